"""Maps from one source's probabilities to another's: what they recover, and that few trials change little."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.special import expit, logit

from graspdb_density.success.source_map import (
    PRIOR_SHIFT,
    PRIOR_SLOPE,
    fit_source_map,
    judge_source_map,
)

GRID = np.linspace(0.02, 0.98, 25)


def found(count: int, shift: float, slope: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predictions, outcomes whose chance is the map of them, and a block each."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(0.02, 0.98, count)
    return p, rng.random(count) < expit(shift + slope * logit(p)), np.arange(count)


def test_without_trials_it_changes_nothing() -> None:
    nothing = np.empty(0)
    identity = fit_source_map(nothing, nothing.astype(bool), nothing.astype(int))
    np.testing.assert_allclose(identity.probability(GRID), GRID, atol=1e-12)
    np.testing.assert_allclose(identity.covariance, np.diag([PRIOR_SHIFT**2, PRIOR_SLOPE**2]))
    low, high = identity.interval([0.5], [0.5], [0.5])
    assert logit(high[0]) == pytest.approx(1.6449 * PRIOR_SHIFT, rel=1e-3)
    assert low[0] == pytest.approx(1.0 - high[0])


@given(st.lists(st.booleans(), min_size=5, max_size=5), st.floats(0.2, 0.8))
def test_five_trials_of_one_spot_change_little(won: list[bool], p: float) -> None:
    changed = fit_source_map(np.full(5, p), np.array(won), np.zeros(5, dtype=int))
    assert np.abs(changed.probability(GRID) - GRID).max() < 0.26


@pytest.mark.parametrize(("shift", "slope"), [(0.0, 1.0), (-1.5, 0.7), (1.0, 1.3), (0.5, 0.0)])
def test_many_trials_tell_the_map(shift: float, slope: float) -> None:
    fitted = fit_source_map(*found(20_000, shift, slope))
    assert (fitted.shift, fitted.slope) == (pytest.approx(shift, abs=0.1), pytest.approx(slope, abs=0.1))
    np.testing.assert_allclose(np.sqrt(np.diag(fitted.covariance)), 0.0, atol=0.05)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1_000), st.integers(1, 60), st.integers(1, 20))
def test_it_is_the_maximum_of_the_posterior(seed: int, count: int, blocks: int) -> None:
    rng = np.random.default_rng(seed)
    p, won, block = rng.uniform(0.02, 0.98, count), rng.random(count) < 0.5, rng.integers(0, blocks, count)
    sizes = np.bincount(block)[block]
    weight, x = 1.0 / (1.0 + 0.1 * (sizes - 1)), logit(p)

    def loss(at: np.ndarray) -> float:
        z = at[0] + at[1] * x
        prior = at[0] ** 2 / PRIOR_SHIFT**2 + (at[1] - 1.0) ** 2 / PRIOR_SLOPE**2
        return float(weight @ (np.logaddexp(0.0, z) - won * z) + 0.5 * prior)

    fitted = fit_source_map(p, won, block)
    best = minimize(loss, [0.0, 1.0], bounds=[(-20, 20), (0, 20)])
    assert loss(np.array([fitted.shift, fitted.slope])) <= best.fun + 1e-6
    assert fitted.slope >= 0.0
    assert fitted.effective_trials == pytest.approx(weight.sum())


def test_trials_of_one_spot_count_as_few() -> None:
    """300 at one place say no more than ten elsewhere, however sure they look."""
    one = fit_source_map(np.full(300, 0.9), np.zeros(300, dtype=bool), np.zeros(300, dtype=int))
    assert one.effective_trials < 10.0
    apart = fit_source_map(np.full(300, 0.9), np.zeros(300, dtype=bool), np.arange(300))
    assert apart.probability([0.9])[0] < one.probability([0.9])[0] < 0.9


@given(st.integers(0, 200), st.floats(0.0, 1.0), st.floats(0.0, 0.3))
def test_intervals_hold_the_estimate_and_the_maps_doubt(seed: int, p: float, half: float) -> None:
    fitted = fit_source_map(*found(30, -1.0, 0.8, seed))
    low, high = max(p - half, 0.0), min(p + half, 1.0)
    corrected = fitted.probability([p])
    ends = fitted.interval([p], [low], [high])
    alone = fitted.interval([p], [p], [p])
    assert ends[0] <= alone[0] <= corrected <= alone[1] <= ends[1]
    mapped = fitted.probability([low, high])
    assert ends[0] <= mapped[0] + 1e-12
    assert ends[1] >= mapped[1] - 1e-12


def test_a_map_that_helps_is_told_from_one_that_does_not() -> None:
    off = judge_source_map(*found(400, -2.0, 1.0))
    assert (off.verdict, off.informative) == ("better", True)
    assert off.brier < off.uncorrected_brier
    right = judge_source_map(*found(400, 0.0, 1.0))
    assert right.informative
    assert abs(right.gain) < 0.005
    nothing = judge_source_map(*found(400, 0.0, 0.0))
    assert not nothing.informative


def test_left_out_trials_claim_no_gain_by_chance() -> None:
    """Where simulation is right, a correction is called better in one of twenty at most."""
    claims = sum(judge_source_map(*found(60, 0.0, 1.0, seed)).verdict == "better" for seed in range(100))
    assert claims <= 12


@pytest.mark.parametrize(("count", "blocks"), [(19, 19), (300, 1), (300, 4)])
def test_too_few_judge_nothing(count: int, blocks: int) -> None:
    p, won, number = found(count, -2.0, 1.0)
    judged = judge_source_map(p, won, number % blocks)
    assert judged.verdict == "undecided"
    assert math.isnan(judged.brier)


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="probabilities"):
        fit_source_map([1.5], [True], [0])
    with pytest.raises(ValueError, match="bools"):
        fit_source_map([0.5], [1], [0])
