"""What mechanics says of simple grasps: bodies, patches they are held by, and the load at which they slip.

A pair of patches under uniform pressure resists a load (force and torque, together) if no motion that its
fingers leave free gains more work from the load than friction takes (limit analysis): with twists v of the
body, patch points x_i carrying normal forces N_i, and u_i(v) the speed along the patch at x_i,

    ratio(W) = max over v of  W . v / (mu sum_i N_i |u_i(v)|)

is 1 at the limit surface and proportional to the load. Where the largest ratio over the motion of protocol
``lift`` or ``shake`` is 1, the motion's hardest instant is just held.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graspdb.wire import GripperProfile, SimulatePayload
from graspdb.wire.presets.grippers import PRESETS
from graspdb_simworker.simulation import chunks, lifting
from graspdb_simworker.simulation.bodies import Part, mass_properties
from graspdb_simworker.simulation.force_test import GRAVITY_M_S2
from graspdb_simworker.simulation.labels import Label

FLOAT = NDArray[np.float64]
PG70 = PRESETS["pg70"].profile
DOWN = (1.0, 0.0, 0.0, 0.0)
"""Approach along -z of the object, closing along its -y: the tool's x is the object's, y and z are turned."""


@dataclass(frozen=True)
class Case:
    """A grasp that a closed form speaks of: ``part``, held by PG70 at ``position`` of the object, from above.

    ``patch`` (n, 3) are points of equal normal force on the finger at +y, in the tool frame; mirrored, those
    on the other. ``twists`` (k, 6) are the motions (translation first) that the fingers leave free;
    ``arms`` (2,) over how much of x and z the patch reaches, metres, infinite where tilting is a free twist.
    """

    name: str
    part: Part
    position: tuple[float, float, float]
    patch: FLOAT
    twists: FLOAT
    arms: tuple[float, float]
    friction: float

    def rubbing(self, friction: float) -> Case:
        """The same with another coefficient of friction."""
        return replace(self, friction=friction)


def _part(mesh: trimesh.Trimesh) -> Part:
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


_SLIDE = np.eye(6)[[0, 2, 4]]
"""Along x and z, and about y: what two flat patches leave free."""
_FINGER_Z = (PG70.tip_offset_m - PG70.finger.length_m, PG70.tip_offset_m)
_HALF_WIDTH = 0.5 * PG70.finger.width_m


def _grid(x: tuple[float, float], z: tuple[float, float], y: float, n: int = 12) -> FLOAT:
    middle = (np.arange(n) + 0.5) / n
    xs, zs = x[0] + (x[1] - x[0]) * middle, z[0] + (z[1] - z[0]) * middle
    return np.array([[a, y, b] for a in xs for b in zs])


def box(size: tuple[float, float, float], x: float = 0.0, z: float = 0.0) -> Case:
    """A box held across y, ``x`` and ``z`` off its middle; the patch is where face and finger overlap."""
    (sx, sy, sz), place = size, (x, 0.0, z)
    over_x = max(-_HALF_WIDTH, -x - 0.5 * sx), min(_HALF_WIDTH, -x + 0.5 * sx)
    over_z = max(_FINGER_Z[0], z - 0.5 * sz), min(_FINGER_Z[1], z + 0.5 * sz)
    return Case(
        f"box {1e3 * sx:g} x {1e3 * sy:g} x {1e3 * sz:g} mm, {1e3 * x:g} and {1e3 * z:g} mm off",
        _part(trimesh.creation.box(size)),
        place,
        _grid(over_x, over_z, 0.5 * sy),
        _SLIDE,
        (over_x[1] - over_x[0], over_z[1] - over_z[0]),
        0.4,
    )


def cylinder_by_its_ends(radius: float, length: float, x: float = 0.0) -> Case:
    """A cylinder along y, held by its end faces; ``x`` keeps the disc on the finger."""
    mesh = trimesh.creation.cylinder(radius, length, sections=48)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5 * math.pi, (1, 0, 0)))
    disc = _grid((-radius, radius), (-radius, radius), 0.5 * length, 24)
    disc = disc[np.hypot(disc[:, 0], disc[:, 2]) < radius] - [x, 0.0, 0.0]
    disc = disc[np.abs(disc[:, 0]) < _HALF_WIDTH]
    side = 1.7 * radius
    return Case(
        f"cylinder of {2e3 * radius:g} mm by its ends, {1e3 * length:g} mm apart, {1e3 * x:g} mm off",
        _part(mesh),
        (x, 0.0, 0.0),
        disc,
        _SLIDE,
        (side, side),
        0.4,
    )


def cylinder_by_its_side(radius: float, length: float, axis: str, off: float = 0.0) -> Case:
    """A cylinder along x or z, held across it, ``off`` its middle along the axis: two lines, about which it
    may roll."""
    mesh = trimesh.creation.cylinder(radius, length, sections=96)
    if axis == "x":
        mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5 * math.pi, (0, 1, 0)))
        over = max(-_HALF_WIDTH, -off - 0.5 * length), min(_HALF_WIDTH, -off + 0.5 * length)
        line = _grid(over, (0.0, 0.0), radius, 24)[::24]
        twists = np.vstack([_SLIDE, np.eye(6)[3]])
        arms, place = (over[1] - over[0], math.inf), (off, 0.0, 0.0)
    else:
        over = max(_FINGER_Z[0], off - 0.5 * length), min(_FINGER_Z[1], off + 0.5 * length)
        line = _grid((0.0, 0.0), over, radius, 24)[:24]
        twists = np.vstack([_SLIDE, np.eye(6)[5]])
        arms, place = (math.inf, over[1] - over[0]), (0.0, 0.0, off)
    name = f"cylinder of {2e3 * radius:g} x {1e3 * length:g} mm across {axis}, {1e3 * off:g} mm off"
    return Case(name, _part(mesh), place, line, twists, arms, 0.4)


def sphere(radius: float) -> Case:
    """A ball held by two points, about whose line it may spin unhindered."""
    mesh = trimesh.creation.icosphere(3, radius)
    point = np.array([[0.0, radius, 0.0]])
    return Case(
        f"ball of {2e3 * radius:g} mm",
        _part(mesh),
        (0.0, 0.0, 0.0),
        point,
        np.eye(6)[[0, 2, 3, 5]],
        (math.inf, math.inf),
        0.4,
    )


def wedge(half_angle: float) -> Part:
    """A wedge whose sides lean by ``half_angle`` (radians) from the plane y = 0, thin at x = -5 mm, thicker
    up to x = 18 mm: the fingers' rims, at x = 10 mm, touch its sides in lines."""
    corners = [
        (x, side * (2e-3 + math.tan(half_angle) * (x + 5e-3)), z)
        for x in (-5e-3, 18e-3)
        for side in (-1.0, 1.0)
        for z in (-15e-3, 15e-3)
    ]
    return _part(trimesh.convex.convex_hull(np.array(corners)))


