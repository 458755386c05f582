"""Speed of densities beside scikit-learn, SciPy with NumPy, NumPy's exponential and bare loops.

On grasps around an ellipsoid. Every figure is a median of interleaved rounds in one process, in processor
time of one core; what two threads gain is in wall-clock time and needs an idle machine. Peers:

- ``sklearn.neighbors.KernelDensity`` on the 7-D embedding ``(p / sigma, sqrt(kappa) q)``, where a Gaussian of
  bandwidth 1 is the kernel itself; rows are doubled for the jaw's twins but not for the sign of quaternions,
  which saves the peer half its rows and makes its answers wrong wherever signs differ;
- ``scipy.spatial.cKDTree`` over positions, and NumPy over the rows within the same four standard deviations,
  twins by the nearer of two cosines.

``python tests/benchmarks/density_speed.py --plot FILE`` also draws time against the number of kernels.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from scipy.spatial import cKDTree
from sklearn.neighbors import KernelDensity

from graspdb_density import (
    AnisotropicKernel,
    DiagonalKernel,
    GraspDensity,
    IsotropicKernel,
    MixtureDensity,
    Region,
    SampledKernel,
    SuccessModel,
    se3,
)
from graspdb_density._compiled import exp, isotropic
from graspdb_density.bandwidth import mixture_fit
from graspdb_density.kde.bhattacharyya import bhattacharyya, sampled_kernel_rows
from graspdb_density.kde.isotropic import CUTOFF, scaled_radius
from graspdb_density.search.mode_search import ModeSearch
from graspdb_density.search.start_ranking import centre_sums

sys.path.append(str(Path(__file__).parents[1] / "density"))
import brute_force as reference
from ellipsoid_shell import SEMI_AXES_M, shell

Poses = tuple[se3.Floats, se3.Floats]
ROUNDS = 5


def queries(rows: Poses, count: int, kernel: IsotropicKernel, rng: np.random.Generator) -> Poses:
    """Random rows moved by the kernel's own widths."""
    index = rng.integers(len(rows[0]), size=count)
    turns = se3.from_rotation_vector(rng.standard_normal((count, 3)) * kernel.sigma_rotation)
    moves = rng.standard_normal((count, 3)) * kernel.sigma_position_m
    return rows[0][index] + moves, se3.multiply(rows[1][index], turns)


def interleaved(
    rounds: int, *tasks: Callable[[], object], clock: Callable[[], float] = time.thread_time
) -> list[float]:
    """Median seconds of every task, one round of each after the other; of this thread's processor time,
    which other work on the machine disturbs least."""
    seconds: list[list[float]] = [[] for _ in tasks]
    for task in tasks:
        task()
    for _ in range(rounds):
        for spent, task in zip(seconds, tasks, strict=True):
            started = clock()
            task()
            spent.append(clock() - started)
    return [statistics.median(s) for s in seconds]


def scikit_learn(kernel: IsotropicKernel, rows: Poses) -> Callable[[Poses], se3.Floats]:
    """Log densities by scikit-learn, but for a constant."""

    def embedded(p: se3.Floats, q: se3.Floats) -> se3.Floats:
        return np.hstack([p / kernel.sigma_position_m, math.sqrt(kernel.kappa) * q])

    doubled = np.concatenate([embedded(*rows), embedded(rows[0], se3.jaw_twin(rows[1]))])
    fitted = KernelDensity(kernel="gaussian", bandwidth=1.0, rtol=1e-3).fit(doubled)
    return lambda poses: fitted.score_samples(embedded(*poses))


def scipy_and_numpy(kernel: IsotropicKernel, rows: Poses) -> Callable[[Poses], se3.Floats]:
    """Kernel sums by SciPy's tree and NumPy, cut off where ours are."""
    tree = cKDTree(rows[0])
    turned = se3.jaw_twin(rows[1])
    reach, kappa = CUTOFF * kernel.sigma_position_m, kernel.kappa
    unit = -0.5 / kernel.sigma_position_m**2

    def sums(poses: Poses) -> se3.Floats:
        out = np.empty(len(poses[0]))
        for j, near in enumerate(tree.query_ball_point(poses[0], reach)):
            squared = np.sum((rows[0][near] - poses[0][j]) ** 2, axis=1)
            q = poses[1][j]
            cosine = np.maximum(np.abs(rows[1][near] @ q), np.abs(turned[near] @ q))
            out[j] = np.exp(unit * squared + kappa * (cosine - 1.0)).sum()
        return out

    return sums


