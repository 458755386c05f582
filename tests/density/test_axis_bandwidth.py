"""Success under a width for every axis: against sums in NumPy, and widths found on fields that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspdb_density import DiagonalKernel, IsotropicKernel, SuccessModel, se3
from graspdb_density.se3 import Floats, Poses
from graspdb_density.success.axis_bandwidth import AxisBandwidths, fit_axis_bandwidths
from graspdb_density.success.kernel_regression import PRIOR_TRIALS, SUCCESS_CUTOFF

WIDTHS = np.array([0.006, 0.02, 0.009, 0.1, 0.4, 0.15])


def scattered(count: int, seed: int) -> tuple[Floats, Floats, np.ndarray]:
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(count, 3)) * 0.015
    turns = se3.from_rotation_vector(rng.normal(size=(count, 3)) * 0.3)
    q = se3.multiply(se3.random_quaternions(3, rng)[rng.integers(3, size=count)], turns)
    return p, q, rng.random(count) < 0.4


def brute(
    p: Floats, q: Floats, won: np.ndarray, twin: np.ndarray, x: Floats, r: Floats, widths: Floats
) -> tuple[float, float]:
    """Probability and effective number of trials at one pose."""
    k = np.zeros(len(p))
    for flags, turned in ((np.ones(len(p), bool), q), (twin, se3.jaw_twin(q))):
        shift = np.einsum("nji,nj->ni", se3.to_matrix(turned), x - p)
        turn = se3.to_rotation_vector(se3.canonical(se3.multiply(se3.conjugate(turned), r)))
        exponent = 0.5 * np.sum((np.concatenate([shift, turn], axis=1) / widths) ** 2, axis=1)
        k += flags * np.where(exponent <= 0.5 * SUCCESS_CUTOFF**2, np.exp(-exponent), 0.0)
    if not k.any():
        return float(won.mean()), 0.0
    n = k.sum() ** 2 / (k**2).sum()
    share = (k * won).sum() / k.sum()
    return float((PRIOR_TRIALS * won.mean() + n * share) / (PRIOR_TRIALS + n)), float(n)


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_the_model_is_the_sum_over_attempts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p, q, won = scattered(300, seed)
    won[:2] = True, False
    twin = rng.random(300) < 0.6
    model = SuccessModel.build(Poses.of(p, q), won, kernel=DiagonalKernel.of(WIDTHS), symmetric=twin)
    at = rng.integers(300, size=20)
    x = p[at] + rng.normal(size=(20, 3)) * 0.008
    r = se3.multiply(q[at], se3.from_rotation_vector(rng.normal(size=(20, 3)) * 0.2))
    found = model.evaluate(Poses.of(x, r))
    for j in range(20):
        chance, trials = brute(p, q, won, twin, x[j], r[j], WIDTHS)
        assert found.effective_trials[j] == pytest.approx(trials, rel=2e-3, abs=1e-6)
        assert found.probability[j] == pytest.approx(chance, abs=2e-4)
    assert (found.low <= found.probability + 1e-9).all()
    assert (found.probability <= found.high + 1e-9).all()
    # The order of coming does not matter, nor which way round a symmetric jaw is held.
    grown = SuccessModel.build(
        Poses.of(p[:120], q[:120]), won[:120], kernel=DiagonalKernel.of(WIDTHS), symmetric=twin[:120]
    )
    grown = grown.extend(Poses.of(p[120:], q[120:]), won[120:], twin[120:])
    np.testing.assert_allclose(grown.evaluate(Poses.of(x, r)).probability, found.probability, atol=1e-5)
    assert (grown.size, grown.worth) == (300, (won.sum(), 300))
    every = SuccessModel.build(Poses.of(p, q), won, kernel=DiagonalKernel.of(WIDTHS))
    np.testing.assert_allclose(
        every.evaluate(Poses.of(x, se3.jaw_twin(r))).probability,
        every.evaluate(Poses.of(x, r)).probability,
        atol=1e-5,
    )


def test_fixed_axes_are_those_of_the_sum() -> None:
    rng = np.random.default_rng(5)
    p, q, won = scattered(300, 5)
    axes = se3.to_matrix(se3.random_quaternions(1, rng))[0]
    model = SuccessModel.build(Poses.of(p[:200], q[:200]), won[:200], kernel=DiagonalKernel.of(WIDTHS, axes))
    model = model.extend(Poses.of(p[200:], q[200:]), won[200:])
    at = rng.integers(300, size=20)
    x = p[at] + rng.normal(size=(20, 3)) * 0.008
    r = se3.multiply(q[at], se3.from_rotation_vector(rng.normal(size=(20, 3)) * 0.2))
    found = model.evaluate(Poses.of(x, r))
    narrow = SuccessModel.build(Poses.of(p, q), won, kernel=DiagonalKernel.of(0.5 * WIDTHS, axes)).evaluate(
        Poses.of(x, r)
    )
    for j in range(20):
        k = np.zeros((2, 300))
        for turned in (q, se3.jaw_twin(q)):
            shift = (x[j] - p) @ axes
            turn = se3.to_rotation_vector(se3.canonical(se3.multiply(se3.conjugate(turned), r[j])))
            for row, widths in enumerate((WIDTHS, 0.5 * WIDTHS)):
                e = 0.5 * np.sum((np.concatenate([shift, turn], axis=1) / widths) ** 2, axis=1)
                k[row] += np.where(e <= 0.5 * SUCCESS_CUTOFF**2, np.exp(-e), 0.0)
        told = []
        for weight in k:
            trials = weight.sum() ** 2 / max((weight**2).sum(), 1e-300)
            share = (weight * won).sum() / max(weight.sum(), 1e-300)
            told.append((PRIOR_TRIALS * won.mean() + trials * share) / (PRIOR_TRIALS + trials))
        assert found.probability[j] == pytest.approx(told[0], abs=2e-4)
        assert narrow.probability[j] == pytest.approx(told[1], abs=2e-4)
    with pytest.raises(ValueError, match="orthonormal"):
        SuccessModel.build(Poses.of(p, q), won, kernel=DiagonalKernel.of(WIDTHS, 2.0 * axes))


def test_equal_widths_agree_with_the_isotropic_model() -> None:
    p, q, won = scattered(4_000, 3)
    kernel = IsotropicKernel(0.008, math.radians(9.0))
    widths = np.repeat([kernel.sigma_position_m, kernel.sigma_rotation], 3)
    plain = SuccessModel.build(Poses.of(p, q), won, kernel=kernel)
    shaped = SuccessModel.build(Poses.of(p, q), won, kernel=DiagonalKernel.of(widths))
    x, r, _ = scattered(300, 4)
    ours, theirs = shaped.evaluate(Poses.of(x, r)), plain.evaluate(Poses.of(x, r))
    assert np.abs(ours.probability - theirs.probability).mean() < 5e-3
    with pytest.raises(ValueError, match="widths"):
        SuccessModel.build(Poses.of(p, q), won, kernel=DiagonalKernel.of(np.zeros(6)))


def field(count: int, seed: int) -> tuple[Floats, Floats, np.ndarray]:
    """Success alternates over 24 mm along the gripper's x, and knows nothing of the rest."""
    rng = np.random.default_rng(seed)
    base = se3.random_quaternions(1, rng)[0]
    p = rng.uniform(-0.09, 0.09, (count, 3))
    q = se3.multiply(base, se3.from_rotation_vector(rng.normal(size=(count, 3)) * 0.12))
    across = p @ se3.to_matrix(base)[:, 0]
    return p, q, rng.random(count) < 0.5 + 0.45 * np.sin(2.0 * math.pi * across / 0.048)


