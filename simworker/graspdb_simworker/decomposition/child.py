"""The process that decomposes a mesh into convex parts: an order and a mesh in, candidates out, best last.

Run as ``python -m graspdb_simworker.decomposition.child`` by :mod:`.supervisor`. The work is done here,
because it takes memory and time that only a process of its own can bound, and CoACD can't be interrupted. To
the kernel it is less urgent than the chunks of other objects that are simulated beside it.

Reads one ``CHUNK`` (a line of JSON, then the mesh as it was uploaded); writes ``NOTE`` (how far it is, for a
person), ``RESULT`` (a candidate as GLB, each finer than the one before) and ``ERROR``.
"""

from __future__ import annotations

import json
import math
import os
import resource
import sys
from contextlib import suppress
from typing import Any

from graspdb_simworker.process import channel

NICENESS = 10


def main() -> int:
    """Decompose one mesh."""
    source, sink = channel.take_streams()
    os.dup2(0, 2)  # CoACD's log
    os.nice(NICENESS)
    try:
        _, body = channel.Inbox(source).receive(poll_s=60.0)
        head, _, content = body.partition(b"\n")
        order = json.loads(head)
        memory, seconds = int(order["memory_bytes"]), max(1, math.ceil(order["seconds"]))
        for kind, soft, hard in (
            (resource.RLIMIT_AS, memory, memory),
            # The kernel ends it by SIGXCPU at the first.
            (resource.RLIMIT_CPU, seconds, seconds + 5),
            (resource.RLIMIT_CORE, 0, 0),
        ):
            with suppress(ValueError, OSError):  # an inherited limit may be tighter already
                resource.setrlimit(kind, (soft, hard))
        _serve(order, content, sink)
    except channel.Closed:
        pass
    return 0


def _serve(order: dict[str, Any], content: bytes, sink: int) -> None:
    try:
        # Imported under the limits, so that the libraries count as well.
        from graspdb_simworker.decomposition import convexity  # extra: sim
    except ModuleNotFoundError as error:
        channel.send(sink, channel.MISSING, str(error).encode())
        return
    except ImportError as error:
        channel.send(
            sink, channel.ERROR, f"its libraries do not fit into the memory allowed: {error}".encode()
        )
        return
    limits = convexity.CuttingLimits(order["max_parts"], order["seconds"], order["seed"])
    try:
        convexity.decompose(
            convexity.read(content, order["media_type"], order["unit"], order["scale"]),
            limits,
            tell=lambda note: channel.send(sink, channel.NOTE, note.encode()),
            give=lambda found: channel.send(sink, channel.RESULT, found.glb),
        )
    except convexity.Undecomposable as error:
        channel.send(sink, channel.ERROR, str(error).encode())
    except MemoryError:
        channel.send(sink, channel.ERROR, b"it needs more memory than allowed")


if __name__ == "__main__":
    sys.exit(main())
