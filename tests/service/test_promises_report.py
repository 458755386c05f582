"""The promises report: what answers promised against what became of the trials that name them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest

DOWN = (1.0, 0.0, 0.0, 0.0)


@pytest.fixture
def thing(
    sqlite_http: httpx.Client,
    make_object: Callable[..., str],
    post: Callable[..., Any],
    clusters: Callable[..., Any],
) -> str:
    """Grasps that hold about one place, and three in ten that fail."""
    slug = make_object(sqlite_http)
    outcomes = ["failure" if i % 10 < 3 else "success" for i in range(400)]
    post(sqlite_http, slug, clusters([((0, 0, 0.06), DOWN)], 400), outcomes, gripper="pg70", source="robot")
    return slug


def _report(http: httpx.Client, slug: str, **options: Any) -> dict[str, Any]:
    answer = http.get(f"/objects/{slug}/reports/promises", params=options)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def _tried(http: httpx.Client, slug: str, held: list[bool], **more: Any) -> list[dict[str, Any]]:
    """The best grasps of so many questions, each tried once."""
    trials = []
    for number, outcome in enumerate(held):
        question = {"sphere": [0, 0, 0.06, 0.02 + 1e-4 * number], "objective": "success_probability"}
        best = http.post(f"/objects/{slug}/best-grasp", json=question).json()
        grasp = best["grasps"][0]
        pose = {name: grasp[name] for name in ("position", "quaternion_xyzw")}
        trials.append({**pose, "outcome": outcome, "answer": best["answer"], "gripper": "pg70", **more})
    posted = http.post(f"/objects/{slug}/trials", json={"trials": trials, "source": "robot"})
    assert posted.status_code == 201, posted.text
    return trials


def test_without_any_it_says_what_to_post(sqlite_http: httpx.Client, thing: str) -> None:
    answer = sqlite_http.get(f"/objects/{thing}/reports/promises")
    assert answer.status_code == 409
    assert "answer" in answer.json()["title"]


def test_few_decide_nothing(sqlite_http: httpx.Client, thing: str) -> None:
    _tried(sqlite_http, thing, [True, False, True])
    found = _report(sqlite_http, thing)
    assert (found["verdict"], found["answers"], found["judged"]) == ("undecided", 3, 3)
    assert "too little" in found["text"]
    assert found["difference"]["low"] < 0 < found["difference"]["high"]
    assert found["selection"]["more_than_selection"] is None


def test_promises_that_are_kept_and_such_that_are_not(sqlite_http: httpx.Client, thing: str) -> None:
    trials = _tried(sqlite_http, thing, [i not in (3, 11) for i in range(24)])
    # Never tried; once it is read, it is written.
    untried = sqlite_http.post(f"/objects/{thing}/best-grasp", json={"count": 7}).json()["answer"]
    assert sqlite_http.get(f"/answers/{untried}").status_code == 200
    found = _report(sqlite_http, thing)
    assert (found["verdict"], found["answers"], found["unmatched"]) == ("as-promised", 24, 0)
    assert (found["answers_given"], found["answers_never_tried"]) == (25, 1)
    assert found["match_position_m"] == pytest.approx(0, abs=1e-9)
    assert 0.5 < found["promised"]["low"] <= found["promised"]["value"] <= found["promised"]["high"] < 1
    assert found["selection"]["share_of_all"] == pytest.approx(0.7)
    assert any("Only what promised" in warning for warning in found["warnings"])
    assert sum(item["answers"] for item in found["bins"]) == 24
    # The same answers again, and all fail: each still counts once.
    failed = [{**trial, "outcome": False} for trial in trials for _ in range(9)]
    sqlite_http.post(f"/objects/{thing}/trials", json={"trials": failed, "source": "robot"})
    found = _report(sqlite_http, thing)
    assert (found["verdict"], found["answers"], found["judged"]) == ("over-promised", 24, 240)
    assert found["selection"]["more_than_selection"]
    assert found["happened"]["value"] < 0.2
    assert "More than choosing the highest" in found["text"]
    figure = sqlite_http.get(f"/objects/{thing}/reports/promises", headers={"Accept": "image/png"})
    assert figure.content.startswith(b"\x89PNG")
    # Withdrawn ones tell nothing.
    seqs = [
        item["seq"] for item in sqlite_http.get(f"/objects/{thing}/trials?since_revision=2").json()["items"]
    ]
    sqlite_http.delete(f"/objects/{thing}/trials/{seqs[-1]}")
    assert _report(sqlite_http, thing)["judged"] == 239


def test_what_was_tried_elsewhere_is_told_apart(sqlite_http: httpx.Client, thing: str) -> None:
    best = sqlite_http.post(f"/objects/{thing}/best-grasp", json={}).json()
    pose = {name: best["grasps"][0][name] for name in ("position", "quaternion_xyzw")}
    far = [pose["position"][0] + 0.05, *pose["position"][1:]]
    plain = sqlite_http.post(f"/objects/{thing}/samples", json={"count": 2}).json()
    drawn = {"position": plain["position"][0], "quaternion_xyzw": plain["quaternion_xyzw"][0]}
    likely = sqlite_http.post(f"/objects/{thing}/likelihood", json={"poses": [pose]}).json()
    trials = [
        {**pose, "outcome": True, "answer": best["answer"]},
        {**pose, "position": far, "outcome": True, "answer": best["answer"]},
        {**drawn, "outcome": True, "answer": plain["answer"]},
        {**pose, "outcome": True, "answer": likely["answer"]},
        {**pose, "outcome": "simulation_error", "answer": best["answer"]},
    ]
    posted = sqlite_http.post(f"/objects/{thing}/trials", json={"trials": trials, "gripper": "pg70"})
    assert posted.status_code == 201
    found = _report(sqlite_http, thing)
    assert (found["trials"], found["unmatched"], found["without_promise"], found["answers"]) == (4, 1, 1, 2)
    found = _report(sqlite_http, thing, match_position_m=0.1)
    assert (found["unmatched"], found["judged"]) == (0, 3)
    # The twin of a symmetric jaw is the same grasp.
    x, y, z, w = pose["quaternion_xyzw"]
    twin = {**pose, "quaternion_xyzw": [y, -x, w, -z], "outcome": True, "answer": best["answer"]}
    sqlite_http.post(f"/objects/{thing}/trials", json={**twin, "gripper": "pg70"})
    assert _report(sqlite_http, thing)["unmatched"] == 1


def test_misplacing_is_told_and_what_it_explains(sqlite_http: httpx.Client, thing: str) -> None:
    rng = np.random.default_rng(0)
    trials = _tried(sqlite_http, thing, [True] * 12)
    moved = []
    for trial in trials:
        off = rng.normal(size=3)
        position = (np.array(trial["position"]) + 0.004 * off / np.linalg.norm(off)).tolist()
        achieved = {"position": position, "quaternion_xyzw": trial["quaternion_xyzw"]}
        moved.append({**trial, "outcome": False, "achieved_pose": achieved})
    sqlite_http.post(f"/objects/{thing}/trials", json={"trials": moved})
    found = _report(sqlite_http, thing)
    place = found["placement"]
    assert place["trials"] == 12
    assert place["position_m"] == pytest.approx(0.004)
    assert place["position_failed_m"] == pytest.approx(0.004)
    assert (place["position_held_m"], place["rotation_deg"]) == (None, pytest.approx(0, abs=1e-4))
    assert 0 < place["achieved_probability"] < 1
    assert 0 < place["commanded_probability"] < 1
    assert found["unmatched"] == 0
