"""The service's compute pool: a few threads for numbers, so that the rest of the service stays quick."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

from graspdb_density.se3 import Poses
from graspdb_service.problems import busy

T = TypeVar("T")

#: Queries under way or waiting. The server has 40 threads for requests: the others must find some free.
MAX_QUERIES = 28
#: Poses a computation takes at a time, so that short questions get between the blocks of a long one.
_BLOCK = 16_384


class Compute:
    """Runs computations on a bounded number of threads and refuses more queries than it can hold."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(max_workers=threads, thread_name_prefix="graspdb-compute")
        self._room = threading.BoundedSemaphore(MAX_QUERIES)

    @contextmanager
    def admitted(self) -> Iterator[None]:
        """A query's place, from its first computation to its last; 429 where all are taken."""
        if not self._room.acquire(blocking=False):
            title = (
                "All places for queries are taken: try again in a second, or ask for fewer poses at a time"
            )
            raise busy(title, status=429)
        try:
            yield
        finally:
            self._room.release()

    def run(self, work: Callable[[], T]) -> T:
        """Do ``work`` in the pool and wait for it. Never call it from inside the pool or a transaction."""
        return self._pool.submit(work).result()

    def blocks(self, poses: Poses, work: Callable[[Poses], T]) -> list[T]:
        """What ``work`` answers for consecutive blocks of poses, one by one so that others get between."""
        starts = range(0, len(poses), _BLOCK)
        return [self.run(partial(work, poses[start : start + _BLOCK])) for start in starts]

    def close(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)
