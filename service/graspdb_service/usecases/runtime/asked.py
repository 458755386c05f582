"""Whose question a thread works on, until when an answer is wanted, and whether anybody waits for it."""

from __future__ import annotations

import threading
import time
from contextvars import ContextVar
from dataclasses import dataclass, field

from graspdb_service.problems import ProblemError


@dataclass(eq=False)
class Asked:
    """A request while it is answered: who asked, and what ends the work on it."""

    client: str
    """The id of the key that asked, else the peer's address; the service's own work has no client."""
    started: float = field(default_factory=time.monotonic)
    seconds: float | None = None
    """Time for the answer, from the request on; None without an end."""
    gone: bool = False
    """Whether the asker has hung up."""
    step: str = "waiting for a processor"
    done: int = 0
    of: int | None = None

    def within(self, seconds: float | None, most: float) -> None:
        """Answer within this, or within what the service allows at ``most``."""
        self.seconds = most if seconds is None else min(seconds, most)

    def reached(self, step: str, done: int = 0, of: int | None = None) -> None:
        """Note how far the work is, for whoever is told that time ran out."""
        self.step, self.done, self.of = step, done, of

    def check(self) -> None:
        """Raise where the work is no longer wanted: 503 ``deadline``, or nobody is there to be told."""
        if _CLOSING.is_set():
            title = "The service is shutting down: ask again in a few seconds"
            raise ProblemError(503, "shutting-down", title, headers={"Retry-After": "5"})
        if self.gone:
            raise ProblemError(499, "client-gone", "The client hung up before the answer")
        if self.seconds is not None and time.monotonic() - self.started > self.seconds:
            so_far = {"step": self.step, "done": self.done, "of": self.of, "seconds": self.seconds}
            raise ProblemError(
                503,
                "deadline",
                f"No answer within {self.seconds:g} s, while {self.step}: ask for less (fewer poses, a"
                " smaller count, no noise), or give it longer with timeout_s (see /info)",
                headers={"Retry-After": "5"},
                extra={"reached": so_far},
            )


_CLOSING = threading.Event()
_ASKED: ContextVar[Asked | None] = ContextVar("asked", default=None)


def asked() -> Asked:
    """What this thread works on; the service's own work where nobody asked."""
    return _ASKED.get() or Asked("")


def end_all() -> None:
    """Have every computation of this process end at its next breath, for it shuts down."""
    _CLOSING.set()


def begin(question: Asked) -> None:
    """From here on, in this task and the threads it hands work to, that is what is worked on."""
    _ASKED.set(question)
