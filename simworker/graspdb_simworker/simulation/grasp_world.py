"""Closing a parallel jaw on a free-floating object in pybullet.

The world is built once and reused. The gripper (a palm and two fingers on prismatic joints) stays at
the origin, its tool frame is the world frame; for every grasp the *object* is moved instead. Nothing
weighs: the object floats, so that the jaw centres it as it closes, and gravity enters afterwards
through the force test in :mod:`graspdb_simworker.simulation.labels`, or as a load on what is carried: Bullet
closes the jaw, and :mod:`graspdb_simworker.simulation.carrying` lifts.

What the solver does depends on what it did before: Bullet keeps contact caches and the order of
overlapping pairs. Parking the object far away and stepping the world once after every grasp empties
both, and results become bitwise independent of the order of grasps, of the process and of the world
(saving and restoring Bullet's state does not achieve that).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pybullet
from numpy.typing import NDArray

from graspdb.wire.sweeps import Fidelity
from graspdb_simworker.simulation import carrying, lifting
from graspdb_simworker.simulation.bodies import (
    HEAVY_KG,
    Carried,
    Closing,
    Contacts,
    End,
    Gripper,
    Part,
    Quaternion,
    Vector,
    inverse,
    multiply,
    rotate,
)
from graspdb_simworker.simulation.bullet_world import COLLISION_MARGIN_M, IDENTITY, PARKED, BulletWorld
from graspdb_simworker.simulation.force_test import rating
from graspdb_simworker.simulation.labels import RATED

APPROACH_GAP_M = 0.0005
"""The fingers start this far before their first contact: nothing can happen on the way there."""
STALL_PROGRESS_M = 5e-5
"""The jaw has stalled once it closed less than this by the ages below: 5 mm at full speed by the first."""
READING_AGES_S = (0.040, 0.060, 0.080, 0.100, 0.120, 0.200, 0.280)
"""Contacts are read at these ages of the stall, until a reading leaves no doubt."""
NO_DOUBT = (1.8, 1.6, 1.5, 1.4, 1.2, 1.2, 1.2)
"""A reading from here on is the last one; 1 is the least that holds the weight. Lower ones are waited
with: a heavy object often still creeps into a better hold, what moves between the fingers makes the forces
ring, and a low reading may be an instant at which the fingers hardly touch. The median of the last
:data:`graspdb_simworker.simulation.labels.RATED` counts."""
DAMPING = 0.4
"""Rate at which the object's motion is damped while the jaw closes, over sqrt(closing force / mass / 1 m),
which is the pace of its swing between the fingers: about 2 per second for 1.6 kg at 40 N, 5 for 75 g at
10 N. Nothing else damps what floats. Undamped, a heavy object held far from its centre of mass swings from
finger to finger, and whether it stays depends on the time step more than on the grasp: see
docs/experiments.md."""
SLACK_S = 1.0
"""A closing may last this much longer than the fingers need to meet at full speed."""
LOST = carrying.Lost(0.050, math.radians(75.0))
"""A carried object that is farther off than this in the jaw is lost: no need to see where it ends."""
LIFTED_AFTER_S = 0.100
"""This long after the stall the jaw begins to lift: it has nearly stopped swinging by then."""
SUNK_M = 0.002
"""A finger this deep in the object is passing through it: Bullet's contacts of single points may rock a flat
object from corner to corner at every step and never stop the jaw. What turns as it is squeezed is up to
1.6 mm deep for a while, and comes out again."""
STALLED_SUNK_M, CARRIED_SUNK_M = 0.0008, 0.0002
"""Nor has a jaw stalled soundly this deep in it, whose forces are rated, or whose patches are to carry: what
is firmly held is 0.02 mm deep. Of 62 closings of a screwdriver that stalled at 0.2 to 0.8 mm, each was called
at the fine step what it had been called before."""
_EMPTY_CHECK_STEPS = 10
_SUNK_CHECK_STEPS = 3
_SURELY_BETWEEN = 0.8
"""An object that no point of which moved by this share of its depth between the fingers is still there."""
_ANY_LINK = -2


@dataclass(frozen=True)
class Stepping:
    """How time is cut: until both fingers touch, from then on, and while the object is carried, when patches
    of contact are cut into areas of ``area_m``."""

    approach_dt_s: float
    squeeze_dt_s: float
    solver_iterations: int
    carry_dt_s: float
    area_m: float


_LIGHT = Stepping(1.0 / 240.0, 1.0 / 480.0, 50, 1.0 / 240.0, 0.005)
_HEAVY = Stepping(1.0 / 240.0, 1.0 / 240.0, 80, 1.0 / 240.0, 0.005)
"""What is heavy moves slowly: longer steps do, if the solver takes the trouble to converge in each."""
_FINE = Stepping(1.0 / 2000.0, 1.0 / 2000.0, 200, 1.0 / 960.0, 0.0025)
"""Also what a doubtful closing is simulated with once more."""


def stepping_for(fidelity: Fidelity, mass_kg: float) -> Stepping:
    """How finely to simulate an object of this mass."""
    if fidelity == "fine":
        return _FINE
    return _HEAVY if mass_kg >= HEAVY_KG else _LIGHT


def doubtful(closing: Closing) -> bool:
    """Whether a closing can't be believed at the ordinary step: the fingers sank into the object, or the
    readings that count contradict each other, some hold the weight and some do not. What is slippery or light
    makes the forces ring, and the median of what rings is no measure."""
    counted = closing.ratings[-RATED:]
    return closing.end is End.SUNK or (bool(counted) and min(counted) < 1.0 <= max(counted))


class Moment(NamedTuple):
    """A moment of a closing: how far each finger is from the middle, and the object frame in the tool frame.

    ``fingers_m`` are of the finger at +y and that at -y, metres; the jaw stands still throughout.
    """

    time_s: float
    fingers_m: tuple[float, float]
    position: Vector
    quaternion_xyzw: Quaternion


class GraspWorld(BulletWorld):
    """One object and one gripper in a headless Bullet world.

    ``parts`` are convex, vertices (V, 3) in the object frame, metres, and faces (F, 3); ``friction`` is
    Coulomb's coefficient between object and gripper; ``fidelity`` is ``standard`` or ``fine``. ``lifts``:
    lift and shake what is held after every closing, see :mod:`graspdb_simworker.simulation.lifting`.
    ``visible``: build what can be seen, for :attr:`pictures`, one at the end and one every ``film_every_s``.
    ``moments_every_s``: keep :attr:`moments` that far apart, which changes nothing about what comes out.
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
        moments_every_s: float = math.inf,
    ) -> None:
        stepping = stepping_for(fidelity, mass_kg)
        super().__init__(
            parts,
            mass_kg,
            friction,
            gripper,
            solver_iterations=stepping.solver_iterations,
            visible=visible,
        )
        self.stepping = stepping
        self._film_every_s = film_every_s
        self._filmed_s = 0.0
        self._moments_every_s = moments_every_s
        self._watched = visible or moments_every_s < math.inf
        self._time_s = 0.0
        self.moments: list[Moment] = []
        """What the last closing came through, from just before the first contact; empty unless kept."""
        self.pictures: list[NDArray[np.uint8]] = []
        """The last closing as a whole and close by, each (480, 1280, 3), drawn by pybullet's CPU renderer;
        the end is last. Empty unless the world is visible."""
        self._carrier = (
            carrying.Carrier(parts, self.mass, gripper, friction, stepping.carry_dt_s, stepping.area_m, LOST)
            if lifts
            else None
        )
        self._to_body = inverse(self.mass.principal_xyzw)
        self._radius = self.mass.radius_of(parts)
        # Where the object was when it was last looked for between the fingers, and how deep.
        self._seen: tuple[Vector, Quaternion, float] | None = None
        self._damp(DAMPING * math.sqrt(gripper.closing_force_n / mass_kg))
        self._park()

    # -- one grasp -----------------------------------------------------------------------------------------

    def close(self, position: Vector, quaternion_xyzw: Quaternion, travel_m: float = 0.0) -> Closing:
        """Close the jaw at a tool pose in the object frame, until it stalls, is empty or times out.

        Each finger can close by ``travel_m`` before the first of the two touches, by the exact geometry.
        """
        stepping = self.stepping
        try:
            closing = self._close(position, quaternion_xyzw, travel_m)
            if stepping is not _FINE and doubtful(closing):
                self._step_by(_FINE)
                closing = self._close(position, quaternion_xyzw, travel_m)
            if self._moments_every_s < math.inf and self.moments[-1].time_s < self._time_s:
                self.moments.append(self._moment())
            if self._visible:
                self.pictures.append(self._render())
            return closing
        finally:
            if self.stepping is stepping:
                self._park()
            else:
                self._step_by(stepping)

    def _step_by(self, stepping: Stepping) -> None:
        """Leave the running grasp and cut time otherwise from now on."""
        self.stepping = stepping
        self._bullet.setPhysicsEngineParameter(numSolverIterations=stepping.solver_iterations)
        self._park()

    def _watch(self, dt: float) -> None:
        """Keep a moment, and take a picture, when it is time for the next."""
        self._time_s += dt
        if self._time_s > len(self.moments) * self._moments_every_s:
            self.moments.append(self._moment())
        self._filmed_s += dt
        if self._visible and self._filmed_s >= self._film_every_s:
            self._filmed_s = 0.0
            self.pictures.append(self._render())

    def _moment(self) -> Moment:
        (first, *_), (second, *_) = self._bullet.getJointStates(self._jaw, (0, 1))
        return Moment(self._time_s, (first, second), *self._object_pose())

    def _object_pose(self) -> tuple[Vector, Quaternion]:
        """Pose of the object frame in the tool frame."""
        where, orientation = self._bullet.getBasePositionAndOrientation(self._object)
        quaternion = multiply(orientation, self._to_body)
        shift = rotate(quaternion, self.mass.centre)
        return (where[0] - shift[0], where[1] - shift[1], where[2] - shift[2]), quaternion

    # long: one step after the other, with every name looked up once: it runs ten thousand times a second
    def _close(self, position: Vector, quaternion_xyzw: Quaternion, travel_m: float) -> Closing:
        client, jaw, body = self._client, self._jaw, self._object
        gripper, stepping = self.gripper, self.stepping
        self.pictures.clear()
        self.moments.clear()
        self._filmed_s = self._time_s = 0.0
        where, orientation = self._body_pose(position, quaternion_xyzw)
        # Parking left the object at rest and the motors driven at the steps of the approach.
        pybullet.resetBasePositionAndOrientation(body, where, orientation, physicsClientId=client)
        self._seen = None
        if self._visible:
            self._aim()
        start = gripper.max_opening_m * 0.5 - max(0.0, travel_m - APPROACH_GAP_M)
        for joint in (0, 1):
            pybullet.resetJointState(jaw, joint, start, -gripper.max_speed_m_s, physicsClientId=client)

        dt = stepping.approach_dt_s
        touched = False
        elapsed = 0.0
        limit = 2.0 * start / gripper.max_speed_m_s + SLACK_S
        opening = 2.0 * start
        # The opening at the beginning of the running stall window.
        mark_opening, mark_time = opening, 0.0
        contacts: list[Contacts] = []
        ratings: list[float] = []
        steps = 0
        end = End.TIMEOUT
        # What is done at every step costs as much as the physics of a light one: names looked up once, and
        # arguments without their names.
        step, states, touching = pybullet.stepSimulation, pybullet.getJointStates, pybullet.getContactPoints
        watched, joints = self._watched, (0, 1)
        ages = READING_AGES_S if self._carrier is None else (LIFTED_AFTER_S,)
        while elapsed < limit:
            step(client)
            steps += 1
            elapsed += dt
            if watched:
                self._watch(dt)
            first, second = states(jaw, joints, client)
            opening = first[0] + second[0]
            if not 0.0 < opening < math.inf:
                end = End.EMPTY if math.isfinite(opening) else End.UNSTABLE
                break
            if not touched:
                pressing = 0
                for contact in touching(jaw, body, _ANY_LINK, _ANY_LINK, client):
                    if contact[9] > 0.0:
                        pressing |= 1 << (contact[3] + 1)
                if pressing & 0b110 == 0b110:
                    touched = True
                    dt = stepping.squeeze_dt_s
                    if dt != stepping.approach_dt_s:
                        self._drive(dt)
                    mark_opening, mark_time = opening, elapsed
                    contacts.clear()
                    ratings.clear()
            if mark_opening - opening > STALL_PROGRESS_M:
                mark_opening, mark_time = opening, elapsed
                contacts.clear()
                ratings.clear()
            elif elapsed - mark_time >= ages[len(contacts)] - 1e-9:
                contacts.append(self._contacts())
                if self._carrier is None:
                    ratings.append(rating(contacts[-1], gripper, self.mass.mass_kg, self.friction))
                if len(contacts) == len(ages) or ratings[-1] >= NO_DOUBT[len(contacts) - 1]:
                    end = End.STALLED
                    break
            if steps % _EMPTY_CHECK_STEPS == 0 and not self._between():
                end = End.EMPTY
                break
            if touched and steps % _SUNK_CHECK_STEPS == 0 and self._sunk(SUNK_M):
                end = End.SUNK
                break
        if end is End.STALLED and self._sunk(STALLED_SUNK_M if self._carrier is None else CARRIED_SUNK_M):
            end = End.SUNK
        closing = self._closing(end, touched, opening, contacts, ratings, steps)
        if self._carrier is not None and closing.end is End.STALLED:
            return replace(closing, carried=self._carry(self._carrier))
        return closing

    def _body_pose(self, position: Vector, quaternion_xyzw: Quaternion) -> tuple[Vector, Quaternion]:
        """Pose of the object's principal frame in the tool frame.

        In scalars: a vectorised product may round differently with the length of its batch, and labels
        must not.
        """
        back, centre = inverse(quaternion_xyzw), self.mass.centre
        offset = (centre[0] - position[0], centre[1] - position[1], centre[2] - position[2])
        return rotate(back, offset), multiply(back, self.mass.principal_xyzw)

    def _drive(self, dt: float) -> None:
        # The step first: a motor's largest impulse, force times step, is frozen when the command is given.
        self._bullet.setPhysicsEngineParameter(fixedTimeStep=dt)
        speeds, forces = [-self.gripper.max_speed_m_s] * 2, [self.gripper.closing_force_n] * 2
        self._bullet.setJointMotorControlArray(
            self._jaw, (0, 1), pybullet.VELOCITY_CONTROL, targetVelocities=speeds, forces=forces
        )

    def _contacts(self) -> Contacts:
        contacts = [c for c in self._bullet.getContactPoints(self._jaw, self._object) if c[9] > 0.0]
        # contactNormalOnB points from B, the object, to A: turned round it points into the object.
        return Contacts(
            np.array([[-c for c in contact[7]] for contact in contacts], dtype=np.float64).reshape(-1, 3),
            np.array([contact[9] for contact in contacts], dtype=np.float64),
            np.array([contact[3] for contact in contacts], dtype=np.int64),
        )

    def _carry(self, carrier: carrying.Carrier) -> Carried:
        """Lift and shake what the stalled jaw holds, with the gripper's own force."""
        (first, *_), (second, *_) = self._bullet.getJointStates(self._jaw, (0, 1))
        where, orientation = self._bullet.getBasePositionAndOrientation(self._object)
        dt = self.stepping.carry_dt_s
        carried, path = carrier.carry(where, orientation, (first, second), lifting.frames(dt))
        if self._watched:
            for row in path.tolist():
                self._bullet.resetBasePositionAndOrientation(self._object, row[:3], row[3:7])
                for joint in (0, 1):
                    self._bullet.resetJointState(self._jaw, joint, row[7 + joint])
                self._watch(dt)
        return carried

    def _sunk(self, depth_m: float) -> bool:
        """Whether any contact is deeper than this."""
        touching = pybullet.getContactPoints(self._jaw, self._object, _ANY_LINK, _ANY_LINK, self._client)
        return any(contact[8] < -depth_m for contact in touching)

    def _between(self) -> bool:
        """Whether any of the object is in the space between the open fingers.

        A convex part that is in it by a depth d, the least translation that would part the two, can't be out
        of it before one of its points has moved by d: so the collision test, which takes as long as a step,
        is not made again until then.
        """
        where, orientation = pybullet.getBasePositionAndOrientation(self._object, self._client)
        if self._seen is not None:
            then, turned, depth = self._seen
            moved = math.dist(where, then) + self._radius * lifting.angle_between(turned, orientation)
            if moved < _SURELY_BETWEEN * depth:
                return True
        depth = self._depth_between()
        self._seen = (where, orientation, depth)
        return depth > -math.inf

    def _closing(
        self,
        end: End,
        touched: bool,
        opening: float,
        contacts: Sequence[Contacts],
        ratings: Sequence[float],
        steps: int,
    ) -> Closing:
        position, quaternion = self._object_pose()
        if not all(map(math.isfinite, (*position, *quaternion))):
            end = End.UNSTABLE
        elif end is End.STALLED:
            # Bullet's hulls are inflated by the margin on both sides; the object is not.
            opening -= 2.0 * COLLISION_MARGIN_M
        held, rated = (tuple(contacts), tuple(ratings)) if end is End.STALLED else ((), ())
        return Closing(end, touched, opening, held, position, quaternion, steps, ratings=rated)

    def _park(self) -> None:
        """Empty Bullet's caches: the object far away, one step without any contact."""
        self._bullet.resetBasePositionAndOrientation(self._object, PARKED, IDENTITY)
        self._bullet.resetBaseVelocity(self._object, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        for joint in (0, 1):
            self._bullet.resetJointState(self._jaw, joint, 0.5 * self.gripper.max_opening_m, 0.0)
        self._drive(self.stepping.approach_dt_s)
        self._bullet.stepSimulation()
