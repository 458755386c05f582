"""Scenes: what stands around, stored once and named by questions."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import BeforeValidator, Field

from graspdb.wire.base import Request, Response, Slug, Vector7
from graspdb.wire.queries import Obstacles, pose_vector

MAX_SCENE_OBJECTS = 50
"""Most objects in a scene."""


class SceneObject(Request):
    """An object of the database that stands around as an obstacle."""

    object: Slug
    """Id of the object; it needs a mesh."""
    pose: Annotated[Vector7, BeforeValidator(pose_vector)]
    """Its frame in the world: x, y, z in metres and a unit quaternion x, y, z, w (a pose's object, too)."""


class SceneCreate(Obstacles):
    """What stands around, in the world's frame: boxes and points as obstacles, and objects."""

    objects: Annotated[list[SceneObject], Field(max_length=MAX_SCENE_OBJECTS)] = Field(default_factory=list)
    """Objects with meshes that must not be touched either."""


class SceneSummary(Response):
    """A stored scene without its points."""

    id: str
    """Id of the scene, by which questions name it."""
    boxes: int
    """How many boxes stand in it."""
    points: int
    """How many points of a sensor are in it, in the world's frame."""
    objects: list[str]
    """Ids of the objects in it."""
    updated_at: datetime
    """When it was stored last, UTC."""


class SceneInfo(Response):
    """A stored scene."""

    id: str
    """Id of the scene, by which questions name it."""
    scene: SceneCreate
    """What stands in it."""
    created_at: datetime
    """When it was first stored, UTC."""
    updated_at: datetime
    """When it was stored last, UTC."""
