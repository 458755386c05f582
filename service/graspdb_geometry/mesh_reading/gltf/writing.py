"""Writing glTF 2.0 binary (GLB)."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy.typing as npt

from graspdb_geometry.mesh_reading.content import Geometry
from graspdb_geometry.mesh_reading.gltf.accessors import FLOAT
from graspdb_geometry.mesh_reading.gltf.reading import BINARY_CHUNK, JSON_CHUNK, MAGIC


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
        position = store(points, 34962, {"componentType": FLOAT, "type": "VEC3"} | limits)
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
    head = struct.pack("<III", MAGIC, 2, total) + struct.pack("<II", len(text), JSON_CHUNK)
    return head + text + struct.pack("<II", len(binary), BINARY_CHUNK) + bytes(binary)
