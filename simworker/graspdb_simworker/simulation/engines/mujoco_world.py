"""Gripper and object in a MuJoCo world. Only this module imports mujoco.

MuJoCo's contacts are soft: they give way within the time constant of their reference, which is at least two
time steps, and by a share 1 - d of what presses, d their impedance. Both are as stiff as the step allows.
Overdamped, as these are, they do not throw back what strikes them, as Bullet's don't, and as plastic does
little.
Friction is that of the pair, for both have the same coefficient and MuJoCo takes the larger; as in Bullet, a
contact point resists sliding and not spinning. Resetting the data before every grasp makes results bitwise
independent of what ran before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from graspdb.wire.sweeps import Fidelity
from graspdb_simworker.simulation.bodies import (
    Contacts,
    Gripper,
    MassProperties,
    Part,
    Quaternion,
    Vector,
)
from graspdb_simworker.simulation.engines.world import EngineWorld, Stepping

_PALM, _COLUMN, _FIRST_FINGER, _SECOND_FINGER, _PARTS = range(5)
"""Geoms in the order of the model; from the last on, the object's parts."""
_BODY, _SPIN = slice(2, 9), slice(2, 8)
"""The object's coordinates and velocities, after those of the two fingers."""

_CONTACT = 'solref="0.0005 3" solimp="0.99 0.999 0.0001 0.5 2"'
"""MuJoCo raises the time constant, half a millisecond, to two steps."""

_STANDARD = Stepping(1.0 / 480.0, 1.0 / 960.0, 50, look_steps=4)
_FINE = Stepping(1.0 / 2000.0, 1.0 / 2000.0, 200)


class MujocoWorld(EngineWorld):
    """A world of MuJoCo's, without pictures."""

    inflated_m = 0.0
    finer = (_FINE,)

    def __init__(
        self, parts: Sequence[Part], mass: MassProperties, friction: float, gripper: Gripper, *, visible: bool
    ) -> None:
        if visible:
            raise ValueError("grasps are drawn by pybullet: --engine pybullet")
        self.gripper = gripper
        # Else a warning would be written to a file in the folder that the worker was started in.
        mujoco.set_mju_user_warning(_ignored)
        self._model: Any = mujoco.MjModel.from_xml_string(_model(parts, mass, friction, gripper))
        self._data: Any = mujoco.MjData(self._model)
        self._inertia = np.array([mass.mass_kg] * 3 + list(mass.inertia))
        self._column_radius = float(self._model.geom_rbound[_COLUMN])
        self._approach_dt = _STANDARD.approach_dt_s
        self._step = mujoco.mj_step

    @staticmethod
    def stepping(fidelity: Fidelity, mass_kg: float, *, carried: bool) -> Stepping:
        return _FINE if fidelity == "fine" else _STANDARD

    def close_world(self) -> None:
        del self._data, self._model

    def cut(self, stepping: Stepping) -> None:
        self._approach_dt = stepping.approach_dt_s
        self._model.opt.iterations = stepping.iterations

    def damp(self, rate: float) -> None:
        self._model.dof_damping[_SPIN] = rate * self._inertia

    def drive(self, dt: float) -> None:
        self._model.opt.timestep = dt
        self._data.ctrl[:] = -self.gripper.max_speed_m_s

    def place(self, where: Vector, orientation: Quaternion, finger_m: float) -> None:
        x, y, z, w = orientation
        self._data.qpos[:] = (finger_m, finger_m, *where, w, x, y, z)
        self._data.qvel[:2] = -self.gripper.max_speed_m_s

    def advance(self, steps: int) -> float:
        data = self._data
        self._step(self._model, data, steps)
        first, second = data.qpos[:2].tolist()
        return float(first + second)

    def touching(self) -> tuple[int, float]:
        data = self._data
        if data.ncon == 0:
            return 0, 0.0
        jaw, _, forces = self._touching()
        pressing = set(jaw[forces > 0.0].tolist())
        fingers = (_FIRST_FINGER in pressing) + (_SECOND_FINGER in pressing)
        return fingers, max(0.0, -float(data.contact.dist.min()))

    def contacts(self) -> Contacts:
        jaw, normals, forces = self._touching()
        on = forces > 0.0
        fingers = np.where(jaw == _PALM, -1, jaw - _FIRST_FINGER)
        depths = -self._data.contact.dist[on]
        return Contacts(normals[on], forces[on], fingers[on].astype(np.int64), depths)

    def _touching(self) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Of the last step's contacts the geom of the jaw, the normal (n, 3) into the object, the force."""
        contact = self._data.contact
        geoms, address = contact.geom, contact.efc_address
        # Boxes come before meshes in a pair, and the normal points from the first to the second.
        forces = np.where(address >= 0, self._data.efc_force[address], 0.0)
        return geoms[:, 0], contact.frame[:, :3], forces

    def depth_between(self) -> float:
        model, data = self._model, self._data
        apart = np.linalg.norm(data.geom_xpos[_PARTS:] - data.geom_xpos[_COLUMN], axis=1)
        near = np.flatnonzero(apart < model.geom_rbound[_PARTS:] + self._column_radius) + _PARTS
        depths = (-mujoco.mj_geomDistance(model, data, _COLUMN, part, 0.0, None) for part in near.tolist())
        return max((depth for depth in depths if depth > 0.0), default=-math.inf)

    def body(self) -> tuple[Vector, Quaternion]:
        px, py, pz, w, x, y, z = self._data.qpos[_BODY].tolist()
        return (px, py, pz), (x, y, z, w)

    def fingers(self) -> tuple[float, float]:
        first, second = self._data.qpos[:2].tolist()
        return first, second

    def show(self, where: Vector, orientation: Quaternion, fingers_m: tuple[float, float]) -> None:
        x, y, z, w = orientation
        self._data.qpos[:] = (*fingers_m, *where, w, x, y, z)

    def park(self) -> None:
        mujoco.mj_resetData(self._model, self._data)
        self.drive(self._approach_dt)


