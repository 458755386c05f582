"""The map of a robot's reach about an object: which of many grasps its arm takes, and from where."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator
from typing_extensions import Self

from graspdb.wire.base import Pose, Response, Slug
from graspdb.wire.cells.robots import JointNumber
from graspdb.wire.queries import (
    ObjectPose,
    Obstacles,
    PoseColumns,
    PreOpeningField,
    TimeoutS,
    TrialSelection,
)

MAX_REACH_POSES, MAX_REACH_BASES, MAX_REACH_TESTS = 1_000, 400, 20_000
"""Most poses of a map, most places of the robot, and most tests of poses at places."""


class ReachRequest(TrialSelection):
    """A map of reach: the poses, and where the robot, the object and what stands around are, in the world."""

    poses: Annotated[list[Pose], Field(min_length=1, max_length=MAX_REACH_POSES)] | PoseColumns
    """Poses of the tool in the object frame, at most 1,000."""
    robot: Slug
    """Id of the stored robot whose arm is asked about."""
    object_pose: ObjectPose
    """The object frame in the world: x, y, z in metres and a unit quaternion x, y, z, w."""
    robot_base_pose: ObjectPose | None = None
    """Pose of the robot's root link in the world: x, y, z in metres and a unit quaternion x, y, z, w; null
    for the world's own frame."""
    bases: Annotated[list[ObjectPose], Field(max_length=MAX_REACH_BASES)] = Field(default_factory=list)
    """Other poses of the robot's root in the world, at most 400, and times the poses at most 20,000: from
    each the share of poses that the arm takes is told."""
    scene: Slug | None = None
    """Id of a stored scene, in the world, that must not be touched; null for none."""
    obstacles: Obstacles | None = None
    """What else must not be touched, in the world; null for nothing."""
    pre_opening_m: PreOpeningField = None
    pregrasp_distance_m: Annotated[float, Field(gt=0, le=2.0)] | None = None
    """How far back the straight approach starts, metres; null for no approach."""
    lift_m: Annotated[float, Field(gt=0, le=2.0)] | None = None
    """How far the arm lifts straight up, along the world's z, metres; null for not at all."""
    timeout_s: TimeoutS = None

    @property
    def in_world(self) -> bool:
        """That obstacles are in the world."""
        return True

    @property
    def joints_now(self) -> list[JointNumber] | None:
        """Where joints are makes nothing reachable."""
        return None

    @model_validator(mode="after")
    def _few_enough(self) -> Self:
        count = len(self.poses) if isinstance(self.poses, list) else len(self.poses.position)
        if count > MAX_REACH_POSES:
            raise ValueError(f"poses: {count:,} are more than {MAX_REACH_POSES:,}: ask in parts")
        if count * len(self.bases) > MAX_REACH_TESTS:
            raise ValueError(
                f"bases: poses times bases are more than {MAX_REACH_TESTS:,}: send fewer of either"
            )
        return self


class ReachMap(Response):
    """Which poses a robot's arm takes; columns in the poses' order. Whether the open gripper meets the object
    at them is not looked at."""

    reached: list[bool]
    """Whether the arm takes each pose, with its approach and lift, without a collision of arm or gripper with
    what stands around."""
    reason: list[Literal["too_far", "joint_limit", "singular", "self_collision", "collision"] | None]
    """Why the arm does not take it, as in the ``reach`` of best grasps; null where it does."""
    base_share: list[float]
    """Share of the poses, 0 to 1, that the arm takes from each of ``bases``."""
    warnings: list[str] = Field(default_factory=list)
    """What was not tested, for people."""
