"""Compiled loops over attempts under a Gaussian with a width for every axis, the gripper's or fixed ones."""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from .exp import exp
from .isotropic import BLOCK, COUNT, OFFSET, TWIN, empty_runs, place, runs_within
from .isotropic_runs import single
from .options import exact, fast, inlined
from .quaternions import angle_factor, relative, turned_back

__all__ = [
    "displacements",
    "held_out_sums",
    "left_out_sums",
    "near_pairs",
    "nearest_anywhere",
    "rotation_vector",
    "square_sums",
]

F32 = np.float32
_ZERO, _ONE = F32(0.0), F32(1.0)
#: Rows with a smaller exponent are at one pose, tried again.
_SAME = 0.5 * 0.05**2


@inlined
def rotation_vector(ax, ay, az, aw, bx, by, bz, bw):
    """The shortest rotation vector of a^-1 b."""
    x, y, z, w = relative(ax, ay, az, aw, bx, by, bz, bw)
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    size = math.sqrt(x * x + y * y + z * z)
    factor = 2.0
    if size > 1e-12:
        factor = 2.0 * math.atan2(size, w) / size
    return factor * x, factor * y, factor * z


@inlined
def _displaced(data, i, twin, at, half, turning):
    """From row ``i``, or its nearer twin, to a pose: the translation (3) along the axes of the widths, the
    rotation vector (3), and the exponents of either.
    """
    dx, dy, dz = at.x - data[0, i], at.y - data[1, i], at.z - data[2, i]
    ax, ay, az, aw = data[3, i], data[4, i], data[5, i], data[6, i]
    x, y, z = dx, dy, dz
    if turning:
        x, y, z = turned_back(ax, ay, az, aw, dx, dy, dz)
    u, v, t = rotation_vector(ax, ay, az, aw, at.qx, at.qy, at.qz, at.qw)
    turned = half[3] * u * u + half[4] * v * v + half[5] * t * t
    if twin:
        b, c, d = rotation_vector(ay, -ax, aw, -az, at.qx, at.qy, at.qz, at.qw)
        other = half[3] * b * b + half[4] * c * c + half[5] * d * d
        if other < turned:
            u, v, t, turned = b, c, d, other
    moved = half[0] * x * x + half[1] * y * y + half[2] * z * z
    return x, y, z, u, v, t, moved, turned


@inlined
def _turned_least(w):
    """The least squared angle, radians, of a rotation whose quaternion has ``w``: little below it up to a
    right angle, and cheap.
    """
    return 8.0 * (1.0 - abs(w))


@inlined
def _lowest(half):
    """The least of 1 / (2 sigma^2), of translations and of rotations."""
    return min(half[0], min(half[1], half[2])), min(half[3], min(half[4], half[5]))


@inlined
def _farther(data, i, twin, at, least, cut):
    """Whether what is cheap to know shows that the exponent of a row, and of its twin, is at least ``cut``;
    ``least`` is `_lowest`.
    """
    x, y, z = at.x - data[0, i], at.y - data[1, i], at.z - data[2, i]
    ax, ay, az, aw = data[3, i], data[4, i], data[5, i], data[6, i]
    near = abs(ax * at.qx + ay * at.qy + az * at.qz + aw * at.qw)
    if twin:
        near = max(near, abs(ay * at.qx - ax * at.qy + aw * at.qz - az * at.qw))
    return least[0] * (x * x + y * y + z * z) + least[1] * _turned_least(near) >= cut


@fast
def _squares_run(data, begin, end, at, half, turning, twin, cut):
    """Sums of k and k^2 over the rows of a run whose exponent is at most ``cut``, their twins beside them."""
    h0, h1, h2, h3, h4, h5 = half
    total, squares = _ZERO, _ZERO
    for i in range(np.uint64(begin), np.uint64(end)):
        x, y, z = at.x - data[0, i], at.y - data[1, i], at.z - data[2, i]
        ax, ay, az, aw = data[3, i], data[4, i], data[5, i], data[6, i]
        if turning:
            x, y, z = turned_back(ax, ay, az, aw, x, y, z)
        base = h0 * x * x + h1 * y * y + h2 * z * z
        u, v, t, w = relative(ax, ay, az, aw, at.qx, at.qy, at.qz, at.qw)
        f = angle_factor(min(abs(w), _ONE))
        e = base + f * f * (h3 * u * u + h4 * v * v + h5 * t * t)
        k = exp(-e) if e <= cut else _ZERO
        if twin:
            # The row turned about its z: from there the rotation is (v, -u, -w, t).
            f = angle_factor(min(abs(t), _ONE))
            e = base + f * f * (h3 * v * v + h4 * u * u + h5 * w * w)
            k += exp(-e) if e <= cut else _ZERO
        total += k
        squares += k * k
    return total, squares


