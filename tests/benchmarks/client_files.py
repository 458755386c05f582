"""Files in and out by the command line: processor and wall time of whole commands, and the client's memory.

An ACRONYM file of 2,000 grasps and a Parquet file of a million rows are imported, and 200,000 trials exported
and bundled, into and out of a real service on SQLite. Beside them ``graspdb objects list``, which does hardly
more than start: what an import takes over it is the import.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import service_queries as queries

from graspdb import Client
from graspdb.interop.frames import to_tool
from graspdb.poses import matrices
from graspdb.resources.trials import DoubtfulTrials

GRASPS, ROWS, OUT, ROUNDS = 2_000, 1_000_000, 200_000, 5


class Taken(NamedTuple):
    """What a command took: seconds by the clock and of the processor, and the most memory in MiB."""

    wall_s: float
    processor_s: float
    memory_mib: float


def taken(url: str, arguments: Sequence[str]) -> Taken:
    """Run ``graspdb`` to its end; RuntimeError where it fails."""
    began, memory, before = time.perf_counter(), 0.0, os.times()
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "graspdb", *arguments],
            env=os.environ | {"GRASPDB_URL": url},
            stdout=subprocess.DEVNULL,
            stderr=said,
        )
        # Asked while it runs: what a child has used when it ends counts its parent's memory, too.
        while process.poll() is None:
            memory = max(memory, _peak_mib(process.pid))
            time.sleep(0.02)
        said.seek(0)
        if process.returncode:
            raise RuntimeError(f"{' '.join(arguments)} failed: {said.read()}")
    after = os.times()
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return Taken(time.perf_counter() - began, used, memory)


def _peak_mib(pid: int) -> float:
    """The most memory that a running process has had; 0 where the system does not tell."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return 0.0
    return next((float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), 0.0)


def told(name: str, times: Sequence[Taken], start: float, count: int = 0) -> None:
    """Print a line: medians, and how often the start they are."""
    wall, processor, memory = (statistics.median(column) for column in zip(*times, strict=True))
    rate = f"{count / wall:11,.0f} /s" if count else ""
    print(
        f"{name:34s} {wall:7.2f} s {processor:7.2f} s of processor {wall / start:6.1f} starts"
        f" {memory:6.0f} MiB {rate}",
        flush=True,
    )


def main(rows: int = ROWS, out: int = OUT) -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as scratch, queries.server(Path(scratch)) as url, Client(url) as db:
        folder, stl = Path(scratch), queries.sphere_stl()
        for name in ("few", "many", "some"):
            db.objects.create(name, mesh=stl, media_type="model/stl")
        position, quaternion = queries.shell(max(rows, GRASPS), rng)
        held = rng.random(len(position)) < 0.5
        bases = matrices(position[:GRASPS], quaternion[:GRASPS])
        bases = bases @ np.linalg.inv(to_tool("base", "acronym", db.grippers.get("panda").profile))
        with h5py.File(folder / "few.h5", "w") as file:
            file["grasps/transforms"] = bases
            file["grasps/qualities/flex/object_in_gripper"] = held[:GRASPS].astype(int)
            file["gripper/type"] = "panda"
        columns = dict(zip(["x", "y", "z"], position[:rows].T, strict=True))
        columns |= dict(zip(["qx", "qy", "qz", "qw"], quaternion[:rows].T, strict=True))
        pq.write_table(pa.table(columns | {"success": held[:rows]}), folder / "many.parquet")
        starts = [taken(url, ["objects", "list"]) for _ in range(ROUNDS)]
        start = statistics.median(each.wall_s for each in starts)
        told("objects list", starts, start)
        into = ["--gripper", "panda", "--again"]
        few = ["import", str(folder / "few.h5"), "--object", "few", *into]
        # The service's own first import compiles and reads what later ones find.
        told("ACRONYM, 2,000 grasps, the first", [taken(url, few)], start, GRASPS)
        told("ACRONYM, 2,000 grasps", [taken(url, few) for _ in range(ROUNDS)], start, GRASPS)
        many = ["import", str(folder / "many.parquet"), "--object", "many", *into, "--accept-implausible"]
        told(f"Parquet, {rows:,} rows", [taken(url, many)], start, rows)
        some = db.objects.get("some")
        warnings.simplefilter("ignore", DoubtfulTrials)  # many of the shell's grasps collide: that is meant
        some.trials.add(np.column_stack([position, quaternion])[:out], held[:out], gripper="panda")
        for name in ("t.parquet", "t.csv"):
            export = ["export", "some", "--what", "trials", "-o", str(folder / name)]
            told(f"export of {out:,} as {name[2:]}", [taken(url, export)], start, out)
        bundle = ["bundle", "some", "-o", str(folder / "some.zip")]
        told(f"bundle of {out:,}", [taken(url, bundle)], start, out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=ROWS)
    parser.add_argument("--out", type=int, default=OUT)
    given = parser.parse_args()
    main(given.rows, given.out)
