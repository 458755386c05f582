"""Robots: an arm by its URDF, where the gripper is mounted, and how the arm takes a grasp."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field

from graspdb.wire.base import Pose, Request, Response, Text, Triple

URDF, ZIP = "application/xml", "application/zip"
"""Media types of a robot: its URDF alone, or zipped with the meshes that it names."""
MAX_JOINTS = 12
"""Most joints from a robot's root to its flange."""

JointNumber = Annotated[float, Field(ge=-1_000.0, le=1_000.0)]


class RobotJoint(Response):
    """A joint between a robot's root and its flange."""

    name: str
    """Name of the joint, as the URDF has it."""
    lower: float | None = None
    """Lower limit along or about the axis of the joint's frame, radians, or metres of one that slides; null
    for one that turns on without end."""
    upper: float | None = None
    """Upper limit along or about the axis of the joint's frame, radians, or metres of one that slides; null
    for one that turns on without end."""
    sliding: bool = False
    """Whether it slides: its values are metres."""


class RobotInfo(Response):
    """A stored robot: the arm from the root of its URDF to its flange."""

    id: str
    """Id of the robot, by which questions name it."""
    name: str
    """The robot's name in its URDF."""
    flange: str
    """The link that the gripper is mounted on; what hangs at it in the URDF is left out."""
    joints: list[RobotJoint]
    """The joints from the root to the flange: joint values come and go in this order. Others of the URDF
    stay at zero."""
    links: list[str]
    """The links from the root to the flange."""
    tested: list[str] = Field(default_factory=list)
    """Links that are tested for collisions, by the convex hulls of their collision shapes."""
    untested: list[str] = Field(default_factory=list)
    """Links with a shape that could not be read, such as a mesh that did not come along: they, or that part
    of them, are not tested for collisions."""
    gripper_mount: Pose | None = None
    """Pose of the gripper's base in the flange link, metres and a unit quaternion; null where the gripper's
    own ``flange`` frame says it, or else the two are one."""
    sha256: str
    """SHA-256 of what was sent."""
    created_at: datetime
    """When it was first stored, UTC."""
    updated_at: datetime
    """When it was last changed, UTC."""


class ChainJoint(Response):
    """A joint of a robot's chain: where it is, and how it moves what comes after it."""

    name: str
    """Name of the joint, as the URDF has it."""
    placement: Pose
    """Its frame at zero in the frame of the joint before it, of the first in the root link; metres and a unit
    quaternion."""
    axis: Triple
    """Unit axis that it turns about, or slides along, in its own frame."""
    sliding: bool = False
    """Whether it slides: its values are metres."""


class RobotSolid(Response):
    """A convex solid of a link, as it is tested for collisions."""

    link: str
    """Name of the link that it belongs to."""
    joint: int
    """How many joints of the chain move it: its frame is that of the last of these, or for 0 the root link's.
    """
    vertices: list[Triple]
    """Corners, metres, in the frame of that joint, rounded to micrometres."""
    faces: list[tuple[int, int, int]]
    """Triangles by the numbers of their vertices, counter-clockwise from outside."""


class RobotShape(Response):
    """What is needed to draw a robot's arm at any joint values, root to flange."""

    joints: list[ChainJoint]
    """The chain from the root to the flange, in the order of joint values."""
    flange: Pose
    """The flange link in the frame of the last joint, metres and a unit quaternion."""
    solids: list[RobotSolid]
    """What is tested for collisions: a link whose shape could not be read is not there."""


class RobotUpdate(Request):
    """What of a robot may be changed beside its URDF."""

    gripper_mount: Pose | None = None
    """Pose of the gripper's base in the flange link, metres and a unit quaternion; null for what the
    gripper's ``flange`` frame says, or else the identity."""
    name: Text | None = None
    """A name for people; by default the one it has."""


class GraspJoints(Response):
    """Joint values for a grasp, in the order of the robot's joints, radians and metres."""

    pregrasp: list[float] | None = None
    """Before the straight approach; null without ``pregrasp_distance_m``."""
    grasp: list[float]
    """At the grasp."""
    lift: list[float] | None = None
    """Lifted straight up; null without ``lift_m``."""


class LinkCollision(Response):
    """A link that collides, and what it meets."""

    link: str
    """The link that collides, or ``gripper``."""
    other: str
    """Another link, ``object``, ``points``, or an obstacle as it stands in the request or the scene, such as
    ``scene.boxes.0``."""


class RobotReach(Response):
    """Why a robot's arm takes none of the grasps, told of the one that it came nearest to."""

    reason: Literal["too_far", "joint_limit", "singular", "self_collision", "collision"]
    """``too_far``: out of reach, whatever the limits; ``joint_limit``: only beyond a joint's limit;
    ``singular``: no straight approach or lift leads there; or what collides."""
    link: str | None = None
    """The link that collides, or ``gripper``; null where none does."""
    other: str | None = None
    """What it collides with: another link, ``object``, or an obstacle as it stands in the request, such as
    ``obstacles.boxes.0``; null where nothing collides."""
    colliding: list[LinkCollision] = Field(default_factory=list)
    """All that collide at ``joints``, the first being ``link`` with ``other``; empty where nothing does."""
    joints: list[float] | None = None
    """Joint values at which it fails, in the robot's order, radians and metres: where the link collides, on
    the approach, at the grasp or on the lift, or at the grasp beyond a limit or singular; null where it is
    too far."""
    off_m: float = 0.0
    """How far off the arm stays, metres, with a radian counted as 0.3 m; 0 where it gets there."""
    nearest_base_pose: Pose | None = None
    """The nearest of some places around for the robot's root, in the world, turned as it is, from which the
    arm takes a grasp; null where none was found."""
    tested: int = 0
    """How many grasps the arm was tested with."""
