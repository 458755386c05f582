"""What a density is worth at its own centres: the ranking that searches start from.

Exact where that is cheap. Where most kernels reach each other (many grasps of a small object), the sums over
all pairs would take many seconds; there a sample of the kernels stands for all. It is drawn systematically in
the order of the cells with probability proportional to weight, so that it is spread over space evenly, and
each drawn kernel counts by the inverse of its probability: the sums are unbiased and, at a maximum to which
hundreds of kernels contribute, within some 10 %. Searches make up for that with more starts, and with exact
sums for all they compare.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .._compiled import isotropic
from .._compiled.threads import for_blocks
from ..kde.cell_list import Cells
from ..se3 import Floats

if TYPE_CHECKING:
    from ..kde.isotropic import GraspDensity

__all__ = ["CentreSums", "centre_sums", "drawn"]

#: Three standard deviations rank centres well enough; refinement uses the full reach.
_RADIUS = 3.0 / math.sqrt(2.0)
#: Most pairs of kernels to sum: some 0.2 s on one core.
MOST_PAIRS = 5e8
_LEAST_SAMPLE = 4_096
_PROBES = 256
_QUERY_BLOCK = 1_024


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


def centre_sums(density: GraspDensity, known: CentreSums | None, threads: int) -> CentreSums:
    """The sums at all centres; ``known`` are those of the first rows, of before the density was extended."""
    if known is not None and len(known.values) == density.size:
        return known
    if known is not None and 8 * (density.size - len(known.values)) <= density.size:
        return _extended(density, known, threads)
    probes = np.linspace(0, density.size - 1, min(density.size, _PROBES)).astype(np.int64)
    pairs = density.size * float(_reached(density, probes).mean())
    rows = np.arange(density.size)
    if pairs <= MOST_PAIRS or density.size <= _LEAST_SAMPLE:
        return CentreSums(_sums(density, density.cells, rows, threads))
    size = max(_LEAST_SAMPLE, density.size * MOST_PAIRS / pairs)
    rate = size / float(density.raw_weights.sum())
    picked, weights = drawn(density, density.cells.rows.astype(np.int64), rate)
    sample = Cells.build(
        density.positions[picked],
        density.quaternions_xyzw[picked],
        weights,
        density.symmetric[picked],
        density.kernel.sigma_position_m,
    )
    values = _sums(density, sample, rows, threads)
    return CentreSums(_with_own(density, values, rows, picked, weights), sample, rate)


def _extended(density: GraspDensity, known: CentreSums, threads: int) -> CentreSums:
    """Sums completed with what rows that came since add to the old ones, and with their own."""
    first = len(known.values)
    cells, new = density.cells, np.arange(first, density.size)
    sample, rate = known.sample, known.rate
    if sample is None:
        adding, weights, within = new, density.raw_weights[new], cells
    else:
        adding, weights = drawn(density, new, rate)
        if len(adding):
            sample = sample.extend(
                density.positions[adding],
                density.quaternions_xyzw[adding],
                weights,
                density.symmetric[adding],
            )
        within = sample
    values = np.zeros(density.size)
    values[:first] = known.values
    ordered = values[cells.rows]
    if len(adding):
        isotropic.scatter_sums(
            cells.arrays,
            density.positions[adding], density.quaternions_xyzw[adding], weights, density.symmetric[adding],
            density.kernel.kappa, _RADIUS, density.wide, ordered,
        )  # fmt: skip
    values[cells.rows] = ordered
    values[new] = _sums(density, within, new, threads)
    if sample is not None:
        values[new] = _with_own(density, values[new], new, adding, weights)
    return CentreSums(values, sample, rate)


def _sums(density: GraspDensity, cells: Cells, rows: NDArray[np.int64], threads: int) -> Floats:
    """Sums over ``cells`` at rows' centres."""
    order = rows
    if len(rows) == density.size:
        # Neighbours one after the other: kernels stay in the processor's cache.
        order = density.cells.rows.astype(np.int64)
    positions, quaternions = density.positions[order], density.quaternions_xyzw[order]
    out = np.empty(len(order))

    def work(begin: int, end: int) -> None:
        isotropic.sums(
            cells.arrays, positions[begin:end],
            quaternions[begin:end], density.kernel.kappa, _RADIUS, density.wide, out[begin:end],
        )  # fmt: skip

    for_blocks(work, len(order), block=_QUERY_BLOCK, threads=threads)
    if order is rows:
        return out
    result = np.empty(len(order))
    result[order] = out
    return result


def drawn(density: GraspDensity, rows: NDArray[np.int64], rate: float) -> tuple[NDArray[np.int64], Floats]:
    """Systematic sample of rows in the order given, with the weights that make its sums unbiased."""
    probability = np.minimum(rate * density.raw_weights[rows], 1.0)
    steps = np.floor(np.cumsum(probability) + 0.5)
    chosen = np.diff(steps, prepend=0.0) > 0.0
    return rows[chosen], density.raw_weights[rows[chosen]] / probability[chosen]


def _with_own(
    density: GraspDensity,
    values: Floats,
    rows: NDArray[np.int64],
    picked: NDArray[np.int64],
    weights: Floats,
) -> Floats:
    """Estimated sums with every row's own kernel as it is: drawn rows would outrank their neighbours."""
    own = density.raw_weights.copy()
    own[picked] -= weights
    return values + (own * np.where(density.symmetric, 0.5, 1.0))[rows]


def _reached(density: GraspDensity, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many kernels are visited for the sum at each of some centres."""
    out = np.empty(len(rows), dtype=np.int64)
    cells = density.cells
    isotropic.reached(cells.arrays, density.positions[rows], _RADIUS, out)
    return out
