"""What a jaw closes on: closed forms, and the symmetries of a jaw and of space."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graspdb_geometry.closing import FEATURES, ClosingGeometry
from graspdb_geometry.collision import box_part
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70

Floats = NDArray[np.float64]


def box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Floats:
    vertices, faces = box_part(np.array(size) / 2, centre, (0, 0, 0, 1))
    return np.asarray(vertices)[np.asarray(faces)]


def bent() -> Floats:
    """Triangles that no motion maps onto themselves."""
    return np.concatenate([box((0.03, 0.02, 0.05)), box((0.05, 0.01, 0.012), (0.02, 0.004, 0.02))])


def poses(count: int, seed: int) -> ToolPoses:
    rng = np.random.default_rng(seed)
    return ToolPoses(
        rng.uniform(-0.04, 0.04, (count, 3)), Rotation.random(count, random_state=seed).as_quat()
    )


def column(features: Floats, name: str) -> Floats:
    return features[:, FEATURES.index(name)]


def test_a_box_gripped_off_its_middle() -> None:
    # From above: tool z along -z, tool y along y; the tool 3 mm off along x, 2 mm along y, 1 mm below.
    turned = Rotation.from_euler("x", 180, degrees=True).as_quat()
    found = ClosingGeometry(box((0.03, 0.02, 0.05)), np.zeros(3)).features(
        ToolPoses(np.array([[0.003, 0.002, -0.001]]), turned[None]), PG70
    )
    assert column(found, "width") == pytest.approx(0.02)
    assert column(found, "off_centre") == pytest.approx(0.002)
    for finger in ("first", "second"):
        assert column(found, f"{finger}_ny_deep") == pytest.approx(1.0)
        assert column(found, f"{finger}_behind") == pytest.approx(0.0, abs=1e-12)
        assert column(found, f"{finger}_aligned") == pytest.approx(1.0)
    assert column(found, "first_travel") + column(found, "second_travel") == pytest.approx(
        PG70.max_opening_m - 0.02
    )
    # The centre of mass is 3 mm beside the tool, whichever way x is counted, and 1 mm behind it.
    assert column(found, "mass_x") == pytest.approx(0.003)
    assert column(found, "mass_z") == pytest.approx(-0.001)


def test_slanted_sides_are_seen_by_their_normals() -> None:
    """A wedge of 20 degrees between its sides: normals lean by 10 from the closing direction."""
    lean = np.tan(np.radians(10.0)) * 0.1
    # Along x, thicker by twice `lean` at the top than at the bottom.
    low = np.array([[x, y, -0.05] for x, y in ((-0.03, -0.01), (0.03, -0.01), (0.03, 0.01), (-0.03, 0.01))])
    high = low + np.array([0.0, 0.0, 0.1]) + np.sign(low) * np.array([0.0, lean, 0.0])
    v = np.concatenate([low, high])
    sides = [(0, 1, 5), (0, 5, 4), (2, 3, 7), (2, 7, 6)]
    found = ClosingGeometry(v[np.array(sides)], np.zeros(3)).features(
        ToolPoses(np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]])), PG70
    )
    for finger in ("first", "second"):
        assert column(found, f"{finger}_ny_deep") == pytest.approx(np.cos(np.radians(10.0)))
    assert column(found, "least_aligned") == pytest.approx(np.cos(np.radians(10.0)))


def test_nothing_between_the_fingers_is_not_known_but_for_the_mass() -> None:
    far = ToolPoses(np.array([[0.5, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]]))
    found = ClosingGeometry(box((0.03, 0.02, 0.05)), np.zeros(3)).features(far, PG70)
    known = {name for name, value in zip(FEATURES, found[0], strict=True) if not np.isnan(value)}
    assert known == {"mass_x", "mass_z"}


@given(st.integers(0, 2**31 - 1))
def test_twins_and_moved_objects_have_the_same_features(seed: int) -> None:
    asked, centre = poses(20, seed), np.array([0.004, 0.001, 0.009])
    here = ClosingGeometry(bent(), centre).features(asked, PG70)
    twins = (Rotation.from_quat(asked.quaternions_xyzw) * Rotation.from_euler("z", np.pi)).as_quat()
    twin = ClosingGeometry(bent(), centre).features(ToolPoses(asked.positions, twins), PG70)
    _alike(here, twin)
    turn, shift = Rotation.random(random_state=seed), np.random.default_rng(seed).normal(size=3)
    moved = ToolPoses(
        turn.apply(asked.positions) + shift, (turn * Rotation.from_quat(asked.quaternions_xyzw)).as_quat()
    )
    corners = turn.apply(bent().reshape(-1, 3)).reshape(-1, 3, 3) + shift
    _alike(here, ClosingGeometry(corners, turn.apply(centre) + shift).features(moved, PG70))


@given(st.integers(0, 2**31 - 1))
def test_a_mirrored_grasp_of_the_mirrored_object_has_the_same_features(seed: int) -> None:
    asked, centre = poses(20, seed), np.array([0.004, 0.001, 0.009])
    here = ClosingGeometry(bent(), centre).features(asked, PG70)
    mirror = np.diag([1.0, -1.0, 1.0])
    # The reflected tool is a proper one again once its own x is reflected, which the jaw does not tell.
    turned = mirror @ Rotation.from_quat(asked.quaternions_xyzw).as_matrix() @ np.diag([-1.0, 1.0, 1.0])
    mirrored = ToolPoses(np.asarray(asked.positions) @ mirror, Rotation.from_matrix(turned).as_quat())
    corners = (bent() @ mirror)[:, ::-1]
    _alike(here, ClosingGeometry(corners, centre @ mirror).features(mirrored, PG70))


def _alike(one: Floats, other: Floats) -> None:
    """Equal in nearly all rows: where a line meets an edge, or lines tie, rounding decides."""
    same = np.isclose(one, other, atol=1e-6, equal_nan=True).all(axis=1)
    assert same.mean() >= 0.9


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="triangle"):
        ClosingGeometry(np.empty((0, 3, 3)), np.zeros(3))
