"""Have we tried enough? How much a density would change if its grasps were drawn again (eq 9).

``s = mean over b of BC(m, d_b)``: the Bhattacharyya coefficient between the density m of all grasps and the
density d_b of a bootstrap replicate; 1 means that the replicates agree with it entirely. Equation 9 of
Bodenhagen, Detry, Piater and Krueger takes the mean density of the replicates; the density of all grasps is
what that mean tends to. Estimated with points drawn from m: ``BC_b = E_m sqrt(d_b / m)`` (`coefficients`).

s measures variance, not truth: a wider kernel raises it while the likelihood of held-out grasps falls. So
every point of a curve carries both. N counts successes; a grasp and its twin under the jaw's turn are one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kde.weighted_sums import KernelRows, Progress
from ..se3 import Floats

__all__ = [
    "LEAST_GRASPS",
    "TARGET",
    "ConvergenceCurve",
    "CurvePoint",
    "Needed",
    "Verdict",
    "bootstrap_similarity",
    "coefficients",
    "curve_sizes",
    "grasps_needed",
    "needed_ratio",
    "verdict",
]

#: The similarity from which a density counts as converged.
TARGET = 0.95
#: Smallest subset of a curve and the fewest sizes that make one.
LEAST_SUBSET, LEAST_SIZES = 25, 4
#: Fewest grasps for a curve: sizes are doubled up to half the whole.
LEAST_GRASPS = LEAST_SUBSET * 2 ** (LEAST_SIZES - 1)
#: Resamples behind intervals.
_RESAMPLES = 400
#: Extrapolations beyond this many times the present number say nothing.
_HORIZON = 1_000.0


@dataclass(frozen=True, eq=False, slots=True)
class CurvePoint:
    """Similarity and likelihood at one number of grasps.

    Attributes
    ----------
    grasps : int
    similarity : float
        Mean over the subsets of their s.
    deviation : float
        Standard deviation over bootstrap replicates within a subset (root mean square over subsets).
    replicates : (S, B)
        BC of every replicate of every subset.
    log_likelihood : float
        Mean log density at the held-out grasps, nats of 1/(m^3 rad^3), averaged over subsets.
    log_likelihood_error : float
        Standard error of that mean from the held-out grasps.
    """

    grasps: int
    similarity: float
    deviation: float
    replicates: Floats
    log_likelihood: float
    log_likelihood_error: float


@dataclass(frozen=True, eq=False, slots=True)
class ConvergenceCurve:
    """Points by rising number of grasps; ``held_out`` grasps judged the likelihood."""

    points: tuple[CurvePoint, ...]
    held_out: int

    @property
    def sizes(self) -> Floats:
        """(P,) numbers of grasps."""
        return np.array([point.grasps for point in self.points], dtype=np.float64)

    @property
    def similarities(self) -> Floats:
        """(P,) s of the points."""
        return np.array([point.similarity for point in self.points])


@dataclass(frozen=True, slots=True)
class Needed:
    """Number of grasps at which a similarity is reached, with an interval.

    ``math.inf`` where the curve does not rise enough to say. ``extrapolated`` is false where the curve itself
    crosses the target.
    """

    target: float
    grasps: float
    low: float
    high: float
    extrapolated: bool


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether there are enough grasps.

    Attributes
    ----------
    state : str
        ``enough``, ``more``, or ``borderline`` where the interval of s holds the target.
    similarity, low, high : float
        s of all grasps and its interval.
    needed : Needed
        Grasps in total.
    more : (float, float, float)
        Further grasps: least, best guess and most; 0 where reached, ``math.inf`` where nothing can be said.
    exponent : float
        a of ``1 - s ~ N^-a`` through the last three points.
    """

    state: str
    grasps: int
    similarity: float
    low: float
    high: float
    needed: Needed
    more: tuple[float, float, float]
    exponent: float


