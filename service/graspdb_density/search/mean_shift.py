"""Mean shift, compiled: kernel centres against a region, thinning, climbing, random steps.

Climbing is projected mean shift. Every step maximises a lower bound of the log density that touches it at the
present pose: a quadratic in position, whose maximiser over a convex set is the projection of the mean-shift
point, and a linear form in the quaternion, whose maximiser over a set of rotations is the projection of the
mean-shift rotation. So steps of length 1 never descend; longer ones (over-relaxation, which halves the number
of steps) are taken back when they do.
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from .._compiled import exp, isotropic, nearest
from .._compiled.isotropic_runs import cosines, offset, single, squared
from .._compiled.options import exact, fast
from .feasible_projection import position_excess, project

F32 = np.float32
__all__ = ["PATH", "bound_centres", "climb", "scatter", "thin"]


#: Columns of a path: position, quaternion, kernel sum.
PATH = 8
#: Longest step as a multiple of the mean shift's, and in kernel widths where it is longer than that.
_LONGEST, _FARTHEST = 40.0, 1.0
#: A climb gathers kernels anew after so many kernel widths, and before it ends where it has moved more than
#: the second.
_STRAYED, _SETTLED = 0.8, 0.3


@exact
def bound_centres(centres, twins, limits, sigma, kappa, reach_m, reach, bounds, turned):
    """Optimistic log of the kernel sum at the feasible pose nearest to every kernel centre, -inf where that
    is out of reach.

    ``log(sum) - excess^2 / (2 sigma^2) - kappa (1 - cos(angle / 2))``: the sum at the centre less what its
    own kernel loses on the way into the region. ``turned`` says where the jaw's twin is nearer to a signed
    closing cone. ``centres`` (M, 8) are positions, quaternions and logs of their sums.
    """
    cones = limits.cones
    signed = cones[8] > 0.5 and cones[7] >= 0.0
    linear = limits.planes.shape[0] + limits.balls.shape[0] > 0
    # Most centres are far outside a cone: a cosine tells without an arc cosine.
    least_approach = math.cos(min(cones[3] + reach, math.pi)) if cones[3] >= 0.0 else -2.0
    least_closing = math.cos(min(cones[7] + reach, math.pi)) if cones[7] >= 0.0 else -2.0
    p = np.empty(3)
    for j in range(centres.shape[0]):
        bounds[j] = -np.inf
        turned[j] = False
        away, angle = 0.0, 0.0
        row = centres[j]
        x, y, z, w = float(row[3]), float(row[4]), float(row[5]), float(row[6])
        if cones[3] >= 0.0:
            dot = (
                cones[0] * 2.0 * (x * z + y * w)
                + cones[1] * 2.0 * (y * z - x * w)
                + cones[2] * (1.0 - 2.0 * (x * x + y * y))
            )
            if dot < least_approach:
                continue
            angle = math.acos(min(max(dot, -1.0), 1.0)) - cones[3]
        if cones[7] >= 0.0:
            dot = (
                cones[4] * 2.0 * (x * y - z * w)
                + cones[5] * (1.0 - 2.0 * (x * x + z * z))
                + cones[6] * 2.0 * (y * z + x * w)
            )
            if dot < 0.0 and (not signed or twins[j]):
                # Without a sign, or for a jaw whose fingers may be exchanged, the axis has two ends.
                dot = -dot
                turned[j] = signed
            if dot < least_closing:
                continue
            angle = max(angle, math.acos(min(max(dot, -1.0), 1.0)) - cones[7])
        if linear:
            p[0], p[1], p[2] = row[0], row[1], row[2]
            away = max(position_excess(limits, p), 0.0)
            if away > reach_m:
                continue
        loss = 0.5 * (away / sigma) ** 2
        if angle > 0.0:
            loss += kappa * (1.0 - math.cos(0.5 * angle))
        bounds[j] = row[7] - loss


@exact
def _same(p, q, other_p, other_q, separation_m, cosine, twins):
    """Whether two grasps are within both separations; ``cosine`` is that of half the angle."""
    squared = (p[0] - other_p[0]) ** 2 + (p[1] - other_p[1]) ** 2 + (p[2] - other_p[2]) ** 2
    if squared > separation_m * separation_m:
        return False
    dot = abs(q[0] * other_q[0] + q[1] * other_q[1] + q[2] * other_q[2] + q[3] * other_q[3])
    if twins:
        dot = max(dot, abs(q[0] * other_q[1] - q[1] * other_q[0] + q[2] * other_q[3] - q[3] * other_q[2]))
    return dot >= cosine


@exact
def thin(positions, quaternions, first, limit, separation_m, separation, twins, kept):
    """Greedy choice of mutually distinct poses in the order given, after ``first`` that are chosen already.

    ``kept`` (at least ``limit``) holds indices, the first ``first`` of them set; returns how many there are
    now.
    """
    cosine = math.cos(0.5 * min(separation, math.pi))
    count = first
    for j in range(positions.shape[0]):
        if count >= limit:
            break
        distinct = True
        for k in range(count):
            i = kept[k]
            if _same(positions[j], quaternions[j], positions[i], quaternions[i], separation_m, cosine, twins):
                distinct = False
                break
        if distinct:
            kept[count] = j
            count += 1
    return count


@fast
def _gather(cells, at, cut, runs, buffer, near):
    """Kernels whose exponent at a pose is above ``-cut``, into ``near`` (8, ...): as ``data``, but every end
    (twin, antipode) a kernel of its own with the sign that faces the pose. Answers how many there are.
    """
    data, here, least = cells.data, single(at), F32(-cut)
    count = 0
    for r in range(isotropic.runs_within(cells, at, math.sqrt(cut), nearest.GATHERED, runs)):
        begin, twin = runs[r, 0], F32(runs[r, 2])
        nearest.exponents(data, begin, runs[r, 1], here, twin, buffer)
        for i in range(runs[r, 1] - begin):
            if buffer[i] <= least:
                continue
            j = begin + i
            u0, u1, u2, u3 = data[3, j], data[4, j], data[5, j], data[6, j]
            base = -here.kappa - squared(data, j, here)
            for end in range(4 if twin > F32(0.0) else 2):
                if end == 2:
                    # The twin of mu is (mu_y, -mu_x, mu_w, -mu_z).
                    u0, u1, u2, u3 = u1, -u0, u3, -u2
                elif end > 0:
                    u0, u1, u2, u3 = -u0, -u1, -u2, -u3
                exponent = base + u0 * here.qx + u1 * here.qy + u2 * here.qz + u3 * here.qw
                if exponent > least and count < near.shape[1]:
                    for axis in range(3):
                        near[axis, count] = data[axis, j]
                    near[3, count], near[4, count], near[5, count], near[6, count] = u0, u1, u2, u3
                    near[7, count] = data[7, j]
                    count += 1
    return count


@fast
def _moments(near, count, at, sums):
    """Sums (8,) of k, k (p_i - p) and the pull k mu_i over gathered kernels, scaled units."""
    sums[:] = 0.0
    for begin in range(0, count, isotropic.BLOCK):
        s = F32(0.0)
        sx, sy, sz = F32(0.0), F32(0.0), F32(0.0)
        m0, m1, m2, m3 = F32(0.0), F32(0.0), F32(0.0), F32(0.0)
        for i in range(np.uint64(begin), np.uint64(min(begin + isotropic.BLOCK, count))):
            dx, dy, dz = offset(near, i, at)
            k = near[7, i] * exp.exp(cosines(near, i, at)[0] - at.kappa - squared(near, i, at))
            s += k
            sx += k * dx
            sy += k * dy
            sz += k * dz
            m0 += k * near[3, i]
            m1 += k * near[4, i]
            m2 += k * near[5, i]
            m3 += k * near[6, i]
        for i, part in enumerate((s, sx, sy, sz, m0, m1, m2, m3)):
            sums[i] += part


@fast
def _sum(near, count, at):
    """Sum of gathered kernels at a pose."""
    total = np.float64(0.0)
    for begin in range(0, count, isotropic.BLOCK):
        s = F32(0.0)
        for i in range(np.uint64(begin), np.uint64(min(begin + isotropic.BLOCK, count))):
            s += near[7, i] * exp.exp(cosines(near, i, at)[0] - at.kappa - squared(near, i, at))
        total += s
    return total


@exact
def _in_widths(p, q, unit, turn, x):
    """A pose (7,) in units of the kernel's widths: position over sigma, sqrt(kappa) times the quaternion."""
    for i in range(3):
        x[i] = p[i] / unit
    for i in range(4):
        x[3 + i] = q[i] * turn


