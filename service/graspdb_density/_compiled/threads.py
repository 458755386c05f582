"""The package's own bounded pool: compiled blocks run outside the interpreter lock."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

__all__ = ["for_blocks", "processors"]

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_pool_owner = 0


def processors() -> int:
    """Processors this process may use."""
    try:
        return max(1, len(os.sched_getaffinity(0)))
    except AttributeError:  # not on every platform
        return max(1, os.cpu_count() or 1)


def _shared_pool() -> ThreadPoolExecutor:
    global _pool, _pool_owner
    with _lock:
        # A forked child inherits the object but not its threads.
        if _pool is None or _pool_owner != os.getpid():
            _pool = ThreadPoolExecutor(max_workers=processors(), thread_name_prefix="graspdb-density")
            _pool_owner = os.getpid()
        return _pool


def for_blocks(work: Callable[[int, int], None], count: int, *, block: int, threads: int) -> None:
    """Call ``work(begin, end)`` on consecutive blocks of ``range(count)``, on at most ``threads`` threads.

    The calling thread works too; helpers take blocks from the same counter, so uneven blocks balance.
    Exceptions are raised here.
    """
    starts = iter(range(0, count, block))
    guard = threading.Lock()

    def drain() -> None:
        while True:
            with guard:
                begin = next(starts, None)
            if begin is None:
                return
            work(begin, min(begin + block, count))

    helpers = min(threads, processors(), -(-count // block)) - 1
    futures = [_shared_pool().submit(drain) for _ in range(helpers)]
    try:
        drain()
    finally:
        for future in futures:
            # A helper that never started has nothing left to do; waiting for it would tie callers to each
            # other.
            if not future.cancel():
                future.result()
