"""glTF 2.0 binary (GLB): the meshes that its scene shows, in the scene's frame."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from graspdb_geometry.mesh_reading.content import (
    FaceArray,
    FileContent,
    FloatArray,
    FormatError,
    Geometry,
    check_limit,
)
from graspdb_geometry.mesh_reading.gltf.accessors import Glb, indices, positions
from graspdb_geometry.mesh_reading.gltf.document import (
    entries_of,
    entry_at,
    integer_of,
    integers_of,
    numbers_of,
)
from graspdb_geometry.mesh_reading.strips import triangles_of_fan, triangles_of_strip

MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
#: Parsed at once, holding the interpreter's lock.
MAX_JSON_BYTES = 4 * 2**20

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
#: Required extensions that change how a mesh looks, not where its triangles are.
_HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "KHR_xmp")
_READ = ("KHR_mesh_quantization",)
#: Extensions that make other triangles out of a node.
_INSTANCING = "EXT_mesh_gpu_instancing"
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


def read_glb(data: bytes, max_triangles: int) -> FileContent:
    """Read one geometry for each primitive of each node; points and lines are left aside."""
    glb = Glb(*_chunks(data))
    _check_extensions(glb.document)
    geometries: list[Geometry] = []
    notes: dict[str, None] = {}
    total = 0
    meshes = entries_of(glb.document, "meshes")
    read: dict[int, list[Geometry]] = {}
    for mesh, matrix in _instances(glb.document, notes):
        if mesh not in read:
            primitives = entries_of(entry_at(meshes, mesh, "mesh"), "primitives")
            found = [_primitive(glb, primitive, max_triangles, notes) for primitive in primitives]
            read[mesh] = [geometry for geometry in found if geometry is not None]
        for geometry in read[mesh]:
            total += len(geometry.faces)
            check_limit(total, max_triangles)
            vertices = geometry.vertices @ matrix[:3, :3].T + matrix[:3, 3]
            # A mirroring node turns the triangles inside out.
            faces = geometry.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else geometry.faces
            geometries.append(Geometry(vertices, faces))
    return FileContent(geometries, tuple(notes))


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    if data.lstrip()[:1] == b"{":
        raise FormatError("this is glTF as text, not GLB: export it as one binary file (.glb)")
    if len(data) < 20 or struct.unpack_from("<I", data)[0] != MAGIC:
        raise FormatError("this is not GLB: it does not start with 'glTF'")
    _, version, length = struct.unpack_from("<III", data)
    if version != 2:
        raise FormatError(f"this is glTF version {version}; version 2 is supported")
    if length > len(data):
        raise FormatError(f"the GLB is cut off: it declares {length} bytes and has {len(data)}")
    chunks: list[tuple[int, bytes]] = []
    offset = 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<II", data, offset)
        if offset + 8 + size > length:
            raise FormatError("a chunk of the GLB is cut off")
        chunks.append((kind, data[offset + 8 : offset + 8 + size]))
        offset += 8 + size
    if not chunks or chunks[0][0] != JSON_CHUNK:
        raise FormatError("the first chunk of the GLB is not JSON")
    if len(chunks[0][1]) > MAX_JSON_BYTES:
        raise FormatError(
            f"the GLB's description of its scene has {len(chunks[0][1]):,} bytes and at most"
            f" {MAX_JSON_BYTES:,} are read: merge its nodes, or export it as STL"
        )
    try:
        document = json.loads(chunks[0][1])
    except (ValueError, RecursionError):
        raise FormatError("the GLB's JSON can't be read") from None
    if not isinstance(document, dict):
        raise FormatError("the GLB's JSON is not an object")
    return document, next((body for kind, body in chunks[1:] if kind == BINARY_CHUNK), b"")


def _check_extensions(document: dict[str, Any]) -> None:
    required = document.get("extensionsRequired", [])
    if not isinstance(required, list) or not all(isinstance(name, str) for name in required):
        raise FormatError("'extensionsRequired' of the GLB is not a list of names")
    strange = [name for name in required if not name.startswith(_HARMLESS) and name not in _READ]
    if strange:
        way_out = "without compression" if set(strange) <= set(_COMPRESSED) else "without them"
        names = ", ".join(name[:60] for name in strange[:5])
        raise FormatError(f"the GLB requires extensions that are not supported: {names}; export it {way_out}")


def _instances(document: dict[str, Any], notes: dict[str, None]) -> list[tuple[int, FloatArray]]:
    """Each mesh with the transform of a node that shows it; without a scene, all root nodes."""
    nodes = entries_of(document, "nodes")
    if not nodes:
        return [(number, np.eye(4)) for number in range(len(entries_of(document, "meshes")))]
    children = {child for node in nodes for child in integers_of(node, "children")}
    scenes = entries_of(document, "scenes")
    if scenes:
        roots = integers_of(entry_at(scenes, integer_of(document, "scene", 0), "scene"), "nodes")
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
        node = entry_at(nodes, number, "node")
        matrix = parent @ _matrix(node)
        if "mesh" in node:
            if _INSTANCING in (node.get("extensions") or {}):
                raise FormatError(f"the GLB uses {_INSTANCING}, which is not supported: export it without it")
            if "skin" in node:
                notes["its skeleton was left aside: the mesh is taken as it was modelled"] = None
            instances.append((integer_of(node, "mesh"), matrix))
        pending.extend((child, matrix) for child in reversed(integers_of(node, "children")))
    return instances


def _matrix(node: dict[str, Any]) -> FloatArray:
    if "matrix" in node:
        return numbers_of(node, "matrix", 16).reshape(4, 4).T  # stored column by column
    matrix = np.eye(4)
    if "rotation" in node:
        quaternion = numbers_of(node, "rotation", 4)
        x, y, z, w = quaternion / (np.linalg.norm(quaternion) or 1.0)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    if "scale" in node:
        matrix[:3, :3] *= numbers_of(node, "scale", 3)
    if "translation" in node:
        matrix[:3, 3] = numbers_of(node, "translation", 3)
    return matrix


def _primitive(
    glb: Glb, primitive: dict[str, Any], max_triangles: int, notes: dict[str, None]
) -> Geometry | None:
    """The triangles of a primitive; None for points and lines."""
    mode = integer_of(primitive, "mode", _TRIANGLES)
    if mode < _TRIANGLES:
        notes["points and lines in it were left aside"] = None
        return None
    if mode > _FAN:
        raise FormatError(f"the GLB has primitives of the unknown mode {mode}")
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise FormatError("a primitive of the GLB has no attributes")
    number = integer_of(attributes, "POSITION")
    accessors = entries_of(glb.document, "accessors")
    compressed = [name for name in _COMPRESSED if name in (primitive.get("extensions") or {})]
    if compressed and "bufferView" not in entry_at(accessors, number, "accessor"):
        raise FormatError(f"the GLB is compressed by {compressed[0]}: export it without compression")
    vertices = positions(glb, number)
    if "indices" in primitive:
        corners = indices(glb, integer_of(primitive, "indices"))
    else:
        corners = np.arange(len(vertices), dtype=np.int64)
    return Geometry(vertices, _triangles(corners, mode, max_triangles))


def _triangles(corners: FaceArray, mode: int, max_triangles: int) -> FaceArray:
    if mode == _TRIANGLES:
        if len(corners) % 3:
            raise FormatError("a primitive of the GLB ends within a triangle")
        check_limit(len(corners) // 3, max_triangles)
        return corners.reshape(-1, 3)
    check_limit(len(corners) - 2, max_triangles)
    if len(corners) < 3:
        return np.empty((0, 3), dtype=np.int64)
    return triangles_of_strip(corners) if mode == _STRIP else triangles_of_fan(corners)
