"""Attacks on a real server: nothing that one client does keeps ``/livez`` and ``/readyz`` from answering.

How quick they are is measured by the benchmark ``service_under_attack``; here only that they answer all the
while, within seconds rather than the half minute that each of these attacks once took.
"""

from __future__ import annotations

import json
import os
import socket
import sqlite3
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from attack import RealServer, Seen, real_server, witness
from graspdb import Client
from graspdb.errors import DeadlineExceeded
from graspdb_service.storage import schema
from graspdb_service.storage.database import Database
from postgres_server import PostgresPrograms, PostgresServer

JSON = {"Content-Type": "application/json"}
ROW = b'{"position":[0.0,0.01,0.09],"quaternion_xyzw":[1,0,0,0],"outcome":true}'
HEALTH = ("/livez", "/readyz")
MIB = 2**20


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealServer]:
    """A server with the object ``mug``."""
    with real_server(tmp_path_factory.mktemp("server")) as server:
        httpx.post(f"{server.url}/objects", json={"id": "mug"}).raise_for_status()
        yield server


def answered(seen: dict[str, Seen]) -> None:
    """Every answer of the witness's came, was 200, and not late."""
    for path, found in seen.items():
        assert found.seconds, path
        assert not found.other, (path, found.other)
        assert found.seconds[-1] < 10.0, (path, found.seconds[-3:])


def lists(size: int) -> bytes:
    return b"[" + b"[]," * (size // 3) + b"[]]"


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("/objects", b'{"id":"x","metadata":{"a":' + lists(24 * MIB) + b"}}", 413),
        ("/objects/mug/samples", b'{"a":' + lists(24 * MIB) + b"}", 413),
        ("/objects/mug/trials", b'{"id":"x","metadata":{"a":' + lists(48 * MIB) + b"}}", 422),
        ("/objects/mug/trials", lists(48 * MIB), 422),
        ("/objects/mug/trials", b'{"trials":[' + ROW + b',{"a":"' + b"a" * (24 * MIB) + b'"}]}', 422),
        ("/objects/mug/trials", b'{"trials":' + b"[" * 100_000 + b"]" * 100_000 + b" " * MIB + b"}", 422),
        ("/objects/mug/trials", b'{"trials":[' + b",".join([ROW] * 200_000) + b"]}", 201),
        ("/objects/mug/likelihood", lists(48 * MIB), 422),
    ],
    ids=["object", "samples", "metadata", "lists", "one-item", "nesting", "rows", "likelihood"],
)
def test_large_json_keeps_nobody_waiting(server: RealServer, path: str, body: bytes, status: int) -> None:
    with httpx.Client(base_url=server.url, timeout=240) as http, witness(server.url, *HEALTH) as seen:
        answer = http.post(path, content=body, headers=JSON)
    assert answer.status_code == status, answer.text[:500]
    if status >= 400:
        assert answer.headers["content-type"] == "application/problem+json"
    answered(seen)


def closed_within(connection: socket.socket, seconds: float) -> bool:
    """Whether the server closes a connection before that, whatever it says first."""
    connection.settimeout(seconds)
    try:
        while connection.recv(65_536):
            pass
    except TimeoutError:
        return False
    except OSError:
        pass
    return True


def connect(server: RealServer, sent: bytes) -> socket.socket:
    url = httpx.URL(server.url)
    connection = socket.create_connection((url.host, url.port), timeout=30)
    connection.sendall(sent)
    return connection


POST = b"POST /objects/mug/trials HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"


