"""Scenes: what stands around, stored once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from graspdb import wire
from graspdb.poses import as_vector7
from graspdb.resources.pages import Listing, Resource, segment, validate


class Scenes(Resource):
    """``db.scenes``: what stands around, so that questions name it (``scene=``) instead of sending it."""

    def put(
        self,
        id: str,
        *,
        boxes: Sequence[Mapping[str, Any]] = (),
        points: ArrayLike | None = None,
        point_radius_m: float | None = None,
        objects: Mapping[str, ArrayLike | Any] | Sequence[tuple[str, ArrayLike | Any]] = (),
    ) -> wire.SceneSummary:
        """Store a scene, or replace it, all in the world's frame, metres.

        ``boxes`` each have ``size_m`` and a pose; ``points`` (K, 3) of a sensor stand for balls of
        ``point_radius_m``; ``objects`` are ids of objects with meshes, each with its pose, (4, 4) or
        ``x y z qx qy qz qw``.
        """
        named = objects.items() if isinstance(objects, Mapping) else objects
        fields: dict[str, Any] = {
            "boxes": list(boxes),
            "objects": [{"object": name, "pose": as_vector7(pose, "pose")} for name, pose in named],
        }
        if points is not None:
            fields["points"] = np.asarray(points, dtype=np.float64).reshape(-1, 3).tolist()
        if point_radius_m is not None:
            fields["point_radius_m"] = point_radius_m
        request = validate(wire.SceneCreate, fields)
        path = f"{self._path}/{segment(id)}"
        return self._transport.model(wire.SceneSummary, "PUT", path, body=request)

    def get(self, id: str) -> wire.SceneInfo:
        """The scene with this id, with all that stands in it."""
        return self._transport.model(wire.SceneInfo, "GET", f"{self._path}/{segment(id)}")

    def delete(self, id: str) -> None:
        """Delete a scene."""
        self._transport.request("DELETE", f"{self._path}/{segment(id)}")

    def list(self) -> Iterator[wire.SceneSummary]:
        """All scenes, without their points."""
        return iter(Listing(self._transport, self._path, wire.SceneSummary))

    def __iter__(self) -> Iterator[wire.SceneSummary]:
        return self.list()
