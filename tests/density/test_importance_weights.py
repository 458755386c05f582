"""Weights that undo the choice of trials."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspdb_density import effective_sample_size, importance_weights
from graspdb_density.kde.importance_weights import pooled_density

POSITIVE = st.lists(st.floats(1e-12, 1e12), min_size=1, max_size=30)


@given(POSITIVE, st.floats(1e-6, 1e6))
def test_reciprocal_normalised_and_free_of_units(g: list[float], unit: float) -> None:
    w = importance_weights(g)
    assert w.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(w * np.array(g), w[0] * g[0], rtol=1e-9)
    np.testing.assert_allclose(importance_weights(np.array(g) * unit), w, rtol=1e-9)


def test_unknown_densities_take_the_mean_of_the_rest() -> None:
    w = importance_weights([1.0, None, 3.0, math.nan])  # type: ignore[list-item]
    assert w[1] == w[3] == pytest.approx((w[0] + w[2]) / 2.0)
    np.testing.assert_allclose(importance_weights([math.nan] * 4), 0.25)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.inf])
def test_impossible_densities_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="positive and finite"):
        importance_weights([1.0, bad])


def test_mixture_recovers_an_expectation_that_own_weights_recover_badly() -> None:
    """Two strategies on [0, 1]: the mean of x^2 under the uniform density, from trials of both."""
    rng = np.random.default_rng(0)
    counts = np.array([20_000, 20_000])
    x = np.concatenate([rng.random(counts[0]), rng.beta(5.0, 1.0, counts[1])])
    densities = np.stack([np.ones_like(x), 5.0 * x**4], axis=1)
    mixed = importance_weights(pooled_density(densities, counts))
    assert mixed.sum() == pytest.approx(1.0)
    assert mixed @ x**2 == pytest.approx(1.0 / 3.0, abs=0.005)
    own = importance_weights(np.concatenate([densities[: counts[0], 0], densities[counts[0] :, 1]]))
    assert effective_sample_size(mixed) > 3.0 * effective_sample_size(own)


def test_one_strategy_weighs_by_its_reciprocal() -> None:
    g = np.array([0.5, 2.0, 4.0])
    np.testing.assert_allclose(importance_weights(pooled_density(g[:, None], [3])), importance_weights(g))
    with pytest.raises(ValueError, match="positive and finite"):
        importance_weights(pooled_density([[0.0]], [1]))
    with pytest.raises(ValueError, match="shape"):
        pooled_density([[1.0]], [1, 2])


def test_effective_sample_size() -> None:
    assert effective_sample_size([2.0] * 7) == pytest.approx(7.0)
    assert effective_sample_size([1.0, 0.0]) == pytest.approx(1.0)
    assert effective_sample_size([]) == 0.0


def test_pooled_strategies_weigh_as_the_mixture_does() -> None:
    """Two grids, one over half of the other: in the overlap each trial counts for what both have tried."""
    inside = np.array([False, False, True, True])
    densities = np.stack([np.full(4, 1.0), np.where(inside, 2.0, 0.0)], axis=1)
    pooled = pooled_density(densities, [100, 300])
    np.testing.assert_allclose(pooled, np.where(inside, 1.75, 0.25))
    tried = densities @ [100, 300]
    np.testing.assert_allclose(importance_weights(pooled), (1 / tried) / (1 / tried).sum())
    # One strategy by itself is what it says, whatever it drew.
    np.testing.assert_allclose(pooled_density(densities[:, :1], [7]), 1.0)
    with pytest.raises(ValueError, match="at least one strategy"):
        pooled_density(densities, [0, 0])