def test_connections_are_not_kept_for_ever(tmp_path: Path) -> None:
    """Without a head, within one, without the rest of a body, and between two requests."""
    patience = {"max_header_seconds": 1, "max_idle_seconds": 1, "max_body_seconds": 1, "max_connections": 60}
    with real_server(tmp_path, **patience) as server, httpx.Client(base_url=server.url, timeout=60) as http:
        http.post("/objects", json={"id": "mug"})
        for sent in (b"", b"GET /livez HTTP/1.1\r\nX-A: ", b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n"):
            with connect(server, sent) as connection:
                assert closed_within(connection, 30), sent
        with connect(server, POST + b"Content-Length: 1000\r\n\r\n{") as connection:
            connection.settimeout(60)
            assert b" 408 " in connection.recv(65_536)
            assert closed_within(connection, 60)
        with ExitStack() as stack:
            for _ in range(150):
                stack.enter_context(connect(server, b""))
            assert http.get("/livez").status_code == 200


def test_who_does_not_read_is_cut_off(tmp_path: Path) -> None:
    ask = b"GET /objects/mug/trials HTTP/1.1\r\nHost: localhost\r\nAccept: application/x-ndjson\r\n\r\n"
    with real_server(tmp_path, max_reader_stall_seconds=1) as server:
        with httpx.Client(base_url=server.url, timeout=240) as http:
            http.post("/objects", json={"id": "mug"})
            body = b'{"trials":[' + b",".join([ROW] * 100_000) + b"]}"
            assert http.post("/objects/mug/trials", content=body, headers=JSON).status_code == 201
        with connect(server, ask) as connection, witness(server.url, *HEALTH) as seen:
            time.sleep(6.0)
            # What is left is what was on its way already: far less than there was to read.
            connection.settimeout(60)
            got = 0
            try:
                while piece := connection.recv(2**20):
                    got += len(piece)
            except OSError:
                pass
        assert 0 < got < 20 * MIB
        answered(seen)


def test_bodies_in_flight_are_bounded(tmp_path: Path) -> None:
    """Bodies that never end, of one client, leave room for another's; they are told to wait, or refused."""
    room = {"max_body_bytes": 8 * MIB, "max_bytes_in_flight": 16 * MIB, "max_waiting_seconds": 1}
    with real_server(tmp_path, **room) as server, ExitStack() as stack:
        before = server.megabytes()
        url = httpx.URL(server.url)
        httpx.post(f"{server.url}/objects", json={"id": "mug"})
        for _ in range(20):
            connection = stack.enter_context(socket.create_connection((url.host, url.port), timeout=1))
            length = 7 * MIB
            with suppress(OSError):
                connection.sendall(POST + b"Content-Length: %d\r\n\r\n" % length + b" " * (length - 1))
        assert server.megabytes("VmHWM") < before + 150
        transport = httpx.HTTPTransport(local_address="127.0.0.2")
        with httpx.Client(base_url=server.url, transport=transport, timeout=60) as other:
            answer = other.post("/objects/mug/trials", content=b'{"trials":[' + ROW + b"]}", headers=JSON)
        assert answer.status_code == 201, answer.text
        large = b" " * 7 * MIB
        answer = httpx.post(f"{server.url}/objects/mug/trials", content=large, headers=JSON, timeout=60)
        assert answer.status_code in (429, 503)
        assert int(answer.headers["retry-after"]) > 0


NOISE: dict[str, Any] = {
    "objective": "robust",
    "pose_noise_m": 0.02,
    "pose_noise_deg": 20,
    "tool_noise_deg": 5,
    "count": 50,
}


@pytest.fixture(scope="module")
def crowded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RealServer]:
    """A server with an object of many grasps, ``large``, and one of few, ``small``."""
    rng = np.random.default_rng(0)
    with (
        real_server(tmp_path_factory.mktemp("crowded"), threads=1) as server,
        httpx.Client(base_url=server.url, timeout=240) as http,
    ):
        for name, count in (("large", 20_000), ("small", 100)):
            http.post("/objects", json={"id": name})
            turns = rng.normal((1, 0, 0, 0), 0.2, (count, 4))
            columns = {
                "position": rng.normal(0, 0.02, (count, 3)).tolist(),
                "quaternion_xyzw": (turns / np.linalg.norm(turns, axis=1)[:, None]).tolist(),
                "outcome": [bool(i % 2) for i in range(count)],
            }
            http.post(f"/objects/{name}/trials", json={"columns": columns}).raise_for_status()
            http.get(f"/objects/{name}/best-grasp").raise_for_status()
        yield server


def test_time_runs_out_with_what_was_reached(crowded: RealServer) -> None:
    url = f"{crowded.url}/objects/large"
    answer = httpx.post(f"{url}/best-grasp", json={**NOISE, "timeout_s": 0.2}, timeout=120)
    assert answer.status_code == 503, answer.text[:300]
    assert answer.json()["type"].endswith(":deadline")
    assert answer.json()["reached"]["seconds"] == 0.2
    assert "timeout_s" in answer.json()["title"]
    with Client(crowded.url) as db, pytest.raises(DeadlineExceeded):
        db.objects.get("large").best_grasps(**NOISE, timeout_s=0.2)
    # An answer is the same whatever time it was given.
    quick = httpx.get(f"{url}/best-grasp", timeout=120)
    timed = httpx.get(f"{url}/best-grasp?timeout_s=100", timeout=120)
    assert (timed.json(), timed.headers["etag"]) == (quick.json(), quick.headers["etag"])


