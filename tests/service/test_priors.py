"""What an object's edges tell before any trial: proposals drawn from them, and best grasps marked prior."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from graspdb_density import GraspDensity, IsotropicKernel, se3
from graspdb_geometry.collision import Scene
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]
Put = Callable[..., Scene]

#: Of the box the tests grasp: x and y fit the jaw's 70 mm, z does not.
SIZE = (0.03, 0.05, 0.12)


@pytest.fixture
def box(sqlite_http: httpx.Client, make_object: Make, put_box: Put) -> Scene:
    """An object with a mesh and no trial."""
    make_object(sqlite_http)
    return put_box(sqlite_http, "thing", SIZE)


def propose(http: httpx.Client, **body: Any) -> dict[str, Any]:
    answer = http.post("/objects/thing/proposals", json={"strategy": "edges", "gripper": "pg70", **body})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def arrays(answer: dict[str, Any]) -> tuple[Floats, Floats, Floats]:
    position, quaternion, density = (
        np.array(answer[name]) for name in ("position", "quaternion_xyzw", "proposal_density")
    )
    return position, quaternion, density


def best(http: httpx.Client, **body: Any) -> dict[str, Any]:
    answer = http.post("/objects/thing/best-grasp", json={"gripper": "pg70", **body})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def poses_of(grasps: list[dict[str, Any]]) -> Poses:
    return np.array([g["position"] for g in grasps]), np.array([g["quaternion_xyzw"] for g in grasps])


def kind(answer: httpx.Response) -> tuple[int, str]:
    return answer.status_code, str(answer.json()["type"]).rpartition(":")[2]


# -- proposals


def test_edges_close_on_opposed_faces_at_any_turn(sqlite_http: httpx.Client, box: Scene) -> None:
    answer = propose(sqlite_http, count=4_000, seed=3)
    assert "edges" in answer["kernel"]["rule"]
    assert "not tested" in answer["criterion"]
    p, q, g = arrays(answer)
    closing, approach = se3.to_matrix(q)[:, :, 1], se3.to_matrix(q)[:, :, 2]
    # Along x or y, which fit the jaw, and never along z; within five widths of the kernel.
    angle = np.degrees(np.arccos(np.clip(np.abs(closing), 0, 1)))
    assert (angle[:, :2].min(axis=1) < 75).all()
    assert np.median(angle[:, :2].min(axis=1)) < 25
    for axis in (0, 1):
        assert (angle[:, axis] < 30).mean() > 0.15
    # Approaches from above, from below and from either side.
    for direction in ((0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)):
        assert (approach @ np.array(direction) > 0.8).mean() > 0.02, direction
    assert (np.abs(p) < np.array(SIZE) / 2 + 0.05).all()
    # Far more of them are free of the object than of poses turned at random in the same places.
    free = ~box.collides(ToolPoses(p, q), PG70)
    random = se3.random_quaternions(len(p), np.random.default_rng(0))
    assert free.mean() > 0.4
    assert (
        np.isfinite(box.widths(ToolPoses(p, q), PG70)).mean()
        > 3 * np.isfinite(box.widths(ToolPoses(p, random), PG70)).mean()
    )
    assert (g > 0).all()
    assert propose(sqlite_http, count=4_000, seed=3) == answer
    assert propose(sqlite_http, count=4_000, seed=4)["position"] != answer["position"]


@pytest.mark.parametrize("symmetric", [True, False])
def test_their_density_integrates_to_one(sqlite_http: httpx.Client, box: Scene, symmetric: bool) -> None:
    """The mean of h / g over draws from g is the integral of h wherever g is: 1, both twins included."""
    del box
    profile = sqlite_http.get("/grippers/pg70").json()["profile"]
    made = sqlite_http.post("/grippers", json={**profile, "id": "own", "symmetric": symmetric})
    assert made.status_code == 201, made.text
    p, q, g = arrays(propose(sqlite_http, gripper="own", count=40_000, seed=5, sigma_rotation_deg=20))
    narrow = IsotropicKernel(0.008, math.radians(14))
    h = GraspDensity.build(se3.Poses.of(p[:400], q[:400]), kernel=narrow, symmetric=symmetric)
    ratio = h.density(se3.Poses.of(p[400:], q[400:]), cutoff=None, threads=2) / g[400:]
    error = ratio.std() / math.sqrt(len(ratio))
    assert error < 0.05
    assert ratio.mean() == pytest.approx(1.0, abs=4 * error)


def test_widths_of_the_kernel_are_as_asked(sqlite_http: httpx.Client, box: Scene) -> None:
    del box
    wide = propose(sqlite_http, count=10, sigma_position_m=0.02, sigma_rotation_deg=25)["kernel"]
    assert (wide["sigma_position_m"], wide["sigma_rotation_deg"]) == (0.02, 25)
    usual = propose(sqlite_http, count=10)["kernel"]
    assert (usual["sigma_position_m"], usual["sigma_rotation_deg"]) == (0.01, 15)


def test_what_edges_need_is_said(
    sqlite_http: httpx.Client, make_object: Make, put_box: Put, box: Scene
) -> None:
    del box
    http = sqlite_http

    def refused(slug: str, **body: Any) -> tuple[int, str]:
        return kind(http.post(f"/objects/{slug}/proposals", json={"strategy": "edges", **body}))

    assert refused("thing") == (409, "gripper-unknown")
    assert refused("thing", gripper="pg70", kernel="anisotropic") == (422, "invalid-request")
    assert refused("thing", gripper="none") == (404, "not-found")
    make_object(http, "shapeless")
    assert refused("shapeless", gripper="pg70") == (409, "mesh-missing")
    make_object(http, "huge")
    put_box(http, "huge", (0.3, 0.3, 0.3))
    assert refused("huge", gripper="pg70") == (409, "no-surface-pairs")
    make_object(http, "tight")
    # It fits between the fingers by less than any collision test of the open jaw allows.
    put_box(http, "tight", (PG70.max_opening_m, 0.3, 0.3))
    assert refused("tight", gripper="pg70")[1] in ("edges-unreachable", "no-surface-pairs")


def test_a_smooth_object_has_opposed_points(sqlite_http: httpx.Client, make_object: Make) -> None:
    """No facet of it is large enough to be a face, and it has no edge."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.025)
    ball.vertices *= [1.0, 1.0, 2.0]
    make_object(sqlite_http)
    put = sqlite_http.put(
        "/objects/thing/mesh?unit=m",
        content=ball.export(file_type="stl"),
        headers={"Content-Type": "model/stl"},
    )
    assert put.status_code in (200, 201), put.text
    p, q, _ = arrays(propose(sqlite_http, count=3_000, seed=1, sigma_position_m=0.005))
    # Across the long axis, which does not fit, and not along it; all around it.
    closing = se3.to_matrix(q)[:, :, 1]
    assert np.median(np.abs(closing[:, 2])) < 0.35
    turn = np.arctan2(closing[:, 1], closing[:, 0]) % np.pi
    assert np.histogram(turn, bins=6, range=(0, np.pi))[0].min() > 0.1 * len(turn)
    held = Scene([(np.asarray(ball.vertices), np.asarray(ball.faces))]).holds(ToolPoses(p, q), PG70)
    assert held.mean() > 0.5
    (grasp,) = best(sqlite_http)["grasps"]
    assert grasp["prior"] is True
    assert grasp["width_m"] == pytest.approx(0.05, rel=0.1)


