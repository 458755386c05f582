"""Grasps that held where geometry says that the gripper overlaps the object: attempts decide."""

from __future__ import annotations

from typing import Any

import httpx
import numpy as np
import pytest
import trimesh


@pytest.fixture
def block(sqlite_http: httpx.Client) -> str:
    """A block of 5 cm, which the Panda holds from above, and its mesh, which came out too long by far."""
    sqlite_http.post("/objects", json={"id": "block", "mass_kg": 0.2}).raise_for_status()
    mesh = trimesh.creation.box([0.05, 0.05, 0.09]).export(file_type="stl")
    sqlite_http.put(
        "/objects/block/mesh", content=mesh, headers={"Content-Type": "model/stl"}
    ).raise_for_status()
    return "/objects/block"


def _trials(heights: np.ndarray, outcomes: list[str], source: str) -> dict[str, Any]:
    """Grasps straight down, closing along y, the fingertips' middle at these heights."""
    position = np.zeros((len(heights), 3))
    position[:, 2] = heights
    turned = np.tile([1.0, 0.0, 0.0, 0.0], (len(heights), 1))
    columns = {"position": position.tolist(), "quaternion_xyzw": turned.tolist(), "outcome": outcomes}
    return {"columns": columns, "gripper": "panda", "source": source}


def _ask(http: httpx.Client, block: str, height: float) -> dict[str, Any]:
    poses = [{"position": [0.0, 0.0, height], "quaternion_xyzw": [1.0, 0.0, 0.0, 0.0]}]
    answer = http.post(f"{block}/likelihood", json={"poses": poses})
    answer.raise_for_status()
    found: dict[str, Any] = answer.json()
    return found


#: The palm would be within the mesh here; the block itself ends 2 cm below it.
DEEP = -0.005


def test_what_held_is_not_impossible(sqlite_http: httpx.Client, block: str) -> None:
    rng = np.random.default_rng(0)
    deep, above = rng.normal(DEEP, 0.002, 60), rng.normal(0.06, 0.002, 30)
    heights = np.concatenate([deep, above])
    outcomes = ["success"] * 54 + ["slipped"] * 6 + ["missed"] * 30
    sqlite_http.post(f"{block}/trials", json=_trials(heights, outcomes, "robot")).raise_for_status()
    found = _ask(sqlite_http, block, DEEP)
    assert found["collision_free"] == [False]
    assert found["success_probability"][0] > 0.7
    assert any("in 54 of 54 grasps that held" in text for text in found["warnings"])
    density = sqlite_http.get(f"{block}/density").json()
    assert any("decide no success probability" in text for text in density["warnings"])
    best = sqlite_http.get(f"{block}/best-grasp", params={"collision_free": "false"}).json()
    assert best["grasps"][0]["success_probability"] > 0.7
    assert best["warnings"] == found["warnings"]


def test_simulated_trials_and_strays_say_nothing_against_geometry(
    sqlite_http: httpx.Client, block: str
) -> None:
    rng = np.random.default_rng(0)
    heights = np.concatenate([rng.normal(0.04, 0.001, 60), [DEEP]])
    sqlite_http.post(
        f"{block}/trials", json=_trials(heights, ["success"] * 50 + ["slipped"] * 10 + ["success"], "robot")
    ).raise_for_status()
    deep = rng.normal(DEEP, 0.002, 60)
    sqlite_http.post(
        f"{block}/trials", json=_trials(deep, ["success"] * 50 + ["slipped"] * 10, "simulation")
    ).raise_for_status()
    found = _ask(sqlite_http, block, DEEP)
    assert found["collision_free"] == [False]
    assert found["success_probability"] == [0.0]
    assert not any("grasps that held" in text for text in found["warnings"])


def test_the_best_by_success_probability_closes_on_something(sqlite_http: httpx.Client, block: str) -> None:
    """Beyond the end of the block the grasps that held are near, and nothing is between the fingers."""
    rng = np.random.default_rng(0)
    trials = _trials(rng.normal(0.03, 0.002, 80), ["success"] * 80, "robot")
    trials["columns"]["position"] = np.column_stack(
        [rng.uniform(0.0, 0.03, 80), np.zeros(80), rng.normal(0.03, 0.002, 80)]
    ).tolist()
    trials["columns"]["outcome"] = ["success"] * 79 + ["slipped"]
    sqlite_http.post(f"{block}/trials", json=trials).raise_for_status()
    beyond = {"objective": "success_probability", "half_spaces": [[1.0, 0.0, 0.0, 0.052]]}
    answer = sqlite_http.post(f"{block}/best-grasp", json=beyond).json()
    assert answer["status"] == "infeasible"
    as_asked = sqlite_http.post(f"{block}/best-grasp", json={**beyond, "collision_free": False}).json()
    assert as_asked["status"] == "ok"


def test_the_mesh_may_lack_what_real_grasps_held(sqlite_http: httpx.Client, block: str) -> None:
    rng = np.random.default_rng(0)
    outcomes = ["success"] * 54 + ["slipped"] * 6
    above = _trials(rng.normal(0.08, 0.002, 60), outcomes, "robot")
    sqlite_http.post(f"{block}/trials", json=above).raise_for_status()
    found = _ask(sqlite_http, block, 0.08)
    assert found["collision_free"] == [True]
    assert found["success_probability"][0] > 0.7
    asked = {"objective": "success_probability", "half_spaces": [[0.0, 0.0, 1.0, 0.07]]}
    assert sqlite_http.post(f"{block}/best-grasp", json=asked).json()["status"] == "ok"
