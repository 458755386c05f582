"""Closing a parallel jaw on a free-floating object, in the world of a physics engine.

The world is built once and reused. The gripper (a palm and two fingers on prismatic joints) stays at
the origin, its tool frame is the world frame; for every grasp the *object* is moved instead. Nothing
weighs: the object floats, so that the jaw centres it as it closes, and gravity enters afterwards
through the force test in :mod:`graspdb_simworker.simulation.labels`, or as a load on what is carried: the
engine closes the jaw, and :mod:`graspdb_simworker.simulation.carrying` carries. What is an engine's own is
behind :class:`~graspdb_simworker.simulation.engines.world.EngineWorld`; when a closing is over is decided
here, alike for all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graspdb.wire.sweeps import Engine, Fidelity
from graspdb_simworker.simulation import carrying, lifting
from graspdb_simworker.simulation.bodies import (
    Carried,
    Closing,
    Contacts,
    End,
    Gripper,
    MassProperties,
    Part,
    Quaternion,
    Vector,
    inverse,
    multiply,
    rotate,
)
from graspdb_simworker.simulation.engines import installed
from graspdb_simworker.simulation.engines.world import Stepping
from graspdb_simworker.simulation.force_test import GRAVITY_M_S2, rating
from graspdb_simworker.simulation.labels import RATED

APPROACH_GAP_M = 0.0005
"""The fingers start this far before their first contact: nothing can happen on the way there."""
STALL_PROGRESS_M = 5e-5
"""The jaw has stalled once it closed less than this by the ages below: 3 mm at full speed by the first."""
READING_AGES_S = (0.025, 0.040, 0.060, 0.080, 0.100, 0.120, 0.200, 0.280)
"""Contacts are read at these ages of the stall, until a reading leaves no doubt."""
NO_DOUBT = (4.0, 1.8, 1.6, 1.5, 1.4, 1.2, 1.2, 1.2)
"""A reading from here on is the last one; 1 is the least that holds the weight. Lower ones are waited with: a
heavy object often still creeps into a better hold, what moves between the fingers makes the forces ring, and
a low reading may be an instant at which the fingers hardly touch. The median of the last
:data:`graspdb_simworker.simulation.labels.RATED` counts, the very first reading only if it is the last."""
EARLY_AGE_S, AT_ONCE = 1.0 / 60.0, 16.0
"""What already holds so many times the weight at this age of the stall is read no more, nor is a first
reading that does doubted for the fingers' depth: such a hold is not lost again. Looked for only where
friction could hold as much, and not at the finest step."""
SETTLED = 1.02
"""Two readings in a row that differ by less than this factor, and hold what the last one must, are the last,
too: the forces have settled."""
DAMPING = 0.4
"""Rate at which the object's motion is damped while the jaw closes, over sqrt(closing force / mass / 1 m),
which is the pace of its swing between the fingers: about 2 per second for 1.6 kg at 40 N, 5 for 75 g at
10 N. Nothing else damps what floats. Undamped, a heavy object held far from its centre of mass swings from
finger to finger, and whether it stays depends on the time step more than on the grasp: see
docs/experiments.md."""
SLACK_S = 1.0
"""A closing may last this much longer than the fingers need to meet at full speed."""
MOVED_AFTER_S = 0.100
"""This long after the stall the jaw begins to move: what it holds has nearly stopped swinging by then."""
DOUBTED = (End.SUNK, End.TIMEOUT)
"""What ends so at the ordinary step may be a matter of the step, and is closed on once more in finer ones."""
SUNK_M = 0.002
"""A finger this deep in the object is passing through it: Bullet's contacts of single points may rock a flat
object from corner to corner at every step and never stop the jaw. What turns as it is squeezed is up to
1.6 mm deep for a while, and comes out again."""
STALLED_SUNK_M, CARRIED_SUNK_M = 0.0005, 0.0002
"""Nor has a jaw stalled soundly this deep in it, whose forces are rated, or whose patches are to carry: what
is firmly held is 0.02 mm deep. Of 63 closings of a screwdriver that were 0.8 mm deep on the way, or 0.2 when
stalled, the fine step called 62 what they were called before."""
_EMPTY_CHECK_LOOKS = 10
_SURELY_BETWEEN = 0.8
"""An object that no point of which moved by this share of its depth between the fingers is still there."""


@dataclass(frozen=True)
class Carrying:
    """How finely carrying is simulated: its steps, and areas that patches of contact are cut into, by their
    side."""

    dt_s: float
    area_m: float


CARRYING: Mapping[Fidelity, Carrying] = {
    "standard": Carrying(1.0 / 240.0, 0.005),
    "fine": Carrying(1.0 / 960.0, 0.0025),
}


def counted(ratings: Sequence[float]) -> Sequence[float]:
    """The readings that count."""
    return (ratings[1:] or ratings)[-RATED:]


def settled(ratings: Sequence[float]) -> bool:
    """Whether the forces have settled, in a hold beyond doubt."""
    two = ratings[-2:]
    return len(two) == 2 and min(two) >= NO_DOUBT[-1] and max(two) < SETTLED * min(two)


def contradictory(ratings: Sequence[float]) -> bool:
    """Whether of the readings that count some hold the weight and some do not. What is slippery or light
    makes the forces ring, and the median of what rings is no measure."""
    rated = counted(ratings)
    return bool(rated) and min(rated) < 1.0 <= max(rated)


def _pace(stepping: Stepping, squeezing: bool) -> tuple[float, int]:
    """The length of a step, and after how many to look."""
    return (stepping.squeeze_dt_s, stepping.look_steps) if squeezing else (stepping.approach_dt_s, 1)


class Moment(NamedTuple):
    """A moment of a closing: how far each finger is from the middle, and the object frame in the tool frame.

    ``fingers_m`` are of the finger at +y and that at -y, metres; the jaw stands still throughout.
    """

    time_s: float
    fingers_m: tuple[float, float]
    position: Vector
    quaternion_xyzw: Quaternion


class GraspWorld:
    """One object and one gripper in the world of an engine, by default the worker's own.

    ``parts`` are convex, vertices (V, 3) in the object frame, metres, and faces (F, 3); ``friction`` is
    Coulomb's coefficient between object and gripper; ``fidelity`` is ``standard`` or ``fine``. ``motion``:
    carry what is held through it after every closing, on pads of ``compliance`` times the usual give.
    ``visible``: build what can be seen, for :attr:`pictures`, one at the end and one every ``film_every_s``.
    ``moments_every_s``: keep :attr:`moments` that far apart, which changes nothing about what comes out.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        mass: MassProperties,
        friction: float,
        gripper: Gripper,
        fidelity: Fidelity = "standard",
        *,
        engine: Engine | None = None,
        motion: lifting.Motion | None = None,
        compliance: float = 1.0,
        visible: bool = False,
        film_every_s: float = math.inf,
        moments_every_s: float = math.inf,
    ) -> None:
        self.gripper = gripper
        self.friction = friction
        self.mass = mass
        name = installed.require(engine)
        world_of = installed.world_of(name)
        self.engine = f"{name} {installed.version_of(name)}"
        """The engine and its version."""
        self._engine = world_of(parts, mass, friction, gripper, visible=visible)
        self._stepping = self._engine.stepping(fidelity, mass.mass_kg, carried=motion is not None)
        self._running = self._stepping
        self._visible = visible
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
        self.motion = motion
        self._carrying = CARRYING[fidelity]
        self._carrier = motion and carrying.Carrier(
            parts, mass, gripper, friction, motion, self._carrying.dt_s, self._carrying.area_m, compliance
        )
        # Times its weight, by both fingers.
        self._may_hold = 2.0 * friction * gripper.closing_force_n / (mass.mass_kg * GRAVITY_M_S2)
        self._to_body = inverse(mass.principal_xyzw)
        self._radius = mass.radius_of(parts)
        # Where the object was when it was last looked for between the fingers, and how deep.
        self._seen: tuple[Vector, Quaternion, float] | None = None
        self._engine.damp(DAMPING * math.sqrt(gripper.closing_force_n / mass.mass_kg))
        self._engine.cut(self._running)
        self._engine.park()

    def close_world(self) -> None:
        """Free the engine's memory at once; the world can't be used afterwards."""
        self._engine.close_world()

    # -- one grasp -----------------------------------------------------------------------------------------

    def close(self, position: Vector, quaternion_xyzw: Quaternion, travel_m: float = 0.0) -> Closing:
        """Close the jaw at a tool pose in the object frame, until it stalls, is empty or times out.

        Each finger can close by ``travel_m`` before the first of the two touches, by the exact geometry.
        Where the fingers sink into the object, or never stall, it is closed on once more in finer steps.
        """
        stepping = self._stepping
        try:
            closing = self._close(position, quaternion_xyzw, travel_m)
            for finer in self._finer_than(stepping):
                if closing.end not in DOUBTED:
                    break
                self._step_by(finer)
                closing = self._close(position, quaternion_xyzw, travel_m)
            if self._moments_every_s < math.inf and self.moments[-1].time_s < self._time_s:
                self.moments.append(self._moment())
            if self._visible:
                self.pictures.append(self._engine.picture())
            return closing
        finally:
            self._step_by(stepping)

    def _finer_than(self, stepping: Stepping) -> list[Stepping]:
        """What an engine has for what can't be believed."""
        return [finer for finer in self._engine.finer if finer.squeeze_dt_s < stepping.squeeze_dt_s]

    def _step_by(self, stepping: Stepping) -> None:
        """Leave the running grasp, and cut time so in the next."""
        self._cut(stepping)
        self._engine.park()

    def _cut(self, stepping: Stepping) -> None:
        """Cut time so in what comes next."""
        if stepping is not self._running:
            self._running = stepping
            self._engine.cut(stepping)

    def _watch(self, dt: float) -> None:
        """Keep a moment, and take a picture, when it is time for the next."""
        self._time_s += dt
        if self._time_s > len(self.moments) * self._moments_every_s:
            self.moments.append(self._moment())
        self._filmed_s += dt
        if self._visible and self._filmed_s >= self._film_every_s:
            self._filmed_s = 0.0
            self.pictures.append(self._engine.picture())

    def _moment(self) -> Moment:
        first, second = self._engine.fingers()
        return Moment(self._time_s, (second, first), *self._object_pose())

    def _object_pose(self) -> tuple[Vector, Quaternion]:
        """Pose of the object frame in the tool frame."""
        where, orientation = self._engine.body()
        quaternion = multiply(orientation, self._to_body)
        shift = rotate(quaternion, self.mass.centre)
        return (where[0] - shift[0], where[1] - shift[1], where[2] - shift[2]), quaternion

    # long: one step after the other, with every name looked up once: it runs ten thousand times a second
    def _close(self, position: Vector, quaternion_xyzw: Quaternion, travel_m: float) -> Closing:
        engine, gripper, stepping = self._engine, self.gripper, self._running
        self.pictures.clear()
        self.moments.clear()
        self._filmed_s = self._time_s = 0.0
        self._seen = None
        start = gripper.max_opening_m * 0.5 - max(0.0, travel_m - APPROACH_GAP_M)
        engine.place(*self._body_pose(position, quaternion_xyzw), start)
        if self._visible:
            engine.aim()

        dt, look, looks = stepping.approach_dt_s, 1, 0
        finer = self._finer_than(stepping)
        touched = squeezing = False
        elapsed = 0.0
        limit = 2.0 * start / gripper.max_speed_m_s + SLACK_S
        opening = 2.0 * start
        # The opening at the beginning of the running stall window.
        mark_opening, mark_time = opening, 0.0
        contacts: list[Contacts] = []
        ratings: list[float] = []
        steps = 0
        end = End.TIMEOUT
        # What is done at every step costs as much as the physics of a light one: names looked up once.
        advance, watched = engine.advance, self._watched
        carried = self._carrier is not None
        ages = (MOVED_AFTER_S,) if carried else READING_AGES_S
        deepest = CARRIED_SUNK_M if carried else STALLED_SUNK_M
        # When the stall began at whose early age was looked.
        seen_early = -1.0 if finer and not carried and self._may_hold >= AT_ONCE else math.inf
        while elapsed < limit:
            opening = advance(look)
            steps += look
            elapsed += look * dt
            if watched:
                self._watch(look * dt)
            if not 0.0 < opening < math.inf:
                end = End.EMPTY if math.isfinite(opening) else End.UNSTABLE
                break
            pressing, depth = engine.touching()
            if squeezing != (pressing == 2):
                # What one finger pushes, or none, needs no finer steps than what none has touched yet.
                squeezing = not squeezing
                before = dt
                dt, look = _pace(stepping, squeezing)
                if dt != before:
                    engine.drive(dt)
                if squeezing and not touched:
                    touched = True
                    mark_opening, mark_time = opening, elapsed
                    contacts.clear()
                    ratings.clear()
            if mark_opening - opening > STALL_PROGRESS_M:
                mark_opening, mark_time = opening, elapsed
                contacts.clear()
                ratings.clear()
            elif elapsed - mark_time >= ages[len(contacts)] - 1e-9:
                contacts.append(engine.contacts())
                if not carried:
                    ratings.append(rating(contacts[-1], gripper, self.mass.mass_kg, self.friction))
                if len(contacts) == len(ages) or (
                    depth <= (deepest if len(contacts) > 1 or ratings[-1] >= AT_ONCE else CARRIED_SUNK_M)
                    and (ratings[-1] >= NO_DOUBT[len(contacts) - 1] or settled(ratings))
                ):
                    if not finer or not contradictory(ratings):
                        end = End.STALLED
                        break
                    # It stays where it is: what its forces are, finer steps tell.
                    stepping = finer.pop(0)
                    self._cut(stepping)
                    dt, look = _pace(stepping, squeezing)
                    engine.drive(dt)
                    limit = elapsed + SLACK_S
                    mark_opening, mark_time = opening, elapsed
                    contacts.clear()
                    ratings.clear()
            elif seen_early < mark_time <= elapsed - EARLY_AGE_S + 1e-9 and squeezing and depth <= deepest:
                seen_early, early = mark_time, engine.contacts()
                held = rating(early, gripper, self.mass.mass_kg, self.friction)
                if held >= AT_ONCE:
                    contacts, ratings, end = [early], [held], End.STALLED
                    break
            looks += 1
            # What both fingers press is between them.
            if looks % _EMPTY_CHECK_LOOKS == 0 and not squeezing and not self._between():
                end = End.EMPTY
                break
            if touched and depth > SUNK_M:
                end = End.SUNK
                break
        if end is End.STALLED and depth > deepest:
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

    def _carry(self, carrier: carrying.Carrier) -> Carried:
        """Move what the stalled jaw holds, with the gripper's own force."""
        dt = self._carrying.dt_s
        carried, path = carrier.carry(*self._engine.body(), self._engine.fingers())
        if self._watched:
            for row in path.tolist():
                self._engine.show(tuple(row[:3]), tuple(row[3:7]), (row[7], row[8]))
                self._watch(dt)
        return carried

    def _between(self) -> bool:
        """Whether any of the object is in the space between the open fingers.

        A convex part that is in it by a depth d, the least translation that would part the two, can't be out
        of it before one of its points has moved by d: so the collision test, which takes as long as a step,
        is not made again until then.
        """
        where, orientation = self._engine.body()
        if self._seen is not None:
            then, turned, depth = self._seen
            moved = math.dist(where, then) + self._radius * lifting.angle_between(turned, orientation)
            if moved < _SURELY_BETWEEN * depth:
                return True
        depth = self._engine.depth_between()
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
            opening += contacts[-1].sunk_m - 2.0 * self._engine.inflated_m
        held, rated = (tuple(contacts), tuple(counted(ratings))) if end is End.STALLED else ((), ())
        return Closing(end, touched, opening, held, position, quaternion, steps, ratings=rated)
