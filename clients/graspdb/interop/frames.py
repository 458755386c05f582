"""From a file's frame and axes to the tool frame: ``tool = pose in the file, times a fixed pose``."""

from __future__ import annotations

import re
from typing import cast

import numpy as np

from graspdb.interop.grasps import Floats
from graspdb.poses import Poses, matrices
from graspdb.wire import CONVENTIONS, Convention, GripperProfile, Pose
from graspdb.wire.frames.conventions import APPROACH_AND_CLOSING, OWN_AXES

_AXES = re.compile(r"([+-]?)([xyz])/([+-]?)([xyz])")


def to_graspdb(convention: str) -> Floats:
    """The rotation (3, 3) that makes a pose of this convention one with approach z and closing y: T R.

    A name of :data:`graspdb.wire.CONVENTIONS`, or the two axes themselves, as in ``x/y`` or ``-z/x``; else
    ValueError.
    """
    named = APPROACH_AND_CLOSING.get(cast("Convention", convention))
    found = _AXES.fullmatch("/".join(named) if named else convention)
    if found is None or found[2] == found[4]:
        known = ", ".join(CONVENTIONS)
        raise ValueError(
            f"convention is {convention!r}; expected one of {known}, or the axes of approach and closing,"
            " such as x/y or -z/x"
        )
    z, y = _axis(found[1], found[2]), _axis(found[3], found[4])
    return np.stack([np.cross(y, z), y, z], axis=1)


def _axis(sign: str, letter: str) -> Floats:
    return np.asarray(np.eye(3)["xyz".index(letter)] * (-1.0 if sign == "-" else 1.0))


def frames_of(gripper: GripperProfile | None) -> dict[str, Pose]:
    """The frames of a gripper by name, poses in its base; without a gripper only ``tool`` can be meant."""
    return {} if gripper is None else gripper.frames


def to_tool(frame: str, convention: str, gripper: GripperProfile | None) -> Floats:
    """The fixed pose (4, 4) on the right of a pose of ``frame`` with the axes of ``convention``.

    As on the service: ``graspdb`` and ``moveit`` are the frame's own axes, any other says which axes of the
    pose approach and close, whatever axes the gripper's description gives the frame (ACRONYM and GraspGen say
    so of every base). ValueError, saying what to give, where the gripper lacks the frame or the way to its
    tool.
    """
    fixed = np.eye(4)
    fixed[:3, :3] = to_graspdb(convention)
    if frame == "tool":
        return fixed
    if gripper is None:
        raise ValueError(f"poses of the frame {frame!r} need the gripper's profile (gripper)")
    frames = frames_of(gripper)
    if frame not in frames:
        there = ", ".join(dict.fromkeys([*frames, "tool"]))
        raise ValueError(f"the gripper has no frame {frame!r}; it has {there} (--frame)")
    if "tool" not in frames:
        raise ValueError(
            f"where the tool is in the gripper's base is not known, so poses of {frame!r} can't be used: give"
            " its profile base_to_tool (graspdb grippers update), or poses of the tool (--frame tool)"
        )
    origin, tool = _matrix(frames[frame]), _matrix(frames["tool"])
    if convention not in OWN_AXES:
        origin[:3, :3] = tool[:3, :3]
    back: Floats = np.asarray(np.linalg.inv(origin), dtype=np.float64)
    way: Floats = fixed @ back @ tool
    return way


def _matrix(pose: Pose) -> Floats:
    return np.asarray(matrices(pose.position, pose.quaternion_xyzw), dtype=np.float64)


def follow(poses: Poses, fixed: Floats) -> Poses:
    """Poses with a fixed one (4, 4) on their right; as they are where that is the identity."""
    return poses if np.array_equal(fixed, np.eye(4)) else Poses.of(poses.matrices @ fixed)


def precede(fixed: Floats, poses: Poses) -> Poses:
    """Poses with a fixed one (4, 4) on their left."""
    return Poses.of(fixed @ poses.matrices)


def approach_of(poses: Poses) -> Floats:
    """The unit vectors (N, 3) of their z axes."""
    return poses.matrices[:, :3, 2]
