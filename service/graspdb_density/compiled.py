"""Compiled loops over kernels: the hot path of every density.

Layout. Kernels are float32 structures of arrays, rows of ``data`` (8, N): x, y, z, then the quaternion's x,
y, z, w, then the weight. Positions are centred and divided by ``sigma sqrt(2)``, so a squared distance is the
exponent itself. Kernels are sorted by grid cell with z fastest, so that what a query reaches in one column of
cells is one contiguous run.

``table`` (S, COLUMNS) describes the segments: kernels are kept in a few independently sorted ranges, one for
rows with the jaw's symmetry and one for rows without, each followed by a short tail of what came later.

The exponential is a power of two: the argument over ln 2 is split into its nearest integer, which goes to the
exponent's bits, and a rest, of which a fifth-degree polynomial is taken. The error grows with the argument,
like that of the arguments themselves, and it is half the work of an exact reduction (Cephes expf).

LLVM turns the whole loop into vector code only with unsigned indices (signed ones wrap around in Python) and
without slices, whose reference counts would cost more than a short run; ``tests/benchmarks`` notice a loss.

Accumulation is float32 within a block of at most ``BLOCK`` kernels and float64 across.
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from .compiler import fast, inlined

F32 = np.float32
BLOCK = 2048
#: Kernels in the vectors that a loop takes at once, with AVX-512; a multiple of what it takes elsewhere.
LANES = 32

#: Columns of the segment table.
OFFSET, COUNT, STARTS, NX, NY, NZ, OX, OY, OZ, EDGE, EDGE_Z, TWIN, LOW, HIGH = (
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    8,
    9,
    10,
    11,
    12,
    15,
)
COLUMNS = 18
#: Most columns of cells a query may reach; `cells.build` keeps edges wide enough for it.
MAX_RUNS = 8192

_LOG2E = F32(1.44269504088896341)
#: 2^r over -1/2 <= r <= 1/2, least largest relative error (7.5e-8): fitted by weighted least squares.
_P0, _P1, _P2 = F32(1.00000007), F32(0.69314697), F32(0.2402212)
_P3, _P4, _P5 = F32(0.05550713), F32(0.00967554), F32(0.00132765)
_ZERO = F32(0.0)
#: 2^-108 times a weight is still a normal number: results that are not cost a hundred cycles each.
_FLOOR = F32(-108.0)
#: Kernels in a block that every pose of a call passes over: its columns stay in the first-level cache.
_TILE = 1024
#: No sum is as large.
_NEVER = 1e300


@intrinsic
def _times_power_of_two(typing_context: Any, value: Any, power: Any) -> Any:
    """A float32 times 2^power (int32), both factors and the product normal: added to the exponent's bits."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.bitcast(arguments[0], ir.IntType(32))
        raised = builder.add(bits, builder.shl(arguments[1], ir.Constant(ir.IntType(32), 23)))
        return builder.bitcast(raised, ir.FloatType())

    return types.float32(types.float32, types.int32), generate


@inlined
def _exp2(t: Any) -> Any:
    """2^t in float32 for -108 <= t <= 115, relative error below 3e-7 + 6e-8 |t|; smaller t give 2^-108."""
    t = max(t, _FLOOR)
    k = np.rint(t)
    r = t - k
    y = _P5 * r + _P4
    y = y * r + _P3
    y = y * r + _P2
    y = y * r + _P1
    y = y * r + _P0
    return _times_power_of_two(y, np.int32(k))  # type: ignore[call-arg]


@inlined
def _exp(x: Any) -> Any:
    """e^x in float32 for -75 <= x <= 80, relative error below 3e-7 + 1e-7 |x|; smaller x give 3e-33."""
    return _exp2(x * _LOG2E)


@fast
def _run_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa):
    """Sums of k and k r^2 over rows with a twin, where the antipode's and the farther twin's share is
    negligible.

    (qx..qw) is kappa times the quaternion. Here and below both are taken to base 2 once, so that no kernel
    has to.
    """
    qx, qy, qz, qw, kappa = qx * _LOG2E, qy * _LOG2E, qz * _LOG2E, qw * _LOG2E, kappa * _LOG2E
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        b = data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz
        r2 = dx * dx + dy * dy + dz * dz
        k = data[7, i] * _exp2((max(abs(a), abs(b)) - kappa) - r2 * _LOG2E)
        total += k
        spread += k * r2
    return total, spread


