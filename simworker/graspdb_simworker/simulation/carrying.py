"""Carrying a held object through the motion of :mod:`.lifting`: a rigid body between two coupled fingers.

Fingers are covered with stiff elastic pads: pressure grows with depth, shear with how far an area of the
patch was dragged from where it stuck, and shear is never more than friction times pressure. So a patch of two
faces resists what its limit surface says, force and torque about its normal together, and what is below the
limit is held by shear that does not fade: there is nothing that could creep.

Time is cut in steps, and each is implicit: displacement of object and jaw in a step are those under which
inertia, load, closing force and all areas' forces are in balance at its end, found by Newton's method. Where
nothing slips that is the elastic balance itself, however long the step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from graspdb_simworker.simulation import lifting
from graspdb_simworker.simulation.bodies import (
    Carried,
    Gripper,
    MassProperties,
    Part,
    Quaternion,
    Vector,
    multiply,
    rotate,
)
from graspdb_simworker.simulation.lifting import load
from graspdb_simworker.simulation.patches import (
    AREA,
    AREAS,
    BODY,
    COLUMNS,
    DEPTH,
    KEY,
    LEVER,
    NORMAL,
    OPENS,
    SHEAR,
    body_of,
    find_areas,
    jaw_of,
)

PRESSURE_PA_M = 4e10
"""Pressure over depth: 40 N on a finger's width squared press 3 um deep, on a ball of 50 mm 0.1 mm."""
SHEAR_PA_M = 1e11
"""Shear stress over how far an area was dragged."""
REACH_M = 3e-4
"""What is nearer to a face than this may come to touch it before patches are found again,"""
FOUND_ANEW_M = 1e-4
"""which they are once anything moved this far."""
SETTLE_STEPS = 120
"""In so many steps at most, without a load, does the object come to rest on the pads."""
SETTLED_M = 1e-7
_START_REACH_M = 3e-3
_ARM_M = 0.02
"""A torque over this arm counts like a force, where balance is measured."""
_BALANCED = 2e-5
"""Balance is found when what is left is this share of the closing force,"""
_ROUNDS = 40
"""or after so many of Newton's rounds."""
_FREE = 7


class Grip(NamedTuple):
    """What closes: newtons of each finger, its mass (kg), its highest speed (m/s), friction coefficient, and
    how stiff its pads are: pressure over depth, and shear stress over how far an area was dragged, Pa/m."""

    force_n: float
    finger_mass_kg: float
    max_speed_m_s: float
    friction: float
    pressure_pa_m: float
    shear_pa_m: float


_multiplied: Any = njit(multiply)
_turned: Any = njit(rotate)


@njit(cache=True)
def _matrix(q):  # type: ignore[no-untyped-def]
    """Rotation matrix (3, 3) of a unit quaternion xyzw."""
    x, y, z, w = q
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


@njit(cache=True)
def _strain(area, move):  # type: ignore[no-untyped-def]
    """Depth and shear (3) of an area after a displacement (7,) of object and jaw."""
    lx, ly, lz = area[LEVER], area[LEVER + 1], area[LEVER + 2]
    nx, ny, nz = area[NORMAL], area[NORMAL + 1], area[NORMAL + 2]
    ux = move[0] + move[4] * lz - move[5] * ly
    uy = move[1] + move[5] * lx - move[3] * lz - area[OPENS] * move[6]
    uz = move[2] + move[3] * ly - move[4] * lx
    along = ux * nx + uy * ny + uz * nz
    return (
        area[DEPTH] - along,
        area[SHEAR] + ux - along * nx,
        area[SHEAR + 1] + uy - along * ny,
        area[SHEAR + 2] + uz - along * nz,
    )


@njit(cache=True)
def _contact_force(areas, count, move, grip, total):  # type: ignore[no-untyped-def]
    """What all areas exert on object and jaw (7,): force, torque about the centre of mass, opening force."""
    total[:] = 0.0
    for i in range(count):
        area = areas[i]
        depth, sx, sy, sz = _strain(area, move)
        if depth <= 0.0:
            continue
        normal = grip.pressure_pa_m * area[AREA] * depth
        stiff = grip.shear_pa_m * area[AREA]
        shear = stiff * math.sqrt(sx * sx + sy * sy + sz * sz)
        if shear > grip.friction * normal:
            stiff *= grip.friction * normal / shear
        fx = normal * area[NORMAL] - stiff * sx
        fy = normal * area[NORMAL + 1] - stiff * sy
        fz = normal * area[NORMAL + 2] - stiff * sz
        total[0] += fx
        total[1] += fy
        total[2] += fz
        total[3] += area[LEVER + 1] * fz - area[LEVER + 2] * fy
        total[4] += area[LEVER + 2] * fx - area[LEVER] * fz
        total[5] += area[LEVER] * fy - area[LEVER + 1] * fx
        total[6] -= area[OPENS] * fy


