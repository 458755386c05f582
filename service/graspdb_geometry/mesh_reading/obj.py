"""Wavefront OBJ: vertices and faces; materials, lines and curves are ignored."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from graspdb_geometry.mesh_reading.content import (
    FileContent,
    FloatArray,
    FormatError,
    Geometry,
    as_text,
    check_limit,
    numbers,
)
from graspdb_geometry.mesh_reading.polygons import triangles_of

_FREE_FORM = re.compile(rb"^[ \t]*(?:curv2?|surf)\b", re.M)


def read_obj(data: bytes, max_triangles: int) -> FileContent:
    """Read the vertices and the faces, polygons of any shape, of an OBJ."""
    text = as_text(data)
    if b"\0" in text:
        raise FormatError("this is not OBJ, which is text")
    coordinates: list[list[bytes]] = []
    lines_of_vertices: list[int] = []
    corners: list[int] = []
    lengths: list[int] = []
    triangles = 0
    for number, line in _lines(text):
        words = line.split()
        if not words:
            continue
        keyword = words[0].lower()
        try:
            if keyword == b"v":
                if len(words) < 4:
                    raise IndexError
                coordinates.append(words[1:4])
                lines_of_vertices.append(number)
            elif keyword in (b"f", b"fo"):
                face = [_corner(word, len(coordinates)) for word in words[1:]]
                if len(face) < 3:
                    raise IndexError
                corners += face
                lengths.append(len(face))
                triangles += len(face) - 2
        except (ValueError, IndexError):
            raise FormatError(f"line {number} of the OBJ can't be read") from None
        if triangles > max_triangles:
            check_limit(triangles, max_triangles)
    if not coordinates or not lengths:
        raise FormatError(_without_faces(bool(coordinates), text))
    vertices = _vertices(coordinates, lines_of_vertices)
    return FileContent([Geometry(vertices, triangles_of(vertices, corners, np.array(lengths)))])


def _lines(text: bytes) -> Iterator[tuple[int, bytes]]:
    """Lines with their numbers, without comments; a backslash at the end goes on in the next line."""
    continued: list[bytes] = []
    number = 0
    for number, whole in enumerate(text.split(b"\n"), start=1):
        line = whole.partition(b"#")[0].rstrip()
        if line.endswith(b"\\"):
            continued.append(line[:-1])
        else:
            yield number, b" ".join([*continued, line])
            continued = []
    yield number, b" ".join(continued)


def _corner(word: bytes, vertices: int) -> int:
    """A corner's vertex from 0 on; counted from 1, or backwards from the last one so far."""
    number = int(word.split(b"/", 1)[0])
    if number == 0:
        raise ValueError
    if number > 0:
        return number - 1
    # Never -1: NumPy would take it for the last vertex.
    return vertices + number if vertices + number >= 0 else 2**62


def _vertices(coordinates: list[list[bytes]], lines: list[int]) -> FloatArray:
    try:
        return numbers([word for triple in coordinates for word in triple]).reshape(-1, 3)
    except ValueError:
        for number, triple in zip(lines, coordinates, strict=True):
            try:
                numbers(triple)
            except ValueError:
                raise FormatError(f"line {number} of the OBJ can't be read") from None
        raise


def _without_faces(has_vertices: bool, text: bytes) -> str:
    if has_vertices and _FREE_FORM.search(text):
        return "this is not OBJ with faces but with curves or surfaces: export it as a polygon mesh"
    if has_vertices:
        return "this is not OBJ with faces ('f') but a cloud of points: make a surface of it first"
    return "this is not OBJ with vertices ('v') and faces ('f')"
