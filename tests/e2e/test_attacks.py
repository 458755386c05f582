"""Attacks on a real server: nothing that one client does keeps ``/livez`` and ``/readyz`` from answering.

How quick they are is measured by the benchmark ``service_under_attack``; here only that they answer all the
while, within seconds rather than the half minute that each of these attacks once took.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from attack import RealServer, Seen, real_server, witness

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
        assert found.seconds[-1] < 5.0, (path, found.seconds[-3:])


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
