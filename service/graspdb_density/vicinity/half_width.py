"""How far a grasp may be off along or about one axis: where the chance of success falls to one half.

Only what was tried counts. A profile ends at the farthest pair of trials on either side, and where the chance
has not fallen to one half by then, that far is a lower bound: the half width is at least so much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from ..se3 import Floats

__all__ = ["HALF", "LEAST_PAIRS", "Tolerance", "quantiles", "tolerances"]

HALF = 0.5
#: Pairs on a side that tell where half of them succeed, at least: as many that all fare alike are by chance
#: with less than 7 %.
LEAST_PAIRS = 5


@dataclass(frozen=True, eq=False, slots=True)
class Tolerance:
    """Half width of success along one axis, the other coordinates unchanged.

    Attributes
    ----------
    axis : x, y, z (metres) or rx, ry, rz (radians)
    half_width, low, high : float
        Half the distance between the two sides' ends, with its interval; nan where a side has fewer than
        `LEAST_PAIRS` pairs.
    minus, plus : float
        How far P stays above one half towards either side; nan for a side with too few pairs.
    beyond : bool
        P does not fall to one half within what was tried on at least one side: the numbers are lower bounds.
    within : bool
        It has where the nearest trials are: the half width is at most ``nearest``.
    nearest : float
        The smallest displacement tried towards either side, mean of its bin; nan where there is none.
    tried : (float, float)
        The farthest displacements tried towards minus, not above 0, and plus, not below 0; 0 where there is
        none.
    displacement : (n,)
        Mean displacement of the pairs in each bin of the profile (on a grid the bin's middle), rising; bins
        without pairs are left out.
    probability, profile_low, profile_high : (n,)
    count : (n,) int64
    resampled : (R,)
        Half widths in the resamples of the grasps, the same ones for every axis; nan without data.
    """

    axis: str
    half_width: float
    low: float
    high: float
    minus: float
    plus: float
    beyond: bool
    within: bool
    nearest: float
    tried: tuple[float, float]
    displacement: Floats
    probability: Floats
    profile_low: Floats
    profile_high: Floats
    count: NDArray[np.int64]
    resampled: Floats


def quantiles(values: Floats, level: float) -> tuple[Floats, Floats]:
    """Ends of the central interval of every row (n, R), nan left out; nan for rows without a number."""
    ordered = np.sort(values, axis=1)
    count = np.count_nonzero(np.isfinite(ordered), axis=1)
    row = np.arange(len(values))
    ends = []
    for share in (0.5 * (1.0 - level), 0.5 * (1.0 + level)):
        place = share * np.maximum(count - 1, 0)
        low = np.floor(place).astype(np.int64)
        high = np.minimum(low + 1, np.maximum(count - 1, 0))
        below, above = ordered[row, low], ordered[row, high]
        ends.append(np.where(count > 0, below + (place - low) * (above - below), np.nan))
    return ends[0], ends[1]


def tolerances(
    names: Sequence[str],
    probability: Floats,
    tried: NDArray[np.float32],
    pairs: NDArray[np.int64],
    moved: Floats,
    *,
    step: float,
    level: float,
    farthest: Floats | None = None,
) -> list[Tolerance]:
    """Profiles of three axes to tolerances.

    Parameters
    ----------
    probability, tried : (3 n, 1 + resamples)
        Column 0 as observed; nan where nothing was tried.
    pairs, moved, farthest : (3 n,)
        Pairs, the sum of their displacements, and the largest of these in amount (None: their mean).
    step : float
        Width of a bin; the middle one is about 0, and its pairs do not count as displaced.
    """
    count = len(probability) // 3
    middle: Floats = (np.arange(count, dtype=np.float64) - count // 2) * step
    result = []
    for number, name in enumerate(names):
        part = slice(number * count, (number + 1) * count)
        n = pairs[part]
        at: Floats = np.where(n > 0, moved[part] / np.maximum(n, 1), middle)
        reached = np.where(n > 0, np.abs(at) if farthest is None else farthest[part], 0.0)
        sides = tuple(_Side.of(sign * middle, sign * at, n, reached) for sign in (-1.0, 1.0))
        result.append(_tolerance(name, sides, at, probability[part], tried[part], n, level))
    return result


def _tolerance(
    name: str,
    sides: tuple[_Side, ...],
    at: Floats,
    value: Floats,
    weight: NDArray[np.float32],
    pairs: NDArray[np.int64],
    level: float,
) -> Tolerance:
    """That of one profile (n, 1 + resamples), from its two sides."""
    known, tail = pairs > 0, 0.5 * (1.0 - level)
    ends = np.array([side.ends(value, weight) for side in sides])
    width = 0.5 * (ends[0] + ends[1])
    resampled = width[1:][np.isfinite(width[1:])]
    has = bool(np.isfinite(width[0])) and resampled.size > 0
    low, high = np.quantile(resampled, [tail, 1.0 - tail]) if has else (np.nan, np.nan)
    least, most = quantiles(value[known, 1:], level)
    beyond = has and any(side.open(value, weight) for side in sides)
    nearest = min((side.nearest for side in sides if side.rows.size), default=np.nan)
    return Tolerance(
        axis=name,
        half_width=float(width[0]),
        low=float(low),
        high=float(high),
        minus=float(ends[0, 0]),
        plus=float(ends[1, 0]),
        beyond=beyond,
        within=has and not beyond and bool(width[0] < nearest),
        nearest=float(nearest),
        tried=(0.0 - sides[0].reach, sides[1].reach),
        displacement=at[known],
        probability=value[known, 0],
        profile_low=np.fmin(least, value[known, 0]),
        profile_high=np.fmax(most, value[known, 0]),
        count=pairs[known],
        resampled=width[1:],
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Side:
    """What was tried towards one side.

    Attributes
    ----------
    rows : (m,)
        Bins from the nearest to the farthest that pairs are in, those between included.
    distance, reached : (m,)
        Of each: the mean of its pairs, and the farthest pair up to it.
    pairs, nearest, reach : int, float, float
        Pairs in all, the distance of the nearest of them (mean of its bin) and of the farthest; 0 without.
    """

    rows: NDArray[np.intp]
    distance: Floats
    reached: Floats
    pairs: int
    nearest: float
    reach: float

    @classmethod
    def of(cls, nominal: Floats, at: Floats, pairs: NDArray[np.int64], reached: Floats) -> _Side:
        """The side on which the bins' middles ``nominal`` (n,) are positive."""
        # Bins rise or fall; in the middle one pairs hardly differ.
        rows = np.flatnonzero(nominal > 0.0)
        rows = rows[np.argsort(nominal[rows])]
        filled = np.flatnonzero(pairs[rows] > 0)
        if not filled.size:
            return cls(rows[:0], np.empty(0), np.empty(0), 0, 0.0, 0.0)
        rows = rows[filled[0] : filled[-1] + 1]
        distance, farthest = at[rows], np.maximum.accumulate(reached[rows])
        return cls(rows, distance, farthest, int(pairs[rows].sum()), float(distance[0]), float(farthest[-1]))

    def ends(self, value: Floats, weight: NDArray[np.float32]) -> Floats:
        """Where P falls to one half (columns,): the farthest pair where it does not, nan without data."""
        if self.pairs < LEAST_PAIRS:
            return np.full(value.shape[1], np.nan)
        return np.array([self._end(value[:, r], weight[:, r])[0] for r in range(value.shape[1])])

    def open(self, value: Floats, weight: NDArray[np.float32]) -> bool:
        """Whether P, as observed, stays above one half as far as was tried."""
        return self.pairs >= LEAST_PAIRS and self._end(value[:, 0], weight[:, 0])[1]

    def _end(self, value: Floats, weight: NDArray[np.float32]) -> tuple[float, bool]:
        """First distance at which the falling fit to a profile that starts at 1 passes one half, and whether
        it does not.

        The fit is isotonic: a bin that happens to lie high or low between others does not decide alone.
        """
        v, w = value[self.rows], weight[self.rows].astype(np.float64)
        known = np.isfinite(v) & (w > 0.0)
        if not known.any():
            return np.nan, False
        distance, reach = self.distance[known], float(self.reached[known][-1])
        fit = isotonic_regression(v[known], weights=w[known], increasing=False).x
        below = np.flatnonzero(fit < HALF)
        if not below.size:
            return reach, True
        i = int(below[0])
        x0, y0 = (0.0, 1.0) if i == 0 else (float(distance[i - 1]), float(fit[i - 1]))
        x1, y1 = float(distance[i]), float(fit[i])
        return min(x0 + (y0 - HALF) / (y0 - y1) * (x1 - x0), reach), False