def test_who_hangs_up_is_not_computed_for(crowded: RealServer) -> None:
    body = json.dumps(NOISE).encode()
    head = b"POST /objects/large/best-grasp HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    for _ in range(20):
        with connect(crowded, head + b"Content-Length: %d\r\n\r\n" % len(body) + body):
            time.sleep(0.02)
    with witness(crowded.url, "/objects/small/density?sigma_position_m=0.01", *HEALTH) as seen:
        time.sleep(3.0)
    for found in seen.values():
        assert not found.other
        assert found.seconds[-1] < 20.0


def test_one_client_leaves_the_others_their_share(crowded: RealServer) -> None:
    """20 robust questions at once from one address: another's small one is answered between them."""

    def saturate() -> None:
        with suppress(httpx.HTTPError), httpx.Client(base_url=crowded.url, timeout=120) as http:
            http.post("/objects/large/best-grasp", json={**NOISE, "timeout_s": 15})

    threads = [threading.Thread(target=saturate) for _ in range(20)]
    for thread in threads:
        thread.start()
    transport = httpx.HTTPTransport(local_address="127.0.0.2")
    with httpx.Client(base_url=crowded.url, transport=transport, timeout=60) as other:
        for _ in range(20):
            started = time.monotonic()
            assert other.get("/objects/small/best-grasp").status_code == 200
            assert time.monotonic() - started < 20.0
    for thread in threads:
        thread.join()


def test_it_ends_when_it_is_told_to(tmp_path: Path, crowded: RealServer) -> None:
    """The last test of its server: a robust question is cut short."""
    answers: list[httpx.Response] = []

    def ask() -> None:
        answers.append(httpx.post(f"{crowded.url}/objects/large/best-grasp", json=NOISE, timeout=120))

    thread = threading.Thread(target=ask)
    thread.start()
    time.sleep(1.0)
    crowded.process.terminate()
    crowded.process.wait(60)
    thread.join()
    assert answers[0].status_code in (200, 503)


def ready(server: RealServer) -> httpx.Response:
    return httpx.get(f"{server.url}/readyz", timeout=30)


def test_readiness_is_true(tmp_path: Path, eventually: Callable[..., Any]) -> None:
    """A file that is moved away, back, or written by a newer version; and that no new one takes its place."""
    file = tmp_path / "graspdb.sqlite"
    with real_server(tmp_path, probe_seconds=0.1) as server:
        names = [Path(f"{file}{end}") for end in ("", "-wal", "-shm")]
        for name in names:
            os.rename(name, f"{name}.away")
        answer = eventually(lambda: (found := ready(server)).status_code == 503 and found)
        assert "moved or replaced" in answer.json()["title"]
        assert answer.json()["age_s"] >= 0
        assert not file.exists()
        for name in names:
            os.rename(f"{name}.away", name)
        eventually(lambda: ready(server).status_code == 200)
        with sqlite3.connect(file) as database:
            database.execute("UPDATE alembic_version SET version_num = 'newer'")
        answer = eventually(lambda: (found := ready(server)).status_code == 503 and found)
        assert "schema newer" in answer.json()["title"]


def test_a_hanging_postgresql_is_not_waited_for(tmp_path: Path, eventually: Callable[..., Any]) -> None:
    """It accepts and never answers: refusals, also to who asked before that was known; then it goes on."""
    with ExitStack() as stack:
        # A user without privileges has to read it.
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="graspdb-postgres-")))
        postgres = PostgresServer(folder, PostgresPrograms(folder))
        stack.callback(postgres.stop)
        database = Database(postgres.url)
        schema.upgrade(database)
        database.dispose()
        server = stack.enter_context(real_server(tmp_path, postgres.url, probe_seconds=0.5))
        http = stack.enter_context(httpx.Client(base_url=server.url, timeout=120))
        assert http.post("/objects", json={"id": "mug"}).status_code == 201
        postgres.pause()
        asked_early = http.get("/objects/mug")
        assert (asked_early.status_code, asked_early.json()["type"].rpartition(":")[2]) == (
            503,
            "database-unavailable",
        )
        assert http.get("/livez").status_code == 200
        assert http.get("/readyz").status_code == 503
        started = time.monotonic()
        assert http.get("/objects/mug").status_code == 503
        assert time.monotonic() - started < 5.0
        postgres.resume()
        eventually(lambda: http.get("/objects/mug").status_code == 200)
        eventually(lambda: http.get("/readyz").status_code == 200)
