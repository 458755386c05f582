"""Objects, their meshes and convex parts."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import Field

from graspdb.wire.base import Metadata, Request, Response, Slug, Text, Triple

Mass = Annotated[float, Field(gt=0, le=10_000)]
MassDensity = Annotated[float, Field(gt=0, le=30_000)]
Friction = Annotated[float, Field(gt=0, le=5)]


class ObjectCreate(Request):
    id: Slug
    name: Text | None = None
    mass_kg: Mass | None = None
    density_kg_m3: MassDensity | None = None
    friction: Friction | None = None
    metadata: Metadata | None = None


class ObjectPatch(Request):
    """What to change; a field left out stays, an explicit null clears it."""

    name: Text | None = None
    mass_kg: Mass | None = None
    density_kg_m3: MassDensity | None = None
    friction: Friction | None = None
    metadata: Metadata | None = None


class BoundingBox(Response):
    """Axis-aligned, object frame, metres."""

    lower: Triple
    upper: Triple


class MeshInfo(Response):
    """A checked mesh: lengths in metres whatever unit it came in.

    ``inertia_m5`` is the inertia about the centre of mass at unit mass density, object axes; times
    kg/m^3 it is kg m^2. ``volume_m3`` and it are null where the mesh is not watertight.
    """

    sha256: str
    media_type: str
    unit: str
    bytes: int
    vertices: int
    faces: int
    bounding_box: BoundingBox
    volume_m3: float | None
    watertight: bool
    convex: bool
    centre_of_mass: Triple | None
    inertia_m5: list[list[float]] | None
    warnings: list[str] = Field(default_factory=list)


class PartsInfo(Response):
    """``volume_m3`` is the sum over the parts. ``deviation_m``: how far, in metres, the parts' surface and
    the mesh's lie apart at most, over points sampled on both; null without a mesh."""

    sha256: str
    parts: int
    volume_m3: float
    bounding_box: BoundingBox
    deviation_m: float | None = None
    warnings: list[str] = Field(default_factory=list)


class ObjectInfo(Response):
    """``outcomes`` counts every collected trial by outcome, packed ones included; ``trials`` is their sum."""

    id: str
    name: str | None = None
    mass_kg: float | None = None
    density_kg_m3: float | None = None
    friction: float | None = None
    metadata: Metadata | None = None
    revision: int
    epoch: int
    mesh: MeshInfo | None = None
    convex_parts: PartsInfo | None = None
    trials: int = 0
    outcomes: dict[str, int] = Field(default_factory=dict)
    created_at: datetime
    updated_at: datetime
