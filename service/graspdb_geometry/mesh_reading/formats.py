"""Readers of untrusted mesh files, from memory: STL, OBJ, PLY, GLB.

A reader trusts no count or offset in the file, opens nothing else (materials, textures and external buffers
are ignored or refused), and counts triangles before it builds them.  It returns vertices and triangles as the
file has them; `meshes` checks values, scales units and merges.
"""

from __future__ import annotations

import io
import itertools
import json
import re
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
FaceArray = npt.NDArray[np.int64]


class Geometry(NamedTuple):
    """Triangles as read: vertices (V, 3) in the file's unit, faces (F, 3) not yet checked."""

    vertices: FloatArray
    faces: FaceArray


class FormatError(ValueError):
    """The content can't be read as the format it claims to be."""


# --------------------------------------------------------------------------------------------- STL


def read_stl(data: bytes, max_triangles: int) -> list[Geometry]:
    """Read binary or ASCII STL; binary is told by its length, as some put ``solid`` in its header too."""
    declared = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
    if len(data) >= 84 and len(data) == 84 + 50 * declared:
        _limit(declared, max_triangles)
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
        corners = np.frombuffer(data, dtype=record, offset=84)["corners"].astype(np.float64)
        return [_soup(corners.reshape(-1, 3))]
    if not re.match(rb"\s*solid\b", data[:256]):
        raise FormatError(
            "this is not STL: neither text starting with 'solid' nor binary of the length its header declares"
        )
    if b"endsolid" not in data[-4096:]:
        raise FormatError("the ASCII STL is cut off: 'endsolid' is missing")
    triples = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", data)
    if len(triples) % 3 or len(triples) // 3 != len(re.findall(rb"\bendfacet\b", data)):
        raise FormatError("the ASCII STL has facets without three vertices")
    _limit(len(triples) // 3, max_triangles)
    try:
        return [_soup(np.array(triples, dtype="S64").astype(np.float64).reshape(-1, 3))]
    except ValueError:
        raise FormatError("the ASCII STL has a coordinate that is not a number") from None


def _soup(corners: FloatArray) -> Geometry:
    return Geometry(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3))


# --------------------------------------------------------------------------------------------- OBJ


