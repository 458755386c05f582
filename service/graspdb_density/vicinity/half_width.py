"""How far a grasp may be off along or about one axis: where the chance of success falls to one half."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from ..se3 import Floats

__all__ = ["HALF", "Tolerance", "quantiles", "tolerances"]

HALF = 0.5


@dataclass(frozen=True, eq=False, slots=True)
class Tolerance:
    """Half width of success along one axis, the other coordinates unchanged.

    Attributes
    ----------
    axis : x, y, z (metres) or rx, ry, rz (radians)
    half_width, low, high : float
        Half the distance between the two sides' ends, with its interval; nan without data.
    minus, plus : float
        How far P stays above one half towards either side.
    beyond : bool
        P does not fall to one half within what was looked at on at least one side: the numbers are lower
        bounds.
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
) -> list[Tolerance]:
    """Profiles of three axes to tolerances.

    Parameters
    ----------
    probability, tried : (3 n, 1 + resamples)
        Column 0 as observed; nan where nothing was tried.
    pairs, moved : (3 n,)
        Pairs and the sum of their displacements.
    step : float
        Width of a bin; the middle one is about 0.
    """
    count = len(probability) // 3
    tail = 0.5 * (1.0 - level)
    result = []
    for number, name in enumerate(names):
        part = slice(number * count, (number + 1) * count)
        value, weight, n = probability[part], tried[part], pairs[part]
        nominal = (np.arange(count) - count // 2) * step
        at = np.where(n > 0, moved[part] / np.maximum(n, 1), nominal)
        known = n > 0
        reach = (count // 2 + 0.5) * step
        ends = np.array([_ends(at, value[:, r], weight[:, r], reach) for r in range(value.shape[1])])
        minus, plus = ends[0, 0], ends[0, 1]
        width = 0.5 * (ends[:, 0] + ends[:, 1])
        resampled = width[1:][np.isfinite(width[1:])]
        has = np.isfinite(width[0]) and resampled.size > 0
        low, high = np.quantile(resampled, [tail, 1.0 - tail]) if has else (np.nan, np.nan)
        least, most = quantiles(value[known, 1:], level)
        result.append(
            Tolerance(
                axis=name,
                half_width=float(width[0]),
                low=float(low),
                high=float(high),
                minus=float(minus),
                plus=float(plus),
                beyond=bool(has and max(minus, plus) >= reach * (1.0 - 1e-9)),
                displacement=at[known],
                probability=value[known, 0],
                profile_low=np.fmin(least, value[known, 0]),
                profile_high=np.fmax(most, value[known, 0]),
                count=n[known],
                resampled=width[1:],
            )
        )
    return result


def _ends(at: Floats, value: Floats, weight: NDArray[np.float32], reach: float) -> tuple[float, float]:
    """Where P falls to one half on the two sides of 0; nan for a side without data."""
    found = []
    for sign in (-1.0, 1.0):
        distance = sign * at
        chosen = np.isfinite(value) & (distance > 0.0)
        if not chosen.any():
            found.append(np.nan)
            continue
        order = np.flatnonzero(chosen)[np.argsort(distance[chosen])]
        found.append(_crossing(distance[order], value[order], weight[order].astype(np.float64), reach))
    return found[0], found[1]


def _crossing(distance: Floats, value: Floats, weight: Floats, reach: float) -> float:
    """First distance at which the falling fit to a profile that starts at 1 passes one half.

    The fit is isotonic: a bin that happens to lie high or low between others does not decide alone.
    """
    fit = isotonic_regression(value, weights=weight, increasing=False).x
    below = np.flatnonzero(fit < HALF)
    if not below.size:
        return reach
    i = int(below[0])
    x0, y0 = (0.0, 1.0) if i == 0 else (float(distance[i - 1]), float(fit[i - 1]))
    x1, y1 = float(distance[i]), float(fit[i])
    return x0 + (y0 - HALF) / (y0 - y1) * (x1 - x0)
