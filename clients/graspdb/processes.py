"""Processes that end with the one that started them, however early or hard it is stopped.

:class:`ChildProcess` gives a child one end of a pipe and keeps the other, which nobody writes to. Whichever
way the parent goes, Ctrl-C in the midst of a start and SIGKILL included, its end closes; the kernel then
kills the child, which asked for that in :func:`end_with_parent`, whatever it computes. A child that has not
come so far yet ends when it does.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

try:
    import fcntl
except ModuleNotFoundError:  # Windows, where nothing of ours starts another
    fcntl = None  # type: ignore[assignment]

LIFELINE = "GRASPDB_LIFELINE"
LIFELINE_HELP = (
    f"Who starts this process may name in {LIFELINE} the descriptor of a pipe's reading end to inherit: the"
    " process is killed as soon as the writing end is closed, and so never outlives its parent."
)


class ChildProcess(subprocess.Popen[bytes]):
    """A program that calls :func:`end_with_parent`: killed when this process ends or drops the object."""

    def __init__(
        self, command: Sequence[str | Path], *, env: Mapping[str, str] | None = None, **options: Any
    ) -> None:
        reader, writer = os.pipe()
        self._lifeline = open(writer, "wb", buffering=0)  # noqa: SIM115 - as long as this object
        try:
            environment = {**(os.environ if env is None else env), LIFELINE: str(reader)}
            super().__init__(list(command), env=environment, pass_fds=(reader,), **options)
        except BaseException:
            self._lifeline.close()
            raise
        finally:
            os.close(reader)

    def __del__(self) -> None:
        if hasattr(self, "_lifeline"):
            self._lifeline.close()
        super().__del__()  # keeps the object until the process is reaped


def end_with_parent() -> None:
    """Have this process killed when its parent's end of the pipe closes, if it was started with one."""
    named = os.environ.pop(LIFELINE, None)
    if named is None:
        return
    reader = int(named)
    os.set_inheritable(reader, False)
    if not hasattr(fcntl, "F_SETSIG"):  # beyond Linux
        threading.Thread(target=_wait_for_the_end, args=(reader,), daemon=True).start()
        return
    fcntl.fcntl(reader, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(reader, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(reader, fcntl.F_SETFL, os.O_ASYNC | os.O_NONBLOCK)
    if select.select([reader], [], [], 0.0)[0]:  # it had closed before
        _wait_for_the_end(reader)


def _wait_for_the_end(reader: int) -> None:
    os.read(reader, 1)
    os.kill(os.getpid(), signal.SIGKILL)
