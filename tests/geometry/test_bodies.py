"""Meshes of several bodies: twice, inside out, overlapping, hollow, touching; against closed forms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from graspdb_geometry import meshes
from graspdb_geometry.mass import share_counted_wrong
from graspdb_geometry.meshes import MeshProperties

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
FloatArray = npt.NDArray[np.float64]


def solid_box(box: Box) -> trimesh.Trimesh:
    lower, upper = np.array(box)
    return trimesh.creation.box(bounds=[lower, upper])


def inspect(*bodies: trimesh.Trimesh, media_type: str = "model/stl") -> MeshProperties:
    joined = trimesh.util.concatenate(list(bodies))
    kind = {"model/stl": "stl", "model/ply": "ply", "model/obj": "obj"}[media_type]
    data = joined.export(file_type=kind)
    return meshes.inspect(data.encode() if isinstance(data, str) else data, media_type).properties


def inverted(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    turned = mesh.copy()
    turned.invert()
    return turned


def union_of_boxes(boxes: Sequence[Box]) -> tuple[float, FloatArray, FloatArray]:
    """Volume, centre of mass and inertia about it of a union of boxes: cell by cell of their grid."""
    corners = np.array(boxes)
    cuts = [np.unique(corners[:, :, axis]) for axis in range(3)]
    sides = np.stack(np.meshgrid(*(np.diff(cut) for cut in cuts), indexing="ij"), axis=-1).reshape(-1, 3)
    middles = [(cut[1:] + cut[:-1]) / 2 for cut in cuts]
    centres = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.zeros(len(centres), dtype=np.bool_)
    for lower, upper in corners:
        inside |= np.all((centres > lower) & (centres < upper), axis=1)
    sides, centres = sides[inside], centres[inside]
    volumes = sides.prod(axis=1)
    centre = volumes @ centres / volumes.sum()
    second = np.einsum("i,ij,ik->jk", volumes, centres - centre, centres - centre)
    second += np.diag(volumes @ (sides * sides)) / 12.0
    return float(volumes.sum()), centre, np.trace(second) * np.eye(3) - second


def check(found: MeshProperties, boxes: Sequence[Box]) -> None:
    volume, centre, inertia = union_of_boxes(boxes)
    assert found.watertight, found.warnings
    assert found.volume_m3 == pytest.approx(volume, rel=1e-5)
    np.testing.assert_allclose(found.centre_of_mass, centre, atol=1e-6)
    np.testing.assert_allclose(found.inertia, inertia, rtol=1e-4, atol=1e-5 * np.abs(inertia).max())


BRICK: Box = ((-0.02, -0.03, -0.05), (0.02, 0.03, 0.05))
BESIDE: Box = ((0.0, -0.03, -0.05), (0.04, 0.03, 0.05))
AWAY: Box = ((0.1, 0.0, 0.0), (0.12, 0.02, 0.02))
ON_TOP: Box = ((-0.02, -0.03, 0.05), (0.02, 0.03, 0.08))
CORE: Box = ((-0.01, -0.01, -0.01), (0.01, 0.01, 0.01))


def other_diagonals(box: Box) -> trimesh.Trimesh:
    """The same box with each of its sides split along the other diagonal."""
    mirrored = solid_box(box)
    centre = mirrored.bounds.mean(axis=0)
    mirrored.vertices = (mirrored.vertices - centre) * [-1, 1, 1] + centre
    mirrored.invert()
    return mirrored


def test_a_body_that_stands_twice_counts_once() -> None:
    brick = solid_box(BRICK)
    for copy in (brick, inverted(brick), other_diagonals(BRICK), inverted(other_diagonals(BRICK))):
        found = inspect(brick, copy)
        check(found, [BRICK])
        assert found.warnings
    check(inspect(brick, brick, inverted(brick), brick), [BRICK])
    assert any("twice" in warning for warning in inspect(brick, brick).warnings)
    assert any("both ways round" in warning for warning in inspect(brick, inverted(brick)).warnings)


def test_a_body_that_stands_twice_but_for_rounding_counts_once() -> None:
    rng = np.random.default_rng(2)
    lump = trimesh.creation.icosphere(subdivisions=2, radius=0.04)
    again = lump.copy()
    again.vertices += rng.uniform(-1e-8, 1e-8, again.vertices.shape)
    found = inspect(lump, again)
    assert found.volume_m3 == pytest.approx(lump.volume, rel=1e-4)
    np.testing.assert_allclose(found.inertia, lump.moment_inertia, rtol=1e-3, atol=1e-9)


def test_overlapping_bodies_are_united() -> None:
    found = inspect(solid_box(BRICK), solid_box(BESIDE))
    check(found, [BRICK, BESIDE])
    assert any("overlap" in warning for warning in found.warnings)


def test_the_union_of_two_balls_is_that_of_the_closed_form() -> None:
    radius, apart = 0.03, 0.04
    balls = [trimesh.creation.icosphere(subdivisions=5, radius=radius) for _ in range(2)]
    balls[1].apply_translation([apart, 0, 0])
    lens = np.pi * (4 * radius + apart) * (2 * radius - apart) ** 2 / 12
    found = inspect(*balls)
    assert found.volume_m3 == pytest.approx(8 / 3 * np.pi * radius**3 - lens, rel=2e-3)
    np.testing.assert_allclose(found.centre_of_mass, [apart / 2, 0, 0], atol=1e-6)


def test_a_body_inside_out_beside_others_is_turned() -> None:
    found = inspect(solid_box(BRICK), inverted(solid_box(AWAY)))
    check(found, [BRICK, AWAY])
    assert any("inside out" in warning for warning in found.warnings)
    check(inspect(solid_box(BRICK), inverted(solid_box(BESIDE))), [BRICK, BESIDE])
    check(inspect(inverted(solid_box(BRICK)), inverted(solid_box(AWAY))), [BRICK, AWAY])


def test_bodies_that_do_not_touch_are_said_so() -> None:
    found = inspect(solid_box(BRICK), solid_box(AWAY))
    check(found, [BRICK, AWAY])
    assert any("2 bodies that do not touch" in warning for warning in found.warnings)


@pytest.mark.parametrize("turned", [False, True])
def test_bodies_that_touch_are_whole(turned: bool) -> None:
    top = solid_box(ON_TOP)
    found = inspect(solid_box(BRICK), inverted(top) if turned else top)
    check(found, [BRICK, ON_TOP])
    assert not any("touch" in warning for warning in found.warnings)


def test_bodies_that_touch_in_an_edge_or_a_corner_come_apart() -> None:
    by_edge: Box = ((0.02, 0.03, -0.05), (0.05, 0.06, 0.05))
    by_corner: Box = ((0.02, 0.03, 0.05), (0.05, 0.06, 0.07))
    check(inspect(solid_box(BRICK), solid_box(by_edge)), [BRICK, by_edge])
    check(inspect(solid_box(BRICK), inverted(solid_box(by_edge))), [BRICK, by_edge])
    check(inspect(solid_box(BRICK), solid_box(by_corner)), [BRICK, by_corner])


def hollow_ball(outer: float = 0.05, inner: float = 0.03) -> list[trimesh.Trimesh]:
    balls = [trimesh.creation.icosphere(subdivisions=4, radius=radius) for radius in (outer, inner)]
    return [balls[0], inverted(balls[1])]


def check_hollow(found: MeshProperties, outer: float = 0.05, inner: float = 0.03) -> None:
    assert found.watertight
    assert found.volume_m3 == pytest.approx(4 / 3 * np.pi * (outer**3 - inner**3), rel=5e-3)
    expected = 8 / 15 * np.pi * (outer**5 - inner**5)
    np.testing.assert_allclose(np.diag(np.array(found.inertia)), expected, rtol=1e-2)
    assert not found.convex


def test_a_cavity_stays_a_cavity() -> None:
    check_hollow(inspect(*hollow_ball()))
    assert inspect(*hollow_ball()).warnings == []
    # The whole of it inside out, in two copies, beside another body.
    check_hollow(inspect(*[inverted(shell) for shell in hollow_ball()]))
    check_hollow(inspect(*hollow_ball(), *hollow_ball()))
    found = inspect(*hollow_ball(), solid_box(AWAY))
    volume = 4 / 3 * np.pi * (0.05**3 - 0.03**3) + 0.02**3
    assert found.volume_m3 == pytest.approx(volume, rel=5e-3)


def test_a_body_in_a_cavity_is_material_again() -> None:
    found = inspect(*hollow_ball(), solid_box(CORE))
    assert found.volume_m3 == pytest.approx(4 / 3 * np.pi * (0.05**3 - 0.03**3) + 0.02**3, rel=5e-3)
    assert any("do not touch" in warning for warning in found.warnings)
    found = inspect(*hollow_ball(), inverted(solid_box(CORE)))
    assert found.volume_m3 == pytest.approx(4 / 3 * np.pi * (0.05**3 - 0.03**3) + 0.02**3, rel=5e-3)


def test_a_hollow_body_wound_at_random_keeps_its_cavity() -> None:
    rng = np.random.default_rng(5)
    shells = trimesh.util.concatenate(hollow_ball())
    turned = rng.random(len(shells.faces)) < 0.5
    shells.faces[turned] = shells.faces[turned][:, ::-1]
    check_hollow(inspect(shells))


def test_a_body_wholly_inside_another_adds_nothing_and_is_said() -> None:
    found = inspect(solid_box(BRICK), solid_box(CORE))
    check(found, [BRICK])
    assert any("inside another" in warning for warning in found.warnings)


def test_an_inner_cavity_of_overlapping_bodies_stays() -> None:
    found = inspect(solid_box(BRICK), inverted(solid_box(CORE)), solid_box(ON_TOP), solid_box(AWAY))
    volume, _, _ = union_of_boxes([BRICK, ON_TOP, AWAY])
    assert found.volume_m3 == pytest.approx(volume - 0.02**3, rel=1e-5)


def test_a_surface_drawn_both_ways_round_is_one_solid() -> None:
    tube = trimesh.creation.annulus(r_min=0.01, r_max=0.02, height=0.05, sections=32)
    both = trimesh.Trimesh(tube.vertices, np.concatenate([tube.faces, tube.faces[:, ::-1]]), process=False)
    for media_type in ("model/stl", "model/ply", "model/obj"):
        found = inspect(both, media_type=media_type)
        assert found.volume_m3 == pytest.approx(tube.volume, rel=1e-5)


def closed_tube(path: FloatArray, side: float) -> trimesh.Trimesh:
    """A square section of 2 ``side`` swept along points near the plane z = 0, with caps at both ends."""
    along = np.gradient(path, axis=0)
    across = np.cross([0, 0, 1], along)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    rings = np.stack([path + side * (x * across + y * np.array([0, 0, 1.0])) for x, y in corners], axis=1)
    faces = []
    for ring in range(len(path) - 1):
        for k in range(4):
            a, b = 4 * ring + k, 4 * ring + (k + 1) % 4
            faces += [(a, b, a + 4), (b, b + 4, a + 4)]
    end = 4 * (len(path) - 1)
    faces += [(0, 2, 1), (0, 3, 2), (end, end + 1, end + 2), (end, end + 2, end + 3)]
    return trimesh.Trimesh(rings.reshape(-1, 3), faces, process=False)


def test_a_surface_through_itself_has_no_volume_and_says_why() -> None:
    """A bent tube whose ends run through one another: one connected surface."""
    angle = np.linspace(0, 2.2 * np.pi, 80)
    ring = closed_tube(np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), 1e-4 * angle], axis=1), 0.01)
    assert ring.is_watertight
    found = inspect(ring)
    assert not found.watertight
    assert found.volume_m3 is None
    assert any("runs through itself" in warning for warning in found.warnings)
    assert any("boolean union" in warning for warning in found.warnings)
    half = closed_tube(
        np.stack([0.05 * np.cos(angle / 2), 0.05 * np.sin(angle / 2), 0 * angle], axis=1), 0.01
    )
    assert inspect(half).warnings == []


def test_the_share_counted_wrong_is_that_of_the_overlap() -> None:
    brick, beside = solid_box(BRICK), solid_box(BESIDE)
    corners = np.concatenate([brick.vertices[brick.faces], beside.vertices[beside.faces]])
    assert share_counted_wrong(corners) == pytest.approx(1 / 3, abs=0.03)
    assert share_counted_wrong(brick.vertices[brick.faces]) == 0.0


@pytest.mark.parametrize("count", [2, 3, 4])
def test_the_bodies_of_convex_ones_are_its_parts(count: int) -> None:
    bodies = [trimesh.creation.cylinder(radius=0.01, height=0.1, sections=20 + k) for k in range(count)]
    for number, body in enumerate(bodies):
        body.apply_transform(trimesh.transformations.rotation_matrix(number, [1, 1, 0]))
    data = trimesh.util.concatenate(bodies).export(file_type="stl")
    answer = meshes.inspect(data, "model/stl")
    assert answer.properties.watertight
    assert len(answer.parts) == count
    dented = meshes.inspect(trimesh.creation.torus(0.03, 0.01).export(file_type="stl"), "model/stl")
    assert dented.parts == []


SMALL = st.integers(0, 4)


@st.composite
def boxes(draw: st.DrawFn) -> Box:
    """A box on a coarse grid, so that faces and edges of several coincide often."""
    lower = draw(st.tuples(SMALL, SMALL, SMALL))
    size = draw(st.tuples(*[st.integers(1, 3)] * 3))
    low = tuple(0.01 * x for x in lower)
    return low, tuple(0.01 * (x + s) for x, s in zip(lower, size, strict=True))  # type: ignore[return-value]


@settings(max_examples=60, deadline=None)
@given(some=st.lists(boxes(), min_size=1, max_size=5), turned=st.booleans())
def test_any_union_of_boxes_has_its_volume_centre_and_inertia(some: list[Box], turned: bool) -> None:
    bodies = [solid_box(box) for box in some]
    check(inspect(*[inverted(body) if turned else body for body in bodies]), some)
