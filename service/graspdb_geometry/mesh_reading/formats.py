"""Readers of untrusted mesh files, from memory, by media type.

A reader trusts no count or offset in the file, opens nothing else (materials, textures and external buffers
are ignored or refused), and counts triangles before it builds them.  It returns vertices and triangles as the
file has them; `meshes` checks values, scales units and merges.
"""

from __future__ import annotations

from collections.abc import Callable

from graspdb_geometry.mesh_reading.content import FileContent
from graspdb_geometry.mesh_reading.gltf.reading import read_glb
from graspdb_geometry.mesh_reading.obj import read_obj
from graspdb_geometry.mesh_reading.ply import read_ply
from graspdb_geometry.mesh_reading.stl import read_stl

#: Reader of each accepted media type.
READERS: dict[str, Callable[[bytes, int], FileContent]] = {
    "model/stl": read_stl,
    "model/obj": read_obj,
    "model/ply": read_ply,
    "model/gltf-binary": read_glb,
}
