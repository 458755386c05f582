"""What attacks on a real server share: the server, a witness in a process of its own, and a mind for both."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

#: Asks paths one after the other until its input ends, and writes how long each took and what was answered.
_WITNESS = """
import http.client, json, sys, threading, time
host, port, source, paths = sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4:]
stop = threading.Event()
threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
seen = []
while not stop.is_set():
    for path in paths:
        started = time.monotonic()
        try:
            connection = http.client.HTTPConnection(host, port, timeout=30, source_address=(source, 0))
            connection.request("GET", path)
            answer = connection.getresponse()
            answer.read()
            status = answer.status
            connection.close()
        except OSError as error:
            status = type(error).__name__
        seen.append([path, time.monotonic() - started, status])
    stop.wait(0.05)
json.dump(seen, sys.stdout)
"""


@dataclass
class Seen:
    """What a witness saw of a path: seconds of every answer, ascending, and the statuses but 200."""

    seconds: list[float]
    other: list[Any]

    def share(self, share: float) -> float:
        """The time within which this share of the answers came."""
        return self.seconds[min(len(self.seconds) - 1, int(len(self.seconds) * share))]


@contextmanager
def witness(url: str, *paths: str, source: str = "127.0.0.1") -> Iterator[dict[str, Seen]]:
    """Ask paths of a server all the time, from another process; what it saw is there when the block ends.

    ``source`` is the address to ask from: another one is another client.
    """
    base = httpx.URL(url)
    seen: dict[str, Seen] = {}
    with subprocess.Popen(
        [sys.executable, "-c", _WITNESS, base.host, str(base.port), source, *paths],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        time.sleep(0.3)
        try:
            yield seen
        finally:
            output, _ = process.communicate(timeout=120)
            for path in paths:
                found = [(seconds, status) for at, seconds, status in json.loads(output) if at == path]
                seen[path] = Seen(
                    sorted(seconds for seconds, _ in found), [status for _, status in found if status != 200]
                )


@dataclass
class RealServer:
    """A server process."""

    url: str
    process: subprocess.Popen[bytes]
    log: Path

    def megabytes(self, what: str = "VmRSS") -> float:
        """Its memory now, or at most so far (``VmHWM``)."""
        lines = Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith(what)) / 1024


@contextmanager
def real_server(folder: Path, database_url: str | None = None, **settings: Any) -> Iterator[RealServer]:
    """``graspdb-server serve`` in a process of its own, with settings as ``GRASPDB_...``."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    url, log = f"http://127.0.0.1:{port}", folder / "server.log"
    database_url = database_url or f"sqlite:///{folder}/graspdb.sqlite"
    command = [sys.executable, "-m", "graspdb_service.cli", "serve", "--port", str(port)]
    environment = {f"GRASPDB_{name.upper()}": str(value) for name, value in settings.items()}
    with log.open("ab") as output:
        process = subprocess.Popen(
            [*command, "--database-url", database_url],
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**os.environ, **environment},
        )
    try:
        deadline = time.monotonic() + 120
        while True:
            assert process.poll() is None, log.read_text(encoding="utf-8")
            assert time.monotonic() < deadline, "the server does not start"
            try:
                if httpx.get(f"{url}/readyz", timeout=5).status_code == 200:
                    break
            except httpx.TransportError:
                pass
            time.sleep(0.1)
        yield RealServer(url, process, log)
    finally:
        process.kill()
        process.wait()
