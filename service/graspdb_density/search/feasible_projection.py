"""Nearest feasible poses, compiled.

Positions: the dual method for half-spaces; with balls, Dykstra's alternating projections (1986), which
converge to the nearest point of the intersection. Rotations: the nearest rotation whose approach and closing
axes lie in their cones; one cone in closed form (turn the axis to the cone's rim about their common normal),
two by sequential quadratic programming on the rotation vector, whose subproblem with two constraints is
solved exactly.

A region reaches them as `Limits`.
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .._compiled.options import exact
from ..se3 import Floats

__all__ = [
    "Limits",
    "cone_excess",
    "contains_all",
    "position_excess",
    "project",
    "project_all",
    "project_position",
]


#: Projections aim this far inside, so that rounding does not leave them outside. Metres; radians.
MARGIN_M = 5e-10
MARGIN = 1e-8


class Limits(NamedTuple):
    """A region, as compiled functions take it.

    Attributes
    ----------
    planes : (K, 4)
        Unit normals n and offsets d, metres: n.x >= d.
    balls : (S, 4)
        Centres and radii, metres.
    cones : (9,)
        Approach axis, its angle, closing axis, its angle, 1 where the closing axis keeps its sign. A negative
        angle means no cone.
    """

    planes: Floats
    balls: Floats
    cones: Floats


@exact
def position_excess(limits, p):
    """Distance by which a point misses the constraint it misses most, metres; at most 0 inside."""
    planes, balls = limits.planes, limits.balls
    worst = -1e300
    for k in range(planes.shape[0]):
        miss = planes[k, 3] - (planes[k, 0] * p[0] + planes[k, 1] * p[1] + planes[k, 2] * p[2])
        worst = max(worst, miss)
    for k in range(balls.shape[0]):
        x, y, z = p[0] - balls[k, 0], p[1] - balls[k, 1], p[2] - balls[k, 2]
        worst = max(worst, math.sqrt(x * x + y * y + z * z) - balls[k, 3])
    return worst


@exact
def _excess(q, which, cone, signed, normal):
    """Angle by which the tool's axis y (``which`` = 1) or z (2), its nearer end unless ``signed``, leaves a
    cone (axis, angle); ``normal`` gets the unit turn that brings it back, object frame.
    """
    x, y, z, w = q[0], q[1], q[2], q[3]
    if which == 2:
        a0, a1, a2 = 2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)
    else:
        a0, a1, a2 = 2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)
    dot = a0 * cone[0] + a1 * cone[1] + a2 * cone[2]
    flip = -1.0 if (dot < 0.0 and not signed) else 1.0
    a0, a1, a2 = flip * a0, flip * a1, flip * a2
    normal[0] = a1 * cone[2] - a2 * cone[1]
    normal[1] = a2 * cone[0] - a0 * cone[2]
    normal[2] = a0 * cone[1] - a1 * cone[0]
    sine = length = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    if sine <= 1e-12:
        # Parallel or opposite: any normal will do.
        if abs(a0) < 0.6:
            normal[0], normal[1], normal[2] = 0.0, -a2, a1
        else:
            normal[0], normal[1], normal[2] = a2, 0.0, -a0
        length = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    for i in range(3):
        normal[i] /= length
    return math.atan2(sine, flip * dot) - cone[3]


@exact
def cone_excess(cones, q):
    """Angle by which the worse of the two axes leaves its cone, radians; at most 0 inside."""
    normal = np.empty(3)
    worst = -1e300
    if cones[3] >= 0.0:
        worst = max(worst, _excess(q, 2, cones[0:4], True, normal))
    if cones[7] >= 0.0:
        worst = max(worst, _excess(q, 1, cones[4:8], cones[8] > 0.5, normal))
    return worst


@exact
def _turn(q, v):
    """q <- exp(v) q, v a rotation vector in the object frame."""
    angle = math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    s = 0.5 if angle < 1e-12 else math.sin(0.5 * angle) / angle
    ax, ay, az, aw = s * v[0], s * v[1], s * v[2], math.cos(0.5 * angle)
    bx, by, bz, bw = q[0], q[1], q[2], q[3]
    q[0] = aw * bx + ax * bw + ay * bz - az * by
    q[1] = aw * by - ax * bz + ay * bw + az * bx
    q[2] = aw * bz + ax * by - ay * bx + az * bw
    q[3] = aw * bw - ax * bx - ay * by - az * bz
    length = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for i in range(4):
        q[i] /= length


@exact
def _pull_back(v, n, out):
    """Gradient by the rotation vector v of a function whose gradient by a small further turn is n: J_l(v)^T
    n.
    """
    t = math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    if t < 1e-4:
        a, b = 0.5, 1.0 / 6.0
    else:
        a, b = (1.0 - math.cos(t)) / t**2, (t - math.sin(t)) / t**3
    c0, c1, c2 = v[1] * n[2] - v[2] * n[1], v[2] * n[0] - v[0] * n[2], v[0] * n[1] - v[1] * n[0]
    d0, d1, d2 = v[1] * c2 - v[2] * c1, v[2] * c0 - v[0] * c2, v[0] * c1 - v[1] * c0
    out[0], out[1], out[2] = n[0] - a * c0 + b * d0, n[1] - a * c1 + b * d1, n[2] - a * c2 + b * d2


@exact
def _least(g1, r1, g2, r2, v):
    """Shortest v with g1.v >= r1 and g2.v >= r2 (a plain compromise where they contradict)."""
    a11, a22, a12 = 0.0, 0.0, 0.0
    for i in range(3):
        a11 += g1[i] * g1[i]
        a22 += g2[i] * g2[i]
        a12 += g1[i] * g2[i]
    l1, l2 = max(r1, 0.0) / a11, 0.0
    if l1 * a12 < r2:
        l1, l2 = 0.0, max(r2, 0.0) / a22
        if l2 * a12 < r1:
            det = a11 * a22 - a12 * a12
            if det > 1e-9 * a11 * a22:
                l1, l2 = (r1 * a22 - r2 * a12) / det, (r2 * a11 - r1 * a12) / det
            else:
                l1, l2 = 0.5 * max(r1, 0.0) / a11, 0.5 * max(r2, 0.0) / a22
    for i in range(3):
        v[i] = l1 * g1[i] + l2 * g2[i]


@exact
def _into_both(cones, q):
    """Turn q to nearly the nearest rotation inside both cones."""
    signed, origin = cones[8] > 0.5, q.copy()
    n1, n2, v, g1, g2 = np.empty(3), np.empty(3), np.zeros(3), np.empty(3), np.empty(3)
    damping, last = 1.0, 1e300
    for _ in range(60):
        r1 = _excess(q, 2, cones[0:4], True, n1) + MARGIN
        r2 = _excess(q, 1, cones[4:8], signed, n2) + MARGIN
        _pull_back(v, n1, g1)
        _pull_back(v, n2, g2)
        for i in range(3):
            r1 += g1[i] * v[i]
            r2 += g2[i] * v[i]
        moved = v.copy()
        _least(g1, r1, g2, r2, v)
        change = abs(v[0] - moved[0]) + abs(v[1] - moved[1]) + abs(v[2] - moved[2])
        if change > 0.6 * last:
            # Narrow cones curve more than the subproblem knows: full steps overshoot from side to side.
            damping = max(0.6 * damping, 0.1)
        last = change
        for i in range(3):
            v[i] = moved[i] + damping * (v[i] - moved[i])
        length = math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
        if length > 3.0:
            for i in range(3):
                v[i] *= 3.0 / length
        q[:] = origin
        _turn(q, v)
        if change < 1e-8:
            break


@exact
def _project_rotation(cones, q):
    """Turn q (4,) in place to the nearest rotation inside the cones; whether it got there."""
    first, second = cones[3] >= 0.0, cones[7] >= 0.0
    if not (first or second):
        return True
    if first and second:
        _into_both(cones, q)
    normal = np.empty(3)
    # Closed form for one cone; for two, this mends what curvature left over.
    for _ in range(200):
        worst = 0.0
        for which, cone, given in ((2, cones[0:4], first), (1, cones[4:8], second)):
            if not given:
                continue
            excess = _excess(q, which, cone, which == 2 or cones[8] > 0.5, normal)
            if excess > 0.0:
                worst = max(worst, excess)
                # A cone of angle zero can't be entered with a margin.
                step = excess + min(MARGIN, 0.5 * cone[3])
                for i in range(3):
                    normal[i] *= step
                _turn(q, normal)
        if worst <= MARGIN:
            return True
    return False


@exact
def _shares(planes, active, count, normal, share, way):
    """A normal as a sum of those of active planes (``share``) and what is square to them (``way``); False
    where these depend on each other.
    """
    way[:] = normal[:3]
    share[:] = 0.0
    if count == 0:
        return True
    gram, right = np.zeros((count, count)), np.zeros(count)
    for a in range(count):
        for i in range(3):
            right[a] += planes[active[a], i] * normal[i]
            for b in range(count):
                gram[a, b] += planes[active[a], i] * planes[active[b], i]
    if not _solved(gram, right):
        return False
    for a in range(count):
        share[a] = right[a]
        for i in range(3):
            way[i] -= right[a] * planes[active[a], i]
    return True


@exact
def _nearest_in_polyhedron(planes, goal, p):
    """The point nearest to ``goal`` inside half-spaces, by the dual method of Goldfarb and Idnani (1983).

    Exact after a few exchanges, where alternating projections crawl along planes that meet at a small angle.
    Answers whether there is such a point; ``p`` is set only then.
    """
    active, force = np.empty(3, dtype=np.int64), np.zeros(4)
    share, way = np.empty(3), np.empty(3)
    x = goal.copy()
    count = 0
    for _ in range(8 * planes.shape[0] + 8):
        worst, chosen = 0.0, -1
        for k in range(planes.shape[0]):
            miss = _miss(planes[k], x)
            if miss > worst:
                worst, chosen = miss, k
        if worst <= 0.5 * MARGIN_M:
            p[:] = x
            return True
        force[3] = 0.0
        while True:
            normal = planes[chosen]
            if not _shares(planes, active, count, normal, share, way):
                return False
            square = way[0] * way[0] + way[1] * way[1] + way[2] * way[2]
            free = square > 1e-12 and count < 3
            step, dropped = 1e300, -1
            for a in range(count):
                if share[a] > 1e-12 and force[a] / share[a] < step:
                    step, dropped = force[a] / share[a], a
            if free:
                full = _miss(normal, x) / square
                if full <= step:
                    step, dropped = full, -1
                for i in range(3):
                    x[i] += step * way[i]
            elif dropped < 0:
                return False
            for a in range(count):
                force[a] -= step * share[a]
            force[3] += step
            if dropped < 0:
                active[count], force[count] = chosen, force[3]
                count += 1
                break
            for a in range(dropped, count - 1):
                active[a], force[a] = active[a + 1], force[a + 1]
            count -= 1
    return False


@exact
def _miss(plane, x):
    """Distance that a point is short of where projections aim, inside a plane."""
    miss = plane[3] + MARGIN_M
    for i in range(3):
        miss -= plane[i] * x[i]
    return miss


@exact
def _solved(gram, right):
    """Solve a positive definite system of at most 3 unknowns in place; False where it is singular."""
    n = gram.shape[0]
    for a in range(n):
        if gram[a, a] < 1e-10:
            return False
        for b in range(a + 1, n):
            factor = gram[b, a] / gram[a, a]
            for i in range(a, n):
                gram[b, i] -= factor * gram[a, i]
            right[b] -= factor * right[a]
    for a in range(n - 1, -1, -1):
        for i in range(a + 1, n):
            right[a] -= gram[a, i] * right[i]
        right[a] /= gram[a, a]
    return True


@exact
def project_position(limits, p):
    """Move p (3,) in place to the nearest point inside planes and balls; whether it got there."""
    planes, balls = limits.planes, limits.balls
    count = planes.shape[0] + balls.shape[0]
    if count == 0 or position_excess(limits, p) <= 0.0:
        return True
    before = p.copy()
    if balls.shape[0] == 0 and _nearest_in_polyhedron(planes, before, p):
        return True
    memory = np.zeros((count, 3))
    for sweep in range(400):
        moved = 0.0
        for k in range(count):
            before[:] = p
            for i in range(3):
                p[i] += memory[k, i]
            if k < planes.shape[0]:
                shift = max(_miss(planes[k], p), 0.0)
                for i in range(3):
                    memory[k, i] = -shift * planes[k, i]
                    p[i] += shift * planes[k, i]
            else:
                s = k - planes.shape[0]
                x, y, z = p[0] - balls[s, 0], p[1] - balls[s, 1], p[2] - balls[s, 2]
                distance = math.sqrt(x * x + y * y + z * z)
                radius = balls[s, 3] - min(MARGIN_M, 0.5 * balls[s, 3])
                share = 1.0 if distance <= radius else radius / distance
                for i in range(3):
                    target = balls[s, i] + share * (p[i] - balls[s, i])
                    memory[k, i] = p[i] - target
                    p[i] = target
            for i in range(3):
                moved = max(moved, abs(p[i] - before[i]))
        if moved < 1e-12 or (sweep > 20 and position_excess(limits, p) <= 0.0 and moved < 1e-7):
            break
    return position_excess(limits, p) <= 2.0 * MARGIN_M


@exact
def project(limits, p, q):
    """Project a pose in place, position and rotation each by itself; whether it got there."""
    there = project_position(limits, p)
    return _project_rotation(limits.cones, q) and there


@exact
def contains_all(limits, positions, quaternions, tolerance_m, tolerance, inside):
    """Which poses (M,) are inside, within the tolerances."""
    for j in range(positions.shape[0]):
        inside[j] = (
            position_excess(limits, positions[j]) <= tolerance_m
            and cone_excess(limits.cones, quaternions[j]) <= tolerance
        )


@exact
def project_all(limits, positions, quaternions, inside):
    """Project poses in place; ``inside`` (M,) says which reached the region."""
    for j in range(positions.shape[0]):
        inside[j] = project(limits, positions[j], quaternions[j])
