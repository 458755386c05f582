"""The paper's four objects: convex closed parts, stated sizes and masses, surfaces with the same extent."""

from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh

from graspdb.examples import EXAMPLES, example

#: Part counts and masses (kg) as published with the measurements the objects were made for.
STATED = {"cone": (1, 0.87), "elongated-d": (15, 1.6), "screwdriver": (4, 0.075), "mug": (33, 0.075)}


@pytest.mark.parametrize("name", EXAMPLES)
def test_parts_are_convex_closed_and_outward(name: str) -> None:
    thing = example(name)
    assert len(thing.parts) == STATED[name][0]
    for vertices, faces in thing.parts:
        part = trimesh.Trimesh(vertices, faces, process=False)
        assert part.is_watertight
        assert part.is_winding_consistent
        assert part.volume == pytest.approx(part.convex_hull.volume, rel=1e-9)


@pytest.mark.parametrize("name", EXAMPLES)
def test_mass_and_friction(name: str) -> None:
    thing = example(name)
    assert thing.mass_kg == pytest.approx(STATED[name][1], rel=0.06)
    assert thing.friction == 0.4


@pytest.mark.parametrize("name", EXAMPLES)
def test_surface_is_closed_with_the_parts_extent_and_volume(name: str) -> None:
    thing = example(name)
    mesh = thing.mesh()
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    np.testing.assert_array_equal(mesh.bounds, thing.bounds)
    # The parts' faces on the outside are the surface's: the same points are inside both.
    points = np.random.default_rng(1).uniform(*thing.bounds, size=(4000, 3))
    in_parts = np.zeros(len(points), dtype=bool)
    for vertices, faces in thing.parts:
        part = trimesh.Trimesh(vertices, faces, process=False)
        normals, origins = part.face_normals, part.triangles[:, 0]
        in_parts |= np.all(points @ normals.T <= np.sum(normals * origins, axis=1), axis=1)
    in_surface = np.zeros(len(points), dtype=bool)
    for vertices, faces in thing.surface:
        a, b, c = (vertices[faces[:, k]] - points[:, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
        numerator = np.sum(a * np.cross(b, c), axis=-1)
        denominator = la * lb * lc + np.sum(a * b, -1) * lc + np.sum(b * c, -1) * la + np.sum(c * a, -1) * lb
        winding = np.sum(2 * np.arctan2(numerator, denominator), axis=1) / (4 * np.pi)
        in_surface |= winding > 0.5
    assert np.array_equal(in_parts, in_surface)
    assert in_parts.any()


@pytest.mark.parametrize("name", EXAMPLES)
def test_stl_and_glb_carry_the_object(name: str) -> None:
    thing = example(name)
    surface = trimesh.load_mesh(io.BytesIO(thing.stl()), file_type="stl")
    assert surface.is_watertight
    np.testing.assert_allclose(surface.bounds, thing.bounds, atol=1e-8)
    scene = trimesh.load_scene(io.BytesIO(thing.parts_glb()), file_type="glb")
    assert len(scene.geometry) == len(thing.parts)
    volumes = [part.volume for part in scene.geometry.values()]
    assert sum(volumes) * 1000 == pytest.approx(thing.mass_kg, rel=1e-5)


def test_stated_dimensions() -> None:
    np.testing.assert_allclose(example("cone").bounds, [[-0.04, -0.04, -0.2], [0.04, 0.04, 0.2]])
    np.testing.assert_allclose(example("elongated-d").bounds, [[-0.07, -0.07, -0.175], [0.07, 0.07, 0.175]])
    low, high = example("screwdriver").bounds
    assert high[2] - low[2] == pytest.approx(0.28)
    low, high = example("mug").bounds
    np.testing.assert_allclose([low[0], high[1], high[2]], [-0.03, 0.03, 0.04])
    assert high[0] == pytest.approx(0.057)  # the handle


def test_other_names_are_refused_with_the_list() -> None:
    assert example("elongated_d").name == "elongated-d"
    with pytest.raises(ValueError, match="cone, elongated-d, screwdriver, mug"):
        example("teapot")
