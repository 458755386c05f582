"""Compiled loops over one run of rows: contiguous, and all with the jaw's twin or all without.

``data`` and the scaling are those of `isotropic`; `At` is where a pose stands among the rows. ``wide`` is 0
where the nearest of twins and antipodes stands for all, 1 where both twins count, 2 where antipodes do too.

LLVM turns the whole loop into vector code only with unsigned indices (signed ones wrap around in Python) and
without slices, whose reference counts would cost more than a short run; ``tests/benchmarks`` notice a loss.
Accumulation is float32: callers keep runs to `isotropic.BLOCK` rows.
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .exp import LOG2E, exp, exp2
from .options import fast, inlined

F32 = np.float32
#: Rows in the vectors that a loop takes at once, with AVX-512; a multiple of what it takes elsewhere.
LANES = 32
#: Less than any exponent.
LEAST = F32(-1e30)
_ZERO = F32(0.0)
#: Far below what any kernel counts for; its square, and that times a kernel of position, are normal numbers.
_NORMAL = F32(2.0**-60)


class At(NamedTuple):
    """A pose among sorted rows: its position in their scaled units, ``kappa`` times its quaternion, so that a
    dot product is an exponent, and ``kappa``.
    """

    x: Any
    y: Any
    z: Any
    qx: Any
    qy: Any
    qz: Any
    qw: Any
    kappa: Any


@inlined
def single(at):
    """The same in float32."""
    return At(
        F32(at.x), F32(at.y), F32(at.z), F32(at.qx), F32(at.qy), F32(at.qz), F32(at.qw), F32(at.kappa)
    )  # fmt: skip


@inlined
def _base2(at):
    """Rotation's exponents to base 2, once, so that no kernel has to."""
    return At(
        at.x, at.y, at.z, at.qx * LOG2E, at.qy * LOG2E, at.qz * LOG2E, at.qw * LOG2E, at.kappa * LOG2E
    )  # fmt: skip


@inlined
def offset(data, i, at):
    """From a pose to row ``i``, in scaled units."""
    return data[0, i] - at.x, data[1, i] - at.y, data[2, i] - at.z


@inlined
def squared(data, i, at):
    """The squared distance, which is the exponent of position."""
    dx, dy, dz = offset(data, i, at)
    return dx * dx + dy * dy + dz * dz


@inlined
def cosines(data, i, at):
    """``kappa`` times the cosine of half the angle to row ``i``, and to its twin."""
    own = data[3, i] * at.qx + data[4, i] * at.qy + data[5, i] * at.qz + data[6, i] * at.qw
    twin = data[3, i] * at.qy - data[4, i] * at.qx + data[5, i] * at.qw - data[6, i] * at.qz
    return own, twin


@inlined
def nearest(data, i, at):
    """The largest of a row's four cosines: of the twins and their antipodes."""
    a, b = cosines(data, i, at)
    return max(abs(a), abs(b))


@fast
def run_narrow(data, begin, end, at):
    """Sums of k and k r^2 over rows with a twin, where the antipode's and the farther twin's share is
    negligible.
    """
    at = _base2(at)
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        r2 = squared(data, i, at)
        k = data[7, i] * exp2((nearest(data, i, at) - at.kappa) - r2 * LOG2E)
        total += k
        spread += k * r2
    return total, spread


@fast
def rest_narrow(data, begin, end, at):
    """`run_narrow` over fewer than ``LANES`` rows, of which there are that many from ``begin`` on: whole
    vectors of which the end is thrown away, where LLVM would take the rest of a loop one by one.
    """
    at = _base2(at)
    total, spread = _ZERO, _ZERO
    first, count = np.uint64(begin), np.int32(end - begin)
    for j in range(np.uint64(LANES)):
        i = first + j
        r2 = squared(data, i, at)
        k = data[7, i] * exp2((nearest(data, i, at) - at.kappa) - r2 * LOG2E)
        k = k if np.int32(j) < count else _ZERO
        total += k
        spread += k * r2
    return total, spread


@fast
def total_narrow(data, begin, end, at):
    """As `run_narrow` without k r^2, which only a cut-off needs to know: a sixth less work."""
    at = _base2(at)
    total = _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        total += data[7, i] * exp2((nearest(data, i, at) - at.kappa) - squared(data, i, at) * LOG2E)
    return total


@fast
def run_single(data, begin, end, at):
    """As `run_narrow` over rows without a twin."""
    at = _base2(at)
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        r2 = squared(data, i, at)
        k = data[7, i] * exp2((abs(cosines(data, i, at)[0]) - at.kappa) - r2 * LOG2E)
        total += k
        spread += k * r2
    return total, spread


@fast
def run_twins(data, begin, end, at, twin):
    """Sums of k and k r^2 over both twins, each by its nearer end."""
    at = _base2(at)
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        r2 = squared(data, i, at)
        base = -at.kappa - r2 * LOG2E
        a, b = cosines(data, i, at)
        k = data[7, i] * (exp2(base + abs(a)) + twin * exp2(base + abs(b)))
        total += k
        spread += k * r2
    return total, spread


