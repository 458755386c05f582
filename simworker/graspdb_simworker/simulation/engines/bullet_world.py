"""Gripper and object in a headless Bullet world. Only this module imports pybullet.

What the solver does depends on what it did before: Bullet keeps contact caches and the order of
overlapping pairs. Parking the object far away and stepping the world once after every grasp empties
both, and results become bitwise independent of the order of grasps, of the process and of the world
(saving and restoring Bullet's state does not achieve that).
"""

from __future__ import annotations

import functools
import math
import os
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pybullet
from numpy.typing import NDArray

from graspdb.wire.sweeps import Fidelity
from graspdb_simworker.simulation import camera
from graspdb_simworker.simulation.bodies import (
    HEAVY_KG,
    Contacts,
    Gripper,
    MassProperties,
    Part,
    Quaternion,
    Vector,
    obj_of_parts,
)
from graspdb_simworker.simulation.engines.world import EngineWorld, Stepping

COLLISION_MARGIN_M = 0.0005
"""Bullet inflates convex hulls by this much; boxes keep their size."""
CONTACT_BREAKING_M = 0.002
PARKED: Vector = (0.0, 0.0, -1000.0)
IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)
_ANY_LINK = -2
_JOINTS = (0, 1)

_LIGHT = Stepping(1.0 / 120.0, 1.0 / 360.0, 80, look_steps=3, residual=1e-6)
_HEAVY = Stepping(1.0 / 120.0, 1.0 / 180.0, 80, look_steps=2, residual=1e-6)
"""Long steps do, if the solver takes the trouble to converge in each; what is heavy moves slowly. Where fewer
than two fingers press, half of the time and more, 1/120 s differs from the labels of the fine step as often
as 1/240 s does, and 1/80 s more often. See docs/experiments.md."""
_LIGHT_CARRIED = Stepping(1.0 / 120.0, 1.0 / 480.0, 50)
_HEAVY_CARRIED = Stepping(1.0 / 120.0, 1.0 / 240.0, 80)
"""What is to be carried: the longer the steps, the deeper the fingers are in it when they stall, and then it
is closed on once more."""
_MIDDLE = Stepping(1.0 / 480.0, 1.0 / 1000.0, 100, look_steps=4)
_FINE = Stepping(1.0 / 2000.0, 1.0 / 2000.0, 200)


class _Connection:
    """Pybullet's functions for one world, which ends with this object. `BulletClient` would print a line."""

    def __init__(self) -> None:
        self.number: int = pybullet.connect(pybullet.DIRECT)
        if self.number < 0:
            raise RuntimeError("pybullet could not open a DIRECT world")
        self.end = weakref.finalize(self, pybullet.disconnect, self.number)

    def __getattr__(self, function: str) -> Any:
        return functools.partial(getattr(pybullet, function), physicsClientId=self.number)


