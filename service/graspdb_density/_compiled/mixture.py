"""Compiled sums of a Gaussian mixture kernel, one weighting, as fast as the isotropic kernel's shape allows.

A block of kernels at a time: displacements into buffers that stay in the first-level cache, then a loop for
every component. Of a row and its twin only the nearer is evaluated: their rotations are half a turn apart,
and `mixture.NARROW` is where the farther one's share stops being negligible (wider kernels take `rowloops`).
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from . import exp
from . import isotropic as c
from .isotropic_runs import LANES, single
from .options import fast
from .quaternions import angle_factor
from .weighted import mixture_log_sum

__all__ = ["mixture_log_sums", "mixture_sums_at"]

F32 = np.float32
BLOCK = 512
_ONE, _ZERO = F32(1.0), F32(0.0)


@fast
def _nearest_displacements(data, frames, begin, n, px, py, pz, qx, qy, qz, qw, metres, twin, xi):
    """Displacements (6, n) from rows or, where its rotation is nearer, from their twins.

    In frames that do not turn with the jaw.
    """
    for k in range(np.uint64(n)):
        i = np.uint64(begin) + k
        dx = (px - data[0, i]) * metres
        dy = (py - data[1, i]) * metres
        dz = (pz - data[2, i]) * metres
        ax, ay, az, aw = data[3, i], data[4, i], data[5, i], data[6, i]
        vx = aw * qx - ax * qw - ay * qz + az * qy
        vy = aw * qy + ax * qz - ay * qw - az * qx
        vz = aw * qz - ax * qy + ay * qx - az * qw
        w = aw * qw + ax * qx + ay * qy + az * qz
        turned = abs(vz) * twin > abs(w)
        # (q_i M)^-1 q = M^-1 v with M^-1 = (0, 0, -1, 0).
        ux = vy if turned else vx
        uy = -vx if turned else vy
        uz = -w if turned else vz
        uw = vz if turned else w
        f = angle_factor(min(abs(uw), _ONE))
        f = f if uw >= _ZERO else -f
        xi[0, k] = frames[0, i] * dx + frames[3, i] * dy + frames[6, i] * dz
        xi[1, k] = frames[1, i] * dx + frames[4, i] * dy + frames[7, i] * dz
        xi[2, k] = frames[2, i] * dx + frames[5, i] * dy + frames[8, i] * dz
        xi[3, k] = f * ux
        xi[4, k] = f * uy
        xi[5, k] = f * uz


@fast
def _nearest_in_gripper(data, begin, n, px, py, pz, qx, qy, qz, qw, metres, twin, xi):
    """As `_nearest_displacements` in the gripper's axes, turned by the row's quaternion: half the memory
    read.
    """
    two = F32(2.0)
    for k in range(np.uint64(n)):
        i = np.uint64(begin) + k
        dx = (px - data[0, i]) * metres
        dy = (py - data[1, i]) * metres
        dz = (pz - data[2, i]) * metres
        ax, ay, az, aw = data[3, i], data[4, i], data[5, i], data[6, i]
        vx = aw * qx - ax * qw - ay * qz + az * qy
        vy = aw * qy + ax * qz - ay * qw - az * qx
        vz = aw * qz - ax * qy + ay * qx - az * qw
        w = aw * qw + ax * qx + ay * qy + az * qz
        # d' = d + 2 (aw (d x a) + a x (a x d)), the inverse rotation of the row.
        cx, cy, cz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
        tx = dx + two * (aw * cx + cy * az - cz * ay)
        ty = dy + two * (aw * cy + cz * ax - cx * az)
        tz = dz + two * (aw * cz + cx * ay - cy * ax)
        turned = abs(vz) * twin > abs(w)
        ux = vy if turned else vx
        uy = -vx if turned else vy
        uz = -w if turned else vz
        uw = vz if turned else w
        f = angle_factor(min(abs(uw), _ONE))
        f = f if uw >= _ZERO else -f
        xi[0, k] = -tx if turned else tx
        xi[1, k] = -ty if turned else ty
        xi[2, k] = tz
        xi[3, k] = f * ux
        xi[4, k] = f * uy
        xi[5, k] = f * uz


@fast
def _component(data, begin, n, all_n, xi, lower, log_weight):
    """Sum over the first ``n`` of a block of ``all_n`` of weight times one component, and that sum weighted
    by the exponent.
    """
    l00, l10, l11 = lower[0], lower[1], lower[2]
    l20, l21, l22 = lower[3], lower[4], lower[5]
    l30, l31, l32, l33 = lower[6], lower[7], lower[8], lower[9]
    l40, l41, l42, l43, l44 = lower[10], lower[11], lower[12], lower[13], lower[14]
    l50, l51, l52, l53, l54, l55 = lower[15], lower[16], lower[17], lower[18], lower[19], lower[20]
    b0, b1, b2, b3, b4, b5 = lower[21], lower[22], lower[23], lower[24], lower[25], lower[26]
    total, spread = _ZERO, _ZERO
    count, log_weight = np.int32(n), log_weight * exp.LOG2E
    for k in range(np.uint64(all_n)):
        x0, x1, x2, x3, x4, x5 = xi[0, k], xi[1, k], xi[2, k], xi[3, k], xi[4, k], xi[5, k]
        z0 = l00 * x0 - b0
        z1 = l10 * x0 + l11 * x1 - b1
        z2 = l20 * x0 + l21 * x1 + l22 * x2 - b2
        z3 = l30 * x0 + l31 * x1 + l32 * x2 + l33 * x3 - b3
        z4 = l40 * x0 + l41 * x1 + l42 * x2 + l43 * x3 + l44 * x4 - b4
        z5 = l50 * x0 + l51 * x1 + l52 * x2 + l53 * x3 + l54 * x4 + l55 * x5 - b5
        place = z0 * z0 + z1 * z1 + z2 * z2
        square = place + z3 * z3 + z4 * z4 + z5 * z5
        value = data[7, np.uint64(begin) + k] * exp.exp2(log_weight - square * exp.LOG2E)
        value = value if np.int32(k) < count else _ZERO
        total += value
        spread += value * place
    return total, spread


@fast
def mixture_sums_at(cells, frames, turning, at, mixture, radius, runs, xi):
    """Weighted mixture sum at one pose, that weighted by the position's exponent, rows visited."""
    data, near, m = cells.data, single(at), F32(1.0 / cells.scale)
    px, py, pz, qx, qy, qz, qw = near.x, near.y, near.z, near.qx, near.qy, near.qz, near.qw
    total, spread, visited = 0.0, 0.0, 0
    for r in range(c.runs_within(cells, at, radius, BLOCK, runs)):
        begin, n, twin = runs[r, 0], runs[r, 1] - runs[r, 0], F32(runs[r, 2])
        visited += n
        # Whole vectors, of which the end is thrown away: LLVM would take the rest one by one.
        all_n = n + -n % LANES
        if begin + all_n > data.shape[1]:
            all_n = n
        if turning:
            _nearest_in_gripper(data, begin, all_n, px, py, pz, qx, qy, qz, qw, m, twin, xi)
        else:
            _nearest_displacements(data, frames, begin, all_n, px, py, pz, qx, qy, qz, qw, m, twin, xi)
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
