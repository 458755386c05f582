"""What simulates chunks, wherever it does: here in a process of its own, or on a cluster."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

from graspdb.wire import SimulatePayload, SimulateResult


class ChunkCancelled(Exception):
    """The chunk is not wanted any more."""


class ChunkFailed(Exception):
    """The chunk can't be simulated; the message says why."""


class PhysicsMissing(Exception):
    """The simulating process has no engine, or lacks what it needs beside it; the message says which."""


class ChunkRunner(AbstractContextManager[Any], Protocol):
    """Simulates one chunk after the other for one thread; what it holds for that ends with its context."""

    def run(
        self, payload: SimulatePayload, parts_glb: bytes, *, wanted: Callable[[], bool]
    ) -> SimulateResult:
        """Simulate a chunk of an object with these convex parts; ``wanted`` is asked several times a second.

        ChunkCancelled if it was not wanted any more; ChunkFailed, with the reason, if the chunk as a whole
        can't be simulated; PhysicsMissing.
        """
