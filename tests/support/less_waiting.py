"""What costs every test the same and proves nothing in it: waits, certificates, reading a known file."""

from __future__ import annotations

import asyncio
import functools
import json
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import httpx
import pytest
import uvicorn
from httpx._transports import default as transports

from graspdb_service.app import create_app
from graspdb_service.settings import Settings
from graspdb_service.usecases.cells import robot_child
from graspdb_service.usecases.geometry import mesh_child
from graspdb_service.usecases.geometry.bounded_child import ChildLimits, bounded

_TICK_S = 0.01


class _Server(uvicorn.Server):
    """As uvicorn's, but it sees within 10 ms, not some tenths of a second, that it is to stop."""

    async def main_loop(self) -> None:
        counter = 0
        while not await self.on_tick(counter):
            await asyncio.sleep(_TICK_S)
            # Every tenth count writes the date that answers carry.
            counter += 1

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for listener in self.servers:
            listener.close()
        for connection in list(self.server_state.connections):
            connection.shutdown()
        while self.server_state.connections or self.server_state.tasks:
            await asyncio.sleep(_TICK_S / 2)
        for listener in self.servers:
            await listener.wait_closed()
        await self.lifespan.shutdown()


@contextmanager
def serving(settings: Settings) -> Iterator[str]:
    """The application on a real uvicorn in a thread; yields its address once it answers."""
    server = _Server(
        uvicorn.Config(
            create_app(settings), host="127.0.0.1", port=0, http="h11", log_level="warning", lifespan="on"
        )
    )
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    deadline = time.monotonic() + 30
    while not server.started:
        if not thread.is_alive() or time.monotonic() > deadline:
            raise RuntimeError("the service did not start")
        time.sleep(_TICK_S / 2)
    port = server.servers[0].sockets[0].getsockname()[1]
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        server.should_exit = True
        thread.join(15)


def one_tls_context() -> None:
    """Clients of this process share what they trust: reading all certificates takes each 25 ms and more."""
    transports.create_ssl_context = functools.cache(httpx.create_ssl_context)


def read_once(patch: pytest.MonkeyPatch) -> None:
    """A file that a child process has read is known, for the same order and limits; a refusal is not kept."""
    known: dict[tuple[str, str, bytes, ChildLimits], bytes] = {}

    def remembered(module: str, order: Mapping[str, Any], data: bytes, limits: ChildLimits) -> bytes:
        key = (module, json.dumps(order, sort_keys=True), bytes(data), limits)
        if key not in known:
            known[key] = bounded(module, order, data, limits)
        return known[key]

    for reader in (mesh_child, robot_child):
        patch.setattr(reader, "bounded", remembered)
