"""Compiled loops over kernels: the hot path of every density.

Layout. Kernels are float32 structures of arrays, rows of ``data`` (8, N): x, y, z, then the quaternion's x,
y, z, w, then the weight. Positions are centred and divided by ``sigma sqrt(2)``, so a squared distance is the
exponent itself. Kernels are sorted by grid cell with z fastest, so that what a query reaches in one column of
cells is one contiguous run.

``table`` (S, COLUMNS) describes the segments: kernels are kept in a few independently sorted ranges, one for
rows with the jaw's symmetry and one for rows without, each followed by a short tail of what came later.

Accumulation is float32 within a block of at most ``BLOCK`` kernels and float64 across.
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import isotropic_runs
from .isotropic_runs import At, single
from .options import fast, inlined

F32 = np.float32
BLOCK = 2048

#: Columns of the segment table.
OFFSET, COUNT, STARTS, NX, NY, NZ, OX, OY, OZ, EDGE, EDGE_Z, TWIN, LOW, HIGH = (
    0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 15,
)  # fmt: skip
COLUMNS = 18
#: Most columns of cells a query may reach; `cells.build` keeps edges wide enough for it.
MAX_RUNS = 8192

_ZERO = F32(0.0)
#: Kernels in a block that every pose of a call passes over: its columns stay in the first-level cache.
_TILE = 1024
#: No sum is as large.
_NEVER = 1e300


class CellArrays(NamedTuple):
    """Sorted kernels as every loop takes them; `kde.cell_list` makes them.

    Attributes
    ----------
    data : (8, N) float32, start : (cells,) int32, table : (S, COLUMNS)
    blocks : (B, 3) int64
        First and last + 1 row of a block, 1 for rows with a twin.
    boxes : (B, 6) float32
        Lowest and highest corner of a block's positions, scaled units.
    centre : (3,) metres
    scale : float
        1 / (sigma sqrt 2), 1/m.
    """

    data: NDArray[np.float32]
    start: NDArray[np.int32]
    table: NDArray[np.float64]
    blocks: NDArray[np.int64]
    boxes: NDArray[np.float32]
    centre: NDArray[np.float64]
    scale: float


@inlined
def place(cells, position, quaternion, kappa):
    """Where a pose stands among sorted kernels."""
    return At(
        (position[0] - cells.centre[0]) * cells.scale,
        (position[1] - cells.centre[1]) * cells.scale,
        (position[2] - cells.centre[2]) * cells.scale,
        quaternion[0] * kappa,
        quaternion[1] * kappa,
        quaternion[2] * kappa,
        quaternion[3] * kappa,
        kappa,
    )


@inlined
def empty_runs(cells, most):
    """Room for what `runs_within` finds."""
    return np.empty((MAX_RUNS + cells.data.shape[1] // most, 3), dtype=np.int64)


@fast
def runs_within(cells, at, radius, most, runs):
    """Ranges of kernels in the cells that a ball reaches, of at most ``most`` rows each, into ``runs``: first
    row, last + 1, and 1 for rows with a twin; their number.
    """
    count = 0
    for s in range(cells.table.shape[0]):
        count = _segment_runs(cells.start, cells.table[s], at, radius, most, runs, count)
    return count


@fast
def _segment_runs(start, row, at, radius, most, runs, count):
    """`runs_within` for one segment, a row of the table, behind ``count`` ranges that there are.

    Cells at the border of the grid are unbounded outwards: they hold the outliers that the grid does not
    span.
    """
    for axis in range(3):
        p = at.x if axis == 0 else (at.y if axis == 1 else at.z)
        if p < row[LOW + axis] - radius or p > row[HIGH + axis] + radius:
            return count
    nx, ny, nz = int(row[NX]), int(row[NY]), int(row[NZ])
    edge, edge_z = row[EDGE], row[EDGE_Z]
    base, offset = int(row[STARTS]), int(row[OFFSET])
    x, y, z = at.x - row[OX], at.y - row[OY], at.z - row[OZ]
    x0 = min(max(math.floor((x - radius) / edge), 0), nx - 1)
    x1 = min(max(math.floor((x + radius) / edge), 0), nx - 1)
    y0 = min(max(math.floor((y - radius) / edge), 0), ny - 1)
    y1 = min(max(math.floor((y + radius) / edge), 0), ny - 1)
    for ix in range(x0, x1 + 1):
        gap_x = 0.0
        if ix > 0 and x < ix * edge:
            gap_x = ix * edge - x
        elif ix < nx - 1 and x > (ix + 1) * edge:
            gap_x = x - (ix + 1) * edge
        for iy in range(y0, y1 + 1):
            gap_y = 0.0
            if iy > 0 and y < iy * edge:
                gap_y = iy * edge - y
            elif iy < ny - 1 and y > (iy + 1) * edge:
                gap_y = y - (iy + 1) * edge
            left = radius * radius - gap_x * gap_x - gap_y * gap_y
            if left < 0.0:
                continue
            reach = math.sqrt(left)
            z0 = min(max(math.floor((z - reach) / edge_z), 0), nz - 1)
            z1 = min(max(math.floor((z + reach) / edge_z), 0), nz - 1)
            column = base + (ix * ny + iy) * nz
            begin, end = offset + start[column + z0], offset + start[column + z1 + 1]
            while begin < end and count < runs.shape[0]:
                stop = min(begin + most, end)
                runs[count, 0], runs[count, 1], runs[count, 2] = begin, stop, int(row[TWIN])
                count += 1
                begin = stop
    return count


@fast
def _sum_at(cells, at, radius, wide, runs):
    """Sum of weights times kernels (1 at a centre) within ``radius``, their k r^2, and how many were visited.

    ``wide`` is 0 where the nearest of twins and antipodes stands for all, 1 where both twins count, 2 where
    antipodes do too.
    """
    data, near = cells.data, single(at)
    total, spread, visited = 0.0, 0.0, 0
    for r in range(runs_within(cells, at, radius, BLOCK, runs)):
        begin, end, twin = runs[r, 0], runs[r, 1], F32(runs[r, 2])
        visited += end - begin
        full = end - (end - begin) % isotropic_runs.LANES
        if wide == 0 and twin > _ZERO and full + isotropic_runs.LANES <= data.shape[1]:
            if full > begin:
                part = isotropic_runs.run_narrow(data, begin, full, near)
                total += part[0]
                spread += part[1]
            if end > full:
                part = isotropic_runs.rest_narrow(data, full, end, near)
                total += part[0]
                spread += part[1]
        else:
            part = isotropic_runs.run(data, begin, end, near, twin, wide)
            total += part[0]
            spread += part[1]
    return total, spread, visited


@fast
def exact_log_sum(data, blocks, boxes, at, margin):
    """Log of the sum over all kernels, without a cut-off; right however far the pose is from data.

    Blocks of kernels whose bounding box proves every exponent to lie ``margin`` nats below the largest one
    found are left out: with ``margin = 16 + log(total weight / least weight)`` the sum is short of less than
    1.2e-7 of itself.
    """
    count = blocks.shape[0]
    bound = np.empty(count)
    first = 0
    for j in range(count):
        gx = max(max(boxes[j, 0] - at.x, at.x - boxes[j, 3]), 0.0)
        gy = max(max(boxes[j, 1] - at.y, at.y - boxes[j, 4]), 0.0)
        gz = max(max(boxes[j, 2] - at.z, at.z - boxes[j, 5]), 0.0)
        bound[j] = -(gx * gx + gy * gy + gz * gz)
        if bound[j] > bound[first]:
            first = j
    top = isotropic_runs.top_of_run(data, blocks[first, 0], blocks[first, 1], at, float(blocks[first, 2]))
    total = 0.0
    for j in range(count):
        if bound[j] < top - margin:
            continue
        twin = float(blocks[j, 2])
        here = isotropic_runs.top_of_run(data, blocks[j, 0], blocks[j, 1], at, twin)
        if here > top:
            total *= math.exp(top - here)
            top = here
        elif here < top - margin:
            continue
        total += isotropic_runs.sum_of_run(data, blocks[j, 0], blocks[j, 1], at, twin, top)
    return top + math.log(total)


@fast
def log_sums(cells, positions, quaternions, kappa, stages, wide, margin, out):
    """Log of the weighted kernel sum at every pose into ``out`` (M,).

    Parameters
    ----------
    stages : (T, 3)
        Radii to try in turn, each with the largest mean exponent of position and the least mean kernel at
        which what lies outside is too little to matter (see `kde.isotropic.stages`). A pose that passes none
        is summed without a cut-off.
    """
    runs = empty_runs(cells, BLOCK)
    for j in range(positions.shape[0]):
        at = place(cells, positions[j], quaternions[j], kappa)
        done = False
        for t in range(stages.shape[0]):
            total, spread, visited = _sum_at(cells, at, stages[t, 0], wide, runs)
            if total > 0.0 and spread <= stages[t, 1] * total and total >= stages[t, 2] * visited:
                out[j] = math.log(total)
                done = True
                break
        if not done:
            out[j] = exact_log_sum(cells.data, cells.blocks, cells.boxes, at, margin)


@fast
def all_sums(cells, positions, quaternions, kappa, wide, out):
    """The weighted sum over all kernels at every pose into ``out`` (M,), as brute force has it."""
    out[:] = 0.0
    for s in range(cells.table.shape[0]):
        twin = F32(cells.table[s, TWIN])
        begin = int(cells.table[s, OFFSET])
        end = begin + int(cells.table[s, COUNT])
        while begin < end:
            stop = min(begin + _TILE, end)
            for j in range(positions.shape[0]):
                near = single(place(cells, positions[j], quaternions[j], kappa))
                out[j] += isotropic_runs.total(cells.data, begin, stop, near, twin, wide)
            begin = stop


@fast
def all_log_sums(cells, positions, quaternions, kappa, wide, least, margin, out):
    """Log of the weighted sum over all kernels at every pose into ``out`` (M,), without a cut-off.

    By brute force, and where that gives less than ``least`` by `exact_log_sum`.
    """
    if least < _NEVER:
        all_sums(cells, positions, quaternions, kappa, wide, out)
    else:
        out[:] = 0.0
    for j in range(positions.shape[0]):
        if out[j] >= least:
            out[j] = math.log(out[j])
        else:
            at = place(cells, positions[j], quaternions[j], kappa)
            out[j] = exact_log_sum(cells.data, cells.blocks, cells.boxes, at, margin)


@fast
def sums(cells, positions, quaternions, kappa, radius, wide, out):
    """The weighted kernel sum within ``radius`` at every pose, zero where nothing is in reach."""
    runs = empty_runs(cells, BLOCK)
    for j in range(positions.shape[0]):
        at = place(cells, positions[j], quaternions[j], kappa)
        near = single(at)
        out[j] = 0.0
        for r in range(runs_within(cells, at, radius, BLOCK, runs)):
            begin, end, twin = runs[r, 0], runs[r, 1], F32(runs[r, 2])
            out[j] += isotropic_runs.total(cells.data, begin, end, near, twin, wide)


@fast
def reached(cells, positions, quaternions, radius, out):
    """How many kernels a sum at each pose visits, into ``out`` (M,) int64."""
    runs = empty_runs(cells, BLOCK)
    for j in range(positions.shape[0]):
        at = place(cells, positions[j], quaternions[j], 1.0)
        out[j] = 0
        for r in range(runs_within(cells, at, radius, BLOCK, runs)):
            out[j] += runs[r, 1] - runs[r, 0]


@fast
def scatter_sums(cells, positions, quaternions, weights, twins, kappa, radius, wide, out):
    """Add the kernels of the given rows to the sums ``out`` (N,) at every sorted kernel's centre."""
    runs = empty_runs(cells, BLOCK)
    every = F32(1.0) if wide > 0 else F32(0.0)
    for j in range(positions.shape[0]):
        at = place(cells, positions[j], quaternions[j], kappa)
        near = single(at)
        twin = F32(1.0) if twins[j] else F32(0.0)
        weight = F32(weights[j] * (0.5 if twins[j] else 1.0))
        for r in range(runs_within(cells, at, radius, BLOCK, runs)):
            isotropic_runs.scatter_run(cells.data, runs[r, 0], runs[r, 1], near, twin, every, weight, out)


