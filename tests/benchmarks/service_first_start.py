"""From ``serve`` to the first best grasp: of a cold install, of one compiled ahead, of later starts.

One database of 2,000 successes on the graspable ellipsoid of the query benchmark, its mesh with it, is
written first. Every start is a new server process, asked for a best grasp in a cone, with the collision test,
until it answers; Numba keeps its files in a folder of the benchmark's own (NUMBA_CACHE_DIR), so that "cold"
is a folder with nothing in it. Seconds by the clock from the start of the process, and of the processor, of
the server and of what it started, up to its end: a machine that does other things besides is told by the
difference.

A bare start is Python importing NumPy, Numba and FastAPI: what no service of this kind starts without.
"""

from __future__ import annotations

import argparse
import os
import resource
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from http import HTTPStatus
from pathlib import Path

import httpx
import numpy as np
import service_queries as queries

from graspdb.processes import ChildProcess

KERNELS = 2_000
ROUNDS = 7
SLUG = "first"
ASKED = {"approach": "0,0,-1", "approach_cone_deg": 60, "gripper": "pg70"}
BARE = "import numpy, numba, fastapi"
#: Longest that a server may take, seconds.
_PATIENCE = 900.0


def command(*words: str) -> list[str]:
    """The server's command line, of the package that this process would import."""
    return [sys.executable, "-c", "from graspdb_service.cli import main; main()", *words]


def processor_s() -> float:
    """Processor time of all children that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def write(folder: Path) -> None:
    """The database, by a server that keeps its compiled code elsewhere."""
    with queries.server(folder) as url, httpx.Client(base_url=url, timeout=_PATIENCE) as http:
        http.post("/objects", json={"id": SLUG}).raise_for_status()
        mesh = {"Content-Type": "model/stl"}
        http.put(
            f"/objects/{SLUG}/mesh?unit=m", content=queries.sphere_stl(), headers=mesh
        ).raise_for_status()
        queries.post(http, SLUG, queries.shell(KERNELS, np.random.default_rng(0)))


def environment(folder: Path, compiled: Path) -> dict[str, str]:
    """Of a server over the database whose compiled code is kept in a folder."""
    kept = {"GRASPDB_DATABASE_URL": queries.database_in(folder), "NUMBA_CACHE_DIR": str(compiled)}
    return os.environ | kept


def first_grasp(folder: Path, compiled: Path) -> tuple[float, float]:
    """Seconds from ``serve`` to the first best grasp by the clock, and of the processor up to the end."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    busy, started = processor_s(), time.perf_counter()
    with (folder / "log").open("w") as log:
        process = ChildProcess(
            command("serve", "--port", str(port), "--log-level", "warning"),
            env=environment(folder, compiled),
            stdout=log,
            stderr=log,
        )
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=_PATIENCE) as http:
            while time.perf_counter() - started < _PATIENCE:
                try:
                    answer = http.get(f"/objects/{SLUG}/best-grasp", params=ASKED)
                    if answer.status_code != HTTPStatus.SERVICE_UNAVAILABLE:  # compiling took too long
                        answer.raise_for_status()
                        break
                except httpx.TransportError:
                    time.sleep(0.01)
        took = time.perf_counter() - started
    finally:
        process.terminate()
        process.wait(60)
    return took, processor_s() - busy


def bare() -> tuple[float, float]:
    """Seconds of a process that imports what every such service needs."""
    busy, started = processor_s(), time.perf_counter()
    subprocess.run([sys.executable, "-c", BARE], check=True)
    return time.perf_counter() - started, processor_s() - busy


def told(name: str, each: list[tuple[float, float]]) -> None:
    clock, busy = (statistics.median(values) for values in zip(*each, strict=True))
    lowest, highest = min(t for t, _ in each), max(t for t, _ in each)
    spread = f"{lowest:.2f} to {highest:.2f}, n {len(each)}"
    print(f"{name:46s} {clock:7.2f} s   processor {busy:7.2f} s   ({spread})", flush=True)


def run(folder: Path, *, cold: bool) -> None:
    write(folder)
    if cold:
        told("cold install: first best grasp", [first_grasp(folder, folder / "cold")])
    ahead = folder / "ahead"
    busy, started = processor_s(), time.perf_counter()
    subprocess.run(command("warm-up"), env=environment(folder, ahead), check=True, stdout=subprocess.DEVNULL)
    told("graspdb-server warm-up", [(time.perf_counter() - started, processor_s() - busy)])
    told("fresh install, cache built ahead: first grasp", [first_grasp(folder, ahead)])
    later, plain = [], []
    for _ in range(ROUNDS):
        plain.append(bare())
        later.append(first_grasp(folder, ahead))
    told("later starts: first best grasp", later)
    told("bare start: NumPy, Numba, FastAPI", plain)
    ratios = [statistics.median(values) for values in zip(*later, strict=True)]
    bares = [statistics.median(values) for values in zip(*plain, strict=True)]
    print(f"later start / bare start: {ratios[0] / bares[0]:.1f} by the clock")


def main(*, cold: bool = True) -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as folder:
        run(Path(folder), cold=cold)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--no-cold", action="store_true", help="leave out the start that compiles")
    main(cold=not parser.parse_args().no_cold)