def _ignored(message: str) -> None:
    """A warning of MuJoCo's: what is not finite shows in the result."""


def _model(parts: Sequence[Part], mass: MassProperties, friction: float, gripper: Gripper) -> str:
    """The world as MJCF. The object's body frame is its principal frame of inertia, every part a mesh."""
    half, palm = gripper.finger_half_extents, gripper.palm_half_extents
    closed = gripper.tip_offset_m - half[2]
    column = (half[0], 0.5 * gripper.max_opening_m, half[2])
    force = gripper.closing_force_n
    # At its highest speed a finger is not driven any more, and where it stands by the whole force: a steeper
    # drive than that flips between its limits from step to step.
    gain = force / gripper.max_speed_m_s
    meshes = "".join(
        _mesh(number, mass.to_principal(np.asarray(v, dtype=np.float64)))
        for number, (v, _) in enumerate(parts)
    )
    geoms = "".join(f'<geom type="mesh" mesh="part{number}"/>' for number in range(len(parts)))
    fingers = "".join(
        f'<body pos="0 {side * half[1]!r} {closed!r}"><joint name="finger{side}" type="slide"'
        f' axis="0 {side} 0"/><inertial pos="0 0 0" mass="{gripper.finger_mass_kg!r}" diaginertia="1 1 1"/>'
        f'<geom class="jaw" type="box" size="{_numbers(half)}"/></body>'
        for side in (-1, 1)
    )
    motors = "".join(
        f'<velocity joint="finger{side}" kv="{gain!r}" forcerange="{-force!r} {force!r}"/>'
        for side in (-1, 1)
    )
    return f"""<mujoco>
<compiler balanceinertia="true" autolimits="true"/>
<option gravity="0 0 0" integrator="implicitfast" cone="elliptic" impratio="10" tolerance="1e-8">
  <flag autoreset="disable" island="disable" multiccd="enable"/>
</option>
<default>
  <geom condim="3" friction="{friction!r} 0 0" {_CONTACT} contype="1" conaffinity="2"/>
  <default class="jaw"><geom contype="2" conaffinity="1"/></default>
</default>
<asset>{meshes}</asset>
<worldbody>
  <geom class="jaw" type="box" size="{_numbers(palm)}" pos="0 0 {gripper.palm_centre_z!r}"/>
  <geom type="box" size="{_numbers(column)}" pos="0 0 {closed!r}" contype="0" conaffinity="0"/>
  {fingers}
  <body pos="0 0 -1000"><freejoint/><inertial pos="0 0 0" mass="{mass.mass_kg!r}"
        diaginertia="{_numbers(mass.inertia)}"/>{geoms}</body>
</worldbody>
<actuator>{motors}</actuator>
</mujoco>"""


def _mesh(number: int, vertices: NDArray[np.float64]) -> str:
    return f'<mesh name="part{number}" inertia="convex" vertex="{_numbers(vertices.ravel().tolist())}"/>'


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(repr, values))
