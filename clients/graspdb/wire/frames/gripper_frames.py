"""The frames of a gripper: what they are called, and where each is in the tool frame.

A pose of the tool frame becomes one of another frame of the same gripper by a fixed pose on the right, which
:func:`in_tool` gives; arrays are composed with it by whoever has them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from graspdb.wire.base import Pose, Quadruple, Triple
from graspdb.wire.frames.conventions import OWN_AXES, Convention, axes_in_graspdb

FrameName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9._-]{0,63}$")]
"""The name of a frame: letters, digits, ``.``, ``_``, ``-``; at most 64 characters."""

TOOL, BASE = "tool", "base"
RESERVED = ("world", "object")
"""Names that no frame of a gripper or an object may have: they are those of references."""

MAX_FRAMES = 64
NAMED = Field(max_length=MAX_FRAMES, json_schema_extra={"additionalProperties": False})
"""A mapping by names: the schema says that there are no others than those of the names' pattern."""
IDENTITY = Pose(position=(0.0, 0.0, 0.0), quaternion_xyzw=(0.0, 0.0, 0.0, 1.0))

#: Frames given twice agree within rounding of what other programs print, metres and parts of a quaternion.
_SAME = 1e-6


class NoSuchFrame(ValueError):
    """The gripper has no frame of that name."""


class ToolUnknown(ValueError):
    """Where the tool is in the gripper's base was never told, so no other frame can be used."""


def completed(frames: Mapping[str, Pose], base_to_tool: Pose | None) -> dict[str, Pose]:
    """A gripper's frames with ``base``, and ``tool`` where it is known; ValueError for what contradicts."""
    for name in RESERVED:
        if name in frames:
            raise ValueError(f"{name!r} is reserved, as that of a reference: choose another name")
    if BASE in frames and not same(frames[BASE], IDENTITY):
        raise ValueError("frames are poses in the base, so that of base itself is the identity: leave it out")
    tool = frames.get(TOOL)
    if tool is not None and base_to_tool is not None and not same(tool, base_to_tool):
        raise ValueError("frames.tool and base_to_tool are the same pose: give one, or both alike")
    known = tool if base_to_tool is None else base_to_tool
    others = {name: pose for name, pose in frames.items() if name not in (BASE, TOOL)}
    return {BASE: IDENTITY, **({} if known is None else {TOOL: known}), **others}


def in_tool(frames: Mapping[str, Pose], frame: str, convention: Convention = "graspdb") -> Pose:
    """The pose in the tool frame of a gripper's frame, or of its origin with the axes that a convention says.

    ``frames`` are poses in the gripper's base. NoSuchFrame names those there are; ToolUnknown for any but
    ``tool`` where that is not among them.
    """
    inner = Pose(position=(0.0, 0.0, 0.0), quaternion_xyzw=axes_in_graspdb(convention))
    if frame == TOOL:
        return inner
    if frame not in frames:
        there_are = ", ".join(dict.fromkeys([BASE, TOOL, *frames]))
        raise NoSuchFrame(f"the gripper has no frame {frame!r}; it has {there_are}")
    if TOOL not in frames:
        raise ToolUnknown(f"where the tool is in the gripper's base is not known, so {frame!r} can't be used")
    own = compose(inverse(frames[TOOL]), frames[frame])
    return own if convention in OWN_AXES else _pose(own.position, inner.quaternion_xyzw)


def compose(outer: Pose, inner: Pose) -> Pose:
    """The inner pose seen from the outer's parent frame."""
    turned = _rotate(outer.quaternion_xyzw, inner.position)
    x, y, z = (a + b for a, b in zip(outer.position, turned, strict=True))
    return _pose((x, y, z), _multiply(outer.quaternion_xyzw, inner.quaternion_xyzw))


def inverse(pose: Pose) -> Pose:
    """The inverse of a rigid motion."""
    x, y, z, w = pose.quaternion_xyzw
    back = -x, -y, -z, w
    a, b, c = _rotate(back, pose.position)
    return _pose((-a, -b, -c), back)


def same(one: Pose, other: Pose) -> bool:
    """Whether two poses are alike but for rounding; ``q`` and ``-q`` are the same rotation."""
    apart = max(abs(a - b) for a, b in zip(one.position, other.position, strict=True))
    pairs = list(zip(one.quaternion_xyzw, other.quaternion_xyzw, strict=True))
    turned = min(max(abs(a - b) for a, b in pairs), max(abs(a + b) for a, b in pairs))
    return apart <= _SAME and turned <= _SAME


def _pose(position: Triple, quaternion: Quadruple) -> Pose:
    """A pose made of checked ones: it may lie farther off than any that is sent."""
    norm = math.hypot(*quaternion)
    x, y, z, w = (part / norm for part in quaternion)
    return Pose.model_construct(position=position, quaternion_xyzw=(x, y, z, w))


def _multiply(a: Quadruple, b: Quadruple) -> Quadruple:
    """Hamilton product: the rotation ``b`` followed by ``a``."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def _rotate(q: Quadruple, v: Triple) -> Triple:
    x, y, z, _ = _multiply(_multiply(q, (*v, 0.0)), (-q[0], -q[1], -q[2], q[3]))
    return x, y, z
