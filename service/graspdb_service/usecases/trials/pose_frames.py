"""Which frame of a gripper poses come and go in: the service's own are of the tool."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import Convention, GripperProfile, Pose
from graspdb.wire.base import Quadruple
from graspdb.wire.frames.conventions import OWN_AXES
from graspdb.wire.frames.gripper_frames import (
    IDENTITY,
    TOOL,
    NoSuchFrame,
    ToolUnknown,
    compose,
    in_tool,
    inverse,
)
from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_service.problems import conflict, invalid
from graspdb_service.usecases.trials.selection import Selected

#: Frames turned less than this against the tool have its axes, radians.
_ALIGNED = 1e-3
#: The tool of a grasp with the fingers exchanged, in that of the grasp.
_TWIN = Pose(position=(0.0, 0.0, 0.0), quaternion_xyzw=(0.0, 0.0, 1.0, 0.0))

NO_TWINS = (
    "near= chooses between the twins of a symmetric jaw, which this gripper's is not: it changed nothing"
)


@dataclass(frozen=True, eq=False)
class PoseFrame:
    """A frame of a gripper with the axes of a convention; ``fixed`` is its pose in the tool frame, None where
    it is the tool frame itself. ``near`` is the rotation of it, in the object frame, that of two twins the
    nearer one is wanted to; None where they are not chosen between. ``turned``: its axes are turned
    against the tool's, and the convention says others than its own.
    """

    frame: str = TOOL
    convention: Convention = "graspdb"
    fixed: Pose | None = None
    warnings: Sequence[str] = ()
    near: Quadruple | None = None
    turned: bool = False

    @property
    def is_tool(self) -> bool:
        """Whether poses are as they are kept."""
        return self.fixed is None and self.near is None

    def to_tool(self, poses: Poses) -> Poses:
        """Poses (n,) of this frame as those of the tool."""
        return poses if self.fixed is None else _followed(poses, inverse(self.fixed))

    def from_tool(self, poses: Poses) -> Poses:
        """Poses (n,) of the tool as those of this frame, each the twin that was asked for."""
        own = poses if self.fixed is None else _followed(poses, self.fixed)
        if self.near is None or not len(poses):
            return own
        twins, nearer = _followed(poses, self.twin.fixed or IDENTITY), self.exchanged(poses)[:, None]
        return Poses(
            np.where(nearer, twins.positions, own.positions),
            np.where(nearer, twins.quaternions_xyzw, own.quaternions_xyzw),
        )

    @property
    def twin(self) -> PoseFrame:
        """The same frame of the same grasp with its fingers exchanged, as one of this grasp's tool."""
        return replace(self, fixed=compose(_TWIN, self.fixed or IDENTITY), near=None)

    def exchanged(self, poses: Poses) -> NDArray[np.bool_]:
        """Of which poses (n,) of the tool the twin is nearer to what was asked for."""
        if self.near is None:
            return np.zeros(len(poses), dtype=bool)
        near = np.array(self.near)
        own, other = (
            se3.angle_between(se3.multiply(poses.quaternions_xyzw, np.array(fixed.quaternion_xyzw)), near)
            for fixed in (self.fixed or IDENTITY, self.twin.fixed or IDENTITY)
        )
        return np.asarray(other < own)

    def one_from_tool(self, pose: Pose) -> Pose:
        """As :meth:`from_tool`, of one alone, which is faster so."""
        return pose if self.fixed is None else compose(pose, self.fixed)

    def told(self) -> dict[str, Any]:
        """What an answer says of its poses."""
        fixed = None if self.fixed is None else self.fixed.model_dump()
        return {"frame": self.frame, "convention": self.convention, "tool_to_frame": fixed}


def frame_of(
    selected: Selected, frame: str | None, convention: Convention | None, near: Quadruple | None = None
) -> PoseFrame:
    """The frame that a question asks for, of the gripper of its selection: refused as :func:`pose_frame`."""
    found = pose_frame(frame, convention, selected.profile, selected.gripper)
    return with_near(found, near, symmetric=selected.jaw_symmetric)


def with_near(frame: PoseFrame, near: Quadruple | None, *, symmetric: bool) -> PoseFrame:
    """A frame with the rotation that twins are chosen by; a jaw that is not symmetric has none, and it says
    so.
    """
    if near is None or symmetric:
        return replace(frame, near=near)
    return replace(frame, warnings=[*frame.warnings, NO_TWINS])


def pose_frame(
    frame: str | None, convention: Convention | None, profile: GripperProfile | None, gripper: str | None
) -> PoseFrame:
    """A frame of a gripper; 422 for a name that it has not, 409 ``gripper-unknown`` without a gripper, and
    ``tool-unknown`` where its profile does not say where the tool is.
    """
    named, axes = frame or TOOL, convention or "graspdb"
    if named == TOOL and axes == "graspdb":
        return PoseFrame()
    if profile is None:
        if named != TOOL:
            told = f"Which gripper's frame {named!r} is meant is not known: name the gripper (gripper=)"
            raise conflict("gripper-unknown", told)
        # The tool's axes are the same whichever gripper it is.
        fixed, turned = in_tool({}, TOOL, axes), False
    else:
        try:
            fixed = profile.in_tool(named, axes)
            turned = named != TOOL and axes not in OWN_AXES and _turned(profile.in_tool(named), fixed)
        except NoSuchFrame as error:
            way_out = f"{error}: PUT /grippers/{_id(gripper)} with it in frames adds one"
            raise invalid("frame", way_out) from None
        except ToolUnknown as error:
            raise conflict(
                "tool-unknown",
                f"{str(error)[:1].upper()}{str(error)[1:]}: PUT /grippers/{_id(gripper)} with base_to_tool,"
                " the pose of the tool frame in the base, in the profile",
            ) from None
    if named == TOOL and _angle(fixed) == 0.0:
        return PoseFrame(named, axes)
    warnings = []
    if turned:
        warnings = [
            f"convention={axes} says which axes approach and close, and the own axes of {named!r}, which are"
            " turned against the tool's, are not used: leave it out if they are meant"
        ]
    return PoseFrame(named, axes, fixed, warnings, turned=turned)


def _id(gripper: str | None) -> str:
    return "{gripper}" if gripper is None else gripper.partition("@")[0]


def _turned(own: Pose, said: Pose) -> bool:
    """Whether a frame, as it is in the tool frame, is turned against it, and against what is said instead."""
    x, y, z, w = said.quaternion_xyzw
    apart = Pose.model_construct(position=(0.0, 0.0, 0.0), quaternion_xyzw=(-x, -y, -z, w))
    return _angle(own) > _ALIGNED and _angle(compose(apart, own)) > _ALIGNED


def _angle(pose: Pose) -> float:
    x, y, z, w = pose.quaternion_xyzw
    return 2.0 * math.atan2(math.hypot(x, y, z), abs(w))


def _followed(poses: Poses, fixed: Pose) -> Poses:
    right = Poses(np.array(fixed.position), np.array(fixed.quaternion_xyzw))
    p, q = se3.compose(poses, right)
    return Poses(p, se3.canonical(q))
