"""A robot's URDF with the meshes of its collision shapes, zipped as the service takes it."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

MESHES = (".stl", ".obj", ".ply", ".glb")
"""Endings of files that the service reads as a robot's meshes."""


def zipped_robot(urdf: Path, folders: Sequence[Path] = ()) -> tuple[bytes, list[str]]:
    """A zip of a URDF and of the meshes that its collision shapes name, and the names that were not found.

    Meshes are looked for in the folders, by default that of the URDF and the one above it, by as much of the
    end of their path as leads to a file there; nothing else is opened. ValueError for what is no XML.
    """
    xml = urdf.read_bytes()
    roots = [folder.resolve() for folder in folders or (urdf.parent, urdf.resolve().parent.parent)]
    stream, missing = io.BytesIO(), []
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{urdf.stem}.urdf", xml)
        for name in _named(xml):
            path = _found(name, roots)
            if path is None:
                missing.append(name)
            else:
                archive.write(path, _parts(name).as_posix())
    return stream.getvalue(), missing


def _named(xml: bytes) -> Iterator[str]:
    """The files that collision shapes name, each once."""
    if re.search(rb"<!\s*(DOCTYPE|ENTITY)", xml, re.IGNORECASE):
        raise ValueError("a URDF has no DOCTYPE and no entities: remove them")
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise ValueError(f"the URDF is no XML: {error}") from None
    found = (mesh.get("filename", "") for mesh in root.iterfind("link/collision/geometry/mesh"))
    yield from dict.fromkeys(name for name in found if name)


def _parts(name: str) -> PurePosixPath:
    parts = PurePosixPath(name.split("://")[-1].replace("\\", "/")).parts
    return PurePosixPath(*(part for part in parts if part not in ("/", "..", ".")))


def _found(name: str, roots: Sequence[Path]) -> Path | None:
    parts = _parts(name).parts
    if PurePosixPath(name).suffix.lower() not in MESHES:
        return None
    for first in range(len(parts)):
        for root in roots:
            path = root.joinpath(*parts[first:])
            if path.is_file() and path.resolve().is_relative_to(root):
                return path
    return None
