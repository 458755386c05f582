"""The protocols ``lift`` and ``shake``: what a held object feels while the jaw moves it, seen from the jaw.

In the simulation the jaw stands still. Its motion is put on the object instead: in a frame that moves
with rotation R(t) and origin p(t), a body of mass m and inertia I, with its centre of mass at r moving
at v, spinning at w (all in that frame), moves as if under the force and the torque

    F / m = R^T (g - p'') - a x r - s x (s x r) - 2 s x v
    T     = -I a - s x I s + 2 w x J s,      J = tr(I) / 2 - I,

where s is the frame's angular velocity and a its rate. That is exact for a rigid body; no contact is
ever dragged by a body that was set to a new place. What holds the object against it: :mod:`.carrying`.

**lift**: the jaw points down: gravity starts along its approach. Gravity grows in, the jaw rises by 10 cm,
then goes there and back once along each of its axes and turns there and back once about each (through the
tool's origin), with accelerations of about 1 g and 33 rad/s^2 at most. Then it rests. The object has to stay
where it was in the jaw.

**shake**: nothing weighs. The jaw goes 10 cm there, back and home along each of its axes, with
accelerations of 20 m/s^2 at most, turns by 45 degrees likewise about each (through the tool's origin) with
100 rad/s^2 at most, and rests; with others as long as they take to go as far. The object has to be between
the fingers still, wherever it slid: so data sets label whose grasps are shaken without gravity. Whether it
stayed firmly or slid by little is told by the quality.

The object is at rest in the jaw when either begins. The fingers are coupled, as a parallel jaw's are: they
can be forced open, but not pushed aside together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from graspdb.wire.sweeps import SHAKEN, stated_accelerations
from graspdb_simworker.simulation.bodies import Quaternion, Vector, inverse, multiply, rotate
from graspdb_simworker.simulation.force_test import GRAVITY_M_S2

LIFT_M = 0.10
SHAKE_M = 0.020
SHAKE_RAD = math.radians(15.0)
_AMPLITUDE = 0.75 * math.sqrt(3.0)
"""Largest value of sin x - sin(2 x) / 2."""
_NOTHING: Vector = (0.0, 0.0, 0.0)
_AXES: tuple[Vector, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

ONSET_S, LIFT_S, SHAKE_S, TURN_S, REST_S = 0.1, 0.4, 0.4, 0.8, 0.1
_TURNS_FROM_S = ONSET_S + LIFT_S + 3.0 * SHAKE_S
DURATION_S = _TURNS_FROM_S + 3.0 * TURN_S + REST_S

ALONG_M, ABOUT_RAD = 0.10, math.radians(45.0)
_HARDEST = 2.735815 / _AMPLITUDE
"""Largest acceleration of :func:`_there_and_back` in a period of 2 pi."""


class Frame(NamedTuple):
    """The jaw's motion at one instant, in its own axes.

    ``push`` is R^T (g - p''), what a particle at rest at the origin feels, m/s^2; ``spin`` and ``spin_rate``
    are the angular velocity, rad/s, and its rate, rad/s^2.
    """

    push: Vector
    spin: Vector
    spin_rate: Vector


class Displacement(NamedTuple):
    """How far an object is from where it was in the jaw: metres and radians."""

    translation_m: float
    rotation_rad: float


class Motion(NamedTuple):
    """What a protocol does with what the jaw holds: the frame at a time from 0 to ``duration_s``.

    The grasp has succeeded up to the displacement ``allowed``; from ``lost`` on an object is not followed
    any more.
    """

    at: Callable[[float], Frame]
    duration_s: float
    allowed: Displacement
    lost: Displacement


def lift_at(time_s: float) -> Frame:
    """The jaw's motion in ``lift``."""
    if time_s < ONSET_S:
        s = max(0.0, time_s) / ONSET_S
        return Frame((0.0, 0.0, GRAVITY_M_S2 * s * s * (3.0 - 2.0 * s)), _NOTHING, _NOTHING)
    time_s -= ONSET_S
    if time_s < LIFT_S:
        # From rest to rest by the polynomial 10 s^3 - 15 s^4 + 6 s^5; up is against the approach.
        s = time_s / LIFT_S
        rising = LIFT_M / LIFT_S**2 * (60.0 * s - 180.0 * s * s + 120.0 * s**3)
        return Frame((0.0, 0.0, GRAVITY_M_S2 + rising), _NOTHING, _NOTHING)
    time_s -= LIFT_S
    if time_s < 3.0 * SHAKE_S:
        x, y, z = _AXES[int(time_s / SHAKE_S)]
        _, _, acceleration = _there_and_back(math.fmod(time_s, SHAKE_S) / SHAKE_S, SHAKE_S)
        a = SHAKE_M * acceleration
        return Frame((-a * x, -a * y, GRAVITY_M_S2 - a * z), _NOTHING, _NOTHING)
    time_s -= 3.0 * SHAKE_S
    if time_s < 3.0 * TURN_S:
        axis = _AXES[int(time_s / TURN_S)]
        angle, rate, acceleration = (
            SHAKE_RAD * v for v in _there_and_back(math.fmod(time_s, TURN_S) / TURN_S, TURN_S)
        )
        sine = -math.sin(0.5 * angle)
        back = (sine * axis[0], sine * axis[1], sine * axis[2], math.cos(0.5 * angle))
        return Frame(rotate(back, (0.0, 0.0, GRAVITY_M_S2)), _scaled(axis, rate), _scaled(axis, acceleration))
    return Frame((0.0, 0.0, GRAVITY_M_S2), _NOTHING, _NOTHING)


