"""The distance between convex parts and the mesh they stand for."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspdb.examples import EXAMPLES, example
from graspdb_geometry import meshes
from graspdb_geometry.deviation import Fit, deviation, fit
from graspdb_geometry.meshes import Mesh, Part


def part(mesh: trimesh.Trimesh) -> Part:
    return np.array(mesh.vertices), np.array(mesh.faces)


def solid(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.array(mesh.vertices), np.array(mesh.faces))


@pytest.mark.parametrize("name", EXAMPLES)
def test_parts_by_construction_are_the_object(name: str) -> None:
    thing = example(name)
    found = deviation(meshes.load(thing.stl(), "model/stl"), thing.parts)
    assert found.largest_m < 1e-7


def test_a_filled_hollow_is_a_bulge() -> None:
    tube = trimesh.creation.annulus(r_min=0.02, r_max=0.03, height=0.1, sections=64)
    found = deviation(solid(tube), [part(trimesh.creation.cylinder(radius=0.03, height=0.1, sections=64))])
    # The lids' centres are as far as the bore's radius from the tube's surface.
    assert found.bulge_m == pytest.approx(0.02, abs=1e-3)
    assert found.gap_m < 1e-6


def test_a_missing_part_is_a_gap() -> None:
    boxes = [trimesh.creation.box((0.04, 0.04, 0.04)) for _ in range(2)]
    boxes[1].apply_translation([0, 0, 0.1])
    both = trimesh.util.concatenate(boxes)
    found = deviation(solid(both), [part(boxes[0])])
    assert found.gap_m == pytest.approx(0.1, abs=1e-3)
    assert found.bulge_m < 1e-9


def test_swollen_parts_are_as_far_off_as_they_swelled() -> None:
    inner, outer = trimesh.creation.box((0.04, 0.05, 0.06)), trimesh.creation.box((0.042, 0.052, 0.062))
    found = deviation(solid(inner), [part(outer)])
    # The corners are the farthest: sqrt(3) mm, which samples only come near to.
    assert 0.0014 < found.bulge_m <= 0.001 * np.sqrt(3)
    assert found.gap_m == 0.0
    assert deviation(solid(outer), [part(inner)]).gap_m == pytest.approx(0.001 * np.sqrt(3), rel=0.2)


def tube(inner: float, outer: float) -> trimesh.Trimesh:
    return trimesh.creation.annulus(r_min=inner, r_max=outer, height=0.1, sections=64)


def test_parts_stand_for_a_mesh_within_a_share_of_its_size_and_of_its_volume() -> None:
    block = trimesh.creation.box((0.3, 0.3, 0.3))
    mesh = solid(block)

    def grown(off: float) -> Fit:
        return fit(mesh, [part(trimesh.creation.box(np.full(3, 0.3 + 2 * off)))], float(block.volume))

    same, near, far = grown(0.0), grown(0.001), grown(0.003)
    assert same.accepted_m == pytest.approx(0.003)  # 1 % of 300 mm
    assert same.same
    assert same.accepted
    assert near.volume == pytest.approx((0.302 / 0.3) ** 3)
    assert near.accepted
    assert not near.same
    # 5 mm off at its corners, and 6 % too large.
    assert far.volume == pytest.approx(1.0612, abs=1e-4)
    assert not far.accepted
    assert "106.1% of its (95% to 105% do)" in str(far)
    small = fit(
        solid(trimesh.creation.box((0.02, 0.02, 0.02))), [part(trimesh.creation.box((0.021,) * 3))], None
    )
    assert (small.accepted_m, small.volume, small.accepted) == (1e-3, None, True)


def test_what_fills_a_room_does_not_stand_for_the_mesh() -> None:
    cup = tube(0.036, 0.04)
    found = fit(solid(cup), [part(cup.convex_hull)], float(cup.volume))
    assert found.deviation_m == pytest.approx(0.036, abs=2e-3)
    assert found.volume == pytest.approx(40**2 / (40**2 - 36**2), rel=1e-3)
    assert not found.accepted


def test_sheets_beside_a_solid_count_in_no_fit() -> None:
    block = trimesh.creation.box((0.04, 0.04, 0.04))
    sheet = np.array([[[0.1, 0, 0], [0.2, 0, 0], [0.1, 0.1, 0]], [[0.1, 0, 0], [0.1, 0.1, 0], [0.2, 0, 0]]])
    both = trimesh.util.concatenate(
        [block, trimesh.Trimesh(sheet.reshape(-1, 3), np.arange(6).reshape(2, 3), process=False)]
    )
    mesh = meshes.load(both.export(file_type="stl"), "model/stl")
    assert any("sheets" in warning for warning in mesh.warnings)
    assert fit(mesh, [part(block)], float(block.volume)).same


def test_the_same_input_gives_the_same_answer() -> None:
    thing = example("mug")
    mesh = meshes.load(thing.stl(), "model/stl")
    assert deviation(mesh, thing.parts[:20]) == deviation(mesh, thing.parts[:20])
