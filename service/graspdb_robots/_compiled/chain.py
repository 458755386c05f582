"""Forward and inverse kinematics of a chain of joints, many times a second.

The inverse is Levenberg and Marquardt's with the damping of Sugihara (Solvability-unconcerned inverse
kinematics by the Levenberg-Marquardt method, IEEE T-RO 27, 2011), joints held within their limits at every
step.
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["cell_numbers", "forward", "forward_many", "jacobian", "seeds_of", "solutions", "straight"]


def _fast(function):
    """Compile with reassociation; no use of nan or infinity inside. Runs without the interpreter's lock."""
    return njit(fastmath=True, error_model="numpy", nogil=True, cache=True)(function)


#: Metres that count as much as a radian.
_METRES = 0.3
_STEPS, _LONGEST = 40, 0.6
_DONE = 1e-14
#: A solution is one within this: metres and radians, squared.
_NEAR = 1e-12
#: Damping beside the squared error.
_DAMPED = 1e-5
#: Solutions of one pose whose joints all differ by less than this are one.
_SAME = 0.1


@_fast
def forward(q, sliding, placements, axes, tip, frames, directions):
    """The flange's pose: rotation (3, 3), position (3,), in the root's frame.

    Parameters
    ----------
    frames : (n, 4, 4), out
        Frames of the joints, moved.
    directions : (n, 3), out
        Their axes.
    """
    n = len(q)
    m = np.eye(4)
    turned = np.empty((3, 3))
    for i in range(n):
        f = frames[i]
        place = placements[i]
        for a in range(3):
            for b in range(4):
                f[a, b] = m[a, 0] * place[0, b] + m[a, 1] * place[1, b] + m[a, 2] * place[2, b]
            f[a, 3] += m[a, 3]
        x, y, z = axes[i, 0], axes[i, 1], axes[i, 2]
        for a in range(3):
            directions[i, a] = f[a, 0] * x + f[a, 1] * y + f[a, 2] * z
        if sliding[i]:
            for a in range(3):
                f[a, 3] += directions[i, a] * q[i]
        else:
            c, t = math.cos(q[i]), math.sin(q[i])
            d = 1.0 - c
            # Rodrigues.
            turned[0, 0], turned[0, 1], turned[0, 2] = c + d * x * x, d * x * y - t * z, d * x * z + t * y
            turned[1, 0], turned[1, 1], turned[1, 2] = d * x * y + t * z, c + d * y * y, d * y * z - t * x
            turned[2, 0], turned[2, 1], turned[2, 2] = d * x * z - t * y, d * y * z + t * x, c + d * z * z
            for a in range(3):
                u, v, w = f[a, 0], f[a, 1], f[a, 2]
                for b in range(3):
                    f[a, b] = u * turned[0, b] + v * turned[1, b] + w * turned[2, b]
        for a in range(3):
            for b in range(4):
                m[a, b] = f[a, b]
    r, p = np.empty((3, 3)), np.empty(3)
    for a in range(3):
        for b in range(3):
            r[a, b] = m[a, 0] * tip[0, b] + m[a, 1] * tip[1, b] + m[a, 2] * tip[2, b]
        p[a] = m[a, 0] * tip[0, 3] + m[a, 1] * tip[1, 3] + m[a, 2] * tip[2, 3] + m[a, 3]
    return r, p


@_fast
def forward_many(qs, sliding, placements, axes, tip, out):
    """Poses (N, 4, 4) of the flange for joints (N, n)."""
    n = qs.shape[1]
    frames, directions = np.zeros((n, 4, 4)), np.empty((n, 3))
    for i in range(len(qs)):
        r, p = forward(qs[i], sliding, placements, axes, tip, frames, directions)
        out[i, :3, :3] = r
        out[i, :3, 3] = p
        out[i, 3, :3] = 0.0
        out[i, 3, 3] = 1.0


