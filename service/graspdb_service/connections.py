"""Connections of bounded patience: for a request's head, between requests, for who reads no answer."""

from __future__ import annotations

import asyncio
import resource
import sys
from contextlib import suppress
from types import FrameType
from typing import TYPE_CHECKING

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from graspdb_service.settings import Settings
from graspdb_service.usecases.runtime.asked import end_all

if TYPE_CHECKING:
    from fastapi import FastAPI

#: Seconds for what is left of a body whose request has been answered already.
_REST_S = 10.0
#: Open files that are no connections: the database's, the programs' own.
_OTHER_FILES = 200


# long: a class whose methods know the settings
def protocol(settings: Settings) -> type[H11Protocol]:
    """uvicorn's protocol with the settings' time-outs, and at most so many connections of this process.

    One more closes the one that has been without a request for longest.
    """
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = max(10, min(settings.max_connections, files - _OTHER_FILES))
    # By how long they have been so.
    idle: dict[Connection, None] = {}

    class Connection(H11Protocol):
        """One connection, with a timer for whatever it waits for."""

        waiting: asyncio.TimerHandle | None = None
        writing: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            idle[self] = None
            self.expect(settings.max_header_seconds)
            if len(self.connections) > most:
                next(iter(idle)).transport.abort()

        def connection_lost(self, exc: Exception | None) -> None:
            idle.pop(self, None)
            self.expect(None)
            self.wait_for_reader(None)
            super().connection_lost(exc)

        def data_received(self, data: bytes) -> None:
            if self.waiting is None and self in idle:
                self.expect(settings.max_header_seconds)
            super().data_received(data)
            if self.cycle is not None and not self.cycle.response_complete:
                idle.pop(self, None)
                self.expect(None)

        def on_response_complete(self) -> None:
            self.expect(None)
            idle[self] = None
            super().on_response_complete()
            if self.cycle.response_complete and self.conn.their_state is h11.SEND_BODY:
                self.expect(_REST_S)

        def pause_writing(self) -> None:
            super().pause_writing()
            self.wait_for_reader(self.transport.get_write_buffer_size())

        def resume_writing(self) -> None:
            self.wait_for_reader(None)
            super().resume_writing()

        def expect(self, seconds: float | None) -> None:
            """Close the connection unless what it waits for comes within this; None: it has come."""
            if self.waiting is not None:
                self.waiting.cancel()
            self.waiting = None if seconds is None else self.loop.call_later(seconds, self.transport.abort)

        def wait_for_reader(self, left: int | None) -> None:
            """Look again later how much of ``left`` bytes was read meanwhile; None: enough."""
            if self.writing is not None:
                self.writing.cancel()
            seconds = settings.max_reader_stall_seconds
            self.writing = None if left is None else self.loop.call_later(seconds, self.look_at_reader, left)

        def look_at_reader(self, before: int) -> None:
            left = self.transport.get_write_buffer_size()
            if before - left < settings.min_body_bytes_per_second * settings.max_reader_stall_seconds:
                self.transport.abort()
            else:
                self.wait_for_reader(left)

    return Connection


class _Server(uvicorn.Server):
    """A server that ends what it computes when it is told to stop."""

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        end_all()
        super().handle_exit(sig, frame)


def serve(app: FastAPI, settings: Settings) -> None:
    """Serve until a signal says to stop; then whoever is being answered has 10 s more."""
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        # h11 refuses headers over 64 KiB; httptools would collect them without end.
        http=protocol(settings),
        timeout_keep_alive=settings.max_idle_seconds,
        # Its lines go where ours do; that of a request is ours alone.
        log_config=None,
        log_level=settings.log_level,
        access_log=False,
        timeout_graceful_shutdown=10,
        ssl_certfile=settings.ssl_certfile,
        ssl_keyfile=settings.ssl_keyfile,
    )
    server = _Server(config)
    with suppress(KeyboardInterrupt):
        server.run()
    if not server.started:
        sys.exit(3)
