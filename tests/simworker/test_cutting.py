"""Cutting solids into convex parts: exact on modelled shapes, within its time on any."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from graspdb_geometry import meshes
from graspdb_geometry.collision import CONTACT, Scene, Surface
from graspdb_geometry.poses import ToolPoses
from graspdb_simworker.decomposition.convexity import (
    Candidate,
    CuttingLimits,
    Undecomposable,
    decompose,
    target_m,
)
from known_jaws import PG70


def run(mesh: trimesh.Trimesh, seconds: float = 60.0) -> tuple[Candidate, list[str]]:
    """Decompose within ``seconds`` of the processor's time."""
    read = meshes.load(mesh.export(file_type="stl"), "model/stl")
    notes: list[str] = []
    found: list[Candidate] = []
    limits = CuttingLimits(max_parts=1024, seconds=seconds, seed=0)
    decompose(read, limits, tell=notes.append, give=found.append)
    assert found[-1].fit.deviation_m <= target_m(read), notes
    assert found[-1].fit.accepted, notes
    return found[-1], notes


def channel() -> trimesh.Trimesh:
    """A U of three slabs."""
    slabs = [
        trimesh.creation.box(bounds=bounds)
        for bounds in (
            [[0, 0, 0], [0.06, 0.02, 0.08]],
            [[0, 0.02, 0], [0.02, 0.06, 0.08]],
            [[0.04, 0.02, 0], [0.06, 0.06, 0.08]],
        )
    ]
    united: trimesh.Trimesh = trimesh.boolean.union(slabs, engine="manifold")
    return united


def test_a_channel_is_three_slabs() -> None:
    found, _ = run(channel())
    assert found.parts == 3
    assert found.fit.deviation_m < 1e-6
    assert found.fit.volume == pytest.approx(1.0, abs=1e-5)


def test_convex_bodies_stay_beside_one_that_is_cut() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.02).apply_translation([0.2, 0, 0])
    found, notes = run(trimesh.util.concatenate([channel(), ball]))
    assert found.parts == 4
    assert "2 bodies, 1 convex" in notes[0]
    parts = meshes.parts_from_glb(found.glb)
    assert any(len(vertices) == len(ball.vertices) for vertices, _ in parts)


@pytest.mark.parametrize("name", ["torus", "tube", "hollow ball", "cross"])
def test_round_and_hollow_shapes_come_near(name: str) -> None:
    if name == "torus":
        mesh = trimesh.creation.torus(0.03, 0.01, major_sections=40, minor_sections=20)
    elif name == "tube":
        mesh = trimesh.creation.annulus(r_min=0.02, r_max=0.025, height=0.1, sections=48)
    elif name == "hollow ball":
        shells = [trimesh.creation.icosphere(subdivisions=2, radius=radius) for radius in (0.05, 0.03)]
        shells[1].invert()
        mesh = trimesh.util.concatenate(shells)
    else:
        bars = [trimesh.creation.box(np.roll([0.1, 0.01, 0.01], k)) for k in range(3)]
        mesh = trimesh.boolean.union(bars, engine="manifold")
    found, notes = run(mesh)
    assert found.parts <= (320 if name == "hollow ball" else 64)
    assert "at most" in notes[0]


def mug() -> trimesh.Trimesh:
    """80 mm wide, 90 mm high, walls of 4 mm, a floor of 5 mm, and a handle with a hole of 36 x 40 mm."""
    wall = trimesh.creation.annulus(r_min=0.036, r_max=0.04, height=0.09, sections=64)
    floor = trimesh.creation.cylinder(radius=0.038, height=0.005, sections=64)
    floor.apply_translation([0, 0, -0.0425])
    handle = [
        trimesh.creation.box(bounds=bounds)
        for bounds in (
            [[0.0385, -0.005, 0.02], [0.084, 0.005, 0.028]],
            [[0.0385, -0.005, -0.028], [0.084, 0.005, -0.02]],
            [[0.076, -0.005, -0.028], [0.084, 0.005, 0.028]],
        )
    ]
    united: trimesh.Trimesh = trimesh.boolean.union([wall, floor, *handle], engine="manifold")
    return united


def test_rooms_that_fingers_enter_stay_open() -> None:
    mesh = mug()
    found, _ = run(mesh)
    # As the sweeps' collision test takes them.
    scene = Scene(meshes.parts_from_glb(found.glb))
    # Straight down onto the rim, one finger in the mug: 33 mm off the wall outside, a little less inside,
    # where the finger's edges come first.
    down = Rotation.from_matrix([[[0, 1, 0], [1, 0, 0], [0, 0, -1]]]).as_quat()
    onto_the_rim = ToolPoses([[-0.038, 0.0, 0.045]], down)
    codes, travel = scene.classify(onto_the_rim, PG70)
    assert codes.tolist() == [CONTACT]
    inner = np.sqrt(0.036**2 - 0.01**2) - 0.003
    np.testing.assert_allclose(travel, [[inner, 0.033]], atol=found.fit.accepted_m)
    # Sideways about the handle, one finger through its hole.
    across = Rotation.from_matrix([[[0, 1, 0], [0, 0, -1], [-1, 0, 0]]]).as_quat()
    through_the_handle = ToolPoses([[0.08, 0.0, 0.0]], across)
    assert not scene.collides(through_the_handle, PG70, opening_m=0.02).any()
    assert scene.collides(through_the_handle, PG70, opening_m=0.006).all()
    exact = Surface(mesh.vertices, mesh.faces, watertight=True)
    for poses, opening in ((onto_the_rim, None), (through_the_handle, 0.02), (through_the_handle, 0.006)):
        assert np.array_equal(exact.collides(poses, PG70, opening), scene.collides(poses, PG70, opening))


def test_what_time_leaves_unusable_is_refused_with_the_option() -> None:
    mesh = trimesh.creation.torus(0.03, 0.01)
    told = r"more than 0 s .*--decompose-seconds.*best \d+ parts .*mm off .* of its \(95% to 105% do\)"
    with pytest.raises(Undecomposable, match=told):
        run(mesh, seconds=0.0)
