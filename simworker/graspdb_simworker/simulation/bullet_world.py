"""Gripper and object in a headless Bullet world, built once, to be posed and driven by
:mod:`graspdb_simworker.simulation.grasp_world`. Only these two modules import pybullet."""

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

from graspdb_simworker.simulation import camera
from graspdb_simworker.simulation.bodies import (
    Gripper,
    MassProperties,
    Part,
    Quaternion,
    Vector,
    mass_properties,
    obj_of_parts,
)

COLLISION_MARGIN_M = 0.0005
"""Bullet inflates convex hulls by this much; boxes keep their size."""
CONTACT_BREAKING_M = 0.002
PARKED: Vector = (0.0, 0.0, -1000.0)
IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)


class _Connection:
    """Pybullet's functions for one world, which ends with this object. `BulletClient` would print a line."""

    def __init__(self) -> None:
        self.number: int = pybullet.connect(pybullet.DIRECT)
        if self.number < 0:
            raise RuntimeError("pybullet could not open a DIRECT world")
        self.end = weakref.finalize(self, pybullet.disconnect, self.number)

    def __getattr__(self, function: str) -> Any:
        return functools.partial(getattr(pybullet, function), physicsClientId=self.number)


class BulletWorld:
    """A jaw at the origin, its tool frame the world's, and an object.

    ``parts`` are convex, vertices (V, 3) in the object frame, metres, and faces (F, 3). ``visible``:
    build what can be seen.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        mass_kg: float,
        friction: float,
        gripper: Gripper,
        *,
        solver_iterations: int,
        visible: bool,
    ) -> None:
        self.gripper = gripper
        self.friction = friction
        self.mass = mass_properties(parts, mass_kg)
        self._visible = visible
        self._views: list[camera.View] = []
        # Gives every call the world's number; calls of every step give it themselves, which is faster.
        self._bullet = _Connection()
        self._client = self._bullet.number
        self._configure(solver_iterations)
        self._jaw, self._object = self._build_gripper(), self._build_object(parts, self.mass)
        self._column, self._column_at = self._build_column()
        self._finish_bodies(math.sqrt(friction))

    def close_world(self) -> None:
        """Free Bullet's memory at once; the world can't be used afterwards."""
        self._bullet.end()

    def _configure(self, solver_iterations: int) -> None:
        self._bullet.resetSimulation()
        self._bullet.setGravity(0.0, 0.0, 0.0)
        self._bullet.setPhysicsEngineParameter(
            numSolverIterations=solver_iterations,
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

    def _damp(self, rate: float) -> None:
        self._bullet.changeDynamics(self._object, -1, linearDamping=rate, angularDamping=rate)

    def _depth_between(self) -> float:
        """How deep the object is in the space between the open fingers, metres; negative outside.

        The deepest part counts: moved by less than its depth, it is still there.
        """
        points = pybullet.getClosestPoints(
            bodyA=self._object,
            bodyB=-1,
            distance=0.0,
            collisionShapeB=self._column,
            collisionShapePositionB=self._column_at,
            physicsClientId=self._client,
        )
        return max((-float(point[8]) for point in points), default=-math.inf)

    def _aim(self) -> None:
        """Choose from where the grasp that begins is looked at."""
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

    def _render(self) -> NDArray[np.uint8]:
        views = [camera.finished(*self._draw(view, 1280, 960)) for view in self._views]
        return np.concatenate(views, axis=1)
