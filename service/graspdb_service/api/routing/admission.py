"""What every request passes before its route: room for its body, and a place among its kind."""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from typing import Any, get_args

import anyio.to_thread
from fastapi import Request, Response

from graspdb_service.api.access.guard import GuardedRoute
from graspdb_service.api.routing.bodies import Bodies, Received, no_room
from graspdb_service.api.routing.scopes import BODY_FIELD, PLACE_FIELD, SCOPE_FIELD, Work
from graspdb_service.settings import Settings
from graspdb_service.usecases.runtime.asked import Asked, begin
from graspdb_service.usecases.runtime.fair_share import FairShare, NoRoom

#: Threads beside those that places have: for what is public, and for answers that are streamed.
_SPARE_THREADS = 12
_IN_WORDS: dict[str, str] = {
    "queries": "questions to densities",
    "reports": "reports",
    "uploads": "batches of trials and results",
    "meshes": "meshes",
    "writes": "changes",
    "reads": "reads",
}


class Admission:
    """Room and places of one service process, shared fairly between clients."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.bodies = Bodies(settings)
        most = {work: int(getattr(settings, f"max_{work}_at_once")) for work in get_args(Work)}
        # Long questions keep their thread when they give their place to a short one.
        long = settings.max_long_questions_at_once + settings.max_queries_at_once
        self._threads = sum(most.values()) + long + _SPARE_THREADS
        self._places = {
            f"max_{work}_at_once": (work, FairShare(count, max(1, count * 3 // 4), settings.max_waiting))
            for work, count in most.items()
        }

    def open(self) -> None:
        """Have as many threads as places: whoever has one never waits for the other. In the event loop."""
        anyio.to_thread.current_default_thread_limiter().total_tokens = self._threads

    @property
    def is_quiet(self) -> bool:
        """Whether no large body is held."""
        return self.bodies.held_bytes < self.settings.max_small_body_bytes

    @contextlib.asynccontextmanager
    async def place(self, field: str, client: str) -> AsyncIterator[Callable[[], None]]:
        """A place of a kind, in turns of clients, and what gives it back early; 429 where too many wait, 503
        after waiting in vain.
        """
        work, places = self._places[field]
        try:
            async with places.held(client, self.settings.max_waiting_seconds) as claim:
                yield functools.partial(places.release, claim)
        except NoRoom as error:
            raise no_room(f"All places for {_IN_WORDS[work]} are taken", error) from None


def client_of(request: Request) -> str:
    """Whose request it is, for fair shares: the id of its key, else the peer's address."""
    key: str | None = getattr(request.state, "key_id", None)
    if key is not None:
        return f"key {key}"
    return "" if request.client is None else request.client.host


class AdmittedRoute(GuardedRoute):
    """A route whose requests pass admission; what it declares (see ``scope``) says how."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()
        declared = self.openapi_extra or {}
        if declared.get(SCOPE_FIELD) == "public":
            return handle
        by_method = (
            "max_reads_at_once" if (self.methods or set()) <= {"GET", "HEAD"} else "max_writes_at_once"
        )
        place = str(declared.get(PLACE_FIELD, by_method))
        limit = str(declared.get(BODY_FIELD, "max_small_body_bytes"))

        async def admitted(request: Request) -> Response:
            admission: Admission = request.app.state.admission
            client = client_of(request)
            most = int(getattr(admission.settings, limit))
            async with (
                admission.bodies.read(request, client, most) as received,
                admission.place(place, client) as give_place,
            ):
                asks = place == "max_queries_at_once"
                question = Asked(client, may_be_stale=asks, give_place=give_place if asks else None)
                begin(question)
                try:
                    return await _while_wanted(handle, received, question)
                finally:
                    question.end()

        return admitted


async def _while_wanted(
    handle: Callable[[Request], Awaitable[Response]], request: Received, question: Asked
) -> Response:
    """Handle a request whose body is read, and note when its client hangs up meanwhile."""

    async def watch() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass
        question.gone = True

    watching = asyncio.create_task(watch())
    try:
        return await handle(request)
    finally:
        watching.cancel()