@njit(cache=True)
def _stiffness(areas, count, move, grip, total):  # type: ignore[no-untyped-def]
    """Minus the rate of :func:`_contact_force` with the displacement, added to ``total`` (7, 7)."""
    d = np.empty((3, 3))
    j = np.zeros((3, _FREE))
    j[0, 0] = j[1, 1] = j[2, 2] = 1.0
    for i in range(count):
        area = areas[i]
        depth, sx, sy, sz = _strain(area, move)
        if depth <= 0.0:
            continue
        n = area[NORMAL : NORMAL + 3]
        press = grip.pressure_pa_m * area[AREA]
        stiff = grip.shear_pa_m * area[AREA]
        length = math.sqrt(sx * sx + sy * sy + sz * sz)
        cap = grip.friction * press * depth
        slips = stiff * length > cap
        if slips:
            stiff = cap / length
            sx, sy, sz = sx / length, sy / length, sz / length
        s = (sx, sy, sz)
        for a in range(3):
            for b in range(3):
                d[a, b] = (press - stiff) * n[a] * n[b]
                if slips:
                    d[a, b] -= stiff * s[a] * s[b] + grip.friction * press * s[a] * n[b]
            d[a, a] += stiff
        lx, ly, lz = area[LEVER], area[LEVER + 1], area[LEVER + 2]
        j[0, 4], j[0, 5] = lz, -ly
        j[1, 3], j[1, 5] = -lz, lx
        j[2, 3], j[2, 4] = ly, -lx
        j[1, 6] = -area[OPENS]
        for b in range(_FREE):
            x = d[0, 0] * j[0, b] + d[0, 1] * j[1, b] + d[0, 2] * j[2, b]
            y = d[1, 0] * j[0, b] + d[1, 1] * j[1, b] + d[1, 2] * j[2, b]
            z = d[2, 0] * j[0, b] + d[2, 1] * j[1, b] + d[2, 2] * j[2, b]
            total[0, b] += x
            total[1, b] += y
            total[2, b] += z
            total[3, b] += ly * z - lz * y
            total[4, b] += lz * x - lx * z
            total[5, b] += lx * y - ly * x
            total[6, b] -= area[OPENS] * y


@njit(cache=True)
def _factor(m, pivots):  # type: ignore[no-untyped-def]
    """LU factors of a matrix (7, 7), in place, with partial pivoting."""
    for k in range(_FREE):
        best = k
        for i in range(k + 1, _FREE):
            if abs(m[i, k]) > abs(m[best, k]):
                best = i
        pivots[k] = best
        if best != k:
            for c in range(_FREE):
                m[k, c], m[best, c] = m[best, c], m[k, c]
        for i in range(k + 1, _FREE):
            m[i, k] /= m[k, k]
            for c in range(k + 1, _FREE):
                m[i, c] -= m[i, k] * m[k, c]


@njit(cache=True)
def _solve(m, pivots, x):  # type: ignore[no-untyped-def]
    """Solve for the right side ``x`` (7,), in place, with the factors of :func:`_factor`."""
    for k in range(_FREE):
        if pivots[k] != k:
            x[k], x[pivots[k]] = x[pivots[k]], x[k]
    for k in range(_FREE):
        for c in range(k):
            x[k] -= m[k, c] * x[c]
    for k in range(_FREE - 1, -1, -1):
        for c in range(k + 1, _FREE):
            x[k] -= m[k, c] * x[c]
        x[k] /= m[k, k]