@fast
def run_wide(data, begin, end, at, twin):
    """Sums of k and k r^2 with every term: both twins, each with its antipode."""
    at = _base2(at)
    total, spread = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        r2 = squared(data, i, at)
        base = -at.kappa - r2 * LOG2E
        a, b = cosines(data, i, at)
        own = exp2(base + a) + exp2(base - a)
        other = exp2(base + b) + exp2(base - b)
        k = data[7, i] * (own + twin * other)
        total += k
        spread += k * r2
    return total, spread


@fast
def run(data, begin, end, at, twin, wide):
    """Sums of k and k r^2 over rows that all have a twin or have none."""
    if wide == 2:
        return run_wide(data, begin, end, at, twin)
    if wide == 1:
        return run_twins(data, begin, end, at, twin)
    if twin > _ZERO:
        return run_narrow(data, begin, end, at)
    return run_single(data, begin, end, at)


@fast
def total(data, begin, end, at, twin, wide):
    """The first of what `run` gives."""
    if wide == 0 and twin > _ZERO:
        return total_narrow(data, begin, end, at)
    return run(data, begin, end, at, twin, wide)[0]


@inlined
def _squared_double(data, i, at):
    dx, dy, dz = np.float64(data[0, i]) - at.x, np.float64(data[1, i]) - at.y, np.float64(data[2, i]) - at.z
    return dx * dx + dy * dy + dz * dz


@fast
def top_of_run(data, begin, end, at, twin):
    """Largest exponent of a run, float64."""
    top = -1e300
    for i in range(np.uint64(begin), np.uint64(end)):
        a, b = cosines(data, i, at)
        b = b * twin
        top = max(top, max(abs(a), abs(b)) - at.kappa - _squared_double(data, i, at))
    return top


@fast
def sum_of_run(data, begin, end, at, twin, top):
    """Sum of every term of a run relative to e^top, exponents in float64."""
    total = _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        base = -at.kappa - _squared_double(data, i, at) - top
        # Without a twin b may be far above the top: e^(base + b) would be beyond float32, and 0 times it NaN.
        a, b = cosines(data, i, at)
        b = b * twin
        own = exp(F32(base + a)) + exp(F32(base - a))
        other = exp(F32(base + b)) + exp(F32(base - b))
        total += data[7, i] * (own + F32(twin) * other)
    return total


@fast
def scatter_run(data, begin, end, at, twin, wide, weight, out):
    """Add one kernel's value at every kernel centre of a run."""
    for i in range(np.uint64(begin), np.uint64(end)):
        base = -at.kappa - squared(data, i, at)
        a, b = cosines(data, i, at)
        b = abs(b) * twin
        large, small = max(abs(a), b), min(abs(a), b)
        rest = exp(base - large) + twin * (exp(base + small) + exp(base - small))
        out[i] += weight * (exp(base + large) + wide * rest)


@fast
def squares_run(data, begin, end, at, twin, wide, cut):
    """Sums of k and k^2 over kernels whose exponent is above ``-cut``.

    ``wide`` asks for twins and antipodes; without it, the nearest stands for all.
    """
    at = _base2(at)
    cut = cut * LOG2E
    total, squares = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        base = -at.kappa - squared(data, i, at) * LOG2E
        a, b = cosines(data, i, at)
        b = abs(b) * twin
        large, small = max(abs(a), b), min(abs(a), b)
        k = exp2(base + large)
        if wide:
            k += exp2(base - large) + twin * (exp2(base + small) + exp2(base - small))
        k = data[7, i] * k if base + large >= -cut else _ZERO
        total += k
        squares += k * k
    return total, squares


@inlined
def _exponent(data, i, at, twin):
    own, other = cosines(data, i, at)
    return max(abs(own), abs(other * twin)) - at.kappa - squared(data, i, at)


@fast
def nearest_of_run(data, begin, end, at, twin):
    """Largest exponent of a run, of the nearer twin's nearer end, and its row."""
    top, row = LEAST, np.int64(begin)
    for i in range(np.uint64(begin), np.uint64(end)):
        here = _exponent(data, i, at, twin)
        if here > top:
            top, row = here, np.int64(i)
    return top, row


@fast
def other_blocks_run(data, block, own, begin, end, at, twin):
    """Sums of both twins' kernels over a run, those of block ``own`` left out: under the rotation's
    concentration, and under twice, four, eight and sixteen times that, whose exponentials are squares.
    """
    t0, t1, t2, t3, t4 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        k = data[7, i] * exp(-squared(data, i, at))
        k = k if block[i] != own else _ZERO
        a, b = cosines(data, i, at)
        a, b = exp(abs(a) - at.kappa), exp(abs(b) - at.kappa)
        t0 += k * (a + twin * b)
        a, b = max(a * a, _NORMAL), max(b * b, _NORMAL)
        t1 += k * (a + twin * b)
        a, b = max(a * a, _NORMAL), max(b * b, _NORMAL)
        t2 += k * (a + twin * b)
        a, b = max(a * a, _NORMAL), max(b * b, _NORMAL)
        t3 += k * (a + twin * b)
        a, b = max(a * a, _NORMAL), max(b * b, _NORMAL)
        t4 += k * (a + twin * b)
    return t0, t1, t2, t3, t4