def bootstrap_similarity(
    rows: KernelRows,
    rng: np.random.Generator,
    *,
    replicates: int = 50,
    points: int = 20_000,
    threads: int = 1,
    progress: Progress | None = None,
) -> Floats:
    """BC of every bootstrap replicate with all grasps of ``rows``, (B,): their mean is s of eq 9.

    A replicate resamples the grasps with their weights uniformly with replacement and renormalises.

    Parameters
    ----------
    points : int
        Draws from the whole density, systematic over kernels: 1,000 leave a Monte Carlo spread of about
        1.6e-3, 20,000 of 3e-4.

    Raises
    ------
    ValueError
        For fewer than 2 grasps, 2 replicates or 2 points.
    """
    if rows.size < 2 or replicates < 2 or points < 2:
        raise ValueError("a bootstrap needs at least 2 grasps, 2 replicates and 2 points")
    drawn = rows.sample(points, rng)
    weightings = np.empty((replicates + 1, rows.size), dtype=np.float32)
    weightings[0] = rows.weights * rows.size
    for b in range(1, replicates + 1):
        counts = np.bincount(rng.integers(rows.size, size=rows.size), minlength=rows.size)
        again = rows.weights * counts
        weightings[b] = again * (rows.size / again.sum())
    sums = rows.sums(drawn, weightings.T, threads=threads, progress=progress)
    return coefficients(sums[:, 0], sums[:, 1:], np.ones(replicates))


def coefficients(
    whole: NDArray[np.floating], replicates: NDArray[np.floating], totals: NDArray[np.floating]
) -> Floats:
    """BC of every replicate with the whole, (B,), at most 1, from kernel sums at points drawn from the whole.

    The mean of ``sqrt(r)`` with ``r = d_b / m``. Since r has the mean 1 whatever the replicate,
    ``(r - 1) / 2`` is taken off it: to first order what the choice of the points adds, which is more than the
    deviation between replicates where there are few points.

    Parameters
    ----------
    whole : (M,)
        Sums under the weights of all grasps.
    replicates : (M, B)
        Sums under each replicate's weights.
    totals : (B,)
        The sum of each replicate's weights over that of all grasps.

    Raises
    ------
    ValueError
        Where no point is within reach of any grasp.
    """
    # A point all of whose kernels fell below the threshold says nothing.
    seen = whole > 0.0
    if not seen.any():
        raise ValueError("no drawn pose is within reach of any grasp")
    ratio = replicates[seen] / whole[seen, None]
    ratio /= totals.astype(ratio.dtype)
    excess = 0.5 * (ratio.mean(axis=0, dtype=np.float64) - 1.0)
    mean = np.sqrt(ratio, out=ratio).mean(axis=0, dtype=np.float64)
    return np.asarray(mean - excess, dtype=np.float64)


def curve_sizes(count: int) -> list[int]:
    """Numbers of grasps of a curve: 25, 50, 100, ... below the whole, at most half of it, and the whole.

    Raises
    ------
    ValueError
        For fewer than `LEAST_GRASPS`, saying how many more are needed.
    """
    if count < LEAST_GRASPS:
        raise ValueError(
            f"a convergence curve needs at least {LEAST_GRASPS} successful grasps (a grasp and its twin "
            f"under the jaw's turn are one); there are {count}, so {LEAST_GRASPS - count} more are needed"
        )
    sizes = [LEAST_SUBSET]
    while sizes[-1] * 4 <= count:
        sizes.append(sizes[-1] * 2)
    return [*sizes, count]


# -- how many more


def _resampled(curve: ConvergenceCurve, rng: np.random.Generator) -> Floats:
    """s of every point, resampled over subsets and over replicates within them: (resamples, points)."""
    columns = []
    for point in curve.points:
        subsets, count = point.replicates.shape
        which = rng.integers(subsets, size=(_RESAMPLES, subsets, 1))
        again = rng.integers(count, size=(_RESAMPLES, subsets, count))
        columns.append(point.replicates[which, again].mean(axis=(1, 2)))
    return np.stack(columns, axis=1)


def _fit(sizes: Floats, similarity: Floats) -> tuple[Floats, Floats]:
    """Exponent a and log c of ``1 - s = c N^-a`` through the last three points, rows independent."""
    x = np.log(sizes[-3:])
    y = np.log(np.maximum(1.0 - similarity[..., -3:], 1e-12))
    x0 = x.mean()
    slope = ((x - x0) * y).sum(axis=-1) / ((x - x0) ** 2).sum()
    return -slope, y.mean(axis=-1) - slope * x0


