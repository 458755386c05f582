"""Objects, their meshes and convex parts."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import Field

from graspdb.wire.base import (
    Metadata,
    OutcomeCounts,
    Pose,
    Request,
    Response,
    Slug,
    StoredMetadata,
    Text,
    Triple,
    Warnings,
)
from graspdb.wire.frames.object_frames import ObjectFrames

Mass = Annotated[float, Field(gt=0, le=10_000)]
MassDensity = Annotated[float, Field(gt=0, le=30_000)]
Friction = Annotated[float, Field(gt=0, le=5)]


class ObjectCreate(Request):
    """An object to register."""

    id: Slug
    """Id of the object, by which routes and trials name it."""
    name: Text | None = None
    """A name for people; null for none."""
    mass_kg: Mass | None = None
    """Mass, kilograms; null if unknown, then density times volume where both are known."""
    density_kg_m3: MassDensity | None = None
    """Mass density, kg/m^3; null if unknown."""
    friction: Friction | None = None
    """Coulomb's coefficient of friction, without a unit; null if unknown, then the gripper's counts."""
    frames: ObjectFrames | None = None
    """Frames of the object by name, each its pose in the frame of its mesh, which is the object frame: where
    a tracker or a drawing has its origin, all of them. Answers have ``mesh``, the identity, too. ``world``
    and ``object`` are no names of frames; null for none."""
    metadata: Metadata | None = None
    """Any JSON object of the user's, which GraspDB keeps as it is; null for none."""


class ObjectPatch(Request):
    """What to change; a field left out stays, an explicit null clears it."""

    name: Text | None = None
    """A name for people; null for none."""
    mass_kg: Mass | None = None
    """Mass, kilograms; null if unknown."""
    density_kg_m3: MassDensity | None = None
    """Mass density, kg/m^3; null if unknown."""
    friction: Friction | None = None
    """Coulomb's coefficient of friction, without a unit; null if unknown."""
    frames: ObjectFrames | None = None
    """Frames of the object by name, each its pose in the frame of its mesh, which is the object frame: where
    a tracker or a drawing has its origin, all of them. Answers have ``mesh``, the identity, too. ``world``
    and ``object`` are no names of frames; null for none."""
    metadata: Metadata | None = None
    """Any JSON object of the user's, which replaces the one before; null for none."""


class BoundingBox(Response):
    """A box with edges along the axes of the object frame."""

    lower: Triple
    """Lowest x, y, z of the surface, object frame, metres."""
    upper: Triple
    """Highest x, y, z of the surface, object frame, metres."""


class MeshInfo(Response):
    """A checked mesh: lengths in metres whatever unit it came in."""

    sha256: str
    """SHA-256 of the file's bytes, in hexadecimal digits."""
    media_type: str
    """Format of the file as a media type."""
    unit: str
    """Unit that the file's coordinates are in: m, mm, cm or in."""
    scale: float = 1.0
    """Factor to the file's coordinates beside its unit: ``mm`` and 2 make 2 mm of a 1; without a unit."""
    bytes: int
    """Size of the file in bytes."""
    vertices: int
    """How many vertices the mesh has."""
    faces: int
    """How many triangles the mesh has."""
    bounding_box: BoundingBox
    """The smallest box about the mesh, object frame, metres."""
    volume_m3: float | None
    """Volume inside the mesh, cubic metres; null where it is not watertight."""
    watertight: bool
    """Whether the surface is closed, so that inside and outside are known."""
    convex: bool
    """Whether the mesh is its own convex hull."""
    centre_of_mass: Triple | None
    """Centre of mass at even mass density, object frame, metres; null where it is not watertight."""
    inertia_m5: list[list[float]] | None
    """3x3 inertia about the centre of mass at unit mass density, axes of the object frame, m^5: times kg/m^3
    it is kg m^2; null where the mesh is not watertight."""
    warnings: Warnings = Field(default_factory=list)


class PartsInfo(Response):
    """Convex bodies whose union is the object in physics, and in the collision test of sweeps.

    Questions test collisions against the mesh itself; where it is not watertight, the parts tell what lies
    inside of it, and where there is none, they are the object."""

    sha256: str
    """SHA-256 of the GLB's bytes, in hexadecimal digits."""
    parts: int
    """How many convex parts there are."""
    volume_m3: float
    """Sum of the parts' volumes, cubic metres."""
    bounding_box: BoundingBox
    """The smallest box about all parts, object frame, metres."""
    deviation_m: float | None = None
    """How far the parts' surface and the mesh's lie apart at most, metres, over points sampled on both; null
    without a mesh."""
    volume_share: float | None = None
    """Volume of the parts' union as a share of the mesh's, without a unit; null where that encloses none."""
    deviates: bool = False
    """Whether they lie farther off the mesh than 1 mm and 1 % of its longest side, or differ from its volume
    by more than 5 %: what sweeps tell may not hold for the mesh there, and they say so."""
    warnings: Warnings = Field(default_factory=list)


class CopyRequest(Request):
    """A copy of an object to make."""

    id: Slug
    """Id of the copy."""
    trials: bool = False
    """Whether it has all trials, too, with their batches, history and findings, and what sweeps found."""


class CopiedFrom(Response):
    """Where a copy comes from."""

    object: str
    """Id of the object that it was copied from."""
    revision: int
    """Revision of that object then."""
    takes_mesh: bool = False
    """Whether it still takes another mesh, once, though it has trials or sweeps."""
    other_mesh: bool = False
    """Whether it took one: the trials that were copied are of the mesh before."""


class ObjectInfo(Response):
    """An object, its properties, and how many trials it has."""

    id: str
    """Id of the object, by which routes and trials name it."""
    name: str | None = None
    """A name for people; null where it has none."""
    mass_kg: float | None = None
    """Mass, kilograms; null if unknown."""
    density_kg_m3: float | None = None
    """Mass density, kg/m^3; null if unknown."""
    friction: float | None = None
    """Coulomb's coefficient of friction, without a unit; null if unknown."""
    frames: dict[str, Pose] = Field(default_factory=dict)
    """Frames of the object by name, each its pose in the frame of its mesh, which is the object frame and
    always among them, as ``mesh``."""
    metadata: StoredMetadata | None = None
    """The user's own JSON object; null where there is none."""
    revision: int
    """Rises with every change of trials, mesh, parts or properties."""
    epoch: int
    """Revision of the last change that was not an append of trials."""
    mesh: MeshInfo | None = None
    """The mesh as it was checked; null where there is none."""
    convex_parts: PartsInfo | None = None
    """The convex parts; null where there are none yet."""
    copied_from: CopiedFrom | None = None
    """What it is a copy of; null for none."""
    trials: int = 0
    """How many collected trials there are, packed outcomes included."""
    outcomes: OutcomeCounts = Field(default_factory=dict)
    created_at: datetime
    """When it was registered, UTC."""
    updated_at: datetime
    """When it last changed, UTC."""