def cylinder_on_the_tips(radius: float, angle: float) -> tuple[Part, tuple[float, float, float]]:
    """A cylinder along x with its middle so far beyond the fingertips that it touches their edges leaning by
    ``angle`` (radians), and where it is held so."""
    mesh = trimesh.creation.cylinder(radius, 0.03, sections=360)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5 * math.pi, (0, 1, 0)))
    return _part(mesh), (0.0, 0.0, PG70.tip_offset_m + radius * math.sin(angle))


# -- loads -------------------------------------------------------------------------------------------------


def loads_of(case: Case, mass_kg: float, motion: lifting.Motion, step_s: float = 0.01) -> FLOAT:
    """Force and torque about the tool's origin (t, 6), in the tool frame, while the jaw carries the body."""
    mass = mass_properties([case.part], mass_kg)
    back = Rotation.from_quat(DOWN).inv()
    centre = back.apply(np.array(mass.centre) - case.position)
    turn = (back * Rotation.from_quat(mass.principal_xyzw)).as_quat()
    still = (0.0, 0.0, 0.0)
    found = []
    for t in np.arange(0.0, motion.duration_s, step_s):
        frame = motion.at(float(t))
        force, torque = lifting.load(frame, mass_kg, mass.inertia, tuple(centre), tuple(turn), still, still)
        found.append(np.concatenate([force, np.array(torque) + np.cross(centre, force)]))
    return np.array(found)


