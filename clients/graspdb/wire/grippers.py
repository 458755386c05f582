"""Parallel-jaw grippers as the service, the collision test and the physics see them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import Field

from graspdb.wire.base import Pose, Request, Response, Slug, Text

Length = Annotated[float, Field(ge=1e-4, le=2.0)]


class Finger(Request):
    """One finger, a box with edges along the axes of the tool frame."""

    width_m: Length
    """Edge along the tool's x axis, metres."""
    thickness_m: Length
    """Edge along the tool's y axis, in which fingers close, metres."""
    length_m: Length
    """Edge along the tool's z axis, from the palm to the tip, metres."""


class GripperProfile(Request):
    """A parallel-jaw gripper. Tool frame: origin midway between the fingers, z approach, y closing."""

    max_opening_m: Length
    """Distance between the fingers' inner faces when wide open, metres."""
    finger: Finger
    """The box that each of the two fingers is."""
    tip_offset_m: Annotated[float, Field(ge=0, le=2.0)] = 0.0
    """Distance from the tool's origin to the fingertips along the tool's z axis, metres."""
    palm_size_m: tuple[Length, Length, Length]
    """Edges of the box right behind the fingers along x, y, z of the tool frame, metres."""
    finger_mass_kg: Annotated[float, Field(gt=0, le=100)] = 0.1
    """Mass of one finger in the physics, kilograms."""
    max_speed_m_s: Annotated[float, Field(gt=0, le=10)] = 0.06
    """Highest speed of each finger while closing, metres a second."""
    max_acceleration_m_s2: Annotated[float, Field(gt=0, le=1_000)] | None = None
    """Highest acceleration of each finger, metres a second squared; null for no limit."""
    force_n: Annotated[float, Field(gt=0, le=10_000)] = 40.0
    """Force that each finger presses with, newtons."""
    friction: Annotated[float, Field(gt=0, le=5)] = 0.4
    """Coulomb's coefficient of friction of the fingers' faces, without a unit."""
    symmetric: bool = True
    """Whether the fingers are alike, so that half a turn about the approach is the same grasp."""
    base_to_tool: Pose | None = None
    """Pose of the tool frame in the gripper's base frame, metres and a unit quaternion; null if unknown."""


class GripperCreate(GripperProfile):
    """A gripper to store: its profile under an id."""

    id: Slug
    """Id of the gripper, by which trials and sweeps name it."""
    name: Text | None = None
    """A name for people; null for none."""


class GripperInfo(Response):
    """A stored gripper."""

    id: str
    """Id of the gripper, by which trials and sweeps name it."""
    name: str | None = None
    """A name for people; null where it has none."""
    profile: GripperProfile
    """Its measures, force and friction."""
    builtin: bool
    """Whether GraspDB brought it along."""
    created_at: datetime
    """When it was stored, UTC."""
