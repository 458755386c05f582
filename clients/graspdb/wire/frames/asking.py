"""Which frame poses come and go in, as requests ask for it and answers tell it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from graspdb.wire.base import Quadruple, Response, Triple
from graspdb.wire.frames.conventions import Convention
from graspdb.wire.frames.gripper_frames import FrameName

ASKED_FRAME = (
    "Frame of the gripper that all poses here are of, those that are sent and those that are answered: one of"
    " its ``frames`` by name; by default ``tool``."
)
ASKED_CONVENTION = (
    "Whose axes these poses have: ``acronym`` and ``graspgen`` approach along z and close along x,"
    " ``graspnet`` along x and y, the others along z and y. It renames the axes of ``frame`` and moves no"
    " origin; by default ``graspdb``."
)

AskedFrame = Annotated[FrameName | None, Field(description=ASKED_FRAME)]
AskedConvention = Annotated[Convention | None, Field(description=ASKED_CONVENTION)]
ToldFrame = Annotated[str, Field(description="Frame of the gripper that the answer's poses are of.")]
ToldConvention = Annotated[Convention, Field(description="Whose axes the answer's poses have.")]


class FixedPose(Response):
    """The pose of one frame of a gripper in another, however far off that is."""

    position: Triple
    """Origin of the frame in the tool frame: x, y, z, metres."""
    quaternion_xyzw: Quadruple
    """Rotation of the frame in the tool frame: unit quaternion x, y, z, w."""


ToolToFrame = Annotated[
    FixedPose | None,
    Field(
        description="Pose of that frame, with the axes of that convention, in the tool frame; null where it"
        " is the tool frame itself. A pose of the tool times this is one as the answer's."
    ),
]
