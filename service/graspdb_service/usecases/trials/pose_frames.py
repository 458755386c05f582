"""Which frame of a gripper poses come and go in: the service's own are of the tool."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graspdb.wire import Convention, GripperProfile, Pose
from graspdb.wire.frames.gripper_frames import TOOL, NoSuchFrame, ToolUnknown, compose, in_tool, inverse
from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_service.problems import conflict, invalid
from graspdb_service.usecases.trials.selection import Selected

#: Frames turned less than this against the tool have its axes, radians.
_ALIGNED = 1e-3


@dataclass(frozen=True, eq=False)
class PoseFrame:
    """A frame of a gripper with the axes of a convention; ``fixed`` is its pose in the tool frame, None where
    it is the tool frame itself.
    """

    frame: str = TOOL
    convention: Convention = "graspdb"
    fixed: Pose | None = None
    warnings: Sequence[str] = ()

    def to_tool(self, poses: Poses) -> Poses:
        """Poses (n,) of this frame as those of the tool."""
        return poses if self.fixed is None else _followed(poses, inverse(self.fixed))

    def from_tool(self, poses: Poses) -> Poses:
        """Poses (n,) of the tool as those of this frame."""
        return poses if self.fixed is None else _followed(poses, self.fixed)

    def one_from_tool(self, pose: Pose) -> Pose:
        """As :meth:`from_tool`, of one alone, which is faster so."""
        return pose if self.fixed is None else compose(pose, self.fixed)

    def told(self) -> dict[str, Any]:
        """What an answer says of its poses."""
        fixed = None if self.fixed is None else self.fixed.model_dump()
        return {"frame": self.frame, "convention": self.convention, "tool_to_frame": fixed}


def frame_of(selected: Selected, frame: str | None, convention: Convention | None) -> PoseFrame:
    """The frame that a question asks for, of the gripper of its selection: refused as :func:`pose_frame`."""
    return pose_frame(frame, convention, selected.profile, selected.gripper)


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
            turned = named != TOOL and axes != "graspdb" and _angle(profile.in_tool(named)) > _ALIGNED
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
            f"convention={axes} renames the axes of {named!r}, which are turned against the tool's: name a"
            " frame with the tool's axes there (frames of the gripper) if those are meant"
        ]
    return PoseFrame(named, axes, fixed, warnings)


def _id(gripper: str | None) -> str:
    return "{gripper}" if gripper is None else gripper.partition("@")[0]


def _angle(pose: Pose) -> float:
    x, y, z, w = pose.quaternion_xyzw
    return 2.0 * math.atan2(math.hypot(x, y, z), abs(w))


def _followed(poses: Poses, fixed: Pose) -> Poses:
    right = Poses(np.array(fixed.position), np.array(fixed.quaternion_xyzw))
    p, q = se3.compose(poses, right)
    return Poses(p, se3.canonical(q))
