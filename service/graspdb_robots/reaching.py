"""Which grasps an arm can take where it stands: with a straight approach and lift, without a collision."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .arm import Floats
from .collision import ArmCollisions, LinkShapes, Obstacle, Surroundings
from .kinematics import STEP_M, Kinematics, Straight

Reason = Literal["too_far", "joint_limit", "singular", "self_collision", "collision"]
#: What fails later is nearer to a grasp that can be taken.
REASONS: tuple[Reason, ...] = ("too_far", "joint_limit", "singular", "self_collision", "collision")
#: Half a turn about the approach, which is the same grasp for a symmetric jaw.
_TWIN = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class ArmMotion:
    """Joints (n,) for a grasp: before it, at it, and lifted; the first and last None without such a way.

    ``twin``: the gripper is turned by half a turn about its approach. ``way`` (steps, n) are all joints that
    were tested, ``margin`` the least distance of any to a limit, radians or metres, ``manipulability`` that
    at the grasp, ``travel`` how far joints go from where they are to the first of the way; 0 where that is
    not known.
    """

    pregrasp: Floats | None
    grasp: Floats
    lift: Floats | None
    way: Floats
    twin: bool
    margin: float
    manipulability: float
    travel: float


@dataclass(frozen=True, eq=False)
class Obstruction:
    """Why an arm can't take a grasp, and by how far it fails, metres (radians counted as 0.3 m).

    ``joints`` (n,) are where it fails: where ``link`` collides, or at the grasp beyond a limit or singular;
    None where nothing leads there. ``lifted``: that is on the lift.
    """

    reason: Reason
    off_m: float
    link: str | None = None
    other: str | None = None
    joints: Floats | None = None
    lifted: bool = False


@dataclass(frozen=True, eq=False)
class RobotCell:
    """An arm with its gripper, and what stands around, all in the world's frame.

    Attributes
    ----------
    kinematics, shapes
        Of the arm, kept between questions.
    gripper
        Convex solids (V, 3) in the flange's frame, metres.
    flange_in_tool : (4, 4)
        Pose of the flange in the tool frame of grasps.
    object_pose : (4, 4)
        The frame of grasps in the world.
    obstacles, points, point_radius_m
        In the world.
    distance_m, lift_m
        How far back the approach starts, and how far up, along the world's z, the lift ends; 0 for none.
    symmetric
        Whether the jaw's twins are one grasp.
    now : (n,) or None
        Where the joints are.
    """

    kinematics: Kinematics
    shapes: LinkShapes
    gripper: tuple[Floats, ...]
    flange_in_tool: Floats
    object_pose: Floats
    obstacles: tuple[Obstacle, ...] = ()
    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    point_radius_m: float = 0.0
    distance_m: float = 0.0
    lift_m: float = 0.0
    symmetric: bool = True
    now: Floats | None = None


class Reaching:
    """Tests of grasps, poses (4, 4) of the tool in the object's frame, with the robot's root at ``base``
    (4, 4) in the world. One question's: not thread-safe.
    """

    def __init__(self, cell: RobotCell, base: Floats) -> None:
        self.cell, self.base = cell, base
        back = np.linalg.inv(base)
        self._object = back @ cell.object_pose
        self._lift = back[:3, :3] @ np.array([0.0, 0.0, cell.lift_m])
        around = Surroundings(
            tuple(replace(obstacle, pose=back @ obstacle.pose) for obstacle in cell.obstacles),
            cell.points @ back[:3, :3].T + back[:3, 3],
            cell.point_radius_m,
        )
        self._collisions = ArmCollisions(cell.kinematics.arm, cell.gripper, around, cell.shapes)

    def flanges(self, grasps: Floats, *, twin: bool = False) -> Floats:
        """Poses (N, 4, 4) of the flange in the root's frame."""
        last = (_TWIN if twin else np.eye(4)) @ self.cell.flange_in_tool
        return np.asarray(self._object @ grasps @ last)

    def likely(self, grasps: Floats) -> NDArray[np.bool_]:
        """Where the arm's map knows of joints for one of the twins (N, 4, 4): a hint, no verdict."""
        known = self.cell.kinematics.map.knows(self.flanges(grasps))
        if self.cell.symmetric:
            known |= self.cell.kinematics.map.knows(self.flanges(grasps, twin=True))
        return known

    def reaches(self, grasps: Floats) -> NDArray[np.bool_]:
        """Which grasps (N, 4, 4) the arm can take."""
        found = [next(self._ways(grasp), None) is not None for grasp in grasps]
        return np.array(found, dtype=np.bool_).reshape(len(grasps))

    def motion(self, grasp: Floats) -> ArmMotion | None:
        """How the arm takes a grasp (4, 4): of all motions found the one with the least travel, or without
        ``now`` the one farthest from limits; None where it can't.
        """
        found = [self._motion(way, twin) for twin, way in self._ways(grasp)]
        if not found:
            return None
        if self.cell.now is None:
            return max(found, key=lambda motion: motion.margin)
        return min(found, key=lambda motion: motion.travel)

    def travel(self, grasps: Floats) -> Floats:
        """Joint travel (N,) of the motion for each grasp (N, 4, 4); infinite where there is none."""
        motions = [self.motion(grasp) for grasp in grasps]
        return np.array([math.inf if motion is None else motion.travel for motion in motions])

    def obstruction(self, grasp: Floats) -> Obstruction | None:
        """What keeps the arm from a grasp (4, 4), by what came nearest to taking it; None for nothing."""
        found = [self._obstruction(grasp, twin) for twin in self._twins()]
        if any(item is None for item in found):
            return None
        return max(
            (item for item in found if item is not None),
            key=lambda item: (REASONS.index(item.reason), -item.off_m),
        )

    def _twins(self) -> Sequence[bool]:
        return (False, True) if self.cell.symmetric else (False,)

    def _straight(self, grasp: Floats) -> Straight:
        return Straight(-self.cell.distance_m * (self._object @ grasp)[:3, 2], self._lift)

    def _ways(self, grasp: Floats) -> Iterator[tuple[bool, Floats]]:
        """Ways (steps, n) without a collision, each with whether it is the twin's."""
        kinematics, ways = self.cell.kinematics, self._straight(grasp)
        parts, _ = ways.parts
        asked = False
        for twin in self._twins():
            flange = self.flanges(grasp[None], twin=twin)[0]
            for joints in self._solutions(flange):
                # Of all steps the grasp collides most often.
                if self._collisions.hits(joints):
                    # The gripper does wherever the links are, and whichever finger is where.
                    if not asked and self._collisions.gripper_hits(joints):
                        return
                    asked = True
                    continue
                way = kinematics.way(joints, flange, ways)
                if way is not None and self._free(way, parts):
                    yield twin, way

    def _solutions(self, flange: Floats) -> Iterator[Floats]:
        """Joints that take the flange to a pose: one is found much faster than several, and will do most
        often.
        """
        first, _ = self.cell.kinematics.solutions(flange, self.cell.now, most=1)
        if len(first):
            yield first[0]
            more, _ = self.cell.kinematics.solutions(flange, self.cell.now)
            yield from more[1:]

    def _free(self, way: Floats, grasp: int) -> bool:
        """Whether nothing collides along a way, but at the grasp itself."""
        last = len(way) - 1
        order = [step for step in dict.fromkeys([0, last, *range(last)]) if step != grasp]
        return not any(self._collisions.hits(way[step], lifted=step > grasp) for step in order)

    def _motion(self, way: Floats, twin: bool) -> ArmMotion:
        kinematics, now = self.cell.kinematics, self.cell.now
        parts = math.ceil(self.cell.distance_m / STEP_M - 1e-9)
        return ArmMotion(
            way[0] if parts else None,
            way[parts],
            way[-1] if parts < len(way) - 1 else None,
            way,
            twin,
            kinematics.margin(way),
            kinematics.manipulability(way[parts]),
            0.0 if now is None else float(np.abs(way[0] - now).sum()),
        )

    def _obstruction(self, grasp: Floats, twin: bool) -> Obstruction | None:
        kinematics, ways = self.cell.kinematics, self._straight(grasp)
        flange, (parts, _) = self.flanges(grasp[None], twin=twin)[0], ways.parts
        found, off = kinematics.solutions(flange, self.cell.now)
        met, broken = None, False
        for joints in found:
            way = kinematics.way(joints, flange, ways)
            if way is None:
                broken = True
                continue
            hit = self._hit(way, parts)
            if hit is None:
                return None
            met = met or hit
        if met is not None:
            return met
        free, farther = kinematics.solutions(flange, self.cell.now, within_limits=False)
        if not len(free):
            return Obstruction("too_far", farther)
        nearest = self._least_beyond(free)
        ends = (kinematics.way(joints, flange, ways, within_limits=False) for joints in free)
        if broken and all(way is None for way in ends):
            return Obstruction("singular", 0.0, joints=nearest)
        return Obstruction("joint_limit", 0.0 if broken else off, joints=nearest)

    def _hit(self, way: Floats, grasp: int) -> Obstruction | None:
        """The first collision along a way."""
        own = {solid.link for solid in self._collisions.solids}
        for step, joints in enumerate(way):
            met = self._collisions.which(joints, lifted=step > grasp)
            if met is not None:
                reason: Reason = "self_collision" if met[1] in own else "collision"
                return Obstruction(reason, 0.0, *met, joints, step > grasp)
        return None

    def colliding(self, met: Obstruction) -> list[tuple[str, str]]:
        """All links that collide where a grasp fails, each with what it meets."""
        if met.link is None or met.joints is None:
            return []
        return self._collisions.all_hits(met.joints, lifted=met.lifted)

    def _least_beyond(self, free: Floats) -> Floats:
        """Of joints (m, n), turned back by whole turns, those that are least beyond limits."""
        arm = self.cell.kinematics.arm
        turns = np.round((free - arm.middle) / (2 * math.pi))
        near = np.where(arm.sliding, free, free - 2 * math.pi * turns)
        beyond = np.maximum(np.maximum(arm.lower - near, near - arm.upper), 0.0)
        return np.asarray(near[int(np.argmin(beyond.sum(axis=1)))])
