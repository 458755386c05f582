"""Parallel-jaw grippers as the service, the collision test and the physics see them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any, ClassVar

from pydantic import Field, ValidationInfo, field_validator, model_validator

from graspdb.wire.base import Pose, Request, Response, Slug, Text
from graspdb.wire.frames.conventions import Convention
from graspdb.wire.frames.gripper_frames import BASE, NAMED, TOOL, FrameName, completed, in_tool

SHAPE_FIELDS = ("max_opening_m", "finger.", "tip_offset", "palm_size_m")
"""What the fields of a profile that make the gripper's shape begin with."""

MAX_TIP_OFFSETS = 64
"""Most openings at which a profile says where its tips are."""

Length = Annotated[float, Field(ge=1e-4, le=2.0)]


class Finger(Request):
    """One finger, a box with edges along the axes of the tool frame."""

    width_m: Length
    """Edge along the tool's x axis, metres."""
    thickness_m: Length
    """Edge along the tool's y axis, in which fingers close, metres."""
    length_m: Length
    """Edge along the tool's z axis, from the palm to the tip, metres."""


JointName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9._/-]{0,127}$")]
"""The name of a joint as a robot's description has it."""
JointValue = Annotated[float, Field(ge=-1_000.0, le=1_000.0)]


class JointValues(Request):
    """Where a joint of the gripper stands when the jaw is wide open and when it is closed."""

    open: JointValue
    """Value with the jaw at ``max_opening_m``: radians, or metres for one that slides."""
    closed: JointValue
    """Value with the fingers together: radians, or metres for one that slides."""


class TipOffset(Request):
    """Where the fingertips are at one opening, of fingers whose tips move on arcs."""

    opening_m: Annotated[float, Field(ge=0, le=2.0)]
    """Distance between the fingers' inner faces, metres; below ``max_opening_m``."""
    tip_offset_m: Annotated[float, Field(ge=0, le=2.0)]
    """Distance from the tool's origin to the fingertips along the tool's z axis at that opening, metres."""


class GripperProfile(Request):
    """A parallel-jaw gripper. Tool frame: origin midway between the fingers, z approach, y closing."""

    not_yet: ClassVar[Mapping[str, str]] = {
        r"suction|vacuum|\bcup|_cup|ejector|^fingers$|finger_count|num(ber)?_(of_)?fingers|thumb|^dofs?$": (
            "a gripper is a jaw of two fingers that close on each other: suction cups and hands with more"
            " fingers can't be described yet"
        )
    }

    max_opening_m: Length
    """Distance between the fingers' inner faces when wide open, metres."""
    finger: Finger
    """The box that each of the two fingers is."""
    tip_offset_m: Annotated[float, Field(ge=0, le=2.0)] = 0.0
    """Distance from the tool's origin to the fingertips along the tool's z axis, metres; of the wide-open jaw
    where ``tip_offsets`` says that it changes."""
    tip_offsets: Annotated[list[TipOffset], Field(max_length=MAX_TIP_OFFSETS)] = Field(default_factory=list)
    """Where the tips move on arcs: how far ahead they are at smaller openings, ascending, linear in between
    and up to ``tip_offset_m`` at ``max_opening_m``; a finger's box begins at the palm throughout. By default
    none: the fingers move straight."""
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
    frames: Annotated[dict[FrameName, Pose], NAMED] = Field(default_factory=dict)
    """Frames of the gripper by name, each its pose in the gripper's base frame: ``flange``, where the robot
    ends, and any of your own. Answers have ``base``, the identity, and ``tool``, the same as
    ``base_to_tool``, too; of the others poses can be taken and given once the tool is known. ``world`` and
    ``object`` are no names of frames."""
    joints: Annotated[dict[JointName, JointValues], NAMED] = Field(default_factory=dict)
    """The gripper's joints by name, as the robot's description has them, each with its value open and
    closed."""
    source: Text | None = None
    """Where these values are from, such as a data sheet or a URDF; null if nobody said."""
    unverified: Annotated[list[Text], Field(max_length=100)] = Field(default_factory=list)
    """Which of them nobody has verified, a field and why each; by default none is named."""

    @field_validator("frames")
    @classmethod
    def _agreeing(cls, frames: dict[str, Pose], info: ValidationInfo) -> dict[str, Pose]:
        return completed(frames, info.data.get("base_to_tool"))

    @model_validator(mode="after")
    def _completed(self) -> GripperProfile:
        # What says the same stands in both places, whichever was given.
        frames = completed(self.frames, self.base_to_tool)
        object.__setattr__(self, "frames", frames)
        object.__setattr__(self, "base_to_tool", frames.get(TOOL))
        return self

    def in_tool(self, frame: str, convention: Convention = "graspdb") -> Pose:
        """Pose of a frame of the gripper, with the axes that a convention says, in the tool frame.

        NoSuchFrame; ToolUnknown where no other frame than the tool can be used.
        """
        return in_tool(self.frames, frame, convention)

    def differences(self, other: GripperProfile) -> list[str]:
        """Fields in which two profiles differ by more than rounding, as in ``finger.length_m``."""
        own, others = self._values(), other._values()
        return sorted(
            name for name in own.keys() | others.keys() if not _alike(own.get(name), others.get(name))
        )

    def _values(self) -> dict[str, Any]:
        """All that can differ, by names such as ``finger.length_m`` and ``frames.flange``."""
        values = {name: value for name, value in self if name not in ("finger", "frames", "joints")}
        values |= {f"finger.{name}": value for name, value in self.finger}
        values |= {f"frames.{name}": pose for name, pose in self.frames.items() if name not in (BASE, TOOL)}
        return values | {f"joints.{name}": (at.open, at.closed) for name, at in self.joints.items()}