@fast
def _rest_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa):
    """`_run_narrow` over fewer than ``LANES`` rows, of which there are that many from ``begin`` on: whole
    vectors of which the end is thrown away, where LLVM would take the rest of a loop one by one.
    """
    qx, qy, qz, qw, kappa = qx * _LOG2E, qy * _LOG2E, qz * _LOG2E, qw * _LOG2E, kappa * _LOG2E
    total, spread = _ZERO, _ZERO
    first, count = np.uint64(begin), np.int32(end - begin)
    for j in range(np.uint64(LANES)):
        i = first + j
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        b = data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz
        r2 = dx * dx + dy * dy + dz * dz
        k = data[7, i] * _exp2((max(abs(a), abs(b)) - kappa) - r2 * _LOG2E)
        k = k if np.int32(j) < count else _ZERO
        total += k
        spread += k * r2
    return total, spread


@fast
def _total_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa):
    """As `_run_narrow` without k r^2, which only a cut-off needs to know: a sixth less work."""
    qx, qy, qz, qw, kappa = qx * _LOG2E, qy * _LOG2E, qz * _LOG2E, qw * _LOG2E, kappa * _LOG2E
    total = _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        b = data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz
        r2 = dx * dx + dy * dy + dz * dz
        total += data[7, i] * _exp2((max(abs(a), abs(b)) - kappa) - r2 * _LOG2E)
    return total


@fast
def _run_single(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa):
    """As `_run_narrow` over rows without a twin."""
    qx, qy, qz, qw, kappa = qx * _LOG2E, qy * _LOG2E, qz * _LOG2E, qw * _LOG2E, kappa * _LOG2E
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        r2 = dx * dx + dy * dy + dz * dz
        k = data[7, i] * _exp2((abs(a) - kappa) - r2 * _LOG2E)
        total += k
        spread += k * r2
    return total, spread


@fast
def _run_twins(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin):
    """Sums of k and k r^2 over both twins, each by its nearer end."""
    qx, qy, qz, qw, kappa = qx * _LOG2E, qy * _LOG2E, qz * _LOG2E, qw * _LOG2E, kappa * _LOG2E
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        r2 = dx * dx + dy * dy + dz * dz
        base = -kappa - r2 * _LOG2E
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        b = data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz
        k = data[7, i] * (_exp2(base + abs(a)) + twin * _exp2(base + abs(b)))
        total += k
        spread += k * r2
    return total, spread


@fast
def _run_wide(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin):
    """Sums of k and k r^2 with every term: both twins, each with its antipode."""
    qx, qy, qz, qw, kappa = qx * _LOG2E, qy * _LOG2E, qz * _LOG2E, qw * _LOG2E, kappa * _LOG2E
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        r2 = dx * dx + dy * dy + dz * dz
        base = -kappa - r2 * _LOG2E
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        b = data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz
        own = _exp2(base + a) + _exp2(base - a)
        other = _exp2(base + b) + _exp2(base - b)
        k = data[7, i] * (own + twin * other)
        total += k
        spread += k * r2
    return total, spread


@fast
def _moments_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, sums):
    """As `_moments_wide` with the nearest of twins and antipodes standing for all."""
    qx, qy, qz, qw, kappa = qx * _LOG2E, qy * _LOG2E, qz * _LOG2E, qw * _LOG2E, kappa * _LOG2E
    s = _ZERO
    sx, sy, sz = _ZERO, _ZERO, _ZERO
    m0, m1, m2, m3 = _ZERO, _ZERO, _ZERO, _ZERO
    rr = _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        r2 = dx * dx + dy * dy + dz * dz
        u0, u1, u2, u3 = data[3, i], data[4, i], data[5, i], data[6, i]
        a = u0 * qx + u1 * qy + u2 * qz + u3 * qw
        b = (u0 * qy - u1 * qx + u2 * qw - u3 * qz) * twin
        own = abs(a) >= abs(b)
        near = a if own else b
        k = data[7, i] * _exp2((abs(near) - kappa) - r2 * _LOG2E)
        g = k if near >= _ZERO else -k
        ga = g if own else _ZERO
        gb = _ZERO if own else g
        s += k
        sx += k * dx
        sy += k * dy
        sz += k * dz
        m0 += ga * u0 - gb * u1
        m1 += ga * u1 + gb * u0
        m2 += ga * u2 - gb * u3
        m3 += ga * u3 + gb * u2
        rr += k * r2
    sums[0] += s
    sums[1] += sx
    sums[2] += sy
    sums[3] += sz
    sums[4] += m0
    sums[5] += m1
    sums[6] += m2
    sums[7] += m3
    sums[8] += rr


