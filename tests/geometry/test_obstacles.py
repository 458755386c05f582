"""Obstacles: boxes, point clouds, and the straight approach."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from graspdb_geometry import collision
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70

HERE = [[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]]


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), radius=st.sampled_from([0.0, 0.004, 0.02]))
def test_points_against_distances_to_the_boxes(seed: int, radius: float, random_poses: Any) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.2, 0.2, size=(40, 3))
    positions, quaternions = random_poses(rng, 60, 0.2)
    hits = collision.PointCloud(points, radius).collides(ToolPoses(positions, quaternions), PG70)
    half_extents, centres = PG70.boxes()
    seen = (points[None] - positions[:, None]) @ np.eye(3)
    seen = np.stack([Rotation.from_quat(q).inv().apply(x) for q, x in zip(quaternions, seen, strict=True)])
    outside = np.maximum(np.abs(seen[:, :, None] - centres) - half_extents, 0)
    distance = np.linalg.norm(outside, axis=-1).min(axis=(1, 2))
    clear = np.abs(distance - radius) > 1e-6
    if radius == 0:  # inside the boxes the distance is 0: tell by depth instead
        depth = (half_extents - np.abs(seen[:, :, None] - centres)).min(axis=-1).max(axis=(1, 2))
        clear = np.abs(depth) > 1e-6
    assert np.array_equal(hits[clear], (distance <= radius)[clear])


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_the_approach_collides_where_a_stop_on_it_does(
    seed: int, oracle: Any, random_hull: Any, random_poses: Any
) -> None:
    rng = np.random.default_rng(seed)
    points = random_hull(rng)
    scene = collision.Scene([(points, [])])
    positions, quaternions = random_poses(rng, 40, 0.15)
    approach = Rotation.from_quat(quaternions).apply([0, 0, 1])
    swept = scene.collides(ToolPoses(positions, quaternions), PG70, retreat_m=0.1)
    stops = np.zeros(len(positions), dtype=bool)
    for back in np.linspace(0, 0.1, 101):
        stops |= scene.collides(ToolPoses(positions - back * approach, quaternions), PG70)
    assert np.all(swept[stops])
    # What only the sweep hits lies between two stops: linear programming must find it in the swept boxes.
    reference = oracle([points])
    half_extents, centres = PG70.boxes()
    half_sweep = np.array([0, 0, 0.05])
    for i in np.flatnonzero(swept != stops):
        depth = max(
            reference.depth(
                reference.spaces[0],
                oracle.box(
                    c - half_sweep,
                    h + half_sweep,
                    positions[i],
                    Rotation.from_quat(quaternions[i]).as_matrix(),
                ),
            )
            for c, h in zip(centres, half_extents, strict=True)
        )
        assert depth > -1e-6


def test_approach_by_hand() -> None:
    # Beyond a bar across the way that ends at z = 5 mm; the palm's rear is at 200 - 139 = 61 mm.
    beyond = [[0.0, 0.0, 0.2]], HERE[1]
    wall = collision.Scene([collision.box_part([0.005, 0.2, 0.005], [0, 0, 0.0], [0, 0, 0, 1])])
    assert not wall.collides(ToolPoses(*beyond), PG70).any()
    assert not wall.collides(ToolPoses(*beyond), PG70, retreat_m=0.05).any()
    assert wall.collides(ToolPoses(*beyond), PG70, retreat_m=0.07).any()
    with pytest.raises(ValueError, match="retreat_m"):
        wall.collides(ToolPoses(*HERE), PG70, retreat_m=-0.1)


def test_surface_and_parts_agree_on_the_approach(random_poses: Any) -> None:
    vertices, faces = collision.box_part([0.02, 0.03, 0.04], [0.01, 0, 0], [0, 0, np.sin(0.3), np.cos(0.3)])
    positions, quaternions = random_poses(np.random.default_rng(4), 5000, 0.2)
    surface = collision.Surface(vertices, faces, watertight=True)
    scene = collision.Scene([(vertices, faces)])
    for retreat in (0.0, 0.08):
        hits = surface.collides(ToolPoses(positions, quaternions), PG70, retreat_m=retreat)
        assert np.array_equal(
            hits, scene.collides(ToolPoses(positions, quaternions), PG70, retreat_m=retreat)
        )
        assert 0 < hits.sum() < len(hits)


@pytest.mark.parametrize(
    ("points", "radius", "message"),
    [([[0, 0]], 0.0, "points"), ([[0, 0, np.nan]], 0.0, "finite"), ([[0, 0, 0]], -1.0, "radius_m")],
)
def test_bad_clouds_are_refused(points: Any, radius: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        collision.PointCloud(points, radius)


def test_an_empty_cloud_is_no_obstacle() -> None:
    assert not collision.PointCloud(np.zeros((0, 3))).collides(ToolPoses(*HERE), PG70).any()


def test_flat_boxes_are_refused() -> None:
    with pytest.raises(ValueError, match="half_extents"):
        collision.box_part([0.1, 0.0, 0.1], [0, 0, 0], [0, 0, 0, 1])
