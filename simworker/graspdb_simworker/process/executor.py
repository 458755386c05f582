"""Chunks simulated elsewhere: by any :class:`concurrent.futures.Executor`, such as a Dask cluster's.

What is sent is a function, a chunk's payload and the object's parts; what comes back is its result. Where it
runs, the function supervises a child of its own, as the worker does at home: a member of a pool can
neither be killed when a pose hangs, nor, if it is a daemon, start a process by ``multiprocessing``.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from concurrent import futures

from graspdb.wire import SimulatePayload, SimulateResult
from graspdb_simworker.process.local import LocalRunner
from graspdb_simworker.process.runner import ChunkCancelled, ChunkFailed, ChunkRunner, PhysicsMissing

POLL_S = 0.2

_local = threading.local()


def simulate(payload_json: str, parts_glb: bytes) -> str:
    """Simulate a chunk in this thread's child; runs in a member of the pool.

    The child stays for the next chunk and ends with the thread or the process. Takes and gives the JSON of
    :class:`~graspdb.wire.SimulatePayload` and :class:`~graspdb.wire.SimulateResult`.
    """
    runner: LocalRunner | None = getattr(_local, "runner", None)
    if runner is None:
        runner = _local.runner = LocalRunner()
        weakref.finalize(threading.current_thread(), runner.kill)
    return runner.run(SimulatePayload.model_validate_json(payload_json), parts_glb).model_dump_json()


class ExecutorRunner(ChunkRunner):
    """Hands every chunk to an executor, which its owner shuts down, and waits for the result."""

    def __init__(self, executor: futures.Executor) -> None:
        self._executor = executor

    def run(
        self, payload: SimulatePayload, parts_glb: bytes, *, wanted: Callable[[], bool] = lambda: True
    ) -> SimulateResult:
        """Have a chunk simulated. One that is no longer wanted is taken from the queue; if it runs already
        it runs to its end, and nobody asks for its result. ``ChunkFailed`` also if the executor lost it."""
        try:
            future = self._executor.submit(simulate, payload.model_dump_json(), parts_glb)
        except RuntimeError as error:
            raise ChunkFailed(f"the executor takes no chunks: {error}") from error
        while not futures.wait([future], POLL_S).done:
            if not wanted():
                future.cancel()
                raise ChunkCancelled
        try:
            return SimulateResult.model_validate_json(future.result())
        except (ChunkFailed, PhysicsMissing):
            raise
        except Exception as error:
            raise ChunkFailed(f"the executor lost the chunk: {type(error).__name__}: {error}") from error

    def __exit__(self, *_: object) -> None:
        """Nothing to end: the children belong to the executor's members."""
