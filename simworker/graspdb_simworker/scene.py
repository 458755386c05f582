"""Closing a parallel jaw on a free-floating object in pybullet. The only module that imports pybullet.

The world is built once and reused. The gripper (a palm and two fingers on prismatic joints) stays at
the origin, its tool frame is the world frame; for every grasp the *object* is moved instead. Nothing
weighs: the object floats, so that the jaw centres it as it closes, and gravity enters afterwards
through the force test in :mod:`graspdb_simworker.labels`.

What the solver does depends on what it did before: Bullet keeps contact caches and the order of
overlapping pairs. Parking the object far away and stepping the world once after every grasp empties
both, and results become bitwise independent of the order of grasps, of the process and of the world
(saving and restoring Bullet's state does not achieve that).
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import pybullet
from numpy.typing import NDArray

from graspdb_simworker import lifting, urdf
from graspdb_simworker.bodies import (
    HEAVY_KG,
    Carried,
    Closing,
    Contacts,
    End,
    Gripper,
    MassProperties,
    Part,
    Quaternion,
    Vector,
    mass_properties,
    multiply,
    obj_of_parts,
    rotate,
)
from graspdb_simworker.labels import rating

Fidelity = Literal["standard", "fine"]

APPROACH_GAP_M = 0.0005
"""The fingers start this far before their first contact: nothing can happen on the way there."""
COLLISION_MARGIN_M = 0.0005
"""Bullet inflates convex hulls by this much; boxes keep their size."""
CONTACT_BREAKING_M = 0.002
STALL_PROGRESS_M = 5e-5
"""The jaw has stalled once it closed less than this by the ages below: 5 mm at full speed by the first."""
READING_AGES_S = (0.040, 0.060, 0.080, 0.100, 0.120, 0.200, 0.280)
"""Contacts are read at these ages of the stall, until a reading leaves no doubt."""
NO_DOUBT = (1.8, 1.6, 1.5, 1.4, 1.2, 1.2, 1.2)
"""A reading from here on is the last one; 1 is the least that holds the weight. Lower ones are waited
with: a heavy object often still creeps into a better hold, what moves between the fingers makes the forces
ring, and a low reading may be an instant at which the fingers hardly touch. The median of the last
:data:`graspdb_simworker.labels.RATED` counts."""
DAMPING = 0.4
"""Rate at which the object's motion is damped while the jaw closes, over sqrt(closing force / mass / 1 m),
which is the pace of its swing between the fingers: about 2 per second for 1.6 kg at 40 N, 5 for 75 g at
10 N. Nothing else damps what floats. Undamped, a heavy object held far from its centre of mass swings from
finger to finger, and whether it stays depends on the time step more than on the grasp: see
docs/experiments.md."""
SLACK_S = 1.0
"""A closing may last this much longer than the fingers need to meet at full speed."""
_PARKED: Vector = (0.0, 0.0, -1000.0)
_IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)
_EMPTY_CHECK_STEPS = 10
_GEAR_FORCES = 100.0
"""The coupling of the fingers may exert so many times the closing force: as good as rigid."""


@dataclass(frozen=True)
class Stepping:
    """How time is cut: until both fingers touch, from then on, and while the object is carried."""

    approach_dt_s: float
    squeeze_dt_s: float
    carry_dt_s: float
    solver_iterations: int


_LIGHT = Stepping(1.0 / 240.0, 1.0 / 480.0, 1.0 / 480.0, 50)
_HEAVY = Stepping(1.0 / 240.0, 1.0 / 240.0, 1.0 / 480.0, 80)
"""What is heavy moves slowly: longer steps do, if the solver takes the trouble to converge in each."""
_FINE = Stepping(1.0 / 2000.0, 1.0 / 2000.0, 1.0 / 2000.0, 200)


def stepping_for(fidelity: Fidelity, mass_kg: float, *, lifts: bool = False) -> Stepping:
    """How finely to simulate an object of this mass."""
    if fidelity == "fine":
        return _FINE
    return _HEAVY if mass_kg >= HEAVY_KG and not lifts else _LIGHT


class GraspWorld:
    """One object and one gripper in a headless Bullet world.

    Parameters
    ----------
    parts : sequence of (vertices (V, 3), faces (F, 3))
        Convex parts of the object in its own frame, metres.
    mass_kg : float
    friction : float
        Coulomb friction coefficient between object and gripper.
    gripper : Gripper
    fidelity : {'standard', 'fine'}
    lifts : bool
        Lift and shake what is held after every closing, see :mod:`graspdb_simworker.lifting`.
    visible : bool
        Build what can be seen, for :attr:`pictures`.
    film_every_s : float
        Take a picture at such intervals, not only at the end.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        mass_kg: float,
        friction: float,
        gripper: Gripper,
        fidelity: Fidelity = "standard",
        *,
        lifts: bool = False,
        visible: bool = False,
        film_every_s: float = math.inf,
    ) -> None:
        self.gripper = gripper
        self.friction = friction
        self.stepping = stepping_for(fidelity, mass_kg, lifts=lifts)
        self._damping = DAMPING * math.sqrt(gripper.closing_force_n / mass_kg)
        self.mass = mass_properties(parts, mass_kg)
        self._visible = visible
        # What is lifted must not turn where faces hold it: contact by faces, see urdf.py. It takes longer.
        self._lifts = lifts
        self._film_every_s = film_every_s
        self._filmed_s = 0.0
        self.pictures: list[NDArray[np.uint8]] = []
        """The last closing from two sides, each (480, 1280, 3), drawn by pybullet's CPU renderer; the end
        is last. Empty unless the world is visible."""
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise RuntimeError("pybullet could not open a DIRECT world")
        self._to_body = self.mass.inverse_rotation()
        try:
            self._configure()
            if lifts:
                self._jaw, self._object = self._load_bodies(parts)
            else:
                self._jaw = self._build_gripper()
                self._object = self._build_object(parts, self.mass)
            self._column = self._build_column()
            self._gear = self._build_gear() if lifts else -1
            self._finish_bodies(math.sqrt(friction))
            self._park()
        except BaseException:
            self.close_world()
            raise

    def __enter__(self) -> GraspWorld:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close_world()

    def close_world(self) -> None:
        """Free Bullet's memory; the world can't be used afterwards."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1

    # -- building ------------------------------------------------------------------------------------------

    def _configure(self) -> None:
        pybullet.resetSimulation(physicsClientId=self._client)
        pybullet.setGravity(0.0, 0.0, 0.0, physicsClientId=self._client)
        pybullet.setPhysicsEngineParameter(
            numSolverIterations=self.stepping.solver_iterations,
            contactBreakingThreshold=CONTACT_BREAKING_M,
            deterministicOverlappingPairs=1,
            numSubSteps=0,
            enableSAT=int(self._lifts),
            physicsClientId=self._client,
        )

    def _build_gripper(self) -> int:
        gripper = self.gripper
        finger_half, palm_half = gripper.finger_half_extents, gripper.palm_half_extents
        finger, palm = self._box(finger_half), self._box(palm_half)
        finger_look = self._look(halfExtents=finger_half, rgbaColor=(0.25, 0.30, 0.38, 1.0))
        palm_look = self._look(halfExtents=palm_half, rgbaColor=(0.55, 0.58, 0.62, 1.0))
        closed = gripper.tip_offset_m - finger_half[2]
        frames = [(0.0, side * finger_half[1], closed) for side in (-1.0, 1.0)]
        return int(
            pybullet.createMultiBody(
                baseMass=0.0,
                # The base frame is the tool frame; the palm hangs behind it, so that links count from
                # the tool.
                baseCollisionShapeIndex=palm,
                baseVisualShapeIndex=palm_look,
                basePosition=(0.0, 0.0, gripper.palm_centre_z),
                linkMasses=[gripper.finger_mass_kg] * 2,
                linkCollisionShapeIndices=[finger, finger],
                linkVisualShapeIndices=[finger_look, finger_look],
                linkPositions=[(x, y, z - gripper.palm_centre_z) for x, y, z in frames],
                linkOrientations=[_IDENTITY] * 2,
                linkInertialFramePositions=[(0.0, 0.0, 0.0)] * 2,
                linkInertialFrameOrientations=[_IDENTITY] * 2,
                linkParentIndices=[0, 0],
                linkJointTypes=[pybullet.JOINT_PRISMATIC] * 2,
                linkJointAxis=[(0.0, -1.0, 0.0), (0.0, 1.0, 0.0)],
                physicsClientId=self._client,
            )
        )

    def _box(self, half_extents: Vector) -> int:
        return int(
            pybullet.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=half_extents, physicsClientId=self._client
            )
        )

    def _look(self, **shape: Any) -> int:
        """A visual shape; none unless the world is to be seen."""
        if not self._visible:
            return -1
        kind = pybullet.GEOM_MESH if "fileName" in shape else pybullet.GEOM_BOX
        return int(pybullet.createVisualShape(kind, physicsClientId=self._client, **shape))

    def _build_object(self, parts: Sequence[Part], mass: MassProperties) -> int:
        # pybullet takes several hulls in one body only from an OBJ file, a group a part. In it the body
        # frame is the principal frame of inertia, so that no inertial offset is left to go wrong.
        with tempfile.TemporaryDirectory(prefix="graspdb-parts-") as folder:
            path = Path(folder) / "parts.obj"
            path.write_text(obj_of_parts(parts, mass), encoding="ascii")
            shape = pybullet.createCollisionShape(
                pybullet.GEOM_MESH, fileName=os.fspath(path), physicsClientId=self._client
            )
            body = int(
                pybullet.createMultiBody(
                    baseMass=mass.mass_kg,
                    baseCollisionShapeIndex=shape,
                    baseVisualShapeIndex=self._look(
                        fileName=os.fspath(path), rgbaColor=(0.93, 0.62, 0.25, 1.0)
                    ),
                    basePosition=_PARKED,
                    physicsClientId=self._client,
                )
            )
        if shape < 0 or body < 0:
            raise RuntimeError("pybullet refused the object's convex parts")
        return body

    def _load_bodies(self, parts: Sequence[Part]) -> tuple[int, int]:
        """Gripper and object with contact by faces."""
        flags = pybullet.URDF_INITIALIZE_SAT_FEATURES | pybullet.URDF_USE_INERTIA_FROM_FILE
        with tempfile.TemporaryDirectory(prefix="graspdb-bodies-") as name:
            folder = Path(name)
            jaw = pybullet.loadURDF(
                os.fspath(urdf.write_gripper(folder, self.gripper)),
                basePosition=(0.0, 0.0, self.gripper.palm_centre_z),
                useFixedBase=1,
                flags=flags,
                physicsClientId=self._client,
            )
            body = pybullet.loadURDF(
                os.fspath(urdf.write_object(folder, parts, self.mass)),
                basePosition=_PARKED,
                flags=flags,
                physicsClientId=self._client,
            )
        return int(jaw), int(body)

    def _build_column(self) -> int:
        """A ghost as large as the space between the open fingers: it collides with nothing and answers
        one question."""
        half = self.gripper.finger_half_extents
        shape = self._box((half[0], 0.5 * self.gripper.max_opening_m, half[2]))
        body = int(
            pybullet.createMultiBody(
                baseMass=0.0,
                baseCollisionShapeIndex=shape,
                basePosition=(0.0, 0.0, self.gripper.tip_offset_m - half[2]),
                physicsClientId=self._client,
            )
        )
        pybullet.setCollisionFilterGroupMask(body, -1, 0, 0, physicsClientId=self._client)
        return body

    def _build_gear(self) -> int:
        """What couples the fingers while they carry: both joints move alike. Idle until then."""
        gear = pybullet.createConstraint(
            self._jaw,
            0,
            self._jaw,
            1,
            pybullet.JOINT_GEAR,
            jointAxis=(0.0, 1.0, 0.0),
            parentFramePosition=(0.0, 0.0, 0.0),
            childFramePosition=(0.0, 0.0, 0.0),
            physicsClientId=self._client,
        )
        self._couple(gear, 0.0)
        return int(gear)

    def _couple(self, gear: int, force_n: float) -> None:
        pybullet.changeConstraint(gear, gearRatio=-1, maxForce=force_n, physicsClientId=self._client)

    def _finish_bodies(self, friction_root: float) -> None:
        # Bullet multiplies the coefficients of the two bodies, hence the root.
        surface = {
            "lateralFriction": friction_root,
            "spinningFriction": 0.0,
            "rollingFriction": 0.0,
            "restitution": 0.0,
        }
        for body, links in ((self._jaw, (-1, 0, 1)), (self._object, (-1,))):
            for link in links:
                # In a call of its own: beside a setting that only a base has, such as a damping or a
                # margin, pybullet drops all others of a link without a word.
                pybullet.changeDynamics(body, link, physicsClientId=self._client, **surface)
            pybullet.changeDynamics(
                body,
                -1,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                collisionMargin=COLLISION_MARGIN_M,
                activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
                physicsClientId=self._client,
            )
        for link in (0, 1):
            pybullet.changeDynamics(self._jaw, link, jointDamping=0.0, physicsClientId=self._client)
        pybullet.changeDynamics(
            self._object, -1, localInertiaDiagonal=self.mass.inertia, physicsClientId=self._client
        )
        self._damp(self._damping)

    def _damp(self, rate: float) -> None:
        pybullet.changeDynamics(
            self._object, -1, linearDamping=rate, angularDamping=rate, physicsClientId=self._client
        )

    def frictions(self) -> list[float]:
        """Coefficients between the object and palm, first and second finger, as Bullet multiplies them."""
        roots = [
            pybullet.getDynamicsInfo(body, link, physicsClientId=self._client)[1]
            for body, link in ((self._object, -1), (self._jaw, -1), (self._jaw, 0), (self._jaw, 1))
        ]
        return [roots[0] * root for root in roots[1:]]

    # -- one grasp -----------------------------------------------------------------------------------------

    def close(self, position: Vector, quaternion_xyzw: Quaternion, travel_m: float = 0.0) -> Closing:
        """Close the jaw at a pose of the tool frame in the object frame, until it stalls, is empty or
        times out.

        Parameters
        ----------
        position, quaternion_xyzw
            The grasp: pose of the tool frame in the object frame.
        travel_m : float
            How far each finger can close before the first of the two touches the object, from the exact
            geometry.
        """
        try:
            self.pictures.clear()
            self._filmed_s = 0.0
            closing = self._close(position, quaternion_xyzw, travel_m)
            if self._visible:
                self.pictures.append(self._render())
            return closing
        finally:
            self._park()

    def _film(self, dt: float) -> None:
        """Take a picture when it is time for the next."""
        self._filmed_s += dt
        if self._visible and self._filmed_s >= self._film_every_s:
            self._filmed_s = 0.0
            self.pictures.append(self._render())

    def _render(self) -> NDArray[np.uint8]:
        width, height = 640, 480
        # The ghost column would be drawn: out of sight meanwhile.
        column = pybullet.getBasePositionAndOrientation(self._column, physicsClientId=self._client)
        pybullet.resetBasePositionAndOrientation(
            self._column, _PARKED, _IDENTITY, physicsClientId=self._client
        )
        lens = pybullet.computeProjectionMatrixFOV(fov=32.0, aspect=width / height, nearVal=0.02, farVal=4.0)
        views = []
        # Along the fingers' width, and obliquely from the tips; the approach points down.
        for eye in ((0.45, 0.0, 0.05), (0.28, -0.30, 0.25)):
            view = pybullet.computeViewMatrix(eye, (0.0, 0.0, -0.02), (0.0, 0.0, -1.0))
            _, _, pixels, _, _ = pybullet.getCameraImage(
                width,
                height,
                view,
                lens,
                lightDirection=(0.6, -0.4, -0.8),
                shadow=0,
                renderer=pybullet.ER_TINY_RENDERER,
                physicsClientId=self._client,
            )
            views.append(np.asarray(pixels, dtype=np.uint8).reshape(height, width, 4)[:, :, :3])
        pybullet.resetBasePositionAndOrientation(self._column, *column, physicsClientId=self._client)
        return np.concatenate(views, axis=1)

    def _close(self, position: Vector, quaternion_xyzw: Quaternion, travel_m: float) -> Closing:
        client, jaw, body = self._client, self._jaw, self._object
        gripper, stepping = self.gripper, self.stepping
        where, orientation = self._body_pose(position, quaternion_xyzw)
        pybullet.resetBasePositionAndOrientation(body, where, orientation, physicsClientId=client)
        pybullet.resetBaseVelocity(body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), physicsClientId=client)
        start = gripper.max_opening_m * 0.5 - max(0.0, travel_m - APPROACH_GAP_M)
        for joint in (0, 1):
            pybullet.resetJointState(jaw, joint, start, -gripper.max_speed_m_s, physicsClientId=client)

        dt = stepping.approach_dt_s
        self._drive(dt)
        touched = False
        elapsed = 0.0
        limit = 2.0 * start / gripper.max_speed_m_s + SLACK_S
        opening = 2.0 * start
        # The opening at the beginning of the running stall window.
        mark_opening, mark_time = opening, 0.0
        contacts: list[Contacts] = []
        steps = 0
        end = End.TIMEOUT
        while elapsed < limit:
            pybullet.stepSimulation(physicsClientId=client)
            steps += 1
            elapsed += dt
            if self._visible:
                self._film(dt)
            first, second = pybullet.getJointStates(jaw, (0, 1), physicsClientId=client)
            opening = first[0] + second[0]
            if not math.isfinite(opening):
                end = End.UNSTABLE
                break
            if opening <= 0.0:
                end = End.EMPTY
                break
            if not touched:
                pressing = 0
                for contact in pybullet.getContactPoints(jaw, body, physicsClientId=client):
                    if contact[9] > 0.0:
                        pressing |= 1 << (contact[3] + 1)
                if pressing & 0b110 == 0b110:
                    touched = True
                    dt = stepping.squeeze_dt_s
                    if dt != stepping.approach_dt_s:
                        self._drive(dt)
                    mark_opening, mark_time = opening, elapsed
                    contacts.clear()
            if mark_opening - opening > STALL_PROGRESS_M:
                mark_opening, mark_time = opening, elapsed
                contacts.clear()
            elif elapsed - mark_time >= READING_AGES_S[len(contacts)] - 1e-9:
                contacts.append(self._contacts())
                if (
                    self._lifts
                    or len(contacts) == len(READING_AGES_S)
                    or rating(contacts[-1], gripper, self.mass.mass_kg, self.friction)
                    >= NO_DOUBT[len(contacts) - 1]
                ):
                    end = End.STALLED
                    break
            if steps % _EMPTY_CHECK_STEPS == 0 and not self._between():
                end = End.EMPTY
                break
        closing = self._closing(end, touched, opening, contacts, steps)
        if self._lifts and closing.end is End.STALLED:
            return replace(closing, carried=self._carry())
        return closing

    def _body_pose(self, position: Vector, quaternion_xyzw: Quaternion) -> tuple[Vector, Quaternion]:
        """Pose of the object's principal frame in the tool frame.

        In scalars: a vectorised product may round differently with the length of its batch, and labels
        must not.
        """
        x, y, z, w = quaternion_xyzw
        inverse = (-x, -y, -z, w)
        centre = self.mass.centre
        offset = (centre[0] - position[0], centre[1] - position[1], centre[2] - position[2])
        return rotate(inverse, offset), multiply(inverse, self.mass.principal_xyzw)

    def _drive(self, dt: float) -> None:
        # The step first: a motor's largest impulse, force times step, is frozen when the command is given.
        pybullet.setPhysicsEngineParameter(fixedTimeStep=dt, physicsClientId=self._client)
        speed, force = -self.gripper.max_speed_m_s, self.gripper.closing_force_n
        for joint in (0, 1):
            pybullet.setJointMotorControl2(
                self._jaw,
                joint,
                pybullet.VELOCITY_CONTROL,
                targetVelocity=speed,
                force=force,
                physicsClientId=self._client,
            )

    def _contacts(self) -> Contacts:
        contacts = [
            contact
            for contact in pybullet.getContactPoints(self._jaw, self._object, physicsClientId=self._client)
            if contact[9] > 0.0
        ]
        # contactNormalOnB points from B, the object, to A: turned round it points into the object.
        return Contacts(
            np.array([[-c for c in contact[7]] for contact in contacts], dtype=np.float64).reshape(-1, 3),
            np.array([contact[9] for contact in contacts], dtype=np.float64),
            np.array([contact[3] for contact in contacts], dtype=np.int64),
        )

    def _carry(self) -> Carried:
        """Lift and shake what the stalled jaw holds."""
        client, body, dt = self._client, self._object, self.stepping.carry_dt_s
        # Where the jaw closes with less than its force, every force is scaled alike and time runs slower
        # by the root: the same motion, in slow motion.
        scale = self.gripper.closing_force_n / self.gripper.force_n
        pace = math.sqrt(scale)
        self._damp(0.0)
        self._drive(dt)
        self._couple(self._gear, _GEAR_FORCES * self.gripper.closing_force_n)
        pybullet.resetBaseVelocity(body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), physicsClientId=client)
        where, orientation = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
        # The point of the object at the tool's origin, in the object's principal frame.
        x, y, z, w = began = orientation
        anchor = rotate((-x, -y, -z, w), (-where[0], -where[1], -where[2]))
        translation = rotation = 0.0
        held = True
        for step in range(1, math.ceil(lifting.DURATION_S / (pace * dt)) + 1):
            velocity, spin = pybullet.getBaseVelocity(body, physicsClientId=client)
            force, torque = lifting.load(
                lifting.frame_at((step - 0.5) * dt * pace),
                self.mass,
                where,
                orientation,
                (velocity[0] / pace, velocity[1] / pace, velocity[2] / pace),
                (spin[0] / pace, spin[1] / pace, spin[2] / pace),
            )
            pybullet.applyExternalForce(
                body, -1, [scale * f for f in force], where, pybullet.WORLD_FRAME, physicsClientId=client
            )
            pybullet.applyExternalTorque(
                body, -1, [scale * f for f in torque], pybullet.WORLD_FRAME, physicsClientId=client
            )
            pybullet.stepSimulation(physicsClientId=client)
            self._film(dt)
            where, orientation = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
            if step % _EMPTY_CHECK_STEPS:
                continue
            moved = rotate(orientation, anchor)
            away = math.hypot(where[0] + moved[0], where[1] + moved[1], where[2] + moved[2])
            translation, rotation = (
                max(translation, away),
                max(rotation, lifting.angle_between(began, orientation)),
            )
            if not self._between():
                held = False
                break
        held = held and {0, 1} <= set(self._contacts().fingers.tolist())
        return Carried(held, translation, rotation)

    def _between(self) -> bool:
        return bool(pybullet.getClosestPoints(self._object, self._column, 0.0, physicsClientId=self._client))

    def _closing(
        self, end: End, touched: bool, opening: float, contacts: Sequence[Contacts], steps: int
    ) -> Closing:
        where, orientation = pybullet.getBasePositionAndOrientation(
            self._object, physicsClientId=self._client
        )
        if not all(map(math.isfinite, (*where, *orientation))):
            end = End.UNSTABLE
        elif end is End.STALLED:
            # Bullet's hulls are inflated by the margin on both sides, but for contact by faces; the
            # object is not.
            opening -= 0.0 if self._lifts else 2.0 * COLLISION_MARGIN_M
        quaternion = multiply(orientation, self._to_body)
        shift = rotate(quaternion, self.mass.centre)
        position = (where[0] - shift[0], where[1] - shift[1], where[2] - shift[2])
        held = tuple(contacts) if end is End.STALLED else ()
        return Closing(end, touched, opening, held, position, quaternion, steps)

    def _park(self) -> None:
        """Empty Bullet's caches: the object far away, one step without any contact."""
        client, jaw = self._client, self._jaw
        if self._lifts:
            self._couple(self._gear, 0.0)
            self._damp(self._damping)
        pybullet.resetBasePositionAndOrientation(self._object, _PARKED, _IDENTITY, physicsClientId=client)
        pybullet.resetBaseVelocity(self._object, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), physicsClientId=client)
        for joint in (0, 1):
            pybullet.resetJointState(
                jaw, joint, 0.5 * self.gripper.max_opening_m, 0.0, physicsClientId=client
            )
        self._drive(self.stepping.approach_dt_s)
        pybullet.stepSimulation(physicsClientId=client)
