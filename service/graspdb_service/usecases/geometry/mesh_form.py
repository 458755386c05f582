"""How the bytes of a mesh are read: their format, the unit of their coordinates, and a scale beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from graspdb_geometry import meshes
from graspdb_geometry.meshes import Mesh

if TYPE_CHECKING:  # every mesh is read in a process of its own, which would import the storage for a name
    from graspdb_service.storage.objects import ObjectRow


class MeshForm(NamedTuple):
    """The same bytes in another form are another object."""

    media_type: str
    unit: str = "m"
    scale: float = 1.0

    def read(self, content: bytes) -> Mesh:
        """The mesh of bytes that were checked in a child process when they came; MeshError as there."""
        return meshes.load(content, self.media_type, self.unit, self.scale)


def form_of(row: ObjectRow) -> MeshForm:
    """The form of an object's mesh, which it has."""
    info = row.mesh_info
    assert info is not None
    # Meshes had no scale once.
    return MeshForm(str(info["media_type"]), str(info["unit"]), float(info.get("scale", 1.0)))
