"""Conventions: along which of a pose's axes a gripper approaches and closes.

The tool's are z and y. A pose that comes with the axes of another convention becomes one with the tool's by a
fixed rotation on the right, :func:`to_graspdb`, and goes back by its transpose; origins stay where they are.
A convention says the axes whatever frame's origin a pose has, but for those of :data:`OWN_AXES`.
"""

from __future__ import annotations

from functools import cache
from typing import Literal, get_args

from graspdb.wire.base import Quadruple, Triple, rotation_to_quaternion

Convention = Literal["graspdb", "acronym", "graspgen", "graspnet", "vgn", "moveit"]
"""Whose axes a pose has."""

CONVENTIONS: tuple[Convention, ...] = get_args(Convention)

APPROACH_AND_CLOSING: dict[Convention, str] = {
    "graspdb": "zy",
    "acronym": "zx",
    "graspgen": "zx",
    "graspnet": "xy",
    "vgn": "zy",
    # Of MoveIt Grasps; the message itself says nothing of axes.
    "moveit": "zy",
}
"""The axis of approach and that in which the fingers close, of each convention; in the tool frame."""

OWN_AXES: tuple[Convention, ...] = ("graspdb", "moveit")
"""Conventions that leave each frame its own axes, as the gripper's profile has them."""

Rotation = tuple[Triple, Triple, Triple]


def to_graspdb(convention: Convention) -> Rotation:
    """The rotation R, 3x3 by rows, that makes a pose T of this convention's axes one of GraspDB's: T R.

    Its columns are GraspDB's axes x, y, z in those of the convention.
    """
    z, y = (_unit("xyz".index(axis)) for axis in APPROACH_AND_CLOSING[convention])
    x = (y[1] * z[2] - y[2] * z[1], y[2] * z[0] - y[0] * z[2], y[0] * z[1] - y[1] * z[0])
    first, second, third = zip(x, y, z, strict=True)
    return first, second, third


@cache
def axes_in_graspdb(convention: Convention) -> Quadruple:
    """The unit quaternion x, y, z, w of the convention's axes in GraspDB's: the way back."""
    return rotation_to_quaternion([list(row) for row in zip(*to_graspdb(convention), strict=True)])


def _unit(index: int) -> Triple:
    return float(index == 0), float(index == 1), float(index == 2)
