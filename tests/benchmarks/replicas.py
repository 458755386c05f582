"""From an acknowledged write through one replica to a right answer through another; what is worth sharing.

Two replicas over one PostgreSQL, and one process on SQLite, which is all there is there. Objects of grasps on
an ellipsoid's shell. In every round one replica is sent 20 trials more, and in another round the batch of
these is deleted, which is a change of the past: densities are built anew. The clock runs from the write's
answer until the other replica's answer has its revision, whatever had to be asked until then; beside it the
same question once more, when nothing is new.

Then, in one process over the PostgreSQL: what it takes to build a density from the rows, its widths chosen;
with widths that another replica has chosen, as the service does; and what it would take to write a whole one
that is built to the database, and to read it there.
"""

from __future__ import annotations

import argparse
import pickle
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psycopg
import service_queries as queries

from graspdb.wire import Selection
from graspdb_density import choose_widths
from graspdb_density.kde.rows import Rows
from graspdb_service.app import create_app
from graspdb_service.settings import Settings
from graspdb_service.storage.derived.width_choices import ChosenWidths
from graspdb_service.usecases.densities.cache import kernel_of
from graspdb_service.usecases.densities.widths.choosing import WidthChoosing

sys.path.append(str(Path(__file__).parents[1] / "support"))
from postgres_server import PostgresPrograms
from replica_set import ReplicaSet
from small_disk import Guard

SIZES = (2_000, 20_000, 160_000)
ROUNDS = 25
BOX = {"box_min": "-0.1,-0.1,0.0", "box_max": "0.2,0.2,0.2"}


class Follow:
    """Writes through one address, questions through another."""

    def __init__(self, name: str, writes: httpx.Client, asks: httpx.Client, slug: str) -> None:
        self._name, self._writes, self._asks, self._slug = name, writes, asks, slug
        self.times: dict[str, list[float]] = {}
        self.outdated = 0

    def question(self, path: str) -> dict[str, Any]:
        parameters = BOX if path == "best-grasp" else {}
        answer = self._asks.get(f"/objects/{self._slug}/{path}", params=parameters)
        answer.raise_for_status()
        told: dict[str, Any] = answer.json()
        return told

    def until(self, written: str, path: str, revision: int) -> None:
        """Milliseconds until an answer is of this revision, and those of the same question again."""
        started = time.perf_counter()
        while self.question(path)["revision"] < revision:
            self.outdated += 1
        self._took(f"{path} after {written}", started)
        started = time.perf_counter()
        self.question(path)
        self._took(f"{path}, nothing new", started)

    def _took(self, name: str, started: float) -> None:
        self.times.setdefault(name, []).append((time.perf_counter() - started) * 1000)

    def round(self, rng: np.random.Generator) -> None:
        for path in ("density", "best-grasp"):
            position, quaternion = queries.shell(20, rng)
            columns = {
                "position": position.tolist(),
                "quaternion_xyzw": quaternion.tolist(),
                "outcome": ["success"] * 20,
            }
            at = f"/objects/{self._slug}"
            made = self._writes.post(f"{at}/trials", json={"columns": columns, "gripper": "pg70"})
            made.raise_for_status()
            self.until("20 more trials", path, made.json()["revision"])
            self._writes.delete(f"{at}/batches/{made.json()['batch']}").raise_for_status()
            now = self._writes.get(at).json()["revision"]
            self.until("a deleted batch", path, now)

    def tell(self) -> None:
        for name, times in sorted(self.times.items()):
            told(self._name, name, times)
        print(f"{self._name:46s} answers that were outdated: {self.outdated}", flush=True)


def fill(http: httpx.Client, slug: str, count: int, rng: np.random.Generator) -> None:
    http.post("/objects", json={"id": slug}).raise_for_status()
    queries.post(http, slug, queries.shell(count, rng))


def follow(name: str, writes_to: str, asks_of: str, sizes: tuple[int, ...], rounds: int) -> None:
    rng = np.random.default_rng(0)
    with (
        httpx.Client(base_url=writes_to, timeout=300) as writes,
        httpx.Client(base_url=asks_of, timeout=300) as asks,
    ):
        for count in sizes:
            slug = f"shell-{count}"
            fill(writes, slug, count, rng)
            found = Follow(f"{name}, {count:,} grasps", writes, asks, slug)
            found.round(rng)  # compiles, builds
            found.times.clear()
            for _ in range(rounds):
                found.round(rng)
            found.tell()