@exact
def _stride(x, step, last_x, last_step, known):
    """How far to go along a step, as a multiple of it, and its squared length.

    The inverse curvature that the last two poses saw along their difference (Barzilai and Borwein, 1988), of
    the projected step: along a curved limit, the limit's curvature counts.
    """
    moved, bent, size = 0.0, 0.0, 0.0
    for i in range(7):
        size += step[i] * step[i]
        if known:
            moved += (x[i] - last_x[i]) ** 2
            bent += (x[i] - last_x[i]) * (last_step[i] - step[i])
    if not known:
        return 1.0, size
    stride = moved / bent if bent * _LONGEST > moved else _LONGEST
    return max(1.0, min(stride, _FARTHEST / math.sqrt(size) if size > 0.0 else 1.0)), size


# long: a climb's state stays in one loop; taken apart, every piece would pass a dozen arrays on.
@exact
def climb(cells, limits, kappa, cut, positions, quaternions, gain, path, lengths):
    """Climb from every pose (K, ...); ``path`` (K, steps, PATH) gets the feasible poses passed.

    Kernels are gathered once around a pose and used while the climb stays near: those with an exponent above
    ``-cut``. So sums are too low by what is farther, a per cent or so in dense data; it is flat and hardly
    moves the maximum, but to compare poses of different climbs their sums have to be taken anew.

    The last pose of a path is its best. A climb ends where the next step promises to raise the log density by
    less than ``gain``.
    """
    runs = isotropic.empty_runs(cells, nearest.GATHERED)
    buffer = np.empty(nearest.GATHERED, dtype=np.float32)
    near = np.empty((8, 2 * cells.data.shape[1] + 1024), dtype=np.float32)
    sums = np.empty(8)
    unit, turn = 1.0 / (cells.scale * math.sqrt(2.0)), math.sqrt(kappa)
    p, q, x, step, gathered = np.empty(3), np.empty(4), np.empty(7), np.empty(7), np.empty(7)
    last_x, last_step, best_x, best_step = np.empty(7), np.empty(7), np.empty(7), np.empty(7)
    for j in range(positions.shape[0]):
        p[:] = positions[j]
        q[:] = quaternions[j]
        best, top, known, plain, worst, older = -1.0, 0, False, True, 0.0, 0.0
        count = -1
        lengths[j] = 0
        while lengths[j] < path.shape[1]:
            at = isotropic.place(cells, p, q, kappa)
            _in_widths(p, q, unit, turn, x)
            apart = 0.0
            if count >= 0:
                for i in range(7):
                    apart += (x[i] - gathered[i]) ** 2
            if count < 0 or apart > _STRAYED * _STRAYED:
                count = _gather(cells, at, cut, runs, buffer, near)
                gathered[:] = x
                apart = 0.0
                # Other kernels, other sums: what was seen before is no measure.
                best, known, plain, worst, older = -1.0, False, True, 0.0, 0.0
            _moments(near, count, single(at), sums)
            here = sums[0]
            if here <= 0.0:
                break
            row = path[j, lengths[j]]
            row[0:3] = p
            row[3:7] = q
            row[7] = here
            lengths[j] += 1
            if here < min(worst, older):
                # Too long a step: back to the best pose and from there by mean shift, which can't descend.
                if plain:
                    break
                x[:] = best_x
                step[:] = best_step
                known, plain = False, True
                worst, older = best, best
            else:
                worst, older = here, worst if best > 0.0 else here
                length = math.sqrt(sums[4] ** 2 + sums[5] ** 2 + sums[6] ** 2 + sums[7] ** 2)
                for i in range(3):
                    p[i] += sums[1 + i] / (here * cells.scale)
                for i in range(4):
                    q[i] = sums[4 + i] / length if length > 0.0 else q[i]
                if not project(limits, p, q):
                    break
                _in_widths(p, q, unit, turn, step)
                step -= x
                if here > best:
                    best, top = here, lengths[j] - 1
                    best_x[:] = x
                    best_step[:] = step
                plain = False
            stride, size = _stride(x, step, last_x, last_step, known)
            norm = 0.0
            for i in range(3):
                p[i] = (x[i] + stride * step[i]) * unit
            for i in range(4):
                q[i] = x[3 + i] + stride * step[3 + i]
                norm += q[i] * q[i]
            q /= math.sqrt(norm)
            if not project(limits, p, q):
                break
            # Half the slope times the way ahead, the gain of a parabola.
            if 0.5 * stride * size < gain:
                if apart < _SETTLED * _SETTLED:
                    break
                # At rest among the kernels of a while ago: gather anew.
                count = -1
            last_x[:] = x
            last_step[:] = step
            known = True
        if lengths[j] > 0 and best > 0.0 and top != lengths[j] - 1:
            for i in range(PATH):
                held = path[j, top, i]
                path[j, top, i] = path[j, lengths[j] - 1, i]
                path[j, lengths[j] - 1, i] = held


