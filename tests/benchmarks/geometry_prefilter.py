"""Poses per second that the collision prefilter settles, on the paper's four objects.

Run from a checkout: ``python tests/benchmarks/geometry_prefilter.py [--poses N] [--threads T] [--json]``.
Poses are a random subsample of the 10 mm x 15 degree grid with 20 mm margin, one of each jaw-symmetric pair,
for a PG70.  A rate is the median over repetitions by processor time of the process, so that other load on the
machine counts little; the share that needs physics is printed beside it, and a yardstick (a fixed NumPy
computation) tells how fast the core is.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from typing import Any

import numpy as np

from graspdb.examples import EXAMPLES, example
from graspdb_geometry import collision, grids
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70


def measure(name: str, poses: int, repetitions: int, threads: int) -> dict[str, Any]:
    """Time grid and prefilter for one object."""
    thing = example(name)
    lower, upper = (tuple(float(v) for v in corner) for corner in thing.bounds)
    grid = grids.PoseGrid(lower, upper, max_poses=poses, seed=1)  # type: ignore[arg-type]
    started = time.process_time()
    positions, quaternions = grid.poses(grid.pose_indices(0, grid.total))
    generated = grid.total / (time.process_time() - started)
    scene = collision.Scene(thing.parts)
    vertices, faces = thing.triangles
    surface = collision.Surface(vertices, faces, watertight=True)
    # Compile, or load from the cache, before the clock starts.
    codes, _ = scene.classify(ToolPoses(positions[:64], quaternions[:64]), PG70)
    surface.collides(ToolPoses(positions[:64], quaternions[:64]), PG70)
    rates, wall_rates, surface_rates = [], [], []
    for _ in range(repetitions):
        started, wall = time.process_time(), time.perf_counter()
        codes, _ = scene.classify(ToolPoses(positions, quaternions), PG70, threads)
        rates.append(len(codes) / (time.process_time() - started))
        wall_rates.append(len(codes) / (time.perf_counter() - wall))
        started = time.process_time()
        surface.collides(ToolPoses(positions, quaternions), PG70, threads=threads)
        surface_rates.append(len(codes) / (time.process_time() - started))
    shares = np.bincount(codes, minlength=3) / len(codes)
    return {
        "object": name,
        "parts": len(thing.parts),
        "grid_poses": grid.candidate_total,
        "poses": int(grid.total),
        "poses_per_s_core": round(statistics.median(rates)),
        "poses_per_s_wall": round(statistics.median(wall_rates)),
        "surface_poses_per_s_core": round(statistics.median(surface_rates)),
        "generated_per_s": round(generated),
        "collides": round(float(shares[collision.COLLIDES]), 4),
        "empty": round(float(shares[collision.EMPTY]), 4),
        "needs_physics": round(float(shares[collision.CONTACT]), 4),
    }


def yardstick() -> float:
    """Milliseconds of processor time for a fixed computation: median of five sorts of a million numbers."""
    values = np.random.default_rng(0).normal(size=1_000_000)
    times = []
    for _ in range(5):
        started = time.process_time()
        np.sort(values)
        times.append(time.process_time() - started)
    return 1000 * statistics.median(times)


def main() -> None:
    """Print a table, or JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--poses", type=int, default=300_000)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    results = [measure(name, options.poses, options.repetitions, options.threads) for name in EXAMPLES]
    report = {"yardstick_ms": round(yardstick(), 1), "threads": options.threads, "results": results}
    if options.json:
        print(json.dumps(report))
        return
    print(f"{'object':<14}{'parts':>6}{'poses/s/core':>14}{'poses/s':>12}{'surface':>12}{'physics':>9}")
    for row in results:
        print(
            f"{row['object']:<14}{row['parts']:>6}{row['poses_per_s_core']:>14,}{row['poses_per_s_wall']:>12,}"
            f"{row['surface_poses_per_s_core']:>12,}{row['needs_physics']:>9.2%}"
        )
    print(f"yardstick {report['yardstick_ms']} ms, {options.threads} thread(s)")


if __name__ == "__main__":
    main()
