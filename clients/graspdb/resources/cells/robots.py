"""Robots: arms by their URDFs."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from graspdb import wire
from graspdb.files.robots import zipped_robot
from graspdb.poses import pose_documents
from graspdb.resources.cells.shapes import RobotShape
from graspdb.resources.pages import Listing, Resource, segment, validate
from graspdb.wire.cells.robots import URDF, ZIP


class Robots(Resource):
    """``db.robots``: arms whose reach a best grasp keeps to."""

    def put(
        self,
        id: str,
        urdf: str | os.PathLike[str] | bytes,
        *,
        flange: str,
        meshes: str | os.PathLike[str] | None = None,
        gripper_mount: ArrayLike | Any | None = None,
    ) -> wire.RobotInfo:
        """Store a robot, or replace it: a URDF file, sent with the meshes of its collision shapes.

        ``flange`` is the link that the gripper is mounted on. Meshes are looked for in the folder ``meshes``,
        by default that of the URDF and the one above; a warning names those that are not there, whose links
        are not tested for collisions then. ``urdf`` may be the bytes of a URDF, too, or of a zip of one and
        its meshes. ``gripper_mount`` is the pose of the gripper's base in the flange link, (4, 4) or
        ``x y z qx qy qz qw``; by default what the gripper's ``flange`` frame says.
        """
        if isinstance(urdf, bytes):
            content, media_type = urdf, ZIP if urdf.startswith(b"PK") else URDF
        else:
            content, missing = zipped_robot(Path(urdf), () if meshes is None else (Path(meshes),))
            media_type = ZIP
            if missing:
                told = f"not sent, for they are not there or of no known kind: {', '.join(missing)}"
                warnings.warn(told, stacklevel=2)
        path = f"{self._path}/{segment(id)}"
        headers = {"Content-Type": media_type}
        stored = self._transport.model(
            wire.RobotInfo, "PUT", path, params={"flange": flange}, content=content, headers=headers
        )
        return stored if gripper_mount is None else self.update(id, gripper_mount=gripper_mount)

    def get(self, id: str) -> wire.RobotInfo:
        """The robot with this id: joints with their limits, links, and which of them are tested."""
        return self._transport.model(wire.RobotInfo, "GET", f"{self._path}/{segment(id)}")

    def shape(self, id: str) -> RobotShape:
        """What draws the arm, and where its links are: ``shape.frames(joints)``."""
        path = f"{self._path}/{segment(id)}/shape"
        return RobotShape(self._transport.model(wire.RobotShape, "GET", path))

    def description(self, id: str) -> bytes:
        """The URDF, or the zip of it and its meshes, as it was sent."""
        return self._transport.request("GET", f"{self._path}/{segment(id)}/description").content

    def update(
        self, id: str, *, gripper_mount: ArrayLike | Any | None = None, name: str | None = None
    ) -> wire.RobotInfo:
        """Change where the gripper's base is in the flange link, (4, 4) or ``x y z qx qy qz qw``, or the
        name; None leaves either as it is.
        """
        fields: dict[str, Any] = {} if name is None else {"name": name}
        if gripper_mount is not None:
            fields |= pose_documents({"gripper_mount": gripper_mount})
        request = validate(wire.RobotUpdate, fields)
        path = f"{self._path}/{segment(id)}"
        return self._transport.model(wire.RobotInfo, "PATCH", path, body=request)

    def delete(self, id: str) -> None:
        """Delete a robot."""
        self._transport.request("DELETE", f"{self._path}/{segment(id)}")

    def list(self) -> Iterator[wire.RobotInfo]:
        """All robots."""
        return iter(Listing(self._transport, self._path, wire.RobotInfo))

    def __iter__(self) -> Iterator[wire.RobotInfo]:
        return self.list()
