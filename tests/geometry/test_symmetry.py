"""Symmetries of surfaces: what is found of shapes whose symmetries are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graspdb.examples import example
from graspdb_geometry import meshes
from graspdb_geometry.symmetry import Symmetry, find_symmetry

Floats = NDArray[np.float64]
make = trimesh.creation


def corners(*solids: trimesh.Trimesh) -> Floats:
    return np.concatenate([np.array(solid.triangles) for solid in solids])


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    found = make.box(size)
    found.apply_translation(at)
    return found


def shape(name: str) -> Floats:
    mesh = meshes.load(example(name).stl(), "model/stl")
    return np.asarray(mesh.vertices[mesh.faces])


BRACKET = corners(box((0.06, 0.02, 0.03)), box((0.02, 0.09, 0.03), (-0.02, 0.035, 0)))
CHIRAL = corners(
    box((0.04, 0.06, 0.1)),
    box((0.02, 0.01, 0.03), (0.015, 0.033, 0.02)),
    box((0.01, 0.02, 0.02), (-0.02, 0.02, -0.04)),
)
#: (turns of axes, 0 for revolution, most first; how many planes; how many motions keep the shape).
SHAPES: dict[str, tuple[Floats, list[int], int, int]] = {
    "cone": (corners(make.cone(radius=0.03, height=0.1, sections=64)), [0], 0, 2),
    "cylinder": (corners(make.cylinder(radius=0.03, height=0.1, sections=64)), [0], 1, 4),
    "cylinder of equal moments": (corners(make.cylinder(radius=0.03, height=0.0505, sections=64)), [0], 1, 4),
    "box": (corners(make.box((0.04, 0.06, 0.1))), [2, 2, 2], 3, 8),
    "square box": (corners(make.box((0.04, 0.04, 0.1))), [4, 2, 2, 2, 2], 5, 16),
    "hexagonal bar": (corners(make.cylinder(radius=0.03, height=0.1, sections=6)), [6] + 6 * [2], 7, 24),
    "bracket": (BRACKET, [], 1, 2),
    "chiral": (CHIRAL, [], 0, 1),
    "mug": (shape("mug"), [], 1, 2),
    "elongated-d": (shape("elongated-d"), [2], 2, 4),
    "screwdriver": (shape("screwdriver"), [2], 2, 4),
}


def orders(found: Symmetry) -> list[int]:
    return [axis.order or 0 for axis in found.axes]


@pytest.mark.parametrize("name", SHAPES)
def test_known_shapes_have_their_symmetries(name: str) -> None:
    triangles, turns, planes, motions = SHAPES[name]
    found = find_symmetry(triangles)
    assert (orders(found), len(found.planes)) == (turns, planes)
    assert len(found.elements(mirrors=True)) == motions
    assert bool(found) == (motions > 1)


def test_a_cube_has_48_motions_and_a_ball_every_axis() -> None:
    cube = find_symmetry(corners(make.box((0.05, 0.05, 0.05))))
    assert len(cube.elements(mirrors=True)) == 48
    assert len(cube.elements(mirrors=False)) == 24
    assert find_symmetry(corners(make.icosphere(4, 0.04))).ball


def test_an_axis_and_planes_lie_where_the_shape_has_them() -> None:
    moved = make.cone(radius=0.03, height=0.1, sections=64)
    moved.apply_translation((0.1, -0.2, 0.3))
    axis = find_symmetry(corners(moved)).axis
    assert axis is not None
    assert abs(axis.direction[2]) == pytest.approx(1.0, abs=1e-6)
    found = find_symmetry(corners(moved))
    assert found.centre[:2] == pytest.approx([0.1, -0.2], abs=1e-6)
    mug = find_symmetry(shape("mug"))
    assert abs(mug.planes[0].normal[1]) == pytest.approx(1.0, abs=1e-6)


def test_a_scan_is_symmetric_within_its_noise() -> None:
    scan = make.cylinder(radius=0.03, height=0.1, sections=64).subdivide().subdivide().subdivide()
    scan.vertices = scan.vertices + np.random.default_rng(1).normal(0.0, 1e-4, scan.vertices.shape)
    found = find_symmetry(corners(scan))
    assert orders(found) == [0]
    assert 1e-4 < found.axes[0].deviation_m < found.tolerance_m


def test_a_notch_or_a_handle_takes_a_symmetry_away() -> None:
    can = make.cylinder(radius=0.03, height=0.1, sections=64)
    found = find_symmetry(corners(can, box((0.02, 0.01, 0.04), (0.035, 0, 0))))
    assert found.axis is None
    # The handle's own planes are left.
    assert len(found.planes) == 2


def test_a_mesh_of_many_triangles_is_judged_alike() -> None:
    egg = make.icosphere(6, 0.04)
    egg.apply_scale((1.0, 1.0, 1.3))
    assert orders(find_symmetry(corners(egg))) == [0]


def test_an_open_surface_has_its_symmetry() -> None:
    can = make.cylinder(radius=0.03, height=0.1, sections=64)
    open_top = corners(can)[np.asarray(can.triangles_center)[:, 2] < 0.049]
    assert orders(find_symmetry(open_top)) == [0]
    assert len(find_symmetry(open_top).planes) == 0


def test_surfaces_without_area_are_refused() -> None:
    with pytest.raises(ValueError, match="triangles have shape"):
        find_symmetry(np.empty((0, 3, 3)))
    with pytest.raises(ValueError, match="area"):
        find_symmetry(np.zeros((4, 3, 3)))


@settings(max_examples=12, deadline=None)
@given(
    name=st.sampled_from(["cone", "box", "square box", "bracket", "mug", "screwdriver"]),
    seed=st.integers(0, 2**31),
    shift=st.tuples(*3 * [st.floats(-0.5, 0.5)]),
)
def test_symmetries_move_with_the_object(name: str, seed: int, shift: tuple[float, float, float]) -> None:
    triangles = SHAPES[name][0]
    turn, moved_by = Rotation.random(random_state=seed).as_matrix(), np.array(shift)
    here, there = find_symmetry(triangles), find_symmetry(triangles @ turn.T + moved_by)
    assert there.centre == pytest.approx(turn @ here.centre + moved_by, abs=1e-9)
    assert there.tolerance_m == pytest.approx(here.tolerance_m)
    assert orders(here) == orders(there)
    for group, other in ((here.axes, there.axes), (here.planes, there.planes)):
        theirs = np.array([getattr(x, "direction", getattr(x, "normal", None)) for x in other]).reshape(-1, 3)
        for item in group:
            mine = turn @ (item.direction if hasattr(item, "direction") else item.normal)
            assert np.abs(theirs @ mine).max() == pytest.approx(1.0, abs=1e-3)