def against_peers(rng: np.random.Generator) -> None:
    print("\nevaluation, poses a second (error: relative to float64 over all rows)")
    print("kernels   sigma            ours  2 threads (x)  scikit-learn   (x)  SciPy+NumPy   (x)", end="")
    print("   error median     p99     max")
    for count, metres, degrees, asked, peers in (
        (20_000, 0.015, 20.0, 20_000, 600),
        (20_000, 0.030, 20.0, 10_000, 300),
        (160_000, 0.015, 20.0, 20_000, 100),
        (160_000, 0.015, 15.0, 20_000, 100),
        (160_000, 0.030, 20.0, 5_000, 30),
    ):
        kernel = IsotropicKernel(metres, math.radians(degrees))
        rows = shell(count, rng)
        density = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel)
        poses = queries(rows, asked, kernel, rng)
        few = poses[0][:peers], poses[1][:peers]
        learn, tree = scikit_learn(kernel, rows), scipy_and_numpy(kernel, rows)
        seconds = interleaved(
            ROUNDS,
            lambda d=density, q=poses: d.log_density(se3.Poses.of(*q)),
            lambda f=learn, q=few: f(q),
            lambda f=tree, q=few: f(q),
        )
        alone, both = interleaved(
            ROUNDS,
            lambda d=density, q=poses: d.log_density(se3.Poses.of(*q)),
            lambda d=density, q=poses: d.log_density(se3.Poses.of(*q), threads=2),
            clock=time.perf_counter,
        )
        one, theirs, scipys = (n / s for n, s in zip((asked, peers, peers), seconds, strict=True))
        part = poses[0][:300], poses[1][:300]
        error = np.abs(
            np.expm1(
                density.log_density(se3.Poses.of(*part))
                - reference.log_density(kernel, se3.Poses.of(*rows), se3.Poses.of(*part))
            )
        )
        print(
            f"{count:7d}   {1e3 * metres:.0f} mm, {degrees:.0f} deg {one:9.0f}  {alone / both:13.2f}"
            f"  {theirs:12.0f} {one / theirs:5.0f}  {scipys:11.0f} {one / scipys:5.0f}"
            f"        {np.median(error):8.1e} {np.quantile(error, 0.99):.1e} {error.max():.1e}"
        )


# Not cached on disk: a module that is loaded by path has another name every time.
vectorised = numba.njit(fastmath=True, error_model="numpy", nogil=True)


@intrinsic
def _float_of_bits(typing_context, bits):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@numba.njit(inline="always")
def _cephes(x):
    """e^x by range reduction by 1/ln 2 in two steps and a fifth-degree polynomial (Cephes expf), the power of
    two by its bits."""
    v = max(x, np.float32(-75.0))
    k = np.floor(v * np.float32(1.44269504) + np.float32(0.5))
    r = v - k * np.float32(0.693359375) + k * np.float32(2.12194440e-4)
    e = np.float32(1.9875691500e-4) * r + np.float32(1.3981999507e-3)
    e = e * r + np.float32(8.3334519073e-3)
    e = e * r + np.float32(4.1665795894e-2)
    e = e * r + np.float32(1.6666665459e-1)
    e = e * r + np.float32(5.0000001201e-1)
    e = e * r * r + r + np.float32(1.0)
    return e * _float_of_bits(np.int32((k + np.float32(127.0)) * np.float32(8388608.0)))


@vectorised
def _bare_exponentials(x, y, rounds):
    """From memory to memory, as NumPy's."""
    for _ in range(rounds):
        for i in range(np.uint64(len(x))):
            y[i] = _cephes(x[i])


@vectorised
def _bare_sums(x, rounds, out):
    """Summed, nothing written."""
    for r in range(rounds):
        total, shift = np.float32(0.0), np.float32(r) * np.float32(1e-3)
        for i in range(np.uint64(len(x))):
            total += _cephes(x[i] - shift)
        out[r] = total


@vectorised
def _bare_kernels(data, poses, kappa, out):
    """The kernel and nothing else: one twin, equal weights, one block."""
    for j in range(len(poses)):
        px, py, pz = poses[j, 0], poses[j, 1], poses[j, 2]
        qx, qy, qz, qw = poses[j, 3], poses[j, 4], poses[j, 5], poses[j, 6]
        total = np.float32(0.0)
        for i in range(np.uint64(data.shape[1])):
            dx = data[0, i] - px
            dy = data[1, i] - py
            dz = data[2, i] - pz
            a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
            total += exp.exp(abs(a) - kappa - (dx * dx + dy * dy + dz * dz))
        out[j] = total


