"""The protocol ``lift``: what a held object feels while the jaw lifts and shakes it, seen from the jaw.

In the simulation the jaw stands still. Its motion is put on the object instead: in a frame that moves
with rotation R(t) and origin p(t), a body of mass m and inertia I, with its centre of mass at r moving
at v, spinning at w (all in that frame), moves as if under the force and the torque

    F / m = R^T (g - p'') - a x r - s x (s x r) - 2 s x v
    T     = -I a - s x I s + 2 w x J s,      J = tr(I) / 2 - I,

where s is the frame's angular velocity and a its rate. That is exact for a rigid body; no contact is
ever dragged by a body that was set to a new place.

The jaw points down: gravity starts along its approach. Gravity grows in, the jaw rises by 10 cm, then
goes there and back once along each of its axes and turns there and back once about each (through the
tool's origin), with accelerations of about 1 g and 33 rad/s^2 at most. Then it rests. The object is at
rest in the jaw when this begins. The fingers are coupled, as a parallel jaw's are: they can be forced
open, but not pushed aside together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from graspdb_simworker.bodies import MassProperties, Quaternion, Vector, multiply, rotate
from graspdb_simworker.labels import GRAVITY_M_S2

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


@dataclass(frozen=True)
class Frame:
    """The jaw's motion at one instant, in its own axes.

    Attributes
    ----------
    push : tuple
        R^T (g - p''): what a particle at rest at the origin feels, m/s^2.
    spin, spin_rate : tuple
        Angular velocity, rad/s, and its rate, rad/s^2.
    """

    push: Vector
    spin: Vector
    spin_rate: Vector


def frame_at(time_s: float) -> Frame:
    """The jaw's motion at a time from 0 to :data:`DURATION_S`."""
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


def load(
    frame: Frame,
    mass: MassProperties,
    position: Vector,
    orientation: Quaternion,
    velocity: Vector,
    spin: Vector,
) -> tuple[Vector, Vector]:
    """Force (newtons, at the centre of mass) and torque (newton metres) on a carried body.

    Parameters
    ----------
    frame : Frame
    mass : MassProperties
    position, orientation
        Pose of the body's principal frame in the jaw's frame.
    velocity, spin
        Relative to the jaw, in its axes.
    """
    s, m = frame.spin, mass.mass_kg
    euler, inward = _cross(frame.spin_rate, position), _cross(s, _cross(s, position))
    coriolis = _cross(s, velocity)
    px, py, pz = (m * (frame.push[k] - euler[k] - inward[k] - 2.0 * coriolis[k]) for k in range(3))
    back = (-orientation[0], -orientation[1], -orientation[2], orientation[3])
    s, a, w = rotate(back, s), rotate(back, frame.spin_rate), rotate(back, spin)
    inertia = mass.inertia
    half = 0.5 * sum(inertia)
    momentum = (inertia[0] * s[0], inertia[1] * s[1], inertia[2] * s[2])
    gyro = _cross(s, momentum)
    mixed = _cross(w, ((half - inertia[0]) * s[0], (half - inertia[1]) * s[1], (half - inertia[2]) * s[2]))
    tx, ty, tz = (-inertia[k] * a[k] - gyro[k] + 2.0 * mixed[k] for k in range(3))
    return (px, py, pz), rotate(orientation, (tx, ty, tz))


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """Angle of the rotation that leads from one orientation to another, radians."""
    x, y, z, w = multiply((-a[0], -a[1], -a[2], a[3]), b)
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


def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
