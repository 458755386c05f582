"""How success probabilities from one source should be corrected for another: from simulation for a robot.

``p_real = sigmoid(a + b logit(p_sim))`` (Platt 1999), fitted to the few real trials by maximum posterior:
a and b have independent normal priors about 0 and 1, the map that changes nothing, so that few trials change
little; b is never negative, so that no order is turned round. Trials of one block of space are not
independent: a block of n trials counts as ``n / (1 + (n - 1) rho)`` of them, at most 1 / rho, rho the
correlation of their outcomes. The map's own uncertainty is that of the normal approximation to the posterior.

It is judged on blocks left out, by Brier's score, against the uncorrected probabilities and against the share
of successes in the other blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, stdtrit

from ..se3 import Floats, Poses
from .kernel_regression import NearestAttempts, SuccessEstimate, SuccessModel, checked_outcomes

__all__ = [
    "LEAST_BLOCKS",
    "LEAST_TRIALS",
    "Judged",
    "MappedModel",
    "SourceMap",
    "fit_source_map",
    "judge_source_map",
]

#: Standard deviations of the priors of a and of b.
PRIOR_SHIFT, PRIOR_SLOPE = 0.5, 0.3
#: Correlation of the outcomes of trials in one block.
CORRELATION = 0.1
#: Fewer trials, or blocks of space that hold them, judge no map.
LEAST_TRIALS, LEAST_BLOCKS = 20, 5
#: Probabilities nearer to 0 or 1 than this say as much as this.
_CLIP = 0.01
_STEPS, _ENOUGH = 50, 1e-10

Verdict = Literal["better", "worse", "undecided"]


@dataclass(frozen=True, eq=False, slots=True)
class SourceMap:
    """``sigmoid(shift + slope logit(p))`` and how sure it is.

    Attributes
    ----------
    shift, slope : float
        0 and 1 change nothing; a slope of 0 says that p tells nothing.
    covariance : (2, 2)
        Of both, by the posterior.
    trials : int
    effective_trials : float
        As how many independent ones they count.
    """

    shift: float
    slope: float
    covariance: Floats
    trials: int
    effective_trials: float

    def probability(self, p: ArrayLike) -> Floats:
        """Corrected probabilities, of the shape given."""
        return np.asarray(expit(self.shift + self.slope * _logit(p)), dtype=np.float64)

    def interval(
        self, p: ArrayLike, low: ArrayLike, high: ArrayLike, *, level: float = 0.9
    ) -> tuple[Floats, Floats]:
        """Intervals of corrected probabilities: those of the estimates, mapped, and wider by the map's own
        uncertainty; with the estimates themselves for ``low`` and ``high`` they are the map's alone.
        """
        x = _logit(p)
        own = -float(stdtrit(math.inf, 0.5 * (1.0 - level))) * np.sqrt(self.variance(x))
        middle = self.shift + self.slope * x
        down, up = (np.abs(self.slope * (x - _logit(end))) for end in (low, high))
        return expit(middle - np.hypot(down, own)), expit(middle + np.hypot(up, own))

    def variance(self, logit: Floats) -> Floats:
        """Variance of the corrected logit."""
        (a, c), (_, b) = self.covariance
        return np.asarray(np.maximum(a + 2.0 * c * logit + b * logit * logit, 0.0))


class MappedModel(SuccessModel):
    """A success model whose probabilities are corrected, their intervals wider by the map's uncertainty."""

    def __init__(self, model: SuccessModel, correction: SourceMap) -> None:
        super().__init__(model.kernel, model.parts, model.motions)
        self.model = model
        self.correction = correction

    def evaluate_near(
        self, poses: Poses, *, level: float = 0.9, threads: int = 1
    ) -> tuple[SuccessEstimate, NearestAttempts]:
        found, nearest = self.model.evaluate_near(poses, level=level, threads=threads)
        low, high = self.correction.interval(found.probability, found.low, found.high, level=level)
        p = self.correction.probability(found.probability)
        return SuccessEstimate(p, low, high, found.effective_trials, level), nearest

    def probability(self, poses: Poses, *, threads: int = 1) -> Floats:
        return self.correction.probability(self.model.probability(poses, threads=threads))

    def without_interval(
        self, poses: Poses, *, everywhere: bool = False, threads: int = 1
    ) -> tuple[Floats, Floats, NearestAttempts]:
        p, trials, nearest = self.model.without_interval(poses, everywhere=everywhere, threads=threads)
        return self.correction.probability(p), trials, nearest

    def lower_end(
        self,
        poses: Poses,
        *,
        level: float = 0.9,
        near: Callable[[NearestAttempts], NDArray[np.bool_]] | None = None,
        threads: int = 1,
    ) -> Floats:
        low = self.model.lower_end(poses, level=level, near=near, threads=threads)
        p = self.model.probability(poses, threads=threads)
        return self.correction.interval(p, low, low, level=level)[0]


@dataclass(frozen=True, slots=True)
class Judged:
    """A map on trials whose block was left out of its fit.

    Attributes
    ----------
    verdict
        Whether it predicts better than the uncorrected probabilities.
    brier, uncorrected_brier, share_brier : float
        Mean squared errors: of the map, of the probabilities as they are, and of the share of successes in
        the other blocks; nan where too few trials or blocks tell.
    gain, gain_low, gain_high : float
        Uncorrected less corrected Brier score, and its interval by blocks.
    informative : bool
        Whether what predicts better of the two beats the share.
    trials, blocks : int
    """

    verdict: Verdict
    brier: float
    uncorrected_brier: float
    share_brier: float
    gain: float
    gain_low: float
    gain_high: float
    informative: bool
    trials: int
    blocks: int


