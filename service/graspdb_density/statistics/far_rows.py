"""Rows so far from all others that a picture of all would show nothing else: a pose in millimetres, say."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..se3 import Floats

__all__ = ["far_rows"]

#: A few rows are far that lie so many times as far from the middle as all others do ...
_TIMES = 4.0
#: ... and are at most this share of them, but one in any case.
_SHARE = 0.02


def far_rows(points: Floats, *, least: float) -> NDArray[np.bool_]:
    """Which of N points lie far from all others.

    Those are at most 2 % of the points, or one, and four times as far from the median, along any axis, as the
    rest: objects of two ends, however long, are no outliers.

    Parameters
    ----------
    points : (N, d)
    least : float
        What all points may be away without being far, in the unit of the points.
    """
    away = np.abs(points - np.median(points, axis=0)).max(axis=1) if len(points) else np.empty(0)
    ordered = np.sort(away)
    most = min(max(1, int(_SHARE * len(away))), len(away) - 1)
    for count in range(most, 0, -1):
        limit = _TIMES * max(float(ordered[-count - 1]), least)
        if ordered[-count] > limit:
            return np.asarray(away > limit)
    return np.zeros(len(away), dtype=bool)
