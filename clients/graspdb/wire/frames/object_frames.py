"""The frames of an object: its mesh's, which all poses are in, and those of whoever tracks it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import AfterValidator

from graspdb.wire.base import Pose
from graspdb.wire.frames.gripper_frames import (
    IDENTITY,
    NAMED,
    RESERVED,
    FrameName,
    NoSuchFrame,
    compose,
    inverse,
    same,
)

MESH = "mesh"


def _others(frames: dict[str, Pose]) -> dict[str, Pose]:
    for name in RESERVED:
        if name in frames:
            raise ValueError(f"{name!r} is reserved, as that of a reference: choose another name")
    if MESH in frames and not same(frames[MESH], IDENTITY):
        raise ValueError(
            "frames are poses in the mesh's, so that of mesh itself is the identity: leave it out"
        )
    return {name: pose for name, pose in frames.items() if name != MESH}


ObjectFrames = Annotated[
    dict[FrameName, Pose],
    NAMED,
    AfterValidator(_others),
]
"""Frames by name, each its pose in the mesh's frame."""


def mesh_placed(object_pose: Pose, frames: Mapping[str, Pose], frame: str) -> Pose:
    """Where the mesh's frame is when another of the object is at a pose; NoSuchFrame names what there is."""
    if frame == MESH:
        return object_pose
    if frame not in frames:
        there_are = ", ".join([MESH, *frames])
        raise NoSuchFrame(f"the object has no frame {frame!r}; it has {there_are}")
    return compose(object_pose, inverse(frames[frame]))