@pytest.fixture(scope="module")
def fitted() -> AxisBandwidths:
    return fit_axis_bandwidths(Poses.of(*field(8_000, 0)[:2]), field(8_000, 0)[2], symmetric=False)


def test_widths_are_narrow_where_success_changes_and_wide_where_not(fitted: AxisBandwidths) -> None:
    x, y, z = fitted.kernel.sigmas[:3]
    assert x < 0.012
    assert min(y, z) > 1.8 * x
    assert fitted.log_loss < fitted.isotropic_log_loss - 0.02
    assert fitted.skill > fitted.isotropic_skill + 0.03
    assert 0 < fitted.judged < fitted.attempts == 8_000


def test_the_gain_holds_for_attempts_never_seen(fitted: AxisBandwidths) -> None:
    p, q, won = field(8_000, 0)
    rng = np.random.default_rng(9)
    x, r, _ = field(3_000, 0)
    x = x + rng.normal(size=x.shape) * 0.004
    base = se3.random_quaternions(1, np.random.default_rng(0))[0]
    truth = 0.5 + 0.45 * np.sin(2.0 * math.pi * (x @ se3.to_matrix(base)[:, 0]) / 0.048)
    shaped = SuccessModel.build(Poses.of(p, q), won, kernel=fitted.kernel, symmetric=False)
    plain = SuccessModel.build(Poses.of(p, q), won, kernel=fitted.isotropic, symmetric=False)
    errors = [np.mean((model.evaluate(Poses.of(x, r)).probability - truth) ** 2) for model in (shaped, plain)]
    assert errors[0] < 0.8 * errors[1]


def test_along_a_body_s_axis_widths_are_wide_however_grippers_are_turned() -> None:
    """Success changes across a line in the object and not along it; grippers point every way."""
    rng = np.random.default_rng(2)
    p = rng.uniform(-0.04, 0.04, (12_000, 3))
    q = se3.from_rotation_vector(rng.normal(size=(len(p), 3)) * 0.6)
    line = se3.to_matrix(se3.random_quaternions(1, rng))[0]
    chance = 0.5 + 0.45 * np.sin(2.0 * math.pi * (p @ line[:, 1]) / 0.04)
    won = rng.random(len(p)) < chance
    along, gripper = (
        fit_axis_bandwidths(Poses.of(p, q), won, axes=line),
        fit_axis_bandwidths(Poses.of(p, q), won),
    )
    assert along.kernel.sigmas[0] > 1.8 * along.kernel.sigmas[1]
    assert along.log_loss < gripper.log_loss - 0.02
    assert along.skill > gripper.skill + 0.02
    # The best isotropic kernel knows of no axes.
    assert along.isotropic_log_loss == pytest.approx(gripper.isotropic_log_loss)


def test_too_little_is_said_with_numbers() -> None:
    p, q, won = scattered(200, 1)
    won[:] = False
    won[:20] = True
    with pytest.raises(ValueError, match="at least 50 successes and 50 failures; there are 20 and 180"):
        fit_axis_bandwidths(Poses.of(p, q), won)
    won[:100] = True
    with pytest.raises(ValueError, match="one block"):
        fit_axis_bandwidths(Poses.of(np.zeros((200, 3)), q), won)
