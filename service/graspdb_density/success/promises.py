"""What was promised against what happened: success probabilities of grasps that were chosen and then tried.

Trials of one answer fare alike, so each answer counts once, with the mean of its trials. Only what promised
much was tried: the highest of many estimates is, on average, higher than the truth (Smith and Winkler 2006,
"The optimizer's curse"), whether or not each estimate is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .calibration import jeffreys_interval

__all__ = ["Promises", "PromisesBin", "judge_promises"]

Floats = NDArray[np.float64]
_RESAMPLES = 1_000
#: The largest of a hundred estimates of the same truth is this many standard errors too high on average.
_LARGEST_OF_A_HUNDRED = 2.5


@dataclass(frozen=True, slots=True)
class PromisesBin:
    """Answers that promised from ``lower`` to ``upper``; means and interval are nan without any."""

    lower: float
    upper: float
    answers: int
    trials: int
    promised: float
    happened: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Promises:
    """Promises judged, each answer once.

    ``promised`` and ``happened`` are means, ``low`` and ``high`` the ends of the interval of ``happened``.
    ``brier`` is the mean squared error, ``skill`` its share below that of always telling the share that
    happened, with its interval; nan where all or none held. ``selection`` is how much too high a mean promise
    may be because the highest estimates were chosen, 0 where no estimate tells its error.
    """

    answers: int
    trials: int
    promised: float
    happened: float
    low: float
    high: float
    brier: float
    skill: float
    skill_low: float
    skill_high: float
    selection: float
    bins: list[PromisesBin]


# long: most of it says what its parameters are.
def judge_promises(
    promised: ArrayLike,
    happened: ArrayLike,
    answer: ArrayLike,
    errors: ArrayLike,
    *,
    bins: int = 5,
    level: float = 0.9,
) -> Promises:
    """Judge promises by what happened.

    Parameters
    ----------
    promised : (N,)
        Success probability promised to each trial, 0 to 1.
    happened : (N,) bool
        Whether it held.
    answer : (N,) int
        Which answer each trial tried: those of one are not independent.
    errors : (N,)
        Standard error of each promise; nan where not known.
    bins
        Between 0 and 1, equally wide.
    level
        Probability that intervals hold the truth.

    Raises
    ------
    ValueError
        For no trial, wrong shapes, or promises that are no probabilities.
    """
    p, y = np.asarray(promised, dtype=np.float64), np.asarray(happened, dtype=np.float64)
    label, error = np.asarray(answer), np.asarray(errors, dtype=np.float64)
    if p.ndim != 1 or not len(p) or not p.shape == y.shape == label.shape == error.shape:
        raise ValueError("promised, happened, answer and errors have one shape (N,), N at least 1")
    if not ((p >= 0.0) & (p <= 1.0)).all():
        raise ValueError("a promise is a probability from 0 to 1")
    _, group, counts = np.unique(label, return_inverse=True, return_counts=True)

    def mean(values: Floats) -> Floats:
        return np.bincount(group, weights=values) / counts

    promises, held, squared = mean(p), mean(y), mean((p - y) ** 2)
    share, low, high = _share(held, level)
    spread = np.where(np.isfinite(error), error, 0.0)
    skill, skill_low, skill_high = _skill(squared, held, level)
    edges = np.linspace(0.0, 1.0, bins + 1)
    place = np.minimum((promises * bins).astype(np.int64), bins - 1)
    return Promises(
        answers=len(counts),
        trials=len(p),
        promised=float(promises.mean()),
        happened=share,
        low=low,
        high=high,
        brier=float(squared.mean()),
        skill=skill,
        skill_low=skill_low,
        skill_high=skill_high,
        selection=float(_LARGEST_OF_A_HUNDRED * mean(spread).mean()),
        bins=[
            _bin(edges[i], edges[i + 1], promises[place == i], held[place == i], counts[place == i], level)
            for i in range(bins)
        ],
    )


def _bin(
    lower: float, upper: float, promises: Floats, held: Floats, counts: NDArray[np.int64], level: float
) -> PromisesBin:
    if not len(promises):
        return PromisesBin(float(lower), float(upper), 0, 0, np.nan, np.nan, np.nan, np.nan)
    share, low, high = _share(held, level)
    told = float(promises.mean())
    return PromisesBin(float(lower), float(upper), len(promises), int(counts.sum()), told, share, low, high)


def _share(held: Floats, level: float) -> tuple[float, float, float]:
    """The mean over answers, and Jeffreys' interval as of so many independent trials: wider than it need be
    where answers differ in what they promised, or were tried several times.
    """
    share = float(held.mean())
    low, high = (float(end) for end in jeffreys_interval(share, len(held), level))
    return share, min(low, share), max(high, share)


def _skill(squared: Floats, held: Floats, level: float) -> tuple[float, float, float]:
    """Brier skill against the share that held, and its interval from resampling answers."""

    def skill(errors: Floats, shares: Floats) -> Floats:
        base = shares * (1.0 - shares)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(base > 0.0, 1.0 - errors / base, np.nan))

    value = float(skill(squared.mean(keepdims=True), held.mean(keepdims=True))[0])
    if not np.isfinite(value):
        return np.nan, np.nan, np.nan
    count = len(held)
    rng = np.random.default_rng(0)
    weights = rng.multinomial(count, np.full(count, 1.0 / count), size=_RESAMPLES) / count
    drawn = skill(weights @ squared, weights @ held)
    drawn = drawn[np.isfinite(drawn)]
    tail = 0.5 * (1.0 - level)
    low, high = np.quantile(drawn, [tail, 1.0 - tail]) if len(drawn) else (np.nan, np.nan)
    return value, min(float(low), value), max(float(high), value)
