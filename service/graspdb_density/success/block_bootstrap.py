"""Shares of attempts that succeeded, by what each attempt is related to, with intervals.

Attempts at neighbouring poses fare alike, so the interval is from resampling blocks of space, and never
narrower than that of as many independent attempts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .calibration import jeffreys_interval, numbered

__all__ = ["Share", "shares"]

_RESAMPLES = 200
#: Edge of the cubes of space that are resampled.
_BLOCK_M = 0.02
#: Fewer blocks than this have no spread to resample.
_LEAST_BLOCKS = 3


@dataclass(frozen=True, slots=True)
class Share:
    """Successes among attempts; probability and interval are nan without any."""

    attempts: int
    successes: int
    probability: float
    low: float
    high: float


def shares(
    success: ArrayLike,
    group: ArrayLike,
    positions: ArrayLike,
    *,
    groups: int,
    level: float = 0.9,
) -> list[Share]:
    """The share of successes in each group.

    Parameters
    ----------
    success : (N,) bool
    group : (N,) int
        Below ``groups``; negative ones are left out.
    positions : (N, 3) metres

    Raises
    ------
    ValueError
        For wrong shapes, or numbers of groups out of range.
    """
    won = np.asarray(success, dtype=bool)
    label = np.asarray(group, dtype=np.int64)
    p = np.asarray(positions, dtype=np.float64)
    if won.ndim != 1 or label.shape != won.shape or p.shape != (len(won), 3) or not np.isfinite(p).all():
        raise ValueError("success, group and positions have shapes (N,), (N,) and (N, 3), all finite")
    if groups < 1 or (len(label) and int(label.max()) >= groups):
        raise ValueError("groups are numbered below their count")
    rng = np.random.default_rng(0)
    tail = 0.5 * (1.0 - level)
    found = []
    for number in range(groups):
        chosen = label == number
        n, k = int(chosen.sum()), int(won[chosen].sum())
        if not n:
            found.append(Share(0, 0, np.nan, np.nan, np.nan))
            continue
        low, high = (float(end) for end in jeffreys_interval(k / n, n, level))
        block = numbered(np.floor(p[chosen] / _BLOCK_M))
        blocks = int(block.max()) + 1
        if blocks >= _LEAST_BLOCKS:
            tried = np.bincount(block, minlength=blocks).astype(np.float64)
            held = np.bincount(block, weights=won[chosen], minlength=blocks)
            again = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), size=_RESAMPLES)
            drawn = (again @ held) / (again @ tried)
            ends = np.quantile(drawn, [tail, 1.0 - tail])
            low, high = min(low, float(ends[0])), max(high, float(ends[1]))
        found.append(Share(n, k, k / n, low, high))
    return found
