"""Which frame poses come and go in, as requests ask for it and answers tell it."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, Field, TypeAdapter, WithJsonSchema

from graspdb.wire.base import Quadruple, Quaternion, Response, Triple, _split_commas, _unit
from graspdb.wire.frames.conventions import Convention
from graspdb.wire.frames.gripper_frames import FrameName

ASKED_FRAME = (
    "Frame of the gripper that all poses here are of, those that are sent and those that are answered: one of"
    " its ``frames`` by name; by default ``tool``."
)
ASKED_CONVENTION = (
    "Along which of their axes these poses approach and close: ``acronym`` and ``graspgen`` along z and x,"
    " ``graspnet`` along x and y, ``vgn`` along z and y; ``graspdb`` and ``moveit`` are the own axes of"
    " ``frame``, in the tool frame z and y; by default ``graspdb``. It moves no origin."
)

ASKED_NEAR = (
    "Unit quaternion x,y,z,w: of the two poses that are one grasp for a symmetric jaw the answer gives the"
    " one whose rotation, of ``frame`` in the object frame, is nearer to this; by default that which is kept."
)

AskedFrame = Annotated[FrameName | None, Field(description=ASKED_FRAME)]
AskedConvention = Annotated[Convention | None, Field(description=ASKED_CONVENTION)]
AskedNear = Annotated[Quaternion | None, Field(description=ASKED_NEAR)]


def _near(text: Any) -> Any:
    parts = _split_commas(text)
    if not isinstance(parts, (list, tuple)) or len(parts) != 4:
        raise ValueError("a unit quaternion is four numbers x,y,z,w")
    try:
        x, y, z, w = (float(part) for part in parts)
    except ValueError:
        raise ValueError("a unit quaternion is four numbers x,y,z,w") from None
    return _unit((x, y, z, w))


NearQuery = Annotated[
    str | None,
    AfterValidator(lambda text: None if text is None else _near(text)),
    WithJsonSchema(TypeAdapter(Quaternion | None).json_schema()),
]
"""The same in a query string by itself: a unit quaternion (x, y, z, w), or None."""

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
