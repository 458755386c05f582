"""Ridges: of solids whose edges are known, of unions, of sampled curves, and the one nearest to a grasp."""

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
from graspdb_geometry.features.ridges import REACH_M, Ridges, ridges_of_mesh, ridges_of_parts

FloatArray = npt.NDArray[np.float64]
Part = tuple[FloatArray, npt.NDArray[np.int64]]


def length_m(found: Ridges) -> float:
    """Of all segments together."""
    return float(np.linalg.norm(found.ends[:, 1] - found.ends[:, 0], axis=1).sum())


def box(size: npt.ArrayLike, at: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Part:
    made = trimesh.creation.box(extents=np.asarray(size))
    return np.asarray(made.vertices) + np.asarray(at), np.asarray(made.faces, dtype=np.int64)


def cylinder(sections: int, radius: float = 0.02, height: float = 0.1) -> Part:
    made = trimesh.creation.cylinder(radius, height, sections=sections)
    return np.asarray(made.vertices), np.asarray(made.faces, dtype=np.int64)


def together(parts: list[Part]) -> Part:
    """Several closed surfaces as one mesh."""
    offsets = np.cumsum([0] + [len(v) for v, _ in parts[:-1]])
    return (
        np.concatenate([v for v, _ in parts]),
        np.concatenate([f + o for (_, f), o in zip(parts, offsets, strict=True)]),
    )


@given(st.tuples(*[st.floats(0.005, 0.2)] * 3), st.integers(0, 10_000), st.booleans())
@settings(max_examples=30, deadline=None)
def test_a_box_has_its_twelve_edges_however_it_lies(
    size: tuple[float, float, float], seed: int, soup: bool
) -> None:
    vertices, faces = box(size)
    turn = Rotation.random(random_state=seed)
    vertices = turn.apply(vertices) + np.random.default_rng(seed).normal(size=3)
    if soup:  # as STL has it
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    found = ridges_of_mesh(vertices, faces)
    assert len(found) == 12
    assert length_m(found) == pytest.approx(4 * sum(size))
    own = turn.inv().apply(found.tangents)
    assert np.allclose(np.sort(np.abs(own), axis=1), [0, 0, 1], atol=1e-9)
    normals = turn.inv().apply(found.normals)
    assert np.allclose(np.sort(np.abs(normals), axis=1), [0, 0.5**0.5, 0.5**0.5], atol=1e-9)
    # Outwards: away from the middle.
    away = turn.inv().apply(found.ends.mean(axis=1) - vertices.mean(axis=0))
    assert (np.einsum("ei,ei->e", away, normals) > 0).all()


@pytest.mark.parametrize("sections", [8, 10, 12, 20, 32])
def test_the_facets_of_a_round_thing_are_no_ridges(sections: int) -> None:
    found = ridges_of_mesh(*cylinder(sections))
    assert len(found) == 2 * sections
    assert np.allclose(np.abs(found.ends[:, :, 2]), 0.05)
    assert np.allclose(found.tangents[:, 2], 0.0, atol=1e-12)


def test_a_hexagon_and_a_chamfer_have_ridges_and_a_sphere_has_none() -> None:
    assert len(ridges_of_mesh(*cylinder(6))) == 18
    for divisions in (1, 2):
        ball = trimesh.creation.icosphere(divisions, 0.03)
        assert not len(ridges_of_mesh(ball.vertices, ball.faces))
    outline = [[-20, -15], [20, -15], [20, 13], [18, 15], [-20, 15]]
    bar = trimesh.creation.extrude_triangulation(
        np.array(outline) / 1000, np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]]), 0.1
    )
    # 45 degrees on either side of the chamfer, which is much narrower than what it joins.
    upright = np.abs(ridges_of_mesh(bar.vertices, bar.faces).tangents[:, 2]) > 0.9
    assert upright.sum() == 5


def test_inward_bends_are_no_ridges() -> None:
    step = [[0, 0], [40, 0], [40, 10], [20, 10], [20, 30], [0, 30]]
    triangles = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 5], [3, 4, 5]])
    bar = trimesh.creation.extrude_triangulation(np.array(step) / 1000, triangles, 0.05)
    found = ridges_of_mesh(bar.vertices, bar.faces)
    upright = found.ends[np.abs(found.tangents[:, 2]) > 0.9][:, 0, :2]
    assert {tuple(np.round(xy * 1000).astype(int)) for xy in upright} == {
        (0, 0), (40, 0), (40, 10), (20, 30), (0, 30)
    }  # fmt: skip


