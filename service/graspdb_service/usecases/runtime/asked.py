"""Whose question a thread works on, until when an answer is wanted, whether anybody waits for it, and whether
what is kept will do while the database does not answer.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TypeVar

from graspdb_service.problems import ProblemError
from graspdb_service.storage.database import UNAVAILABLE, why

V = TypeVar("V")


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
    may_be_stale: bool = False
    """Whether an answer from what is kept will do while the database does not answer."""
    computed_s: float = 0.0
    """How long it has had a processor."""
    is_long: bool = False
    """Whether that was so long that short questions of its asker's own must not wait for it."""
    give_place: Callable[[], None] | None = None
    """Gives back its place among short questions; None for what has none."""
    at_end: list[Callable[[], None]] = field(default_factory=list)
    """What is to be given back when it is answered."""
    outage: str | None = None
    """What the database said where the answer is from what was kept."""
    step: str = "waiting for a processor"
    done: int = 0
    of: int | None = None

    @property
    def lane(self) -> str:
        """Among which of its asker's work it waits for a processor."""
        return "long" if self.is_long else "short"

    def end(self) -> None:
        """It is answered: give back what it holds."""
        for give_back in self.at_end:
            give_back()

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


def or_kept(read: Callable[[], V], kept: V | None) -> V:
    """What the database has; while it does not answer what is kept, where that will do, as is then noted.

    Without, or where nothing is kept, the database's error.
    """
    try:
        return read()
    except UNAVAILABLE as error:
        question = asked()
        if kept is None or not question.may_be_stale:
            raise
        question.outage = why(error)
        return kept


def outage() -> str | None:
    """What the database said, where this thread's question is answered from what was kept."""
    return asked().outage


def outage_warnings(revision: int) -> list[str]:
    """What is to be said of an answer, of this revision, from what was kept."""
    said = outage()
    if said is None:
        return []
    return [
        f"stale: the database does not answer ({said}), so this is from what the service had read before, of"
        f" revision {revision}; what came since is not in it"
    ]
