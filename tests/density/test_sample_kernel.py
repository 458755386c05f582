"""The sampled kernel: normalised, symmetric, equal to its definition, drawn from, limited."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from graspdb_density import IsotropicKernel, SampledKernel, se3
from graspdb_density.kde import brute_force

Poses = tuple[se3.Floats, se3.Floats]
Shell = Callable[[int, np.random.Generator], Poses]

COMPONENT = IsotropicKernel(0.01, math.radians(20.0))


def template(rng: np.random.Generator, count: int = 12) -> SampledKernel:
    moves = rng.normal(size=(count, 3)) * [0.004, 0.02, 0.008]
    turns = se3.from_rotation_vector(rng.normal(size=(count, 3)) * [0.1, 0.5, 0.2])
    return SampledKernel(moves, turns, COMPONENT, rng.uniform(0.5, 2.0, count))


def test_integrates_to_one() -> None:
    """Importance sampling from an isotropic kernel that covers it."""
    rng = np.random.default_rng(0)
    kernel = template(rng)
    cover = IsotropicKernel(0.025, math.radians(50.0))
    p, q = cover.sample_displacements(400_000, rng)
    log_cover = brute_force.kernel_log_density(cover, se3.Poses(p, q), se3.Poses(np.zeros(3), se3.IDENTITY))
    ratio = np.exp(kernel.log_kernel(se3.Poses(p, q)) - log_cover)
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
                at, to = se3.compose(
                    se3.Poses(rows[0][i], end), se3.Poses(kernel.translations[j], kernel.quaternions_xyzw[j])
                )
                faces = [to, se3.jaw_twin(to)] if symmetric[i] else [to]
                for face in faces:
                    share = weights[i] * kernel.shares[j] / len(ends) / len(faces)
                    wanted += share * np.exp(
                        brute_force.kernel_log_density(COMPONENT, se3.Poses(p, q), se3.Poses(at, face))
                    )
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
    move, turn = kernel.sample_displacements(40_000, rng)
    mean = kernel.shares @ kernel.translations
    np.testing.assert_allclose(move.mean(axis=0), mean, atol=5e-4)
    # Where draws are, a density that is theirs is as high as its own entropy says.
    drawn = kernel.log_kernel(se3.Poses(*kernel.sample_displacements(4_000, rng))).mean()
    assert kernel.log_kernel(se3.Poses(move[:4_000], turn[:4_000])).mean() == pytest.approx(drawn, abs=0.1)


def test_gradient_is_that_of_the_density(shell: Shell) -> None:
    rng = np.random.default_rng(4)
    p, q = shell(60, rng)
    density = template(rng).placed(se3.Poses.of(p, q))
    at, to = p[:5] + 0.003, q[:5]
    along, _ = density.gradient(se3.Poses.of(at, to))
    step = 1e-5 * along / np.linalg.norm(along, axis=1, keepdims=True)
    rise = density.log_density(se3.Poses.of(at + step, to), cutoff=None) - density.log_density(
        se3.Poses.of(at - step, to), cutoff=None
    )
    np.testing.assert_allclose(rise / 2e-5, np.linalg.norm(along, axis=1), rtol=0.05)


def test_limits_and_bad_values() -> None:
    rng = np.random.default_rng(5)
    kernel = template(rng, 900)
    with pytest.raises(ValueError, match="more than 2000000; fit a mixture"):
        kernel.placed(se3.Poses.of(np.zeros((1_200, 3)), np.tile(se3.IDENTITY, (1_200, 1))))
    with pytest.raises(ValueError, match="at least one component"):
        SampledKernel(np.empty((0, 3)), np.empty((0, 4)), COMPONENT)
    with pytest.raises(ValueError, match="positive"):
        SampledKernel(np.zeros((1, 3)), se3.IDENTITY[None], COMPONENT, np.zeros(1))
