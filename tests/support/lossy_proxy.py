"""A network that loses answers: the request has arrived and done its work, and nobody hears of it."""

from __future__ import annotations

import random
import socket
import threading
from contextlib import suppress


class LossyProxy:
    """Forwards TCP to ``port``. While ``share`` is above 0, that share of the answers never arrives.

    A lost answer is cut off, before its first byte or in its midst, together with the connection. Which ones
    is drawn from the seed.
    """

    def __init__(self, port: int) -> None:
        self._upstream = port
        self._random = random.Random(0)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self.share = 0.0
        self.lost = 0
        self._sockets: set[socket.socket] = set()
        threading.Thread(target=self._accept, daemon=True).start()

    def lose(self, share: float, seed: int) -> None:
        self._random = random.Random(seed)
        self.share = share

    def close(self) -> None:
        self._listener.close()
        for each in list(self._sockets):
            _close(each)

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            try:
                service = socket.create_connection(("127.0.0.1", self._upstream), 10)
            except OSError:
                client.close()
                continue
            service.settimeout(None)
            self._sockets |= {client, service}
            asked = threading.Event()
            for run in (self._ask, self._answer):
                threading.Thread(target=run, args=(client, service, asked), daemon=True).start()

    def _ask(self, client: socket.socket, service: socket.socket, asked: threading.Event) -> None:
        with suppress(OSError):
            while data := client.recv(65_536):
                asked.set()
                service.sendall(data)
        self._end(client, service)

    def _answer(self, client: socket.socket, service: socket.socket, asked: threading.Event) -> None:
        with suppress(OSError):
            while data := service.recv(65_536):
                # The first bytes after a request are those of its answer.
                begins = asked.is_set()
                asked.clear()
                if begins and self._random.random() < self.share:
                    self.lost += 1
                    client.sendall(data[: self._random.choice([0, 0, 20, len(data) // 2])])
                    break
                client.sendall(data)
        self._end(client, service)

    def _end(self, *both: socket.socket) -> None:
        for each in both:
            _close(each)
            self._sockets.discard(each)


def _close(each: socket.socket) -> None:
    with suppress(OSError):
        each.shutdown(socket.SHUT_RDWR)
    each.close()