# -- best grasps


def test_a_grasp_before_any_success_is_marked_prior(
    sqlite_http: httpx.Client, box: Scene, post: Post, clusters: Callable[..., Poses]
) -> None:
    answer = best(sqlite_http, count=5)
    assert (answer["status"], len(answer["grasps"])) == ("ok", 5)
    assert "edges" in answer["kernel"]["rule"]
    p, q = poses_of(answer["grasps"])
    assert np.isfinite(box.widths(ToolPoses(p, q), PG70)).all()
    for grasp in answer["grasps"]:
        assert grasp["prior"] is True
        assert grasp["collision_free"] is True
        assert (grasp["success_probability"], grasp["interval"], grasp["effective_trials"]) == (None, None, 0)
        assert grasp["nearest_trials"] == []
        assert grasp["width_m"] < PG70.max_opening_m
    # As dense as a proposal there would be.
    drawn = propose(sqlite_http, count=5_000, seed=1)
    assert answer["grasps"][0]["density"] > np.max(drawn["proposal_density"])
    by_get = sqlite_http.get("/objects/thing/best-grasp", params={"gripper": "pg70", "count": 5})
    assert by_get.json()["grasps"] == answer["grasps"]
    # One success, and trials answer.
    post(sqlite_http, "thing", clusters([((0, 0, 0.05), (1.0, 0, 0, 0))], 1), gripper="pg70")
    after = best(sqlite_http)
    assert after["grasps"][0]["prior"] is False
    assert "edges" not in after["kernel"]["rule"]