def fit_source_map(
    predicted: ArrayLike, success: ArrayLike, blocks: ArrayLike, *, correlation: float = CORRELATION
) -> SourceMap:
    """The map of probabilities to what trials found.

    Parameters
    ----------
    predicted : (N,) in [0, 1]
        What the one source predicts at the trials of the other.
    success : (N,) bool
    blocks : (N,) int
        The block of space of each trial.

    Raises
    ------
    ValueError
        For wrong shapes, or predictions that are no probabilities.
    """
    p, y, block = _checked(predicted, success, blocks)
    counts = np.unique(block, return_inverse=True, return_counts=True)
    weight = np.asarray(
        1.0 / (1.0 + (counts[2][counts[1].reshape(-1)] - 1.0) * correlation), dtype=np.float64
    )
    precision: Floats = np.array([PRIOR_SHIFT**-2.0, PRIOR_SLOPE**-2.0], dtype=np.float64)
    x = np.stack([np.ones(len(p)), _logit(p)], axis=1)
    at = _maximum(x, y, weight, precision, free=np.array([True, True]))
    if at[1] < 0.0:
        at = _maximum(x, y, weight, precision, free=np.array([True, False]))
    return SourceMap(
        shift=float(at[0]),
        slope=float(at[1]),
        covariance=np.asarray(np.linalg.inv(_curvature(x, at, weight, precision)), dtype=np.float64),
        trials=len(p),
        effective_trials=float(weight.sum()),
    )


def _maximum(
    x: Floats, y: NDArray[np.bool_], weight: Floats, precision: Floats, free: NDArray[np.bool_]
) -> Floats:
    """Where the posterior is highest, by Newton's method; what is not ``free`` is 0."""
    mean = np.array([0.0, 1.0])
    at: Floats = np.where(free, mean, 0.0)

    def loss(at: Floats) -> float:
        z = x @ at
        likelihood = weight @ (np.logaddexp(0.0, z) - y * z)
        return float(likelihood + 0.5 * precision @ (at - mean) ** 2)

    now = loss(at)
    for _ in range(_STEPS):
        slope = x.T @ (weight * (expit(x @ at) - y)) + precision * (at - mean)
        curvature = _curvature(x, at, weight, precision)[np.ix_(free, free)]
        step = np.zeros(2)
        step[free] = np.linalg.solve(curvature, slope[free])
        length = 1.0
        while length > 1e-6 and loss(at - length * step) > now:
            length *= 0.5
        at = np.asarray(at - length * step, dtype=np.float64)
        before, now = now, loss(at)
        if before - now < _ENOUGH:
            break
    return at


def _curvature(x: Floats, at: Floats, weight: Floats, precision: Floats) -> Floats:
    p = expit(x @ at)
    return np.asarray((x * (weight * p * (1.0 - p))[:, None]).T @ x + np.diag(precision), dtype=np.float64)


def judge_source_map(
    predicted: ArrayLike,
    success: ArrayLike,
    blocks: ArrayLike,
    *,
    correlation: float = CORRELATION,
    level: float = 0.9,
) -> Judged:
    """How well maps fitted without a block predict its trials; parameters as `fit_source_map`."""
    p, y, block = _checked(predicted, success, blocks)
    names, group = np.unique(block, return_inverse=True)
    group = group.reshape(-1)
    count = len(names)
    if len(p) < LEAST_TRIALS or count < LEAST_BLOCKS:
        nothing = math.nan
        return Judged("undecided", nothing, nothing, nothing, nothing, nothing, nothing, False, len(p), count)
    # Many blocks are left out in tens.
    fold = group % min(count, 10) if count > 40 else group
    corrected, share = np.empty(len(p)), np.empty(len(p))
    for number in range(int(fold.max()) + 1):
        out = fold == number
        fitted = fit_source_map(p[~out], y[~out], group[~out], correlation=correlation)
        corrected[out] = fitted.probability(p[out])
        share[out] = (y[~out].sum() + 0.5) / ((~out).sum() + 1.0)
    errors = [(values - y) ** 2 for values in (corrected, p, share)]
    gain, low, high = _mean_interval(errors[1] - errors[0], group, level)
    verdict: Verdict = "better" if low > 0.0 else "worse" if high < 0.0 else "undecided"
    best = errors[0] if verdict == "better" else errors[1]
    _, informed, _ = _mean_interval(errors[2] - best, group, level)
    own, plain, alone = (float(error.mean()) for error in errors)
    return Judged(verdict, own, plain, alone, gain, low, high, informed > 0.0, len(p), count)


def _mean_interval(values: Floats, group: NDArray[np.int64], level: float) -> tuple[float, float, float]:
    """A mean whose values are alike within groups: Student's t over the groups' summed deviations."""
    mean = float(values.mean())
    deviations = np.bincount(group, weights=values - mean)
    freedom = len(deviations) - 1
    error = math.sqrt(len(deviations) / freedom * float(deviations @ deviations)) / len(values)
    half = -float(stdtrit(freedom, 0.5 * (1.0 - level))) * error
    return mean, mean - half, mean + half


def _logit(p: ArrayLike) -> Floats:
    clipped = np.clip(np.asarray(p, dtype=np.float64), _CLIP, 1.0 - _CLIP)
    return np.asarray(np.log(clipped) - np.log1p(-clipped), dtype=np.float64)


def _checked(
    predicted: ArrayLike, success: ArrayLike, blocks: ArrayLike
) -> tuple[Floats, NDArray[np.bool_], NDArray[np.int64]]:
    p, block = np.asarray(predicted, dtype=np.float64), np.asarray(blocks, dtype=np.int64)
    if p.ndim != 1 or block.shape != p.shape or not ((p >= 0.0) & (p <= 1.0)).all():
        raise ValueError("predictions (N,) are probabilities, and every one has its block (N,)")
    return p, checked_outcomes(success, len(p)), block
