"""Untrusted meshes are read in a child process of bounded memory and time, which ends with the service.

Run as ``python -m graspdb_service.usecases.geometry.mesh_child``: order and content on the standard input,
result on the standard output.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import subprocess
import sys
from dataclasses import asdict, replace

import numpy as np

from graspdb.processes import ChildProcess, end_with_parent
from graspdb_geometry import meshes
from graspdb_geometry.meshes import Inspection, Mesh, MeshError, MeshProperties
from graspdb_service.usecases.geometry.mesh_form import MeshForm

# One thread in the numeric libraries: each would reserve address space of its own.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
#: Modules are not looked for in the working folder, for which Python 3.10 has no option.
_COMMAND = (
    [sys.executable, "-P", "-m", __name__]
    if sys.version_info >= (3, 11)
    else [sys.executable, "-c", f"import sys; del sys.path[0]; from {__name__} import main; sys.exit(main())"]
)


PATIENCE = 4.0
"""A mesh is refused for the processor time it takes, not for what else the machine is doing."""


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
    order = {
        "as_parts": as_parts,
        **form._asdict(),
        "max_triangles": max_triangles,
        "memory_bytes": memory_bytes,
        "seconds": seconds,
    }
    pipe = subprocess.PIPE
    with ChildProcess(
        _COMMAND,
        env=os.environ | _ONE_THREAD,
        stdin=pipe,
        stdout=pipe,
        stderr=subprocess.DEVNULL,
    ) as child:
        try:
            answer, _ = child.communicate(
                json.dumps(order).encode() + b"\n" + data, timeout=PATIENCE * seconds
            )
        except subprocess.TimeoutExpired:
            child.kill()
            raise MeshError(
                "mesh",
                f"reading it took more than {PATIENCE * seconds:g} s: this machine is busy, so try again"
                " later, or simplify it",
            ) from None
    if child.returncode != 0:
        raise MeshError(
            "mesh",
            f"reading it failed or needs more than {memory_bytes / 2**20:.0f} MiB of memory or {seconds:g} s "
            "of processor time: check the file, or simplify it",
        )
    return _deserialise(answer)


def main() -> int:
    """Limit this process, read one mesh, write the result; 0 also for a mesh that was refused."""
    end_with_parent()
    order = json.loads(sys.stdin.buffer.readline())
    # Both limits count what the libraries have used already.
    for kind, limit in (
        (resource.RLIMIT_AS, order["memory_bytes"]),
        (resource.RLIMIT_CPU, max(1, round(order["seconds"]))),
        (resource.RLIMIT_CORE, 0),
    ):
        with contextlib.suppress(ValueError, OSError):  # an inherited limit may be tighter already
            resource.setrlimit(kind, (limit, limit))
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
