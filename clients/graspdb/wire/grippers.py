"""Parallel-jaw grippers as the service, the collision test and the physics see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import Field

from graspdb.wire.base import Pose, Request, Response, Slug, Text

Length = Annotated[float, Field(ge=1e-4, le=2.0)]


class Finger(Request):
    """One finger, a box: ``width_m`` along the tool's x, ``thickness_m`` along y, ``length_m`` along z."""

    width_m: Length
    thickness_m: Length
    length_m: Length


class GripperProfile(Request):
    """A parallel-jaw gripper. Tool frame: origin midway between the fingers, z approach, y closing.

    ``tip_offset_m`` is the distance from the tool origin to the fingertips along z; ``palm_size_m`` the
    box directly behind the fingers; ``base_to_tool`` the tool frame in the gripper's base frame.
    """

    max_opening_m: Length
    finger: Finger
    tip_offset_m: Annotated[float, Field(ge=0, le=2.0)] = 0.0
    palm_size_m: tuple[Length, Length, Length]
    finger_mass_kg: Annotated[float, Field(gt=0, le=100)] = 0.1
    max_speed_m_s: Annotated[float, Field(gt=0, le=10)] = 0.06
    max_acceleration_m_s2: Annotated[float, Field(gt=0, le=1_000)] | None = None
    force_n: Annotated[float, Field(gt=0, le=10_000)] = 40.0
    friction: Annotated[float, Field(gt=0, le=5)] = 0.4
    symmetric: bool = True
    base_to_tool: Pose | None = None


class GripperCreate(GripperProfile):
    id: Slug
    name: Text | None = None


class GripperInfo(Response):
    id: str
    name: str | None = None
    profile: GripperProfile
    builtin: bool
    created_at: datetime