@fast
def _moments_wide(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, sums):
    """Add to ``sums`` (9,): k, k (p_i - p), the signed pull k mu_i of the quaternion, and k r^2, scaled
    units.
    """
    qx, qy, qz, qw, kappa = qx * _LOG2E, qy * _LOG2E, qz * _LOG2E, qw * _LOG2E, kappa * _LOG2E
    s = _ZERO
    sx, sy, sz = _ZERO, _ZERO, _ZERO
    m0, m1, m2, m3 = _ZERO, _ZERO, _ZERO, _ZERO
    rr = _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        r2 = dx * dx + dy * dy + dz * dz
        u0, u1, u2, u3 = data[3, i], data[4, i], data[5, i], data[6, i]
        a = u0 * qx + u1 * qy + u2 * qz + u3 * qw
        b = (u0 * qy - u1 * qx + u2 * qw - u3 * qz) * twin
        base = -kappa - r2 * _LOG2E
        w = data[7, i]
        large, small = max(abs(a), abs(b)), min(abs(a), abs(b))
        k1 = w * _exp2(base + large)
        k2 = w * twin * _exp2(base + small)
        k3 = w * _exp2(base - large)
        k4 = w * twin * _exp2(base - small)
        own_near = abs(a) >= abs(b)
        ga = (k1 - k3) if own_near else (k2 - k4)
        gb = (k2 - k4) if own_near else (k1 - k3)
        ga = ga if a >= _ZERO else -ga
        gb = gb if b >= _ZERO else -gb
        k = k1 + k2 + k3 + k4
        s += k
        sx += k * dx
        sy += k * dy
        sz += k * dz
        # The twin of mu is (mu_y, -mu_x, mu_w, -mu_z), as b pairs it with q.
        m0 += ga * u0 - gb * u1
        m1 += ga * u1 + gb * u0
        m2 += ga * u2 - gb * u3
        m3 += ga * u3 + gb * u2
        rr += k * r2
    sums[0] += s
    sums[1] += sx
    sums[2] += sy
    sums[3] += sz
    sums[4] += m0
    sums[5] += m1
    sums[6] += m2
    sums[7] += m3
    sums[8] += rr


@fast
def _runs(start, table, s, px, py, pz, radius, runs):
    """Ranges of kernels in the cells of segment ``s`` that a ball reaches, into ``runs`` (MAX_RUNS, 2); their
    number.

    Cells at the border of the grid are unbounded outwards: they hold the outliers that the grid does not
    span.
    """
    row = table[s]
    for axis in range(3):
        p = px if axis == 0 else (py if axis == 1 else pz)
        if p < row[LOW + axis] - radius or p > row[HIGH + axis] + radius:
            return 0
    nx, ny, nz = int(row[NX]), int(row[NY]), int(row[NZ])
    edge, edge_z = row[EDGE], row[EDGE_Z]
    base, offset = int(row[STARTS]), int(row[OFFSET])
    x, y, z = px - row[OX], py - row[OY], pz - row[OZ]
    x0 = min(max(math.floor((x - radius) / edge), 0), nx - 1)
    x1 = min(max(math.floor((x + radius) / edge), 0), nx - 1)
    y0 = min(max(math.floor((y - radius) / edge), 0), ny - 1)
    y1 = min(max(math.floor((y + radius) / edge), 0), ny - 1)
    count = 0
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
            begin, end = start[column + z0], start[column + z1 + 1]
            if end > begin and count < runs.shape[0]:
                runs[count, 0] = offset + begin
                runs[count, 1] = offset + end
                count += 1
    return count


@fast
def _run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, wide):
    """Sums of k and k r^2 over rows that all have a twin or have none; `_sum_at` says what ``wide`` is."""
    if wide == 2:
        return _run_wide(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin)
    if wide == 1:
        return _run_twins(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin)
    if twin > _ZERO:
        return _run_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa)
    return _run_single(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa)


@fast
def _total(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, wide):
    """The first of what `_run` gives."""
    if wide == 0 and twin > _ZERO:
        return _total_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa)
    return _run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, wide)[0]