@fast
def _nearest_by_sums(data, at, runs, of_run, half, turning):
    """The least exponent of some runs' rows, and its place, by the sums of their kernels, which are used up.

    No kernel is larger than its run's sum, so few runs are looked through.
    """
    least, nearest = 1e30, -1
    lowest = _lowest(half)
    for _ in range(of_run.shape[0]):
        r = int(np.argmax(of_run))
        if of_run[r] <= 0.0 or of_run[r] < 0.999 * math.exp(-least):
            break
        for i in range(runs[r, 0], runs[r, 1]):
            if _farther(data, i, runs[r, 2] > 0, at, lowest, least):
                continue
            displaced = _displaced(data, i, runs[r, 2] > 0, at, half, turning)
            e = displaced[6] + displaced[7]
            if e < least:
                least, nearest = e, i
        of_run[r] = 0.0
    return least, nearest


@fast
def square_sums(cells, positions, quaternions, half, turning, radius, out):
    """Sums of k and k^2 at every pose into ``out`` (M, 2), over rows with an exponent of at most radius^2.

    ``half`` (6,): 1 / (2 sigma^2), translations in units of the cells' scale, along each row's gripper's axes
    where ``turning`` and else along those positions are given in. A row's twin counts beside it.
    Of a row's jaw and its turn the translation's x and y differ in sign only, which widths do not see. Where
    ``out`` has four columns, the nearest row's exponent and its place follow, -1e30 and -1 without any.
    """
    runs, cut, data = empty_runs(cells, BLOCK), F32(radius * radius), cells.data
    of_run = np.empty(runs.shape[0])
    narrow = F32(half[0]), F32(half[1]), F32(half[2]), F32(half[3]), F32(half[4]), F32(half[5])
    for j in range(positions.shape[0]):
        at = place(cells, positions[j], quaternions[j], 1.0)
        near, total, squares = single(at), 0.0, 0.0
        count = runs_within(cells, at, radius, BLOCK, runs)
        for r in range(count):
            begin, end, twin = runs[r, 0], runs[r, 1], runs[r, 2] > 0
            # The constants let LLVM make a loop of its own of each.
            if turning and twin:
                part = _squares_run(data, begin, end, near, narrow, True, True, cut)
            elif turning:
                part = _squares_run(data, begin, end, near, narrow, True, False, cut)
            elif twin:
                part = _squares_run(data, begin, end, near, narrow, False, True, cut)
            else:
                part = _squares_run(data, begin, end, near, narrow, False, False, cut)
            total += part[0]
            squares += part[1]
            of_run[r] = part[0]
        out[j, 0], out[j, 1] = total, squares
        if out.shape[1] > 2:
            least, nearest = _nearest_by_sums(data, at, runs, of_run[:count], half, turning)
            out[j, 2], out[j, 3] = -least, nearest


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
            near = max(own, other) if symmetric[i] else own
            if e + b * _turned_least(near) > cut:
                continue
            if symmetric[i] and other > own:
                u, v, t = rotation_vector(ay, -ax, aw, -az, bx, by, bz, bw)
            else:
                u, v, t = rotation_vector(ax, ay, az, aw, bx, by, bz, bw)
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


