"""Speed of the anisotropy report: empirical over at least a million pairs on a grid, and the density method.

The trials are those of a 10 mm / 15 degree sweep: every rotation at every position, success in a shell around
an ellipsoid for approaches near its normal. Medians.
"""

from __future__ import annotations

import math
import statistics
import time

import numpy as np

from graspdb_density import GraspDensity, IsotropicKernel, se3
from graspdb_density.se3 import Poses
from graspdb_density.vicinity.anisotropy import empirical_anisotropy
from graspdb_density.vicinity.displacement_density import density_anisotropy

ROUNDS = 5


def sweep(rng: np.random.Generator) -> tuple[se3.Floats, se3.Floats, np.ndarray, np.ndarray, np.ndarray]:
    """Positions, quaternions, success, rotation keys and position keys of about 1.4 million trials."""
    rotations = se3.random_quaternions(1_152, rng)
    side = [np.arange(-n, n + 1) * 0.01 for n in (8, 5, 5)]
    grid = np.stack(np.meshgrid(*side, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[np.linalg.norm(grid / [0.08, 0.05, 0.05], axis=1) < 1.2]
    position, rotation = (
        k.ravel() for k in np.meshgrid(np.arange(len(grid)), np.arange(len(rotations)), indexing="ij")
    )
    p, q = grid[position], rotations[rotation]
    depth = np.linalg.norm(grid / [0.06, 0.03, 0.03], axis=1)
    normal = grid / np.square([0.06, 0.03, 0.03])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    approach = se3.rotate(rotations, np.array([0.0, 0.0, 1.0]))
    cosine = -(normal @ approach.T).ravel()
    success = (np.abs(depth - 1.0) < 0.3)[position] & (cosine > math.cos(math.radians(35.0)))
    return p, q, success, rotation, position


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    p, q, success, rotation, position = sweep(rng)
    print(f"{len(p)} trials, {int(success.sum())} successes")
    grid = {"rotation_keys": rotation, "position_keys": position}
    for name, keys in (("grid", grid), ("by tolerance", {})):
        times, busy = [], []
        for turn in range(ROUNDS + 1):
            started, spent = time.perf_counter(), time.process_time()
            report = empirical_anisotropy(Poses.of(p, q), success, **keys, seed=turn)  # type: ignore[arg-type]
            times.append(time.perf_counter() - started)
            busy.append(time.process_time() - spent)
        pairs = report.translation_pairs + report.rotation_pairs
        seconds, cpu = statistics.median(times[1:]), statistics.median(busy[1:])
        print(
            f"empirical, {name}: {report.grasps} grasps, {pairs / 1e6:.2f} million pairs in {seconds:.2f} s, "
            f"CPU {cpu:.2f} s; {cpu / pairs * 1e6:.2f} CPU s a million"
        )
    kernel = IsotropicKernel(0.015, math.radians(15.0))
    chosen = np.flatnonzero(success)[:20_000]
    density = GraspDensity.build(Poses.of(p[chosen], q[chosen]), kernel=kernel)
    volume = len(np.unique(position)) * 1e-6
    density_anisotropy(density, len(p) / (8.0 * math.pi**2 * volume), max_grasps=2)
    started = time.perf_counter()
    density_anisotropy(density, len(p) / (8.0 * math.pi**2 * volume))
    print(f"density method, {density.size} kernels, 100 grasps: {time.perf_counter() - started:.2f} s")


if __name__ == "__main__":
    main()
