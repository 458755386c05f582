"""The demo: the whole chain as processes, and what it leaves behind when something goes wrong."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
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


def _failure(children: Children) -> str | None:
    try:
        children.check()
    except DemoFailed as error:
        return str(error)
    return None


def test_from_nothing_to_checked_grasps_and_kept_until_ctrl_c(
    tmp_path: Path, descendants: Callable[[], list[str]], eventually: Callable[..., Any]
) -> None:
    arguments = ["demo", "--keep", "--folder", str(tmp_path), "--max-poses", "20000"]
    process = subprocess.Popen(
        [GRASPDB, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "GRASPDB_LEARNED_ESTIMATES": "true"},
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
    # From below, where the table is.
    assert re.search(r"The best grasp overall approaches at 1\d\d° to straight down \(30° is allowed\)", out)
    pictures = [tmp_path / f"mug-{name}.png" for name in ("overall", "workspace")]
    assert f"Pictures of both: {pictures[0]}, {pictures[1]}" in out
    assert all(picture.read_bytes().startswith(b"\x89PNG") for picture in pictures)
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
    eventually(lambda: not descendants(), 5)


Living = Callable[[], list[str]]
Starting = Callable[[], subprocess.Popen[str]]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[[], subprocess.Popen[str]]]:
    """Starts a demo that lasts; with the test it ends, whatever became of it."""
    begun: list[subprocess.Popen[str]] = []

    def begin() -> subprocess.Popen[str]:
        words = (GRASPDB, "demo", "--max-poses", "2000000", "--processes", "1", "--folder", str(tmp_path))
        process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        begun.append(process)
        return process

    yield begin
    for process in begun:
        with process:
            process.kill()


def _runs(descendants: Living, text: str) -> Callable[[], bool]:
    return lambda: any(text in line for line in descendants())


def test_stopped_in_the_middle_it_leaves_no_process(
    start: Starting, descendants: Living, eventually: Callable[..., Any]
) -> None:
    process = start()
    eventually(_runs(descendants, "graspdb-simworker run"))
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 130, out
    assert "Interrupted" in out
    eventually(lambda: not descendants(), 5)


@pytest.mark.parametrize(
    ("appeared", "number"),
    [
        ("demo", signal.SIGINT),
        ("demo", signal.SIGKILL),
        ("graspdb-server serve", signal.SIGKILL),
        ("graspdb-simworker run", signal.SIGKILL),
        ("graspdb_simworker.process.child", signal.SIGKILL),
    ],
)
def test_however_early_and_hard_it_is_stopped_nothing_is_left(
    start: Starting,
    descendants: Living,
    eventually: Callable[..., Any],
    appeared: str,
    number: signal.Signals,
) -> None:
    process = start()
    eventually(_runs(descendants, appeared))
    time.sleep(np.random.default_rng().uniform(0.0, 3.0 if appeared == "demo" else 0.5))
    process.send_signal(number)
    process.communicate(timeout=60)
    eventually(lambda: not descendants(), 10)


def test_a_child_that_fails_is_reported_with_its_last_lines(
    tmp_path: Path, eventually: Callable[..., Any]
) -> None:
    with Children(tmp_path) as children:
        children.start("graspdb-server", "serve", "--database-url", "mysql://nowhere/x")
        failure = eventually(lambda: _failure(children))
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