@exact
def displacements(cells, places, positions, quaternions, half, turning, gripper, out):
    """How far every pose is from the row at its place, into ``out`` (M, 10): metres, radians, either in
    widths, and the translation (3) and rotation vector (3) themselves, metres and radians. ``half`` and
    ``turning`` as in `square_sums`; where ``gripper``, the translation is along the row's gripper's axes
    whatever the widths are along.
    """
    table = cells.table
    for j in range(positions.shape[0]):
        i, twin = places[j], False
        for s in range(table.shape[0]):
            if table[s, OFFSET] <= i < table[s, OFFSET] + table[s, COUNT]:
                twin = table[s, TWIN] > 0.0
        at = place(cells, positions[j], quaternions[j], 1.0)
        x, y, z, u, v, t, moved, turned = _displaced(cells.data, i, twin, at, half, turning)
        out[j, 0] = math.sqrt(x * x + y * y + z * z) / cells.scale
        out[j, 1] = math.sqrt(u * u + v * v + t * t)
        out[j, 2] = math.sqrt(2.0 * moved)
        out[j, 3] = math.sqrt(2.0 * turned)
        if gripper and not turning:
            data = cells.data
            x, y, z = turned_back(data[3, i], data[4, i], data[5, i], data[6, i], x, y, z)
        out[j, 4], out[j, 5], out[j, 6] = x / cells.scale, y / cells.scale, z / cells.scale
        out[j, 7], out[j, 8], out[j, 9] = u, v, t


@exact
def nearest_anywhere(cells, positions, quaternions, half, turning, out):
    """As `nearest.nearest_anywhere`, under widths for every axis: minus the least exponent, and its place."""
    data, boxes, blocks = cells.data, cells.boxes, cells.blocks
    least = _lowest(half)
    for j in range(positions.shape[0]):
        at = place(cells, positions[j], quaternions[j], 1.0)
        best, chosen = -1e30, -1
        for b in range(blocks.shape[0]):
            gx = max(max(boxes[b, 0] - at.x, at.x - boxes[b, 3]), 0.0)
            gy = max(max(boxes[b, 1] - at.y, at.y - boxes[b, 4]), 0.0)
            gz = max(max(boxes[b, 2] - at.z, at.z - boxes[b, 5]), 0.0)
            if -least[0] * (gx * gx + gy * gy + gz * gz) <= best:
                continue
            for i in range(blocks[b, 0], blocks[b, 1]):
                if _farther(data, i, blocks[b, 2] > 0, at, least, -best):
                    continue
                displaced = _displaced(data, i, blocks[b, 2] > 0, at, half, turning)
                exponent = -displaced[6] - displaced[7]
                if exponent > best:
                    best, chosen = exponent, i
        out[j, 0], out[j, 1] = best, chosen


@exact
def left_out_sums(
    cells, share, positions, quaternions, own, sides, half, turning, radius, step, width, sums, nearest
):
    """Kernel sums of rows by how far they are from every judged pose (J), as if the pose stood at the edge of
    what was tried: of displacements only those that point to one side count.

    Parameters
    ----------
    share : by how much these rows succeeded
    own : (J,) the row that is the pose itself, left out; -1 where it is not among these
    sides : (J, 6) the directions away from the side that counts, of translation and of the rotation vector
    step : every so many'th row is looked at
    width : of a shell, in kernel widths
    sums : (J, 2, K, 3)
        To which k of successes, k, and k^2 are added: by the shell of the translation, and of the rotation.
    nearest : (J, 3)
        The least exponent so far of another pose, and that row's translation and rotation in widths; no side
        is left out.
    """
    runs, cut, data, shells = empty_runs(cells, BLOCK), radius * radius, cells.data, sums.shape[2]
    least = _lowest(half)
    for j in range(positions.shape[0]):
        at, side = place(cells, positions[j], quaternions[j], 1.0), sides[j]
        for r in range(runs_within(cells, at, radius, BLOCK, runs)):
            for i in range(runs[r, 0] + (-runs[r, 0]) % step, runs[r, 1], step):
                if i == own[j]:
                    continue
                if _farther(data, i, runs[r, 2] > 0, at, least, cut):
                    continue
                x, y, z, u, v, t, moved, turned = _displaced(data, i, runs[r, 2] > 0, at, half, turning)
                if moved + turned > cut:
                    continue
                apart = math.sqrt(2.0 * moved), math.sqrt(2.0 * turned)
                if _SAME < moved + turned < nearest[j, 0]:
                    nearest[j, 0] = moved + turned
                    nearest[j, 1], nearest[j, 2] = apart
                k = math.exp(-moved - turned)
                along = x * side[0] + y * side[1] + z * side[2], u * side[3] + v * side[4] + t * side[5]
                for kind in range(2):
                    if along[kind] <= 0.0:
                        row = sums[j, kind, min(int(apart[kind] / width), shells - 1)]
                        row[0] += share * k
                        row[1] += k
                        row[2] += k * k
