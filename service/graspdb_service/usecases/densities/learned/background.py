"""A thread that learns while others answer: one thing after the other, and each that is wanted once."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable

log = logging.getLogger("graspdb")

#: How much waits to be done.
_MOST_WAITING = 32
#: How long a service that stops waits for what is being done.
_ENDS_WITHIN_S = 2.0
#: Below other threads, which answer.
_NICE = 10


class Stopped(Exception):
    """The service is about to stop."""


class Background:
    """What one service process learns behind its answers, by names that tell what is wanted already."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: OrderedDict[str, Callable[[], None]] = OrderedDict()
        self._closed = False
        self._thread: threading.Thread | None = None

    def do(self, name: str, task: Callable[[], None]) -> None:
        """Have it done soon, after what is being done. Nobody hears of its errors but the log."""
        with self._changed:
            if self._closed or name in self._waiting:
                return
            self._waiting[name] = task
            if len(self._waiting) > _MOST_WAITING:
                # Who asks for it again has it done then. The first is being done.
                self._waiting.pop(list(self._waiting)[1])
            if self._thread is None:
                self._thread = threading.Thread(target=self._go_on, name="graspdb-learning", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def wait(self, name: str, within_s: float) -> bool:
        """Until nothing of this name waits or is being done; False where that takes longer."""
        with self._changed:
            return self._changed.wait_for(lambda: name not in self._waiting or self._closed, within_s)

    def breathe(self) -> None:
        """Called by tasks between steps of a few seconds at most; raises :class:`Stopped` to end them."""
        if self._closed:
            raise Stopped
        # Others take the interpreter meanwhile.
        time.sleep(0.0)

    def close(self) -> None:
        """Stop; what is half learned is learned again by whoever needs it."""
        with self._changed:
            self._closed = True
            thread = self._thread
            self._changed.notify_all()
        if thread is not None:
            # What scikit-learn fits is not ended: nothing of it is lost that the next start can't learn.
            thread.join(_ENDS_WITHIN_S)

    def _go_on(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # Linux only: there threads have their own
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                name, task = next(iter(self._waiting.items()))
            try:
                task()
            except Stopped:
                return
            except Exception:
                log.exception("what was to be learned could not be")
            finally:
                with self._changed:
                    self._waiting.pop(name, None)
                    self._changed.notify_all()
