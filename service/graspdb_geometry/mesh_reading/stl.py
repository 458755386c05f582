"""STL, binary and ASCII, as the tools of three decades write it."""

from __future__ import annotations

import re

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

_HEADER, _RECORD = 84, 50
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])

# A solid's name may hold any word, `vertex` too.
_SOLID_LINE = re.compile(rb"^[ \t]*(?:end[ \t]*)?solid\b.*?(?=\bfacet\s+normal\b|$)", re.I | re.M)
_VERTEX = re.compile(rb"\bvertex[\s,]+([^\s]+?),?\s+([^\s]+?),?\s+([^\s]+)", re.I)
_COMMAS = re.compile(rb"\bvertex\s+([^\s,]+),([^\s,]+),([^\s,]+)(?=\s)", re.I)
_END_OF_FACET = re.compile(rb"\bend[ \t]*facet\b", re.I)


def read_stl(data: bytes, max_triangles: int) -> FileContent:
    """Read binary or ASCII STL; which of them is told by the length, as some put ``solid`` before binary."""
    declared = int.from_bytes(data[80:84], "little") if len(data) >= _HEADER else 0
    if len(data) >= _HEADER and len(data) == _HEADER + _RECORD * declared:
        return _binary(data, declared, max_triangles)
    text = as_text(data)
    if b"\0" not in text and re.match(rb"\s*solid\b", text[:4096], re.I):
        return FileContent([_ascii(text, max_triangles)])
    if len(data) < _HEADER or not _is_plausible(data, declared):
        raise FormatError(
            "this is not STL: neither text starting with 'solid' nor binary of the length its header declares"
        )
    return _binary_of_another_length(data, declared, max_triangles)


def _is_plausible(data: bytes, declared: int) -> bool:
    """Whether bytes of another length than declared may still be triangles: their numbers are lengths."""
    count = (len(data) - _HEADER) // _RECORD
    if count < 1:
        return False
    some = min(count, declared or count, 1000)
    corners = np.frombuffer(data, dtype=_TRIANGLE, offset=_HEADER, count=some)["corners"]
    with np.errstate(invalid="ignore"):
        size = np.abs(corners)
        return bool(np.all((size == 0) | ((size > 1e-30) & (size < 1e9))))


def _binary_of_another_length(data: bytes, declared: int, max_triangles: int) -> FileContent:
    held, rest = divmod(len(data) - _HEADER, _RECORD)
    if declared == 0 and rest == 0:
        # Written as a stream, whose writer never came back to fill in the count.
        return _binary(data, held, max_triangles)
    if declared > held:
        raise FormatError(
            f"the STL is cut off: its header declares {declared:,} triangles and it holds {held:,}"
        )
    behind = data[_HEADER + _RECORD * declared :]
    if declared == 0 or (rest == 0 and any(behind)):
        raise FormatError(
            f"the STL's header declares {declared:,} triangles, but {held:,} would fit into the file:"
            " export it anew"
        )
    found = _binary(data, declared, max_triangles)
    return found._replace(notes=(f"{len(behind)} bytes behind the last triangle were left aside",))


def _binary(data: bytes, count: int, max_triangles: int) -> FileContent:
    check_limit(count, max_triangles)
    corners = np.frombuffer(data, dtype=_TRIANGLE, offset=_HEADER, count=count)["corners"]
    return FileContent([_soup(corners.astype(np.float64).reshape(-1, 3))])


def _ascii(text: bytes, max_triangles: int) -> Geometry:
    if not re.search(rb"\bend[ \t]*solid\b", text[-4096:], re.I):
        raise FormatError("the ASCII STL is cut off: 'endsolid' is missing")
    body = _COMMAS.sub(rb"vertex \1 \2 \3", _SOLID_LINE.sub(b"", text))
    triples = _VERTEX.findall(body)
    if len(triples) % 3 or len(triples) // 3 != len(_END_OF_FACET.findall(body)):
        raise FormatError("the ASCII STL has facets without three vertices")
    check_limit(len(triples) // 3, max_triangles)
    try:
        return _soup(numbers([word for triple in triples for word in triple]).reshape(-1, 3))
    except ValueError:
        raise FormatError("the ASCII STL has a coordinate that is not a number") from None


def _soup(corners: FloatArray) -> Geometry:
    return Geometry(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3))