def test_it_keeps_every_constraint(sqlite_http: httpx.Client, box: Scene) -> None:
    answer = best(
        sqlite_http,
        count=3,
        box_min=[-0.1, -0.1, 0.03],
        box_max=[0.1, 0.1, 0.2],
        approach=[0, 0, -1],
        approach_cone_deg=20,
        max_width_m=0.045,
        pregrasp_distance_m=0.1,
        obstacles={"boxes": [{"size_m": [0.5, 0.5, 0.01], "position": [0, 0, -0.065]}]},
        object_pose=[0, 0, 0, 0, 0, 0, 1],
        min_separation_m=0.005,
    )
    assert answer["grasps"]
    p, q = poses_of(answer["grasps"])
    axes = se3.to_matrix(q)
    assert (p[:, 2] >= 0.03 - 1e-6).all()
    assert (axes[:, 2, 2] <= -math.cos(math.radians(20)) + 1e-6).all()
    # Only x, 30 mm, is narrow enough.
    assert (np.abs(axes[:, 0, 1]) > 0.8).all()
    assert (box.widths(ToolPoses(p, q), PG70) <= 0.045).all()
    assert all(grasp["prior"] and grasp["world"] for grasp in answer["grasps"])
    far = best(sqlite_http, box_min=[1, 1, 1], box_max=[2, 2, 2])
    assert (far["status"], far["grasps"]) == ("infeasible", [])
    assert far["nearest"]["prior"] is True
    # Robust under noise, and ranked among candidates.
    robust = best(sqlite_http, objective="robust", tool_noise_m=0.005, tool_noise_deg=5)
    assert robust["status"] == "ok"
    assert np.isfinite(box.widths(ToolPoses(*poses_of(robust["grasps"])), PG70)).all()
    first = best(sqlite_http, count=5, candidates={"position": p.tolist(), "quaternion_xyzw": q.tolist()})
    assert {grasp["candidate"] for grasp in first["grasps"]} == set(range(len(p)))


def test_failures_alone_tell_how_unlikely_it_is(sqlite_http: httpx.Client, box: Scene, post: Post) -> None:
    before = best(sqlite_http)["grasps"]
    p, q = poses_of(before)
    post(
        sqlite_http, "thing", (np.repeat(p, 20, axis=0), np.repeat(q, 20, axis=0)), "slipped", gripper="pg70"
    )
    (same,) = best(sqlite_http)["grasps"]
    assert same["prior"] is True
    assert same["effective_trials"] > 10
    assert same["success_probability"] < 0.15
    told = sqlite_http.post(
        "/objects/thing/likelihood",
        json={"poses": [{name: same[name] for name in ("position", "quaternion_xyzw")}], "gripper": "pg70"},
    ).json()
    assert same["success_probability"] == pytest.approx(told["success_probability"][0])
    # Ranked by it, the failed place is left.
    (other,) = best(sqlite_http, objective="success_probability")["grasps"]
    assert other["prior"] is True
    assert other["effective_trials"] < 1
    assert np.isfinite(box.widths(ToolPoses(*poses_of([other])), PG70)).all()


def test_when_it_does_not_answer(sqlite_http: httpx.Client, make_object: Make, box: Scene) -> None:
    del box
    http = sqlite_http
    assert best(http, prior=False)["status"] == "no_successes"
    assert best(http, gripper=None)["status"] == "no_successes"
    assert best(http, objective="success_probability")["status"] == "no_successes"
    refused = http.post("/objects/thing/best-grasp", json={"prior": True})
    assert kind(refused) == (409, "gripper-unknown")
    make_object(http, "shapeless")
    answer = http.get("/objects/shapeless/best-grasp", params={"gripper": "pg70"})
    assert answer.json()["status"] == "no_successes"
    answer = http.get("/objects/shapeless/best-grasp", params={"gripper": "pg70", "prior": "true"})
    assert kind(answer) == (409, "mesh-missing")