@fast
def _sum_at(data, start, table, px, py, pz, q, kappa, radius, wide, runs):
    """Sum of weights times kernels (1 at a centre) within ``radius``, their k r^2, and how many were visited.

    ``wide`` is 0 where the nearest of twins and antipodes stands for all, 1 where both twins count, 2 where
    antipodes do too.
    """
    fx, fy, fz = F32(px), F32(py), F32(pz)
    k = F32(kappa)
    q0, q1, q2, q3 = F32(q[0] * kappa), F32(q[1] * kappa), F32(q[2] * kappa), F32(q[3] * kappa)
    total, spread, visited = 0.0, 0.0, 0
    for s in range(table.shape[0]):
        twin = F32(table[s, TWIN])
        for r in range(_runs(start, table, s, px, py, pz, radius, runs)):
            begin, end = runs[r, 0], runs[r, 1]
            visited += end - begin
            while begin < end:
                stop = min(begin + BLOCK, end)
                full = stop - (stop - begin) % LANES
                if wide == 0 and twin > _ZERO and full + LANES <= data.shape[1]:
                    if full > begin:
                        part = _run_narrow(data, begin, full, fx, fy, fz, q0, q1, q2, q3, k)
                        total += part[0]
                        spread += part[1]
                    if stop > full:
                        part = _rest_narrow(data, full, stop, fx, fy, fz, q0, q1, q2, q3, k)
                        total += part[0]
                        spread += part[1]
                else:
                    part = _run(data, begin, stop, fx, fy, fz, q0, q1, q2, q3, k, twin, wide)
                    total += part[0]
                    spread += part[1]
                begin = stop
    return total, spread, visited


@fast
def moments_at(data, start, table, px, py, pz, q, kappa, radius, wide, runs, sums):
    """Fill ``sums`` (9,) with the moments of `_moments_wide` over the kernels within ``radius``."""
    fx, fy, fz = F32(px), F32(py), F32(pz)
    k = F32(kappa)
    q0, q1, q2, q3 = F32(q[0] * kappa), F32(q[1] * kappa), F32(q[2] * kappa), F32(q[3] * kappa)
    sums[:] = 0.0
    for s in range(table.shape[0]):
        twin = F32(table[s, TWIN])
        for r in range(_runs(start, table, s, px, py, pz, radius, runs)):
            begin, end = runs[r, 0], runs[r, 1]
            while begin < end:
                stop = min(begin + BLOCK, end)
                if wide > 0:
                    _moments_wide(data, begin, stop, fx, fy, fz, q0, q1, q2, q3, k, twin, sums)
                else:
                    _moments_narrow(data, begin, stop, fx, fy, fz, q0, q1, q2, q3, k, twin, sums)
                begin = stop


@fast
def _top_of_run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin):
    """Largest exponent of a run, float64."""
    top = -1e300
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = np.float64(data[0, i]) - px
        dy = np.float64(data[1, i]) - py
        dz = np.float64(data[2, i]) - pz
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        b = (data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz) * twin
        top = max(top, max(abs(a), abs(b)) - kappa - (dx * dx + dy * dy + dz * dz))
    return top


@fast
def _sum_of_run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, top):
    """Sum of every term of a run relative to e^top, exponents in float64."""
    total = _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = np.float64(data[0, i]) - px
        dy = np.float64(data[1, i]) - py
        dz = np.float64(data[2, i]) - pz
        base = -kappa - (dx * dx + dy * dy + dz * dz) - top
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        # Without a twin b may be far above the top: e^(base + b) would be beyond float32, and 0 times it NaN.
        b = (data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz) * twin
        own = _exp(F32(base + a)) + _exp(F32(base - a))
        other = _exp(F32(base + b)) + _exp(F32(base - b))
        total += data[7, i] * (own + F32(twin) * other)
    return total


