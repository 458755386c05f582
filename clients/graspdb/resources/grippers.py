"""Gripper profiles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from graspdb import wire
from graspdb.poses import pose_documents
from graspdb.resources.pages import Listing, Resource, segment, validate


class Grippers(Resource):
    """``db.grippers``: those that are there from the start, such as ``panda``, and your own."""

    def create(self, /, id: str, *, name: str | None = None, **profile: Any) -> wire.GripperInfo:
        """Create a gripper profile; the fields are those of :class:`graspdb.wire.GripperProfile`.

        Poses of ``base_to_tool`` and ``frames`` may be (4, 4) or ``x y z qx qy qz qw``, too.
        """
        request = validate(wire.GripperCreate, {"id": id, "name": name, **_plain(profile)})
        return self._transport.model(wire.GripperInfo, "POST", self._path, body=request, idempotent=True)

    def get(self, id: str) -> wire.GripperInfo:
        """The gripper with this id, or one version of it, as in ``panda@1``."""
        return self._transport.model(wire.GripperInfo, "GET", f"{self._path}/{segment(id)}")

    def update(self, /, id: str, *, name: str | None = None, **profile: Any) -> wire.GripperInfo:
        """Make a new version of a gripper: all its fields, as for :meth:`create`, built-in ones too.

        The id stands for it from now on; what was tried keeps its version, ``panda@1``. The same profile
        again makes none. ``name`` None leaves the name as it is.
        """
        request = validate(wire.GripperUpdate, {"name": name, **_plain(profile)})
        path = f"{self._path}/{segment(id)}"
        return self._transport.model(wire.GripperInfo, "PUT", path, body=request)

    def versions(self, id: str) -> Iterator[wire.GripperInfo]:
        """All versions of a gripper, the first one first."""
        return iter(Listing(self._transport, f"{self._path}/{segment(id)}/versions", wire.GripperInfo))

    def delete(self, id: str) -> None:
        """Delete a gripper; Conflict while trials, sweeps or kernels use it, and for a built-in one."""
        self._transport.request("DELETE", f"{self._path}/{segment(id)}")

    def list(self) -> Iterator[wire.GripperInfo]:
        """All grippers."""
        return iter(Listing(self._transport, self._path, wire.GripperInfo))

    def __iter__(self) -> Iterator[wire.GripperInfo]:
        return self.list()


def _plain(profile: dict[str, Any]) -> dict[str, Any]:
    """A profile as requests take it: its poses as such."""
    fields = dict(profile)
    if fields.get("frames") is not None:
        fields["frames"] = pose_documents(fields["frames"])
    if fields.get("base_to_tool") is not None:
        fields |= pose_documents({"base_to_tool": fields["base_to_tool"]})
    return fields