@njit(cache=True)
def _unbalanced(areas, count, move, inertia, push, grip, dt, left):  # type: ignore[no-untyped-def]
    """What of all forces (7,) is not in balance after a displacement; returns its size over the closing
    force, and how fast the closing force falls with the jaw's displacement."""
    _contact_force(areas, count, move, grip, left)
    for a in range(_FREE):
        left[a] = push[a] + left[a]
        for b in range(_FREE):
            left[a] -= inertia[a, b] * move[b]
    # The drive closes with its force, and with less where it comes near its highest speed.
    full = 2.0 * grip.force_n
    slope = full / (0.1 * grip.max_speed_m_s)
    drive = slope * (move[6] / dt + grip.max_speed_m_s)
    rate = slope / dt
    if drive >= full:
        drive, rate = full, 0.0
    left[6] -= drive
    size = left[6] ** 2
    for a in range(3):
        size += left[a] ** 2 + (left[a + 3] / _ARM_M) ** 2
    return math.sqrt(size) / full, rate


@njit(cache=True)
def _balance(areas, count, move, inertia, push, grip, dt, factors, pivots, known):  # type: ignore[no-untyped-def]
    """Find the displacement (7,) under which all forces are in balance, from a guess, in place.

    ``inertia`` (7, 7) is mass over the step squared, ``push`` (7,) load and momentum. Whether ``factors`` are
    ``known`` from an earlier step is given and returned: as long as they serve they are not made again.
    """
    left, trial, turn = np.empty(_FREE), np.empty(_FREE), np.empty(_FREE)
    size, rate = _unbalanced(areas, count, move, inertia, push, grip, dt, left)
    for _ in range(_ROUNDS):
        if size < _BALANCED:
            break
        made = False
        if not known:
            factors[:] = inertia
            factors[6, 6] += rate
            _stiffness(areas, count, move, grip, factors)
            _factor(factors, pivots)
            known = made = True
        turn[:] = left
        _solve(factors, pivots, turn)
        share, best, best_share, tried = 1.0, np.inf, 0.0, 0.0
        for _ in range(8 if made else 1):
            trial[:] = move + share * turn
            tried = share
            found, rate = _unbalanced(areas, count, trial, inertia, push, grip, dt, left)
            if found < best:
                best, best_share = found, share
            if found < (1.0 - 0.2 * share) * size:
                break
            share *= 0.5
        # Factors that do not lead on quickly are made anew, where the displacement is then.
        known = best < 0.3 * size
        if not (made or known):
            best_share = 0.0
        move += best_share * turn
        if best_share == tried:
            size = best
        else:
            size, rate = _unbalanced(areas, count, move, inertia, push, grip, dt, left)
    return known


@njit(cache=True)
def _moved(areas, count, move, grip, centre, turn, fingers):  # type: ignore[no-untyped-def]
    """Displace object and jaw: depths and shears follow, and what slipped has no more shear than friction
    allows. Returns the object's new orientation."""
    for i in range(count):
        area = areas[i]
        depth, sx, sy, sz = _strain(area, move)
        area[DEPTH] = depth
        most = grip.friction * grip.pressure_pa_m * max(0.0, depth) / grip.shear_pa_m
        length = math.sqrt(sx * sx + sy * sy + sz * sz)
        share = most / length if length > most else 1.0
        area[SHEAR], area[SHEAR + 1], area[SHEAR + 2] = sx * share, sy * share, sz * share
    for k in range(3):
        centre[k] += move[k]
    fingers += move[6]
    angle = math.sqrt(move[3] ** 2 + move[4] ** 2 + move[5] ** 2)
    sine = math.sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
    x, y, z, w = _multiplied((sine * move[3], sine * move[4], sine * move[5], math.cos(0.5 * angle)), turn)
    size = 1.0 / math.sqrt(x * x + y * y + z * z + w * w)
    turn = (x * size, y * size, z * size, w * size)
    axes = _matrix(turn)
    for i in range(count):
        for k in range(3):
            areas[i, LEVER + k] = (
                axes[k, 0] * areas[i, BODY]
                + axes[k, 1] * areas[i, BODY + 1]
                + axes[k, 2] * areas[i, BODY + 2]
            )
    return turn


@njit(cache=True)
def _keep_shear(old, before, new, count, spacing):  # type: ignore[no-untyped-def]
    """Areas found anew take over the shear of the nearest that was there in the same patch."""
    for i in range(count):
        nearest, which = 4.0 * spacing * spacing, -1
        for m in range(before):
            if old[m, KEY] != new[i, KEY]:
                continue
            away = 0.0
            for k in range(3):
                away += (old[m, BODY + k] - new[i, BODY + k]) ** 2
            if away < nearest:
                nearest, which = away, m
        if which >= 0:
            along = 0.0
            for k in range(3):
                along += old[which, SHEAR + k] * new[i, NORMAL + k]
            for k in range(3):
                new[i, SHEAR + k] = old[which, SHEAR + k] - along * new[i, NORMAL + k]


