"""The sampled kernel: normalised, symmetric, equal to its definition, drawn from, limited."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from graspdb_density import GraspDensity, IsotropicKernel, SampledKernel, se3

Poses = tuple[se3.Floats, se3.Floats]
Shell = Callable[[int, np.random.Generator], Poses]

COMPONENT = IsotropicKernel(0.01, math.radians(20.0))


def template(rng: np.random.Generator, count: int = 12) -> SampledKernel:
    moves = rng.normal(size=(count, 3)) * [0.004, 0.02, 0.008]
    turns = se3.from_rotation_vector(rng.normal(size=(count, 3)) * [0.1, 0.5, 0.2])
    return SampledKernel(se3.Poses(moves, turns), COMPONENT, rng.uniform(0.5, 2.0, count))


def alone(kernel: SampledKernel) -> GraspDensity:
    """The kernel as a density of displacements: one grasp at the origin, whose jaw has no symmetry."""
    return kernel.placed(se3.Poses(np.zeros((1, 3)), se3.IDENTITY[None]), symmetric=False)


def test_integrates_to_one() -> None:
    """Importance sampling from an isotropic kernel that covers it."""
    rng = np.random.default_rng(0)
    kernel = template(rng)
    cover = IsotropicKernel(0.025, math.radians(50.0))
    p, q = cover.sample_displacements(400_000, rng)
    log_cover = cover.log_kernel(se3.Poses(p, q), se3.Poses(np.zeros(3), se3.IDENTITY))
    ratio = np.exp(alone(kernel).log_density(se3.Poses(p, q), cutoff=None) - log_cover)
    error = ratio.std() / math.sqrt(len(p))
    assert error < 0.02
    assert abs(ratio.mean() - 1.0) < 4.5 * error


def test_density_is_the_sum_over_rows_turns_and_components(shell: Shell) -> None:
    """Eq 6 by its definition, in float64: no cells, no cut-off."""
    rng = np.random.default_rng(1)
    kernel = template(rng, 5)
    rows = shell(30, rng)
    weights, symmetric = rng.uniform(0.5, 2.0, 30), rng.random(30) < 0.6
    density = kernel.placed(se3.Poses.of(*rows), weights=weights, symmetric=symmetric)
    p = rows[0][:20] + rng.normal(size=(20, 3)) * 0.01
    q = se3.multiply(rows[1][:20], se3.from_rotation_vector(rng.normal(size=(20, 3)) * 0.3))
    wanted = np.zeros(20)
    for i in range(30):
        ends = [rows[1][i], se3.jaw_twin(rows[1][i])] if symmetric[i] else [rows[1][i]]
        for end in ends:
            for j in range(5):
                at, to = se3.compose(se3.Poses(rows[0][i], end), kernel.displacements[j])
                faces = [to, se3.jaw_twin(to)] if symmetric[i] else [to]
                for face in faces:
                    share = weights[i] * kernel.weights[j] / len(ends) / len(faces)
                    wanted += share * np.exp(COMPONENT.log_kernel(se3.Poses(p, q), se3.Poses(at, face)))
    np.testing.assert_allclose(
        density.density(se3.Poses.of(p, q), cutoff=None), wanted / weights.sum(), rtol=1e-4
    )


def test_the_jaws_turn_changes_nothing(shell: Shell) -> None:
    rng = np.random.default_rng(2)
    kernel = template(rng)
    p, q = shell(40, rng)
    turned = np.where(rng.random(40)[:, None] < 0.5, q, se3.jaw_twin(q))
    at, to = p + 0.005, q
    one = kernel.placed(se3.Poses.of(p, q)).log_density(se3.Poses.of(at, to))
    np.testing.assert_allclose(
        one, kernel.placed(se3.Poses.of(p, turned)).log_density(se3.Poses.of(at, to)), atol=1e-4
    )
    np.testing.assert_allclose(
        one, kernel.placed(se3.Poses.of(p, q)).log_density(se3.Poses.of(at, se3.jaw_twin(to))), atol=1e-4
    )


def test_draws_follow_the_kernel() -> None:
    rng = np.random.default_rng(3)
    kernel = template(rng)
    drawn = alone(kernel).sample(40_000, rng)
    mean = kernel.weights @ kernel.displacements.positions
    np.testing.assert_allclose(drawn.positions.mean(axis=0), mean, atol=5e-4)


def test_bad_values() -> None:
    with pytest.raises(ValueError, match="at least one component"):
        SampledKernel(se3.Poses(np.empty((0, 3)), np.empty((0, 4))), COMPONENT, np.empty(0))
    with pytest.raises(ValueError, match="positive"):
        SampledKernel(se3.Poses(np.zeros((1, 3)), se3.IDENTITY[None]), COMPONENT, np.zeros(1))