@fast
def exact_log_sum(data, blocks, boxes, px, py, pz, q, kappa, margin):
    """Log of the sum over all kernels, without a cut-off; right however far the pose is from data.

    Blocks of kernels whose bounding box proves every exponent to lie ``margin`` nats below the largest one
    found are left out: with ``margin = 16 + log(total weight / least weight)`` the sum is short of less than
    1.2e-7 of itself.

    Parameters
    ----------
    blocks : (B, 3) int64, first and last + 1 of a block, 1 for rows with a twin
    boxes : (B, 6) float32, lowest and highest corner of the positions, scaled units
    """
    q0, q1, q2, q3 = q[0] * kappa, q[1] * kappa, q[2] * kappa, q[3] * kappa
    count = blocks.shape[0]
    bound = np.empty(count)
    first = 0
    for j in range(count):
        gx = max(max(boxes[j, 0] - px, px - boxes[j, 3]), 0.0)
        gy = max(max(boxes[j, 1] - py, py - boxes[j, 4]), 0.0)
        gz = max(max(boxes[j, 2] - pz, pz - boxes[j, 5]), 0.0)
        bound[j] = -(gx * gx + gy * gy + gz * gz)
        if bound[j] > bound[first]:
            first = j
    twin = float(blocks[first, 2])
    top = _top_of_run(data, blocks[first, 0], blocks[first, 1], px, py, pz, q0, q1, q2, q3, kappa, twin)
    total = 0.0
    for j in range(count):
        if bound[j] < top - margin:
            continue
        twin = float(blocks[j, 2])
        here = _top_of_run(data, blocks[j, 0], blocks[j, 1], px, py, pz, q0, q1, q2, q3, kappa, twin)
        if here > top:
            total *= math.exp(top - here)
            top = here
        elif here < top - margin:
            continue
        total += _sum_of_run(data, blocks[j, 0], blocks[j, 1], px, py, pz, q0, q1, q2, q3, kappa, twin, top)
    return top + math.log(total)


@fast
def log_sums(
    data, start, table, blocks, boxes, centre, scale, positions, quaternions, kappa, stages, wide, margin, out
):
    """Log of the weighted kernel sum at every pose into ``out`` (M,).

    Parameters
    ----------
    stages : (T, 3)
        Radii to try in turn, each with the largest mean exponent of position and the least mean kernel at
        which what lies outside is too little to matter (see `density.stages`). A pose that passes none is
        summed without a cut-off.
    """
    runs = np.empty((MAX_RUNS, 2), dtype=np.int64)
    for j in range(positions.shape[0]):
        px = (positions[j, 0] - centre[0]) * scale
        py = (positions[j, 1] - centre[1]) * scale
        pz = (positions[j, 2] - centre[2]) * scale
        done = False
        for t in range(stages.shape[0]):
            total, spread, visited = _sum_at(
                data, start, table, px, py, pz, quaternions[j], kappa, stages[t, 0], wide, runs
            )
            if total > 0.0 and spread <= stages[t, 1] * total and total >= stages[t, 2] * visited:
                out[j] = math.log(total)
                done = True
                break
        if not done:
            out[j] = exact_log_sum(data, blocks, boxes, px, py, pz, quaternions[j], kappa, margin)


@fast
def all_sums(data, table, centre, scale, positions, quaternions, kappa, wide, out):
    """The weighted sum over all kernels at every pose into ``out`` (M,), as brute force has it."""
    k = F32(kappa)
    out[:] = 0.0
    for s in range(table.shape[0]):
        twin = F32(table[s, TWIN])
        begin = int(table[s, OFFSET])
        end = begin + int(table[s, COUNT])
        while begin < end:
            stop = min(begin + _TILE, end)
            for j in range(positions.shape[0]):
                px = F32((positions[j, 0] - centre[0]) * scale)
                py = F32((positions[j, 1] - centre[1]) * scale)
                pz = F32((positions[j, 2] - centre[2]) * scale)
                q0, q1 = F32(quaternions[j, 0] * kappa), F32(quaternions[j, 1] * kappa)
                q2, q3 = F32(quaternions[j, 2] * kappa), F32(quaternions[j, 3] * kappa)
                out[j] += _total(data, begin, stop, px, py, pz, q0, q1, q2, q3, k, twin, wide)
            begin = stop


@fast
def all_log_sums(
    data, table, blocks, boxes, centre, scale, positions, quaternions, kappa, wide, least, margin, out
):
    """Log of the weighted sum over all kernels at every pose into ``out`` (M,), without a cut-off.

    By brute force, and where that gives less than ``least`` by `exact_log_sum`.
    """
    if least < _NEVER:
        all_sums(data, table, centre, scale, positions, quaternions, kappa, wide, out)
    else:
        out[:] = 0.0
    for j in range(positions.shape[0]):
        if out[j] >= least:
            out[j] = math.log(out[j])
        else:
            px = (positions[j, 0] - centre[0]) * scale
            py = (positions[j, 1] - centre[1]) * scale
            pz = (positions[j, 2] - centre[2]) * scale
            out[j] = exact_log_sum(data, blocks, boxes, px, py, pz, quaternions[j], kappa, margin)


