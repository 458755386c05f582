"""The default widths of an isotropic kernel.

15 mm and 15 degrees until there are 200 successes; from then on the widths under which rows are likeliest
given the rows outside their own block. Blocks are cubes three position widths wide: with plain leave-one-out,
the likelihood grows without bound as the kernel shrinks onto repeated poses, twins and grid neighbours.

Widths are chosen anew only when the number of successes doubles (200, 400, 800, ...), from the rows up to
there in commit order: so rows that arrive one by one and all at once lead to the same choice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from . import compiled, se3
from .cells import Cells
from .density import scaled_radius
from .kernels import HAAR_VOLUME, IsotropicKernel
from .se3 import Floats
from .threads import for_blocks

__all__ = ["DEFAULT_KERNEL", "WidthChoice", "choose_widths", "widths_prefix"]

DEFAULT_KERNEL = IsotropicKernel(0.015, math.radians(15.0))
FIRST_CHOICE = 200
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
        Rows the choice was made from, the first ones in commit order.
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


def choose_widths(
    positions: ArrayLike,
    quaternions_xyzw: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    symmetric: ArrayLike | bool = True,
    threads: int = 1,
) -> WidthChoice:
    """Choose widths for grasps (N, 3), (N, 4) in commit order."""
    p, q = se3.as_poses(positions, quaternions_xyzw)
    count = widths_prefix(len(p))
    if count == 0:
        return WidthChoice(DEFAULT_KERNEL, "default", 0, math.nan)
    w = np.ones(count) if weights is None else np.asarray(weights, dtype=np.float64)[:count]
    flags = np.broadcast_to(np.asarray(symmetric, dtype=bool), (len(p),))[:count]
    p, q, w = p[:count], q[:count], w / w.mean()
    best: tuple[float, IsotropicKernel] | None = None
    for step in _STEPS_POSITION:
        sigma = DEFAULT_KERNEL.sigma_position_m * 2.0 ** (0.5 * step)
        cells = Cells.build(p, q, w, flags, sigma)
        for turn in _STEPS_ROTATION:
            kernel = IsotropicKernel(sigma, DEFAULT_KERNEL.sigma_rotation * 2.0 ** (0.5 * turn))
            value = _held_out(kernel, cells, p, q, w, threads)
            if best is None or value > best[0]:
                best = value, kernel
    assert best is not None
    return WidthChoice(best[1], "leave-one-block-out", count, best[0])


def _held_out(kernel: IsotropicKernel, cells: Cells, p: Floats, q: Floats, w: Floats, threads: int) -> float:
    """Weighted mean log density of rows given those outside their block."""
    edge = BLOCK_WIDTHS * kernel.sigma_position_m
    low = p.min(axis=0)
    cell = np.floor((p - low) / edge).astype(np.int64)
    _, block = np.unique(cell, axis=0, return_inverse=True)
    block = block.reshape(-1).astype(np.int32)
    outside = w.sum() - np.bincount(block, weights=w)[block]
    # Evenly spaced in commit order: no generator, so the same rows give the same widths everywhere.
    held = np.unique(np.linspace(0, len(p) - 1, min(len(p), MOST_HELD_OUT)).astype(np.int64))
    held = held[outside[held] > 0.0]
    if not held.size:
        return -math.inf
    out = np.empty(len(held))
    sorted_block = block[cells.rows]

    def work(begin: int, end: int) -> None:
        part = held[begin:end]
        compiled.other_blocks_sums(
            cells.data, sorted_block, cells.start, cells.table, cells.centre, cells.scale,
            p[part], q[part], block[part], kernel.kappa, scaled_radius(5.0), out[begin:end],
        )  # fmt: skip

    for_blocks(work, len(held), block=256, threads=threads)
    density = out / outside[held] * math.exp(kernel.log_peak)
    spread = np.maximum(p.max(axis=0) - low, 1e-3)
    uniform = 1.0 / (float(np.prod(spread)) * HAAR_VOLUME)
    values = np.log((1.0 - _UNIFORM_SHARE) * density + _UNIFORM_SHARE * uniform)
    return float(np.average(values, weights=w[held]))
