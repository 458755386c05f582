"""Compiled parts of the search for maxima: scoring kernel centres against a region, thinning, climbing.

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

from . import compiled, projection
from .compiler import exact

__all__ = ["climb", "score_centres", "thin"]


#: Columns of a path: position, quaternion, kernel sum.
PATH = 8
_RELAXATION = 1.6


@exact
def score_centres(
    positions, quaternions, twins, sums, planes, spheres, cones, sigma, kappa, reach_m, reach, scores, turned
):
    """Optimistic log density at the feasible pose nearest to every kernel centre, -inf where that is out of
    reach.

    ``log(sum) - excess^2 / (2 sigma^2) - kappa (1 - cos(angle / 2))``: the density at the centre less what
    its own kernel loses on the way into the region. ``turned`` says where the jaw's twin is nearer to a
    signed closing cone.
    """
    signed = cones[8] > 0.5 and cones[7] >= 0.0
    linear = planes.shape[0] + spheres.shape[0] > 0
    # Most centres are far outside a cone: a cosine tells without an arc cosine.
    least_approach = math.cos(min(cones[3] + reach, math.pi)) if cones[3] >= 0.0 else -2.0
    least_closing = math.cos(min(cones[7] + reach, math.pi)) if cones[7] >= 0.0 else -2.0
    for j in range(positions.shape[0]):
        scores[j] = -np.inf
        turned[j] = False
        away, angle = 0.0, 0.0
        x, y, z, w = quaternions[j, 0], quaternions[j, 1], quaternions[j, 2], quaternions[j, 3]
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
            away = max(projection.position_excess(planes, spheres, positions[j]), 0.0)
            if away > reach_m:
                continue
        loss = 0.5 * (away / sigma) ** 2
        if angle > 0.0:
            loss += kappa * (1.0 - math.cos(0.5 * angle))
        scores[j] = math.log(max(sums[j], 1e-300)) - loss


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


@exact
def climb(
    data, start, table, centre, scale, planes, spheres, cones, kappa, radius, wide, positions, quaternions,
    tolerance, path, lengths,
):  # fmt: skip
    """Projected mean shift from every pose (K, ...); ``path`` (K, steps, PATH) gets the feasible poses
    passed.

    The last pose of a path is its best. ``tolerance`` ends a climb, in units of the kernel's widths.
    """
    runs = np.empty((compiled.MAX_RUNS, 2), dtype=np.int64)
    sums = np.empty(9)
    p, q, best_p, best_q = np.empty(3), np.empty(4), np.empty(3), np.empty(4)
    turn_unit = 0.5 * math.sqrt(kappa)
    for j in range(positions.shape[0]):
        p[:] = positions[j]
        q[:] = quaternions[j]
        best = -1.0
        relaxation = 1.0
        lengths[j] = 0
        target_p, target_q = np.empty(3), np.empty(4)
        for _ in range(path.shape[1]):
            px, py, pz = (p[0] - centre[0]) * scale, (p[1] - centre[1]) * scale, (p[2] - centre[2]) * scale
            compiled.moments_at(data, start, table, px, py, pz, q, kappa, radius, wide, runs, sums)
            if sums[0] <= 0.0:
                break
            if sums[0] < best * (1.0 - 1e-6) and relaxation > 1.0:
                # Too long a step: back to the best pose and from there by a plain step.
                relaxation = 1.0
                p[:] = best_p
                q[:] = best_q
            elif sums[0] < best:
                break
            else:
                row = path[j, lengths[j]]
                row[0:3] = p
                row[3:7] = q
                row[7] = sums[0]
                lengths[j] += 1
                moved = 1.0
                if best > 0.0:
                    moved = 0.0
                    for i in range(3):
                        moved += ((p[i] - best_p[i]) * scale) ** 2
                    dot = 0.0
                    for i in range(4):
                        dot += q[i] * best_q[i]
                    moved += 4.0 * turn_unit**2 * max(0.0, 2.0 - 2.0 * abs(dot))
                best = sums[0]
                best_p[:] = p
                best_q[:] = q
                if moved < tolerance * tolerance:
                    break
                for i in range(3):
                    target_p[i] = p[i] + sums[1 + i] / (sums[0] * scale)
                length = math.sqrt(sums[4] ** 2 + sums[5] ** 2 + sums[6] ** 2 + sums[7] ** 2)
                for i in range(4):
                    target_q[i] = sums[4 + i] / length if length > 0.0 else q[i]
                relaxation = _RELAXATION
            norm = 0.0
            for i in range(3):
                p[i] = p[i] + relaxation * (target_p[i] - p[i])
            for i in range(4):
                q[i] = q[i] + relaxation * (target_q[i] - q[i])
                norm += q[i] * q[i]
            norm = math.sqrt(norm)
            for i in range(4):
                q[i] /= norm
            there = projection.project_position(planes, spheres, p)
            if not (projection.project_rotation(cones, q) and there):
                break
