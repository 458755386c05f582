"""The child process that reads untrusted meshes: order and content on stdin, result on stdout."""

from __future__ import annotations

import contextlib
import json
import resource
import sys

from graspdb_geometry import meshes


def main() -> int:
    """Limit this process, read one mesh, write the result; 0 also for a mesh that was refused."""
    order = json.loads(sys.stdin.buffer.readline())
    # Both limits count what the libraries have used already.
    seconds = max(1, round(order["seconds"]))
    for kind, limit in (
        (resource.RLIMIT_AS, order["memory_bytes"]),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_CORE, 0),
    ):
        with contextlib.suppress(ValueError, OSError):  # an inherited limit may be tighter already
            resource.setrlimit(kind, (limit, limit))
    try:
        inspection = meshes.inspect(
            sys.stdin.buffer.read(), order["media_type"], order["unit"], max_triangles=order["max_triangles"]
        )
        answer = meshes.serialise(inspection)
    except meshes.MeshError as error:
        answer = json.dumps({"error": {"field": error.field, "message": error.message}}).encode() + b"\n"
    sys.stdout.buffer.write(answer)
    sys.stdout.buffer.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
