"""A cache bounded by bytes in which a value that many ask for at once is made once."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Generic, TypeVar

from graspdb_service.usecases.runtime.asked import asked, or_kept

K = TypeVar("K")
V = TypeVar("V")

#: Who waits for what another makes looks so often whether its own answer is still wanted.
_LOOK_S = 0.25


@dataclass(eq=False)
class _Slot(Generic[V]):
    lock: threading.Lock = field(default_factory=threading.Lock)
    value: V | None = None
    users: int = 0


class SingleFlightCache(Generic[K, V]):
    """Values by key, the least recently used dropped first where all take more than ``max_bytes``.

    A single larger one is answered but not kept. ``size`` is asked again before each eviction, for values may
    grow as they are used.
    """

    def __init__(self, max_bytes: int, size: Callable[[V], int]) -> None:
        self._max_bytes = max_bytes
        self._size = size
        self._lock = threading.Lock()
        self._slots: OrderedDict[K, _Slot[V]] = OrderedDict()
        self.hits = 0
        self.misses = 0

    def get(self, key: K, usable: Callable[[V], bool], make: Callable[[V | None], V]) -> V:
        """The value of ``key`` if ``usable``, else what ``make`` answers, given the value before (or None).

        Of several callers one makes while the others wait, as long as their answers are wanted; they then
        judge what it made for themselves. If ``make`` raises, its caller gets the error and the next one
        tries anew; where that is for the database, which does not answer, a question that it will do for
        gets the value before.
        """
        with self._lock:
            slot = self._slots.setdefault(key, _Slot())
            slot.users += 1
            self._slots.move_to_end(key)
        try:
            value = slot.value
            if value is not None and usable(value):
                self.hits += 1
                return value
            while not slot.lock.acquire(timeout=_LOOK_S):
                asked().check()
            try:
                value = slot.value
                if value is None or not usable(value):
                    self.misses += 1
                    value = or_kept(partial(make, value), value)
                    slot.value = value
            finally:
                slot.lock.release()
            return value
        finally:
            with self._lock:
                slot.users -= 1
                self._evict()

    def _evict(self) -> None:
        sizes = {key: self._size(slot.value) for key, slot in self._slots.items() if slot.value is not None}
        total = sum(sizes.values())
        for key, slot in list(self._slots.items()):
            if slot.users:
                continue
            if slot.value is None:
                del self._slots[key]
            elif total > self._max_bytes:
                total -= sizes[key]
                del self._slots[key]

    def __len__(self) -> int:
        with self._lock:
            return sum(slot.value is not None for slot in self._slots.values())

    @property
    def nbytes(self) -> int:
        """Bytes of all values kept."""
        with self._lock:
            return sum(self._size(slot.value) for slot in self._slots.values() if slot.value is not None)
