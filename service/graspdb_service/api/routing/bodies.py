"""Reading a request's body: so long, so large and so much of them at a time, and not slower than a rate."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import anyio
from fastapi import Request
from starlette.requests import ClientDisconnect

from graspdb_service.problems import ProblemError, busy
from graspdb_service.settings import Settings
from graspdb_service.usecases.runtime.fair_share import FairShare, NoRoom

#: Seconds before a body's rate counts.
_GRACE_S = 10.0


class Received(Request):
    """A request whose body has been read already."""

    content: Any = b""

    async def body(self) -> Any:
        """The bytes, not copied: a large copy would hold up every other request."""
        return self.content


class Bodies:
    """The bodies that the service holds."""

    def __init__(self, settings: Settings) -> None:
        total = max(settings.max_bytes_in_flight, settings.max_body_bytes)
        share = max(total // 2, settings.max_body_bytes)
        self._settings = settings
        self._room = FairShare(total, share, settings.max_waiting)

    @property
    def held_bytes(self) -> int:
        """Bytes of all bodies that are held or under way."""
        return self._room.used

    @asynccontextmanager
    async def read(self, request: Request, client: str, most: int) -> AsyncIterator[Received]:
        """The request with its body, which takes room until the block ends.

        413 over ``most`` bytes, 408 where it comes too slowly, 503 and 429 where there is no room for it.
        """
        received = Received(request.scope, request.receive)
        length = request.headers.get("content-length", "")
        declared = int(length) if length.isdigit() else None
        if declared == 0 or (declared is None and "transfer-encoding" not in request.headers):
            yield received
            return
        if declared is not None and declared > most:
            raise too_large(most)
        try:
            async with self._room.held(client, self._settings.max_waiting_seconds, declared or most):
                received.content = await self._content(request, most)
                yield received
        except NoRoom as error:
            raise no_room("The service holds as many bytes of bodies as it may", error) from None

    async def _content(self, request: Request, most: int) -> bytearray:
        content = bytearray()
        started = anyio.current_time()
        settings = self._settings
        try:
            with anyio.fail_after(min(_GRACE_S, settings.max_body_seconds)) as limit:
                while True:
                    message = await request.receive()
                    if message["type"] == "http.disconnect":
                        raise ClientDisconnect
                    content += message.get("body", b"")
                    if len(content) > most:
                        raise too_large(most)
                    if not message.get("more_body", False):
                        return content
                    enough = _GRACE_S + len(content) / max(settings.min_body_bytes_per_second, 1)
                    limit.deadline = started + min(enough, settings.max_body_seconds)
        except TimeoutError:
            raise ProblemError(
                408,
                "body-too-slow",
                f"The body came too slowly: within {settings.max_body_seconds:g} s, at"
                f" {settings.min_body_bytes_per_second:,} bytes a second or more; send it again, in smaller"
                " parts",
                headers={"Connection": "close"},
            ) from None


def too_large(most: int) -> ProblemError:
    """413, before or while a body is read."""
    return ProblemError(
        413,
        "body-too-large",
        f"The body is over the limit of {most:,} bytes for this route (see /info): send less, or in several"
        " requests",
        extra={"limit": most},
    )


def no_room(what: str, error: NoRoom) -> ProblemError:
    """429 where too many wait already, 503 after waiting in vain."""
    if error.waited:
        return busy(f"{what}, and waiting took too long: try again in a few seconds", retry_after_s=5)
    return busy(f"{what}, and too many requests wait: try again in a second", status=429)
