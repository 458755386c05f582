"""Pairs that a jaw can close on: of solids whose pairs are known, and the one a grasp is at."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from graspdb.examples import EXAMPLES, example
from graspdb_geometry.features.jaw_pairs import KINDS, MARGIN_M, JawPairs, pairs_of_mesh, pairs_of_parts
from graspdb_geometry.features.ridges import ridges_of_mesh, ridges_of_parts
from graspdb_geometry.poses import ToolPoses

FloatArray = npt.NDArray[np.float64]


def of(mesh: trimesh.Trimesh, opening: float = 0.07) -> JawPairs:
    ridges = ridges_of_mesh(mesh.vertices, mesh.faces)
    return pairs_of_mesh(mesh.vertices, mesh.faces, ridges, watertight=True, opening_m=opening)


# As wide as the jaw to the last bit either fits or does not, once it is turned.
SIDES = st.floats(0.01, 0.12).filter(lambda side: abs(side - 0.07) > 1e-6)


@given(st.tuples(SIDES, SIDES, SIDES), st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_a_box_has_its_opposite_faces_and_edges(size: tuple[float, float, float], seed: int) -> None:
    mesh = trimesh.creation.box(extents=size)
    turn = Rotation.random(random_state=seed)
    shift = np.random.default_rng(seed).normal(size=3) * 0.1
    mesh.vertices = turn.apply(mesh.vertices) + shift
    found = of(mesh)
    near = sorted(s for s in size if s <= 0.07)
    surfaces = found.of("surfaces")
    np.testing.assert_allclose(np.sort(surfaces.gaps_m), near, atol=1e-9)
    for pair in range(len(surfaces)):
        axes = turn.inv().apply(surfaces.axes[pair].T)
        # Along the box's own axes, the longer way first.
        np.testing.assert_allclose(np.sort(np.abs(axes), axis=1), [[0, 0, 1]] * 3, atol=1e-6)
        others = sorted(np.array(size) @ (axes[[0, 2]] ** 2).T, reverse=True)
        half = surfaces.half[pair]
        assert half[0] >= half[2]
        np.testing.assert_allclose(2 * half[[0, 2]], others, rtol=0.12)
        assert np.linalg.norm(surfaces.centres[pair] - shift) < 0.06 * max(size)
    # Four edges run each way: two pairs of faces for every width that fits, twice.
    coplanar = found.of("coplanar-edges")
    np.testing.assert_allclose(np.sort(coplanar.gaps_m), np.repeat(near, 4), atol=1e-9)


def test_across_a_rhombus_edges_point_apart() -> None:
    wedge = trimesh.creation.extrude_triangulation(
        np.array([[-0.02, 0], [0, -0.02], [0.02, 0], [0, 0.02]]), np.array([[0, 1, 2], [0, 2, 3]]), 0.1
    )
    found = of(wedge).of("parallel-edges")
    np.testing.assert_allclose(found.gaps_m, 0.04)
    assert len(found) == 2
    np.testing.assert_allclose(np.abs(found.axes[:, 2, 0]), 1.0)
    np.testing.assert_allclose(found.half[:, 0], 0.05)
    assert not len(of(wedge, opening=0.039).of("parallel-edges"))


def test_what_looks_at_each_other_or_is_too_far_is_no_pair() -> None:
    # A U of two legs 30 mm thick, 40 mm apart: the legs' own sides are pairs, the slot's are not.
    outline = np.array([[0, 0], [100, 0], [100, 80], [70, 80], [70, 30], [30, 30], [30, 80], [0, 80]]) / 1000
    triangles = np.array([[0, 1, 5], [1, 4, 5], [1, 3, 4], [1, 2, 3], [0, 5, 7], [5, 6, 7]])
    found = of(trimesh.creation.extrude_triangulation(outline, triangles, 0.09)).of("surfaces")
    across = found.centres[np.abs(found.axes[:, 0, 1]) > 0.9]
    np.testing.assert_allclose(np.sort(across[:, 0]), [0.015, 0.085], atol=1e-6)
    # Through the bridge, but not over the whole height of 80 mm.
    np.testing.assert_allclose(found.gaps_m[np.abs(found.axes[:, 1, 1]) > 0.9], 0.03, atol=1e-6)


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples(name: str) -> None:
    thing = example(name)
    vertices, faces = thing.triangles
    ridges = ridges_of_mesh(vertices, faces)
    found = pairs_of_mesh(vertices, faces, ridges, watertight=True, opening_m=0.07)
    by_parts = pairs_of_parts(thing.parts, ridges_of_parts(thing.parts), opening_m=0.07)
    assert (found.gaps_m <= 0.07).all()
    gaps = np.round(found.of("surfaces").gaps_m, 3)
    assert set(gaps) <= set(np.round(by_parts.of("surfaces").gaps_m, 3)) | {0.053, 0.054, 0.055, 0.056, 0.057}
    expected = {
        "cone": ("surfaces", 16, None),
        "elongated-d": ("surfaces", 15, 0.01),
        "screwdriver": ("surfaces", 1, 0.0012),
        "mug": ("surfaces", 24, 0.004),
    }[name]
    many = found.of(KINDS[0])
    if expected[2] is None:
        assert len(many) == expected[1]
    else:
        # Half a facet's turn makes the wall of a curve a little thinner than its radii say.
        assert (np.abs(many.gaps_m - expected[2]) < 0.02 * expected[2]).sum() >= expected[1]


def test_the_pair_a_grasp_is_at_and_its_frame() -> None:
    found = of(trimesh.creation.box(extents=(0.03, 0.05, 0.2)))
    both = found.of("surfaces")
    # The approach along -x, y and z in turn; closing along the object's x, but for a turn about z.
    down = Rotation.from_matrix(np.stack([[0, 1, 0], [1, 0, 0], [0, 0, -1]], axis=-1))
    tilt = math.radians(12.0)
    poses = [
        ((0, 0, 0.105), down * Rotation.from_rotvec([0, 0, tilt])),
        ((0.01, 0.0, 0.0), Rotation.from_matrix(np.stack([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], axis=-1))),
        ((0.0, 0.0, 0.15), down),
        ((0.0, 0.0, 0.0), down * Rotation.from_rotvec([0, 0, math.radians(50.0)])),
        ((0.02, 0.03, 0.0), down),
    ]
    p = np.array([position for position, _ in poses])
    q = np.array([turn.as_quat() for _, turn in poses])
    which, angle = both.at(ToolPoses(p, q))
    gaps = [round(float(both.gaps_m[w]), 6) if w >= 0 else None for w in which]
    assert gaps == [0.03, 0.05, None, 0.05, None]
    np.testing.assert_allclose(np.degrees(angle[[0, 1, 3]]), [12.0, 0.0, 40.0], atol=1e-6)
    assert np.isnan(angle[[2, 4]]).all()
    frames = both.frames(ToolPoses(p, q))
    np.testing.assert_allclose(frames[0], down.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(frames[1], poses[1][1].as_matrix(), atol=1e-9)
    assert np.isnan(frames[[2, 4]]).all()
    # The jaw turned about its approach sees x and y turned.
    twin = (Rotation.from_quat(q) * Rotation.from_rotvec([0, 0, math.pi])).as_quat()
    np.testing.assert_allclose(
        both.frames(ToolPoses(p, twin))[[0, 1, 3]], frames[[0, 1, 3]] * [-1, -1, 1], atol=1e-9
    )
    assert len(found.within(0.04)) == (found.gaps_m <= 0.04).sum() < len(found)


@given(st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_at_is_the_most_parallel_of_those_that_hold_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    thing = example("mug")
    found = pairs_of_mesh(*thing.triangles, ridges_of_mesh(*thing.triangles), watertight=True, opening_m=0.07)
    p = rng.uniform(-0.045, 0.045, (40, 3))
    turns = Rotation.random(40, random_state=seed)
    which, angle = found.at(ToolPoses(p, turns.as_quat()))
    closing = turns.as_matrix()[:, :, 1]
    room = found.half + np.array([MARGIN_M, 0, MARGIN_M])
    for x, c, w, a in zip(p, closing, which, angle, strict=True):
        inside = (np.abs(np.einsum("pij,pi->pj", found.axes, x - found.centres)) <= room).all(axis=1)
        if not inside.any():
            assert w == -1
            continue
        cosines = np.abs(found.axes[:, :, 1] @ c)
        assert inside[w]
        assert math.cos(a) == pytest.approx(cosines[inside].max())


def test_nothing_to_close_on() -> None:
    ball = of(trimesh.creation.icosphere(3, 0.05))
    assert not len(ball)
    assert (ball.at(ToolPoses([(0.0, 0.0, 0.0)], [(0.0, 0.0, 0.0, 1.0)]))[0] == -1).all()
    assert np.isnan(ball.frames(ToolPoses([(0.0, 0.0, 0.0)], [(0.0, 0.0, 0.0, 1.0)]))).all()
    assert ball.frames(ToolPoses(np.empty((0, 3)), np.empty((0, 4)))).shape == (0, 3, 3)
    with pytest.raises(ValueError, match="opening"):
        of(trimesh.creation.box(), opening=0.0)


@pytest.mark.parametrize("name", EXAMPLES)
def test_grasps_on_pairs_are_at_their_pairs(name: str) -> None:
    parts = example(name).parts
    found = pairs_of_parts(parts, ridges_of_parts(parts), opening_m=0.07)
    positions, quaternions, weights = found.grasps(4_000)
    assert len(positions) == pytest.approx(4_000, rel=0.1)
    assert weights.sum() == pytest.approx(1.0)
    which, angle = found.at(ToolPoses(positions, quaternions))
    assert (which >= 0).all()
    np.testing.assert_allclose(angle, 0.0, atol=1e-6)
    # Every pair has its share, and every turn about its axis.
    share = (found.half[:, 0] + MARGIN_M) * (found.half[:, 2] + MARGIN_M)
    number = np.maximum(np.rint(share / share.sum() * 4_000), 1).astype(int)
    own = np.repeat(np.arange(len(found)), number)
    np.testing.assert_allclose(np.bincount(own, weights=weights), share / share.sum(), atol=1e-9)
    largest = own == np.argmax(share)
    approach = Rotation.from_quat(quaternions[largest]).as_matrix()[:, :, 2]
    assert np.linalg.norm(approach.mean(axis=0)) < 0.2
    again = found.grasps(4_000)
    assert all(np.array_equal(a, b) for a, b in zip(again, (positions, quaternions, weights), strict=True))
    assert len(found.of().grasps(10)[0]) == 0
