"""Calibration measures against definitions, scikit-learn and simulated coverage."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import brier_score_loss, roc_auc_score

from graspdb_density.success import calibration as cal


def _data(seed: int, count: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    p = np.round(rng.random(count), 2)
    y = rng.random(count) < p
    y[:2] = True, False
    return p, y, rng.uniform(0.1, 3.0, count)


@given(st.integers(0, 10_000), st.booleans())
@settings(max_examples=40, deadline=None)
def test_scores_agree_with_scikit_learn(seed: int, weighted: bool) -> None:
    p, y, w = _data(seed)
    weights = w if weighted else None
    assert cal.calibrate(p, y, weights=weights).brier == pytest.approx(
        brier_score_loss(y, p, sample_weight=weights)
    )
    assert cal.area_under_curve(p, y, weights=weights) == pytest.approx(
        roc_auc_score(y, p, sample_weight=weights)
    )


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_weights_are_repetitions(seed: int) -> None:
    p, y, _ = _data(seed, 60)
    times = np.random.default_rng(seed).integers(1, 5, 60)
    one = cal.calibrate(p, y, weights=times.astype(float))
    two = cal.calibrate(np.repeat(p, times), np.repeat(y, times))
    for name in ("brier", "skill", "ece", "auc"):
        assert getattr(one, name) == pytest.approx(getattr(two, name), nan_ok=True)
    for a, b in zip(one.bins, two.bins, strict=True):
        assert (a.predicted, a.observed, a.weight) == pytest.approx(
            (b.predicted, b.observed, b.weight), nan_ok=True
        )


def test_skill_of_known_forecasts() -> None:
    y = np.array([True] * 30 + [False] * 70)
    assert cal.brier_skill(y.astype(float), y) == 1.0
    assert cal.brier_skill(np.full(100, 0.3), y) == pytest.approx(0.0)
    assert cal.brier_skill(1.0 - y, y) < -3.0
    assert math.isnan(cal.brier_skill(np.full(5, 0.9), np.ones(5, dtype=bool)))
    assert math.isnan(cal.area_under_curve([0.1, 0.2], [True, True]))


def test_ece_counts_only_predictions_above_the_limit() -> None:
    p = np.concatenate([np.full(1_000, 0.05), np.full(100, 0.6), np.full(100, 0.9)])
    y = np.concatenate([np.zeros(1_000), np.arange(100) < 50, np.arange(100) < 90]).astype(bool)
    assert cal.expected_calibration_error(p, y) == pytest.approx(0.05)
    assert math.isnan(cal.expected_calibration_error([0.05, 0.1], [False, True]))


def test_bins_hold_what_they_say() -> None:
    p, y, w = _data(1, 2_000)
    bins = cal.reliability(p, y, weights=w, bins=[0.0, 0.1, 0.5, 1.0])
    assert [b.count for b in bins] == [int(((p >= a) & (p < b)).sum()) for a, b in ((0, 0.1), (0.1, 0.5))] + [
        int((p >= 0.5).sum())
    ]
    assert sum(b.weight for b in bins) == pytest.approx(1.0)
    inside = (p >= 0.1) & (p < 0.5)
    assert bins[1].predicted == pytest.approx(np.average(p[inside], weights=w[inside]))
    assert bins[1].observed == pytest.approx(np.average(y[inside], weights=w[inside]))
    empty = cal.reliability([0.95, 1.0], [True, True])
    assert empty[-1].count == 2
    assert empty[0].count == 0
    assert math.isnan(empty[0].observed)
    assert math.isnan(empty[0].low)
    assert empty[-1].high == 1.0
    assert 0.2 < empty[-1].low < 0.9


@pytest.mark.parametrize("in_blocks", [False, True])
def test_intervals_cover_the_truth(in_blocks: bool) -> None:
    """With outcomes alike within blocks, intervals over blocks cover; as if independent they would not."""
    rng = np.random.default_rng(2)
    hits = naive = 0
    for seed in range(120):
        if in_blocks:
            block = np.repeat(np.arange(60), 20)
            chance = rng.beta(2.0, 2.0, 60)[block]
        else:
            block, chance = None, np.full(300, 0.5)
        y = rng.random(len(chance)) < chance
        p = np.full(len(chance), 0.55)
        middle = cal.reliability(p, y, blocks=block, bins=1, seed=seed)[0]
        hits += middle.low <= 0.5 <= middle.high
        plain = cal.reliability(p, y, bins=1)[0]
        naive += plain.low <= 0.5 <= plain.high
    assert 0.82 <= hits / 120 <= 0.98
    if in_blocks:
        assert naive / 120 < 0.7


def test_skill_interval_covers() -> None:
    rng = np.random.default_rng(3)
    truth = rng.random(200_000)
    expected = cal.brier_skill(truth, rng.random(200_000) < truth)
    hits = 0
    for seed in range(80):
        p = rng.random(500)
        got = cal.calibrate(p, rng.random(500) < p, seed=seed)
        assert got.skill_low <= got.skill <= got.skill_high
        hits += got.skill_low <= expected <= got.skill_high
    assert 0.8 <= hits / 80 <= 1.0


def test_bad_input_is_named() -> None:
    for bad in ([0.5, np.nan], [0.5, 1.2], [-0.1, 0.2]):
        with pytest.raises(ValueError, match="probabilities"):
            cal.brier_skill(bad, [True, False])
    with pytest.raises(ValueError, match="one length"):
        cal.brier_skill([0.5], [True, False])
    with pytest.raises(ValueError, match="at least 1"):
        cal.brier_skill([], [])
    with pytest.raises(ValueError, match="true or false"):
        cal.brier_skill([0.5, 0.5], [0, 2])
    with pytest.raises(ValueError, match="weights"):
        cal.brier_skill([0.5, 0.5], [0, 1], weights=[0.0, 0.0])
    with pytest.raises(ValueError, match="rising"):
        cal.reliability([0.5, 0.5], [0, 1], bins=[0.0, 0.5, 0.5, 1.0])
    # Scores for ranking may be anything but nan.
    assert cal.area_under_curve([-np.inf, 7.0], [False, True]) == 1.0


@given(st.integers(0, 1_000), st.floats(0.02, 0.06), st.integers(2, 6))
@settings(max_examples=30, deadline=None)
def test_blocks_are_cubes_in_balanced_folds(seed: int, edge: float, folds: int) -> None:
    rng = np.random.default_rng(seed)
    p = rng.uniform(-0.1, 0.1, (600, 3))
    got = cal.assign_blocks(p, edge_m=edge, folds=folds, seed=seed)
    for b in range(got.count):
        inside = got.block == b
        assert np.all(np.ptp(p[inside], axis=0) <= edge)
        assert len(set(got.fold[inside])) == 1
    sizes = np.bincount(got.fold, minlength=got.folds)
    assert len(sizes) == folds
    assert sizes.max() - sizes.min() <= np.bincount(got.block).max()
    again = cal.assign_blocks(p, edge_m=edge, folds=folds, seed=seed)
    np.testing.assert_array_equal(got.fold, again.fold)


def test_one_block_is_refused() -> None:
    # Positions at one place share a cube wherever its origin lies.
    with pytest.raises(ValueError, match="one block"):
        cal.assign_blocks(np.zeros((9, 3)), edge_m=0.05)
    with pytest.raises(ValueError, match="edge_m"):
        cal.assign_blocks(np.zeros((9, 3)), edge_m=0.0)