def slip_ratio(case: Case, loads: FLOAT, force_n: float = PG70.force_n) -> FLOAT:
    """How much of what friction resists each load (t, 6) about the tool's origin asks for: 1 at the limit.

    The maximum by fixed points: at it, the load is proportional to sum_i N_i u_i(v) / |u_i(v)|, which is
    linear in v but for the denominator.
    """
    points = np.concatenate([case.patch, case.patch * [1.0, -1.0, 1.0]])
    count = len(case.patch)
    # Velocity at each point, along the patch (x and z), of each free twist.
    speeds = np.array([t[:3] + np.cross(t[3:], points) for t in case.twists])[:, :, [0, 2]]
    # What pushes along y loads one finger more and the other less; a jaw's sum stays.
    more = 0.5 * np.clip(loads[:, 1], -2.0 * force_n, 2.0 * force_n)
    normal = np.concatenate([np.repeat(force_n + s * more[:, None], count, axis=1) for s in (1, -1)], axis=1)
    normal *= case.friction / count
    load = loads @ case.twists.T
    twist = load.copy()
    twist[:, case.twists[:, 3:].any(axis=1)] *= 1e3
    best = np.zeros(len(loads))
    for _ in range(80):
        at = np.einsum("tk,kic->tic", twist, speeds)
        rate = np.maximum(np.linalg.norm(at, axis=2), 1e-9 * np.abs(twist).max(axis=1, initial=1e-9)[:, None])
        taken = (normal * rate).sum(axis=1)
        best = np.maximum(best, (load * twist).sum(axis=1) / np.maximum(taken, 1e-300))
        stiff = np.einsum("ti,kic,lic->tkl", normal / rate, speeds, speeds)
        stiff += 1e-12 * np.trace(stiff, axis1=1, axis2=2)[:, None, None] * np.eye(len(case.twists))
        twist = np.linalg.solve(stiff, load[:, :, None])[:, :, 0]
        twist /= np.maximum(np.linalg.norm(twist, axis=1, keepdims=True), 1e-300)
    return best


def tilt_ratio(case: Case, loads: FLOAT, force_n: float = PG70.force_n) -> float:
    """How near any load comes to lifting a patch's edge off its finger, where pressure is zero: 1 there. Up
    to it the two patches' pressures, which tilting slants in opposite ways, still sum to a uniform one."""
    middle = np.append(case.patch.mean(axis=0)[[0, 2]], 0.0)
    force, torque = loads[:, :3], loads[:, 3:]
    about_x = torque[:, 0] - (0.0 - middle[1] * force[:, 1])
    about_z = torque[:, 2] - (middle[0] * force[:, 1])
    least = np.maximum(force_n - 0.5 * np.abs(force[:, 1]), 1e-9)
    ratio = 3.0 * np.abs(about_z) / (case.arms[0] * least) + 3.0 * np.abs(about_x) / (case.arms[1] * least)
    return float(ratio.max())


def carried_limit(case: Case, motion: lifting.Motion) -> float:
    """The mass (kg) that the jaw just carries unmoved; infinite pushes along y are not looked at."""
    mass = 1.0
    for _ in range(30):
        ratio = float(slip_ratio(case, loads_of(case, mass, motion)).max())
        if abs(ratio - 1.0) < 1e-3:
            break
        mass /= ratio
    return mass


def wrench_limit(friction: float, force_n: float = PG70.force_n) -> float:
    """The mass (kg) whose weight two opposite contacts just hold, whichever way down is."""
    return min(2.0 * friction * force_n * math.cos(math.atan(friction)), force_n) / GRAVITY_M_S2


def slid(
    mass_kg: float, friction: float, motion: lifting.Motion, axis: int, force_n: float = PG70.force_n
) -> FLOAT:
    """How far (t,) a block between two flat fingers slides along one axis (0 or 2) of a motion without turns,
    from step to step of 0.1 ms, metres: Coulomb's friction on both sides against what pushes it."""
    dt, most = 1e-4, 2.0 * friction * force_n / mass_kg
    way = speed = 0.0
    found = []
    for t in np.arange(0.0, motion.duration_s, dt):
        push = motion.at(float(t)).push[axis]
        # What brakes it may stop it, and keeps it, but never turns it back.
        free = speed + push * dt
        speed = math.copysign(max(0.0, abs(free) - most * dt), free)
        way += speed * dt
        found.append(way)
    return np.array(found)


# -- simulation --------------------------------------------------------------------------------------------


def payload_of(
    mass_kg: float, friction: float, gripper: GripperProfile = PG70, **fields: object
) -> SimulatePayload:
    """A payload of one grasp."""
    return SimulatePayload.model_validate(
        {
            "sweep": "bench",
            "object": "bench",
            "convex_parts": "",
            "parts_sha256": "bench",
            "mass_kg": mass_kg,
            "friction": friction,
            "gripper": gripper,
            "protocol": "wrench",
            "fidelity": "standard",
            "start": 0,
            "stop": 1,
            **fields,
        }
    )


def simulate(
    part: Part, position: tuple[float, float, float], mass_kg: float, friction: float, **fields: object
) -> Label:
    """What the worker says of one grasp from above."""
    workpiece = chunks.prepare(payload_of(mass_kg, friction, **fields), [part])
    try:
        poses = np.array([position]), np.array([DOWN])
        _, travel = workpiece.classify(*poses)
        return workpiece.simulate(poses[0][0], poses[1][0], float(travel[0]))
    finally:
        workpiece.close()
