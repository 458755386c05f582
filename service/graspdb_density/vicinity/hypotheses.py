"""What the paper expects of a grasp's vicinity, judged on one object's trials.

It expects that x (along an edge), z (the approach) and turns about y (the closing axis) forgive more than the
others, and that this shows more when displacements follow the object's structure (section III-A, figures 7 to
12). Each expectation is a quotient of half widths. Resamples of the grasps are shared by all axes and
alignments, so the quotient's interval is that of pairs. With its whole interval above 1 it is confirmed,
below 1 denied, else undecided. Without trials along an axis nothing is said of it; a half width that is only
a bound, because nothing was tried beyond or the nearest trials fail, decides nothing it could overturn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..se3 import Floats
from .displacement_bins import Anisotropy
from .half_width import Tolerance

__all__ = ["Hypothesis", "Verdict", "sharpened", "wide_axes"]

Verdict = Literal["confirmed", "denied", "undecided"]
#: Resamples that tell a quotient, at least.
_LEAST_RESAMPLES = 20


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A quotient that is above 1 where the expectation holds.

    Attributes
    ----------
    name : ``x-wide``, ``z-wide``, ``ry-wide`` or ``alignment-sharpens``
    ratio, low, high : float
        Quotient and its interval; nan where nothing can be said.
    verdict : ``confirmed``, ``denied`` or ``undecided``
    bound : ``lower``, ``upper`` or ``both``, or None
        Which way the quotient is only a bound, because a half width reaches beyond what was tried or is less
        than the nearest of it.
    """

    name: str
    ratio: float
    low: float
    high: float
    verdict: Verdict
    bound: Literal["lower", "upper", "both"] | None


def wide_axes(found: Anisotropy) -> list[Hypothesis]:
    """Whether x and z forgive more than y, and turns about y more than those about x and z.

    The axes must be the gripper's, or those of edges or pairs; the object's own are named by length.
    """
    by = {item.axis: item for item in found.tolerances}
    return [
        _judged("x-wide", [by["x"]], [by["y"]], found),
        _judged("z-wide", [by["z"]], [by["y"]], found),
        _judged("ry-wide", [by["ry"]], [by["rx"], by["rz"]], found),
    ]


def sharpened(aligned: Anisotropy, gripper: Anisotropy) -> Hypothesis:
    """Whether the widest translation differs more from the narrowest along an object's structure.

    The quotient of widest over narrowest half width, aligned over the gripper's axes; both by the same method
    on the same grasps.

    Raises
    ------
    ValueError
        Where the two were not measured on the same number of grasps and resamples.
    """
    if (aligned.method, aligned.grasps) != (gripper.method, gripper.grasps):
        raise ValueError("alignments are compared on the same grasps, by the same method")
    ours, theirs = (_Widths.of(found.tolerances[:3], found.method) for found in (aligned, gripper))
    with np.errstate(divide="ignore", invalid="ignore"):
        spread, blurred = (w.values.max(axis=0) / w.values.min(axis=0) for w in (ours, theirs))
        quotients = spread / blurred
    at_least, at_most = ours.spread_bounds()
    blurred_at_least, blurred_at_most = theirs.spread_bounds()
    return _verdict(
        "alignment-sharpens",
        quotients,
        aligned.level,
        lower=at_least or blurred_at_most,
        upper=at_most or blurred_at_least,
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Widths:
    """Half widths as far as they are known.

    Attributes
    ----------
    values : (axes, 1 + resamples)
        As observed, then in the resamples: where trials fail from the nearest on, the distance of those; nan
        without data.
    beyond, within : (axes,) bool
        Whether they are lower, or upper bounds: both where a density's kernel hides how wide it is.
    """

    values: Floats
    beyond: NDArray[np.bool_]
    within: NDArray[np.bool_]

    @classmethod
    def of(cls, items: Sequence[Tolerance], method: str) -> _Widths:
        rows = []
        for item in items:
            row = np.concatenate([[item.half_width], item.resampled])
            rows.append(np.maximum(row, item.nearest) if item.within else row)
        within = np.array([item.within for item in items])
        beyond = np.array([item.beyond for item in items])
        return cls(np.array(rows), beyond | within if method == "density" else beyond, within)

    def widest_bounds(self) -> tuple[bool, bool]:
        """Whether the widest is a lower bound, and whether it is an upper one."""
        return bool(self.beyond.any()), bool(self.within[np.argmax(self.values[:, 0])])

    def spread_bounds(self) -> tuple[bool, bool]:
        """Whether the widest over the narrowest is a lower bound, and whether it is an upper one.

        What reaches beyond what was tried may be the widest of all, and what is narrower than that the
        narrowest; where the narrowest reaches beyond, or the widest is narrower, it may be less, too.
        """
        widest, narrowest = np.argmax(self.values[:, 0]), np.argmin(self.values[:, 0])
        at_least = bool(self.beyond.any() or self.within.any())
        return at_least, bool(self.beyond[narrowest] or self.within[widest])


def _judged(name: str, wide: list[Tolerance], narrow: list[Tolerance], found: Anisotropy) -> Hypothesis:
    over, under = (_Widths.of(items, found.method) for items in (wide, narrow))
    with np.errstate(divide="ignore", invalid="ignore"):
        quotients = over.values.max(axis=0) / under.values.max(axis=0)
    (over_at_least, over_at_most), (under_at_least, under_at_most) = (
        side.widest_bounds() for side in (over, under)
    )
    return _verdict(
        name,
        quotients,
        found.level,
        lower=over_at_least or under_at_most,
        upper=over_at_most or under_at_least,
    )


def _verdict(name: str, quotients: Floats, level: float, *, lower: bool, upper: bool) -> Hypothesis:
    """Of a quotient as observed and in the resamples (1 + R,), and which way it is a bound."""
    ratio = float(quotients[0])
    known = quotients[1:][np.isfinite(quotients[1:])]
    if not math.isfinite(ratio) or len(known) < _LEAST_RESAMPLES:
        return Hypothesis(name, math.nan, math.nan, math.nan, "undecided", None)
    tail = 0.5 * (1.0 - level)
    low, high = (float(v) for v in np.quantile(known, [tail, 1.0 - tail]))
    verdict: Verdict = "undecided"
    if low > 1.0 and not upper:
        verdict = "confirmed"
    elif high < 1.0 and not lower:
        verdict = "denied"
    bound: Literal["lower", "upper", "both"] | None = None
    if lower or upper:
        bound = "both" if lower and upper else "lower" if lower else "upper"
    return Hypothesis(name, ratio, min(low, ratio), max(high, ratio), verdict, bound)