@njit(cache=True)
def _touches(areas, count):  # type: ignore[no-untyped-def]
    """Whether both fingers press on the object."""
    first = second = False
    for i in range(count):
        if areas[i, DEPTH] > 0.0:
            first = first or areas[i, OPENS] < 0.0
            second = second or areas[i, OPENS] > 0.0
    return first and second


@njit(cache=True)
def _displacement(move, centre, jaw):  # type: ignore[no-untyped-def]
    """How far a small displacement (7,) takes what is between the fingers at most, about, metres."""
    turn = math.sqrt(move[3] ** 2 + move[4] ** 2 + move[5] ** 2) * (jaw.tip - jaw.base)
    total = 0.0
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        total += (move[a] - move[3 + b] * centre[c] + move[3 + c] * centre[b]) ** 2
    return math.sqrt(total) + turn + abs(move[6])


@njit(cache=True)
def _areas(body, jaw, centre, turn, fingers, spacing, areas):  # type: ignore[no-untyped-def]
    """Write the areas that touch or soon may; returns how many. Where there is no room for so many, they are
    larger."""
    axes = _matrix(turn)
    count, _ = find_areas(body, jaw, centre, axes, fingers, REACH_M, spacing, areas)
    while count >= areas.shape[0]:
        spacing *= 2.0
        count, _ = find_areas(body, jaw, centre, axes, fingers, REACH_M, spacing, areas)
    return count


# long: settling and carrying are one loop, so that both treat a step alike
@njit(cache=True)
def carry(body, jaw, grip, mass_kg, moments, centre, turn, fingers, frames, dt, spacing, lost, path):  # type: ignore[no-untyped-def]
    """Settle an object between the fingers, then carry it through all frames.

    ``centre`` (3,) of mass, metres, and ``turn``, xyzw of the principal axes, are in the tool frame, and
    change in place as ``fingers`` (2,) do, each finger's way from y = 0. ``moments`` are the principal ones,
    kg m^2; ``frames`` (n, 9) push, spin and its rate, one a step of ``dt`` seconds; areas are of ``spacing``
    metres. ``path`` (n, 9) is filled with centre, turn and fingers after each step. Returns whether both
    fingers press on the object at the end, the farthest that its point at the tool's origin moved, metres,
    the farthest it turned, radians, and how many steps were made.
    """
    areas, spare = np.zeros((AREAS, COLUMNS)), np.zeros((AREAS, COLUMNS))
    _, deepest = find_areas(body, jaw, centre, _matrix(turn), fingers, _START_REACH_M, 0.0, areas)
    for finger in range(2):
        # The engine's hulls have a margin, and what rang when it stopped may be off either finger.
        if deepest[finger] > -_START_REACH_M:
            fingers[finger] += deepest[finger]
    count = _areas(body, jaw, centre, turn, fingers, spacing, areas)
    inertia, push, move, speed = np.zeros((_FREE, _FREE)), np.zeros(_FREE), np.zeros(_FREE), np.zeros(_FREE)
    factors, pivots, known = np.zeros((_FREE, _FREE)), np.zeros(_FREE, dtype=np.int64), False
    for k in range(3):
        inertia[k, k] = mass_kg / dt**2
    inertia[6, 6] = 2.0 * grip.finger_mass_kg / dt**2
    since = np.zeros(_FREE)
    settling, settled_after = True, 0
    began, anchor = turn, (0.0, 0.0, 0.0)
    translation = rotation = 0.0
    held = True
    step = made = 0
    while step < frames.shape[0]:
        axes = _matrix(turn)
        for a in range(3):
            for b in range(3):
                inertia[3 + a, 3 + b] = (
                    axes[a, 0] * moments[0] * axes[b, 0]
                    + axes[a, 1] * moments[1] * axes[b, 1]
                    + axes[a, 2] * moments[2] * axes[b, 2]
                ) / dt**2
        if settling:
            # At rest again after every step: that is the way of what is damped heavily.
            push[:] = 0.0
            move[:] = 0.0
        else:
            f = frames[step]
            where, velocity = (centre[0], centre[1], centre[2]), (speed[0], speed[1], speed[2])
            spin = (speed[3], speed[4], speed[5])
            frame = ((f[0], f[1], f[2]), (f[3], f[4], f[5]), (f[6], f[7], f[8]))
            force, torque = load(frame, mass_kg, moments, where, turn, velocity, spin)
            own = np.zeros(3)
            for a in range(3):
                for b in range(3):
                    own[a] += inertia[3 + a, 3 + b] * speed[3 + b] * dt**2
            move[:] = speed * dt
            push[:] = 0.0
            for a in range(_FREE):
                for b in range(_FREE):
                    push[a] += inertia[a, b] * move[b]
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                push[a] += force[a]
                push[3 + a] += torque[a] - (speed[3 + b] * own[c] - speed[3 + c] * own[b])
        known = _balance(areas, count, move, inertia, push, grip, dt, factors, pivots, known)
        turn = _moved(areas, count, move, grip, centre, turn, fingers)
        since += move
        moved = _displacement(since, centre, jaw)
        if not moved < np.inf:
            return False, np.inf, np.inf, made
        if moved > FOUND_ANEW_M:
            areas, spare = spare, areas
            before = count
            count = _areas(body, jaw, centre, turn, fingers, spacing, areas)
            _keep_shear(spare, before, areas, count, spacing)
            since[:] = 0.0
            known = False
        if settling:
            settled_after += 1
            if settled_after >= SETTLE_STEPS or _displacement(move, centre, jaw) < SETTLED_M:
                settling = False
                began = turn
                # The point of the object at the tool's origin, in the object's principal frame.
                back = (-turn[0], -turn[1], -turn[2], turn[3])
                anchor = _turned(back, (-centre[0], -centre[1], -centre[2]))
            continue
        speed[:] = move / dt
        for k in range(3):
            path[step, k] = centre[k]
        for k in range(4):
            path[step, 3 + k] = turn[k]
        path[step, 7], path[step, 8] = fingers[0], fingers[1]
        step += 1
        made = step
        now = _turned(turn, anchor)
        away = math.sqrt((centre[0] + now[0]) ** 2 + (centre[1] + now[1]) ** 2 + (centre[2] + now[2]) ** 2)
        translation = max(translation, away)
        x, y, z, w = _multiplied((-began[0], -began[1], -began[2], began[3]), turn)
        rotation = max(rotation, 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w)))
        if count == 0 and fingers[0] + fingers[1] < 0.0:
            held = False
            break
        if translation > lost.translation_m or rotation > lost.rotation_rad:
            break
    return held and _touches(areas, count), translation, rotation, made


