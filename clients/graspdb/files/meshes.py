"""Meshes on their way to the service: from files, bytes or trimesh objects to bytes and a media type."""

from __future__ import annotations

import codecs
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

MeshLike = str | PathLike[str] | bytes | Any
"""A file, its bytes, or a trimesh object (a mesh or a scene)."""

_MEDIA_TYPES = {
    ".stl": "model/stl",
    ".obj": "model/obj",
    ".ply": "model/ply",
    ".glb": "model/gltf-binary",
}
GLB = "model/gltf-binary"


def read_mesh(mesh: MeshLike, media_type: str | None, *, prefer: str = "ply") -> tuple[bytes, str]:
    """The bytes and media type of a file, bytes or a trimesh object; ValueError for an unknown format."""
    if isinstance(mesh, (str, PathLike)):
        path = Path(mesh)
        kind = media_type or _MEDIA_TYPES.get(path.suffix.lower())
        if kind is None:
            raise ValueError(f"{path.name}: meshes end in {', '.join(_MEDIA_TYPES)}, or name the media_type")
        return path.read_bytes(), kind
    if isinstance(mesh, (bytes, bytearray, memoryview)):
        content = bytes(mesh)
        kind = media_type or _sniffed(content)
        if kind is None:
            raise ValueError(
                f"bytes of an unknown mesh format: give media_type, one of {set(_MEDIA_TYPES.values())}"
            )
        return content, kind
    if callable(getattr(mesh, "export", None)):
        # A scene has several geometries, which only GLB keeps apart.
        form = "glb" if hasattr(mesh, "geometry") else prefer
        exported = mesh.export(file_type=form)
        return (exported if isinstance(exported, bytes) else exported.encode()), _MEDIA_TYPES[f".{form}"]
    raise ValueError(f"a mesh is a file's name, bytes or a trimesh object, not {type(mesh).__name__}")


def _sniffed(content: bytes) -> str | None:
    if content[:4] == b"glTF":
        return GLB
    text = content.removeprefix(codecs.BOM_UTF8)
    if text[:4] in {b"ply\n", b"ply\r"}:
        return "model/ply"
    triangles = int.from_bytes(content[80:84], "little")
    solid = text.lstrip()[:6].lower()
    if solid.split() == [b"solid"] or (len(content) >= 84 and len(content) == 84 + 50 * triangles):
        return "model/stl"
    return None


def scene_of(parts: Sequence[Any]) -> Any:
    """A trimesh scene with one geometry a mesh."""
    try:
        import trimesh
    except ImportError as error:
        raise ImportError(
            "convex parts from a list of meshes need trimesh: pip install 'graspdb[examples]'"
        ) from error
    scene = trimesh.Scene()
    for number, part in enumerate(parts):
        scene.add_geometry(part, geom_name=f"part_{number:04d}", node_name=f"part_{number:04d}")
    return scene
