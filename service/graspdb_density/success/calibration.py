"""Can the numbers be believed? Predicted success probabilities against outcomes they have not seen.

Predictions must come from data that does not hold the neighbours of what they predict: `assign_blocks` makes
the folds. All measures take sample weights, since outcomes are often subsampled by kind (most poses of a grid
collide) and the statement is about all of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv

from ..se3 import Floats

__all__ = [
    "Blocks",
    "Calibration",
    "ReliabilityBin",
    "area_under_curve",
    "assign_blocks",
    "brier_skill",
    "calibrate",
    "expected_calibration_error",
    "jeffreys_interval",
    "numbered",
    "reliability",
]

_RESAMPLES = 400
#: Predictions above this enter the expected calibration error: below lies the sea of poses that nobody would
#: try and every model gets right.
ECE_ABOVE = 0.1


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """Predictions in ``[lower, upper)`` (the last bin includes its end) and how often they came true.

    ``predicted``, ``observed``, ``low`` and ``high`` are nan in an empty bin. ``count`` is the number of
    predictions, ``weight`` their share of all weight.
    """

    lower: float
    upper: float
    count: int
    weight: float
    predicted: float
    observed: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Calibration:
    """All measures of one set of predictions.

    Attributes
    ----------
    brier : float
        Mean squared difference between prediction and outcome (Brier 1950).
    skill, skill_low, skill_high : float
        ``1 - brier / (m (1 - m))`` with m the share of successes: 1 is perfect, 0 no better than always
        saying m; interval over blocks (or predictions where none are given).
    ece : float
        Expected calibration error over predictions above `ECE_ABOVE`; nan without any.
    auc : float
        Chance that a success is ranked above a failure; nan where one of them is missing.
    """

    bins: tuple[ReliabilityBin, ...]
    count: int
    successes: int
    brier: float
    skill: float
    skill_low: float
    skill_high: float
    ece: float
    auc: float


@dataclass(frozen=True, eq=False, slots=True)
class Blocks:
    """Cubes of space and the folds they belong to.

    Attributes
    ----------
    block : (N,) int64
        Number of the cube of every row, 0 .. count - 1.
    fold : (N,) int64
        Fold of that cube.
    count, folds : int
    """

    block: NDArray[np.int64]
    fold: NDArray[np.int64]
    count: int
    folds: int


def _checked(
    predictions: ArrayLike, outcomes: ArrayLike, weights: ArrayLike | None, *, probability: bool = True
) -> tuple[Floats, Floats, Floats]:
    p, y = np.array(predictions, dtype=np.float64), np.asarray(outcomes)
    if p.ndim != 1 or y.shape != p.shape or not len(p):
        raise ValueError("predictions and outcomes are arrays (N,) of one length, at least 1")
    y = y.astype(np.float64)
    if not np.all((y >= 0.0) & (y <= 1.0)):
        raise ValueError("outcomes are true or false, or shares from 0 to 1")
    if np.isnan(p).any() or (probability and not np.all((p >= 0.0) & (p <= 1.0))):
        raise ValueError("predictions must be probabilities" if probability else "scores must not be nan")
    w = np.ones(len(p)) if weights is None else np.array(weights, dtype=np.float64)
    if w.shape != p.shape or not np.all(np.isfinite(w)) or np.any(w < 0.0) or not w.sum() > 0.0:
        raise ValueError("weights are not negative, finite, (N,), and not all zero")
    return p, y, w


def _squared_error(p: Floats, y: Floats) -> Floats:
    """Mean squared error (N,) of predictions over tries, of which these shares succeed."""
    return np.asarray(p * p - 2.0 * p * y + y)


def brier_skill(predictions: ArrayLike, outcomes: ArrayLike, *, weights: ArrayLike | None = None) -> float:
    """``1 - brier / (m (1 - m))``, m the share of successes; nan where all outcomes are the same."""
    p, y, w = _checked(predictions, outcomes, weights)
    share = float(np.average(y, weights=w))
    reference = share * (1.0 - share)
    error = float(np.average(_squared_error(p, y), weights=w))
    return 1.0 - error / reference if reference > 0.0 else math.nan


def reliability(
    predictions: ArrayLike,
    outcomes: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    blocks: ArrayLike | None = None,
    bins: int | ArrayLike = 10,
    level: float = 0.9,
    seed: int = 0,
) -> tuple[ReliabilityBin, ...]:
    """The reliability diagram: how often predictions of about the same value came true.

    Parameters
    ----------
    predictions : (N,) in [0, 1]
    outcomes : (N,) bool, or float from 0 to 1
        Whether each succeeded, or by what share of several tries.
    weights : (N,) or None
    blocks : (N,) int or None
        Outcomes of neighbours are alike. Given blocks, intervals come from resampling whole blocks; without,
        from the Beta distribution of the effective count (Jeffreys' prior), as if outcomes were independent.
        A bin that meets fewer than three blocks has Jeffreys' interval of as many trials.
    bins : int or rising edges from 0 to 1
    """
    p, y, w = _checked(predictions, outcomes, weights)
    edges = np.linspace(0.0, 1.0, bins + 1) if isinstance(bins, int) else np.array(bins, dtype=np.float64)
    rising = edges.ndim == 1 and len(edges) > 1 and bool(np.all(np.diff(edges) > 0.0))
    if not rising or edges[0] != 0.0 or edges[-1] != 1.0:
        raise ValueError("bins are a positive number or edges rising from 0 to 1")
    count = len(edges) - 1
    place = np.minimum(np.searchsorted(edges, p, side="right") - 1, count - 1)
    total = _tally(place, w, count)
    number = np.bincount(place, minlength=count)
    predicted = _ratio(_tally(place, w * p, count), total)
    observed = _ratio(_tally(place, w * y, count), total)
    effective = _ratio(total**2, _tally(place, w * w, count))
    low, high = _bin_intervals(place, y, w, observed, effective, blocks, level, seed)
    return tuple(
        ReliabilityBin(
            lower=float(edges[i]),
            upper=float(edges[i + 1]),
            count=int(number[i]),
            weight=float(total[i] / w.sum()),
            predicted=float(predicted[i]),
            observed=float(observed[i]),
            low=float(low[i]),
            high=float(high[i]),
        )
        for i in range(count)
    )


def _tally(place: NDArray[np.int64], weights: Floats, count: int) -> Floats:
    """Sum of weights at each place, (count,)."""
    return np.asarray(np.bincount(place, weights=weights, minlength=count), dtype=np.float64)


def _ratio(top: Floats, bottom: Floats) -> Floats:
    return np.asarray(np.where(bottom > 0.0, top / np.where(bottom > 0.0, bottom, 1.0), np.nan))


def jeffreys_interval(share: ArrayLike, trials: ArrayLike, level: float) -> tuple[Floats, Floats]:
    """The interval of shares (n,) of independent trials (n,), which includes what was seen; nan where
    nothing was.
    """
    share, trials = np.asarray(share, dtype=np.float64), np.asarray(trials, dtype=np.float64)
    known = np.isfinite(share) & (trials > 0.0)
    s, n = np.where(known, share, 0.5), np.where(known, trials, 1.0)
    tail = 0.5 * (1.0 - level)
    low = betaincinv(s * n + 0.5, (1.0 - s) * n + 0.5, tail)
    high = betaincinv(s * n + 0.5, (1.0 - s) * n + 0.5, 1.0 - tail)
    return np.where(known, np.minimum(low, s), np.nan), np.where(known, np.maximum(high, s), np.nan)


def _bin_intervals(
    place: NDArray[np.int64],
    y: Floats,
    w: Floats,
    observed: Floats,
    effective: Floats,
    blocks: ArrayLike | None,
    level: float,
    seed: int,
) -> tuple[Floats, Floats]:
    if blocks is None:
        return jeffreys_interval(observed, np.nan_to_num(effective), level)
    group = _group(blocks, len(place))
    groups = int(group.max()) + 1
    sums = np.zeros((2, groups, len(observed)))
    np.add.at(sums[0], (group, place), w)
    np.add.at(sums[1], (group, place), w * y)
    met = np.count_nonzero(sums[0], axis=0)
    again = _bootstrap_counts(groups, seed)
    shares = _ratio(again @ sums[1], again @ sums[0])
    tail = 0.5 * (1.0 - level)
    few = met < 3
    low, high = jeffreys_interval(observed, met.astype(np.float64), level)
    if not few.all():
        quantiles = np.nanquantile(shares[:, ~few], [tail, 1.0 - tail], axis=0)
        # Blocks that agree completely have no spread to resample: never narrower than independent outcomes.
        least, most = jeffreys_interval(observed[~few], effective[~few], level)
        low[~few] = np.minimum(quantiles[0], least)
        high[~few] = np.maximum(quantiles[1], most)
    return low, high


def _group(blocks: ArrayLike, count: int) -> NDArray[np.int64]:
    b = np.asarray(blocks)
    if b.shape != (count,):
        raise ValueError(f"blocks have shape ({count},), not {b.shape}")
    return np.unique(b, return_inverse=True)[1].astype(np.int64)


def _bootstrap_counts(groups: int, seed: int) -> Floats:
    """How often each group is drawn in every resample, (resamples, groups)."""
    rng = np.random.default_rng(seed)
    return rng.multinomial(groups, np.full(groups, 1.0 / groups), size=_RESAMPLES).astype(np.float64)


def expected_calibration_error(
    predictions: ArrayLike,
    outcomes: ArrayLike,
    *,
    weights: ArrayLike | None = None,
) -> float:
    """Mean over predictions above `ECE_ABOVE` of the difference between a bin's mean prediction and its share
    of successes (Naeini et al. 2015); 10 bins of equal width between there and 1; nan without such
    predictions.
    """
    p, y, w = _checked(predictions, outcomes, weights)
    chosen = (p > ECE_ABOVE) & (w > 0.0)
    if not chosen.any():
        return math.nan
    p, y, w = p[chosen], y[chosen], w[chosen]
    place = np.minimum(((p - ECE_ABOVE) / (1.0 - ECE_ABOVE) * 10).astype(np.int64), 9)
    gap = _tally(place, w * (p - y), 10)
    return float(np.abs(gap).sum() / w.sum())


def area_under_curve(scores: ArrayLike, outcomes: ArrayLike, *, weights: ArrayLike | None = None) -> float:
    """Chance that a success has a higher score than a failure, ties counted half; nan where one is missing.

    Scores need not be probabilities: densities and their logarithms (minus infinity included) rank as well.
    """
    s, y, w = _checked(scores, outcomes, weights, probability=False)
    _, place = np.unique(s, return_inverse=True)
    wins = np.bincount(place, weights=w * y)
    losses = np.bincount(place, weights=w * (1.0 - y))
    if not wins.sum() > 0.0 or not losses.sum() > 0.0:
        return math.nan
    below = np.cumsum(losses) - losses
    return float(np.dot(wins, below + 0.5 * losses) / (wins.sum() * losses.sum()))


def calibrate(
    predictions: ArrayLike,
    outcomes: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    blocks: ArrayLike | None = None,
    bins: int | ArrayLike = 10,
    level: float = 0.9,
    seed: int = 0,
) -> Calibration:
    """Every measure of held-out predictions; parameters as for `reliability`."""
    p, y, w = _checked(predictions, outcomes, weights)
    if not 0.0 < level < 1.0:
        raise ValueError("level lies between 0 and 1")
    score = float(np.average(_squared_error(p, y), weights=w))
    skill = brier_skill(p, y, weights=w)
    group = np.arange(len(p)) if blocks is None else _group(blocks, len(p))
    groups = int(group.max()) + 1
    # Many independent predictions are resampled in 2,000 random groups: the same interval for less.
    if blocks is None and groups > 2_000:
        group = np.random.default_rng(seed).permutation(groups) % 2_000
        groups = 2_000
    sums = np.stack([_tally(group, v, groups) for v in (w, w * y, w * _squared_error(p, y))])
    again = _bootstrap_counts(groups, seed)
    total, wins, loss = (again @ row for row in sums)
    share = wins / total
    skills = _ratio(loss / total, share * (1.0 - share))
    tail = 0.5 * (1.0 - level)
    known = skills[np.isfinite(skills)]
    low, high = (1.0 - np.quantile(known, [1.0 - tail, tail])) if known.size else (math.nan, math.nan)
    return Calibration(
        bins=reliability(p, y, weights=w, blocks=blocks, bins=bins, level=level, seed=seed),
        count=len(p),
        successes=int((y >= 0.5).sum()),
        brier=score,
        skill=skill,
        skill_low=float(low),
        skill_high=float(high),
        ece=expected_calibration_error(p, y, weights=w),
        auc=area_under_curve(p, y, weights=w),
    )


def numbered(cells: Floats) -> NDArray[np.int64]:
    """Number of the cube of space (N, 3) that each row lies in, 0 .. count - 1."""
    cell = (cells - cells.min(axis=0)).astype(np.int64)
    shape = cell.max(axis=0) + 1
    if float(np.prod(shape, dtype=np.float64)) < 2.0**62:
        # One key a cube, in the same order: rows of millions take many times as long to sort.
        keys = (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
        return np.unique(keys, return_inverse=True)[1].astype(np.int64)
    return np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def assign_blocks(positions: ArrayLike, *, edge_m: float, folds: int = 5, seed: int = 0) -> Blocks:
    """Blocks for cross validation: cubes of space, dealt to folds of about equal size.

    A cube holds every rotation at its positions, so a grasp and its twin, and neighbours on a grid's
    rotations, are never divided. Make ``edge_m`` larger than the kernel, three standard deviations at least:
    with smaller blocks a held-out pose's neighbours stay in the training data.

    Parameters
    ----------
    positions : (N, 3) metres
    edge_m : float
    folds : int
        At least 2; fewer are made where there are fewer cubes.
    seed : int
        Of the cubes' origin and of the order in which equal ones are dealt.

    Raises
    ------
    ValueError
        For arguments out of range, or where all positions lie in one cube.
    """
    p = np.asarray(positions, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3 or not len(p) or not np.isfinite(p).all():
        raise ValueError("positions are finite and have shape (N, 3), N at least 1")
    if not (math.isfinite(edge_m) and edge_m > 0.0) or folds < 2:
        raise ValueError("edge_m is positive and folds at least 2")
    rng = np.random.default_rng(seed)
    block = numbered(np.floor((p - p.min(axis=0)) / edge_m + rng.random(3)))
    sizes = np.bincount(block)
    if len(sizes) < 2:
        raise ValueError(
            f"all positions lie in one block of {edge_m:g} m: held-out checks need smaller blocks (a "
            "narrower kernel) or positions further apart"
        )
    made = min(folds, len(sizes))
    filled = np.zeros(made, dtype=np.int64)
    fold_of = np.empty(len(sizes), dtype=np.int64)
    # Largest first to the emptiest fold; the shuffle decides among equals.
    shuffled = rng.permutation(len(sizes))
    for b in shuffled[np.argsort(-sizes[shuffled], kind="stable")]:
        target = int(np.argmin(filled))
        fold_of[b] = target
        filled[target] += sizes[b]
    return Blocks(block, fold_of[block], len(sizes), made)
