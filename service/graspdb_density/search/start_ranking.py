"""Where searches start: a density's rows by what it is worth at their centres, and what to climb among.

Exact where that is cheap. Where most kernels reach each other (many grasps of a small object), the sums over
all pairs would take many seconds; there a sample of the kernels stands for all. It is drawn systematically in
the order of the cells with probability proportional to weight, so that it is spread over space evenly, and
each drawn kernel counts by the inverse of its probability: the sums are unbiased and, at a maximum to which
hundreds of kernels contribute, within some 10 %. Searches make up for that with more starts, and with exact
sums for all they compare; they climb among such samples first and among all kernels last.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .._compiled import isotropic
from ..kde.cell_list import Cells
from ..kde.isotropic import GraspDensity
from ..kde.rows import Rows
from ..se3 import Floats, Poses

__all__ = ["CentreScores", "CentreSums", "StartRanking", "centre_sums", "rank_starts"]

Indices = NDArray[np.int64]

#: Three standard deviations rank centres well enough; refinement uses the full reach.
_RADIUS = 3.0 / math.sqrt(2.0)
#: Most pairs of kernels to sum: some 0.2 s on one core.
MOST_PAIRS = 5e8
_LEAST_SAMPLE = 4_096
_PROBES = 256
_QUERY_BLOCK = 1_024
#: Centres scored at a time.
_AT_ONCE = 256
#: How many times the kernels of the sample the finer one has, and how many times its kernels there must be
#: for it to pay.
_FINER, _WORTH = 4.0, 2.0


@dataclass(frozen=True, eq=False, slots=True)
class CentreSums:
    """Sums of kernels at every centre.

    Attributes
    ----------
    values : (N,)
        In the order of rows, own kernel included.
    sample : Cells or None
        The kernels that stand for all; None where all were summed.
    rate
        Probability with which a row of weight 1 (the density's unit) is in the sample.
    """

    values: Floats
    sample: Cells | None = None
    rate: float = math.inf

    @property
    def nbytes(self) -> int:
        return self.values.nbytes + (0 if self.sample is None else self.sample.nbytes)


class CentreScores:
    """What a score gives at the centres of rows, each asked of it once. Safe to use from several threads:
    searches at once that ask for the same centres share the work, and none waits for another.
    """

    def __init__(self) -> None:
        self._claims = threading.Lock()
        self._values: Floats = np.empty(0)
        self._begun: NDArray[np.bool_] = np.empty(0, dtype=np.bool_)

    @property
    def nbytes(self) -> int:
        return self._values.nbytes + self._begun.nbytes

    def at(self, rows: Indices, centres: Poses, score: Callable[[Poses], Floats]) -> Floats:
        """The score (K,) at some of the N centres."""
        with self._claims:
            if len(self._values) != len(centres):
                self._begun = np.zeros(len(centres), dtype=np.bool_)
                self._values = np.full(len(centres), np.nan)
            values, begun = self._values, self._begun
        # What another has begun it may end meanwhile; what is still missing then is done here, too.
        for left in (rows[~begun[rows]], rows):
            for first in range(0, len(left), _AT_ONCE):
                some = left[first : first + _AT_ONCE]
                with self._claims:
                    some = some[np.isnan(values[some]) if left is rows else ~begun[some]]
                    begun[some] = True
                if some.size:
                    values[some] = score(centres[some])
        return np.asarray(values[rows])


@dataclass(frozen=True, eq=False, slots=True)
class StartRanking:
    """A density's N rows, best centre first.

    Attributes
    ----------
    order : (N,)
        Indices by falling sum at their centres.
    centres : (N, 8) float32
        In that order: position in metres, quaternion, log of the kernel sum. A row fills one line of the
        processor's cache.
    twins : (N,)
        In that order: whether the jaw is symmetric.
    coarse_to_fine
        Kernels to climb among: samples where there are any, and all of them last.
    """

    order: NDArray[np.intp]
    centres: NDArray[np.float32]
    twins: NDArray[np.bool_]
    coarse_to_fine: tuple[Cells, ...]

    @property
    def nbytes(self) -> int:
        """Bytes held, those of the sums and the density left out."""
        own = self.order.nbytes + self.centres.nbytes + self.twins.nbytes
        return own + sum(cells.nbytes for cells in self.coarse_to_fine[1:-1])


def rank_starts(density: GraspDensity, sums: CentreSums) -> StartRanking:
    """The ranking of a density's rows by the sums at their centres."""
    order = np.argsort(-sums.values, kind="stable")
    log_sums = np.log(np.maximum(sums.values, 1e-300))
    centres = np.concatenate(
        [density.positions, density.quaternions_xyzw, log_sums[:, None]], axis=1, dtype=np.float32
    )[order]
    whole, sample = density.cells, sums.sample
    levels: tuple[Cells, ...] = (whole,) if sample is None else (sample, whole)
    if sample is not None and _WORTH * _FINER * len(sample.rows) <= density.size:
        finer = _systematic_sample(density, whole.rows.astype(np.int64), _FINER * sums.rate)
        levels = sample, _cells(density, *finer), whole
    return StartRanking(order, centres, density.symmetric[order], levels)


def centre_sums(density: GraspDensity, known: CentreSums | None, threads: int) -> CentreSums:
    """The sums at all centres; ``known`` are those of the first rows, of before the density was extended."""
    if known is not None and 8 * (density.size - len(known.values)) <= density.size:
        return _completed(density, known, threads)
    probes = np.linspace(0, density.size - 1, min(density.size, _PROBES)).astype(np.int64)
    pairs = density.size * float(_reached(density, probes).mean())
    rows = np.arange(density.size)
    if pairs <= MOST_PAIRS or density.size <= _LEAST_SAMPLE:
        return CentreSums(_sums(density, density.cells, rows, threads))
    size = max(_LEAST_SAMPLE, density.size * MOST_PAIRS / pairs)
    rate = size / float(density.raw_weights.sum())
    drawn, weights = _systematic_sample(density, density.cells.rows.astype(np.int64), rate)
    sample = _cells(density, drawn, weights)
    values = _sums(density, sample, rows, threads)
    return CentreSums(_with_own(density, values, rows, drawn, weights), sample, rate)


def _completed(density: GraspDensity, known: CentreSums, threads: int) -> CentreSums:
    """Sums completed with what rows that came since add to the old ones, and with their own."""
    first = len(known.values)
    cells, new = density.cells, np.arange(first, density.size)
    sample, rate = known.sample, known.rate
    if sample is None:
        drawn, weights, within = new, density.raw_weights[new], cells
    else:
        drawn, weights = _systematic_sample(density, new, rate)
        if len(drawn):
            sample = sample.extend(Rows(density.poses[drawn], weights, density.symmetric[drawn]))
        within = sample
    values = np.zeros(density.size)
    values[:first] = known.values
    ordered = values[cells.rows]
    if len(drawn):
        isotropic.scatter_sums(
            cells.arrays, density.positions[drawn], density.quaternions_xyzw[drawn], weights,
            density.symmetric[drawn],
            density.kernel.kappa, _RADIUS, density.wide, ordered,
        )  # fmt: skip
    values[cells.rows] = ordered
    values[new] = _sums(density, within, new, threads)
    if sample is not None:
        values[new] = _with_own(density, values[new], new, drawn, weights)
    return CentreSums(values, sample, rate)


def _sums(density: GraspDensity, cells: Cells, rows: Indices, threads: int) -> Floats:
    """Sums over ``cells`` at rows' centres."""
    # Of all rows, neighbours one after the other: kernels stay in the processor's cache.
    order = density.cells.rows if len(rows) == density.size else np.arange(len(rows))

    def loop(p: Floats, q: Floats, out: Floats) -> None:
        isotropic.sums(cells.arrays, p, q, density.kernel.kappa, _RADIUS, density.wide, out)

    return cells.at_poses(loop, density.poses[rows], order=order, block=_QUERY_BLOCK, threads=threads)


def _systematic_sample(density: GraspDensity, rows: Indices, rate: float) -> tuple[Indices, Floats]:
    """Systematic sample of rows in the order given, with the weights that make its sums unbiased."""
    probability = np.minimum(rate * density.raw_weights[rows], 1.0)
    steps = np.floor(np.cumsum(probability) + 0.5)
    chosen = np.diff(steps, prepend=0.0) > 0.0
    return rows[chosen], density.raw_weights[rows[chosen]] / probability[chosen]


def _cells(density: GraspDensity, rows: Indices, weights: Floats) -> Cells:
    """Some rows' kernels, weighted anew."""
    some = Rows(density.poses[rows], weights, density.symmetric[rows])
    return Cells.build(some, density.kernel.sigma_position_m)


def _with_own(
    density: GraspDensity, values: Floats, rows: Indices, drawn: Indices, weights: Floats
) -> Floats:
    """Estimated sums with every row's own kernel as it is: drawn rows would outrank their neighbours."""
    own = density.raw_weights.copy()
    own[drawn] -= weights
    return values + (own * np.where(density.symmetric, 0.5, 1.0))[rows]


def _reached(density: GraspDensity, rows: Indices) -> Indices:
    """How many kernels are visited for the sum at each of some centres."""
    out = np.empty(len(rows), dtype=np.int64)
    isotropic.reached(density.cells.arrays, *density.poses[rows], _RADIUS, out)
    return out
