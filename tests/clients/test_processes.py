"""Children that end with whoever started them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest

from graspdb.processes import LIFELINE, ChildProcess

BUSY = (
    "import os; from graspdb.processes import end_with_parent; end_with_parent(); print('ready', flush=True);"
    # In one call of C, which holds the interpreter's lock, deaf to all other signals.
    "import signal; signal.pthread_sigmask(signal.SIG_BLOCK, range(1, 32)); 3 ** (10 ** 9)"
)
EARLY = (
    "import time; time.sleep(0.5); from graspdb.processes import end_with_parent; end_with_parent(); input()"
)


def child(script: str) -> ChildProcess:
    return ChildProcess([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE)


def ready(script: str) -> ChildProcess:
    process = child(script)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    return process


@pytest.mark.parametrize("script", [BUSY, EARLY], ids=["busy", "not come so far"])
def test_a_child_ends_when_it_is_dropped(script: str, descendants: Any, eventually: Any) -> None:
    process = ready(script) if script == BUSY else child(script)
    assert process.poll() is None
    del process
    eventually(lambda: not descendants(), 10)


def test_a_child_ends_when_its_parent_is_killed(descendants: Any, eventually: Any) -> None:
    script = (
        "import sys; from graspdb.processes import ChildProcess;"
        f"child = ChildProcess([sys.executable, '-c', {BUSY!r}]); child.wait()"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"ready\n"
        assert len(descendants()) == 2
        parent.kill()
        eventually(lambda: not descendants(), 10)


def test_a_child_ends_when_its_start_is_interrupted(
    descendants: Any, eventually: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    start: Callable[..., None] = subprocess.Popen.__init__

    def interrupted(*arguments: Any, **options: Any) -> None:
        start(*arguments, **options)
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess.Popen, "__init__", interrupted)
    with pytest.raises(KeyboardInterrupt):
        child(BUSY)
    eventually(lambda: not descendants(), 10)


def test_what_a_child_starts_does_not_hold_by_its_lifeline() -> None:
    script = (
        "import os, subprocess, sys; from graspdb.processes import end_with_parent; end_with_parent();"
        f"print('ready', os.environ.get({LIFELINE!r}), flush=True);"
        "subprocess.run(['ls', '/proc/self/fd'])"
    )
    process = child(script)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert out.split() == [b"ready", b"None", b"0", b"1", b"2", b"3"]  # the last is the folder that is read


def test_without_a_parent_that_asks_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(LIFELINE, raising=False)
    script = "from graspdb.processes import end_with_parent; end_with_parent(); print('ready')"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert done.stdout == b"ready\n"


def test_a_signal_ends_it_as_any_other_process() -> None:
    process = ready("print('ready', flush=True); input()")
    os.kill(process.pid, signal.SIGTERM)
    assert process.wait(10) == -signal.SIGTERM
