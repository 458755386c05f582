"""``make load``: 200 clients and 50 workers at half of what this machine carries.

On SQLite with one process, then on PostgreSQL with two replicas behind nginx. First one client alone asks
for best grasps; then 16 actors that never think tell what the machine carries; then 200 clients and 50
workers think so long that they ask half as much, for ``--seconds``. Ends with 1 unless no request failed,
no process grew after the first quarter (by more than a twentieth and 32 MiB), and 99 of 100 best grasps
came within 4 times the median alone.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx

sys.path.append(str(Path(__file__).parents[1] / "support"))

from fault_lab import box_stl
from postgres_server import PostgresPrograms
from real_processes import Process, free_port, running, wait_for
from replica_set import ReplicaSet
from small_disk import Guard
from traffic import Seen, Traffic, prepare

CLIENTS, WORKERS = 200, 50


class Memory(threading.Thread):
    """The resident memory of processes, once a second."""

    def __init__(self, pids: list[int]) -> None:
        super().__init__(daemon=True)
        self._pids, self._done = pids, threading.Event()
        self.mib: list[list[float]] = []

    def run(self) -> None:
        while not self._done.wait(1.0):
            status = (Path(f"/proc/{pid}/status").read_text() for pid in self._pids)
            kib = [next(line for line in text.splitlines() if line.startswith("VmRSS")) for text in status]
            self.mib.append([int(line.split()[1]) / 1024 for line in kib])

    def stop(self) -> list[tuple[float, float]]:
        """Of each process: after the first quarter, and at the end (medians of a tenth of the time)."""
        self._done.set()
        self.join()
        tenth = max(1, len(self.mib) // 10)
        quarter = len(self.mib) // 4
        parts = self.mib[quarter : quarter + tenth], self.mib[-tenth:]
        return [
            (statistics.median(row[n] for row in parts[0]), statistics.median(row[n] for row in parts[1]))
            for n in range(len(self._pids))
        ]


@contextmanager
def on_sqlite(folder: Path) -> Iterator[tuple[str, list[int]]]:
    port = free_port()
    words = ("serve", "--port", str(port), "--database-url", f"sqlite:///{folder}/load.sqlite")
    process = Process(folder / "service.log", "graspdb-server", *words, GRASPDB_LOG_LEVEL="warning")
    url = f"http://127.0.0.1:{port}"
    with running(process):
        wait_for("the service is ready", lambda: httpx.get(f"{url}/readyz").is_success)
        yield url, [process.pid]


@contextmanager
def on_postgres(folder: Path) -> Iterator[tuple[str, list[int]]]:
    programs, home, proxy = folder / "programs", folder / "lab", folder / "proxy"
    for each in (programs, home, proxy):
        each.mkdir()
    found = ReplicaSet(home, PostgresPrograms(programs), count=2, GRASPDB_ALLOWED_HOSTS="*")
    try:
        yield found.begin_proxy(proxy), [process.pid for process in found.replicas]
    finally:
        found.close()


def alone(url: str, seconds: float) -> float:
    """The median of best grasps asked by one client, each of another box."""
    only = Traffic(url, clients=1, workers=0, think_s=0.0)
    return asyncio.run(only.run(seconds)).share("best-grasp", 0.5)


def measure(name: str, url: str, pids: list[int], seconds: float) -> bool:
    prepare(url, box_stl)
    short = min(20.0, max(5.0, seconds / 10))
    alone(url, short)  # until all is warm
    median = alone(url, short)
    crowd = Traffic(url, clients=13, workers=3, think_s=0.0)
    carried = asyncio.run(crowd.run(2 * short)).requests / (2 * short)
    # Half of that by all together; an answer itself takes little of the time between two requests.
    think_s = (CLIENTS + WORKERS) / (carried / 2)
    print(
        f"{name}: alone p50 {1e3 * median:.1f} ms; carries {carried:.0f} requests/s; thinking {think_s:.1f} s"
    )
    memory = Memory(pids)
    memory.start()
    started = time.monotonic()
    seen = asyncio.run(Traffic(url, clients=CLIENTS, workers=WORKERS, think_s=think_s).run(seconds))
    took = time.monotonic() - started
    return judge(name, seen, took, median, memory.stop())


def judge(name: str, seen: Seen, took: float, alone_s: float, memory: list[tuple[float, float]]) -> bool:
    print(f"{'ms':<14}{'requests':>9}{'p50':>8}{'p99':>8}{'max':>8}")
    for kind in sorted(seen.seconds):
        at = [1e3 * seen.share(kind, share) for share in (0.5, 0.99, 1.0)]
        print(f"{kind:<14}{len(seen.seconds[kind]):>9}" + "".join(f"{each:>8.0f}" for each in at))
    grown = [late - early for early, late in memory]
    ratio = seen.share("best-grasp", 0.99) / alone_s
    found = {
        "load": name,
        "seconds": round(took),
        "requests_per_s": round(seen.requests / took, 1),
        "errors": dict(seen.errors.most_common(5)),
        "memory_mib": [[round(early), round(late)] for early, late in memory],
        "best_grasp_p99_over_p50_alone": round(ratio, 2),
    }
    print(json.dumps(found), flush=True)
    steady = all(more <= 32 + early / 20 for more, (early, _) in zip(grown, memory, strict=True))
    return not seen.errors and steady and ratio <= 4.0


def main() -> None:
    """Load the service, and print what became of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help="of the load on each database")
    parser.add_argument("--database", choices=["sqlite", "postgres", "both"], default="both")
    given = parser.parse_args()
    well = True
    for name, serving in (("sqlite", on_sqlite), ("postgres", on_postgres)):
        if given.database not in (name, "both"):
            continue
        folder = Path(tempfile.mkdtemp(prefix="graspdb-load-"))
        with ExitStack() as stack:
            folder.chmod(0o755)
            stack.callback(Guard(folder).close)
            url, pids = stack.enter_context(serving(folder))
            well &= measure(name, url, pids, given.seconds)
    sys.exit(not well)


if __name__ == "__main__":
    main()