@fast
def square_sums(cells, positions, quaternions, kappa, radius, wide, out):
    """Sums of k and k^2 at every pose into ``out`` (M, 2), over kernels with an exponent of at most radius^2.

    ``radius`` is the cut-off over sqrt 2: position and rotation share the allowance. The cut is exact,
    because far from data it decides between an attempt and none. Where ``out`` has four columns, the largest
    exponent and its place follow, -1e30 and -1 where none is above the cut.
    """
    runs, cut = empty_runs(cells, BLOCK), F32(radius * radius)
    of_run = np.empty(runs.shape[0])
    for j in range(positions.shape[0]):
        at = place(cells, positions[j], quaternions[j], kappa)
        near = single(at)
        out[j, :] = 0.0
        count = runs_within(cells, at, radius, BLOCK, runs)
        for r in range(count):
            begin, end, twin = runs[r, 0], runs[r, 1], F32(runs[r, 2])
            # The constant lets LLVM make a loop of its own of either.
            if wide:
                part = isotropic_runs.squares_run(cells.data, begin, end, near, twin, True, cut)
            else:
                part = isotropic_runs.squares_run(cells.data, begin, end, near, twin, False, cut)
            out[j, 0] += part[0]
            out[j, 1] += part[1]
            of_run[r] = part[0]
        if out.shape[1] > 2:
            out[j, 2], out[j, 3] = _nearest_by_sums(cells.data, near, runs, of_run[:count])


