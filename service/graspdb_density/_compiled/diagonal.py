"""Compiled loops over attempts under a Gaussian with a width for every axis, the gripper's or fixed ones."""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

from .isotropic import BLOCK, empty_runs, place, runs_within
from .options import exact, inlined
from .quaternions import relative, turned_back

__all__ = ["held_out_sums", "near_pairs", "square_sums"]


@inlined
def _rotation_vector(ax, ay, az, aw, bx, by, bz, bw):
    """The shortest rotation vector of a^-1 b."""
    x, y, z, w = relative(ax, ay, az, aw, bx, by, bz, bw)
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    size = math.sqrt(x * x + y * y + z * z)
    factor = 2.0
    if size > 1e-12:
        factor = 2.0 * math.atan2(size, w) / size
    return factor * x, factor * y, factor * z


@exact
def square_sums(cells, positions, quaternions, half, turning, radius, out):
    """Sums of k and k^2 at every pose into ``out`` (M, 2), over rows with an exponent of at most radius^2.

    ``half`` (6,): 1 / (2 sigma^2), translations in units of the cells' scale, along each row's gripper's axes
    where ``turning`` and else along those positions are given in. A row's twin counts beside it.
    Of a row's jaw and its turn the translation's x and y differ in sign only, which widths do not see.
    """
    runs, cut, data = empty_runs(cells, BLOCK), radius * radius, cells.data
    for j in range(positions.shape[0]):
        at = place(cells, positions[j], quaternions[j], 1.0)
        bx, by, bz, bw = at.qx, at.qy, at.qz, at.qw
        total, squares = 0.0, 0.0
        for r in range(runs_within(cells, at, radius, BLOCK, runs)):
            for i in range(runs[r, 0], runs[r, 1]):
                x, y, z = at.x - data[0, i], at.y - data[1, i], at.z - data[2, i]
                ax, ay, az, aw = data[3, i], data[4, i], data[5, i], data[6, i]
                if turning:
                    x, y, z = turned_back(ax, ay, az, aw, x, y, z)
                base = half[0] * x * x + half[1] * y * y + half[2] * z * z
                if base > cut:
                    continue
                k = 0.0
                u, v, t = _rotation_vector(ax, ay, az, aw, bx, by, bz, bw)
                e = base + half[3] * u * u + half[4] * v * v + half[5] * t * t
                if e <= cut:
                    k = math.exp(-e)
                if runs[r, 2] > 0:
                    # The row turned about its z: q times (0, 0, 1, 0).
                    u, v, t = _rotation_vector(ay, -ax, aw, -az, bx, by, bz, bw)
                    e = base + half[3] * u * u + half[4] * v * v + half[5] * t * t
                    if e <= cut:
                        k += math.exp(-e)
                total += k
                squares += k * k
        out[j, 0], out[j, 1] = total, squares


@exact
def near_pairs(positions, quaternions, symmetric, fold, judged, turning, widest, cut, first, row, squared):
    """Pairs of a judged attempt and one of another fold, the nearer twin, by squared displacements (along the
    gripper's axes where ``turning``); how many.

    ``widest`` (2,): the largest widths that will be asked for, m and rad; pairs whose exponent is larger than
    ``cut`` under even those are left out. Fills ``first`` (J + 1,), ``row`` (K,) and ``squared`` (K, 6) as
    far as they go: pairs beyond K are counted only.
    """
    count = 0
    room = row.shape[0]
    a, b = 0.5 / widest[0] ** 2, 0.5 / widest[1] ** 2
    for j in range(judged.shape[0]):
        first[j] = min(count, room)
        m = judged[j]
        bx, by, bz, bw = quaternions[m, 0], quaternions[m, 1], quaternions[m, 2], quaternions[m, 3]
        for i in range(positions.shape[0]):
            if fold[i] == fold[m]:
                continue
            dx = positions[m, 0] - positions[i, 0]
            dy = positions[m, 1] - positions[i, 1]
            dz = positions[m, 2] - positions[i, 2]
            e = a * (dx * dx + dy * dy + dz * dz)
            if e > cut:
                continue
            ax, ay, az, aw = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
            own = abs(ax * bx + ay * by + az * bz + aw * bw)
            other = abs(ay * bx - ax * by + aw * bz - az * bw)
            if symmetric[i] and other > own:
                u, v, t = _rotation_vector(ay, -ax, aw, -az, bx, by, bz, bw)
            else:
                u, v, t = _rotation_vector(ax, ay, az, aw, bx, by, bz, bw)
            if e + b * (u * u + v * v + t * t) > cut:
                continue
            if count < room:
                x, y, z = dx, dy, dz
                if turning:
                    x, y, z = turned_back(ax, ay, az, aw, dx, dy, dz)
                row[count] = i
                squared[count, 0], squared[count, 1], squared[count, 2] = x * x, y * y, z * z
                squared[count, 3], squared[count, 4], squared[count, 5] = u * u, v * v, t * t
            count += 1
    first[judged.shape[0]] = min(count, room)
    return count


@exact
def held_out_sums(first, won, squared, half, cut, out):
    """Sums of k over successes, of k and of k^2 over all, (J, 3), of pairs from `near_pairs`."""
    for j in range(first.shape[0] - 1):
        success, total, squares = 0.0, 0.0, 0.0
        for i in range(first[j], first[j + 1]):
            e = 0.0
            for a in range(6):
                e += half[a] * squared[i, a]
            if e <= cut:
                k = math.exp(-e)
                total += k
                squares += k * k
                if won[i]:
                    success += k
        out[j, 0], out[j, 1], out[j, 2] = success, total, squares