def brute_force(rng: np.random.Generator) -> None:
    """Kernels a second without any cut-off, beside bare loops and NumPy's exponential."""
    kernel = IsotropicKernel(0.015, math.radians(20.0))
    rows = shell(20_000, rng)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel)
    # So wide that a cut-off leaves out nothing: what a query costs then, the test of its error included.
    reached = GraspDensity.build(se3.Poses.of(*rows), kernel=IsotropicKernel(0.15, kernel.sigma_rotation))
    cells = density.cells.arrays
    p, q = queries(rows, 500, kernel, rng)
    poses = np.hstack([(p - cells.centre) * cells.scale, kernel.kappa * q]).astype(np.float32)
    kappa = np.float32(kernel.kappa)
    out = np.empty(500)
    x = rng.uniform(-20.0, 0.0, 20_000).astype(np.float32)
    y = np.empty_like(x)

    def numpy_exponentials() -> None:
        for _ in range(500):
            np.exp(x, out=y)

    seconds = interleaved(
        4 * ROUNDS,
        lambda: isotropic.all_sums(cells, p, q, kernel.kappa, density.wide, out),
        lambda: reached.log_density(se3.Poses.of(p, q)),
        lambda: _bare_kernels(cells.data, poses, kappa, out),
        lambda: _bare_exponentials(x, y, 500),
        lambda: _bare_sums(x, 500, out),
        numpy_exponentials,
    )
    ours, queried, kernels, written, summed, numpy = (500 * 20_000 / 1e9 / s for s in seconds)
    print("\nbrute force over 20,000 kernels, 1e9 a second on one core     ours / it")
    print(f"sums over all kernels, mirror and weights included  {ours:6.2f}")
    print(f"log_density with all of them within reach           {queried:6.2f}")
    print(f"bare loop over kernels, no mirror, equal weights    {kernels:6.2f}  {ours / kernels:9.2f}")
    print(f"bare polynomial exponentials, memory to memory      {written:6.2f}  {ours / written:9.2f}")
    print(f"the same summed, nothing written                    {summed:6.2f}  {ours / summed:9.2f}")
    print(f"NumPy's float32 exponential, memory to memory       {numpy:6.2f}  {ours / numpy:9.2f}", end="")
    print(f"   (bare / NumPy {written / numpy:.2f})")


def maxima(rng: np.random.Generator) -> None:
    print("\nbuilding, extending and searching, milliseconds on one core")
    print("kernels   build   centres   extend by 1,000   best in box and cone   count=10   MB")
    region = Region(
        half_spaces=Region.box([-0.1, -0.1, 0.02], [0.1, 0.1, 0.2]),
        approach=[0.0, 0.0, -1.0],
        approach_angle=math.radians(45.0),
    )
    for count in (20_000, 160_000):
        kernel = IsotropicKernel(0.015, math.radians(15.0))
        rows, more = shell(count, rng), shell(1_000, rng)
        density = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel)
        started = time.thread_time()
        known = centre_sums(density, None, 1)
        centres = time.thread_time() - started
        search = ModeSearch(density)
        build, extend, best, ten = interleaved(
            ROUNDS,
            lambda r=rows, k=kernel: GraspDensity.build(se3.Poses.of(*r), kernel=k),
            lambda d=density, r=more, k=known: centre_sums(d.extend(se3.Poses.of(*r)), k, 1),
            lambda s=search: s.maxima(region),
            lambda s=search: s.maxima(region, count=10),
        )
        print(
            f"{count:7d}  {1e3 * build:6.0f}  {1e3 * centres:8.0f}  {1e3 * extend:16.1f}"
            f"  {1e3 * best:21.1f}  {1e3 * ten:9.1f}  {(density.nbytes + search.nbytes) / 1e6:4.0f}"
        )