@_fast
def jacobian(p, sliding, frames, directions, out):
    """Columns (6, n): velocity of a point p that moves with the flange, and turning, root's frame."""
    for i in range(len(sliding)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        if sliding[i]:
            out[0, i], out[1, i], out[2, i] = x, y, z
            out[3, i] = out[4, i] = out[5, i] = 0.0
        else:
            u, v, w = p[0] - frames[i, 0, 3], p[1] - frames[i, 1, 3], p[2] - frames[i, 2, 3]
            out[0, i], out[1, i], out[2, i] = y * w - z * v, z * u - x * w, x * v - y * u
            out[3, i], out[4, i], out[5, i] = x, y, z


@_fast
def _turn(r, target, out):
    """Rotation vector, root's frame, from rotation r to that of target, into out[3:6]."""
    trace = 0.0
    for a in range(3):
        for b in range(3):
            trace += target[a, b] * r[a, b]
    # D = target r^T; its skew part is the axis times the sine.
    x = y = z = 0.0
    for b in range(3):
        x += target[2, b] * r[1, b] - target[1, b] * r[2, b]
        y += target[0, b] * r[2, b] - target[2, b] * r[0, b]
        z += target[1, b] * r[0, b] - target[0, b] * r[1, b]
    x, y, z = x / 2, y / 2, z / 2
    sine = math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(sine, (trace - 1.0) / 2)
    if sine > 1e-9:
        f = angle / sine
        out[3], out[4], out[5] = f * x, f * y, f * z
    elif trace > 0.0:
        out[3], out[4], out[5] = x, y, z
    else:
        # Half a turn: any axis of it will do to move on.
        out[3], out[4], out[5] = 3.0, 0.5, 0.25


# long: one loop; its parts share small arrays and are nothing apart.
@_fast
def solve(q, target, lower, upper, sliding, placements, axes, tip, steps, frames, directions, work):
    """Move joints q (n,) in place to where the flange is at target (4, 4); whether it got there, and the
    squared error left, metres and radians weighed.

    ``work`` is (14, max(n, 6)) scratch.
    """
    n = len(q)
    jac, gram, e = work[0:6], work[6:12], work[12]
    left = before = 1e30
    for step in range(steps):
        r, p = forward(q, sliding, placements, axes, tip, frames, directions)
        for a in range(3):
            e[a] = (target[a, 3] - p[a]) / _METRES
        _turn(r, target, e)
        left = 0.0
        for a in range(6):
            left += e[a] * e[a]
        if left < _DONE:
            break
        if step % 4 == 3:
            # Stuck at a limit, or in a valley that does not lead there.
            if left > 0.5 * before:
                break
            before = left
        jacobian(p, sliding, frames, directions, jac)
        for i in range(n):
            for a in range(3):
                jac[a, i] /= _METRES
            # What stands at a limit and would go beyond is not moved by this step.
            push = 0.0
            for a in range(6):
                push += jac[a, i] * e[a]
            if (q[i] <= lower[i] and push < 0.0) or (q[i] >= upper[i] and push > 0.0):
                for a in range(6):
                    jac[a, i] = 0.0
        damp = 0.5 * left * 1e-2 + _DAMPED * min(left, 1.0) + 1e-12
        for a in range(6):
            for b in range(a + 1):
                s = 0.0
                for i in range(n):
                    s += jac[a, i] * jac[b, i]
                gram[a, b] = s
            gram[a, a] += damp
        # Cholesky, then both triangles.
        for a in range(6):
            for b in range(a + 1):
                s = gram[a, b]
                for c in range(b):
                    s -= gram[a, c] * gram[b, c]
                if a == b:
                    gram[a, a] = math.sqrt(max(s, 1e-18))
                else:
                    gram[a, b] = s / gram[b, b]
        for a in range(6):
            s = e[a]
            for c in range(a):
                s -= gram[a, c] * e[c]
            e[a] = s / gram[a, a]
        for a in range(5, -1, -1):
            s = e[a]
            for c in range(a + 1, 6):
                s -= gram[c, a] * e[c]
            e[a] = s / gram[a, a]
        longest = 0.0
        for i in range(n):
            s = 0.0
            for a in range(6):
                s += jac[a, i] * e[a]
            work[13, i] = s
            longest = max(longest, abs(s))
        f = 1.0 if longest < _LONGEST else _LONGEST / longest
        for i in range(n):
            q[i] = min(max(q[i] + f * work[13, i], lower[i]), upper[i])
    return left < _NEAR, left


@_fast
def solutions(seeds, target, lower, upper, sliding, placements, axes, tip, most, out):
    """Joints that take the flange to target (4, 4), from seeds (S, n), the most promising first.

    Writes up to ``most`` different ones to out (most, n). Returns how many, and the least squared error.
    """
    n = seeds.shape[1]
    frames, directions = np.zeros((n, 4, 4)), np.empty((n, 3))
    work, q = np.zeros((14, max(n, 6))), np.empty(n)
    count, least = 0, 1e30
    for s in range(len(seeds)):
        if count == most:
            break
        for i in range(n):
            q[i] = min(max(seeds[s, i], lower[i]), upper[i])
        ok, left = solve(
            q, target, lower, upper, sliding, placements, axes, tip, _STEPS, frames, directions, work
        )
        least = min(least, left)
        if not ok:
            continue
        known = False
        for k in range(count):
            apart = 0.0
            for i in range(n):
                apart = max(apart, abs(q[i] - out[k, i]))
            known = known or apart < _SAME
        if not known:
            out[count] = q
            count += 1
    return count, least


@_fast
def straight(q, target, back, lift, parts, lifts, lower, upper, sliding, placements, axes, tip, jump, out):
    """Joints along straight ways: from the grasp at joints q (n,) back to the pregrasp, and on to the lift.

    Parameters
    ----------
    target : (4, 4)
        The flange at the grasp.
    back, lift : (3,)
        From the grasp to the pregrasp, and to the lifted grasp.
    parts, lifts : int
        Steps of either way; 0 for none.
    jump
        The farthest that a joint may go in one step.
    out : (parts + 1 + lifts, n)
        Joints from pregrasp to grasp to lift.

    Returns whether there is such a way.
    """
    n = len(q)
    frames, directions = np.zeros((n, 4, 4)), np.empty((n, 3))
    work, moved, at = np.zeros((14, max(n, 6))), target.copy(), np.empty(n)
    out[parts] = q
    for side in range(2):
        steps = parts if side == 0 else lifts
        at[:] = q
        for k in range(1, steps + 1):
            share = k / steps
            for a in range(3):
                moved[a, 3] = target[a, 3] + share * (back[a] if side == 0 else lift[a])
            row = parts - k if side == 0 else parts + k
            out[row] = at
            ok, _ = solve(
                at, moved, lower, upper, sliding, placements, axes, tip, _STEPS, frames, directions, work
            )
            for i in range(n):
                ok = ok and abs(at[i] - out[row, i]) <= jump
            if not ok:
                return False
            out[row] = at
    return True


@_fast
def seeds_of(target, origin, cell, sides, cells, known, joints, most, out):
    """Joints to start from, of the map's cells at and around a pose: how many were written to out (most, n).

    ``known`` (K,) are sorted numbers of cells, ``joints`` (K, n) of each the joints that led there.
    """
    count = 0
    for reach in range(2):
        for dx in range(-reach, reach + 1):
            for dy in range(-reach, reach + 1):
                for dz in range(-reach, reach + 1):
                    if reach == 1 and dx == 0 and dy == 0 and dz == 0:
                        continue
                    number = _cell(target, origin, cell, sides, cells, dx, dy, dz)
                    if number < 0:
                        continue
                    at = np.searchsorted(known, number)
                    while at < len(known) and known[at] == number:
                        if count == most:
                            return count
                        out[count] = joints[at]
                        count += 1
                        at += 1
    return count


@_fast
def _cell(target, origin, cell, sides, cells, dx, dy, dz):
    """Number of the map's cell of a pose: of its place, and of its approach and turn about it; -1 outside."""
    x = math.floor((target[0, 3] - origin[0]) / cell) + dx
    y = math.floor((target[1, 3] - origin[1]) / cell) + dy
    z = math.floor((target[2, 3] - origin[2]) / cell) + dz
    if x < 0 or y < 0 or z < 0 or x >= cells or y >= cells or z >= cells:
        return -1
    place = (x * cells + y) * cells + z
    # A cube's face that the approach goes through, and where on it.
    u, v, w = target[0, 2], target[1, 2], target[2, 2]
    a, b, c = abs(u), abs(v), abs(w)
    if a >= b and a >= c:
        face, s, t = (0 if u > 0 else 1), v / a, w / a
    elif b >= c:
        face, s, t = (2 if v > 0 else 3), u / b, w / b
    else:
        face, s, t = (4 if w > 0 else 5), u / c, v / c
    i = min(int((s + 1.0) / 2.0 * sides), sides - 1)
    j = min(int((t + 1.0) / 2.0 * sides), sides - 1)
    return place * 6 * sides * sides + (face * sides + i) * sides + j


@_fast
def cell_numbers(poses, origin, cell, sides, cells, out):
    """Numbers (N,) of the map's cells of poses (N, 4, 4)."""
    for i in range(len(poses)):
        out[i] = _cell(poses[i], origin, cell, sides, cells, 0, 0, 0)