def _needed(sizes: Floats, similarity: Floats, target: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Grasps at which each row (R, P) reaches the target, and whether it lies beyond the curve."""
    gap = math.log(1.0 - target)
    log_sizes = np.log(sizes)
    y = np.log(np.maximum(1.0 - similarity, 1e-12))
    exponent, constant = _fit(sizes, similarity)
    rising = exponent > 1e-3
    beyond = np.where(rising, (constant - gap) / np.where(rising, exponent, 1.0), np.inf)
    beyond = np.exp(np.minimum(beyond, log_sizes[-1] + math.log(_HORIZON)))
    beyond = np.where(beyond >= sizes[-1] * _HORIZON * (1.0 - 1e-9), np.inf, beyond)
    out = np.empty(len(similarity))
    outside = np.zeros(len(similarity), dtype=bool)
    for r, row in enumerate(y):
        # The last crossing: noise may touch the target earlier.
        above = np.flatnonzero(row > gap)
        if not above.size:
            out[r] = sizes[0]
        elif above[-1] == len(sizes) - 1:
            out[r], outside[r] = max(beyond[r], sizes[-1]), True
        else:
            i = above[-1]
            share = (row[i] - gap) / (row[i] - row[i + 1])
            out[r] = math.exp(log_sizes[i] + share * (log_sizes[i + 1] - log_sizes[i]))
    return out, outside


def grasps_needed(
    curve: ConvergenceCurve, *, target: float = TARGET, level: float = 0.9, seed: int = 0
) -> Needed:
    """Grasps at which a curve reaches a similarity: interpolated (log 1 - s over log N), else by the fit
    ``1 - s ~ N^-a`` to the last three points; the interval by resampling subsets and replicates.

    A curve that is above the target from its first point on gives that point's number: an upper bound.
    """
    best, outside = _needed(curve.sizes, curve.similarities[None], target)
    spread, _ = _needed(curve.sizes, _resampled(curve, np.random.default_rng(seed)), target)
    low, high = _interval(spread, level)
    return Needed(target, float(best[0]), low, high, bool(outside[0]))


def needed_ratio(
    curve: ConvergenceCurve,
    reference: ConvergenceCurve,
    *,
    ends: Sequence[ConvergenceCurve] = (),
    target: float = TARGET,
    level: float = 0.9,
) -> tuple[float, float, float]:
    """Grasps one kernel needs over those the reference needs: value and interval; nan where neither can be
    told.

    Parameters
    ----------
    ends
        Curves under the reference's kernels at the ends of an interval of the same level, where its width is
        known no better: what they need widens the ratio's, independent errors adding in squares.
    """
    (best, spread), (base, base_spread) = (
        (
            grasps_needed(one, target=target).grasps,
            _needed(one.sizes, _resampled(one, np.random.default_rng((0, number))), target)[0],
        )
        for number, one in enumerate((curve, reference))
    )
    with np.errstate(invalid="ignore"):
        ratio = np.float64(best) / np.float64(base)
        ratios = spread / base_spread
    if np.isnan(ratios).any():
        return float(ratio), math.nan, math.nan
    low, high = _interval(ratios, level)
    if ends:
        others = np.array([grasps_needed(end, target=target).grasps for end in ends])
        with np.errstate(invalid="ignore", divide="ignore"):
            shifts = np.log(base / others)
            low = float(ratio) * math.exp(-math.hypot(np.log(ratio / low), min(0.0, *shifts)))
            high = float(ratio) * math.exp(math.hypot(np.log(high / ratio), max(0.0, *shifts)))
    return float(ratio), low, high


def verdict(curve: ConvergenceCurve, *, level: float = 0.9) -> Verdict:
    """Whether the whole of a curve's grasps suffice, and how many more are needed otherwise."""
    needed = grasps_needed(curve, level=level)
    resampled = _resampled(curve, np.random.default_rng(0))
    last = curve.points[-1]
    low, high = _interval(resampled[:, -1], level)
    state = "enough" if low >= TARGET else "more" if high < TARGET else "borderline"
    exponent, _ = _fit(curve.sizes, curve.similarities)
    least, best, most = (max(0.0, n - last.grasps) for n in (needed.low, needed.grasps, needed.high))
    return Verdict(
        state=state,
        grasps=last.grasps,
        similarity=last.similarity,
        low=low,
        high=high,
        needed=needed,
        more=(least, best, most),
        exponent=float(exponent),
    )


def _interval(values: Floats, level: float) -> tuple[float, float]:
    """Quantiles by order statistics: infinities stay what they are instead of spoiling an interpolation."""
    tail = 0.5 * (1.0 - level)
    low = np.quantile(values, tail, method="lower")
    high = np.quantile(values, 1.0 - tail, method="higher")
    return float(low), float(high)
