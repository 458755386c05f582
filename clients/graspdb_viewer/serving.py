"""The viewer's server: a session for every browser tab that comes from its own page."""

from __future__ import annotations

import contextlib
import ipaddress
import threading
from collections.abc import Collection, Iterator
from functools import partial
from typing import Any
from urllib.parse import urlsplit

import viser

from graspdb import Client
from graspdb_viewer.session import Session
from graspdb_viewer.view import View

_STALE = "**This link's view can't be read**: it is cut, or of another version. This is the default view."


def link_to(origin: str, view: View) -> str:
    """The address of a view at a viewer's ``http://host:port``."""
    # The page opens the WebSocket that its address names, whose own query comes to the server.
    return f"{origin}/?websocket={origin.replace('http', 'ws', 1)}/?{view.token()}"


class ViewerServer:
    """Serves pages at :attr:`url` until :meth:`stop`.

    ``view`` is what a page shows that is opened without a link; ``names`` are those that it may be opened
    under beside addresses and ``localhost``. OSError where the port is taken.
    """

    def __init__(
        self, db: Client, *, host: str, port: int, view: View, names: Collection[str], api_key: str | None
    ) -> None:
        self._db, self._view, self._api_key, self._names = db, view, api_key, names
        self.sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        self._server = viser.ViserServer(host=host, port=port, label="GraspDB", verbose=False)
        bound = self._server.get_port()
        if port not in (0, bound):
            self._server.stop()
            raise OSError(f"port {port} is taken: --port names another")
        shown = "127.0.0.1" if host in ("0.0.0.0", "::") else host
        self.url = f"http://{shown}:{bound}"
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._gone)

    def stop(self) -> None:
        """End all pages."""
        for session in self.sessions.values():
            session.close()
        self._server.stop()

    def _connected(self, client: viser.ClientHandle) -> None:
        asked = self._handshake(client)
        origin = asked.headers.get("Origin") if asked is not None else None
        if asked is None or origin is None or not self._ours(origin, asked.headers.get("Host")):
            return  # another site's page in the user's browser: it is shown nothing
        view, stale = self._view.model_copy(deep=True), False
        token = urlsplit(asked.path).query
        if token:
            try:
                view = View.of(token)
            except ValueError:
                stale = True

        session = Session(client, self._db, view, partial(link_to, origin), api_key=self._api_key)
        if stale:
            session.page.client.add_notification("Link", _STALE, color="yellow")
        with self._lock:
            self.sessions[client.client_id] = session

    def _ours(self, origin: str, host: str | None) -> bool:
        """Whether a page is this viewer's own, under a name that no other site can give itself."""
        site = urlsplit(origin)
        name = site.hostname or ""
        if site.netloc != host:
            return False
        try:
            ipaddress.ip_address(name)  # a number is nobody's to point elsewhere
        except ValueError:
            return name == "localhost" or name in self._names
        return True

    def _gone(self, client: viser.ClientHandle) -> None:
        with self._lock:
            session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    def _handshake(self, client: viser.ClientHandle) -> Any:
        """The request that opened a client's WebSocket, which viser keeps for itself; None: it is gone."""
        connections = self._server._websock_server._live_connections
        connection = connections.get(client.client_id)
        return None if connection is None else connection.request


@contextlib.contextmanager
def serving(
    db: Client,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    view: View | None = None,
    names: Collection[str] = (),
    api_key: str | None = None,
) -> Iterator[ViewerServer]:
    """A viewer of this service while the context lasts."""
    server = ViewerServer(db, host=host, port=port, view=view or View(), names=names, api_key=api_key)
    try:
        yield server
    finally:
        server.stop()
