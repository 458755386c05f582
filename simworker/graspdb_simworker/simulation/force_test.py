"""Can contact forces hold an object against gravity, whichever way down is? The paper's test: forces only.

Two contacts may be enough although the object could turn about the line through them; with torques no grasp
by two contacts would pass at all.

A contact i with normal n_i (into the object) and measured normal force f_i can exert any force of its
capped friction cone

    C_i = { a n_i + t : t perpendicular to n_i, |t| <= mu a, 0 <= a <= f_i }.

The object is held against a weight m g in direction u if -m g u lies in the sum W of the C_i. Which way
is down is not known when a grasp is rated in the object's frame, so the **worst direction** counts: W
must contain the ball of radius m g. W is convex and contains 0, hence the largest such radius is the
minimum of its support function over unit directions d

    h(d) = sum_i f_i max(0, n_i . d + mu sqrt(1 - (n_i . d)^2)).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from graspdb_simworker.simulation.bodies import Contacts, Gripper

GRAVITY_M_S2 = 9.80665
MERGE_COSINE = 1.0 - 1e-8
"""Contacts whose normals differ less than this (0.008 degrees) act as one: their cones add up to one cone."""
_COARSE = 96
_STARTS = 3
_ON_CIRCLE = 24
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_COMPASS = np.array([[math.cos(k * math.pi / 4.0), math.sin(k * math.pi / 4.0)] for k in range(8)])


def _fibonacci_directions(count: int) -> NDArray[np.float64]:
    """Directions (count, 3), nearly uniform on the sphere."""
    k = np.arange(count, dtype=np.float64) + 0.5
    z = 1.0 - 2.0 * k / count
    azimuth = np.pi * (1.0 + math.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - z * z)
    return np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z])


_DIRECTIONS = _fibonacci_directions(_COARSE)


@njit(cache=True)
def _support(normals, forces, count, friction, x, y, z):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(count):
        along = normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z
        across = 1.0 - along * along
        value = along + friction * math.sqrt(across) if across > 0.0 else along
        if value > 0.0:
            total += forces[i] * value
    return total


@njit(cache=True)
def _merge(normals, forces, merged, sums):  # type: ignore[no-untyped-def]
    """Join contacts of equal normals; returns how many are left."""
    count = 0
    for i in range(forces.shape[0]):
        found = -1
        for j in range(count):
            dot = normals[i, 0] * merged[j, 0] + normals[i, 1] * merged[j, 1] + normals[i, 2] * merged[j, 2]
            if dot > MERGE_COSINE:
                found = j
                break
        if found < 0:
            for axis in range(3):
                merged[count, axis] = normals[i, axis]
            sums[count] = forces[i]
            count += 1
        else:
            sums[found] += forces[i]
    return count


@njit(cache=True)
def _tangents(x, y, z):  # type: ignore[no-untyped-def]
    """Two unit vectors that complete a unit vector to an orthonormal frame, built on the axis least
    along it."""
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        ax, ay, az = 0.0, z, -y
    elif abs(y) <= abs(z):
        ax, ay, az = -z, 0.0, x
    else:
        ax, ay, az = y, -x, 0.0
    scale = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax * scale, ay * scale, az * scale
    return ax, ay, az, y * az - z * ay, z * ax - x * az, x * ay - y * ax


@njit(cache=True)
def _descend(normals, forces, count, friction, x, y, z, step):  # type: ignore[no-untyped-def]
    """Pattern search on the sphere: eight compass points in the tangent plane, the step halved where
    none is lower."""
    best = _support(normals, forces, count, friction, x, y, z)
    turn = 0.0
    while step > 1e-4:
        ax, ay, az, bx, by, bz = _tangents(x, y, z)
        # Turned every time: a fixed compass is stopped by a kink that runs between its points.
        turn += 0.6
        cosine, sine = step * math.cos(turn), step * math.sin(turn)
        moved = False
        nx, ny, nz = x, y, z
        for k in range(8):
            c = cosine * _COMPASS[k, 0] - sine * _COMPASS[k, 1]
            s = sine * _COMPASS[k, 0] + cosine * _COMPASS[k, 1]
            tx, ty, tz = x + c * ax + s * bx, y + c * ay + s * by, z + c * az + s * bz
            norm = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz)
            tx, ty, tz = tx * norm, ty * norm, tz * norm
            value = _support(normals, forces, count, friction, tx, ty, tz)
            if value < best * (1.0 - 1e-12):
                best = value
                nx, ny, nz = tx, ty, tz
                moved = True
        x, y, z = nx, ny, nz
        if not moved:
            step *= 0.6
    return best, x, y, z


@njit(cache=True)
def _circle_point(normal, frame, sine, cosine, angle):  # type: ignore[no-untyped-def]
    c, s = cosine * math.cos(angle), cosine * math.sin(angle)
    return (
        -sine * normal[0] + c * frame[0] + s * frame[3],
        -sine * normal[1] + c * frame[1] + s * frame[4],
        -sine * normal[2] + c * frame[2] + s * frame[5],
    )


@njit(cache=True)
def _on_circle(normals, forces, count, friction, contact, best, where):  # type: ignore[no-untyped-def]
    """Lowest point of h on the circle where a contact begins to push: n . d = -sin(atan(mu))."""
    normal = normals[contact]
    frame = _tangents(normal[0], normal[1], normal[2])
    cosine = 1.0 / math.sqrt(1.0 + friction * friction)
    sine = friction * cosine
    width = 2.0 * math.pi / _ON_CIRCLE
    samples = np.empty(_ON_CIRCLE)
    for k in range(_ON_CIRCLE):
        x, y, z = _circle_point(normal, frame, sine, cosine, k * width)
        samples[k] = _support(normals, forces, count, friction, x, y, z)
    for k in range(_ON_CIRCLE):
        here = samples[k]
        if here > samples[k - 1] or here > samples[(k + 1) % _ON_CIRCLE] or here > 1.3 * best:
            continue
        left, right = (k - 1) * width, (k + 1) * width
        for _ in range(24):
            one, two = right - _GOLDEN * (right - left), left + _GOLDEN * (right - left)
            x1, y1, z1 = _circle_point(normal, frame, sine, cosine, one)
            x2, y2, z2 = _circle_point(normal, frame, sine, cosine, two)
            if _support(normals, forces, count, friction, x1, y1, z1) < _support(
                normals, forces, count, friction, x2, y2, z2
            ):
                right = two
            else:
                left = one
        x, y, z = _circle_point(normal, frame, sine, cosine, 0.5 * (left + right))
        value = _support(normals, forces, count, friction, x, y, z)
        if value < best:
            best = value
            where[0], where[1], where[2] = x, y, z
    return best


# long: four kinds of minima of one function, searched one after the other
@njit(cache=True)
def _weakest(normals, forces, friction):  # type: ignore[no-untyped-def]
    """Global minimum of h over the sphere.

    h is smooth but for convex kinks: at d = n_i, and on the circle where contact i begins to push. So
    its minimum is one of the n_i, or where two circles cross, or the lowest point of a circle, or
    smooth. All four kinds are searched.
    """
    merged = np.empty((forces.shape[0], 3))
    sums = np.empty(forces.shape[0])
    count = _merge(normals, forces, merged, sums)
    best = np.inf
    where = np.zeros(3)
    for i in range(count):
        value = _support(merged, sums, count, friction, merged[i, 0], merged[i, 1], merged[i, 2])
        if value < best:
            best = value
            where[:] = merged[i]

    starts = np.empty(_STARTS, dtype=np.int64)
    heights = np.full(_STARTS, np.inf)
    for k in range(_DIRECTIONS.shape[0]):
        value = _support(
            merged, sums, count, friction, _DIRECTIONS[k, 0], _DIRECTIONS[k, 1], _DIRECTIONS[k, 2]
        )
        for slot in range(_STARTS):
            if value < heights[slot]:
                for later in range(_STARTS - 1, slot, -1):
                    heights[later], starts[later] = heights[later - 1], starts[later - 1]
                heights[slot], starts[slot] = value, k
                break
    for slot in range(_STARTS):
        d = _DIRECTIONS[starts[slot]]
        value, x, y, z = _descend(merged, sums, count, friction, d[0], d[1], d[2], 0.2)
        if value < best:
            best = value
            where[0], where[1], where[2] = x, y, z

    sine = friction / math.sqrt(1.0 + friction * friction)
    for i in range(count):
        best = _on_circle(merged, sums, count, friction, i, best, where)
        for j in range(i):
            # d = a (n_i + n_j) +- b (n_i x n_j) lies on both circles.
            dot = merged[i, 0] * merged[j, 0] + merged[i, 1] * merged[j, 1] + merged[i, 2] * merged[j, 2]
            squared = 1.0 - dot * dot
            if squared < 1e-12 or dot < -1.0 + 1e-12:
                continue
            a = -sine / (1.0 + dot)
            rest = 1.0 - 2.0 * a * a * (1.0 + dot)
            if rest < 0.0:
                continue
            b = math.sqrt(rest / squared)
            cx = merged[i, 1] * merged[j, 2] - merged[i, 2] * merged[j, 1]
            cy = merged[i, 2] * merged[j, 0] - merged[i, 0] * merged[j, 2]
            cz = merged[i, 0] * merged[j, 1] - merged[i, 1] * merged[j, 0]
            for side in (-b, b):
                x = a * (merged[i, 0] + merged[j, 0]) + side * cx
                y = a * (merged[i, 1] + merged[j, 1]) + side * cy
                z = a * (merged[i, 2] + merged[j, 2]) + side * cz
                value = _support(merged, sums, count, friction, x, y, z)
                if value < best:
                    best = value
                    where[0], where[1], where[2] = x, y, z

    # A kink's lowest point need not be a minimum across the kink.
    value, x, y, z = _descend(merged, sums, count, friction, where[0], where[1], where[2], 0.05)
    if value < best:
        best = value
        where[0], where[1], where[2] = x, y, z
    return best, where


def weakest_force(
    normals: NDArray[np.float64], forces: NDArray[np.float64], friction: float
) -> tuple[float, NDArray[np.float64]]:
    """Largest force the contacts resist in every direction, and the direction in which they resist no more.

    That is the minimum over unit d of h(d), newtons, 0 without contacts, and a d (3,) that attains it. Unit
    ``normals`` (K, 3) point into the object; ``forces`` (K,) are newtons along them.
    """
    if len(forces) == 0:
        return 0.0, np.array([0.0, 0.0, 1.0])
    value, direction = _weakest(
        np.ascontiguousarray(normals, dtype=np.float64),
        np.ascontiguousarray(forces, dtype=np.float64),
        float(friction),
    )
    return float(value), direction


def compile_force_test() -> None:
    """Compile the force test now: the first grasp's time is limited, and this may take longer."""
    weakest_force(np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]), np.ones(2), 0.4)


def rating(contacts: Contacts, gripper: Gripper, mass_kg: float, friction: float) -> float:
    """Largest weight that the contacts hold in the worst direction, over the object's weight.

    Measured forces are scaled by the gripper's force over the one the jaw was simulated with, see
    :func:`graspdb_simworker.simulation.bodies.closing_force`.
    """
    scale = gripper.force_n / gripper.closing_force_n
    force, _ = weakest_force(contacts.normals, contacts.forces * scale, friction)
    return force / (mass_kg * GRAVITY_M_S2)