@fast
def _nearest_by_sums(data, near, runs, of_run):
    """The largest exponent of some runs, and its place, by the sums of their kernels, which are used up.

    No kernel is larger than its run's sum, so few runs are looked through. A row counts one half at least.
    """
    top, row = -1e30, -1
    for _ in range(of_run.shape[0]):
        r = int(np.argmax(of_run))
        if of_run[r] <= 0.0 or of_run[r] < 0.499 * math.exp(top):
            break
        begin, end, twin = runs[r, 0], runs[r, 1], F32(runs[r, 2])
        here, place = isotropic_runs.nearest_of_run(data, begin, end, near, twin)
        if here > top:
            top, row = float(here), place
        of_run[r] = 0.0
    return top, float(row)


@fast
def other_blocks_sums(cells, block, positions, quaternions, own, kappa, radius, out):
    """Kernel sums at poses (M,) over the sorted kernels whose ``block`` (N,) int32 differs from ``own``
    (M,), into ``out`` (M, 5): under ``kappa``, and under twice, four, eight and sixteen times that.
    """
    runs = empty_runs(cells, BLOCK)
    for j in range(positions.shape[0]):
        at = place(cells, positions[j], quaternions[j], kappa)
        near = single(at)
        t0, t1, t2, t3, t4 = 0.0, 0.0, 0.0, 0.0, 0.0
        for r in range(runs_within(cells, at, radius, BLOCK, runs)):
            begin, end, twin = runs[r, 0], runs[r, 1], F32(runs[r, 2])
            part = isotropic_runs.other_blocks_run(cells.data, block, own[j], begin, end, near, twin)
            t0, t1, t2, t3, t4 = t0 + part[0], t1 + part[1], t2 + part[2], t3 + part[3], t4 + part[4]
        out[j, 0], out[j, 1], out[j, 2], out[j, 3], out[j, 4] = t0, t1, t2, t3, t4
