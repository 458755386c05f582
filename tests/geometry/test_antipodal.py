"""Opposed points: on solids where the opposite of a point is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from graspdb.examples import EXAMPLES, example
from graspdb_geometry.collision import Scene, Surface
from graspdb_geometry.features.antipodal import opposed_points
from graspdb_geometry.features.jaw_pairs import JawPairs
from graspdb_geometry.features.ridges import parts_solid
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70


def of(mesh: trimesh.Trimesh, opening: float = 0.07) -> JawPairs:
    surface = Surface(mesh.vertices, mesh.faces, watertight=True)
    return opposed_points(mesh.vertices[mesh.faces], surface.contains, opening_m=opening)


def test_across_a_ball_through_its_middle() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.03)
    ball.apply_translation([0.1, 0.2, 0.3])
    found = of(ball)
    # Every point has its opposite.
    assert len(found) > 1_990
    np.testing.assert_allclose(found.gaps_m, 0.06, rtol=0.06)
    assert np.linalg.norm(found.centres - [0.1, 0.2, 0.3], axis=1).max() < 0.01
    # All directions alike.
    spread = np.einsum("pi,pj->ij", found.axes[:, :, 1], found.axes[:, :, 1]) / len(found)
    np.testing.assert_allclose(spread, np.eye(3) / 3, atol=0.02)
    assert len(of(ball, opening=0.05)) == 0


def test_a_box_only_where_it_fits() -> None:
    turn = Rotation.from_rotvec([0.3, -0.8, 0.4])
    box = trimesh.creation.box([0.03, 0.05, 0.12])
    box.vertices = turn.apply(box.vertices)
    found = of(box)
    closing = np.abs(turn.inv().apply(found.axes[:, :, 1]))
    along = np.argmax(closing, axis=1)
    np.testing.assert_allclose(closing[np.arange(len(along)), along], 1.0)
    assert set(along.tolist()) == {0, 1}
    np.testing.assert_allclose(found.gaps_m, np.where(along == 0, 0.03, 0.05))
    # As many as the area of the faces, 50 x 120 and 30 x 120 mm, but for the points at their ends.
    assert (along == 0).sum() / (along == 1).sum() == pytest.approx(50 / 30, rel=0.1)


@pytest.mark.parametrize("name", EXAMPLES)
def test_grasps_on_them_hold_something(name: str) -> None:
    parts = [(np.asarray(v), np.asarray(f)) for v, f in example(name).parts]
    found = opposed_points(
        np.concatenate([v[f] for v, f in parts]), parts_solid([v for v, _ in parts]), opening_m=0.07
    )
    assert len(found) > 200
    positions, quaternions, _ = found.grasps(4_000)
    held = Scene(parts).holds(ToolPoses(positions, quaternions), PG70)
    # The elongated D is a plate, into whose middle no finger reaches.
    assert held.mean() > 0.03
    again = opposed_points(
        np.concatenate([v[f] for v, f in parts]), parts_solid([v for v, _ in parts]), opening_m=0.07
    )
    assert np.array_equal(again.centres, found.centres)


def test_nothing_is_no_pair() -> None:
    flat = np.array([[[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]])
    assert len(opposed_points(flat, None, opening_m=0.07)) == 0
    assert len(opposed_points(np.zeros((2, 3, 3)), None, opening_m=0.07)) == 0
    with pytest.raises(ValueError, match="opening_m"):
        opposed_points(flat, None, opening_m=math.nan)
