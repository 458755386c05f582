"""Gripper profiles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from graspdb import wire
from graspdb.resources.pages import Listing, Resource, segment, validate


class Grippers(Resource):
    """``db.grippers``: ``pg70``, ``panda`` and your own."""

    def create(self, /, id: str, *, name: str | None = None, **profile: Any) -> wire.GripperInfo:
        """Create a gripper profile; the fields are those of :class:`graspdb.wire.GripperProfile`."""
        request = validate(wire.GripperCreate, {"id": id, "name": name, **profile})
        return self._transport.model(wire.GripperInfo, "POST", self._path, body=request, idempotent=True)

    def get(self, id: str) -> wire.GripperInfo:
        """The gripper with this id."""
        return self._transport.model(wire.GripperInfo, "GET", f"{self._path}/{segment(id)}")

    def delete(self, id: str) -> None:
        """Delete a gripper; Conflict while trials, sweeps or kernels use it, and for a built-in one."""
        self._transport.request("DELETE", f"{self._path}/{segment(id)}")

    def list(self) -> Iterator[wire.GripperInfo]:
        """All grippers."""
        return iter(Listing(self._transport, self._path, wire.GripperInfo))

    def __iter__(self) -> Iterator[wire.GripperInfo]:
        return self.list()
