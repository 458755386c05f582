"""What a page shows, as a value: kept in a link, so that the same view opens again."""

from __future__ import annotations

import base64
import binascii
import zlib
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

MOST_GRASPS = 20_000
MAX_TOKEN = 4_000
"""Characters of a link's view: a real one has some hundreds."""
_MAX_JSON = 20_000

Number = Annotated[float, Field(ge=-1_000.0, le=1_000.0)]
Point = tuple[Number, Number, Number]
Quaternion = tuple[Number, Number, Number, Number]
Size = Annotated[float, Field(ge=1e-4, le=100.0)]
Name = Annotated[str, Field(max_length=200)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", validate_assignment=True)


class Box(_Part):
    """Where the tool's origin may be: metres, world axes."""

    centre: Point
    size: tuple[Size, Size, Size]


class Cone(_Part):
    """Where the gripper may come from: its axis is the rotated z (unit quaternion xyzw), in the world."""

    quaternion_xyzw: Quaternion
    half_angle_deg: Annotated[float, Field(gt=0, le=180)] = 45.0


class Placed(_Part):
    """A pose in the world: metres, unit quaternion xyzw."""

    position: Point
    quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)


class Obstacle(Placed):
    """A box that the gripper must not touch."""

    size: tuple[Size, Size, Size]


class View(_Part):
    """All that a page shows, apart from what the service knows."""

    object: Name | None = None
    gripper: Name | None = None
    protocol: Name | None = None
    grasps: Literal["draws", "successes", "none"] = "draws"
    count: Annotated[int, Field(ge=1, le=MOST_GRASPS)] = 2_000
    colour: Literal["density", "success_probability"] = "density"
    drawn: Literal["jaw", "gripper", "cloud"] = "jaw"
    trials: bool = False
    trials_count: Annotated[int, Field(ge=1, le=MOST_GRASPS)] = 2_000
    trials_by: Literal["outcome", "source"] = "outcome"
    best: Annotated[int, Field(ge=0, le=20)] = 3
    objective: Literal["density", "success_probability"] = "density"
    box: Box | None = None
    cone: Cone | None = None
    obstacle: Obstacle | None = None
    object_pose: Placed | None = None
    robot: Name | None = None
    scene: Name | None = None
    robot_base: Placed | None = None
    """The robot's root in the world."""
    reach: Literal["none", "grasps", "bases"] = "none"
    pregrasp_distance_m: Annotated[float, Field(gt=0, le=2.0)] = 0.08
    lift_m: Annotated[float, Field(gt=0, le=2.0)] = 0.1
    """How far the arm backs off and lifts; asked with a robot alone."""
    camera: tuple[Point, Point] | None = None
    """Where the eye is, and what it looks at."""

    def token(self) -> str:
        """The view as a link has it: what differs from the defaults."""
        document = self.model_dump_json(exclude_defaults=True)
        return base64.urlsafe_b64encode(zlib.compress(document.encode(), 9)).decode().rstrip("=")

    @classmethod
    def of(cls, token: str) -> View:
        """The view of a link; ValueError where it is none, whoever wrote it."""
        try:
            if len(token) > MAX_TOKEN:
                raise ValueError("too long")
            packed = base64.b64decode(token + "=" * (-len(token) % 4), altchars=b"-_", validate=True)
            reader = zlib.decompressobj()
            document = reader.decompress(packed, _MAX_JSON)
            if reader.unconsumed_tail or reader.unused_data or not reader.eof:
                raise ValueError("too long, or cut")
            return cls.model_validate_json(document)
        except (ValueError, zlib.error, binascii.Error, ValidationError) as error:
            raise ValueError("this link's view can't be read: it is cut, or of another version") from error
