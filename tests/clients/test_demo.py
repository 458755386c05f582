"""The demo: the whole chain as processes, and what it leaves behind when something goes wrong."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from scipy import optimize, stats

from graspdb import Client
from graspdb.demo import Children, DemoFailed, wilson_interval

GRASPDB = str(Path(sys.executable).with_name("graspdb"))


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (3, 10), (10, 10), (80, 100)])
def test_wilson_interval_inverts_the_score_test(successes: int, trials: int) -> None:
    low, high = wilson_interval(successes, trials, 0.9)
    z = stats.norm.ppf(0.95)
    share = successes / trials

    def score(p: float) -> float:
        return (share - p) ** 2 - z**2 * p * (1 - p) / trials

    assert low == pytest.approx(0 if successes == 0 else optimize.brentq(score, 0, share - 1e-9))
    assert high == pytest.approx(1 if successes == trials else optimize.brentq(score, share + 1e-9, 1))


def test_no_trials_have_no_interval() -> None:
    for successes, trials in ((0, 0), (2, 1), (-1, 3)):
        with pytest.raises(ValueError):
            wilson_interval(successes, trials)


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _failure(children: Children) -> str | None:
    try:
        children.check()
    except DemoFailed as error:
        return str(error)
    return None


def _alive(*texts: str) -> list[str]:
    """Command lines of running processes that contain all the texts."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if all(text in line for text in texts) and str(os.getpid()) != path.parent.name:
            found.append(line)
    return found


def test_from_nothing_to_checked_grasps_and_kept_until_ctrl_c(tmp_path: Path) -> None:
    arguments = ["demo", "--keep", "--folder", str(tmp_path), "--max-poses", "20000"]
    process = subprocess.Popen(
        [GRASPDB, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    out = ""
    for line in process.stdout:
        out += line
        if line.startswith("and in a browser"):
            break
    assert process.poll() is None, out
    assert "Simulated 20,000 poses" in out
    assert out.index("Best grasp overall") < out.index("Best grasp in a workspace")
    assert re.search(r"Tolerance: A good grasp forgives .*\d+ (mm|deg)", out)
    assert re.search(r"Convergence: \d+ successful grasps are ", out)
    assert re.search(
        r"Of 100 draws from the density, .* \d+ \(0\.\d\d; 90 % interval 0\.\d\d to 0\.\d\d\)", out
    )
    (best,) = re.findall(r"Of \d+ best distinct grasps, .*?, \d+ \(([01]\.\d\d);", out)
    assert float(best) >= 0.5
    (url,) = re.findall(r"export GRASPDB_URL=(\S+)", out)
    assert f"API docs: {url}/docs" in out
    with Client(url) as db:
        assert db.objects.get("mug").info.trials == 20_000  # those of the checks are not among them
        assert len(db.objects.get("mug").best_grasps(count=3)) == 3
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 0
    assert not _alive(str(tmp_path))


def test_stopped_in_the_middle_it_leaves_no_process(tmp_path: Path) -> None:
    arguments = [GRASPDB, "demo", "--folder", str(tmp_path), "--max-poses", "2000000", "--processes", "1"]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    _until(lambda: bool(_alive("--port ", str(tmp_path))))
    port = re.findall(r"--port (\d+)", _alive("--port ", str(tmp_path))[0])[0]
    worker = f"--url http://127.0.0.1:{port} --processes"
    _until(lambda: bool(_alive(worker)))
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Interrupted" in out
    assert not _alive(str(tmp_path))
    assert not _alive(worker)


def test_a_child_that_fails_is_reported_with_its_last_lines(tmp_path: Path) -> None:
    with Children(tmp_path) as children:
        children.start("graspdb-server", "serve", "--database-url", "mysql://nowhere/x")
        _until(lambda: _failure(children) is not None)
        failure = _failure(children)
        assert failure is not None
        assert "graspdb-server ended with exit code 1" in failure
        assert "mysql is not supported" in failure


def test_an_interruption_that_somebody_swallowed_is_raised_again(tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    for number, expected in ((signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)):
        with Children(tmp_path) as children:
            with contextlib.suppress(BaseException):  # as an import may do that guards another
                os.kill(os.getpid(), number)
                time.sleep(5)
            with pytest.raises(expected):
                children.check()
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
