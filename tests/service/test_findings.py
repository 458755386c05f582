"""Posted trials are looked at: what is doubtful is said, what is impossible refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb_density import se3

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]


@pytest.fixture
def box(http: httpx.Client, make_object: Callable[..., str], put_box: Callable[..., Any]) -> str:
    """An object that is a box of 4 x 6 x 10 cm."""
    slug = make_object(http, "box")
    put_box(http, slug)
    return slug


def _grasps(count: int = 40) -> Poses:
    """Grasps of the box that hold: down from above or up from below, closing across x."""
    rng = np.random.default_rng(0)
    positions = rng.uniform(-0.005, 0.005, (count, 3))
    down = np.arange(count) % 2 == 0
    positions[:, 2] = np.where(down, 0.04, -0.04)
    across = np.array([0.5**0.5, 0.5**0.5, 0.0, 0.0])
    upward = se3.multiply(across, np.array([1.0, 0.0, 0.0, 0.0]))
    return positions, np.where(down[:, None], across, upward)


def _body(poses: Poses, **more: Any) -> dict[str, Any]:
    columns = {
        "position": poses[0].tolist(),
        "quaternion_xyzw": poses[1].tolist(),
        "outcome": ["success"] * len(poses[0]),
    }
    return {"columns": columns, "gripper": "panda", "source": "robot", **more}


def _found(document: dict[str, Any]) -> dict[str, int]:
    return {finding["code"]: finding["count"] for finding in document["findings"]}


def test_good_trials_raise_no_doubt(http: httpx.Client, box: str, post: Post) -> None:
    receipt = post(http, box, _grasps(), gripper="panda", protocol="lift", source="robot")
    assert receipt["findings"] == []
    batch = http.get(f"/objects/{box}/batches/{receipt['batch']}").json()
    assert batch["findings"] == []
    assert (batch["grippers"], batch["sources"], batch["protocols"]) == (["panda"], ["robot"], ["lift"])
    assert batch["outcomes"] == {"success": 40}
    assert http.get(f"/objects/{box}/density").json()["findings"] == []


def test_millimetres_are_refused_where_a_mesh_is_known(http: httpx.Client, box: str) -> None:
    positions, quaternions = _grasps()
    body = _body((positions * 1000, quaternions))
    refused = http.post(f"/objects/{box}/trials", json=body, headers={"Idempotency-Key": "mm"})
    assert refused.status_code == 422
    problem = refused.json()
    assert problem["type"].endswith(":implausible-poses")
    assert "millimetres" in problem["detail"]
    assert "0.001" in problem["detail"]
    assert problem["errors"][0]["field"].startswith("columns.position.")
    assert {item["code"] for item in problem["findings"]} >= {"looks-like-millimetres", "implausible-poses"}
    assert http.get(f"/objects/{box}").json()["trials"] == 0

    path = f"/objects/{box}/trials?accept_implausible=true"
    taken = http.post(path, json=body, headers={"Idempotency-Key": "mm"})
    assert taken.status_code == 201
    told = taken.json()["findings"]
    assert told[0]["code"] == "implausible-poses"
    assert told[0]["count"] == told[0]["examined"] == 40
    assert told[0]["first_indices"] == list(range(10))
    batch = http.get(taken.headers["Location"]).json()
    assert batch["findings"] == told
    density = http.get(f"/objects/{box}/density").json()
    assert _found(density) == _found(batch)
    assert density["findings"][0]["first_indices"] == list(range(1, 11))
    # The same request again is answered the same, whether it says so again or not.
    again = http.post(f"/objects/{box}/trials", json=body, headers={"Idempotency-Key": "mm"})
    assert (again.status_code, again.json()) == (201, taken.json())


def test_what_was_stored_before_the_mesh_is_answered_again(
    http: httpx.Client, make_object: Callable[..., str], put_box: Callable[..., Any]
) -> None:
    slug = make_object(http, "later")
    positions, quaternions = _grasps()
    body, key = _body((positions * 1000, quaternions)), {"Idempotency-Key": "once"}
    first = http.post(f"/objects/{slug}/trials", json=body, headers=key)
    assert first.status_code == 201
    assert _found(first.json()) == {"looks-like-millimetres": 40}
    put_box(http, slug)
    assert http.post(f"/objects/{slug}/trials", json=body, headers=key).json() == first.json()
    assert http.post(f"/objects/{slug}/trials", json=body).status_code == 422


def test_a_flange_is_no_tool(http: httpx.Client, box: str, post: Post) -> None:
    """Poses of a flange 15 cm behind the tool: nothing is within the fingers' reach."""
    positions, quaternions = _grasps()
    behind = positions - se3.rotate(quaternions, np.array([0.0, 0.0, 0.15]))
    receipt = post(http, box, (behind, quaternions), gripper="panda")
    assert _found(receipt) == {"out-of-reach": 40}
    assert "flange" in receipt["findings"][0]["remedy"]
    away = post(http, box, (behind, se3.multiply(quaternions, np.array([1.0, 0, 0, 0]))), gripper="panda")
    assert {"out-of-reach", "approaches-away", "another-approach-axis"} <= set(_found(away))


def test_w_first_is_told(http: httpx.Client, box: str, post: Post) -> None:
    positions, quaternions = _grasps()
    receipt = post(http, box, (positions, np.roll(quaternions, 1, axis=1)), gripper="panda")
    assert receipt["findings"][0]["code"] == "looks-like-wxyz"
    assert "--quaternion-order wxyz" in receipt["findings"][0]["remedy"]