class Alone(WidthChoosing):
    """Chooses as if no other replica had."""

    def choose(self, object_id: int, rows: Rows, *, threads: int) -> ChosenWidths:
        found = choose_widths(rows, threads=threads)
        return ChosenWidths(found.kernel.sigma_position_m, found.kernel.sigma_rotation, found.rule)


def shared(url: str, sizes: tuple[int, ...], rounds: int) -> None:
    """Building from the rows, with what others have chosen or without, against reading what is built."""
    context = create_app(Settings(database_url=url)).state.context
    # Nobody looks here whether it is well.
    context.database.down = lambda: None
    densities = context.densities
    kept, alone = densities.widths, Alone(context.database)
    request = Selection()
    choice, _ = kernel_of(request)
    times: dict[str, list[float]] = {}

    def took(name: str, started: float, busy: float | None = None) -> None:
        times.setdefault(name, []).append((time.perf_counter() - started) * 1000)
        if busy is not None:
            own = (time.process_time() - busy) * 1000
            times.setdefault(f"{name}, processor's time", []).append(own)

    try:
        with psycopg.connect(url, autocommit=True) as database:
            database.execute("CREATE UNLOGGED TABLE built (id int PRIMARY KEY, content bytea)")
            database.execute("ALTER TABLE built ALTER COLUMN content SET STORAGE EXTERNAL")
            for count in sizes:
                selected = densities.selections.resolve(f"shell-{count}", request)
                for number in range(rounds + 1):
                    if number == 1:
                        times.clear()  # the first has compiled
                    for name, widths in (("built alone", alone), ("built with kept widths", kept)):
                        densities.widths = widths
                        started, busy = time.perf_counter(), time.process_time()
                        built = densities._refresh(selected, choice, None, None)
                        took(name, started, busy)
                    started = time.perf_counter()
                    content = pickle.dumps((built.density, built.seq, built.weighing), protocol=5)
                    replace = "ON CONFLICT (id) DO UPDATE SET content = excluded.content"
                    database.execute(f"INSERT INTO built VALUES (1, %b) {replace}", (content,))
                    took("a built one written", started)
                    started = time.perf_counter()
                    with database.cursor(binary=True) as cursor:
                        row = cursor.execute("SELECT content FROM built").fetchone()
                    assert row is not None
                    pickle.loads(row[0])  # ours, of a moment ago
                    took("a built one read", started)
                for name, each in times.items():
                    what = f"{name}, {count:,} grasps, {len(content) / 2**20:.1f} MiB"
                    told("", what, each)
    finally:
        alone.close()
        context.close()


def told(where: str, what: str, times: list[float]) -> None:
    median, most = statistics.median(times), max(times)
    print(f"{where:46s} {what:60s} median {median:7.1f} ms   highest {most:7.1f} ms", flush=True)


@contextmanager
def folder() -> Iterator[Path]:
    """One that PostgreSQL's user can enter, of which nothing is left."""
    made = Path(tempfile.mkdtemp(prefix="graspdb-benchmark-"))
    made.chmod(0o755)
    guard = Guard(made)
    try:
        yield made
    finally:
        guard.close()


def main(sizes: tuple[int, ...] = SIZES, rounds: int = ROUNDS) -> None:
    """Print the tables."""
    with folder() as home:
        programs = home / "programs"
        programs.mkdir()
        found = ReplicaSet(home, PostgresPrograms(programs), count=2)
        try:
            follow("PostgreSQL, the other replica", *found.urls, sizes, rounds)
            shared(found.postgres.url, sizes, rounds)
        finally:
            found.close()
    with tempfile.TemporaryDirectory() as place, queries.server(Path(place)) as url:
        follow("SQLite, the same process", url, url, sizes, rounds)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="*", default=list(SIZES))
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    given = parser.parse_args()
    main(tuple(given.sizes), given.rounds)
