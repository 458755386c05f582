"""The default widths of an isotropic kernel.

15 mm and 15 degrees until there are 200 successes; from then on the widths under which rows are likeliest
given the rows outside their own block. Blocks are cubes three position widths wide: with plain leave-one-out,
the likelihood grows without bound as the kernel shrinks onto repeated poses, twins and grid neighbours.

Widths are chosen anew only when the number of successes doubles (200, 400, 800, ...), from the rows up to
there in commit order: so rows that arrive one by one and all at once lead to the same choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .._compiled import isotropic
from .._compiled.threads import for_blocks
from ..kde.cell_list import Cells
from ..kde.isotropic import scaled_radius
from ..kde.rows import Rows
from ..kernels.isotropic import HAAR_VOLUME, IsotropicKernel
from ..se3 import Floats
from ..success.calibration import numbered

__all__ = [
    "DEFAULT_KERNEL",
    "LEAST_ROWS",
    "WidthChoice",
    "WidthScore",
    "choose_widths",
    "score_widths",
    "widths_prefix",
]

DEFAULT_KERNEL = IsotropicKernel(0.015, math.radians(15.0))
FIRST_CHOICE = LEAST_ROWS = 200
MOST_ROWS = 20_000
#: Held-out rows evaluated for one pair of widths: their mean's standard error is then below 0.05 nats.
MOST_HELD_OUT = 2_000
BLOCK_WIDTHS = 3.0
_STEPS_POSITION, _STEPS_ROTATION = range(-3, 4), range(-2, 3)
#: Share of a uniform density mixed in, so that a row without neighbours counts as an outlier and no more.
_UNIFORM_SHARE = 1e-3


@dataclass(frozen=True, slots=True)
class WidthChoice:
    """Widths and what chose them.

    Attributes
    ----------
    kernel
    rule
        ``default`` or ``leave-one-block-out``.
    rows
        Rows the choice was made from, the first ones in commit order; by default from none, or from rows of
        which none could be left out.
    log_likelihood
        Mean held-out log density, nats of 1/(m^3 rad^3), nan for the default.
    """

    kernel: IsotropicKernel
    rule: str
    rows: int
    log_likelihood: float


def widths_prefix(count: int) -> int:
    """Rows from which widths are chosen while there are ``count``: 0 below 200, then 200, 400, ... up to
    20,000.

    Two counts with the same prefix have the same widths; nothing needs to be computed again between them.
    """
    if count < FIRST_CHOICE:
        return 0
    doublings = (count // FIRST_CHOICE).bit_length() - 1
    return min(FIRST_CHOICE << doublings, MOST_ROWS)


def choose_widths(rows: Rows, *, threads: int = 1) -> WidthChoice:
    """Choose widths for N grasps in commit order; by default where all lie in one block of every width."""
    count = widths_prefix(len(rows))
    if count == 0:
        return WidthChoice(DEFAULT_KERNEL, "default", 0, math.nan)
    first = rows[:count]
    best: tuple[float, IsotropicKernel] | None = None
    for kernel, held, values in _scored(first, threads):
        if not held.size:
            continue
        value = float(np.average(values, weights=first.weights[held]))
        if best is None or value > best[0]:
            best = value, kernel
    if best is None:
        return WidthChoice(DEFAULT_KERNEL, "default", count, math.nan)
    return WidthChoice(best[1], "leave-one-block-out", count, best[0])


@dataclass(frozen=True, slots=True)
class WidthScore:
    """How likely left-out rows are under a pair of widths.

    Attributes
    ----------
    log_likelihood, error : float
        Weighted mean log density, nats of 1/(m^3 rad^3), and its standard error over cubes of space; nan
        where no row has another outside its block.
    below_best, below_best_error : float
        How far it is below the best pair's mean, and the standard error of that difference over the same
        rows.
    """

    kernel: IsotropicKernel
    log_likelihood: float
    error: float
    below_best: float
    below_best_error: float


def score_widths(
    rows: Rows, *, threads: int = 1, progress: Callable[[float], None] | None = None
) -> list[WidthScore]:
    """Every pair of widths that `choose_widths` tries, by the likelihood it chooses by.

    More than `MOST_ROWS` rows are thinned evenly.

    Raises
    ------
    ValueError
        For fewer than `LEAST_ROWS` rows, saying how many more are needed.
    """
    count = len(rows)
    if count < LEAST_ROWS:
        raise ValueError(
            f"widths are told apart from {LEAST_ROWS} successes on; there are {count}, so"
            f" {LEAST_ROWS - count} more are needed"
        )
    rows = rows[np.unique(np.linspace(0, count - 1, min(count, MOST_ROWS)).astype(np.int64))]
    p, w = rows.poses.positions, rows.weights / rows.weights.mean()
    # Neighbours are alike: errors count cubes as wide as the widest block, not rows.
    edge = BLOCK_WIDTHS * DEFAULT_KERNEL.sigma_position_m * 2.0 ** (0.5 * _STEPS_POSITION[-1])
    cube = numbered(np.floor((p - p.min(axis=0)) / edge))
    tables = []
    for kernel, held, values in _scored(rows, threads):
        full = np.full(len(p), np.nan)
        full[held] = values
        tables.append((kernel, full))
        if progress is not None:
            progress(len(tables) / (len(_STEPS_POSITION) * len(_STEPS_ROTATION)))
    means = [_mean_and_error(full, w, cube)[0] for _, full in tables]
    if not np.isfinite(means).any():
        raise ValueError("all grasps lie in one block, so that none can be left out: add trials elsewhere")
    best = tables[int(np.nanargmax(means))][1]
    return [
        WidthScore(kernel, *_mean_and_error(full, w, cube), *_mean_and_error(best - full, w, cube))
        for kernel, full in tables
    ]


def _mean_and_error(values: Floats, weights: Floats, cube: NDArray[np.int64]) -> tuple[float, float]:
    """Weighted mean of what is known, and its standard error over cubes."""
    known = np.isfinite(values)
    if not known.any():
        return math.nan, math.nan
    v, w = values[known], weights[known]
    mean = float(np.average(v, weights=w))
    sums = np.bincount(cube[known], weights=w * (v - mean))
    return mean, float(np.linalg.norm(sums) / w.sum())


def _scored(rows: Rows, threads: int) -> Iterator[tuple[IsotropicKernel, NDArray[np.int64], Floats]]:
    """Every pair of widths with the rows left out and their log density under it."""
    rows = rows.over(float(rows.weights.mean()))
    for step in _STEPS_POSITION:
        sigma = DEFAULT_KERNEL.sigma_position_m * 2.0 ** (0.5 * step)
        kernels = [
            IsotropicKernel(sigma, DEFAULT_KERNEL.sigma_rotation * 2.0 ** (0.5 * turn))
            for turn in _STEPS_ROTATION
        ]
        held, values = _held_out(kernels, rows, threads)
        for kernel, column in zip(kernels, values, strict=True):
            yield kernel, held, column


def _held_out(kernels: list[IsotropicKernel], rows: Rows, threads: int) -> tuple[NDArray[np.int64], Floats]:
    """Rows (H,), and their log densities (T, H) given those outside their block, under kernels of one
    position width and of the rotation widths of `_STEPS_ROTATION`.
    """
    (p, q), w = rows.poses, rows.weights
    edge = BLOCK_WIDTHS * kernels[0].sigma_position_m
    low = p.min(axis=0)
    block = numbered(np.floor((p - low) / edge)).astype(np.int32)
    outside = w.sum() - np.bincount(block, weights=w)[block]
    # Evenly spaced in commit order: no generator, so the same rows give the same widths everywhere.
    held = np.unique(np.linspace(0, len(p) - 1, min(len(p), MOST_HELD_OUT)).astype(np.int64))
    held = held[outside[held] > 0.0]
    if not held.size:
        return held, np.empty((len(kernels), 0))
    cells = Cells.build(rows, kernels[0].sigma_position_m)
    out = np.empty((len(held), len(kernels)))
    sorted_block = block[cells.rows]

    def work(begin: int, end: int) -> None:
        part = held[begin:end]
        # From width to width the concentration halves: the widest has the least.
        isotropic.other_blocks_sums(
            cells.arrays, sorted_block, p[part], q[part], block[part],
            kernels[-1].kappa, scaled_radius(5.0), out[begin:end, ::-1],
        )  # fmt: skip

    for_blocks(work, len(held), block=256, threads=threads)
    peaks = np.exp([kernel.log_peak for kernel in kernels])
    density = out.T / outside[held] * peaks[:, None]
    spread = np.maximum(p.max(axis=0) - low, 1e-3)
    uniform = 1.0 / (float(np.prod(spread)) * HAAR_VOLUME)
    return held, np.log((1.0 - _UNIFORM_SHARE) * density + _UNIFORM_SHARE * uniform)