def test_an_outcome_that_says_so_itself_is_no_doubt(http: httpx.Client, box: str, post: Post) -> None:
    down = np.array([[1.0, 0.0, 0.0, 0.0]])
    inside, above = np.array([[0, 0, 0.0]]), np.array([[0, 0, 0.065]])
    for position, code, outcome in (
        (inside, "collides", "collision"),
        (above, "closes-on-nothing", "missed"),
    ):
        assert _found(post(http, box, (position, down), "success", gripper="panda")) == {code: 1}
        assert _found(post(http, box, (position, down), outcome, gripper="panda")) == {}


def test_rows_posted_twice_are_told_until_one_batch_goes(http: httpx.Client, box: str, post: Post) -> None:
    poses = _grasps()
    first = post(http, box, poses)
    # With the gripper that was forgotten, and more rows in front.
    more, turns = _grasps(43)
    # In millimetres and back, and the other quaternions of the same rotations.
    again = poses[0] * 1000 * 0.001, -poses[1]
    moved = np.concatenate([more[40:] + 0.001, again[0]]), np.concatenate([turns[40:], again[1]])
    second = post(http, box, moved, gripper="panda")
    told = second["findings"][0]
    assert (told["code"], told["count"], told["examined"]) == ("posted-before", 40, 43)
    assert told["batches"] == [first["batch"]]
    assert told["first_indices"] == list(range(3, 13))
    batch = f"/objects/{box}/batches/{second['batch']}"
    assert http.get(batch).json()["findings"] == second["findings"]
    assert _found(http.get(f"/objects/{box}/density").json()) == {"posted-before": 40}
    assert http.delete(f"/objects/{box}/batches/{first['batch']}").status_code == 204
    assert http.get(batch).json()["findings"] == []
    assert http.get(f"/objects/{box}/density").json()["findings"] == []


def test_attempts_at_other_times_are_no_repeats(http: httpx.Client, box: str, post: Post) -> None:
    poses = _grasps(3)
    times = [f"2026-01-0{day}T00:00:00Z" for day in (1, 2, 3)]
    same = tuple(np.repeat(part[:1], 3, axis=0) for part in poses)
    assert _found(post(http, box, same)) == {"repeated-rows": 2}
    body = _body((same[0], same[1]))
    body["columns"]["measured_at"] = times
    assert http.post(f"/objects/{box}/trials", json=body).json()["findings"] == []


def test_rows_of_large_batches_are_compared_by_a_sample(
    http: httpx.Client, make_object: Callable[..., str], post: Post
) -> None:
    slug = make_object(http)
    rng = np.random.default_rng(3)
    quaternions = se3.random_quaternions(6_000, rng)
    poses = rng.normal(scale=0.05, size=(6_000, 3)), quaternions
    post(http, slug, tuple(part[:3_000] for part in poses))
    (told,) = post(http, slug, poses)["findings"]
    assert told["code"] == "posted-before"
    assert told["examined"] == 1_024
    assert abs(told["count"] / told["examined"] - 0.5) < 0.08
    assert "looked at" in told["message"]


def test_findings_follow_the_selection(http: httpx.Client, box: str, post: Post) -> None:
    inside, down = np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]])
    post(http, box, (inside, down), gripper="panda")
    post(http, box, _grasps(), gripper="pg70")
    density = http.get(f"/objects/{box}/density?gripper=panda").json()
    assert _found(density) == {"collides": 1}
    assert http.get(f"/objects/{box}/density?gripper=pg70").json()["findings"] == []
    mixed = {
        "trials": [
            {"position": p, "quaternion_xyzw": q, "outcome": True, "gripper": g}
            for p, q, g in (([0, 0, 0.001], [1, 0, 0, 0], "panda"), ([0, 0, 0.045], [1, 0, 0, 0], "pg70"))
        ]
    }
    receipt = http.post(f"/objects/{box}/trials", json=mixed).json()
    assert _found(receipt)["collides"] >= 1
    assert _found(http.get(f"/objects/{box}/density?gripper=panda").json())["collides"] == 2
    listed = http.get(f"/objects/{box}/batches").json()["items"][-1]
    assert listed["grippers"] == ["panda", "pg70"]


def test_many_provenances_are_looked_at_together(http: httpx.Client, box: str) -> None:
    positions, quaternions = _grasps(40)
    body = _body((positions + np.array([0, 0, 1.0]), quaternions))
    body["columns"]["protocol"] = [f"p{i}" for i in range(40)]
    receipt = http.post(f"/objects/{box}/trials", json=body).json()
    assert _found(receipt)["out-of-reach"] == 40


def test_an_unknown_gripper_is_still_named(http: httpx.Client, box: str) -> None:
    answer = http.post(f"/objects/{box}/trials", json=_body(_grasps(), gripper="claw"))
    assert answer.status_code == 422
    assert answer.json()["type"].endswith(":unknown-gripper")


def test_a_width_beyond_the_jaw_s_is_told(http: httpx.Client, make_object: Callable[..., str]) -> None:
    """Also where there is no mesh; up to 2 mm are a matter of calibration."""
    slug = make_object(http, "wide")
    for width, count in ((0.0819, 0), (0.083, 2), (None, 0)):
        body = _body(_grasps(2))
        body["columns"]["width_m"] = [width] * 2
        body["protocol"] = f"w{width}"
        receipt = http.post(f"/objects/{slug}/trials", json=body).json()
        assert _found(receipt).get("wider-than-the-jaw", 0) == count, receipt
    found = http.get(f"/objects/{slug}/batches").json()["items"][1]["findings"]
    (told,) = (finding for finding in found if finding["code"] == "wider-than-the-jaw")
    assert "80 mm" in told["message"]
    assert told["examined"] == 2
