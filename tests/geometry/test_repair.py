"""Surfaces that are not closed: mended where that is no guess, left with the reason otherwise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pybullet_data
import pytest
import trimesh

from graspdb_geometry import meshes


def ball(subdivisions: int = 3) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.05)


def inspect(mesh: trimesh.Trimesh) -> meshes.MeshProperties:
    return meshes.inspect(mesh.export(file_type="ply"), "model/ply").properties


def test_a_mended_ball_is_the_ball_again() -> None:
    whole, broken = ball(), ball()
    broken.update_faces(~np.isin(np.arange(len(broken.faces)), [3, 4, 5, 200, 700, 701]))
    broken.faces[::7] = broken.faces[::7, ::-1]
    found = inspect(broken)
    assert found.watertight
    assert found.convex
    assert found.volume_m3 == pytest.approx(whole.volume, rel=2e-3)
    np.testing.assert_allclose(found.centre_of_mass, [0, 0, 0], atol=2e-5)
    (note,) = [warning for warning in found.warnings if "mended" in warning]
    assert "filled" in note
    assert "turned" in note


def test_a_whole_mesh_is_left_alone() -> None:
    assert inspect(ball()).warnings == []


def test_every_triangle_turned_at_random_comes_back_outwards() -> None:
    rng = np.random.default_rng(3)
    mess = trimesh.util.concatenate([ball(2), ball(2).apply_translation([0.2, 0, 0])])
    turned = rng.random(len(mess.faces)) < 0.5
    mess.faces[turned] = mess.faces[turned][:, ::-1]
    found = inspect(mess)
    assert found.watertight
    assert found.volume_m3 == pytest.approx(2 * ball(2).volume, rel=1e-6)


def test_an_open_seam_is_sewn() -> None:
    """Two halves whose rims differ by rounding, as exporters leave them."""
    rng = np.random.default_rng(1)
    tube = trimesh.creation.cylinder(radius=0.03, height=0.1, sections=48).subdivide()
    upper = tube.triangles_center[:, 2] > 0
    halves = [tube.submesh([np.flatnonzero(side)], append=True) for side in (upper, ~upper)]
    halves[1].vertices += rng.uniform(-2e-8, 2e-8, halves[1].vertices.shape)
    apart = trimesh.Trimesh(
        np.concatenate([half.vertices for half in halves]),
        np.concatenate([halves[0].faces, halves[1].faces + len(halves[0].vertices)]),
        process=False,
    )
    data = apart.export(file_type="obj", digits=12).encode()
    found = meshes.inspect(data, "model/obj").properties
    assert found.watertight
    assert found.volume_m3 == pytest.approx(tube.volume, rel=1e-4)
    assert any("merged" in warning for warning in found.warnings)


def test_triangles_that_stand_twice_are_dropped() -> None:
    twice = ball(1)
    twice = trimesh.Trimesh(twice.vertices, np.concatenate([twice.faces, twice.faces[:5]]), process=False)
    found = inspect(twice)
    assert found.watertight
    assert any("stood twice" in warning for warning in found.warnings)


def test_a_hole_of_any_shape_is_filled_flat() -> None:
    """A star's cap: its rim is not convex, a fan over it would leave the plane figure."""
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    radius = np.where(np.arange(20) % 2, 0.01, 0.004)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    star = trimesh.creation.extrude_triangulation(
        np.vstack([ring, [[0, 0]]]), np.array([[i, (i + 1) % 20, 20] for i in range(20)]), height=0.3
    )
    capless = star.copy()
    capless.update_faces(np.abs(star.face_normals[:, 2]) < 0.5)
    found = inspect(capless)
    assert found.watertight
    assert found.volume_m3 == pytest.approx(star.volume, rel=1e-5)
    assert any("2 holes filled" in warning for warning in found.warnings)


def test_the_mouth_of_a_vessel_gets_no_lid() -> None:
    cup = ball()
    cup.update_faces(cup.triangles_center[:, 2] < 0.01)
    found = inspect(cup)
    assert not found.watertight
    assert any("larger than 5%" in warning for warning in found.warnings)


def test_three_walls_at_one_edge_are_no_solid() -> None:
    fin = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, -0.1, 0.02], [0, 0, 0.1]])
    mesh = trimesh.Trimesh(fin, [[0, 1, 2], [1, 0, 3], [0, 1, 4]], process=False)
    found = inspect(mesh)
    assert not found.watertight
    assert any("more than two triangles" in warning for warning in found.warnings)


def test_the_mug_of_pybullet_data_is_closed() -> None:
    content = (Path(pybullet_data.getDataPath()) / "objects" / "mug.obj").read_bytes()
    found = meshes.inspect(content, "model/obj").properties
    assert found.watertight
    assert not found.convex
    assert found.volume_m3 == pytest.approx(2.27e-4, rel=0.01)
    assert any("2 holes filled" in warning for warning in found.warnings)
