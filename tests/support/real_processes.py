"""Commands of ours as real processes that are killed, paused and started again, and all gone at the end."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx

from graspdb.processes import ChildProcess

PATIENCE_S = 60.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Process:
    """A command of ours, as its own process group. The file ``pids`` in ``cwd`` gets a line each start."""

    def __init__(self, log: Path, *command: str, cwd: Path | None = None, **environment: str) -> None:
        self._log = log
        self._cwd = cwd
        self._command = command
        self._environment = environment
        self._process: ChildProcess | None = None

    def start(self) -> None:
        with self._log.open("ab") as log:
            self._process = ChildProcess(
                [str(Path(sys.executable).with_name(self._command[0])), *self._command[1:]],
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=self._cwd,
                env={**os.environ, **self._environment},
                start_new_session=True,
            )
        if self._cwd is not None:
            with (self._cwd / "pids").open("a") as pids:
                pids.write(f"{self.pid}\n")

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def log(self) -> str:
        """The end of what it said."""
        return self._log.read_text(errors="replace")[-3000:]

    def is_running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def kill(self) -> None:
        """kill -9, of this process alone: its children have to notice by themselves."""
        assert self._process is not None
        assert self._process.poll() is None, f"it ended by itself:\n{self.log()}"
        os.kill(self.pid, signal.SIGKILL)
        self._process.wait(30)

    def pause(self) -> None:
        """SIGSTOP, to it and its children."""
        os.killpg(self.pid, signal.SIGSTOP)

    def resume(self) -> None:
        os.killpg(self.pid, signal.SIGCONT)

    def wait(self) -> int:
        """Until it has ended by itself, and how it did."""
        assert self._process is not None
        return self._process.wait(PATIENCE_S)

    def stop(self) -> int:
        """Ask it to end, and how it did."""
        assert self._process is not None
        self._process.terminate()
        return self._process.wait(60)

    def clean_up(self) -> None:
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
            self._process.wait(30)

    def group_is_empty(self) -> bool:
        try:
            os.killpg(self.pid, 0)
        except ProcessLookupError:
            return True
        return False


@contextmanager
def running(process: Process) -> Iterator[Process]:
    try:
        process.start()
        yield process
    finally:
        process.clean_up()


def wait_for(
    what: str, condition: Callable[[], Any], *, every: float = 0.02, seconds: float = PATIENCE_S
) -> Any:
    """What a condition comes to; while no service answers it does not hold."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            found = condition()
        except httpx.TransportError:
            found = None
        if found:
            return found
        time.sleep(every)
    raise AssertionError(f"{what}: not within {seconds:g} s")
