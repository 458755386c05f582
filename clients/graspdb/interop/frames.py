"""From a file's frame and axes to the tool frame: ``tool = pose in the file, times a fixed pose``."""

from __future__ import annotations

import re
from typing import cast

import numpy as np

from graspdb.interop.grasps import Floats
from graspdb.poses import Poses, matrices, quaternions_of
from graspdb.wire import CONVENTIONS, Convention, GripperProfile, Pose
from graspdb.wire.frames.conventions import APPROACH_AND_CLOSING

#: Conventions that are of a gripper's base.
_OF_EVERY_BASE = ("acronym", "graspgen")
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

    ACRONYM and GraspGen say of every gripper's base that z approaches and x closes, whatever axes its
    description gives that: theirs are at the base's origin along the tool's. ValueError, saying what to give,
    where the gripper lacks the frame or the way to its tool.
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
    if frame == "base" and convention in _OF_EVERY_BASE:
        origin[:3, :3] = tool[:3, :3]
    back: Floats = np.asarray(np.linalg.inv(origin), dtype=np.float64)
    way: Floats = fixed @ back @ tool
    return way


def _matrix(pose: Pose) -> Floats:
    return np.asarray(matrices(pose.position, pose.quaternion_xyzw), dtype=np.float64)


def follow(poses: Poses, fixed: Floats) -> Poses:
    """Poses with a fixed one (4, 4) on their right."""
    if np.array_equal(fixed, np.eye(4)):
        return poses
    turn = quaternions_of(fixed[None, :3, :3])[0]
    moved = poses.position + rotated(poses.quaternion_xyzw, fixed[:3, 3])
    return Poses(moved, unit(times(poses.quaternion_xyzw, turn)))


def precede(fixed: Floats, poses: Poses) -> Poses:
    """Poses with a fixed one (4, 4) on their left."""
    turn = quaternions_of(fixed[None, :3, :3])[0]
    moved = poses.position @ fixed[:3, :3].T + fixed[:3, 3]
    turns = np.broadcast_to(turn, poses.quaternion_xyzw.shape)
    return Poses(moved, unit(times(turns, poses.quaternion_xyzw)))


def rotated(quaternion_xyzw: Floats, vector: Floats) -> Floats:
    """Vectors (3,) or (N, 3) turned by unit quaternions (N, 4)."""
    axis, w = quaternion_xyzw[:, :3], quaternion_xyzw[:, 3:]
    vector = np.broadcast_to(vector, axis.shape)
    twice = 2.0 * np.cross(axis, vector)
    return np.asarray(vector + w * twice + np.cross(axis, twice))


def times(a: Floats, b: Floats) -> Floats:
    """Hamilton products (N, 4) of quaternions xyzw: the rotation b, then a."""
    ax, ay, az, aw = np.moveaxis(a, -1, 0)
    bx, by, bz, bw = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def unit(quaternions: Floats) -> Floats:
    """The same rotations by unit quaternions."""
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True))
