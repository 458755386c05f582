"""One decomposition into convex parts, in a child process that is bounded in time and memory."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from graspdb.wire import DecomposePayload
from graspdb_simworker.process import channel
from graspdb_simworker.process.runner import ChunkCancelled, ChunkFailed

COMMAND = (sys.executable, "-m", "graspdb_simworker.decomposition.child")
SEED = 0
"""CoACD searches at random; with one seed the same mesh gets the same parts."""

PATIENCE = 30.0
"""By the clock it may take so many times as long as by the processor's time: chunks go before it."""
_WAY_OUT = "Simplify or mend the mesh, allow more time, or give its convex parts"


@dataclass(frozen=True)
class ResourceLimits:
    """What one decomposition may take: processor time, and the child's address space, libraries (1 GB) too.

    After ``seconds`` the best candidate so far is taken, or without one the job fails; by the clock
    :data:`PATIENCE` times as long. On a busy machine the clock says little about the work, and the parts
    should not depend on what else ran.
    """

    seconds: float = 40.0
    memory_bytes: int = 4 * 2**30


class DecompositionFailed(ChunkFailed):
    """No parts were found; trying again would end the same way."""


class _Late(Exception):
    """The time is over."""


def available() -> bool:
    """Whether this environment has CoACD."""
    return importlib.util.find_spec("coacd") is not None


def decompose(
    payload: DecomposePayload,
    mesh: bytes,
    *,
    limits: ResourceLimits,
    wanted: Callable[[], bool] = lambda: True,
    progress: Callable[[str], None] = lambda note: None,
    command: Sequence[str] = COMMAND,
) -> bytes:
    """The convex parts, as GLB, of a mesh as it was uploaded; DecompositionFailed with the reason.

    ``wanted`` is asked several times a second; the child is killed as soon as it says no (Cancelled).
    ``progress`` is told in words how far it is. ``command`` starts what speaks as
    :mod:`graspdb_simworker.decomposition.child` does.
    """
    deadline = time.monotonic() + PATIENCE * limits.seconds

    def check() -> None:
        if not wanted():
            raise ChunkCancelled
        if time.monotonic() > deadline:
            raise _Late

    order = {
        "media_type": payload.media_type,
        "unit": payload.unit,
        "scale": payload.scale,
        "max_parts": payload.max_parts,
        "seed": SEED,
        "seconds": limits.seconds,
        "memory_bytes": limits.memory_bytes,
    }
    process = channel.start(command)
    assert process.stdin is not None
    assert process.stdout is not None
    best: bytes | None = None
    inbox = channel.Inbox(process.stdout.fileno())
    try:
        with contextlib.suppress(channel.Closed):
            channel.send(process.stdin.fileno(), channel.CHUNK, json.dumps(order).encode() + b"\n" + mesh)
        while True:
            kind, body = inbox.receive(check=check)
            if kind == channel.NOTE:
                progress(body.decode(errors="replace"))
            elif kind == channel.RESULT:
                best = body
            elif kind == channel.MISSING:
                raise ChunkFailed(f"CoACD can't be imported: {body.decode(errors='replace')}")
            elif kind == channel.ERROR and best is None:
                raise DecompositionFailed(f"{body.decode(errors='replace')}. {_WAY_OUT}")
    except _Late:
        if best is None:
            raise _too_long(limits) from None
    except channel.Closed:
        if best is None:
            raise _death(process.wait(), limits) from None
    finally:
        channel.end(process)
    return best


def _too_long(limits: ResourceLimits) -> DecompositionFailed:
    return DecompositionFailed(
        f"it takes more than {limits.seconds:g} s (the worker's --decompose-seconds). {_WAY_OUT}"
    )


def _death(code: int, limits: ResourceLimits) -> DecompositionFailed:
    if code == -signal.SIGXCPU:
        return _too_long(limits)
    cause = f"CoACD died of {signal.Signals(-code).name}" if code < 0 else f"CoACD ended with code {code}"
    return DecompositionFailed(
        f"{cause}: perhaps it needs more than {limits.memory_bytes / 2**20:.0f} MiB"
        f" (the worker's --decompose-memory-mib). {_WAY_OUT}"
    )
