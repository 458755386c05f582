"""What attempts at other objects tell of an object that nobody has tried, or hardly."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import expit

from graspdb_density import se3

Floats = NDArray[np.float64]
Serve = Callable[..., str]
Eventually = Callable[..., Any]
Post = Callable[..., dict[str, Any]]
PutBox = Callable[..., Any]

SIZES = {"a-bar": (0.14, 0.02), "b-bar": (0.2, 0.03), "c-bar": (0.16, 0.04), "other": (0.18, 0.025)}


def attempts(name: str, count: int, seed: int) -> tuple[tuple[Floats, Floats], Floats]:
    """Grasps of a bar along x from above, and how likely each holds: near its middle."""
    length, width = SIZES[name]
    rng = np.random.default_rng(seed)
    p = np.stack(
        [
            rng.uniform(-0.45 * length, 0.45 * length, count),
            rng.normal(0, 0.002, count),
            rng.uniform(0.5 * width + 0.001, 0.5 * width + 0.01, count),
        ],
        axis=1,
    )
    q = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return (p, se3.normalise(q)), expit((0.03 - np.abs(p[:, 0])) / 0.002)


def tell(http: httpx.Client, post: Post, name: str, count: int = 300) -> None:
    poses, truth = attempts(name, count, seed=len(name) + count)
    held = np.random.default_rng(1).random(count) < truth
    outcomes = ["success" if won else "slipped" for won in held]
    post(http, name, poses, outcomes, gripper="pg70", protocol="pull")


def ask(http: httpx.Client, name: str, seed: int = 9) -> tuple[dict[str, Any], Floats]:
    poses, truth = attempts(name, 200, seed)
    body = {"position": poses[0].tolist(), "quaternion_xyzw": poses[1].tolist()}
    answer = http.post(f"/objects/{name}/likelihood", json={"poses": body, "gripper": "pg70"})
    assert answer.status_code == 200, answer.text
    return answer.json(), truth


def prior_of(http: httpx.Client, name: str) -> dict[str, Any]:
    found: dict[str, Any] = ask(http, name)[0]["estimator"]["prior"]
    return found


@pytest.fixture
def bars(database_url: str, serve: Serve, put_box: PutBox, post: Post) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=serve(database_url, learned_estimates=True), timeout=60) as http:
        for name, (length, width) in SIZES.items():
            http.post("/objects", json={"id": name}).raise_for_status()
            put_box(http, name, (length, width, width))
        for name in ("a-bar", "b-bar"):
            tell(http, post, name)
        yield http


def test_other_objects_tell_of_one_that_nobody_tried(
    bars: httpx.Client, database_url: str, serve: Serve, post: Post, eventually: Eventually
) -> None:
    # Two objects are too few to tell of a third.
    answer, _ = ask(bars, "other")
    assert answer["estimator"]["prior"]["name"] == "edges"
    assert set(answer["prior_success_probability"]) <= {0.0, 0.5}
    no_chance = bars.post("/objects/other/best-grasp", json={"objective": "success_probability"}).json()
    assert no_chance["status"] == "no_successes"
    tell(bars, post, "c-bar")
    # Another replica learns of it, and this one hears of that.
    with httpx.Client(base_url=serve(database_url, learned_estimates=True), timeout=60) as there:
        eventually(lambda: prior_of(there, "other")["name"] == "transfer", seconds=120)
    eventually(lambda: prior_of(bars, "other")["name"] == "transfer", seconds=60)
    answer, truth = ask(bars, "other")
    told = answer["estimator"]["prior"]
    assert (told["objects"], told["skill"] > 0.5) == (3, True)
    assert told["attempts"] <= 900
    p = np.array(answer["prior_success_probability"])
    assert np.mean(np.abs(p - truth)) < 0.12
    assert all(value is None for value in answer["success_probability"])
    # Before any attempt the likeliest grasp is by what others tell.
    asked = {"objective": "success_probability", "gripper": "pg70", "prior": True}
    best = bars.post("/objects/other/best-grasp", json=asked).json()
    grasp = best["grasps"][0]
    assert (best["status"], grasp["prior"]) == ("ok", True)
    assert "3 other objects" in best["ranking"]["score"]
    assert grasp["score"] == pytest.approx(grasp["prior_success_probability"])
    assert grasp["prior_success_probability"] > 0.9
    assert abs(grasp["position"][0]) < 0.03


def test_an_object_is_told_by_the_others_until_it_has_taught_enough(
    bars: httpx.Client, post: Post, eventually: Eventually
) -> None:
    tell(bars, post, "c-bar")
    tell(bars, post, "other", 40)
    eventually(lambda: ask(bars, "other")[0]["estimator"]["name"] == "transfer", seconds=120)
    answer, truth = ask(bars, "other")
    told = answer["estimator"]
    assert told["objects"] == 3
    assert told["skill"] > told["kernel_skill"]
    p = np.array([np.nan if value is None else value for value in answer["success_probability"]])
    near = np.isfinite(p)
    assert near.any()
    assert np.mean(np.abs(p - truth)[near]) < 0.15
    assert bars.get("/objects/other/density?gripper=pg70").json()["estimator"]["name"] == "transfer"


def test_who_may_not_see_objects_is_not_told_by_them(
    bars: httpx.Client, database_url: str, serve: Serve, post: Post, eventually: Eventually
) -> None:
    tell(bars, post, "c-bar")
    eventually(lambda: prior_of(bars, "other")["name"] == "transfer", seconds=120)
    made = bars.post("/keys", json={"name": "lab", "scopes": ["read", "trials:write"], "objects": "oth"})
    with httpx.Client(
        base_url=serve(database_url, learned_estimates=True, auth="keys"),
        headers={"Authorization": f"Bearer {made.json()['key']}"},
        timeout=60,
    ) as lab:
        assert prior_of(lab, "other")["name"] == "edges"


def test_what_is_gone_teaches_nothing(
    bars: httpx.Client, database_url: str, serve: Serve, post: Post, eventually: Eventually
) -> None:
    tell(bars, post, "c-bar")
    eventually(lambda: prior_of(bars, "other")["name"] == "transfer", seconds=120)
    bars.delete("/objects/c-bar").raise_for_status()
    with httpx.Client(base_url=serve(database_url, learned_estimates=True), timeout=60) as there:
        eventually(lambda: prior_of(there, "other")["name"] == "edges", seconds=60)