@given(st.floats(0.01, 0.05), st.floats(0.01, 0.05), st.floats(0.0, 0.008), st.booleans())
@settings(max_examples=25, deadline=None)
def test_boxes_end_to_end_are_one_box(first: float, second: float, overlap: float, as_mesh: bool) -> None:
    parts = [
        box((first, 0.03, 0.02), (-first / 2, 0, 0)),
        box((second + overlap, 0.03, 0.02), ((second - overlap) / 2, 0, 0)),
    ]
    found = ridges_of_mesh(*together(parts)) if as_mesh else ridges_of_parts(parts)
    # A seam is left out to within the distance at which samples are looked at.
    along = np.abs(found.tangents[:, 0]) > 0.9
    assert not np.any(~along & (np.abs(found.ends[:, 0, 0] - second) > 1e-9)
                      & (np.abs(found.ends[:, 0, 0] + first) > 1e-9))  # fmt: skip
    covered = np.zeros(400, dtype=bool)
    x = np.linspace(-first, second, 402)[1:-1]
    one = along & (found.ends[:, :, 1] > 0).all(axis=1) & (found.ends[:, :, 2] > 0).all(axis=1)
    for segment in found.ends[one]:
        low, high = np.sort(segment[:, 0])
        covered |= (x >= low - 1e-9) & (x <= high + 1e-9)
    assert covered.mean() > 0.98
    assert np.allclose(np.abs(found.normals[along]), [0, 0.5**0.5, 0.5**0.5], atol=2e-3)


def test_a_box_on_another_shows_what_sticks_out() -> None:
    parts = [box((0.1, 0.1, 0.02)), box((0.02, 0.02, 0.04), (0, 0, 0.025))]
    for found in (ridges_of_parts(parts), ridges_of_mesh(*together(parts))):
        # The upper one's foot, 5 mm deep, is hidden, but for less than the samples' spacing.
        small = np.abs(found.ends[:, :, 0]).max(axis=1) < 0.02
        assert found.ends[small][:, :, 2].min() > 0.01 - 2e-3
        assert np.isclose(found.ends[small][:, :, 2].max(), 0.045)
        whole = np.linalg.norm(found.ends[~small][:, 1] - found.ends[~small][:, 0], axis=1).sum()
        assert whole == pytest.approx(8 * 0.1 + 4 * 0.02)


#: Of the rings and bars that bend, metres: what the objects are made of.
def ring(sections: int, radius: float) -> float:
    return 2 * sections * radius * math.sin(math.pi / sections)


