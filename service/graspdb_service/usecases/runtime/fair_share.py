"""Sharing something scarce between clients: places, processors, memory for bodies."""

from __future__ import annotations

import asyncio
import threading
from collections import OrderedDict, deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass


class NoRoom(Exception):
    """Too many wait already, or it took too long; ``waited`` says which."""

    def __init__(self, *, waited: bool) -> None:
        super().__init__()
        self.waited = waited


@dataclass(eq=False)
class Claim:
    """So much for a client, in a lane of its own: held, or waited for until ``wake`` is called."""

    client: str
    amount: int
    wake: Callable[[], None]
    lane: str
    held: bool = False


class FairShare:
    """``total`` of something, of which one client has at most ``share`` at a time.

    Who finds none waits, at most ``most_waiting`` of them and three quarters of these of one client; what
    becomes free goes to the waiting clients in turn, whoever of them asks most, and so to the lanes of one's
    own that wait. May be used by threads and by an event loop at once.
    """

    def __init__(self, total: int, share: int, most_waiting: int) -> None:
        self._total, self._share = total, share
        self._most_waiting = most_waiting
        self._most_of_one = max(1, most_waiting * 3 // 4)
        self._lock = threading.Lock()
        self._used = 0
        self._used_by: dict[str, int] = {}
        # By client and lane; what was served longest ago comes first.
        self._waiting: OrderedDict[tuple[str, str], deque[Claim]] = OrderedDict()
        self._waiting_count = 0

    def claim(self, client: str, amount: int, wake: Callable[[], None], lane: str = "") -> Claim:
        """A claim that is held already, or that waits; NoRoom where too many do."""
        claim = Claim(client, amount, wake, lane)
        with self._lock:
            queue = self._waiting.get((client, lane))
            if not queue and self._fits(claim):
                self._grant(claim)
            elif self._waiting_count >= self._most_waiting or len(queue or ()) >= self._most_of_one:
                raise NoRoom(waited=False)
            else:
                self._waiting.setdefault((client, lane), deque()).append(claim)
                self._waiting_count += 1
        return claim

    def release(self, claim: Claim) -> None:
        """Give back what a claim holds, or no longer wait for it."""
        with self._lock:
            if claim.held:
                claim.held = False
                self._used -= claim.amount
                left = self._used_by[claim.client] - claim.amount
                if left:
                    self._used_by[claim.client] = left
                else:
                    del self._used_by[claim.client]
            else:
                self._forget(claim)
            served = self._served()
        for other in served:
            other.wake()

    def others_wait(self, claim: Claim) -> bool:
        """Whether another client, or another lane, would get what this claim gives back."""
        with self._lock:
            return any(
                (client, lane) != (claim.client, claim.lane)
                and self._used_by.get(client, 0) + queue[0].amount - claim.amount * (client == claim.client)
                <= self._share
                for (client, lane), queue in self._waiting.items()
            )

    @property
    def used(self) -> int:
        """How much is held."""
        return self._used

    @property
    def waiting(self) -> int:
        """How many claims wait."""
        return self._waiting_count

    @asynccontextmanager
    async def held(self, client: str, seconds: float, amount: int = 1) -> AsyncIterator[Claim]:
        """Hold so much, waiting at most so long for it; NoRoom. The claim may be released before the end."""
        loop = asyncio.get_running_loop()
        woken = asyncio.Event()

        def wake() -> None:
            loop.call_soon_threadsafe(woken.set)

        claim = self.claim(client, amount, wake)
        try:
            if not claim.held:
                try:
                    await asyncio.wait_for(woken.wait(), seconds)
                except asyncio.TimeoutError:
                    raise NoRoom(waited=True) from None
            yield claim
        finally:
            self.release(claim)

    def _fits(self, claim: Claim) -> bool:
        of_client = self._used_by.get(claim.client, 0) + claim.amount
        return self._used + claim.amount <= self._total and of_client <= self._share

    def _grant(self, claim: Claim) -> None:
        claim.held = True
        self._used += claim.amount
        self._used_by[claim.client] = self._used_by.get(claim.client, 0) + claim.amount

    def _forget(self, claim: Claim) -> None:
        key = claim.client, claim.lane
        queue = self._waiting.get(key)
        if queue and claim in queue:
            queue.remove(claim)
            self._waiting_count -= 1
            if not queue:
                del self._waiting[key]

    def _served(self) -> list[Claim]:
        """Grant what fits, one a lane and turn."""
        served: list[Claim] = []
        before = -1
        while before < len(served):
            before = len(served)
            for key in list(self._waiting):
                queue = self._waiting[key]
                if self._fits(queue[0]):
                    claim = queue.popleft()
                    self._grant(claim)
                    served.append(claim)
                    self._waiting_count -= 1
                    self._waiting.move_to_end(key)
                    if not queue:
                        del self._waiting[key]
        return served
