"""Cold start of a real server: a SQLite file of 3.5 million trials, 167,000 of them successes.

The object is the graspable ellipsoid of the query benchmark. Successes lie on its shell; failures are moved
and turned at random about the same shell, a quarter of them collisions. The file is written once, through the
storage layer; every round starts a new server process over it (imports and compiled code are loaded before
``/readyz`` says so) and asks it once, by density and by success probability in turn. Memory is the server's
own figure for the density.

``--folder`` keeps the file for further runs; ``--trials`` makes it smaller.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import service_queries as queries

from graspdb.wire import OUTCOME_CODES
from graspdb_density import se3
from graspdb_service.storage import objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database
from graspdb_service.storage.trials import batches, provenances, rows
from graspdb_service.trial_columns import Provenance, TrialColumns

TRIALS, SUCCESSES = 3_500_000, 167_000
BATCH = 250_000
ROUNDS = 5
SLUG = "cold"


def attempts(count: int, rng: np.random.Generator) -> TrialColumns:
    """Poses and outcomes; the share of successes is the whole file's."""
    positions, quaternions = queries.shell(count, rng)
    won = rng.random(count) < SUCCESSES / TRIALS
    lost = ~won
    turns = se3.from_rotation_vector(rng.normal(size=(count, 3)))
    positions[lost] += 0.02 * rng.normal(size=(int(lost.sum()), 3))
    quaternions[lost] = se3.multiply(quaternions, turns)[lost]
    outcome = np.where(won, OUTCOME_CODES["success"], OUTCOME_CODES["missed"])
    outcome[lost & (rng.random(count) < 0.25)] = OUTCOME_CODES["collision"]
    return TrialColumns(
        position=positions,
        quaternion_xyzw=quaternions,
        outcome=outcome.astype(np.uint8),
        provenance=np.zeros(count, dtype=np.int64),
    )


def write(folder: Path, total: int) -> None:
    """Fill the database: the object and its mesh through the service, the trials through its storage."""
    with queries.server(folder) as url, httpx.Client(base_url=url, timeout=300) as http:
        http.post("/objects", json={"id": SLUG}).raise_for_status()
        mesh = {"Content-Type": "model/stl"}
        http.put(
            f"/objects/{SLUG}/mesh?unit=m", content=queries.sphere_stl(), headers=mesh
        ).raise_for_status()
    rng = np.random.default_rng(0)
    database = Database(f"sqlite:///{folder / 'bench.sqlite'}")
    started = time.perf_counter()
    for start in range(0, total, BATCH):
        columns = attempts(min(BATCH, total - start), rng)
        with database.write() as tx:
            row = objects.find(tx, SLUG)
            assert row is not None
            revision, first = objects.advance(tx, row.id, rows=len(columns), append=True)
            columns.provenance[:] = provenances.ensure(tx, row.id, Provenance("pg70@1", None, None))
            batch_id, key = batches.create(tx, row.id, revision=revision)
            audit.record(tx, "batch.create", object=SLUG, subject=key)
            rows.insert(tx, row.id, batch_id, columns, revision=revision, first_seq=first)
            last = first + len(columns) - 1
            batches.grow(tx, batch_id, first_seq=first, last_seq=last, inserted=len(columns), packed=0)
    database.dispose()
    size = (folder / "bench.sqlite").stat().st_size / 1e9
    print(f"{total} trials written in {time.perf_counter() - started:.0f} s, {size:.2f} GB", flush=True)


def first_answer(folder: Path, objective: str | None) -> float:
    """Seconds of a new server's first best grasp."""
    with queries.server(folder) as url, httpx.Client(base_url=url, timeout=300) as http:
        parameters = {} if objective is None else {"objective": objective}
        return float(queries.timed(lambda: http.get(f"/objects/{SLUG}/best-grasp", params=parameters)) / 1000)


def extensions(folder: Path, rng: np.random.Generator) -> tuple[list[float], dict[str, Any]]:
    """Milliseconds by which a query takes longer after 1,000 more trials, and the density then."""
    with queries.server(folder) as url, httpx.Client(base_url=url, timeout=300) as http:

        def info() -> httpx.Response:
            return http.get(f"/objects/{SLUG}/density")

        info().raise_for_status()
        plain = statistics.median(queries.timed(info) for _ in range(5))
        after = []
        for _ in range(7):
            queries.post(http, SLUG, queries.shell(1_000, rng))
            after.append(queries.timed(info) - plain)
        return after, info().json()


def run(folder: Path, total: int) -> None:
    if not (folder / "bench.sqlite").exists():
        write(folder, total)
    asked = {"density": None, "success probability": "success_probability"}
    seconds: dict[str, list[float]] = {name: [] for name in asked}
    for _ in range(ROUNDS):
        for name, objective in asked.items():
            seconds[name].append(first_answer(folder, objective))
    for name, each in seconds.items():
        told = ", ".join(f"{s:.2f}" for s in each)
        print(f"first best grasp by {name:22s} {statistics.median(each):6.2f} s   ({told})", flush=True)
    after, info = extensions(folder, np.random.default_rng(1))
    print(f"density extended by 1,000 trials              {statistics.median(after):6.1f} ms")
    print(f"a density of {info['size']} kernels          {info['bytes'] / 2**20:6.0f} MiB")


def main(folder: Path | None = None, total: int = TRIALS) -> None:
    """Print the table."""
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        run(folder, total)
        return
    with tempfile.TemporaryDirectory() as scratch:
        run(Path(scratch), total)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--trials", type=int, default=TRIALS)
    arguments = parser.parse_args()
    main(arguments.folder, arguments.trials)
