"""Success probability: against brute force of its definition, extension, calibration on a known field."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import beta

from graspdb_density import DiagonalKernel, IsotropicKernel, SuccessModel, se3
from graspdb_density.se3 import Poses

Pair = tuple[se3.Floats, se3.Floats]
Shell = Callable[[int, np.random.Generator], Pair]

KERNELS = [IsotropicKernel(0.015, math.radians(15.0)), IsotropicKernel(0.02, math.radians(30.0))]


def by_definition(
    kernel: IsotropicKernel, rows: Pair, won: NDArray[np.bool_], flags: NDArray[np.bool_], poses: Pair
) -> tuple[se3.Floats, se3.Floats]:
    """P and effective trials with every kernel above e^-12.5 of its peak, in float64."""
    probability, trials = np.empty(len(poses[0])), np.empty(len(poses[0]))
    twins = se3.jaw_twin(rows[1])
    for j, (p, q) in enumerate(zip(*poses, strict=True)):
        own = kernel.log_kernel(se3.Poses(p, q), se3.Poses(rows[0], rows[1])) - kernel.log_peak
        other = kernel.log_kernel(se3.Poses(p, q), se3.Poses(rows[0], twins)) - kernel.log_peak
        top = np.where(flags, np.maximum(own, other), own)
        k = np.where(flags, 0.5 * (np.exp(own) + np.exp(other)), np.exp(own)) * (top >= -12.5)
        share = won.mean()
        trials[j] = k.sum() ** 2 / (k @ k) if k.any() else 0.0
        p_here = (k @ won) / k.sum() if k.any() else 0.0
        probability[j] = (share + trials[j] * p_here) / (1.0 + trials[j])
    return probability, trials


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
@pytest.mark.parametrize("parts", [1, 3])
def test_equals_its_definition(kernel: IsotropicKernel, parts: int, shell: Shell) -> None:
    rng = np.random.default_rng(0)
    rows = shell(4_000, rng)
    won = rng.random(4_000) < 0.3
    flags = rng.random(4_000) < 0.8
    first, *rest = np.array_split(np.arange(4_000), parts)
    model = SuccessModel.build(
        Poses.of(rows[0][first], rows[1][first]), won[first], kernel=kernel, symmetric=flags[first]
    )
    for chunk in rest:
        model = model.extend(Poses.of(rows[0][chunk], rows[1][chunk]), won[chunk], flags[chunk])
    assert (model.size, model.worth) == (4_000, (won.sum(), 4_000))
    poses = shell(300, rng)
    poses[0][:20] += 5.0
    estimate = model.evaluate(Poses.of(*poses), threads=2)
    probability, trials = by_definition(kernel, rows, won, flags, poses)
    np.testing.assert_allclose(estimate.effective_trials, trials, rtol=3e-3, atol=1e-6)
    np.testing.assert_allclose(estimate.probability, probability, atol=1e-3)
    np.testing.assert_array_equal(estimate.effective_trials[:20], 0.0)
    np.testing.assert_allclose(estimate.probability[:20], model.prior_share)
    a, b = probability * (1 + trials), (1 - probability) * (1 + trials)
    np.testing.assert_allclose(estimate.low, beta.ppf(0.05, a, b), atol=2e-3)
    np.testing.assert_allclose(estimate.high, beta.ppf(0.95, a, b), atol=2e-3)


def test_interval_covers_the_smoothed_truth() -> None:
    """A smooth field of success; what the interval claims to cover is the field under the same kernel."""
    rng = np.random.default_rng(1)
    kernel = KERNELS[0]
    side = 0.08

    def field(p: se3.Floats, q: se3.Floats) -> se3.Floats:
        tilt = se3.rotate(q, [0.0, 0.0, 1.0])[:, 2]
        return np.asarray(0.5 + 0.45 * np.sin(p[:, 0] * 60.0) * tilt, dtype=np.float64)

    covered, count = 0, 0
    for _ in range(4):
        rows = rng.uniform(-side, side, (60_000, 3)), se3.random_quaternions(60_000, rng)
        truth = field(*rows)
        model = SuccessModel.build(Poses.of(*rows), rng.random(60_000) < truth, kernel=kernel)
        poses = rng.uniform(-side / 2, side / 2, (150, 3)), se3.random_quaternions(150, rng)
        # The field smoothed over the attempts: sin is odd in p and the jaw's turn keeps the approach.
        smoothed = np.empty(150)
        for j in range(150):
            dp, dq = kernel.sample_displacements(4_000, rng)
            smoothed[j] = field(poses[0][j] + dp, se3.multiply(poses[1][j], dq)).mean()
        estimate = model.evaluate(Poses.of(*poses))
        covered += int(np.sum((estimate.low <= smoothed) & (smoothed <= estimate.high)))
        count += 150
    assert 0.85 <= covered / count <= 0.97


def test_without_successes_the_interval_is_not_a_point() -> None:
    rows = np.zeros((20, 3)), np.tile(se3.IDENTITY, (20, 1))
    model = SuccessModel.build(Poses.of(*rows), np.zeros(20, dtype=bool), kernel=KERNELS[0])
    estimate = model.evaluate(Poses.of(rows[0][:1], rows[1][:1]))
    assert estimate.probability[0] == 0.0
    assert 0.0 < estimate.high[0] < 0.2
    assert estimate.effective_trials[0] == pytest.approx(20.0, rel=1e-5)
    sure = SuccessModel.build(Poses.of(*rows), np.ones(20, dtype=bool), kernel=KERNELS[0]).evaluate(
        Poses.of(rows[0][:1], rows[1][:1])
    )
    assert sure.probability[0] == 1.0
    assert 0.8 < sure.low[0] < 1.0


def test_a_wide_kernel_blurs_an_edge_more_than_one_half_as_wide() -> None:
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(40_000, 3)) * 0.02, se3.random_quaternions(40_000, rng)
    inside = Poses.of([[0.012, 0.0, 0.0]], se3.IDENTITY[None])
    wide, narrow = (
        SuccessModel.build(Poses.of(*rows), rows[0][:, 0] > 0.0, kernel=kernel).probability(inside)[0]
        for kernel in (
            IsotropicKernel(0.015, math.radians(60.0)),
            IsotropicKernel(0.0075, math.radians(30.0)),
        )
    )
    assert wide < narrow - 0.05


def test_bad_input_is_refused() -> None:
    p, q = np.zeros((2, 3)), np.tile(se3.IDENTITY, (2, 1))
    with pytest.raises(ValueError, match="success must be bools"):
        SuccessModel.build(Poses.of(p, q), [1, 0], kernel=KERNELS[0])
    with pytest.raises(ValueError, match="success must be from 0 to 1"):
        SuccessModel.build(Poses.of(p, q), [1.5, 0.0], kernel=KERNELS[0])
    with pytest.raises(ValueError, match="spread must be bools or float64 of shape"):
        SuccessModel.build(Poses.of(p, q), [1.0, 0.0], kernel=KERNELS[0], spread=[0.1])
    with pytest.raises(ValueError, match="symmetric"):
        SuccessModel.build(Poses.of(p, q), [True, False], kernel=KERNELS[0], symmetric=[True])
    model = SuccessModel.build(Poses.of(p, q), [True, False], kernel=KERNELS[0])
    with pytest.raises(ValueError, match="level"):
        model.evaluate(Poses.of(p, q), level=1.0)
    with pytest.raises(ValueError, match="at least one attempt"):
        SuccessModel.build(Poses.of(p[:0], q[:0]), np.zeros(0, dtype=bool), kernel=KERNELS[0]).evaluate(
            Poses.of(p, q)
        )


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 50), st.integers(1, 4))
def test_a_weight_is_as_many_attempts(seed: int, times: int) -> None:
    """Attempts that weigh ``times`` tell what as many of each tell."""
    rng = np.random.default_rng(seed)
    rows = Poses(rng.normal(size=(60, 3)) * 0.02, se3.random_quaternions(60, rng))
    won, heavy = rng.random(60) < 0.4, rng.random(60) < 0.5
    weights = np.where(heavy, float(times), 1.0)
    kernel = IsotropicKernel(0.015, 0.6)
    weighed = SuccessModel.build(rows[:30], won[:30], kernel=kernel, weights=weights[:30])
    weighed = weighed.extend(rows[30:], won[30:], weights=weights[30:])
    often = np.repeat(np.arange(60), weights.astype(int))
    repeated = SuccessModel.build(rows[often], won[often], kernel=kernel)
    at = Poses(rng.normal(size=(20, 3)) * 0.02, se3.random_quaternions(20, rng))
    (one, near), (other, far) = weighed.evaluate_near(at), repeated.evaluate_near(at)
    for name in ("probability", "low", "high", "effective_trials"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(near.widths, far.widths, rtol=1e-5)
    assert weighed.worth == pytest.approx(repeated.worth)
    assert weighed.size == 60


def test_attempts_that_count_less_say_less() -> None:
    """A fifth of an attempt each: the same share, from a fifth of the trials, with a wider interval."""
    rng = np.random.default_rng(0)
    rows = Poses(rng.normal(size=(500, 3)) * 0.01, np.tile([0.0, 0.0, 0.0, 1.0], (500, 1)))
    won = rng.random(500) < 0.5
    kernel = IsotropicKernel(0.015, 0.6)
    full = SuccessModel.build(rows, won, kernel=kernel).evaluate(rows[:50])
    fifth = SuccessModel.build(rows, won, kernel=kernel, weights=np.full(500, 0.2)).evaluate(rows[:50])
    np.testing.assert_allclose(fifth.effective_trials, 0.2 * full.effective_trials, rtol=1e-6)
    assert (fifth.high - fifth.low > full.high - full.low).all()
    with pytest.raises(ValueError, match="positive"):
        SuccessModel.build(rows, won, kernel=kernel, weights=np.zeros(500))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 50), st.integers(1, 8))
def test_k_of_n_is_one_attempt_that_succeeded_by_its_share(seed: int, tries: int) -> None:
    """Its probability is that of as many rows, k of them successes, and it counts as one in the interval."""
    rng = np.random.default_rng(seed)
    rows = Poses(rng.normal(size=(40, 3)) * 0.02, se3.random_quaternions(40, rng))
    successes = rng.integers(0, tries, 40, endpoint=True)
    kernel = IsotropicKernel(0.015, 0.6)
    first, rest = slice(0, 15), slice(15, 40)
    model = SuccessModel.build(rows[first], successes[first] / tries, kernel=kernel)
    model = model.extend(rows[rest], successes[rest] / tries)
    each = np.repeat(np.arange(40), tries)
    won = np.concatenate([np.arange(tries) < k for k in successes])
    repeated = SuccessModel.build(rows[each], won, kernel=kernel, weights=np.full(len(each), 1.0 / tries))
    at = Poses(rng.normal(size=(20, 3)) * 0.02, se3.random_quaternions(20, rng))
    one, other = model.evaluate(at), repeated.evaluate(at)
    for name in ("probability", "low", "high", "effective_trials"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-4, atol=1e-6)
    assert model.size == 40
    assert model.worth == pytest.approx((successes.sum() / tries, 40.0))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 50))
def test_what_either_judge_says_lies_within_the_interval(seed: int) -> None:
    """Two judges of the same attempts: the interval of both holds the share that each alone tells."""
    rng = np.random.default_rng(seed)
    rows = Poses(rng.normal(size=(60, 3)) * 0.02, se3.random_quaternions(60, rng))
    one, other = rng.random((2, 60)) < 0.5
    kernel = IsotropicKernel(0.015, 0.6)
    spread = 0.5 * np.abs(one.astype(float) - other)
    both = SuccessModel.build(rows, 0.5 * (one + other.astype(float)), kernel=kernel, spread=spread)
    agreed = SuccessModel.build(rows, 0.5 * (one + other.astype(float)), kernel=kernel)
    at = Poses(rng.normal(size=(20, 3)) * 0.02, se3.random_quaternions(20, rng))
    found, without = both.evaluate(at), agreed.evaluate(at)
    np.testing.assert_array_equal(found.probability, without.probability)
    assert (found.low <= without.low).all()
    assert (found.high >= without.high).all()
    np.testing.assert_array_equal(both.lower_end(at), found.low)
    for won in (one, other):
        told = SuccessModel.build(rows, won, kernel=kernel).probability(at)
        # The prior's own share differs between the judges, too, and counts as one attempt.
        slack = abs(won.mean() - agreed.prior_share) / (1.0 + found.effective_trials)
        assert (found.low - slack - 1e-9 <= told).all()
        assert (told <= found.high + slack + 1e-9).all()


@pytest.mark.parametrize("fixed", [False, True])
def test_attempts_are_told_as_they_came_and_some_are_left_out_as_if_they_had_not_come(fixed: bool) -> None:
    rng = np.random.default_rng(3)
    poses = Poses(rng.normal(0, 0.02, (300, 3)), se3.random_quaternions(300, rng))
    share = rng.choice([0.0, 0.5, 1.0], 300)
    weights = rng.choice([0.5, 1.0], 300)
    symmetric = rng.random(300) < 0.7
    kernel = (
        DiagonalKernel.of([0.01, 0.02, 0.03, 0.3, 0.3, 0.4], np.eye(3)[[1, 2, 0]])
        if fixed
        else IsotropicKernel(0.02, 0.3)
    )
    model = SuccessModel.build(poses, share, kernel=kernel, symmetric=symmetric, weights=weights)
    told = model.attempts()
    order = np.lexsort(told.poses.positions.T)
    mine = np.lexsort(poses.positions.T)
    np.testing.assert_allclose(told.poses.positions[order], poses.positions[mine], atol=1e-7)
    for found, posted in ((told.share, share), (told.weight, weights), (told.symmetric, symmetric)):
        np.testing.assert_array_equal(found[order], posted[mine])
    out = rng.random(300) < 0.3

    def of(rows: NDArray[np.bool_]) -> SuccessModel:
        return SuccessModel.build(
            poses[rows], share[rows], kernel=kernel, symmetric=symmetric[rows], weights=weights[rows]
        )

    asked = poses[:50]
    p, n = model.without(of(out), asked)
    rest = of(~out).evaluate(asked)
    np.testing.assert_allclose(p, rest.probability, atol=2e-3)
    np.testing.assert_allclose(n, rest.effective_trials, rtol=2e-3, atol=1e-3)
    # Where all that tell are left out nothing does.
    far = Poses(np.full((1, 3), 5.0), np.array([[0.0, 0, 0, 1]]))
    lone = model.extend(far, np.array([1.0]))
    p, n = lone.without(SuccessModel.build(far, np.array([1.0]), kernel=kernel), far)
    assert n[0] == 0.0
    assert p[0] == pytest.approx(model.prior_share)