@exact
def _times(q, x, y, z, w, out):
    """The product of two quaternions."""
    out[0] = q[3] * x + q[0] * w + q[1] * z - q[2] * y
    out[1] = q[3] * y - q[0] * z + q[1] * w + q[2] * x
    out[2] = q[3] * z + q[0] * y - q[1] * x + q[2] * w
    out[3] = q[3] * w - q[0] * x - q[1] * y - q[2] * z


@exact
def scatter(
    cells, limits, kappa, cut, positions, quaternions, moves, turns, tried_p, tried_q, values
):  # fmt: skip
    """Feasible poses around each of some poses, with their sums.

    Around pose k, the tries are its position plus ``moves[k, t]`` (metres) and its quaternion turned by the
    rotation vectors ``turns[k, t]`` (radians, tool frame), both the other way where that is uphill, projected
    into the region. ``values`` (K, 1 + T) gets the sum at the pose itself and at every try, -1 where the
    projection failed. They are sums over the kernels with an exponent above ``-cut`` at the pose: right for
    comparisons around one pose.
    """
    runs = isotropic.empty_runs(cells, nearest.GATHERED)
    buffer = np.empty(nearest.GATHERED, dtype=np.float32)
    near = np.empty((8, 2 * cells.data.shape[1] + 1024), dtype=np.float32)
    sums = np.empty(8)
    for j in range(positions.shape[0]):
        p, q = positions[j], quaternions[j]
        at = isotropic.place(cells, p, q, kappa)
        count = _gather(cells, at, cut, runs, buffer, near)
        _moments(near, count, single(at), sums)
        values[j, 0] = sums[0]
        for t in range(moves.shape[1]):
            to_p, to_q, v = tried_p[j, t], tried_q[j, t], turns[j, t]
            slope = 0.0
            for i in range(3):
                slope += 2.0 * cells.scale * sums[1 + i] * moves[j, t, i]
            # Half of q (v, 0), the change of q to first order.
            _times(q, v[0], v[1], v[2], 0.0, to_q)
            for i in range(4):
                slope += 0.5 * kappa * sums[4 + i] * to_q[i]
            sign = -1.0 if slope < 0.0 else 1.0
            for i in range(3):
                to_p[i] = p[i] + sign * moves[j, t, i]
            angle = math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
            s = sign * (0.5 if angle < 1e-12 else math.sin(0.5 * angle) / angle)
            _times(q, s * v[0], s * v[1], s * v[2], math.cos(0.5 * angle), to_q)
            values[j, 1 + t] = -1.0
            if project(limits, to_p, to_q):
                values[j, 1 + t] = _sum(near, count, single(isotropic.place(cells, to_p, to_q, kappa)))
