"""Kernels nearest to a pose, in the kernel's own measure: those of the highest exponents."""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from .isotropic import empty_runs, place, runs_within
from .isotropic_runs import LEAST, cosines, nearest_of_run, single, squared
from .options import fast

F32 = np.float32
__all__ = ["GATHERED", "exponents", "nearest_anywhere", "nearest_each", "nearest_rows"]

#: Exponents taken at a time.
GATHERED = 512


@fast
def exponents(data, begin, end, at, twin, out):
    """Exponents of a run's nearest ends."""
    for k in range(np.uint64(end - begin)):
        i = np.uint64(begin) + k
        own, other = cosines(data, i, at)
        out[k] = max(abs(own), abs(other * twin)) - at.kappa - squared(data, i, at)


@fast
def _insert(value, index, best, rows):
    """Put a value into a descending list that is full, where it belongs."""
    k = best.shape[0] - 1
    while k > 0 and best[k - 1] < value:
        best[k], rows[k] = best[k - 1], rows[k - 1]
        k -= 1
    best[k], rows[k] = value, index


@fast
def nearest_rows(cells, position, quaternion, kappa, radius, best, rows):
    """The kernels within ``radius`` with the highest exponents at a pose: ``best`` (C,), descending, and
    their places among the sorted kernels, ``rows`` (C,); -1e30 and -1 where there are no more.
    """
    runs = empty_runs(cells, GATHERED)
    buffer = np.empty(GATHERED, dtype=np.float32)
    at = place(cells, position, quaternion, kappa)
    near = single(at)
    best[:] = -1e30
    rows[:] = -1
    last = best.shape[0] - 1
    for r in range(runs_within(cells, at, radius, GATHERED, runs)):
        begin, end = runs[r, 0], runs[r, 1]
        exponents(cells.data, begin, end, near, F32(runs[r, 2]), buffer)
        for i in range(end - begin):
            if buffer[i] > best[last]:
                _insert(buffer[i], begin + i, best, rows)


@fast
def nearest_each(cells, positions, quaternions, kappa, radius, best, rows):
    """Of every pose, the highest exponent (M,) within ``radius`` and whose it is, as `nearest_rows`."""
    for j in range(positions.shape[0]):
        one = slice(j, j + 1)
        nearest_rows(cells, positions[j], quaternions[j], kappa, radius, best[one], rows[one])


@fast
def nearest_anywhere(cells, positions, quaternions, kappa, out):
    """Of every pose, the largest exponent however far away, and its place, into ``out`` (M, 2).

    Blocks whose bounding box proves every exponent to lie below the best one are left out.
    """
    boxes, blocks = cells.boxes, cells.blocks
    bound = np.empty(blocks.shape[0], dtype=np.float32)
    for j in range(positions.shape[0]):
        near = single(place(cells, positions[j], quaternions[j], kappa))
        for b in range(blocks.shape[0]):
            gx = max(max(boxes[b, 0] - near.x, near.x - boxes[b, 3]), F32(0.0))
            gy = max(max(boxes[b, 1] - near.y, near.y - boxes[b, 4]), F32(0.0))
            gz = max(max(boxes[b, 2] - near.z, near.z - boxes[b, 5]), F32(0.0))
            bound[b] = -(gx * gx + gy * gy + gz * gz)
        # The block with the nearest box first, so that few others can hold a nearer kernel.
        first = int(np.argmax(bound))
        top, row = LEAST, -1
        for k in range(-1, blocks.shape[0]):
            b = first if k < 0 else k
            if bound[b] <= top or k == first:
                continue
            begin, end, twin = blocks[b, 0], blocks[b, 1], F32(blocks[b, 2])
            here, nearest = nearest_of_run(cells.data, begin, end, near, twin)
            if here > top:
                top, row = here, nearest
        out[j, 0], out[j, 1] = top, row