def anisotropic(rng: np.random.Generator) -> None:
    """The 6x6 kernel over the pairs of the isotropic one."""
    print("\nanisotropic kernels, microseconds a pose on one core")
    print("rows      isotropic   6x6 of equal widths   ratio")
    for count in (20_000, 160_000):
        plain = IsotropicKernel(0.015, math.radians(15.0))
        rows = shell(count, rng)
        poses = queries(rows, 5_000, plain, rng)
        six = AnisotropicKernel.diagonal([0.015] * 3 + [math.radians(15.0)] * 3)
        iso, full = (
            GraspDensity.build(se3.Poses.of(*rows), kernel=plain),
            MixtureDensity(se3.Poses.of(*rows), kernel=six),
        )
        one, other = interleaved(
            3 * ROUNDS,
            lambda d=iso, q=poses: d.log_density(se3.Poses.of(*q)),
            lambda d=full, q=poses: d.log_density(se3.Poses.of(*q)),
        )
        print(f"{count:7d}  {200 * one:9.1f}  {200 * other:20.1f}  {other / one:6.1f}")
    replaced(rng)


def chances(rng: np.random.Generator) -> None:
    """Success probabilities of attempts, under one width of each kind and under widths for every axis."""
    print("\nsuccess probability with its nearest attempt, microseconds a pose on one core")
    print("attempts  one width of each kind   a width an axis   ratio")
    wide = DiagonalKernel((0.009, 0.015, 0.006, *np.radians([20.0, 20.0, 14.0])))
    for count in (2_000, 160_000):
        rows, held = shell(count, rng), rng.random(count) < 0.3
        attempts = se3.Poses.of(*rows)
        poses = se3.Poses.of(*queries(rows, 2_000, IsotropicKernel(0.004, math.radians(4.0)), rng))
        kernels = IsotropicKernel(0.015, math.radians(20.0)), wide
        models = [SuccessModel.build(attempts, held, kernel=kernel) for kernel in kernels]
        one, six = interleaved(
            ROUNDS,
            lambda m=models[0], q=poses: m.evaluate_near(q),
            lambda m=models[1], q=poses: m.evaluate_near(q),
        )
        print(f"{count:8}  {500 * one:22.1f}   {500 * six:15.1f}   {six / one:5.1f}")


def replaced(rng: np.random.Generator) -> None:
    """A mixture of 2 fitted to the 900 displacements of a sampled kernel, beside that kernel."""
    # Half of all neighbours are close by; half are spread along the jaw's y and turned about it.
    close = rng.standard_normal((450, 6)) * ([0.01] * 3 + [0.12] * 3)
    spread = rng.standard_normal((450, 6)) * [0.01, 0.03, 0.008, 0.15, 0.35, 0.15]
    xi = np.concatenate([close, spread])
    component = IsotropicKernel(0.01, math.radians(10.0))
    turns = se3.from_rotation_vector(xi[:, 3:])
    pair = mixture_fit._fitted(xi, np.ones(900), 2, component.overall_covariance, False)
    whole = sampled_kernel_rows(se3.Poses.of(xi[:, :3], turns), component)
    one = MixtureDensity(se3.Poses.of(np.zeros((1, 3)), se3.IDENTITY[None]), kernel=pair, symmetric=False)
    found = bhattacharyya(one, whole, rng, points=20_000)
    rows = shell(1_000, rng)
    sampled = SampledKernel(se3.Poses(xi[:, :3], turns), component, np.ones(len(xi))).placed(
        se3.Poses.of(*rows)
    )
    fitted = MixtureDensity(se3.Poses.of(*rows), kernel=pair)
    many, few = queries(rows, 5_000, component, rng), queries(rows, 100, component, rng)
    quick, cut, slow = interleaved(
        ROUNDS,
        lambda: fitted.log_density(se3.Poses.of(*many)),
        lambda: sampled.log_density(se3.Poses.of(*few)),
        lambda: sampled.log_density(se3.Poses.of(*few), cutoff=None),
    )
    here, cut_off, over_all = 1e6 * quick / 5_000, 1e6 * cut / 100, 1e6 * slow / 100
    print("\n1,000 rows, microseconds a pose on one core")
    print(f"mixture of 2 fitted to 900 displacements ({len(pair.weights)} with mirrors)   {here:8.1f}")
    print(f"the 900 components summed over all rows (eq 6)         {over_all:8.1f}  {over_all / here:6.0f} x")
    print(f"the same in cells, cut off at 4 sigma                  {cut_off:8.1f}  {cut_off / here:6.0f} x")
    print(f"their similarity (Bhattacharyya): {found.value:.3f} +- {found.standard_error:.3f}")