def _alike(one: Any, other: Any) -> bool:
    if isinstance(one, Pose) and isinstance(other, Pose):
        one, other = (pose.position + pose.quaternion_xyzw for pose in (one, other))
    if isinstance(one, tuple) and isinstance(other, tuple):
        return all(map(_alike, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
    return bool(one == other)


_FARTHEST_M = 2.0
#: So far beyond the fingertips the base or the flange may seem to lie: nobody measures better.
_AHEAD_M = 0.005
#: No joint of a jaw turns or slides so far; radians or metres.
_JOINT = 10.0


class GivenProfile(GripperProfile):
    """A profile as it is given: what is stored is not judged again."""

    @model_validator(mode="after")
    def _in_metres(self) -> GivenProfile:
        for name, pose in self.frames.items():
            off = math.hypot(*pose.position)
            if off > _FARTHEST_M:
                field = "base_to_tool" if name == TOOL else f"frames.{name}"
                raise ValueError(
                    f"{field} is {off:g} m from the gripper's base, which is no gripper's: positions are in"
                    " metres, so divide millimetres by 1,000"
                )
        return self

    @model_validator(mode="after")
    def _behind_the_fingertips(self) -> GivenProfile:
        tips = max([self.tip_offset_m, *(at.tip_offset_m for at in self.tip_offsets)])
        for name, field in ((BASE, "base_to_tool"), ("flange", "frames.flange")):
            if TOOL not in self.frames or name not in self.frames:
                continue
            ahead = self.in_tool(name).position[2] - tips
            if ahead > _AHEAD_M:
                raise ValueError(
                    f"{field} puts the gripper's {name} {1e3 * ahead:.0f} mm ahead of its fingertips, where"
                    " the object is: is the quaternion x, y, z, w, and the pose not its inverse?"
                )
        return self

    @model_validator(mode="after")
    def _in_radians_or_metres(self) -> GivenProfile:
        for name, at in self.joints.items():
            for state, value in at:
                if abs(value) > _JOINT:
                    raise ValueError(
                        f"joints.{name}.{state} is {value:g}, which no jaw's is: joints are in radians or"
                        " metres, as the URDF has them, so divide millimetres by 1,000"
                    )
        return self


class GripperCreate(GivenProfile):
    """A gripper to store: its profile under an id."""

    id: Slug
    """Id of the gripper, by which trials and sweeps name it."""
    name: Text | None = None
    """A name for people; null for none."""


class GripperUpdate(GivenProfile):
    """A gripper's profile from now on: all of it, where a field left out takes its default."""

    id: Slug | None = None
    """Id of the gripper once more, as in the path; null to leave it out."""
    name: Text | None = None
    """A name for people; by default the one it has."""


class GripperInfo(Response):
    """A stored gripper, its profile that of one version."""

    id: str
    """Id of the gripper, by which trials and sweeps name it."""
    name: str | None = None
    """A name for people; null where it has none."""
    profile: GripperProfile
    """Its measures, force and friction."""
    builtin: bool
    """Whether GraspDB brought it along."""
    created_at: datetime
    """When the gripper was first stored, UTC."""
    version: int = 1
    """Which version this profile is, counted from 1: ``panda@1`` names the first of ``panda``."""
    newest_version: int = 1
    """The version that the id alone stands for."""
    version_created_at: datetime | None = None
    """When this version was stored, UTC; null from services that keep none."""
    changed: list[str] = Field(default_factory=list)
    """Fields of the profile in which this version differs from the one before, as in ``finger.length_m``."""
