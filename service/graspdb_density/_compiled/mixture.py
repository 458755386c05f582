"""Compiled sums of a Gaussian mixture kernel, one weighting, as fast as the isotropic kernel's shape allows.

A block of kernels at a time: displacements into buffers that stay in the first-level cache, then a loop for
every component. Of a row and its twin only the nearer is evaluated: their rotations are half a turn apart,
and `kde.mixture.NARROW` is where the farther one's share stops being negligible (wider kernels take
`weighted`).
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from . import exp
from . import isotropic as c
from .isotropic_runs import LANES, single
from .options import fast, inlined
from .quaternions import relative
from .weighted import angle_factor, mixture_log_sum, whitened_squares, whitening_of

__all__ = ["mixture_log_sums", "mixture_sums_at"]

F32 = np.float32
BLOCK = 512
_TWO, _ONE, _ZERO = F32(2.0), F32(1.0), F32(0.0)


@fast
def _nearest_displacements(data, frames, turning, begin, n, at, metres, twin, xi):
    """Displacements (6, n) from rows or, where its rotation is nearer, from their twins.

    In the axes ``frames``, which do not turn with the jaw, or where ``turning`` in the gripper's, by the
    rows' quaternions: half the memory read.
    """
    # The constant lets LLVM make a loop of its own of either.
    if turning:
        _displaced(data, frames, True, begin, n, at, metres, twin, xi)
    else:
        _displaced(data, frames, False, begin, n, at, metres, twin, xi)


@inlined
def _displaced(data, frames, turning, begin, n, at, metres, twin, xi):
    for k in range(np.uint64(n)):
        i = np.uint64(begin) + k
        dx, dy, dz = (at.x - data[0, i]) * metres, (at.y - data[1, i]) * metres, (at.z - data[2, i]) * metres
        ax, ay, az, aw = data[3, i], data[4, i], data[5, i], data[6, i]
        vx, vy, vz, w = relative(ax, ay, az, aw, at.qx, at.qy, at.qz, at.qw)
        turned = abs(vz) * twin > abs(w)
        if turning:
            # d' = d + 2 (aw (d x a) + a x (a x d)), the inverse rotation of the row.
            cx, cy, cz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
            tx = dx + _TWO * (aw * cx + cy * az - cz * ay)
            ty = dy + _TWO * (aw * cy + cz * ax - cx * az)
            xi[0, k] = -tx if turned else tx
            xi[1, k] = -ty if turned else ty
            xi[2, k] = dz + _TWO * (aw * cz + cx * ay - cy * ax)
        else:
            xi[0, k] = frames[0, i] * dx + frames[3, i] * dy + frames[6, i] * dz
            xi[1, k] = frames[1, i] * dx + frames[4, i] * dy + frames[7, i] * dz
            xi[2, k] = frames[2, i] * dx + frames[5, i] * dy + frames[8, i] * dz
        # (q_i M)^-1 q = M^-1 v with M^-1 = (0, 0, -1, 0).
        ux = vy if turned else vx
        uy = -vx if turned else vy
        uz = -w if turned else vz
        uw = vz if turned else w
        f = angle_factor(min(abs(uw), _ONE))
        f = f if uw >= _ZERO else -f
        xi[3, k] = f * ux
        xi[4, k] = f * uy
        xi[5, k] = f * uz


@fast
def _component(data, begin, n, all_n, xi, lower, log_weight):
    """Sum over the first ``n`` of a block of ``all_n`` of weight times one component, and that sum weighted
    by the exponent.
    """
    whitening = whitening_of(lower)
    total, spread = _ZERO, _ZERO
    count, log_weight = np.int32(n), log_weight * exp.LOG2E
    for k in range(np.uint64(all_n)):
        x0, x1, x2, x3, x4, x5 = xi[0, k], xi[1, k], xi[2, k], xi[3, k], xi[4, k], xi[5, k]
        place, turn = whitened_squares(whitening, x0, x1, x2, x3, x4, x5)
        square = place + turn
        value = data[7, np.uint64(begin) + k] * exp.exp2(log_weight - square * exp.LOG2E)
        value = value if np.int32(k) < count else _ZERO
        total += value
        spread += value * place
    return total, spread


@fast
def mixture_sums_at(cells, frames, turning, at, mixture, radius, runs, xi):
    """Weighted mixture sum at one pose, that weighted by the position's exponent, rows visited."""
    data, near, metres = cells.data, single(at), F32(1.0 / cells.scale)
    total, spread, visited = 0.0, 0.0, 0
    for r in range(c.runs_within(cells, at, radius, BLOCK, runs)):
        begin, n = runs[r, 0], runs[r, 1] - runs[r, 0]
        visited += n
        # Whole vectors, of which the end is thrown away: LLVM would take the rest one by one.
        all_n = n + -n % LANES
        if begin + all_n > data.shape[1]:
            all_n = n
        _nearest_displacements(data, frames, turning, begin, all_n, near, metres, F32(runs[r, 2]), xi)
        for j in range(mixture.lowers.shape[0]):
            part = _component(data, begin, n, all_n, xi, mixture.lowers[j], mixture.log_weights[j])
            total += part[0]
            spread += part[1]
    return total, spread, visited


@fast
def mixture_log_sums(
    cells, frames, positions, quaternions, mixture, stages, unit, exact_rows, exact_mixture, out
):
    """Log of the mixture sum at every pose into ``out`` (M,), in units of ``unit`` (log); stages are those of
    `isotropic.log_sums`. What passes none is summed over all rows in float64.

    ``frames`` (9, N) float32 are those of the sorted rows, ``exact_rows`` and ``exact_mixture`` the same rows
    and components in float64.
    """
    runs = c.empty_runs(cells, BLOCK)
    xi = np.empty((6, BLOCK), dtype=np.float32)
    for j in range(positions.shape[0]):
        at = c.place(cells, positions[j], quaternions[j], 1.0)
        done = False
        for t in range(stages.shape[0]):
            total, spread, visited = mixture_sums_at(
                cells, frames, exact_rows.turning, at, mixture, stages[t, 0], runs, xi
            )
            if total > 0.0 and spread <= stages[t, 1] * total and total >= stages[t, 2] * visited:
                out[j] = math.log(total) - unit
                done = True
                break
        if not done:
            out[j] = mixture_log_sum(exact_rows, exact_mixture, positions[j], quaternions[j])
