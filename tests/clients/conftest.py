"""The real service in a process of its own, shared by the tests of the clients."""

from __future__ import annotations

import importlib
import os
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest
from typer.testing import CliRunner

from graspdb import Client, cli
from graspdb.processes import ChildProcess


def _command(name: str) -> str:
    return str(Path(sys.executable).with_name(name))


def _stop(process: ChildProcess) -> None:
    process.terminate()
    try:
        process.wait(30)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextmanager
def _served(folder: Path) -> Iterator[str]:
    """``graspdb-server serve`` on a scratch SQLite in this folder; its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    log = folder / "log"
    with log.open("wb") as output:
        process = ChildProcess(
            [_command("graspdb-server"), "serve", "--host", "127.0.0.1", "--port", str(port)],
            env={**os.environ, "GRASPDB_DATABASE_URL": f"sqlite:///{folder / 'graspdb.sqlite'}"},
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        deadline = time.monotonic() + 240
        while True:
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < deadline, log.read_text()
            try:
                if httpx.get(f"{url}/readyz").is_success:
                    break
            except httpx.TransportError:
                pass
            time.sleep(0.05)
        yield url
    finally:
        _stop(process)


@contextmanager
def _worked(url: str, log: Path) -> Iterator[None]:
    """``graspdb-simworker run`` beside the service."""
    with log.open("wb") as output:
        process = ChildProcess(
            [_command("graspdb-simworker"), "run", "--url", url, "--processes", "1"],
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        yield
        assert process.poll() is None, log.read_text()
    finally:
        _stop(process)


@pytest.fixture(scope="session")
def service_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A service; its address."""
    with _served(tmp_path_factory.mktemp("service")) as url:
        yield url


@pytest.fixture(scope="session")
def worker(service_url: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A worker of the service."""
    with _worked(service_url, tmp_path_factory.mktemp("worker") / "log"):
        yield


@pytest.fixture
def own_service_url(tmp_path: Path) -> Iterator[str]:
    """A service with a worker, of this test's own: its objects may have any name."""
    with _served(tmp_path) as url, _worked(url, tmp_path / "worker.log"):
        yield url


@pytest.fixture
def db(service_url: str) -> Iterator[Client]:
    """A client of the service."""
    with Client(service_url, retries=1) as client:
        yield client


@pytest.fixture
def fresh_id() -> str:
    """An object's id that no other test has."""
    return f"object-{uuid.uuid4().hex[:12]}"


@pytest.fixture
def run(
    service_url: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str, str]]:
    """Run ``graspdb`` with these arguments: exit code, standard output, standard error."""
    monkeypatch.setenv("GRASPDB_URL", service_url)
    monkeypatch.setenv("COLUMNS", "200")

    def invoke(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["graspdb", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        captured = capsys.readouterr()
        code = ended.value.code
        return (code if isinstance(code, int) else 0 if code is None else 1), captured.out, captured.err

    return invoke


@pytest.fixture
def help_of() -> Callable[..., str]:
    """The help of a command of ours after these arguments, all of which it must know; nothing runs."""
    programs = {
        "graspdb": ("graspdb.cli", "app"),
        "graspdb-server": ("graspdb_service.cli", "cli"),
        "graspdb-simworker": ("graspdb_simworker.cli", "app"),
    }

    def text(program: str, *arguments: str) -> str:
        module, name = programs[program]
        app = getattr(importlib.import_module(module), name)
        shown = CliRunner().invoke(app, [*arguments, "--help"])
        assert shown.exit_code == 0, (program, arguments, shown.output)
        return shown.output

    return text


@pytest.fixture
def clusters() -> Callable[..., np.ndarray]:
    """Poses (N, 7) about centres: Gaussian in position and, by small rotation vectors, in rotation."""

    def make(centres: list[tuple[list[float], list[float]]], count: int, seed: int = 0) -> np.ndarray:
        rng = np.random.default_rng(seed)
        rows = []
        for position, quaternion in centres:
            half = rng.normal(size=(count, 3)) * 0.04
            turn = np.concatenate([half, np.sqrt(1 - (half**2).sum(1, keepdims=True))], axis=1)
            a, b = np.broadcast_to(quaternion, (count, 4)), turn
            vector = a[:, 3:] * b[:, :3] + b[:, 3:] * a[:, :3] + np.cross(a[:, :3], b[:, :3])
            scalar = a[:, 3] * b[:, 3] - (a[:, :3] * b[:, :3]).sum(1)
            rows.append(np.column_stack([position + rng.normal(size=(count, 3)) * 0.005, vector, scalar]))
        return np.concatenate(rows)

    return make
