"""How far apart the fingers are once both touch the object."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from graspdb_geometry.collision import Scene, Surface, box_part
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70

BOX = box_part([0.01, 0.02, 0.05], [0, 0, 0], [0, 0, 0, 1])


def test_a_box_by_hand() -> None:
    down = [1.0, 0.0, 0.0, 0.0]
    turned = [2**-0.5, 2**-0.5, 0.0, 0.0]  # tool y along the object's x
    poses = [[0, 0, 0.04], [0, 0.005, 0.04], [0, 0, 0.04], [0, 0, 0.2], [0, 0.02, 0.04]]
    quaternions = [down, down, turned, down, down]
    expected = [0.04, 0.04, 0.02, np.nan, np.nan]  # beside it: as wide; beyond: nothing; into it: collides
    for solid in (Scene([BOX]), Surface(*BOX, watertight=True)):
        np.testing.assert_allclose(solid.widths(ToolPoses(poses, quaternions), PG70), expected, atol=2e-7)
        np.testing.assert_array_equal(solid.holds(ToolPoses(poses, quaternions), PG70), np.isfinite(expected))


def test_a_ball_of_many_triangles_is_as_wide_as_its_diameter() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.03)
    surface = Surface(ball.vertices, ball.faces, watertight=True)
    rng = np.random.default_rng(4)
    quaternions = rng.normal(size=(200, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    depths = rng.uniform(-0.01, 0.01, 200)
    positions = depths[:, None] * Rotation.from_quat(quaternions).apply([0.0, 0.0, 1.0])
    # Fingers 20 mm wide reach across the ball's middle wherever the tool is along its approach.
    np.testing.assert_allclose(surface.widths(ToolPoses(positions, quaternions), PG70), 0.06, atol=2e-4)


@pytest.mark.parametrize("seed", range(5))
def test_parts_and_surface_agree(seed: int, random_hull: Any, random_poses: Any) -> None:
    from scipy.spatial import ConvexHull

    rng = np.random.default_rng(seed)
    points = random_hull(rng) * 0.5
    hull = ConvexHull(points)
    scene, surface = Scene([(points, [])]), Surface(points, hull.simplices, watertight=True)
    positions, quaternions = random_poses(rng, 3_000, 0.08)
    a, b = (
        scene.widths(ToolPoses(positions, quaternions), PG70),
        surface.widths(ToolPoses(positions, quaternions), PG70),
    )
    both = ~np.isnan(a) & ~np.isnan(b)
    assert both.sum() > 50
    np.testing.assert_allclose(a[both], b[both], atol=1e-6)
    # Poses that differ only touch: a corner within the tolerance.
    assert (np.isnan(a) != np.isnan(b)).sum() <= 3
    for solid, widths in ((scene, a), (surface, b)):
        assert (solid.holds(ToolPoses(positions, quaternions), PG70) != np.isfinite(widths)).sum() <= 3