def read_obj(data: bytes, max_triangles: int) -> list[Geometry]:
    """Read the vertices and faces of an OBJ; polygons become fans, materials and curves are ignored."""
    if b"\0" in data:
        raise FormatError("this is not OBJ, which is text")
    vertices: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(io.BytesIO(data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")), start=1):
        words = line.split()
        if not words:
            continue
        try:
            if words[0] == b"v":
                vertices.append((float(words[1]), float(words[2]), float(words[3])))
            elif words[0] == b"f":
                corners = [int(word.split(b"/", 1)[0]) for word in words[1:]]
                if len(corners) < 3 or 0 in corners:
                    raise IndexError
                index = [c - 1 if c > 0 else len(vertices) + c for c in corners]
                faces.extend((index[0], b, c) for b, c in itertools.pairwise(index[1:]))
        except (ValueError, IndexError):
            raise FormatError(f"line {number} of the OBJ can't be read") from None
        if len(faces) > max_triangles:
            _limit(len(faces), max_triangles)
    if not vertices or not faces:
        raise FormatError("this is not OBJ with vertices ('v') and faces ('f')")
    try:
        return [Geometry(np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64))]
    except OverflowError:
        raise FormatError("a face of the OBJ refers to a vertex that does not exist") from None


# --------------------------------------------------------------------------------------------- PLY


def read_ply(data: bytes, max_triangles: int) -> list[Geometry]:
    """Read ASCII or binary PLY with trimesh, once the declared counts fit the content's size."""
    header, separator, _ = data[:65536].partition(b"end_header")
    if not re.match(rb"ply\s", data[:4]) or not separator:
        raise FormatError("this is not PLY: 'ply' at the start or 'end_header' is missing")
    for name, count in re.findall(rb"^\s*element\s+(\S+)\s+(\S+)", header, flags=re.MULTILINE):
        if not count.isdigit() or int(count) > len(data):
            raise FormatError(f"the PLY declares more {name.decode(errors='replace')} than it can hold")
        if name == b"face":
            _limit(int(count), max_triangles)
    from trimesh.exchange.ply import load_ply

    try:
        loaded = load_ply(io.BytesIO(data), fix_texture=False, skip_materials=True)
        vertices = np.array(loaded["vertices"], dtype=np.float64)
        faces = np.array(loaded["faces"], dtype=np.int64)
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001 - a foreign parser on hostile input may raise anything
        raise FormatError(f"the PLY can't be read ({type(error).__name__})") from None
    if faces.ndim == 2 and faces.shape[1] == 4:
        faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    _limit(len(faces), max_triangles)
    return [Geometry(vertices, faces)]


# --------------------------------------------------------------------------------------------- GLB

_GLB_MAGIC, _GLB_JSON, _GLB_BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_INDEX_TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4"}
_FLOAT = 5126


def read_glb(data: bytes, max_triangles: int) -> list[Geometry]:
    """Read glTF 2.0 binary: one geometry for each primitive of each node, in the scene's frame."""
    document, binary = _glb_chunks(data)
    if document.get("extensionsRequired"):
        raise FormatError(
            "the GLB requires extensions, which are not supported (export it without compression)"
        )
    for kind in ("buffers", "images"):
        if any("uri" in entry for entry in _entries(document, kind)):
            raise FormatError(f"the GLB refers to {kind} outside of it")
    geometries: list[Geometry] = []
    total = 0
    meshes = _entries(document, "meshes")
    read: dict[int, list[Geometry]] = {}
    for mesh, matrix in _glb_instances(document):
        if mesh not in read:
            read[mesh] = [
                _glb_primitive(document, binary, primitive, max_triangles)
                for primitive in _entries(_at(meshes, mesh, "mesh"), "primitives")
            ]
        for geometry in read[mesh]:
            total += len(geometry.faces)
            _limit(total, max_triangles)
            vertices = geometry.vertices @ matrix[:3, :3].T + matrix[:3, 3]
            # A mirroring node turns the triangles inside out.
            faces = geometry.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else geometry.faces
            geometries.append(Geometry(vertices, faces))
    return geometries


def _glb_chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    if len(data) < 20 or struct.unpack_from("<I", data)[0] != _GLB_MAGIC:
        raise FormatError("this is not GLB: it does not start with 'glTF'")
    _, version, length = struct.unpack_from("<III", data)
    if version != 2:
        raise FormatError(f"this is glTF version {version}; version 2 is supported")
    if length != len(data):
        raise FormatError(f"the GLB declares {length} bytes but has {len(data)}")
    chunks: list[tuple[int, bytes]] = []
    offset = 12
    while offset < length:
        if offset + 8 > length:
            raise FormatError("a chunk of the GLB is cut off")
        size, kind = struct.unpack_from("<II", data, offset)
        if offset + 8 + size > length:
            raise FormatError("a chunk of the GLB is cut off")
        chunks.append((kind, data[offset + 8 : offset + 8 + size]))
        offset += 8 + size
    if not chunks or chunks[0][0] != _GLB_JSON:
        raise FormatError("the first chunk of the GLB is not JSON")
    try:
        document = json.loads(chunks[0][1])
    except (ValueError, RecursionError):
        raise FormatError("the GLB's JSON can't be read") from None
    if not isinstance(document, dict):
        raise FormatError("the GLB's JSON is not an object")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == _GLB_BINARY else b""
    return document, binary


def _glb_instances(document: dict[str, Any]) -> list[tuple[int, FloatArray]]:
    """Each mesh with the transform of a node that shows it; without a scene, all root nodes."""
    nodes = _entries(document, "nodes")
    if not nodes:
        return [(number, np.eye(4)) for number in range(len(_entries(document, "meshes")))]
    children = {child for node in nodes for child in _integers(node, "children")}
    scenes = _entries(document, "scenes")
    if scenes:
        roots = _integers(_at(scenes, _integer(document, "scene", 0), "scene"), "nodes")
    else:
        roots = [n for n in range(len(nodes)) if n not in children]
    instances = []
    seen: set[int] = set()
    pending = [(root, np.eye(4)) for root in reversed(roots)]
    while pending:
        number, parent = pending.pop()
        if number in seen:  # the standard demands trees; anything else could grow without bound
            raise FormatError(f"node {number} of the GLB has two parents")
        seen.add(number)
        node = _at(nodes, number, "node")
        matrix = parent @ _glb_matrix(node)
        if "mesh" in node:
            instances.append((_integer(node, "mesh"), matrix))
        pending.extend((child, matrix) for child in reversed(_integers(node, "children")))
    return instances


def _glb_matrix(node: dict[str, Any]) -> FloatArray:
    if "matrix" in node:
        return _numbers(node, "matrix", 16).reshape(4, 4).T  # stored column by column
    matrix = np.eye(4)
    if "rotation" in node:
        x, y, z, w = _numbers(node, "rotation", 4)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    if "scale" in node:
        matrix[:3, :3] *= _numbers(node, "scale", 3)
    if "translation" in node:
        matrix[:3, 3] = _numbers(node, "translation", 3)
    return matrix


def _glb_primitive(
    document: dict[str, Any], binary: bytes, primitive: dict[str, Any], max_triangles: int
) -> Geometry:
    if _integer(primitive, "mode", 4) != 4:
        raise FormatError("the GLB has primitives other than triangle lists")
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise FormatError("a primitive of the GLB has no attributes")
    vertices = _glb_accessor(document, binary, _integer(attributes, "POSITION"), "VEC3", {_FLOAT: "<f4"})
    if "indices" in primitive:
        flat = _glb_accessor(document, binary, _integer(primitive, "indices"), "SCALAR", _INDEX_TYPES)
        index = flat.reshape(-1).astype(np.int64)
    else:
        index = np.arange(len(vertices), dtype=np.int64)
    if len(index) % 3:
        raise FormatError("a primitive of the GLB ends within a triangle")
    _limit(len(index) // 3, max_triangles)
    return Geometry(vertices.astype(np.float64), index.reshape(-1, 3))


def _glb_accessor(
    document: dict[str, Any], binary: bytes, number: int, kind: str, types: dict[int, str]
) -> npt.NDArray[Any]:
    accessor = _at(_entries(document, "accessors"), number, "accessor")
    component = types.get(_integer(accessor, "componentType"))
    if accessor.get("type") != kind or component is None or "sparse" in accessor:
        raise FormatError(f"accessor {number} of the GLB is not of a supported type")
    view = _at(_entries(document, "bufferViews"), _integer(accessor, "bufferView"), "bufferView")
    if _integer(view, "buffer", 0) != 0:
        raise FormatError("the GLB refers to buffers outside of it")
    columns = 3 if kind == "VEC3" else 1
    item = np.dtype(component).itemsize * columns
    stride = _integer(view, "byteStride", item)
    count, offset = _integer(accessor, "count"), _integer(accessor, "byteOffset", 0)
    view_offset, view_length = _integer(view, "byteOffset", 0), _integer(view, "byteLength")
    needed = offset + (stride * (count - 1) + item if count else 0)
    if stride < item or needed > view_length or view_offset + view_length > len(binary):
        raise FormatError(f"accessor {number} of the GLB reaches beyond its data")
    array: npt.NDArray[Any] = np.ndarray(
        (count, columns),
        dtype=component,
        buffer=binary,
        offset=view_offset + offset,
        strides=(stride, np.dtype(component).itemsize),
    )
    return array


def write_glb(geometries: list[Geometry]) -> bytes:
    """Write one node, mesh and primitive for each geometry; the same input gives the same bytes.

    Coordinates are rounded to float32, as the format demands.
    """
    binary = bytearray()
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []

    def store(array: npt.NDArray[Any], target: int, description: dict[str, Any]) -> int:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes, "target": target})
        binary.extend(array.tobytes())
        accessors.append({"bufferView": len(views) - 1, "count": len(array)} | description)
        return len(accessors) - 1

    meshes = []
    for vertices, faces in geometries:
        points = vertices.astype("<f4")
        limits = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        position = store(points, 34962, {"componentType": _FLOAT, "type": "VEC3"} | limits)
        index = store(faces.astype("<u4").reshape(-1), 34963, {"componentType": 5125, "type": "SCALAR"})
        meshes.append({"primitives": [{"attributes": {"POSITION": position}, "indices": index, "mode": 4}]})
    document = {
        "asset": {"version": "2.0", "generator": "GraspDB"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"mesh": number, "name": f"part_{number:04d}"} for number in range(len(meshes))],
        "meshes": meshes,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary.extend(b"\0" * (-len(binary) % 4))
    total = 12 + 8 + len(text) + 8 + len(binary)
    head = struct.pack("<III", _GLB_MAGIC, 2, total) + struct.pack("<II", len(text), _GLB_JSON)
    return head + text + struct.pack("<II", len(binary), _GLB_BINARY) + bytes(binary)


