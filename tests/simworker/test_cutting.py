"""Cutting solids into convex parts: exact on modelled shapes, within its time on any."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspdb_geometry import meshes
from graspdb_simworker.decomposition.convexity import (
    Candidate,
    CuttingLimits,
    Undecomposable,
    decompose,
    target_m,
)


def run(mesh: trimesh.Trimesh, seconds: float = 60.0) -> tuple[Candidate, list[str]]:
    """Decompose within ``seconds`` of the processor's time."""
    read = meshes.load(mesh.export(file_type="stl"), "model/stl")
    notes: list[str] = []
    found: list[Candidate] = []
    limits = CuttingLimits(max_parts=1024, seconds=seconds, seed=0)
    decompose(read, limits, tell=notes.append, give=found.append)
    assert found[-1].deviation_m <= target_m(read), notes
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
    assert found.deviation_m < 1e-6
    assert found.added_volume == pytest.approx(0.0, abs=1e-5)


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
    assert found.added_volume is not None
    assert -0.05 < found.added_volume < 0.15
    assert "at most" in notes[0]


def test_what_time_leaves_unusable_is_refused_with_the_option() -> None:
    mesh = trimesh.creation.torus(0.03, 0.01)
    with pytest.raises(Undecomposable, match=r"--decompose-seconds.*still .* mm off"):
        run(mesh, seconds=0.0)
