"""Work off the event loop of which only the latest counts: what a drag asks ten times a second."""

from __future__ import annotations

import threading
from collections.abc import Callable

Task = Callable[[], None]


class Latest:
    """A thread that runs one task at a time; of those that come meanwhile only the last is run.

    So questions follow a drag as fast as they are answered, and the last position of it always is. What a
    task raises goes to ``failed``.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._changed = threading.Condition()
        self._next: Task | None = None
        self._closed = False
        threading.Thread(target=self._run, daemon=True).start()

    def soon(self, task: Task) -> None:
        """Run this as soon as what runs is done, in place of what waits."""
        with self._changed:
            self._next = task
            self._changed.notify()

    def close(self) -> None:
        """Run nothing any more; what runs ends by itself."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _run(self) -> None:
        while (task := self._taken()) is not None:
            try:
                task()
            except Exception as error:  # noqa: BLE001 - a page must survive whatever an answer does to it
                if not self._closed:
                    self._failed(error)

    def _taken(self) -> Task | None:
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._next is not None)
            task, self._next = self._next, None
            return None if self._closed else task