@fast
def sums(data, start, table, centre, scale, positions, quaternions, kappa, radius, wide, out):
    """The weighted kernel sum within ``radius`` at every pose, zero where nothing is in reach."""
    runs = np.empty((MAX_RUNS, 2), dtype=np.int64)
    k = F32(kappa)
    for j in range(positions.shape[0]):
        px = (positions[j, 0] - centre[0]) * scale
        py = (positions[j, 1] - centre[1]) * scale
        pz = (positions[j, 2] - centre[2]) * scale
        fx, fy, fz = F32(px), F32(py), F32(pz)
        q0, q1 = F32(quaternions[j, 0] * kappa), F32(quaternions[j, 1] * kappa)
        q2, q3 = F32(quaternions[j, 2] * kappa), F32(quaternions[j, 3] * kappa)
        total = 0.0
        for s in range(table.shape[0]):
            twin = F32(table[s, TWIN])
            for r in range(_runs(start, table, s, px, py, pz, radius, runs)):
                begin, end = runs[r, 0], runs[r, 1]
                while begin < end:
                    stop = min(begin + BLOCK, end)
                    total += _total(data, begin, stop, fx, fy, fz, q0, q1, q2, q3, k, twin, wide)
                    begin = stop
        out[j] = total


@fast
def reached(start, table, centre, scale, positions, radius, out):
    """How many kernels a sum at each pose visits, into ``out`` (M,) int64."""
    runs = np.empty((MAX_RUNS, 2), dtype=np.int64)
    for j in range(positions.shape[0]):
        px = (positions[j, 0] - centre[0]) * scale
        py = (positions[j, 1] - centre[1]) * scale
        pz = (positions[j, 2] - centre[2]) * scale
        out[j] = 0
        for s in range(table.shape[0]):
            for r in range(_runs(start, table, s, px, py, pz, radius, runs)):
                out[j] += runs[r, 1] - runs[r, 0]


@fast
def moments(data, start, table, centre, scale, positions, quaternions, kappa, radius, wide, out):
    """The moments at every pose into ``out`` (M, 9)."""
    runs = np.empty((MAX_RUNS, 2), dtype=np.int64)
    for j in range(positions.shape[0]):
        px = (positions[j, 0] - centre[0]) * scale
        py = (positions[j, 1] - centre[1]) * scale
        pz = (positions[j, 2] - centre[2]) * scale
        moments_at(data, start, table, px, py, pz, quaternions[j], kappa, radius, wide, runs, out[j])


@fast
def _scatter_run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, wide, weight, out):
    """Add one kernel's value at every kernel centre of a run."""
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        base = -kappa - (dx * dx + dy * dy + dz * dz)
        a = abs(data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw)
        b = abs(data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz) * twin
        large, small = max(a, b), min(a, b)
        rest = _exp(base - large) + twin * (_exp(base + small) + _exp(base - small))
        out[i] += weight * (_exp(base + large) + wide * rest)


@fast
def scatter_sums(
    data, start, table, centre, scale, positions, quaternions, weights, twins, kappa, radius, wide, out
):
    """Add the kernels of the given rows to the sums ``out`` (N,) at every sorted kernel's centre."""
    runs = np.empty((MAX_RUNS, 2), dtype=np.int64)
    every = F32(1.0) if wide > 0 else F32(0.0)
    for j in range(positions.shape[0]):
        px = (positions[j, 0] - centre[0]) * scale
        py = (positions[j, 1] - centre[1]) * scale
        pz = (positions[j, 2] - centre[2]) * scale
        q0, q1 = F32(quaternions[j, 0] * kappa), F32(quaternions[j, 1] * kappa)
        q2, q3 = F32(quaternions[j, 2] * kappa), F32(quaternions[j, 3] * kappa)
        twin = F32(1.0) if twins[j] else F32(0.0)
        weight = F32(weights[j] * (0.5 if twins[j] else 1.0))
        for s in range(table.shape[0]):
            for r in range(_runs(start, table, s, px, py, pz, radius, runs)):
                _scatter_run(
                    data, runs[r, 0], runs[r, 1], F32(px), F32(py), F32(pz), q0, q1, q2, q3, F32(kappa), twin,
                    every, weight, out,
                )  # fmt: skip


