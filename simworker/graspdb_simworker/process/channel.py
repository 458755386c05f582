"""The worker's end and a child's of two pipes between them; over them go messages: a length, a kind, a body.

Worker to child: ``CHUNK``. Child to worker: ``READY`` once its libraries are loaded or ``MISSING`` where they
can't be, ``BEFORE`` and ``AFTER`` around every closing, ``NOTE`` for a person, ``RESULT`` or ``ERROR``.
"""

from __future__ import annotations

import os
import select
import signal
import struct
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from graspdb.processes import ChildProcess, end_with_parent

READY, CHUNK, BEFORE, AFTER, RESULT, ERROR, MISSING, NOTE = (b"R", b"C", b"B", b"A", b"D", b"E", b"M", b"N")
MAX_BYTES = 1 << 30

_HEADER = struct.Struct("<cQ")
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


class Closed(EOFError):
    """The other end is gone."""


class Silent(TimeoutError):
    """The other end said nothing for too long."""


def start(command: Sequence[str]) -> ChildProcess:
    """Start a program that calls :func:`take_streams`, computes in one thread and ends with this process."""
    return ChildProcess(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ, **_ONE_THREAD}
    )


def end(process: ChildProcess) -> None:
    """Kill a started program and close its pipes."""
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()


def take_streams() -> tuple[int, int]:
    """In the child, before anything else: the descriptors that messages come from and go to.

    What libraries print on the standard output goes nowhere. An interrupt at the terminal, or a manager that
    stops the whole group, is for the worker, who ends its children itself: one that died before it would look
    like the work's fault.
    """
    end_with_parent()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    source, sink = os.dup(0), os.dup(1)
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 0)
    os.dup2(null, 1)
    return source, sink


def send(fd: int, kind: bytes, body: bytes = b"") -> None:
    """Write one message whole; Closed if nobody reads any more."""
    view = memoryview(_HEADER.pack(kind, len(body)) + body)
    try:
        while view:
            view = view[os.write(fd, view) :]
    except BrokenPipeError as error:
        raise Closed("the pipe's reader is gone") from error


class Inbox:
    """Messages that come over a pipe, in turn; read as many at a time as there are.

    Where many small ones come, whoever reads is woken for each, and takes the time of who writes:
    ``pause_s`` is how long to let them gather.
    """

    def __init__(self, fd: int, *, pause_s: float = 0.0) -> None:
        self._fd = fd
        self._pause_s = pause_s
        self._read = bytearray()

    def receive(
        self, *, silence_s: float | None = None, poll_s: float = 0.2, check: Callable[[], None] | None = None
    ) -> tuple[bytes, bytes]:
        """The next message whole: kind and body.

        ``check`` is called about every ``poll_s`` while waiting; what it raises ends the wait. Closed if
        nobody writes any more, Silent if nothing came for ``silence_s``.
        """
        self._gather(_HEADER.size, silence_s, poll_s, check)
        kind, length = _HEADER.unpack_from(self._read)
        if length > MAX_BYTES:
            raise Closed(f"a message of {length} bytes: the stream is broken")
        end = _HEADER.size + length
        self._gather(end, silence_s, poll_s, check)
        body = bytes(memoryview(self._read)[_HEADER.size : end])
        del self._read[:end]
        return kind, body

    def _gather(
        self, count: int, silence_s: float | None, poll_s: float, check: Callable[[], None] | None
    ) -> None:
        """Read until so many bytes are there."""
        heard = time.monotonic()
        while len(self._read) < count:
            while not select.select([self._fd], [], [], poll_s)[0]:
                if check is not None:
                    check()
                if silence_s is not None and time.monotonic() - heard > silence_s:
                    raise Silent(f"nothing heard for {silence_s:g} s")
            if self._pause_s and not self._read:
                time.sleep(self._pause_s)
            piece = os.read(self._fd, 1 << 20)
            if not piece:
                raise Closed("the pipe's writer is gone")
            self._read += piece
            heard = time.monotonic()
