"""Proposals by expected improvement: they seek the best grasp within bounds, their densities are right."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb_density import GraspDensity, IsotropicKernel, se3
from graspdb_geometry.collision import Scene
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70

Floats = NDArray[np.float64]
Pair = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]
Put = Callable[..., Scene]

#: x and y fit the jaw's 70 mm, z does not.
SIZE = (0.03, 0.05, 0.12)
DOWN = {"approach": [0, 0, -1], "approach_cone_deg": 30}
UP = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def box(sqlite_http: httpx.Client, make_object: Make, put_box: Put) -> Scene:
    """An object with a mesh and no trial."""
    make_object(sqlite_http)
    return put_box(sqlite_http, "thing", SIZE)


def propose(http: httpx.Client, **body: Any) -> dict[str, Any]:
    asked = {"strategy": "expected_improvement", "count": 10, "seed": 1, **body}
    answer = http.post("/objects/thing/proposals", json=asked)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def refused(http: httpx.Client, **body: Any) -> tuple[int, str]:
    answer = http.post("/objects/thing/proposals", json={"strategy": "expected_improvement", **body})
    return answer.status_code, str(answer.json()["type"]).rpartition(":")[2]


def arrays(answer: dict[str, Any]) -> tuple[Floats, Floats, Floats]:
    position, quaternion, density = (
        np.array(answer[name]) for name in ("position", "quaternion_xyzw", "proposal_density")
    )
    return position, quaternion, density


def best(http: httpx.Client, **body: Any) -> dict[str, Any]:
    asked = {"objective": "success_probability", "gripper": "pg70", **body}
    found: dict[str, Any] = http.post("/objects/thing/best-grasp", json=asked).json()["grasps"][0]
    return found


def off_down(q: Floats) -> Floats:
    """Degrees between the approach and straight down."""
    return np.degrees(np.arccos(np.clip(-se3.to_matrix(q)[:, 2, 2], -1, 1)))


# -- before any trial


def test_before_any_trial_it_starts_from_the_edges(sqlite_http: httpx.Client, box: Scene) -> None:
    answer = propose(sqlite_http, count=40, gripper="pg70")
    assert answer["strategy"] == "expected_improvement"
    assert answer["prior"] is True
    p, q, g = arrays(answer)
    assert len(p) == len(answer["expected_gain"]) == 40
    assert (g > 0).all()
    gains = np.array(answer["expected_gain"])
    assert ((gains > 0) & (gains < 1)).all()
    # Nearly none collides, though draws are not tested.
    assert box.collides(ToolPoses(p, q), PG70).mean() <= 0.1
    # Each tells little of the next: they are spread over the object.
    away = np.linalg.norm(p[:, None] - p[None], axis=2)
    assert np.median(away) > 0.03


def test_bounds_are_kept(sqlite_http: httpx.Client, box: Scene) -> None:
    p, q, _ = arrays(propose(sqlite_http, count=60, gripper="pg70", box_min=[-1, -1, 0.03], **DOWN))
    # By the width of what is drawn about each that is chosen, 3 mm and 3 degrees.
    assert p[:, 2].min() > 0.03 - 4 * 0.003
    assert off_down(q).max() < 30 + 4 * 3
    assert (off_down(q) < 30).mean() > 0.6


def test_bounds_may_be_in_the_world(sqlite_http: httpx.Client, box: Scene) -> None:
    """The object lies on its back: down in the world is another direction of its own."""
    turned = [0.5, 0, 0.1, math.sin(math.pi / 4), 0, 0, math.cos(math.pi / 4)]
    _, q, _ = arrays(propose(sqlite_http, count=30, gripper="pg70", object_pose=turned, **DOWN))
    approach = se3.to_matrix(se3.multiply(np.array(turned[3:]), q))[:, :, 2]
    assert (np.degrees(np.arccos(np.clip(-approach[:, 2], -1, 1))) < 42).all()


def test_what_can_not_be_known_is_said(
    sqlite_http: httpx.Client, make_object: Make, put_box: Put, post: Post, two_clusters: Pair
) -> None:
    http = sqlite_http
    make_object(http)
    assert refused(http) == (409, "gripper-unknown")
    assert refused(http, gripper="pg70") == (409, "mesh-missing")
    post(http, "thing", two_clusters)
    # Only successes, and no shape: nothing tells what else might be better.
    assert refused(http) == (409, "no-attempts")
    make_object(http, "other")
    put_box(http, "other", SIZE)
    answer = http.post("/objects/other/proposals", json={"strategy": "expected_improvement"})
    assert str(answer.json()["type"]).endswith("gripper-unknown")


def test_nothing_within_bounds_says_so(sqlite_http: httpx.Client, box: Scene) -> None:
    far = {"gripper": "pg70", "box_min": [1, 1, 1], "box_max": [2, 2, 2]}
    assert refused(sqlite_http, **far) == (409, "nothing-to-try")
    contradicting = {"gripper": "pg70", "box_min": [0, 0, 0.1], "above_plane": [0, 0, -1, 0]}
    assert refused(sqlite_http, **contradicting)[0] == 422
    assert refused(sqlite_http, gripper="pg70", approach=[0, 0, -1])[0] == 422


@pytest.mark.parametrize("strategy", ["density", "uncertainty", "edges"])
def test_strategies_that_keep_no_bounds_refuse_them(
    sqlite_http: httpx.Client, box: Scene, strategy: str
) -> None:
    asked = {"strategy": strategy, "gripper": "pg70", "tool_noise_m": 0.002, **DOWN}
    answer = sqlite_http.post("/objects/thing/proposals", json=asked)
    assert answer.status_code == 422
    fields = {error["field"] for error in answer.json()["errors"]}
    assert fields == {"approach", "approach_cone_deg", "tool_noise_m"}


# -- with trials


def held(p: Floats, q: Floats, rng: np.random.Generator) -> NDArray[np.bool_]:
    """A made-up truth: only what closes near the upper end holds, most of the time."""
    return (p[:, 2] > 0.03) & (rng.random(len(p)) < 0.97)


def test_trials_lead_to_the_best_grasp_within_bounds(sqlite_http: httpx.Client, box: Scene) -> None:
    http, rng = sqlite_http, np.random.default_rng(0)
    for batch in range(5):
        p, q, g = arrays(propose(http, gripper="pg70", seed=batch, **DOWN))
        columns = {"position": p.tolist(), "quaternion_xyzw": q.tolist(), "proposal_density": g.tolist()}
        outcomes = ["success" if won else "slipped" for won in held(p, q, rng)]
        body = {"columns": {**columns, "outcome": outcomes}, "gripper": "pg70"}
        assert http.post("/objects/thing/trials", json=body).status_code == 201
    found = best(http, **DOWN)
    assert found["position"][2] > 0.03
    assert found["success_probability"] > 0.85
    # By now it knows where nothing holds, and no longer goes there.
    p, _, _ = arrays(propose(http, count=20, gripper="pg70", **DOWN))
    assert (p[:, 2] > 0.02).mean() > 0.8


def test_noise_that_the_best_grasp_is_to_withstand_keeps_it_off_collisions(
    sqlite_http: httpx.Client, box: Scene
) -> None:
    def collide(**noise: float) -> float:
        p, q, _ = arrays(propose(sqlite_http, count=100, gripper="pg70", **noise))
        rng = np.random.default_rng(2)
        moved = p[:, None] + rng.standard_normal((100, 20, 3)) * 0.006
        poses = ToolPoses(moved.reshape(-1, 3), np.repeat(q, 20, axis=0))
        return float(box.collides(poses, PG70).mean())

    assert collide(tool_noise_m=0.006) < collide()


@pytest.fixture
def known_and_unknown(clusters: Callable[..., Pair]) -> tuple[Pair, list[str]]:
    """400 attempts on the left of which a quarter succeed, 12 on the right of which two thirds do."""
    left, right = clusters([((-0.1, 0, 0), UP)], 400, seed=1), clusters([((0.1, 0, 0), UP)], 12, seed=2)
    poses = np.concatenate([left[0], right[0]]), np.concatenate([left[1], right[1]])
    return poses, ["success", *["slipped"] * 3] * 100 + ["success", "success", "slipped"] * 4


def test_it_goes_where_more_may_be_gained(
    sqlite_http: httpx.Client, make_object: Make, post: Post, known_and_unknown: tuple[Pair, list[str]]
) -> None:
    """Without any shape: not where much was tried and most of it fails."""
    http = sqlite_http
    make_object(http)
    post(http, "thing", *known_and_unknown)
    answer = propose(http, count=20)
    assert answer["prior"] is False
    assert (np.array(answer["position"])[:, 0] > 0).mean() > 0.6
    assert propose(http, count=20) == answer
    assert propose(http, count=20, seed=2)["position"] != answer["position"]


def test_its_densities_integrate_to_one(
    sqlite_http: httpx.Client, make_object: Make, post: Post, known_and_unknown: tuple[Pair, list[str]]
) -> None:
    """The mean of h / g over draws from g is the integral of h wherever g is: here 1, both twins included."""
    http = sqlite_http
    make_object(http)
    post(http, "thing", *known_and_unknown)
    p, q, g = arrays(propose(http, count=60_000, seed=5))
    narrow = IsotropicKernel(0.0015, math.radians(1.5))
    # About draws in the middle of what is drawn: out in its tails single ratios would count for everything.
    about = np.argsort(-g[:3_000])[:300]
    for symmetric in (True, False):
        h = GraspDensity.build(se3.Poses.of(p[about], q[about]), kernel=narrow, symmetric=symmetric)
        ratio = h.density(se3.Poses.of(p[3_000:], q[3_000:]), cutoff=None, threads=2) / g[3_000:]
        error = ratio.std() / math.sqrt(len(ratio))
        assert error < 0.05
        assert ratio.mean() == pytest.approx(1.0, abs=4 * error)
