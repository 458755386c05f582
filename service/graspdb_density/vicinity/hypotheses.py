"""What the paper expects of a grasp's vicinity, judged on one object's trials.

It expects that x (along an edge), z (the approach) and turns about y (the closing axis) forgive more than the
others, and that this shows more when displacements follow the object's structure (section III-A, figures 7 to
12). Each expectation is a quotient of half widths. Resamples of the grasps are shared by all axes and
alignments, so the quotient's interval is that of pairs. With its whole interval above 1 it is confirmed,
below 1 denied, else undecided; a half width that is only a lower bound decides nothing it could overturn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

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
        Which way the quotient is only a bound, because a half width reaches beyond what was looked at.
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
        _judged("x-wide", [by["x"]], [by["y"]], found.level),
        _judged("z-wide", [by["z"]], [by["y"]], found.level),
        _judged("ry-wide", [by["ry"]], [by["rx"], by["rz"]], found.level),
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
    ours, theirs = (list(found.tolerances[:3]) for found in (aligned, gripper))
    if (aligned.method, aligned.grasps) != (gripper.method, gripper.grasps):
        raise ValueError("alignments are compared on the same grasps, by the same method")
    index = [_spread(items) for items in (ours, theirs)]
    value = index[0][0] / index[1][0]
    resampled = index[0][1] / index[1][1]
    # Beyond what was looked at the widest is a lower bound: of ours it may hide sharpening, of theirs it may
    # feign it.
    return _verdict(
        "alignment-sharpens",
        value,
        resampled,
        aligned.level,
        lower=any(item.beyond for item in ours),
        upper=any(item.beyond for item in theirs),
    )


def _spread(items: list[Tolerance]) -> tuple[float, Floats]:
    """Widest over narrowest half width, as observed and in the resamples."""
    value = np.array([item.half_width for item in items])
    again = np.stack([item.resampled for item in items])
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(value.max() / value.min()), np.asarray(again.max(axis=0) / again.min(axis=0))


def _judged(name: str, wide: list[Tolerance], narrow: list[Tolerance], level: float) -> Hypothesis:
    over, under = (
        (np.max([item.half_width for item in items]), np.max([item.resampled for item in items], axis=0))
        for items in (wide, narrow)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio, resampled = over[0] / under[0], over[1] / under[1]
    return _verdict(
        name,
        float(ratio),
        np.asarray(resampled, dtype=np.float64),
        level,
        lower=any(item.beyond for item in wide),
        upper=any(item.beyond for item in narrow),
    )


def _verdict(
    name: str, ratio: float, resampled: Floats, level: float, *, lower: bool, upper: bool
) -> Hypothesis:
    known = resampled[np.isfinite(resampled)]
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