def growth(rng: np.random.Generator, plot: str | None) -> None:
    """Time of a pose against the number of kernels: no steeper than the kernels within reach."""
    kernel = IsotropicKernel(0.015, math.radians(20.0))
    counts = [1_000, 2_000, 5_000, 10_000, 20_000, 40_000, 80_000, 160_000, 320_000]
    curves: dict[str, list[float]] = {"ours": [], "scikit-learn": [], "SciPy": []}
    for name, scaled in (("on one object", False), ("on an object that grows with them", True)):
        print(f"\nkernels {name}, 15 mm, 20 deg: microseconds a pose")
        print("kernels   within reach     ours   ns a kernel within reach", end="")
        print("" if scaled else "   scikit-learn   SciPy+NumPy")
        reaches, spent = [], []
        for count in counts:
            scale = math.sqrt(count / 20_000) if scaled else 1.0
            rows = shell(count, rng, semi_axes_m=scale * np.array(SEMI_AXES_M))
            density = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel)
            scale = density.cells.arrays.scale
            poses = queries(rows, 10_000, kernel, rng)
            within = cKDTree(rows[0]).query_ball_point(
                poses[0][:1_000], CUTOFF * kernel.sigma_position_m, return_length=True
            )
            reaches.append(float(within.mean()))
            # The cells' own reach is rounded outwards; their share of that is in the time, not in the count.
            assert scaled_radius(CUTOFF) / scale >= CUTOFF * kernel.sigma_position_m * (1.0 - 1e-9)
            tasks: list[Callable[[], object]] = [lambda d=density, q=poses: d.log_density(se3.Poses.of(*q))]
            peers = max(40, 2_000_000 // count)
            few = poses[0][:peers], poses[1][:peers]
            if not scaled:
                for peer in (scikit_learn(kernel, rows), scipy_and_numpy(kernel, rows)):
                    tasks.append(lambda f=peer, q=few: f(q))
            seconds = interleaved(ROUNDS, *tasks)
            spent.append(1e6 * seconds[0] / 10_000)
            print(f"{count:7d}  {reaches[-1]:13.0f}  {spent[-1]:7.2f}", end="")
            print(f"  {1e3 * spent[-1] / reaches[-1]:25.2f}", end="")
            if not scaled:
                theirs = [1e6 * s / len(few[0]) for s in seconds[1:]]
                print(f"  {theirs[0]:13.1f}  {theirs[1]:12.1f}", end="")
                for name_of, value in zip(curves, (spent[-1], *theirs), strict=True):
                    curves[name_of].append(value)
            print()
        if not scaled:
            steep = math.log(spent[-1] / spent[0]) / math.log(reaches[-1] / reaches[0])
            print(f"time grows as the kernels within reach to the power of {steep:.2f}")
    if plot is not None:
        draw(plot, counts, curves)


def draw(path: str, counts: list[int], curves: dict[str, list[float]]) -> None:
    """Time of a pose against the number of kernels, beside the peers."""
    import matplotlib.pyplot as plt

    plt.rcParams.update({"svg.hashsalt": "graspdb", "svg.fonttype": "none"})
    figure, axes = plt.subplots(figsize=(6, 4))
    for (name, values), style, label in zip(
        curves.items(),
        ("o-", "s--", "^:"),
        ("GraspDB", "scikit-learn KernelDensity, rtol 1e-3", "SciPy cKDTree and NumPy"),
        strict=True,
    ):
        axes.loglog(counts, values, style, label=label, gid=name)
    axes.set_xlabel("kernels")
    axes.set_ylabel("time a pose, µs (one core)")
    axes.set_title("15 mm, 20°, 4 standard deviations, jaw symmetry included", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=120, metadata={"Date": None} if path.endswith(".svg") else None)


def main(plot: str | None = None) -> None:
    """Print every table."""
    rng = np.random.default_rng(0)
    against_peers(rng)
    brute_force(rng)
    maxima(rng)
    anisotropic(rng)
    chances(rng)
    growth(rng, plot)


def header() -> None:
    """The machine and its calibration score, as a run of all benchmarks prints them."""
    spec = importlib.util.spec_from_file_location("all_benchmarks", Path(__file__).with_name("__main__.py"))
    assert spec is not None
    assert spec.loader is not None
    runner = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(runner)
    flops, bandwidth = runner.calibration()
    print(f"{runner.processor()}, NumPy {np.__version__}, Numba {numba.__version__}")
    print(f"calibration, one core: {flops:.2f} GFLOP/s float32, copy {bandwidth:.1f} GB/s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plot", metavar="FILE")
    arguments = parser.parse_args()
    header()
    main(arguments.plot)