@fast
def _squares_run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, wide, cut):
    """Sums of k and k^2 over kernels whose exponent is above ``-cut``.

    ``wide`` asks for twins and antipodes; without it, the nearest stands for all.
    """
    qx, qy, qz, qw, kappa = qx * _LOG2E, qy * _LOG2E, qz * _LOG2E, qw * _LOG2E, kappa * _LOG2E
    cut = cut * _LOG2E
    total, squares = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        base = -kappa - (dx * dx + dy * dy + dz * dz) * _LOG2E
        a = abs(data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw)
        b = abs(data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz) * twin
        large, small = max(a, b), min(a, b)
        k = _exp2(base + large)
        if wide:
            k += _exp2(base - large) + twin * (_exp2(base + small) + _exp2(base - small))
        k = data[7, i] * k if base + large >= -cut else _ZERO
        total += k
        squares += k * k
    return total, squares


@fast
def square_sums(data, start, table, centre, scale, positions, quaternions, kappa, radius, wide, out):
    """Sums of k and k^2 at every pose into ``out`` (M, 2), over kernels with an exponent of at most radius^2.

    ``radius`` is the cut-off over sqrt 2: position and rotation share the allowance. The cut is exact,
    because far from data it decides between an attempt and none.
    """
    runs = np.empty((MAX_RUNS, 2), dtype=np.int64)
    k, cut = F32(kappa), F32(radius * radius)
    for j in range(positions.shape[0]):
        px = (positions[j, 0] - centre[0]) * scale
        py = (positions[j, 1] - centre[1]) * scale
        pz = (positions[j, 2] - centre[2]) * scale
        q0, q1 = F32(quaternions[j, 0] * kappa), F32(quaternions[j, 1] * kappa)
        q2, q3 = F32(quaternions[j, 2] * kappa), F32(quaternions[j, 3] * kappa)
        total, squares = 0.0, 0.0
        for s in range(table.shape[0]):
            twin = F32(table[s, TWIN])
            for r in range(_runs(start, table, s, px, py, pz, radius, runs)):
                begin, end = runs[r, 0], runs[r, 1]
                while begin < end:
                    stop = min(begin + BLOCK, end)
                    if wide:
                        part = _squares_run(
                            data, begin, stop, F32(px), F32(py), F32(pz), q0, q1, q2, q3, k, twin, True, cut
                        )
                    else:
                        part = _squares_run(
                            data, begin, stop, F32(px), F32(py), F32(pz), q0, q1, q2, q3, k, twin, False, cut
                        )
                    total += part[0]
                    squares += part[1]
                    begin = stop
        out[j, 0] = total
        out[j, 1] = squares


@fast
def _other_blocks_run(data, block, own, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin):
    """Sum of both twins' kernels over a run, those of block ``own`` left out."""
    total = _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        base = -kappa - (dx * dx + dy * dy + dz * dz)
        a = abs(data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw)
        b = abs(data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz)
        k = _exp(base + a) + twin * _exp(base + b)
        total += data[7, i] * k if block[i] != own else _ZERO
    return total


@fast
def other_blocks_sums(
    data, block, start, table, centre, scale, positions, quaternions, own, kappa, radius, out
):
    """Kernel sums at poses (M,) over the sorted kernels whose ``block`` (N,) int32 differs from ``own``
    (M,).
    """
    runs = np.empty((MAX_RUNS, 2), dtype=np.int64)
    k = F32(kappa)
    for j in range(positions.shape[0]):
        px = (positions[j, 0] - centre[0]) * scale
        py = (positions[j, 1] - centre[1]) * scale
        pz = (positions[j, 2] - centre[2]) * scale
        q0, q1 = F32(quaternions[j, 0] * kappa), F32(quaternions[j, 1] * kappa)
        q2, q3 = F32(quaternions[j, 2] * kappa), F32(quaternions[j, 3] * kappa)
        total = 0.0
        for s in range(table.shape[0]):
            twin = F32(table[s, TWIN])
            for r in range(_runs(start, table, s, px, py, pz, radius, runs)):
                total += _other_blocks_run(
                    data,
                    block,
                    own[j],
                    runs[r, 0],
                    runs[r, 1],
                    F32(px),
                    F32(py),
                    F32(pz),
                    q0,
                    q1,
                    q2,
                    q3,
                    k,
                    twin,
                )
        out[j] = total