LIFT = Motion(
    lift_at,
    DURATION_S,
    allowed=Displacement(0.001, math.radians(0.5)),
    lost=Displacement(0.050, math.radians(75.0)),
)
"""What friction holds moves by hundredths of what is allowed, on the pads' give. The motion's hardest
instants are short, and what they ask for beyond what friction gives lets an object slide by little: a quarter
too much is some 9 mm of a fall, or 2 degrees of a turn. A wider tolerance would call that held."""


@lru_cache(maxsize=8)
def shaking(along_m_s2: float, about_rad_s2: float) -> Motion:
    """The jaw's motion in ``shake``, with accelerations of so much at most along its axes and about them.

    However it is turned, and up to 5 cm off, what is held is not lost.
    """
    along_s = 2.0 * math.pi * math.sqrt(ALONG_M * _HARDEST / along_m_s2)
    about_s = 2.0 * math.pi * math.sqrt(ABOUT_RAD * _HARDEST / about_rad_s2)

    def at(time_s: float) -> Frame:
        if time_s < 3.0 * along_s:
            _, _, acceleration = _there_and_back(math.fmod(time_s, along_s) / along_s, along_s)
            push = _scaled(_AXES[int(time_s / along_s)], -ALONG_M * acceleration)
            return Frame(push, _NOTHING, _NOTHING)
        time_s -= 3.0 * along_s
        if time_s < 3.0 * about_s:
            axis = _AXES[int(time_s / about_s)]
            _, rate, acceleration = _there_and_back(math.fmod(time_s, about_s) / about_s, about_s)
            return Frame(_NOTHING, _scaled(axis, ABOUT_RAD * rate), _scaled(axis, ABOUT_RAD * acceleration))
        return Frame(_NOTHING, _NOTHING, _NOTHING)

    displaced = Displacement(0.050, math.pi)
    return Motion(at, 3.0 * (along_s + about_s) + REST_S, allowed=displaced, lost=displaced)


SHAKE = shaking(*SHAKEN)
MOTIONS: Mapping[str, Motion] = {"lift": LIFT, "shake": SHAKE}
"""By the protocols that they belong to."""


def motion_of(protocol: str) -> Motion | None:
    """A protocol's motion; None where it has none, or there is no such protocol."""
    stated = stated_accelerations(protocol)
    return MOTIONS.get(protocol) if stated is None else shaking(*stated)


@lru_cache(maxsize=8)
def frames(motion: Motion, step_s: float) -> NDArray[np.float64]:
    """A motion at the end of every step (n, 9), each frame's vectors one after the other."""
    times = ((k + 1) * step_s for k in range(math.ceil(motion.duration_s / step_s)))
    rows = np.array([[x for v in motion.at(min(t, motion.duration_s)) for x in v] for t in times])
    rows.setflags(write=False)
    return rows


@njit(cache=True)
def _cross(a, b):  # type: ignore[no-untyped-def]
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


_turned: Any = njit(rotate)


@njit(cache=True)
def load(frame, mass_kg, inertia, position, orientation, velocity, spin):  # type: ignore[no-untyped-def]
    """Force (newtons, at the centre of mass) and torque (newton metres) on a carried body.

    ``inertia`` is the principal one, the pose that of its frame in the jaw's; ``velocity`` and ``spin`` are
    relative to the jaw, in its axes. Compiled: this is done at every step.
    """
    push, s, rate = frame
    euler, inward = _cross(rate, position), _cross(s, _cross(s, position))
    coriolis = _cross(s, velocity)
    force = (
        mass_kg * (push[0] - euler[0] - inward[0] - 2.0 * coriolis[0]),
        mass_kg * (push[1] - euler[1] - inward[1] - 2.0 * coriolis[1]),
        mass_kg * (push[2] - euler[2] - inward[2] - 2.0 * coriolis[2]),
    )
    back = (-orientation[0], -orientation[1], -orientation[2], orientation[3])
    own, a, w = _turned(back, s), _turned(back, rate), _turned(back, spin)
    ix, iy, iz = inertia
    half = 0.5 * (ix + iy + iz)
    gyro = _cross(own, (ix * own[0], iy * own[1], iz * own[2]))
    mixed = _cross(w, ((half - ix) * own[0], (half - iy) * own[1], (half - iz) * own[2]))
    torque = (
        -ix * a[0] - gyro[0] + 2.0 * mixed[0],
        -iy * a[1] - gyro[1] + 2.0 * mixed[1],
        -iz * a[2] - gyro[2] + 2.0 * mixed[2],
    )
    return force, _turned(orientation, torque)


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """Angle of the rotation that leads from one orientation to another, radians."""
    x, y, z, w = multiply(inverse(a), b)
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))


def _there_and_back(phase: float, period_s: float) -> tuple[float, float, float]:
    """A smooth way to +1, to -1 and home within one period, from rest to rest: position and its two
    rates."""
    rate = 2.0 * math.pi / period_s
    x = 2.0 * math.pi * phase
    return (
        (math.sin(x) - 0.5 * math.sin(2.0 * x)) / _AMPLITUDE,
        rate * (math.cos(x) - math.cos(2.0 * x)) / _AMPLITUDE,
        rate * rate * (2.0 * math.sin(2.0 * x) - math.sin(x)) / _AMPLITUDE,
    )


def _scaled(v: Vector, factor: float) -> Vector:
    return (factor * v[0], factor * v[1], factor * v[2])
