"""An infeasible answer names the constraints that exclude each other, and values that would do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

Poses = tuple[NDArray[np.float64], NDArray[np.float64]]

#: A quarter turn about z and half a metre along x.
MOVED = [0.5, 0.0, 0.1, 0.0, 0.0, 0.5**0.5, 0.5**0.5]


@pytest.fixture
def tried(
    sqlite_http: httpx.Client,
    make_object: Callable[..., str],
    post: Callable[..., dict[str, Any]],
    clusters: Callable[..., Poses],
) -> httpx.Client:
    """Grasps from above about (0, 0, 300) mm, along x about (-300, 0, 0) mm; every fifth failed."""
    above, beside = ((0, 0, 0.3), (1, 0, 0, 0)), ((-0.3, 0, 0), (0, 0.5**0.5, 0, 0.5**0.5))
    poses = clusters([above, beside], 200)
    make_object(sqlite_http, "thing")
    outcomes = ["success" if row % 5 else "failure" for row in range(len(poses[0]))]
    post(sqlite_http, "thing", poses, outcomes)
    return sqlite_http


def _ask(http: httpx.Client, **constraints: Any) -> dict[str, Any]:
    answer = http.post("/objects/thing/best-grasp", json=constraints)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


@pytest.mark.parametrize(
    ("constraints", "conflict"),
    [
        ({"approach": [0, 0, 1], "approach_cone_deg": 20}, {"approach_cone_deg"}),
        ({"sphere": [0.6, 0, 0, 0.05]}, {"sphere"}),
        (
            {
                "approach": [0, 0, -1],
                "approach_cone_deg": 20,
                "box_max": [-0.15, 1, 1],
                "box_min": [-1, -1, -1],
            },
            {"approach_cone_deg", "box_max"},
        ),
        (
            {
                "closing": [0, 0, 1],
                "closing_cone_deg": 10,
                "above_plane": [0, 0, 2, 0.06],
                "box_max": [1, 1, 1],
            },
            {"closing_cone_deg"},
        ),
        ({"min_success_probability": 0.999}, {"min_success_probability"}),
        ({"min_effective_trials": 5_000, "objective": "success_probability"}, {"min_effective_trials"}),
        (
            {"approach": [1, 0, 0], "approach_cone_deg": 20, "above_plane": [0, 0, 1, 0.15]},
            {"approach_cone_deg", "above_plane"},
        ),
    ],
)
def test_the_fewest_constraints_and_what_would_do(
    tried: httpx.Client, constraints: dict[str, Any], conflict: set[str]
) -> None:
    answer = _ask(tried, **constraints)
    assert answer["status"] == "infeasible"
    assert set(answer["conflict"]) == conflict
    assert set(answer["relax"]) == conflict
    for name, value in answer["relax"].items():
        assert _ask(tried, **{**constraints, name: value})["status"] == "ok", (name, value)
        given = np.array(constraints[name], dtype=float)
        little = given + 0.9 * (np.array(value) - given)
        assert _ask(tried, **{**constraints, name: little.tolist()})["status"] == "infeasible", (name, value)


def test_in_the_world_s_frame(tried: httpx.Client) -> None:
    """The object's x lies along the world's y; the grasps along it stand 300 mm before it."""
    constraints = {
        "object_pose": MOVED,
        "approach": [0, 1, 0],
        "approach_cone_deg": 20,
        "box_min": [-1, -0.15, -1],
    }
    answer = _ask(tried, **constraints)
    assert set(answer["conflict"]) == {"approach_cone_deg", "box_min"}
    x, y, z = answer["relax"]["box_min"]
    assert (x, z) == (-1, -1)
    assert -0.3 < y < -0.15
    assert _ask(tried, **{**constraints, "box_min": [x, y, z]})["status"] == "ok"


def test_no_conflict_where_there_is_a_grasp(tried: httpx.Client) -> None:
    answer = _ask(tried, approach=[0, 0, -1], approach_cone_deg=20)
    assert answer["status"] == "ok"
    assert answer["conflict"] == []
    assert answer["relax"] == {}
