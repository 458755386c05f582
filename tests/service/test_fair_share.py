"""Shares between clients: never more than there is, turn by turn, and nobody waits for ever."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspdb_service.problems import ProblemError
from graspdb_service.usecases.runtime import asked
from graspdb_service.usecases.runtime.asked import Asked, begin
from graspdb_service.usecases.runtime.compute import Compute, breathe
from graspdb_service.usecases.runtime.fair_share import Claim, FairShare, NoRoom


@pytest.fixture(autouse=True)
def _own_question() -> Iterator[None]:
    """Whose question a test works on, and by when, is nothing to the next one in this process."""
    before = asked._ASKED.set(None)
    yield
    asked._ASKED.reset(before)


CLIENTS = st.sampled_from("abc")


def nothing() -> None: ...


@given(st.lists(st.tuples(CLIENTS, st.integers(1, 3)) | st.integers(0, 30), max_size=60))
def test_never_more_than_there_is_and_nothing_free_is_held_back(
    steps: list[tuple[str, int] | int],
) -> None:
    total, share = 6, 4
    room = FairShare(total, share, 1_000)
    claims: deque[Claim] = deque()
    for step in steps:
        if isinstance(step, tuple):
            claims.append(room.claim(*step, nothing))
        elif claims:
            claims.rotate(step)
            room.release(claims.popleft())
        held = [claim for claim in claims if claim.held]
        used = sum(claim.amount for claim in held)
        assert used == room.used <= total
        of = {name: sum(claim.amount for claim in held if claim.client == name) for name in "abc"}
        assert max(of.values()) <= share
        waiting = [claim for claim in claims if not claim.held]
        assert all(
            used + claim.amount > total or of[claim.client] + claim.amount > share
            for claim in waiting
            if not any(other.client == claim.client and other is not claim for other in waiting)
        )
    for claim in claims:
        room.release(claim)
    assert room.used == 0


def test_clients_are_served_in_turn() -> None:
    room = FairShare(1, 1, 100)
    first = room.claim("greedy", 1, nothing)
    greedy = [room.claim("greedy", 1, nothing) for _ in range(20)]
    modest = room.claim("modest", 1, nothing)
    room.release(first)
    room.release(next(claim for claim in (modest, *greedy) if claim.held))
    assert modest.held or sum(claim.held for claim in greedy) == 1
    if not modest.held:
        room.release(next(claim for claim in greedy if claim.held))
    assert modest.held


def test_one_client_does_not_fill_the_queue() -> None:
    room = FairShare(1, 1, 4)
    held = room.claim("greedy", 1, nothing)
    for _ in range(3):
        room.claim("greedy", 1, nothing)
    with pytest.raises(NoRoom):
        room.claim("greedy", 1, nothing)
    modest = room.claim("modest", 1, nothing)
    room.release(held)
    assert room.used == 1
    assert not room.others_wait(modest) or not modest.held


def test_waiting_ends() -> None:
    async def wait() -> None:
        room = FairShare(1, 1, 10)
        async with room.held("a", 1.0):
            with pytest.raises(NoRoom) as caught:
                async with room.held("b", 0.01):
                    pass
            assert caught.value.waited
        async with room.held("b", 1.0):
            assert room.used == 1

    asyncio.run(wait())


def test_a_long_computation_lets_another_clients_short_one_between() -> None:
    compute = Compute(1)
    going, between, ended = threading.Event(), threading.Event(), threading.Event()

    def long() -> None:
        begin(Asked("greedy"))

        def work() -> None:
            going.set()
            while not between.wait(0.005):
                breathe()

        compute.run(work)

    def hold() -> None:
        begin(Asked("other"))
        compute.run(lambda: ended.wait(30))

    threads = [threading.Thread(target=work, daemon=True) for work in (long, hold)]
    for thread in threads:
        thread.start()
    assert going.wait(10)
    begin(Asked("modest"))
    compute.run(between.set)
    ended.set()
    for thread in threads:
        thread.join(10)
        assert not thread.is_alive()


def test_long_questions_leave_place_and_processor_to_their_own_askers_short_ones() -> None:
    """Ten of them on one processor: two go on in turns, the others wait, and a short one gets between."""
    compute = Compute(1, long=3, waiting_long=20)
    done, left, steps = threading.Event(), [], Counter[int]()

    def long(number: int) -> None:
        question = Asked("greedy", give_place=lambda: left.append(number))
        begin(question)

        def work() -> None:
            while not done.is_set():
                steps[number] += 1
                time.sleep(0.002)
                breathe()

        compute.run(work)
        question.end()

    threads = [threading.Thread(target=long, args=(number,), daemon=True) for number in range(10)]
    for thread in threads:
        thread.start()
    end = time.monotonic() + 60
    while len(left) < 10:
        assert time.monotonic() < end, left
        time.sleep(0.01)
    before = Counter(steps)
    begin(Asked("greedy"))
    for _ in range(5):
        compute.run(lambda: time.sleep(0.05))
    went_on = [number for number in range(10) if steps[number] > before[number]]
    assert len(went_on) <= 2
    done.set()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()


def test_work_for_nobody_and_work_that_is_late_ends() -> None:
    compute = Compute(1, max_question_seconds=60)
    question = Asked("a")
    begin(question)
    question.gone = True
    with pytest.raises(ProblemError) as caught:
        compute.run(breathe)
    assert caught.value.status == 499
    question.gone = False
    question.reached("computing poses", 3, 10)
    with compute.within(SimpleNamespace(timeout_s=1e-9)), pytest.raises(ProblemError) as caught:
        compute.run(breathe)
    assert (caught.value.status, caught.value.kind) == (503, "deadline")
    assert caught.value.extra["reached"] == {"step": "computing poses", "done": 3, "of": 10, "seconds": 1e-9}