# ------------------------------------------------------------------------------ reading hostile JSON


def _entries(document: dict[str, Any], name: str) -> list[dict[str, Any]]:
    entries = document.get(name, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise FormatError(f"'{name}' of the GLB is not a list of objects")
    return entries


def _at(entries: list[dict[str, Any]], number: int, kind: str) -> dict[str, Any]:
    if number >= len(entries):
        raise FormatError(f"the GLB refers to {kind} {number}, which does not exist")
    return entries[number]


def _integer(entry: dict[str, Any], name: str, default: int | None = None) -> int:
    value = entry.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**40:
        raise FormatError(f"'{name}' in the GLB is not a sensible integer")
    return value


def _integers(entry: dict[str, Any], name: str) -> list[int]:
    values = entry.get(name, [])
    if not isinstance(values, list):
        raise FormatError(f"'{name}' in the GLB is not a list")
    return [_integer({name: value}, name) for value in values]


def _numbers(entry: dict[str, Any], name: str, count: int) -> FloatArray:
    values = entry[name]
    if (
        not isinstance(values, list)
        or len(values) != count
        or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    ):
        raise FormatError(f"'{name}' in the GLB is not a list of {count} numbers")
    try:
        return np.array(values, dtype=np.float64)
    except OverflowError:
        raise FormatError(f"'{name}' in the GLB is too large") from None


def _limit(triangles: int, max_triangles: int) -> None:
    if triangles > max_triangles:
        raise FormatError(f"the mesh has more than {max_triangles:,} triangles: simplify it first")


#: Reader of each accepted media type.
READERS: dict[str, Callable[[bytes, int], list[Geometry]]] = {
    "model/stl": read_stl,
    "model/obj": read_obj,
    "model/ply": read_ply,
    "model/gltf-binary": read_glb,
}
