"""Attempts shared by an object's symmetry: what answers then, what stays, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
WIDTHS = {"sigma_position_m": 0.01, "sigma_rotation_deg": 15.0}


def grasps(count: int, seed: int, sides: tuple[float, float]) -> tuple[Poses, Floats]:
    """From the side towards the z axis, at azimuths between two, and how far each misses the axis by."""
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(*sides, count)
    miss = rng.uniform(-0.025, 0.025, count)
    out = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(count)], axis=1)
    along = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(count)], axis=1)
    position = out * rng.normal(0.0, 0.004, (count, 1)) + along * miss[:, None]
    position[:, 2] = rng.normal(0.02, 0.006, count)
    # z points inwards, y across, x up or down.
    axes = np.stack([np.cross(along, -out), along, -out], axis=2)
    turned = Rotation.from_matrix(axes) * Rotation.from_rotvec(rng.normal(0.0, 0.1, (count, 3)))
    return (position, turned.as_quat()), miss


def outcomes(miss: Floats, seed: int) -> list[str]:
    chance = np.where(np.abs(miss) < 0.012, 0.95, 0.05)
    return ["success" if won else "missed" for won in np.random.default_rng(seed).random(len(miss)) < chance]


def put_mesh(http: httpx.Client, slug: str, mesh: trimesh.Trimesh) -> None:
    http.put(
        f"/objects/{slug}/mesh", content=mesh.export(file_type="stl"), headers={"Content-Type": "model/stl"}
    ).raise_for_status()


def cone() -> trimesh.Trimesh:
    return trimesh.creation.cone(radius=0.02, height=0.1, sections=48)


@pytest.fixture
def tried(http: httpx.Client, post: Post, make_object: Callable[..., str]) -> httpx.Client:
    """A cone that was tried from +x alone."""
    put_mesh(http, make_object(http), cone())
    poses, miss = grasps(300, 1, (-0.5, 0.5))
    post(http, "thing", poses, outcomes(miss, 2))
    return http


def ask(http: httpx.Client, poses: Poses, **more: Any) -> httpx.Response:
    columns = {"position": poses[0].tolist(), "quaternion_xyzw": poses[1].tolist()}
    return http.post("/objects/thing/likelihood", json={"poses": columns, **WIDTHS, **more})


def told(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_a_cone_tried_from_one_side_answers_on_the_other(tried: httpx.Client) -> None:
    away, miss = grasps(40, 3, (2.5, 3.5))
    without, shared = told(ask(tried, away)), told(ask(tried, away, symmetry="auto"))
    assert "symmetry" not in without
    assert set(without["success_probability"]) == {None}
    known = np.array(shared["support"]["enough"])
    assert known.mean() > 0.8
    p = np.array(shared["success_probability"], dtype=float)
    assert p[known & (np.abs(miss) < 0.006)].min() > 0.6
    assert p[known & (np.abs(miss) > 0.02)].max() < 0.5
    # Nothing else is told otherwise.
    for name in ("density", "log_density", "relative"):
        assert shared[name] == without[name]
    symmetry = shared["symmetry"]
    assert symmetry["applied"]
    assert [axis["turns"] for axis in symmetry["axes"]] == [None]
    assert abs(symmetry["axes"][0]["direction"][2]) == pytest.approx(1.0, abs=1e-6)
    assert "every turn about the axis" in symmetry["reason"]


def test_sharing_is_off_unless_it_is_asked_for(tried: httpx.Client) -> None:
    here, _ = grasps(20, 4, (-0.4, 0.4))
    plain = told(ask(tried, here))
    for same in (told(ask(tried, here, symmetry="off")), told(ask(tried, here))):
        assert same["success_probability"] == plain["success_probability"]
        assert same["effective_trials"] == plain["effective_trials"]
    density = tried.get("/objects/thing/density").json()
    ask(tried, here, symmetry="auto").raise_for_status()
    assert tried.get("/objects/thing/density").json() == density
    assert tried.get("/objects/thing/density", params={"symmetry": "auto"}).status_code == 422
    assert ask(tried, here, symmetry="mirror").status_code == 422


def test_the_best_grasp_may_be_where_a_symmetry_takes_one(tried: httpx.Client) -> None:
    asked = {
        **WIDTHS, "objective": "success_probability", "approach": [1.0, 0.0, 0.0], "approach_cone_deg": 20.0,
    }  # fmt: skip
    nothing = told(tried.post("/objects/thing/best-grasp", json=asked))
    assert nothing["status"] == "infeasible"
    best = told(tried.post("/objects/thing/best-grasp", json={**asked, "symmetry": "auto"}))
    assert best["status"] == "ok"
    (grasp,) = best["grasps"]
    assert grasp["success_probability"] > 0.7
    assert grasp["support"]["enough"]
    assert best["symmetry"]["applied"]
    # From the other side no success lies near, and the density says so.
    assert grasp["relative"] < 1e-3
    ranked = {**asked, "candidates": {k: [grasp[k]] for k in ("position", "quaternion_xyzw")}}
    again = told(tried.post("/objects/thing/best-grasp", json={**ranked, "symmetry": "auto"}))
    assert again["grasps"][0]["success_probability"] == pytest.approx(grasp["success_probability"])


def test_draws_tell_how_near_shared_attempts_are(tried: httpx.Client) -> None:
    for path, more in (("samples", {}), ("proposals", {"strategy": "uncertainty"})):
        asked = {"count": 20, "seed": 1, **WIDTHS, **more}
        plain = told(tried.post(f"/objects/thing/{path}", json=asked))
        shared = told(tried.post(f"/objects/thing/{path}", json={**asked, "symmetry": "auto"}))
        assert shared["symmetry"]["applied"]
        if path == "samples":
            assert shared["position"] == plain["position"]
            trials = [np.array(each["support"]["effective_trials"]) for each in (plain, shared)]
            assert (trials[1] >= trials[0] * 0.99).all()


def test_outcomes_that_differ_by_side_refuse_it(
    http: httpx.Client, post: Post, make_object: Callable[..., str]
) -> None:
    put_mesh(http, make_object(http), cone())
    poses, miss = grasps(1_500, 5, (-np.pi, np.pi))
    azimuth = np.arctan2(
        -Rotation.from_quat(poses[1]).as_matrix()[:, 1, 2], -Rotation.from_quat(poses[1]).as_matrix()[:, 0, 2]
    )
    won = np.array(outcomes(miss, 6), dtype=object)
    # Something that the mesh lacks is in the way from +y.
    won[np.abs(azimuth - 1.5) < 0.6] = "collision"
    post(http, "thing", poses, won.tolist())
    answer = ask(http, (poses[0][:5], poses[1][:5]), symmetry="auto")
    assert answer.status_code == 409
    problem = answer.json()
    assert problem["type"].endswith("symmetry-contradicted")
    assert "attempts" in problem["title"]
    assert "speak against it" in problem["title"]
    assert told(ask(http, (poses[0][:5], poses[1][:5])))["success_probability"][0] is not None


def test_what_has_no_mesh_or_no_symmetry_says_so(
    sqlite_http: httpx.Client, post: Post, make_object: Callable[..., str]
) -> None:
    http = sqlite_http
    make_object(http)
    poses, miss = grasps(60, 7, (-0.5, 0.5))
    post(http, "thing", poses, outcomes(miss, 8))
    some = (poses[0][:5], poses[1][:5])
    refused = ask(http, some, symmetry="auto")
    assert refused.status_code == 409
    assert refused.json()["type"].endswith("mesh-missing")
    make_object(http, "lump")
    parts = [
        trimesh.creation.box(size) for size in ((0.04, 0.06, 0.1), (0.02, 0.01, 0.03), (0.01, 0.02, 0.02))
    ]
    parts[1].apply_translation((0.015, 0.033, 0.02))
    parts[2].apply_translation((-0.02, 0.02, -0.04))
    put_mesh(http, "lump", trimesh.util.concatenate(parts))
    post(http, "lump", poses, outcomes(miss, 8))
    columns = {"position": some[0].tolist(), "quaternion_xyzw": some[1].tolist()}
    asked = {"poses": columns, **WIDTHS}
    plain = told(http.post("/objects/lump/likelihood", json=asked))
    found = told(http.post("/objects/lump/likelihood", json={**asked, "symmetry": "auto"}))
    assert not found["symmetry"]["applied"]
    assert "no symmetry" in found["symmetry"]["reason"]
    assert found["success_probability"] == plain["success_probability"]


def test_mirrors_take_a_jaw_that_is_its_own_mirror_image(
    sqlite_http: httpx.Client, post: Post, make_object: Callable[..., str]
) -> None:
    http = sqlite_http
    make_object(http)
    bracket = [trimesh.creation.box(size) for size in ((0.06, 0.02, 0.03), (0.02, 0.09, 0.03))]
    bracket[1].apply_translation((-0.02, 0.035, 0.0))
    put_mesh(http, "thing", trimesh.util.concatenate(bracket))
    panda = http.get("/grippers/panda").json()["profile"]
    one_sided = {k: panda[k] for k in ("max_opening_m", "finger", "tip_offset_m", "palm_size_m")}
    http.post("/grippers", json={"id": "hook", "symmetric": False, **one_sided}).raise_for_status()
    poses, miss = grasps(100, 9, (-0.5, 0.5))
    post(http, "thing", poses, outcomes(miss, 10), gripper="hook")
    some = (poses[0][:5], poses[1][:5])
    found = told(ask(http, some, symmetry="auto"))["symmetry"]
    assert len(found["planes"]) == 1
    assert not found["applied"]
    assert "jaw" in found["reason"]
    post(http, "thing", poses, outcomes(miss, 10), gripper="panda")
    assert told(ask(http, some, symmetry="auto", gripper="panda"))["symmetry"]["applied"]
