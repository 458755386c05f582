"""How far answers are from what was tried: in likelihood, best grasp, samples and proposals."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from graspdb_density import se3
from graspdb_geometry.collision import Scene
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]

WIDTHS = {"sigma_position_m": 0.015, "sigma_rotation_deg": 15}
DOWN = (1.0, 0.0, 0.0, 0.0)
#: Tool z along the object's +y.
SIDEWAYS = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)


@pytest.fixture
def tried(http: httpx.Client, make_object: Make, post: Post) -> tuple[Poses, NDArray[np.bool_]]:
    """Some 300 trials of a robot, all of which approach along +y within 40 degrees: none from above."""
    rng = np.random.default_rng(0)
    p = rng.uniform(-1.0, 1.0, (300, 3)) * [0.06, 0.02, 0.04]
    tilt = rng.uniform(-1.0, 1.0, (300, 3)) * 0.6
    q = se3.multiply(np.array(SIDEWAYS), se3.from_rotation_vector(tilt))
    # Turned a little further, what failed succeeds.
    won = rng.random(300) < 0.5 + 0.45 * np.sin(p[:, 0] / 0.03) * np.cos(tilt[:, 0] / 0.2)
    make_object(http)
    outcomes = ["success" if w else "slipped" for w in won]
    post(http, "thing", (p, q), outcomes, gripper="panda", source="robot")
    return (p, q), won


def likelihood(http: httpx.Client, poses: Poses, **more: Any) -> dict[str, Any]:
    body = {"poses": {"position": poses[0].tolist(), "quaternion_xyzw": poses[1].tolist()}, **WIDTHS, **more}
    answer = http.post("/objects/thing/likelihood", json=body)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def best(http: httpx.Client, **query: Any) -> dict[str, Any]:
    answer = http.get("/objects/thing/best-grasp", params={**WIDTHS, **query})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def nearest(poses: Poses, rows: Poses) -> Floats:
    """Position, degrees and widths (M, 3) of the attempt that is fewest widths away."""
    metres = np.linalg.norm(poses[0][:, None] - rows[0], axis=2)
    turns = [se3.angle_between(poses[1][:, None], q) for q in (rows[1], se3.jaw_twin(rows[1]))]
    degrees = np.degrees(np.minimum(*turns))
    widths = np.hypot(metres / 0.015, degrees / 15.0)
    chosen = np.argmin(widths, axis=1)
    each = np.arange(len(poses[0]))
    return np.stack([metres[each, chosen], degrees[each, chosen], widths[each, chosen]], axis=1)


def test_nothing_is_promised_where_nobody_tried(
    http: httpx.Client, tried: tuple[Poses, NDArray[np.bool_]]
) -> None:
    rows, _ = tried
    answer = best(http, approach="0,0,-1", approach_cone_deg=5)
    assert answer["status"] == "ok"
    assert (answer["estimator"]["name"], answer["estimator"]["state"]) == ("kernel", "ready")
    (grasp,) = answer["grasps"]
    assert (grasp["success_probability"], grasp["interval"]) == (None, None)
    support = grasp["support"]
    assert support["enough"] is False
    at = np.array([grasp["position"]]), np.array([grasp["quaternion_xyzw"]])
    expected = nearest(at, rows)[0]
    assert expected[1] > 30
    told = support["nearest_attempt"]
    assert [told["position_m"], told["rotation_deg"], told["kernel_widths"]] == pytest.approx(
        expected, rel=0.02
    )
    assert f"{told['rotation_deg']:.0f} degrees" in support["reason"]
    assert answer["reach"]["rotation_deg"] < told["rotation_deg"]
    # Nor of a few far trials that would all have succeeded.
    for query in ({"min_effective_trials": 0.5}, {"min_success_probability": 0.01}):
        assert best(http, approach="0,0,-1", approach_cone_deg=5, **query)["status"] == "infeasible"
    (likely,) = best(http)["grasps"]
    assert likely["support"]["enough"] is True
    assert likely["support"]["reason"] is None
    assert likely["success_probability"] > 0.5
    assert likely["support"]["effective_trials"] == likely["effective_trials"]


def test_every_pose_knows_its_nearest_attempt(
    http: httpx.Client, tried: tuple[Poses, NDArray[np.bool_]]
) -> None:
    (p, q), _ = tried
    rng = np.random.default_rng(3)
    shift = rng.normal(size=(300, 3)) * np.repeat([0.004, 0.02, 0.2], 100)[:, None]
    poses = p + shift, q
    answer = likelihood(http, poses)
    support, reach = answer["support"], answer["reach"]
    told = np.stack(
        [
            np.array(support["nearest_attempt"][name])
            for name in ("position_m", "rotation_deg", "kernel_widths")
        ],
        axis=1,
    )
    expected = nearest(poses, (p, q))
    np.testing.assert_allclose(told[:, 2], expected[:, 2], rtol=0.05, atol=2e-3)
    near = expected[:, 2] < 2.0
    np.testing.assert_allclose(told[near], expected[near], rtol=0.05, atol=2e-3)
    enough = (told[:, 0] <= reach["position_m"]) & (told[:, 1] <= reach["rotation_deg"])
    np.testing.assert_array_equal(support["enough"], enough)
    assert 0.2 < enough.mean() < 0.8
    known = [value is not None for value in answer["success_probability"]]
    assert known == enough.tolist()
    assert [value is not None for value in answer["interval"]["low"]] == known
    np.testing.assert_allclose(support["effective_trials"], answer["effective_trials"], rtol=1e-6)
    assert "widths" in reach["rule"] or "mm" in reach["rule"]
    # Without a mesh geometry tells nothing.
    assert "prior_success_probability" not in answer
    # Only what is asked for; the same as a stream.
    assert "support" not in likelihood(http, poses, include=["density"])
    assert likelihood(http, poses, include=["support"])["support"] == support
    head = {"Accept": "application/vnd.apache.arrow.stream"}
    body = {"poses": {"position": p.tolist(), "quaternion_xyzw": q.tolist()}, **WIDTHS}
    stream = http.post("/objects/thing/likelihood", json=body, headers=head)
    table = pa.ipc.open_stream(stream.content).read_all()
    assert {
        "support_nearest_attempt_position_m",
        "support_nearest_attempt_rotation_deg",
        "support_nearest_attempt_kernel_widths",
        "support_effective_trials",
        "support_enough",
    } <= set(table.column_names)
    assert all(table["support_enough"].to_pylist())


def test_before_any_attempt_nothing_is_enough(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    few = two_clusters[0][:3], two_clusters[1][:3]
    post(http, "thing", two_clusters)
    answer = likelihood(http, few)
    assert answer["support"] == {
        "nearest_attempt": {
            "position_m": [None] * 3,
            "rotation_deg": [None] * 3,
            "kernel_widths": [None] * 3,
        },
        "effective_trials": [0] * 3,
        "enough": [False] * 3,
    }
    assert "reach" not in answer
    (grasp,) = best(http)["grasps"]
    assert grasp["support"]["nearest_attempt"] is None
    assert "failed" in grasp["support"]["reason"]
    refused = http.get("/objects/thing/best-grasp", params={"min_success_probability": 0.5})
    assert refused.status_code == 409
    assert refused.json()["type"].endswith("no-attempts")


def test_constraints_on_the_chance_hold(http: httpx.Client, tried: tuple[Poses, NDArray[np.bool_]]) -> None:
    del tried
    for objective in ("density", "success_probability"):
        answer = best(http, objective=objective, count=5, min_success_probability=0.7, min_effective_trials=3)
        assert answer["grasps"]
        for grasp in answer["grasps"]:
            assert grasp["success_probability"] >= 0.7 - 1e-9
            assert grasp["effective_trials"] >= 3 - 1e-6
            assert grasp["support"]["enough"] is True
    assert best(http, min_effective_trials=1_000)["status"] == "infeasible"
    wrong = http.get("/objects/thing/best-grasp", params={"min_success_probability": 1.5})
    assert wrong.status_code == 422


def test_one_taught_pose_is_known_and_what_lies_beside_is_not(
    http: httpx.Client, make_object: Make, post: Post
) -> None:
    make_object(http)
    same = np.tile([0.0, 0.0, 0.05], (25, 1)), np.tile(DOWN, (25, 1))
    post(http, "thing", same, ["success"] * 20 + ["slipped"] * 5)
    at = np.array([[0.0, 0.0, 0.05], [0.02, 0.0, 0.05]]), np.tile(DOWN, (2, 1))
    answer = likelihood(http, at)
    assert answer["support"]["enough"] == [True, False]
    assert answer["success_probability"][0] == pytest.approx(0.8, abs=0.01)
    assert answer["success_probability"][1] is None
    (grasp,) = best(http)["grasps"]
    assert grasp["support"]["enough"] is True
    # As trials come, the reach is judged anew.
    rng = np.random.default_rng(0)
    p = rng.uniform(-1.0, 1.0, (400, 3)) * 0.05 + [0.0, 0.0, 0.05]
    won = rng.random(400) < np.where(p[:, 0] > 0.0, 0.95, 0.05)
    post(http, "thing", (p, np.tile(DOWN, (400, 1))), ["success" if w else "slipped" for w in won])
    later = likelihood(http, at)
    assert later["support"]["enough"] == [True, True]
    assert later["reach"]["validated"] is True
    assert later["reach"]["attempts"] == 425


def test_a_reach_is_judged_anew_once_a_quarter_of_the_attempts_are_others(
    http: httpx.Client, make_object: Make, post: Post
) -> None:
    make_object(http)
    rng = np.random.default_rng(0)

    def posted(count: int) -> str:
        p = rng.uniform(-1.0, 1.0, (count, 3)) * 0.05
        won = ["success" if w else "slipped" for w in rng.random(count) < 0.5]
        return str(post(http, "thing", (p, np.tile(DOWN, (count, 1))), won)["batch"])

    def judged() -> int:
        found = likelihood(http, (np.zeros((1, 3)), np.array([DOWN])))
        return int(found["reach"]["attempts"])

    first, _ = posted(300), posted(2_100)
    assert judged() == 2_400
    # Fewer, more, and both at once: what counts is how many of them it was not judged by.
    http.delete(f"/objects/thing/batches/{first}").raise_for_status()
    assert judged() == 2_400
    posted(200)
    assert judged() == 2_400
    posted(150)
    assert judged() == 2_450


def test_draws_know_how_far_they_are(http: httpx.Client, tried: tuple[Poses, NDArray[np.bool_]]) -> None:
    rows, _ = tried
    for call in ("samples", "proposals"):
        drawn = http.post(f"/objects/thing/{call}", json={"count": 50, "seed": 1, **WIDTHS})
        assert drawn.status_code == 200, drawn.text
        answer = drawn.json()
        assert answer["prior"] is False
        told = answer["support"]["nearest_attempt"]["kernel_widths"]
        at = np.array(answer["position"]), np.array(answer["quaternion_xyzw"])
        np.testing.assert_allclose(told, nearest(at, rows)[:, 2], rtol=0.05, atol=2e-3)
        assert any(answer["support"]["enough"])


# -- with a mesh and a gripper


@pytest.fixture
def bar(sqlite_http: httpx.Client, make_object: Make, put_box: Callable[..., Scene]) -> Scene:
    """A bar along z that the jaw can take across x or y."""
    make_object(sqlite_http)
    return put_box(sqlite_http, "thing", (0.02, 0.03, 0.2))


def test_geometry_answers_under_its_own_name(sqlite_http: httpx.Client, bar: Scene, post: Post) -> None:
    http = sqlite_http
    up = np.array([[0.0, 0.0, z] for z in (0.095, 0.0, 0.3)]), np.tile(DOWN, (3, 1))
    answer = likelihood(http, up, gripper="pg70")
    assert answer["success_probability"] == [None, 0.0, None]
    # At the top end, inside of the bar, and above it in the air.
    assert answer["prior_success_probability"] == [0.5, None, 0.0]
    assert answer["collision_free"] == [True, False, True]
    (grasp,) = best(http, gripper="pg70")["grasps"]
    assert grasp["prior"] is True
    assert (grasp["success_probability"], grasp["prior_success_probability"]) == (None, 0.5)
    # What held something by geometry, and failed all the same, is learned from.
    rng = np.random.default_rng(0)
    p = np.array([0.0, 0.0, 0.095]) + rng.uniform(-1.0, 1.0, (60, 3)) * 0.002
    poses = p, np.tile(DOWN, (60, 1))
    assert bar.holds(ToolPoses(*poses), PG70).all()
    post(http, "thing", poses, ["success"] * 15 + ["slipped"] * 45, gripper="pg70")
    below = np.array([[0.0, 0.0, -0.09]]), np.array([[0.0, 0.0, 0.0, 1.0]])
    later = likelihood(
        http, (np.concatenate([up[0], below[0]]), np.concatenate([up[1], below[1]])), gripper="pg70"
    )
    assert later["support"]["enough"] == [True, True, False, False]
    assert later["success_probability"][0] == pytest.approx(0.25, abs=0.1)
    prior = later["prior_success_probability"]
    assert prior[:3] == [None, None, 0.0]
    assert prior[3] == pytest.approx(0.25, abs=0.02)
    drawn = http.post(
        "/objects/thing/proposals", json={"count": 20, "strategy": "edges", "gripper": "pg70", "seed": 2}
    ).json()
    assert drawn["prior"] is True
    assert len(drawn["support"]["enough"]) == 20


def test_a_width_limit_is_not_met_by_closing_on_nothing(
    sqlite_http: httpx.Client, bar: Scene, post: Post
) -> None:
    """The pads' tips reach the bar's end by a few micrometres: they graze its edge and hold nothing."""
    http = sqlite_http
    turn = np.array([math.cos(math.pi / 8), math.sin(math.pi / 8), 0.0, 0.0])
    rng = np.random.default_rng(1)
    p = np.array([0.0, 0.0, 0.1 + PG70.tip_offset_m - 2e-5]) + rng.uniform(-1.0, 1.0, (200, 3)) * 5e-6
    poses = p, np.tile(turn, (200, 1))
    widths = bar.widths(ToolPoses(*poses), PG70)
    grazing = np.isfinite(widths)
    assert grazing.any()
    held = np.array([[0.0, 0.0, 0.09]]), np.array([DOWN])
    post(http, "thing", (np.concatenate([p, held[0]]), np.concatenate([poses[1], held[1]])), gripper="pg70")
    for query in ({}, {"objective": "density", "count": 3}):
        for grasp in best(http, gripper="pg70", max_width_m=0.04, **query)["grasps"]:
            assert 0.015 < grasp["width_m"] <= 0.04
