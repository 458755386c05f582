"""Compiled loops that evaluate kernels row by row, for statistics that need every row's share and not only
the sum: bootstrap replicates are many weightings of the same kernel values.

Layout as in `isotropic`: rows sorted by grid cell, float32 structures of arrays, positions centred and
scaled. The values of a run of rows are written to a short buffer by a loop that turns into vector code; those
above a threshold are then added to one accumulator a weighting.
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import exp
from . import isotropic as c
from .isotropic_runs import cosines, single, squared
from .options import exact, fast
from .quaternions import angle_factor

F32 = np.float32
#: Rows evaluated at a time: the buffers stay in the first-level cache.
BLOCK = 256
#: Columns of weightings come in multiples of this.
LANES = 32
_ONE, _ZERO = F32(1.0), F32(0.0)


class Mixture(NamedTuple):
    """Components of a Gaussian mixture over displacements, in float32 or float64.

    Attributes
    ----------
    lowers : (C, 27)
        The whitening matrix over sqrt 2, rows of its lower triangle, then the whitened mean.
    log_weights : (C,)
        Log peaks, the largest 0.
    wraps : bool
        Whether a rotation's other vector, by angle - 2 pi about the same axis, counts.
    """

    lowers: NDArray[np.floating]
    log_weights: NDArray[np.floating]
    wraps: bool

    def single(self) -> Mixture:
        """The same in float32."""
        return Mixture(self.lowers.astype(np.float32), self.log_weights.astype(np.float32), self.wraps)


class MixtureRows(NamedTuple):
    """Rows in float64 for the sum without a cut-off.

    Attributes
    ----------
    positions : (N, 3), quaternions : (N, 4), symmetric : (N,) bool, log_rows : (N,) log weight of a twin
    frames : (N, 9)
        Axes that translations are measured along, rows of the matrix.
    turning : bool
        Whether they turn with the jaw.
    """

    positions: NDArray[np.float64]
    quaternions: NDArray[np.float64]
    frames: NDArray[np.float64]
    symmetric: NDArray[np.bool_]
    log_rows: NDArray[np.float64]
    turning: bool


_TURN = F32(2.0 * math.pi)
#: Keeps the wrap of a rotation by nothing finite; far below float32 where the wrap matters.
_TINY = F32(1e-6)


@fast
def _isotropic_values(data, begin, n, at, twin, wide, out):
    """Kernels of rows ``begin .. begin + n``, 1 at a centre, both twins summed."""
    for k in range(np.uint64(n)):
        i = np.uint64(begin) + k
        a, b = cosines(data, i, at)
        out[k] = exp.exp(max(abs(a), abs(b) * twin) - at.kappa - squared(data, i, at))
    if wide:
        for k in range(np.uint64(n)):
            i = np.uint64(begin) + k
            base = -at.kappa - squared(data, i, at)
            a, b = cosines(data, i, at)
            a, b = abs(a), abs(b)
            low = min(a, b)
            # The nearest of the four is there already; the others are both antipodes and the farther twin.
            out[k] += exp.exp(base - a) + twin * (exp.exp(base + low) + exp.exp(base - b))


@fast
def _displacements(data, frames, begin, n, at, metres, turned, frame_turns, xi):
    """Displacements (6, n) from rows (``turned``: from their twins) to a pose: translation in the row's frame
    (metres), shortest rotation vector in its gripper's frame (radians).
    """
    px, py, pz, qx, qy, qz, qw = at.x, at.y, at.z, at.qx, at.qy, at.qz, at.qw
    flip = F32(-1.0) if (turned and frame_turns) else _ONE
    m = F32(metres)
    for k in range(np.uint64(n)):
        i = np.uint64(begin) + k
        dx = (px - data[0, i]) * m
        dy = (py - data[1, i]) * m
        dz = (pz - data[2, i]) * m
        xi[0, k] = flip * (frames[0, i] * dx + frames[3, i] * dy + frames[6, i] * dz)
        xi[1, k] = flip * (frames[1, i] * dx + frames[4, i] * dy + frames[7, i] * dz)
        xi[2, k] = frames[2, i] * dx + frames[5, i] * dy + frames[8, i] * dz
        ax, ay, az, aw = -data[3, i], -data[4, i], -data[5, i], data[6, i]
        vx = aw * qx + ax * qw + ay * qz - az * qy
        vy = aw * qy - ax * qz + ay * qw + az * qx
        vz = aw * qz + ax * qy - ay * qx + az * qw
        w = aw * qw - ax * qx - ay * qy - az * qz
        if turned:
            # (q_i M)^-1 q = M^-1 v with M^-1 = (0, 0, -1, 0).
            tx, ty, tz, tw = vy, -vx, -w, vz
            vx, vy, vz, w = tx, ty, tz, tw
        sign = _ONE if w >= _ZERO else -_ONE
        f = sign * angle_factor(min(abs(w), _ONE))
        xi[3, k] = f * vx
        xi[4, k] = f * vy
        xi[5, k] = f * vz


@fast
def _add_component(xi, n, lower, log_weight, far, out):
    """Add one Gaussian component at ``xi`` (6, n) to ``out``.

    ``lower`` (27,): the whitening matrix over sqrt 2, rows of its lower triangle, then the whitened mean.
    ``far``: the other wrap, the rotation by angle - 2 pi about the same axis.
    """
    l00 = lower[0]
    l10, l11 = lower[1], lower[2]
    l20, l21, l22 = lower[3], lower[4], lower[5]
    l30, l31, l32, l33 = lower[6], lower[7], lower[8], lower[9]
    l40, l41, l42, l43, l44 = lower[10], lower[11], lower[12], lower[13], lower[14]
    l50, l51, l52, l53, l54, l55 = lower[15], lower[16], lower[17], lower[18], lower[19], lower[20]
    b0, b1, b2, b3, b4, b5 = lower[21], lower[22], lower[23], lower[24], lower[25], lower[26]
    other = _ONE if far else _ZERO
    for k in range(np.uint64(n)):
        x0, x1, x2, x3, x4, x5 = xi[0, k], xi[1, k], xi[2, k], xi[3, k], xi[4, k], xi[5, k]
        angle = math.sqrt(x3 * x3 + x4 * x4 + x5 * x5 + _TINY)
        wrap = _ONE - other * _TURN / angle
        x3, x4, x5 = x3 * wrap, x4 * wrap, x5 * wrap
        z0 = l00 * x0 - b0
        z1 = l10 * x0 + l11 * x1 - b1
        z2 = l20 * x0 + l21 * x1 + l22 * x2 - b2
        z3 = l30 * x0 + l31 * x1 + l32 * x2 + l33 * x3 - b3
        z4 = l40 * x0 + l41 * x1 + l42 * x2 + l43 * x3 + l44 * x4 - b4
        z5 = l50 * x0 + l51 * x1 + l52 * x2 + l53 * x3 + l54 * x4 + l55 * x5 - b5
        square = z0 * z0 + z1 * z1 + z2 * z2 + z3 * z3 + z4 * z4 + z5 * z5
        out[k] += exp.exp(log_weight - square)


@fast
def _mixture_values(data, frames, begin, n, at, metres, twin, frame_turns, mixture, xi, out):
    """Mixture kernels of rows ``begin .. begin + n``, their largest component 1 at its mean, both twins
    summed.
    """
    for k in range(np.uint64(n)):
        out[k] = _ZERO
    for t in range(2 if twin else 1):
        _displacements(data, frames, begin, n, at, metres, t == 1, frame_turns, xi)
        for j in range(mixture.lowers.shape[0]):
            _add_component(xi, n, mixture.lowers[j], mixture.log_weights[j], False, out)
            if mixture.wraps:
                _add_component(xi, n, mixture.lowers[j], mixture.log_weights[j], True, out)


@fast
def _accumulate(values, n, begin, least, weights, index, kept_values, out):
    """Add ``value * weights[row]`` for every value above ``least``; how many there were.

    First a branch-free compaction, since which values count is hardly predictable, then four rows at a time
    over columns in chunks of constant width, which stay in vector registers.
    """
    kept = 0
    for k in range(np.uint64(n)):
        v = values[k]
        index[kept] = begin + k
        kept_values[kept] = v
        kept += 1 if v > least else 0
    full = kept - kept % 4
    for first in range(0, weights.shape[1], LANES):
        f = np.uint64(first)
        for e in range(0, full, 4):
            i0, i1 = np.uint64(index[e]), np.uint64(index[e + 1])
            i2, i3 = np.uint64(index[e + 2]), np.uint64(index[e + 3])
            v0, v1, v2, v3 = kept_values[e], kept_values[e + 1], kept_values[e + 2], kept_values[e + 3]
            for b in range(np.uint64(LANES)):
                out[f + b] += (
                    v0 * weights[i0, f + b]
                    + v1 * weights[i1, f + b]
                    + v2 * weights[i2, f + b]
                    + v3 * weights[i3, f + b]
                )
        for e in range(full, kept):
            i0, v0 = np.uint64(index[e]), kept_values[e]
            for b in range(np.uint64(LANES)):
                out[f + b] += v0 * weights[i0, f + b]
    return kept


@fast
def isotropic_sums(cells, positions, quaternions, kappa, radius, wide, least, weights, out):
    """Kernel sums of poses (M,) under every weighting: ``out`` (M, B) = K weights (N, B); entries used.

    Entries of K beyond ``radius`` (scaled) or not above ``least`` are zero.
    """
    runs = c.empty_runs(cells, BLOCK)
    values = np.empty(BLOCK, dtype=np.float32)
    kept_values = np.empty(BLOCK + 1, dtype=np.float32)
    index = np.empty(BLOCK + 1, dtype=np.int64)
    kept = 0
    for j in range(positions.shape[0]):
        at = c.place(cells, positions[j], quaternions[j], kappa)
        near = single(at)
        out[j, :] = _ZERO
        for r in range(c.runs_within(cells, at, radius, BLOCK, runs)):
            begin, n = runs[r, 0], runs[r, 1] - runs[r, 0]
            _isotropic_values(cells.data, begin, n, near, F32(runs[r, 2]), wide, values)
            kept += _accumulate(values, n, begin, F32(least), weights, index, kept_values, out[j])
    return kept


@fast
def mixture_sums(cells, frames, frame_turns, positions, quaternions, mixture, radius, least, weights, out):
    """As `isotropic_sums`, for a mixture of Gaussians over the displacement from each row."""
    runs = c.empty_runs(cells, BLOCK)
    values = np.empty(BLOCK, dtype=np.float32)
    kept_values = np.empty(BLOCK + 1, dtype=np.float32)
    index = np.empty(BLOCK + 1, dtype=np.int64)
    xi = np.empty((6, BLOCK), dtype=np.float32)
    metres = 1.0 / cells.scale
    kept = 0
    for j in range(positions.shape[0]):
        at = c.place(cells, positions[j], quaternions[j], 1.0)
        near = single(at)
        out[j, :] = _ZERO
        for r in range(c.runs_within(cells, at, radius, BLOCK, runs)):
            begin, n, twin = runs[r, 0], runs[r, 1] - runs[r, 0], runs[r, 2] > 0
            _mixture_values(
                cells.data, frames, begin, n, near, metres, twin, frame_turns, mixture, xi, values
            )
            kept += _accumulate(values, n, begin, F32(least), weights, index, kept_values, out[j])
    return kept


@exact
def _component_exponent(x, lower):
    """Half the squared Mahalanobis distance of one displacement (6,), in float64."""
    square = 0.0
    at = 0
    for i in range(6):
        z = -lower[21 + i]
        for j in range(i + 1):
            z += lower[at] * x[j]
            at += 1
        square += z * z
    return square


@exact
def mixture_log_sum(rows, mixture, p, q):
    """Log of the weighted mixture sum at one pose over all rows, in float64 and without a cut-off: for poses
    so far from every row that the fast sums vanish.
    """
    top, total = -math.inf, 0.0
    x = np.empty(6)
    for i in range(rows.positions.shape[0]):
        dx, dy, dz = p[0] - rows.positions[i, 0], p[1] - rows.positions[i, 1], p[2] - rows.positions[i, 2]
        f = rows.frames[i]
        ax, ay, az, aw = (
            -rows.quaternions[i, 0],
            -rows.quaternions[i, 1],
            -rows.quaternions[i, 2],
            rows.quaternions[i, 3],
        )
        vx = aw * q[0] + ax * q[3] + ay * q[2] - az * q[1]
        vy = aw * q[1] - ax * q[2] + ay * q[3] + az * q[0]
        vz = aw * q[2] + ax * q[1] - ay * q[0] + az * q[3]
        w = aw * q[3] - ax * q[0] - ay * q[1] - az * q[2]
        for t in range(2 if rows.symmetric[i] else 1):
            flip = -1.0 if (t == 1 and rows.turning) else 1.0
            if t == 1:
                ux, uy, uz, uw = vy, -vx, -w, vz
            else:
                ux, uy, uz, uw = vx, vy, vz, w
            if uw < 0.0:
                ux, uy, uz, uw = -ux, -uy, -uz, -uw
            sine = math.sqrt(ux * ux + uy * uy + uz * uz)
            angle = 2.0 * math.atan2(sine, uw)
            x[0] = flip * (f[0] * dx + f[3] * dy + f[6] * dz)
            x[1] = flip * (f[1] * dx + f[4] * dy + f[7] * dz)
            x[2] = f[2] * dx + f[5] * dy + f[8] * dz
            for wrap in range(2 if mixture.wraps else 1):
                turn = angle - 2.0 * math.pi * wrap
                scale = turn / sine if sine > 1e-12 else 2.0
                x[3], x[4], x[5] = scale * ux, scale * uy, scale * uz
                for j in range(mixture.lowers.shape[0]):
                    value = (
                        rows.log_rows[i] + mixture.log_weights[j] - _component_exponent(x, mixture.lowers[j])
                    )
                    if value > top:
                        total = total * math.exp(top - value) + 1.0 if total > 0.0 else 1.0
                        top = value
                    else:
                        total += math.exp(value - top)
    return top + math.log(total)