class Carrier:
    """An object of ``parts`` and the jaw that carries it through a motion, in steps of ``step_s`` seconds;
    ``area_m`` is how finely patches are divided, ``compliance`` how often the pads' give is the usual one."""

    def __init__(
        self,
        parts: Sequence[Part],
        mass: MassProperties,
        gripper: Gripper,
        friction: float,
        motion: lifting.Motion,
        step_s: float,
        area_m: float,
        compliance: float = 1.0,
    ) -> None:
        self._body, self._jaw, self._mass = body_of(parts, mass), jaw_of(gripper), mass
        self._grip = Grip(
            gripper.force_n,
            gripper.finger_mass_kg,
            gripper.max_speed_m_s,
            friction,
            PRESSURE_PA_M / compliance,
            SHEAR_PA_M / compliance,
        )
        self._step_s, self._area_m, self._lost = step_s, area_m, motion.lost
        # Compile now: a grasp's time is limited, and this may take longer.
        self._frames = np.empty((0, 9))
        self.carry((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (1.0, 1.0))
        self._frames = lifting.frames(motion, step_s)

    def carry(
        self,
        centre: Vector,
        principal_xyzw: Quaternion,
        fingers_m: tuple[float, float],
    ) -> tuple[Carried, NDArray[np.float64]]:
        """Carry the object through the motion.

        It begins with its centre of mass and principal axes there in the tool frame and the fingers that far
        from y = 0, metres. Returns what came of it and its way, rows of centre, orientation and fingers.
        """
        path = np.empty((len(self._frames), 9))
        held, translation, rotation, steps = carry(
            self._body,
            self._jaw,
            self._grip,
            self._mass.mass_kg,
            self._mass.inertia,
            np.array(centre),
            principal_xyzw,
            np.array(fingers_m),
            self._frames,
            self._step_s,
            self._area_m,
            self._lost,
            path,
        )
        return Carried(bool(held), float(translation), float(rotation)), path[:steps]
