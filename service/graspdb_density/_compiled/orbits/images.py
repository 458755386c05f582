"""Images of a pose by a few motions of the object."""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from ..diagonal import rotation_vector
from ..isotropic import BLOCK, empty_runs, place, runs_within
from ..options import exact, inlined
from ..quaternions import turned_back

__all__ = ["image_sums", "totals"]


@exact
def image_sums(cells, positions, quaternions, half, kappa, wide, turning, radius, out):
    """As `diagonal.square_sums` at the images (M, n, 3), (M, n, 4) of every pose: a row counts once, by the
    image that is nearest to it. Where ``kappa`` is positive the kernel is that of `isotropic.square_sums`.
    """
    runs, cut, data = empty_runs(cells, BLOCK), radius * radius, cells.data
    largest = np.zeros(data.shape[1])
    reached = np.empty(data.shape[1], dtype=np.int64)
    for j in range(positions.shape[0]):
        count, least, nearest = 0, 1e30, -1
        for s in range(positions.shape[1]):
            at = place(cells, positions[j, s], quaternions[j, s], 1.0)
            bx, by, bz, bw = at.qx, at.qy, at.qz, at.qw
            for r in range(runs_within(cells, at, radius, BLOCK, runs)):
                twin = runs[r, 2] > 0
                for i in range(runs[r, 0], runs[r, 1]):
                    x, y, z = at.x - data[0, i], at.y - data[1, i], at.z - data[2, i]
                    ax, ay, az, aw = data[3, i], data[4, i], data[5, i], data[6, i]
                    k = 0.0
                    if kappa > 0.0:
                        base = x * x + y * y + z * z
                        if base > cut:
                            continue
                        own = abs(ax * bx + ay * by + az * bz + aw * bw)
                        other = abs(ax * by - ay * bx + az * bw - aw * bz) if twin else 0.0
                        large, small = kappa * max(own, other), kappa * min(own, other)
                        e = base + kappa - large
                        if e > cut:
                            continue
                        k = math.exp(-e)
                        if wide:
                            base += kappa
                            k += math.exp(-base - large)
                            k += math.exp(small - base) + math.exp(-small - base) if twin else 0.0
                        if e < least:
                            least, nearest = e, i
                    else:
                        if turning:
                            x, y, z = turned_back(ax, ay, az, aw, x, y, z)
                        base = half[0] * x * x + half[1] * y * y + half[2] * z * z
                        if base > cut:
                            continue
                        u, v, t = rotation_vector(ax, ay, az, aw, bx, by, bz, bw)
                        e = base + half[3] * u * u + half[4] * v * v + half[5] * t * t
                        if e <= cut:
                            k = math.exp(-e)
                            if e < least:
                                least, nearest = e, i
                        if twin:
                            u, v, t = rotation_vector(ay, -ax, aw, -az, bx, by, bz, bw)
                            e = base + half[3] * u * u + half[4] * v * v + half[5] * t * t
                            if e <= cut:
                                k += math.exp(-e)
                                if e < least:
                                    least, nearest = e, i
                    if k > 0.0:
                        if largest[i] == 0.0:
                            reached[count] = i
                            count += 1
                        largest[i] = max(largest[i], k)
        totals(largest, reached, count, least, nearest, out[j])


@inlined
def totals(largest, reached, count, least, nearest, out):
    """Sums of the kernels of the rows that were reached, which are cleared."""
    total, squares = 0.0, 0.0
    for c in range(count):
        k = largest[reached[c]]
        total += k
        squares += k * k
        largest[reached[c]] = 0.0
    out[0], out[1] = total, squares
    if out.shape[0] > 2:
        out[2], out[3] = -least, nearest
