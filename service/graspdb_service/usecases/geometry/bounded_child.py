"""Untrusted files are read in a child process of bounded memory and time, which ends with the service."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import subprocess
import sys
from collections.abc import Mapping
from typing import Any, NamedTuple

from graspdb.processes import ChildProcess, end_with_parent

# One thread in the numeric libraries: each would reserve address space of its own.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

PATIENCE = 4.0
"""A file is refused for the processor time it takes, not for what else the machine is doing."""


class ChildLimits(NamedTuple):
    """What a child may take.

    ``memory_bytes`` is its address space, interpreter and libraries (about 0.4 GB) included; ``seconds`` are
    of processor time; on a busy machine it may take ``PATIENCE`` times as long.
    """

    memory_bytes: int
    seconds: float


class ChildFailed(ValueError):
    """A child was too slow, exceeded a limit or died; in words that end in what to do."""


def bounded(module: str, order: Mapping[str, Any], data: bytes, limits: ChildLimits) -> bytes:
    """What a module of ours, run as a program, makes of an order and of data: ChildFailed where it does not.

    It calls :func:`begin` first, reads the data from its standard input and writes to its standard output.
    """
    pipe = subprocess.PIPE
    with ChildProcess(
        _command(module),
        env=os.environ | _ONE_THREAD,
        stdin=pipe,
        stdout=pipe,
        stderr=subprocess.DEVNULL,
    ) as child:
        try:
            first = json.dumps({**order, **limits._asdict()}).encode() + b"\n"
            answer, _ = child.communicate(first + data, timeout=PATIENCE * limits.seconds)
        except subprocess.TimeoutExpired:
            child.kill()
            raise ChildFailed(
                f"reading it took more than {PATIENCE * limits.seconds:g} s: this machine is busy, so try"
                " again later"
            ) from None
    if child.returncode != 0:
        raise ChildFailed(
            f"reading it failed or needs more than {limits.memory_bytes / 2**20:.0f} MiB of memory or"
            f" {limits.seconds:g} s of processor time: check the file"
        )
    return bytes(answer)


def begin() -> dict[str, Any]:
    """In the child: end with the service, limit this process, and read the order."""
    end_with_parent()
    order: dict[str, Any] = json.loads(sys.stdin.buffer.readline())
    # Both limits count what the libraries have used already.
    for kind, limit in (
        (resource.RLIMIT_AS, order["memory_bytes"]),
        (resource.RLIMIT_CPU, max(1, round(order["seconds"]))),
        (resource.RLIMIT_CORE, 0),
    ):
        with contextlib.suppress(ValueError, OSError):  # an inherited limit may be tighter already
            resource.setrlimit(kind, (limit, limit))
    return order


def _command(module: str) -> list[str]:
    # Modules are not looked for in the working folder, for which Python 3.10 has no option.
    if sys.version_info >= (3, 11):
        return [sys.executable, "-P", "-m", module]
    return [sys.executable, "-c", f"import sys; del sys.path[0]; from {module} import main; sys.exit(main())"]