RIDGED = {
    "cone": ring(32, 0.04) + ring(32, 0.01),
    "mug": ring(24, 0.03) * 2 + ring(24, 0.026),  # and the handle's four edges, told below
    "elongated-d": 2 * (2 * 12 * 0.07 * math.sin(math.pi / 24) + 2 * 0.07 + 0.14)
    + 2 * (2 * 12 * 0.06 * math.sin(math.pi / 24) + 2 * 0.06 + 0.12)
    + 2 * 0.35,
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_by_their_surface_and_by_their_parts(name: str) -> None:
    thing = example(name)
    by_mesh, by_parts = ridges_of_mesh(*thing.triangles), ridges_of_parts(thing.parts)
    assert length_m(by_mesh) == pytest.approx(length_m(by_parts), rel=0.01)
    probes = np.random.default_rng(0).uniform(*thing.bounds, size=(500, 3))
    (_, near), (_, also) = by_mesh.nearest(probes), by_parts.nearest(probes)
    both = np.isfinite(near) & np.isfinite(also)
    assert both.mean() == pytest.approx(np.isfinite(near).mean(), abs=0.02)
    assert np.abs(near[both] - also[both]).max() < 3e-3
    if name == "mug":
        handle = (by_mesh.ends[:, :, 0] > 0.0301).any(axis=1)
        ends = by_mesh.ends[~handle]
        assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum() == pytest.approx(RIDGED[name], rel=0.02)
        assert handle.sum() == 32
        # Nothing of it inside of the wall, where its ends are.
        middle = by_mesh.ends[handle].mean(axis=1)
        assert np.hypot(middle[:, 0], middle[:, 1]).min() > 0.0295
    elif name in RIDGED:
        assert length_m(by_mesh) == pytest.approx(RIDGED[name], rel=1e-6)
    else:
        # The screwdriver's blade, but not its foot; not the twelve edges of the shaft.
        shaft = (by_mesh.ends[:, :, 2] > -0.029).all(axis=1) & (by_mesh.ends[:, :, 2] < 0.124).all(axis=1)
        assert not shaft.any()
        blade = by_mesh.ends[(by_mesh.ends[:, :, 2] > 0.126).any(axis=1)]
        assert np.linalg.norm(blade[:, 1] - blade[:, 0], axis=1).sum() == pytest.approx(
            4 * 0.015 + 2 * (0.01 + 0.0012)
        )


# -- the nearest


def brute(found: Ridges, x: FloatArray) -> FloatArray:
    a, d = found.ends[:, 0], found.ends[:, 1] - found.ends[:, 0]
    share = np.clip(np.einsum("si,si->s", x - a, d) / np.einsum("si,si->s", d, d), 0.0, 1.0)
    return np.asarray(np.linalg.norm(x - a - share[:, None] * d, axis=1))


@given(st.integers(0, 10_000), st.sampled_from(EXAMPLES))
@settings(max_examples=20, deadline=None)
def test_nearest_is_that_of_all_segments(seed: int, name: str) -> None:
    thing = example(name)
    found = ridges_of_mesh(*thing.triangles)
    low, high = thing.bounds
    probes = np.random.default_rng(seed).uniform(low - 0.05, high + 0.05, size=(60, 3))
    which, distance = found.nearest(probes)
    frames = found.frames(probes)
    for x, s, d, frame in zip(probes, which, distance, frames, strict=True):
        every = brute(found, x)
        if s == -1:
            assert every.min() >= REACH_M * (1 - 1e-12)
            assert np.isnan(frame).all()
            continue
        assert d == pytest.approx(every.min())
        close = every <= every.min() + 1e-4
        if s == -2:
            assert close.sum() > 1
            assert np.isnan(frame).all()
            continue
        assert every[s] == pytest.approx(every.min())
        assert np.allclose(frame, np.stack([found.tangents[s], np.cross(found.normals[s], found.tangents[s]),
                                            found.normals[s]], axis=-1))  # fmt: skip
        assert np.allclose(frame.T @ frame, np.eye(3), atol=1e-9)
        assert np.linalg.det(frame) > 0
        assert (np.abs(found.tangents[close] @ found.tangents[s]) > math.cos(math.radians(31))).all()


def test_ties_and_what_is_far_have_no_frame() -> None:
    found = ridges_of_mesh(*box((0.04, 0.04, 0.2)))
    middle, corner, far = (0.0, 0.02, 0.0), (0.022, 0.022, 0.103), (0.0, 0.0, 0.2)
    beside = (0.015, 0.02, 0.0)
    frames = found.frames([middle, corner, far, beside])
    assert np.isnan(frames[:3]).all()
    np.testing.assert_allclose(np.abs(frames[3][:, 0]), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(frames[3][:, 2], [0.5**0.5, 0.5**0.5, 0], atol=1e-12)
    assert np.isfinite(found.frames([(0.0, 0.02, 0.13)], reach_m=0.05)).all()
    # The two ends of neighbouring segments of one curve are no tie.
    assert np.isfinite(ridges_of_mesh(*cylinder(32)).frames([(0.025, 0.0, 0.052)])).all()


def test_what_can_not_be_measured_is_refused() -> None:
    vertices, faces = box((1, 1, 1))
    with pytest.raises(ValueError, match="existing"):
        ridges_of_mesh(vertices, faces + 8)
    with pytest.raises(ValueError, match="finite"):
        ridges_of_mesh(vertices * np.nan, faces)
    with pytest.raises(ValueError, match="part"):
        ridges_of_parts([])
    with pytest.raises(ValueError, match="positions"):
        ridges_of_mesh(vertices, faces).nearest([[0.0, 0.0]])
    # An open sheet has borders, but nothing that bends.
    assert not len(ridges_of_mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]]))
