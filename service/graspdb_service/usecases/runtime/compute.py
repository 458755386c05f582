"""The service's processors: computations in turns of clients, so that the rest of the service stays quick."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from graspdb_density.se3 import Poses
from graspdb_service.problems import busy
from graspdb_service.telemetry.record import timed
from graspdb_service.usecases.runtime.asked import Asked, asked
from graspdb_service.usecases.runtime.fair_share import Claim, FairShare, NoRoom

T = TypeVar("T")
A = TypeVar("A", bound=np.generic)

#: Poses a computation takes at a time, so that short questions get between the blocks of a long one.
_BLOCK = 16_384
#: Poses whose values are computed between two breaths, at most.
_STEP = 2_048
#: A computation keeps its processor so long before another client's that waits has its turn.
_TURN_S = 0.02
#: A question that has had a processor for so long leaves its place to short ones.
_SHORT_S = 0.25
_LOOK_S = 0.25
_MOST_WAITING = 1_000


class _Turn:
    """A computation that has a processor."""

    def __init__(self, slots: FairShare, long_questions: FairShare, question: Asked) -> None:
        self._slots, self._long, self._question = slots, long_questions, question
        self._woken = threading.Event()
        self._thread = threading.get_ident()
        self._claim: Claim | None = None

    def take(self) -> None:
        """Wait for a processor, as long as the answer is wanted."""
        self._question.check()
        self._woken.clear()
        try:
            self._claim = claim = self._slots.claim(
                self._question.client, 1, self._woken.set, self._question.lane
            )
        except NoRoom:
            raise busy("Too many questions wait for a processor: try again in a second", status=429) from None
        while not claim.held and not self._woken.wait(_LOOK_S):
            self._question.check()
        self._since = time.monotonic()

    def give(self) -> None:
        claim, self._claim = self._claim, None
        if claim is not None:
            if claim.held:
                self._question.computed_s += time.monotonic() - self._since
            self._slots.release(claim)

    def breathe(self) -> None:
        """End here where the answer is no longer wanted, and let another client that waits have its turn."""
        self._question.check()
        held = time.monotonic() - self._since
        if threading.get_ident() != self._thread or held < _TURN_S or self._claim is None:
            return
        turns_long = not self._question.is_long and self._question.computed_s + held > _SHORT_S
        if turns_long or self._slots.others_wait(self._claim):
            self.give()
            if turns_long:
                self._lengthen()
            self.take()

    def _lengthen(self) -> None:
        """Go on as a long question, when it is the turn of its asker's among those.

        Whoever has many of them waits with these alone: places and processors of short ones are free.
        """
        question = self._question
        question.is_long = True
        if question.give_place is None:
            return
        woken = threading.Event()
        try:
            claim = self._long.claim(question.client, 1, woken.set)
        except NoRoom:
            raise busy("Too many long questions wait: try again in a second", status=429) from None
        question.at_end.append(partial(self._long.release, claim))
        question.give_place()
        before = question.step, question.done, question.of
        question.reached("waiting for other long questions")
        while not claim.held and not woken.wait(_LOOK_S):
            question.check()
        question.reached(*before)


_TURN: ContextVar[_Turn | None] = ContextVar("turn", default=None)


def breathe() -> None:
    """Call it between the blocks of a long computation; raises where nobody waits for its answer any more."""
    turn = _TURN.get()
    if turn is not None:
        turn.breathe()


def breathing(work: Callable[[Poses], NDArray[A]], step: str) -> Callable[[Poses], NDArray[A]]:
    """The same, a value a pose, in steps between which it breathes; ``step`` is what they are of."""
    question = asked()

    def noted(part: Poses) -> NDArray[A]:
        question.reached(step, len(part) + (question.done if question.step == step else 0))
        return work(part)

    return partial(by_steps, noted)


def by_steps(work: Callable[[Poses], NDArray[A]], poses: Poses, at_once: int = _STEP) -> NDArray[A]:
    """What ``work`` says of each pose, of so many at once; it breathes before each step."""
    parts = []
    for start in range(0, max(len(poses), 1), at_once):
        breathe()
        parts.append(work(poses[start : start + at_once]))
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


class Compute:
    """Computations on a bounded number of processors, clients in turn."""

    def __init__(
        self, threads: int, max_question_seconds: float = math.inf, *, long: int = 8, waiting_long: int = 24
    ) -> None:
        self.threads = threads
        self._most_seconds = max_question_seconds
        # One client has at most as many as there are; a short question of another finds one more.
        self._slots = FairShare(threads + 1, threads, _MOST_WAITING)
        self._long = FairShare(long, max(1, long * 3 // 4), waiting_long)

    @property
    def busy(self) -> int:
        """Processors that compute."""
        return self._slots.used

    @property
    def waiting(self) -> int:
        """Computations that wait for a processor."""
        return self._slots.waiting

    def run(self, work: Callable[[], T]) -> T:
        """Do ``work`` when it is this client's turn. Never call it within another or a transaction."""
        with self._turn():
            return work()

    @contextmanager
    def within(self, request: object = None) -> Iterator[None]:
        """Answer within the request's ``timeout_s``, or what the service allows at most, from its coming.

        503 ``deadline`` from a computation that finds it too late.
        """
        asked().within(getattr(request, "timeout_s", None), self._most_seconds)
        yield

    @contextmanager
    def _turn(self) -> Iterator[None]:
        turn = _Turn(self._slots, self._long, asked())
        token = _TURN.set(turn)
        try:
            with timed("queue"):
                turn.take()
            with timed("compute"):
                yield
        finally:
            turn.give()
            _TURN.reset(token)

    def blocks(self, poses: Poses, work: Callable[[Poses], T]) -> list[T]:
        """What ``work`` answers for consecutive blocks of poses, one by one so that others get between."""
        question, answers = asked(), []
        for start in range(0, len(poses), _BLOCK):
            question.reached("computing poses", start, len(poses))
            answers.append(self.run(partial(work, poses[start : start + _BLOCK])))
        return answers
