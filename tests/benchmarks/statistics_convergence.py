"""Speed and memory of the convergence measure (eq 9), beside SciPy's neighbour search and sparse product.

The peer builds the same kernel matrix with ``scipy.spatial.cKDTree`` (pairs within five standard deviations
of position) and NumPy, and multiplies it with the same bootstrap weights; it runs on a tenth of the points.
Times are medians, of the wall clock unless a column says otherwise; memory is the peak of a whole process
that does nothing else.
"""

from __future__ import annotations

import math
import multiprocessing
import resource
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from graspdb_density import AnisotropicKernel, IsotropicKernel, se3
from graspdb_density._compiled.threads import processors
from graspdb_density.kde.rows import Rows
from graspdb_density.kde.weighted_sums import LEAST, KernelRows
from graspdb_density.kernels.gaussian_mixture import Kernel
from graspdb_density.se3 import Poses
from graspdb_density.statistics.convergence import bootstrap_similarity
from graspdb_density.statistics.incremental_bootstrap import IncrementalCurve

sys.path.append(str(Path(__file__).parents[1] / "density"))
from ellipsoid_shell import shell

Pair = tuple[se3.Floats, se3.Floats]
KERNEL = IsotropicKernel(0.015, math.radians(15.0))
REPLICATES = 50


#: Wide along x and z and about y, as the paper finds.
GAUSSIAN = AnisotropicKernel.diagonal([0.02, 0.008, 0.02, 0.2, 0.4, 0.2])


def peer_similarity(rows: KernelRows, points: int, rng: np.random.Generator) -> float:
    """Eq 9 with SciPy and NumPy."""
    p, q = rows.sample(points, rng)
    tree = cKDTree(rows.poses.positions)
    found = tree.query_ball_point(p, 5.0 * KERNEL.sigma_position_m)
    lengths = np.array([len(f) for f in found])
    columns = np.concatenate([np.asarray(f, dtype=np.int64) for f in found])
    at = np.repeat(np.arange(points), lengths)
    square = np.sum((p[at] - rows.poses.positions[columns]) ** 2, axis=1) / (2.0 * KERNEL.sigma_position_m**2)
    own = rows.poses.quaternions_xyzw
    cosine = np.maximum(
        np.abs(np.sum(q[at] * own[columns], axis=1)),
        np.abs(np.sum(q[at] * se3.jaw_twin(own)[columns], axis=1)),
    )
    value = np.exp(KERNEL.kappa * (cosine - 1.0) - square)
    kept = value > LEAST
    matrix = csr_matrix((value[kept], (at[kept], columns[kept])), shape=(points, rows.size))
    counts = rng.multinomial(rows.size, np.full(rows.size, 1.0 / rows.size), size=REPLICATES).T
    whole = matrix @ np.ones(rows.size)
    return float(np.sqrt((matrix @ counts) / whole[:, None]).mean())


def timed(work: Callable[[], object], rounds: int) -> tuple[float, float]:
    """Median seconds by the wall clock, and by this process's processors (which others don't disturb)."""
    times, busy = [], []
    for _ in range(rounds):
        started, spent = time.perf_counter(), time.process_time()
        work()
        times.append(time.perf_counter() - started)
        busy.append(time.process_time() - spent)
    return statistics.median(times), statistics.median(busy)


def _peak(count: int, points: int) -> float:
    """MB of this process at its peak."""
    rows = KernelRows(Rows.of(se3.Poses.of(*shell(count, np.random.default_rng(0)))), KERNEL)
    bootstrap_similarity(rows, np.random.default_rng(1), replicates=REPLICATES, points=points)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def peak(count: int, points: int) -> float:
    """As `_peak`, of a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_peak, (count, points))


def growth(count: int, added: int, rng: np.random.Generator) -> None:
    """Print what a report costs that has a curve of ``count`` grasps and gets ``added`` more."""
    p, q = shell(count + added, rng)
    for name, kernel in (("isotropic", KERNEL), ("anisotropic", GAUSSIAN)):
        kept = IncrementalCurve.of(Rows.of(Poses.of(p[:count], q[:count])), kernel)

        def grown(known: IncrementalCurve | None, kernel: Kernel = kernel) -> tuple[IncrementalCurve, float]:
            began = time.process_time()
            return IncrementalCurve.of(
                Rows.of(Poses.of(p, q)), kernel, before=known
            ), time.process_time() - began

        whole, at_once = grown(None)
        more, extended = grown(kept)
        _, unchanged = grown(more)
        assert (whole.kept, more.kept) == (0, count)
        apart = max(
            float(np.abs(one.replicates - other.replicates).max())
            for one, other in zip(whole.curve.points, more.curve.points, strict=True)
        )
        print(
            f"{count} grasps and {added} more, {name}: {extended:.2f} CPU s, at once {at_once:.2f},"
            f" nothing new {unchanged:.2f}; s differs by {apart:.0e}; {more.nbytes / 1e6:.0f} MB kept",
            flush=True,
        )


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    threads = processors()
    head = ("grasps", "points", "kernel", "s", "seconds", "CPU s", f"{threads} threads", "MB")
    print("{:>8} {:>8} {:>12} {:>7} {:>8} {:>7} {:>10} {:>6}".format(*head))
    sizes = ((20_000, 20_000, 5), (160_000, 20_000, 3), (160_000, 160_000, 1))
    for count, points, rounds in sizes:
        poses = shell(count, rng)
        for name, kernel in (("isotropic", KERNEL), ("anisotropic", GAUSSIAN)):
            if name == "anisotropic" and points > 20_000:
                continue
            rows = KernelRows(Rows.of(se3.Poses.of(*poses)), kernel)
            bootstrap_similarity(rows, np.random.default_rng(1), points=200)  # compiles

            def measure(threads: int = 1, rows: KernelRows = rows, points: int = points) -> float:
                found = bootstrap_similarity(
                    rows, np.random.default_rng(1), replicates=REPLICATES, points=points, threads=threads
                )
                return float(found.mean())

            s = measure()
            one, cpu = timed(measure, rounds)
            both, _ = timed(lambda measure=measure: measure(threads), rounds)  # type: ignore[misc]
            memory = f"{peak(count, points):.0f}" if name == "isotropic" else ""
            print(
                f"{count:>8} {points:>8} {name:>12} {s:>7.4f} "
                f"{one:>8.2f} {cpu:>7.2f} {both:>10.2f} {memory:>6}",
                flush=True,
            )
    rows = KernelRows(Rows.of(se3.Poses.of(*shell(20_000, rng))), KERNEL)
    _, ours = timed(lambda: bootstrap_similarity(rows, np.random.default_rng(1), points=2_000), 3)
    _, peer = timed(lambda: peer_similarity(rows, 2_000, np.random.default_rng(1)), 3)
    print(
        f"20,000 grasps, 2,000 points: {ours:.2f} CPU s; SciPy and NumPy {peer:.2f}, "
        f"{peer / ours:.0f} times as long"
    )
    growth(20_000, 500, rng)
    for count in (20_000, 160_000):
        poses = shell(count, rng)
        wall, cpu = timed(lambda poses=poses: IncrementalCurve.of(Rows.of(Poses.of(*poses)), KERNEL), 1)  # type: ignore[misc]
        print(
            f"curve to {count} grasps, 5 subsets a point, held-out likelihood: {wall:.1f} s, CPU {cpu:.1f} s"
        )


if __name__ == "__main__":
    main()
