"""Reports over HTTP against a real server on SQLite: computed once, then kept (below 50 ms); figures.

Trials: 40,000 about one grasp, which holds where a Gaussian of displacements is high.
"""

from __future__ import annotations

import os
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np

from graspdb.processes import ChildProcess
from graspdb_density import se3

TRIALS = 40_000
ROUNDS = 60
REPORTS = (
    "convergence",
    "anisotropy",
    "calibration",
    "projection?approach=z",
    "bandwidth",
    "kernel-similarity",
)


@contextmanager
def server(folder: Path) -> Iterator[str]:
    """A service of its own; its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    program = "from graspdb_service.cli import main; main()"
    command = [sys.executable, "-c", program, "serve", "--port", str(port), "--log-level", "warning"]
    settings = {
        "GRASPDB_DATABASE_URL": f"sqlite:///{folder / 'bench.sqlite'}",
        "GRASPDB_REPORT_WAIT_S": "60",
    }
    with (folder / "log").open("w") as log:
        process = ChildProcess(command, env=os.environ | settings, stdout=log, stderr=log)
    url = f"http://127.0.0.1:{port}"
    try:
        for _ in range(600):
            try:
                if httpx.get(f"{url}/readyz").status_code == 200:
                    break
            except httpx.TransportError:
                time.sleep(0.1)
        yield url
    finally:
        process.terminate()
        process.wait(15)


def fill(http: httpx.Client) -> None:
    """Post the trials."""
    rng = np.random.default_rng(0)
    widths = np.array([0.03, 0.008, 0.02, 0.2, 0.8, 0.2])
    http.post("/objects", json={"id": "thing"}).raise_for_status()
    for _ in range(TRIALS // 20_000):
        xi = rng.uniform(-2.0, 2.0, (20_000, 6)) * widths
        won = np.sum((xi / widths) ** 2, axis=1) < 6.0
        columns = {
            "position": xi[:, :3].tolist(),
            "quaternion_xyzw": se3.from_rotation_vector(xi[:, 3:]).tolist(),
            "outcome": won.tolist(),
        }
        http.post("/objects/thing/trials", json={"columns": columns}).raise_for_status()


def done(call: Callable[[], httpx.Response]) -> tuple[float, httpx.Response]:
    """Milliseconds until the report is there, and its last answer."""
    started = time.perf_counter()
    while True:
        answer = call()
        answer.raise_for_status()
        if answer.status_code == 200:
            return 1e3 * (time.perf_counter() - started), answer


def main() -> None:
    """Print the table."""
    with (
        tempfile.TemporaryDirectory() as folder,
        server(Path(folder)) as url,
        httpx.Client(base_url=url, timeout=300) as http,
    ):
        fill(http)
        print(
            f"{'report':24} {'computed':>10} {'kept p50':>10} {'p99':>8} {'unchanged':>10} {'PNG':>8}   (ms)"
        )
        for name in REPORTS:
            path = f"/objects/thing/reports/{name}"
            first, answer = done(lambda path=path: http.get(path))  # type: ignore[misc]
            kept = [done(lambda path=path: http.get(path))[0] for _ in range(ROUNDS)]  # type: ignore[misc]
            tag = {"If-None-Match": answer.headers["ETag"]}
            same = []
            for _ in range(ROUNDS):
                started = time.perf_counter()
                assert http.get(path, headers=tag).status_code == 304
                same.append(1e3 * (time.perf_counter() - started))
            png, _ = done(lambda path=path: http.get(path, headers={"Accept": "image/png"}))  # type: ignore[misc]
            p50, p99 = np.percentile(kept, [50, 99])
            print(
                f"{name:24} {first:10.0f} {p50:10.1f} {p99:8.1f} {np.median(same):10.1f} {png:8.0f}",
                flush=True,
            )
        started = time.perf_counter()
        http.get("/reports/summary").raise_for_status()
        print(f"{'summary':24} {1e3 * (time.perf_counter() - started):10.0f}")


if __name__ == "__main__":
    main()
