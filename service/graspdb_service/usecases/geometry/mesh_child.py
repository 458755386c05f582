"""Untrusted meshes are read in a child process of bounded memory and time, which ends with the service.

Run as ``python -m graspdb_service.usecases.geometry.mesh_child``: order and content on the standard input,
result on the standard output.
"""

from __future__ import annotations

import io
import json
import sys
from dataclasses import asdict, replace

import numpy as np

from graspdb_geometry import meshes
from graspdb_geometry.meshes import Inspection, Mesh, MeshError, MeshProperties
from graspdb_service.usecases.geometry.bounded_child import ChildFailed, ChildLimits, begin, bounded
from graspdb_service.usecases.geometry.mesh_form import MeshForm


def inspect_in_child(
    data: bytes,
    form: MeshForm,
    *,
    as_parts: bool = False,
    max_triangles: int = meshes.MAX_TRIANGLES,
    memory_bytes: int = 2 * 2**30,
    seconds: float = 30.0,
) -> Inspection:
    """Load and measure a mesh; ``as_parts`` one whose geometries are to be convex parts, which are answered.

    ``memory_bytes`` is the child's address space, interpreter and libraries (about 0.4 GB) included;
    ``seconds`` are of processor time; on a busy machine it may take ``PATIENCE`` times as long. Raises
    MeshError as `meshes.load`, and when the child exceeds a limit or dies.
    """
    # Cheap refusals need no child.
    if not meshes.readable(form.media_type, form.unit) or not data:
        form.read(data)
    order = {"as_parts": as_parts, **form._asdict(), "max_triangles": max_triangles}
    limits = ChildLimits(memory_bytes, seconds)
    try:
        answer = bounded(__name__, order, data, limits)
    except ChildFailed as error:
        raise MeshError("mesh", f"{error}, or simplify it") from None
    return _deserialise(answer)


def main() -> int:
    """Limit this process, read one mesh, write the result; 0 also for a mesh that was refused."""
    order = begin()
    try:
        data = sys.stdin.buffer.read()
        inspection = meshes.inspect(
            data, order["media_type"], order["unit"], order["scale"], max_triangles=order["max_triangles"]
        )
        if order["as_parts"]:
            inspection = replace(inspection, parts=meshes.parts_from_glb(data))
        answer = _serialise(inspection)
    except MeshError as error:
        answer = json.dumps({"error": {"field": error.field, "message": error.message}}).encode() + b"\n"
    sys.stdout.buffer.write(answer)
    sys.stdout.buffer.flush()
    return 0


def _serialise(inspection: Inspection) -> bytes:
    """A line of JSON and two arrays for the mesh and for each of its parts."""
    head = {
        "properties": asdict(inspection.properties),
        "mesh_warnings": list(inspection.mesh.warnings),
        "parts": len(inspection.parts),
    }
    stream = io.BytesIO()
    stream.write(json.dumps(head).encode() + b"\n")
    mesh = (inspection.mesh.vertices, inspection.mesh.faces)
    for vertices, faces in [mesh, *inspection.parts]:
        np.save(stream, vertices, allow_pickle=False)
        np.save(stream, faces, allow_pickle=False)
    return stream.getvalue()


def _deserialise(data: bytes) -> Inspection:
    head, _, rest = data.partition(b"\n")
    answer = json.loads(head)
    if "error" in answer:
        raise MeshError(answer["error"]["field"], answer["error"]["message"])
    stream = io.BytesIO(rest)
    (vertices, faces), *parts = (
        (np.load(stream, allow_pickle=False), np.load(stream, allow_pickle=False))
        for _ in range(1 + answer["parts"])
    )
    mesh = Mesh(vertices, faces, tuple(answer["mesh_warnings"]))
    return Inspection(mesh, MeshProperties(**answer["properties"]), parts)


if __name__ == "__main__":
    sys.exit(main())
