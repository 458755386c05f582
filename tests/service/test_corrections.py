"""Single trials are withdrawn and corrected: kept, with a history, and out of every estimate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest

from graspdb_density import se3
from graspdb_service.storage.database import Database
from graspdb_service.storage.tables import trial_changes, trials

Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]


@pytest.fixture
def posted(http: httpx.Client, make_object: Make, clusters: Callable[..., Any], post: Post) -> str:
    """An object with 30 successes (seq 1 to 30) and 30 failures (31 to 60) about one pose."""
    slug = make_object(http)
    for seed, outcome in enumerate(("success", "failure")):
        poses = clusters([((0, 0, 0.06), (1, 0, 0, 0))], 30, seed=seed)
        post(http, slug, poses, outcome, source="robot", gripper="panda")
    return slug


def _trial(http: httpx.Client, slug: str, seq: int) -> dict[str, Any]:
    answer = http.get(f"/objects/{slug}/trials/{seq}")
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def _likelihood(http: httpx.Client, slug: str) -> dict[str, Any]:
    pose = {"position": [0, 0, 0.06], "quaternion_xyzw": [1, 0, 0, 0]}
    answer = http.post(f"/objects/{slug}/likelihood", json={"poses": [pose]})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_a_withdrawn_trial_is_out_of_every_estimate(http: httpx.Client, posted: str) -> None:
    before, kept = http.get(f"/objects/{posted}").json(), http.get(f"/objects/{posted}/density").json()
    likely = _likelihood(http, posted)
    path = f"/objects/{posted}/trials/7"
    assert http.delete(path, params={"reason": "wrong object"}).status_code == 204
    after = http.get(f"/objects/{posted}").json()
    assert after["outcomes"] == {"success": 29, "failure": 30}
    assert after["revision"] == after["epoch"] == before["revision"] + 1
    density = http.get(f"/objects/{posted}/density").json()
    assert (kept["size"], density["size"]) == (30, 29)
    assert density["outcomes"] == {"success": 29, "failure": 30}
    assert _likelihood(http, posted)["density"] != likely["density"]
    best = http.get(f"/objects/{posted}/best-grasp?objective=success_probability").json()
    assert 7 not in best["grasps"][0]["nearest_trials"]

    found = _trial(http, posted, 7)
    assert found["withdrawn"]
    assert found["revision"] == after["revision"]
    (change,) = found["history"]
    assert change["before"] == {"withdrawn": False}
    assert change["reason"] == "wrong object"
    # Once more changes nothing.
    assert http.delete(path).status_code == 204
    assert http.get(f"/objects/{posted}").json() == after

    # And back.
    back = http.patch(path, json={"withdrawn": False}).json()
    assert (back["withdrawn"], len(back["history"])) == (False, 2)
    assert http.get(f"/objects/{posted}").json()["outcomes"] == {"success": 30, "failure": 30}
    assert _likelihood(http, posted)["density"] == pytest.approx(likely["density"])


def test_it_is_as_if_it_had_never_come(
    http: httpx.Client, make_object: Make, clusters: Callable[..., Any], post: Post
) -> None:
    """Densities and probabilities are those of an object that never had the trial."""
    poses = clusters([((0, 0, 0.06), (1, 0, 0, 0))], 40, seed=5)
    outcomes = ["success" if i % 3 else "failure" for i in range(40)]
    rest = np.arange(40) != 11
    post(http, make_object(http, "all"), poses, outcomes)
    others = [outcome for outcome, kept in zip(outcomes, rest, strict=True) if kept]
    post(http, make_object(http, "others"), tuple(part[rest] for part in poses), others)
    http.delete("/objects/all/trials/12")
    for name in ("density", "success_probability", "effective_trials"):
        assert _likelihood(http, "all")[name] == pytest.approx(_likelihood(http, "others")[name])


def test_an_outcome_is_corrected_with_its_history(http: httpx.Client, posted: str) -> None:
    path = f"/objects/{posted}/trials/31"
    first = http.patch(
        path, json={"outcome": True, "metadata": {"seen": "video"}, "reason": "held after all"}
    )
    assert first.status_code == 200
    assert first.json()["outcome"] == "success"
    assert first.json()["metadata"] == {"seen": "video"}
    second = http.patch(path, json={"outcome": "slipped"}).json()
    assert [change["before"] for change in second["history"]] == [
        {"metadata": None, "outcome": "failure"},
        {"outcome": "success"},
    ]
    assert http.get(f"/objects/{posted}").json()["outcomes"] == {"success": 30, "failure": 29, "slipped": 1}
    assert [
        item["seq"] for item in http.get(f"/objects/{posted}/trials?outcome=slipped").json()["items"]
    ] == [31]
    revision = http.get(f"/objects/{posted}").json()["revision"]
    assert http.patch(path, json={"outcome": "slipped", "reason": "again"}).json() == second
    assert http.get(f"/objects/{posted}").json()["revision"] == revision
    # A withdrawn trial may be corrected: it counts as what it is once it is taken back.
    http.delete(path)
    http.patch(path, json={"outcome": "success"})
    assert http.get(f"/objects/{posted}").json()["outcomes"] == {"success": 30, "failure": 29}
    http.patch(path, json={"withdrawn": False})
    assert http.get(f"/objects/{posted}").json()["outcomes"] == {"success": 31, "failure": 29}


def test_listings_mark_and_select_withdrawn_trials(http: httpx.Client, posted: str) -> None:
    revision = http.get(f"/objects/{posted}").json()["revision"]
    http.delete(f"/objects/{posted}/trials/3")
    place = f"/objects/{posted}/trials"

    def seqs(**params: Any) -> list[int]:
        return [item["seq"] for item in http.get(place, params={"limit": 100, **params}).json()["items"]]

    assert len(seqs()) == 60
    assert seqs(withdrawn=True) == [3]
    assert 3 not in seqs(withdrawn=False)
    assert seqs(since_revision=revision) == [3]
    lines = http.get(place, headers={"Accept": "application/x-ndjson"}).text.splitlines()
    assert sum('"withdrawn":true' in line for line in lines) == 1
    batch = http.get(f"/objects/{posted}/batches").json()["items"][0]
    assert (batch["inserted"], batch["withdrawn"], batch["outcomes"]) == (30, 1, {"success": 29})


def test_a_batch_goes_with_its_withdrawn_trials_and_their_history(
    http: httpx.Client, posted: str, database_url: str
) -> None:
    http.delete(f"/objects/{posted}/trials/3")
    http.patch(f"/objects/{posted}/trials/4", json={"outcome": "dropped"})
    http.delete(f"/objects/{posted}/trials/35")
    first, second = http.get(f"/objects/{posted}/batches").json()["items"]
    assert http.delete(f"/objects/{posted}/batches/{first['batch']}").status_code == 204
    assert http.get(f"/objects/{posted}").json()["outcomes"] == {"failure": 29}
    database = Database(database_url)
    with database.read() as tx:
        assert [row.seq for row in tx.execute(trial_changes.select())] == [35]
    database.dispose()
    assert http.delete(f"/objects/{posted}/batches/{second['batch']}").status_code == 204
    assert http.get(f"/objects/{posted}").json()["outcomes"] == {}


def test_a_finding_ends_with_the_trials_it_is_about(
    http: httpx.Client, make_object: Make, put_box: Callable[..., Any], post: Post
) -> None:
    slug = make_object(http)
    put_box(http, slug)
    across = se3.multiply(np.array([1.0, 0, 0, 0]), np.array([0, 0, 0.5**0.5, 0.5**0.5]))
    positions = np.array([[0, 0, 0.0], [0, 0, 0.04], [0, 0, 0.001]])
    receipt = post(http, slug, (positions, np.tile(across, (3, 1))), gripper="panda")
    assert [(f["code"], f["first_indices"]) for f in receipt["findings"]] == [("collides", [0, 2])]

    def found() -> list[tuple[int, list[int]]]:
        density = http.get(f"/objects/{slug}/density").json()
        return [(finding["count"], finding["first_indices"]) for finding in density["findings"]]

    assert found() == [(2, [1, 3])]
    http.delete(f"/objects/{slug}/trials/1")
    assert found() == [(1, [3])]
    http.delete(f"/objects/{slug}/trials/3")
    assert found() == []


def test_what_can_not_be_corrected_is_named(http: httpx.Client, posted: str) -> None:
    for seq in (0, 61, 10**30):
        assert http.delete(f"/objects/{posted}/trials/{seq}").status_code in (404, 422)
    assert http.get(f"/objects/{posted}/trials/61").status_code == 404
    assert http.delete("/objects/nothing/trials/1").status_code == 404
    for body in ({"outcome": "perfect"}, {"position": [0, 0, 0]}, {"metadata": {"x": "\x00"}}):
        assert http.patch(f"/objects/{posted}/trials/1", json=body).status_code == 422
    assert http.patch(f"/objects/{posted}/trials/1", json={}).json() == _trial(http, posted, 1)


def test_a_trial_of_a_sweep_stays_as_it_was_simulated(
    http: httpx.Client, posted: str, database_url: str
) -> None:
    database = Database(database_url)
    with database.write() as tx:
        tx.execute(trials.update().where(trials.c.seq == 5).values(pose_index=17))
    database.dispose()
    refused = http.delete(f"/objects/{posted}/trials/5")
    assert refused.status_code == 409
    assert refused.json()["type"].endswith(":trial-of-a-sweep")
    assert not _trial(http, posted, 5)["withdrawn"]
