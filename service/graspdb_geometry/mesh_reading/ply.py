"""PLY, ASCII and binary of either byte order: vertices, faces of any shape, triangle strips."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

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
from graspdb_geometry.mesh_reading.strips import triangles_of_strip

IntArray = npt.NDArray[np.int64]

_TYPES = (
    {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
    | {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
    | {"int64": "i8", "uint64": "u8", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
)
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_MAX_HEADER = 1 << 20
_INDICES = ("vertex_indices", "vertex_index", "vertex_indexes")


class _Property(NamedTuple):
    """A column of an element: the type of its numbers and, for a list, of their length before them."""

    name: str
    value: str
    length: str | None


class _Element(NamedTuple):
    """A kind of row, how many of them there are, and their columns in the file's order."""

    name: str
    rows: int
    columns: list[_Property]


class _Lists(NamedTuple):
    """Lists of a column, one behind the other."""

    values: npt.NDArray[np.float64]
    lengths: IntArray


def read_ply(data: bytes, max_triangles: int) -> FileContent:
    """Read vertices, faces and triangle strips of a PLY; other elements and columns are passed over."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = as_text(data)
    data = data.removeprefix(b"\xef\xbb\xbf")
    order, elements, body = _header(data)
    for element in elements:
        if element.rows > len(data):
            raise FormatError(f"the PLY declares more {element.name} than it can hold")
        if element.name == "face":
            check_limit(element.rows, max_triangles)
    names = {element.name for element in elements if element.rows}
    if "vertex" not in names:
        raise FormatError("the PLY has no vertices")
    if not names & {"face", "tristrips"}:
        raise FormatError("the PLY is a cloud of points without faces: make a surface of it first")
    columns = _ascii(elements, body) if order == "" else _binary(elements, body, order)
    vertices = _vertices(columns["vertex"])
    geometries = []
    if "face" in names:
        lists = _indices(columns["face"])
        if np.any(lists.lengths < 3):
            kept = np.repeat(lists.lengths >= 3, lists.lengths)
            lists = _Lists(lists.values[kept], lists.lengths[lists.lengths >= 3])
        check_limit(int(lists.lengths.sum()) - 2 * len(lists.lengths), max_triangles)
        corners = lists.values.astype(np.int64)
        geometries.append(Geometry(vertices, triangles_of(vertices, corners, lists.lengths)))
    if "tristrips" in names:
        lists = _indices(columns["tristrips"])
        check_limit(len(lists.values), max_triangles)
        ends = np.cumsum(lists.lengths)[:-1]
        strips = [triangles_of_strip(strip) for strip in np.split(lists.values.astype(np.int64), ends)]
        geometries.append(Geometry(vertices, np.concatenate(strips)))
    return FileContent(geometries)


# ------------------------------------------------------------------------------------------- header


def _header(data: bytes) -> tuple[str, list[_Element], bytes]:
    """Byte order (empty for text), elements and the bytes behind the header."""
    head = data[:_MAX_HEADER]
    end = re.search(rb"(?:^|[\r\n])[ \t]*end_header[ \t]*(\r\n|\n|\r)", head)
    opening = re.match(rb"ply[ \t]*(\r\n|\n|\r)", head)
    if opening is None or end is None:
        raise FormatError("this is not PLY: 'ply' at the start or 'end_header' is missing")
    # By the header's own line ends: the first byte behind it may be a line feed and belong to a number.
    behind = end.start(1) + (1 if opening[1] == b"\r" else len(end[1]))
    order: str | None = None
    elements: list[_Element] = []
    for line in re.split(r"[\r\n]+", head[: end.start(1)].decode("latin-1")):
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isascii():
            if not words[2].isdigit() or len(words[2]) > 18:
                raise FormatError(f"the PLY declares more {words[1]} than it can hold")
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            _add_property(elements, words)
    if order is None:
        raise FormatError("the PLY's header names no format that is known")
    return order, elements, data[behind:]


def _add_property(elements: list[_Element], words: list[str]) -> None:
    is_list = words[1:2] == ["list"]
    types = [_TYPES.get(word) for word in (words[2:4] if is_list else words[1:2])]
    if not elements or len(words) != (5 if is_list else 3) or None in types:
        raise FormatError(f"the PLY's header can't be read: {' '.join(words)[:80]}")
    count, value = types if is_list else (None, types[0])
    assert value is not None
    elements[-1].columns.append(_Property(words[-1], value, count))


# --------------------------------------------------------------------------------------------- body

_Columns = dict[str, FloatArray | _Lists]


def _ascii(elements: list[_Element], body: bytes) -> dict[str, _Columns]:
    words = body.split()
    found: dict[str, _Columns] = {}
    at = 0
    for element in elements:
        if all(column.length is None for column in element.columns):
            stop = at + element.rows * len(element.columns)
            table = _numbers(words, at, stop).reshape(element.rows, len(element.columns))
            found[element.name] = {c.name: table[:, k] for k, c in enumerate(element.columns)}
        else:
            found[element.name], stop = _ascii_lists(element, words, at)
        at = stop
    return found


def _ascii_lists(element: _Element, words: list[bytes], at: int) -> tuple[_Columns, int]:
    values: dict[str, list[bytes]] = {column.name: [] for column in element.columns}
    lengths: dict[str, list[int]] = {column.name: [] for column in element.columns}
    for _ in range(element.rows):
        for column in element.columns:
            count = 1
            if column.length is not None:
                if at >= len(words) or not words[at].isdigit():
                    raise _cut_off()
                count = int(words[at])
                at += 1
            if at + count > len(words):
                raise _cut_off()
            values[column.name] += words[at : at + count]
            lengths[column.name].append(count)
            at += count
    columns: _Columns = {}
    for column in element.columns:
        if column.length is None or column.name in _INDICES:
            flat = _numbers(values[column.name], 0, len(values[column.name]))
            is_list = column.length is not None
            columns[column.name] = _Lists(flat, np.array(lengths[column.name])) if is_list else flat
    return columns, at


def _numbers(words: list[bytes], start: int, stop: int) -> FloatArray:
    if stop > len(words):
        raise _cut_off()
    try:
        return numbers(words[start:stop])
    except ValueError:
        raise FormatError("the PLY has a value that is not a number") from None


def _binary(elements: list[_Element], body: bytes, order: str) -> dict[str, _Columns]:
    found: dict[str, _Columns] = {}
    at = 0
    for element in elements:
        columns, at = _binary_element(element, body, at, order)
        found[element.name] = columns
    return found


def _binary_element(element: _Element, body: bytes, at: int, order: str) -> tuple[_Columns, int]:
    """Rows as runs of equal list lengths: files have few of them, or a row each, read one by one."""
    names = [column.name for column in element.columns]
    wanted = [n for n, c in enumerate(element.columns) if c.length is None or c.name in _INDICES]
    pieces: dict[str, list[FloatArray]] = {names[n]: [] for n in wanted}
    lengths: dict[str, list[IntArray]] = {names[n]: [] for n in wanted}
    rows = element.rows
    while rows:
        layout, counts = _layout(element, body, at, order)
        if layout.itemsize == 0:
            break
        fitting = min(rows, (len(body) - at) // layout.itemsize)
        if not fitting:
            raise _cut_off()
        # The first rows tell whether it pays to look at all of them.
        run = _run(body, at, layout, counts, min(fitting, 16))
        if run == 16:
            run = _run(body, at, layout, counts, fitting)
        table = np.frombuffer(body, dtype=layout, offset=at, count=run)
        for n in wanted:
            values = table[f"v{n}"].astype(np.float64)
            pieces[names[n]].append(values.reshape(-1))
            lengths[names[n]].append(np.full(run, counts.get(n, 1), dtype=np.int64))
        at += run * layout.itemsize
        rows -= run
    columns: _Columns = {}
    for n in wanted:
        flat = np.concatenate(pieces[names[n]] or [np.empty(0)])
        is_list = element.columns[n].length is not None
        columns[names[n]] = (
            _Lists(flat, np.concatenate(lengths[names[n]] or [np.empty(0, dtype=np.int64)]))
            if is_list
            else flat
        )
    return columns, at


def _layout(element: _Element, body: bytes, at: int, order: str) -> tuple[np.dtype[np.void], dict[int, int]]:
    """The layout of the row at a place, and the lengths of its lists by column."""
    fields: list[tuple[str, str] | tuple[str, str, int]] = []
    counts: dict[int, int] = {}
    for number, column in enumerate(element.columns):
        if column.length is None:
            fields.append((f"v{number}", order + column.value))
            at += np.dtype(column.value).itemsize
            continue
        kind = np.dtype(order + column.length)
        if at + kind.itemsize > len(body):
            raise _cut_off()
        count = int(np.frombuffer(body, dtype=kind, offset=at, count=1)[0])
        at += kind.itemsize + count * np.dtype(column.value).itemsize
        if count < 0 or at > len(body):
            raise _cut_off()
        counts[number] = count
        fields += [(f"n{number}", order + column.length), (f"v{number}", order + column.value, count)]
    return np.dtype(fields), counts


def _run(body: bytes, at: int, layout: np.dtype[np.void], counts: dict[int, int], rows: int) -> int:
    """How many of the rows from a place on have lists as long as the first."""
    table = np.frombuffer(body, dtype=layout, offset=at, count=rows)
    same = np.ones(rows, dtype=np.bool_)
    for number, count in counts.items():
        same &= table[f"n{number}"] == count
    return rows if bool(same.all()) else int(np.argmin(same))


def _cut_off() -> FormatError:
    return FormatError("the PLY is cut off, or a list in it is longer than what follows")


# ------------------------------------------------------------------------------------------ columns


def _vertices(columns: _Columns) -> FloatArray:
    found = [columns.get(name) for name in ("x", "y", "z")]
    if not all(isinstance(column, np.ndarray) for column in found):
        raise FormatError("the PLY's vertices have no x, y and z")
    return np.stack([np.asarray(column, dtype=np.float64) for column in found], axis=1)


def _indices(columns: _Columns) -> _Lists:
    for name in _INDICES:
        found = columns.get(name)
        if isinstance(found, _Lists):
            if found.values.size and not np.all(np.abs(found.values) < 2**52):
                raise FormatError("a face refers to a vertex that does not exist")
            return found
    raise FormatError("the PLY's faces have no list of vertex_indices")