class BulletWorld(EngineWorld):
    """A world of pybullet's, without a window. What is done at every step costs as much as the physics of a
    light one: it calls pybullet itself, with arguments without their names."""

    inflated_m = COLLISION_MARGIN_M
    finer = (_MIDDLE, _FINE)

    def __init__(
        self, parts: Sequence[Part], mass: MassProperties, friction: float, gripper: Gripper, *, visible: bool
    ) -> None:
        self.gripper = gripper
        self.mass = mass
        self._visible = visible
        self._views: list[camera.View] = []
        # Gives every call the world's number; calls of every step give it themselves, which is faster.
        self._bullet = _Connection()
        self._client = self._bullet.number
        self._approach_dt = _LIGHT.approach_dt_s
        self._configure()
        self._jaw, self._object = self._build_gripper(), self._build_object(parts, self.mass)
        self._column, self._column_at = self._build_column()
        self._finish_bodies(math.sqrt(friction))

    @staticmethod
    def stepping(fidelity: Fidelity, mass_kg: float, *, carried: bool) -> Stepping:
        if fidelity == "fine":
            return _FINE
        if carried:
            return _HEAVY_CARRIED if mass_kg >= HEAVY_KG else _LIGHT_CARRIED
        return _HEAVY if mass_kg >= HEAVY_KG else _LIGHT

    def close_world(self) -> None:
        self._bullet.end()

    def cut(self, stepping: Stepping) -> None:
        self._approach_dt = stepping.approach_dt_s
        self._bullet.setPhysicsEngineParameter(
            numSolverIterations=stepping.iterations, solverResidualThreshold=stepping.residual
        )

    def damp(self, rate: float) -> None:
        self._bullet.changeDynamics(self._object, -1, linearDamping=rate, angularDamping=rate)

    def drive(self, dt: float) -> None:
        # The step first: a motor's largest impulse, force times step, is frozen when the command is given.
        self._bullet.setPhysicsEngineParameter(fixedTimeStep=dt)
        speeds, forces = [-self.gripper.max_speed_m_s] * 2, [self.gripper.closing_force_n] * 2
        self._bullet.setJointMotorControlArray(
            self._jaw, _JOINTS, pybullet.VELOCITY_CONTROL, targetVelocities=speeds, forces=forces
        )

    def place(self, where: Vector, orientation: Quaternion, finger_m: float) -> None:
        # Parking left the object at rest and the motors driven at the steps of the approach.
        client, jaw, speed = self._client, self._jaw, -self.gripper.max_speed_m_s
        pybullet.resetBasePositionAndOrientation(self._object, where, orientation, physicsClientId=client)
        for joint in _JOINTS:
            pybullet.resetJointState(jaw, joint, finger_m, speed, physicsClientId=client)

    def advance(self, steps: int) -> float:
        client = self._client
        for _ in range(steps):
            pybullet.stepSimulation(client)
        first, second = pybullet.getJointStates(self._jaw, _JOINTS, client)
        return float(first[0] + second[0])

    def touching(self) -> tuple[int, float]:
        first = second = False
        nearest = 0.0
        for contact in pybullet.getContactPoints(self._jaw, self._object, _ANY_LINK, _ANY_LINK, self._client):
            if contact[9] > 0.0:
                first, second = first or contact[3] == 0, second or contact[3] == 1
            nearest = min(nearest, contact[8])
        return first + second, -nearest

    def contacts(self) -> Contacts:
        contacts = [c for c in self._bullet.getContactPoints(self._jaw, self._object) if c[9] > 0.0]
        # contactNormalOnB points from B, the object, to A: turned round it points into the object.
        return Contacts(
            np.array([[-c for c in contact[7]] for contact in contacts], dtype=np.float64).reshape(-1, 3),
            np.array([contact[9] for contact in contacts], dtype=np.float64),
            np.array([contact[3] for contact in contacts], dtype=np.int64),
            np.array([-contact[8] for contact in contacts], dtype=np.float64),
        )

    def body(self) -> tuple[Vector, Quaternion]:
        where, orientation = pybullet.getBasePositionAndOrientation(self._object, self._client)
        return where, orientation

    def fingers(self) -> tuple[float, float]:
        (first, *_), (second, *_) = self._bullet.getJointStates(self._jaw, _JOINTS)
        return first, second

    def show(self, where: Vector, orientation: Quaternion, fingers_m: tuple[float, float]) -> None:
        self._bullet.resetBasePositionAndOrientation(self._object, where, orientation)
        for joint in _JOINTS:
            self._bullet.resetJointState(self._jaw, joint, fingers_m[joint])

    def park(self) -> None:
        """Empty Bullet's caches: the object far away, one step without any contact."""
        self._bullet.resetBasePositionAndOrientation(self._object, PARKED, IDENTITY)
        self._bullet.resetBaseVelocity(self._object, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        for joint in _JOINTS:
            self._bullet.resetJointState(self._jaw, joint, 0.5 * self.gripper.max_opening_m, 0.0)
        self.drive(self._approach_dt)
        self._bullet.stepSimulation()

    def _configure(self) -> None:
        self._bullet.resetSimulation()
        self._bullet.setGravity(0.0, 0.0, 0.0)
        self._bullet.setPhysicsEngineParameter(
            contactBreakingThreshold=CONTACT_BREAKING_M,
            deterministicOverlappingPairs=1,
            numSubSteps=0,
            enableSAT=0,
        )

    def _build_gripper(self) -> int:
        gripper = self.gripper
        finger_half, palm_half = gripper.finger_half_extents, gripper.palm_half_extents
        finger, palm = self._box(finger_half), self._box(palm_half)
        finger_look = self._look(halfExtents=finger_half, rgbaColor=(0.25, 0.30, 0.38, 1.0))
        palm_look = self._look(halfExtents=palm_half, rgbaColor=(0.55, 0.58, 0.62, 1.0))
        closed = gripper.tip_offset_m - finger_half[2]
        frames = [(0.0, side * finger_half[1], closed) for side in (-1.0, 1.0)]
        jaw: int = self._bullet.createMultiBody(
            baseMass=0.0,
            # The base frame is the tool frame; the palm hangs behind it, so that links count from the tool.
            baseCollisionShapeIndex=palm,
            baseVisualShapeIndex=palm_look,
            basePosition=(0.0, 0.0, gripper.palm_centre_z),
            linkMasses=[gripper.finger_mass_kg] * 2,
            linkCollisionShapeIndices=[finger, finger],
            linkVisualShapeIndices=[finger_look, finger_look],
            linkPositions=[(x, y, z - gripper.palm_centre_z) for x, y, z in frames],
            linkOrientations=[IDENTITY] * 2,
            linkInertialFramePositions=[(0.0, 0.0, 0.0)] * 2,
            linkInertialFrameOrientations=[IDENTITY] * 2,
            linkParentIndices=[0, 0],
            linkJointTypes=[pybullet.JOINT_PRISMATIC] * 2,
            linkJointAxis=[(0.0, -1.0, 0.0), (0.0, 1.0, 0.0)],
        )
        return jaw

    def _box(self, half_extents: Vector) -> int:
        return int(self._bullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half_extents))

    def _look(self, **shape: Any) -> int:
        """A visual shape; none unless the world is to be seen."""
        if not self._visible:
            return -1
        kind = pybullet.GEOM_MESH if "fileName" in shape else pybullet.GEOM_BOX
        return int(self._bullet.createVisualShape(kind, **shape))

    def _build_object(self, parts: Sequence[Part], mass: MassProperties) -> int:
        # pybullet takes several hulls in one body only from an OBJ file, a group a part. In it the body
        # frame is the principal frame of inertia, so that no inertial offset is left to go wrong.
        with tempfile.TemporaryDirectory(prefix="graspdb-parts-") as folder:
            path = os.fspath(Path(folder) / "parts.obj")
            Path(path).write_text(obj_of_parts(parts, mass), encoding="ascii")
            shape = self._bullet.createCollisionShape(pybullet.GEOM_MESH, fileName=path)
            body: int = self._bullet.createMultiBody(
                baseMass=mass.mass_kg,
                baseCollisionShapeIndex=shape,
                baseVisualShapeIndex=self._look(fileName=path, rgbaColor=(0.93, 0.62, 0.25, 1.0)),
                basePosition=PARKED,
            )
        if shape < 0 or body < 0:
            raise RuntimeError("pybullet refused the object's convex parts")
        return body

    def _build_column(self) -> tuple[int, Vector]:
        """The space between the open fingers: a shape without a body, which would cost time at every step,
        and its centre."""
        half = self.gripper.finger_half_extents
        shape = self._box((half[0], 0.5 * self.gripper.max_opening_m, half[2]))
        return shape, (0.0, 0.0, self.gripper.tip_offset_m - half[2])

    def _finish_bodies(self, friction_root: float) -> None:
        """Surfaces and inertia."""
        # Bullet multiplies the coefficients of the two bodies, hence the root.
        surface = {"lateralFriction": friction_root}
        surface |= dict.fromkeys(("spinningFriction", "rollingFriction", "restitution"), 0.0)
        for body, links in ((self._jaw, (-1, 0, 1)), (self._object, (-1,))):
            for link in links:
                # In a call of its own: beside a setting that only a base has, such as a damping or a
                # margin, pybullet drops all others of a link without a word.
                self._bullet.changeDynamics(body, link, **surface)
            self._bullet.changeDynamics(
                body,
                -1,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                collisionMargin=COLLISION_MARGIN_M,
                activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            )
        for link in (0, 1):
            self._bullet.changeDynamics(self._jaw, link, jointDamping=0.0)
        self._bullet.changeDynamics(self._object, -1, localInertiaDiagonal=self.mass.inertia)

    def depth_between(self) -> float:
        points = pybullet.getClosestPoints(
            bodyA=self._object,
            bodyB=-1,
            distance=0.0,
            collisionShapeB=self._column,
            collisionShapePositionB=self._column_at,
            physicsClientId=self._client,
        )
        return max((-float(point[8]) for point in points), default=-math.inf)

    def aim(self) -> None:
        low, high = np.array(self._bullet.getAABB(self._object, -1))
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        finger, palm = (
            np.array(e) for e in (self.gripper.finger_half_extents, self.gripper.palm_half_extents)
        )
        tip = self.gripper.tip_offset_m
        reach = np.array([finger[0], 0.5 * self.gripper.max_opening_m, finger[2]])
        fingers = (2 * corners - 1) * reach + np.array([0.0, 0.0, tip - finger[2]])
        behind = (2 * corners - 1) * palm + np.array([0.0, 0.0, self.gripper.palm_centre_z])
        whole = np.concatenate([low + corners * (high - low), fingers, behind])
        self._views = []
        for points in (whole, 1.2 * (fingers - [0, 0, tip]) + [0, 0, tip]):
            views = [v for v in camera.around(points) if all(v.aside(other) for other in self._views)]
            drawn = [self._draw(view, 96, 72)[1] for view in views]
            one, two, thing = (np.array([(d == kind).sum() for d in drawn]) for kind in self._kinds())
            self._views.append(camera.best(views, camera.ACROSS, one, two, thing))

    def _kinds(self) -> tuple[int, int, int]:
        """What pixels of the first finger, the second and the object are marked with."""
        return (self._jaw + (1 << 24), self._jaw + (2 << 24), self._object)

    def _draw(
        self, view: camera.View, width: int, height: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.float64]]:
        """Pixels (height, width, 3), what each shows, and how far it is in metres."""
        near, far = 0.2 * view.distance_m, 4.0 * view.distance_m
        towards = np.subtract(view.eye, view.target) / view.distance_m
        _, _, pixels, depth, bodies = self._bullet.getCameraImage(
            width,
            height,
            pybullet.computeViewMatrix(view.eye, view.target, camera.UP),
            pybullet.computeProjectionMatrixFOV(camera.FIELD_OF_VIEW_DEG, camera.ASPECT, near, far),
            # From above the beholder's shoulder, that no side is dark that is looked at.
            lightDirection=np.add(towards, (0.3, -0.2, -0.7)).tolist(),
            lightAmbientCoeff=0.55,
            lightDiffuseCoeff=0.50,
            lightSpecularCoeff=0.02,
            shadow=0,
            flags=pybullet.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX,
            renderer=pybullet.ER_TINY_RENDERER,
        )
        shape = (height, width)
        buffer = np.asarray(depth, dtype=np.float64).reshape(shape)
        return (
            np.asarray(pixels, dtype=np.uint8).reshape(*shape, 4)[:, :, :3],
            np.asarray(bodies, dtype=np.int64).reshape(shape),
            far * near / (far - (far - near) * buffer),
        )

    def picture(self) -> NDArray[np.uint8]:
        views = [camera.finished(*self._draw(view, 1280, 960)) for view in self._views]
        return np.concatenate(views, axis=1)
