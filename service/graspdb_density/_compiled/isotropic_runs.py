"""Compiled loops over one run of rows: contiguous, and all with the jaw's twin or all without.

``data`` and the scaling are those of `compiled`; a query's quaternion comes times ``kappa``, so that a dot
product is an exponent. ``wide`` is 0 where the nearest of twins and antipodes stands for all, 1 where both
twins count, 2 where antipodes do too.

LLVM turns the whole loop into vector code only with unsigned indices (signed ones wrap around in Python) and
without slices, whose reference counts would cost more than a short run; ``tests/benchmarks`` notice a loss.
Accumulation is float32: callers keep runs to `compiled.BLOCK` rows.
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from .exp import LOG2E, exp, exp2
from .options import fast

F32 = np.float32
#: Rows in the vectors that a loop takes at once, with AVX-512; a multiple of what it takes elsewhere.
LANES = 32
_ZERO = F32(0.0)


@fast
def run_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa):
    """Sums of k and k r^2 over rows with a twin, where the antipode's and the farther twin's share is
    negligible.

    (qx..qw) is kappa times the quaternion. Here and below both are taken to base 2 once, so that no kernel
    has to.
    """
    qx, qy, qz, qw, kappa = qx * LOG2E, qy * LOG2E, qz * LOG2E, qw * LOG2E, kappa * LOG2E
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        b = data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz
        r2 = dx * dx + dy * dy + dz * dz
        k = data[7, i] * exp2((max(abs(a), abs(b)) - kappa) - r2 * LOG2E)
        total += k
        spread += k * r2
    return total, spread


@fast
def rest_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa):
    """`run_narrow` over fewer than ``LANES`` rows, of which there are that many from ``begin`` on: whole
    vectors of which the end is thrown away, where LLVM would take the rest of a loop one by one.
    """
    qx, qy, qz, qw, kappa = qx * LOG2E, qy * LOG2E, qz * LOG2E, qw * LOG2E, kappa * LOG2E
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
        k = data[7, i] * exp2((max(abs(a), abs(b)) - kappa) - r2 * LOG2E)
        k = k if np.int32(j) < count else _ZERO
        total += k
        spread += k * r2
    return total, spread


@fast
def total_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa):
    """As `run_narrow` without k r^2, which only a cut-off needs to know: a sixth less work."""
    qx, qy, qz, qw, kappa = qx * LOG2E, qy * LOG2E, qz * LOG2E, qw * LOG2E, kappa * LOG2E
    total = _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        b = data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz
        r2 = dx * dx + dy * dy + dz * dz
        total += data[7, i] * exp2((max(abs(a), abs(b)) - kappa) - r2 * LOG2E)
    return total


@fast
def run_single(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa):
    """As `run_narrow` over rows without a twin."""
    qx, qy, qz, qw, kappa = qx * LOG2E, qy * LOG2E, qz * LOG2E, qw * LOG2E, kappa * LOG2E
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        r2 = dx * dx + dy * dy + dz * dz
        k = data[7, i] * exp2((abs(a) - kappa) - r2 * LOG2E)
        total += k
        spread += k * r2
    return total, spread


@fast
def run_twins(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin):
    """Sums of k and k r^2 over both twins, each by its nearer end."""
    qx, qy, qz, qw, kappa = qx * LOG2E, qy * LOG2E, qz * LOG2E, qw * LOG2E, kappa * LOG2E
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        r2 = dx * dx + dy * dy + dz * dz
        base = -kappa - r2 * LOG2E
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        b = data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz
        k = data[7, i] * (exp2(base + abs(a)) + twin * exp2(base + abs(b)))
        total += k
        spread += k * r2
    return total, spread


@fast
def run_wide(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin):
    """Sums of k and k r^2 with every term: both twins, each with its antipode."""
    qx, qy, qz, qw, kappa = qx * LOG2E, qy * LOG2E, qz * LOG2E, qw * LOG2E, kappa * LOG2E
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        r2 = dx * dx + dy * dy + dz * dz
        base = -kappa - r2 * LOG2E
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        b = data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz
        own = exp2(base + a) + exp2(base - a)
        other = exp2(base + b) + exp2(base - b)
        k = data[7, i] * (own + twin * other)
        total += k
        spread += k * r2
    return total, spread


@fast
def moments_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, sums):
    """As `moments_wide` with the nearest of twins and antipodes standing for all."""
    qx, qy, qz, qw, kappa = qx * LOG2E, qy * LOG2E, qz * LOG2E, qw * LOG2E, kappa * LOG2E
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
        k = data[7, i] * exp2((abs(near) - kappa) - r2 * LOG2E)
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
def moments_wide(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, sums):
    """Add to ``sums`` (9,): k, k (p_i - p), the signed pull k mu_i of the quaternion, and k r^2, scaled
    units.
    """
    qx, qy, qz, qw, kappa = qx * LOG2E, qy * LOG2E, qz * LOG2E, qw * LOG2E, kappa * LOG2E
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
        base = -kappa - r2 * LOG2E
        w = data[7, i]
        large, small = max(abs(a), abs(b)), min(abs(a), abs(b))
        k1 = w * exp2(base + large)
        k2 = w * twin * exp2(base + small)
        k3 = w * exp2(base - large)
        k4 = w * twin * exp2(base - small)
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
def run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, wide):
    """Sums of k and k r^2 over rows that all have a twin or have none."""
    if wide == 2:
        return run_wide(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin)
    if wide == 1:
        return run_twins(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin)
    if twin > _ZERO:
        return run_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa)
    return run_single(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa)


@fast
def total(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, wide):
    """The first of what `run` gives."""
    if wide == 0 and twin > _ZERO:
        return total_narrow(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa)
    return run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, wide)[0]


@fast
def top_of_run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin):
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
def sum_of_run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, top):
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
        own = exp(F32(base + a)) + exp(F32(base - a))
        other = exp(F32(base + b)) + exp(F32(base - b))
        total += data[7, i] * (own + F32(twin) * other)
    return total


@fast
def scatter_run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, wide, weight, out):
    """Add one kernel's value at every kernel centre of a run."""
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        base = -kappa - (dx * dx + dy * dy + dz * dz)
        a = abs(data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw)
        b = abs(data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz) * twin
        large, small = max(a, b), min(a, b)
        rest = exp(base - large) + twin * (exp(base + small) + exp(base - small))
        out[i] += weight * (exp(base + large) + wide * rest)


@fast
def squares_run(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, wide, cut):
    """Sums of k and k^2 over kernels whose exponent is above ``-cut``.

    ``wide`` asks for twins and antipodes; without it, the nearest stands for all.
    """
    qx, qy, qz, qw, kappa = qx * LOG2E, qy * LOG2E, qz * LOG2E, qw * LOG2E, kappa * LOG2E
    cut = cut * LOG2E
    total, squares = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        base = -kappa - (dx * dx + dy * dy + dz * dz) * LOG2E
        a = abs(data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw)
        b = abs(data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz) * twin
        large, small = max(a, b), min(a, b)
        k = exp2(base + large)
        if wide:
            k += exp2(base - large) + twin * (exp2(base + small) + exp2(base - small))
        k = data[7, i] * k if base + large >= -cut else _ZERO
        total += k
        squares += k * k
    return total, squares


@fast
def other_blocks_run(data, block, own, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin):
    """Sum of both twins' kernels over a run, those of block ``own`` left out."""
    total = _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        base = -kappa - (dx * dx + dy * dy + dz * dz)
        a = abs(data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw)
        b = abs(data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz)
        k = exp(base + a) + twin * exp(base + b)
        total += data[7, i] * k if block[i] != own else _ZERO
    return total
