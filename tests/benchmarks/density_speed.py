"""Speed of densities beside scikit-learn's, NumPy's exponential and bare loops, on the ellipsoid shell.

Every figure is a median of interleaved rounds in one process on one core, unless a column says otherwise.
The peer is ``sklearn.neighbors.KernelDensity`` on the 7-D embedding ``(p / sigma, sqrt(kappa) q)``, where a
Gaussian of bandwidth 1 is the kernel itself; rows are doubled for the jaw's twins but not for the sign of
quaternions, which saves the peer half its rows and makes its answers wrong wherever signs differ.

``python tests/benchmarks/density_speed.py --plot FILE`` also draws time against the number of kernels.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from sklearn.neighbors import KernelDensity

from graspdb_density import (
    AnisotropicKernel,
    GraspDensity,
    IsotropicKernel,
    MixtureDensity,
    Region,
    compiled,
    reference,
    se3,
)

Poses = tuple[se3.Floats, se3.Floats]
ROUNDS = 5


def shell(count: int, rng: np.random.Generator) -> Poses:
    """Grasps on an ellipsoid of semi-axes 0.2, 0.1, 0.1 m, moved along its normal within 20 mm, any roll."""
    axes = np.array([0.2, 0.1, 0.1])
    unit = rng.standard_normal((count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    normal = unit / axes
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    positions = unit * axes + normal * rng.uniform(-0.01, 0.01, (count, 1))
    z = -normal + 0.4 * rng.standard_normal((count, 3))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    helper = np.where(np.abs(z[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    frames = se3.from_matrix(np.stack([x, np.cross(z, x), z], axis=-1))
    roll = np.zeros((count, 3))
    roll[:, 2] = rng.uniform(-np.pi, np.pi, count)
    return positions, se3.multiply(frames, se3.from_rotation_vector(roll))


def queries(rows: Poses, count: int, kernel: IsotropicKernel, rng: np.random.Generator) -> Poses:
    """Random rows moved by the kernel's own widths."""
    index = rng.integers(len(rows[0]), size=count)
    turns = se3.from_rotation_vector(rng.standard_normal((count, 3)) * kernel.sigma_rotation)
    moves = rng.standard_normal((count, 3)) * kernel.sigma_position_m
    return rows[0][index] + moves, se3.multiply(rows[1][index], turns)


def interleaved(rounds: int, *tasks: Callable[[], object]) -> list[float]:
    """Median seconds of every task, one round of each after the other."""
    seconds: list[list[float]] = [[] for _ in tasks]
    for task in tasks:
        task()
    for _ in range(rounds):
        for spent, task in zip(seconds, tasks, strict=True):
            started = time.perf_counter()
            task()
            spent.append(time.perf_counter() - started)
    return [statistics.median(s) for s in seconds]


def embedded(kernel: IsotropicKernel, positions: se3.Floats, quaternions: se3.Floats) -> se3.Floats:
    return np.hstack([positions / kernel.sigma_position_m, math.sqrt(kernel.kappa) * quaternions])


def against_scikit_learn(rng: np.random.Generator) -> None:
    print("\nevaluation against scikit-learn, poses a second (error: relative to float64 over all rows)")
    print("kernels   sigma           ours  2 threads  scikit-learn  ratio   error median     p99     max")
    for count, metres, degrees, asked, peers in (
        (20_000, 0.015, 20.0, 20_000, 600),
        (20_000, 0.030, 20.0, 10_000, 300),
        (160_000, 0.015, 20.0, 20_000, 100),
        (160_000, 0.015, 15.0, 20_000, 100),
        (160_000, 0.030, 20.0, 5_000, 30),
    ):
        kernel = IsotropicKernel(metres, math.radians(degrees))
        rows = shell(count, rng)
        density = GraspDensity.build(*rows, kernel=kernel)
        poses = queries(rows, asked, kernel, rng)
        doubled = np.concatenate([embedded(kernel, *rows), embedded(kernel, rows[0], se3.jaw_twin(rows[1]))])
        peer = KernelDensity(kernel="gaussian", bandwidth=1.0, rtol=1e-3).fit(doubled)
        few = embedded(kernel, poses[0][:peers], poses[1][:peers])
        ours, two, theirs = interleaved(
            ROUNDS,
            lambda d=density, q=poses: d.log_density(*q),
            lambda d=density, q=poses: d.log_density(*q, threads=2),
            lambda k=peer, q=few: k.score_samples(q),
        )
        part = poses[0][:300], poses[1][:300]
        error = np.abs(np.expm1(density.log_density(*part) - reference.log_density(kernel, *rows, *part)))
        print(
            f"{count:7d}   {1e3 * metres:.0f} mm, {degrees:.0f} deg {asked / ours:9.0f}  {asked / two:9.0f}"
            f"  {peers / theirs:12.0f}  {asked / ours / (peers / theirs):5.0f}"
            f"      {np.median(error):8.1e} {np.quantile(error, 0.99):.1e} {error.max():.1e}"
        )


# Not cached on disk: a module that is loaded by path has another name every time.
vectorised = numba.njit(fastmath=True, error_model="numpy", nogil=True)


@intrinsic
def _float_of_bits(typing_context, bits):
    def generate(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@vectorised
def _bare_exponentials(x, y, rounds):
    """y = e^x as NumPy's ufunc does it, from memory to memory: range reduction by 1/ln 2 and a fifth-degree
    polynomial (Cephes expf), the power of two by its bits."""
    for _ in range(rounds):
        for i in range(np.uint64(len(x))):
            v = max(x[i], np.float32(-75.0))
            k = np.floor(v * np.float32(1.44269504) + np.float32(0.5))
            r = v - k * np.float32(0.693359375) + k * np.float32(2.12194440e-4)
            e = np.float32(1.9875691500e-4) * r + np.float32(1.3981999507e-3)
            e = e * r + np.float32(8.3334519073e-3)
            e = e * r + np.float32(4.1665795894e-2)
            e = e * r + np.float32(1.6666665459e-1)
            e = e * r + np.float32(5.0000001201e-1)
            e = e * r * r + r + np.float32(1.0)
            y[i] = e * _float_of_bits(np.int32((k + np.float32(127.0)) * np.float32(8388608.0)))


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
            total += compiled._exp(abs(a) - kappa - (dx * dx + dy * dy + dz * dz))
        out[j] = total


@vectorised
def _all_blocks(data, poses, kappa, out):
    """The loop densities run, over every kernel."""
    for j in range(len(poses)):
        total, begin = 0.0, 0
        while begin < data.shape[1]:
            end = min(begin + compiled.BLOCK, data.shape[1])
            part = compiled._run_narrow(
                data, begin, end, poses[j, 0], poses[j, 1], poses[j, 2],
                poses[j, 3], poses[j, 4], poses[j, 5], poses[j, 6], kappa,
            )  # fmt: skip
            total += part[0]
            begin = end
        out[j] = total


def brute_force(rng: np.random.Generator) -> None:
    """Kernels a second without any cut-off, beside bare loops and NumPy's exponential."""
    kernel = IsotropicKernel(0.015, math.radians(20.0))
    rows = shell(20_000, rng)
    cells = GraspDensity.build(*rows, kernel=kernel).cells
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
        ROUNDS,
        lambda: _all_blocks(cells.data, poses, kappa, out),
        lambda: _bare_kernels(cells.data, poses, kappa, out),
        lambda: _bare_exponentials(x, y, 500),
        numpy_exponentials,
    )
    ours, kernels, exponentials, numpy = (500 * 20_000 / 1e9 / s for s in seconds)
    print("\nbrute force over 20,000 kernels, 1e9 a second on one core")
    print(f"kernels, mirror and weights included      {ours:6.2f}")
    print(f"bare loop over kernels, no mirror         {kernels:6.2f}   ours / bare {ours / kernels:.2f}")
    print(f"bare loop over exponentials               {exponentials:6.2f}", end="")
    print(f"   ours / bare {ours / exponentials:.2f}")
    print(f"NumPy's float32 exponential               {numpy:6.2f}   bare / NumPy {exponentials / numpy:.2f}")


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
        density = GraspDensity.build(*rows, kernel=kernel)
        started = time.perf_counter()
        density.centre_sums()
        centres = time.perf_counter() - started
        build, extend, best, ten = interleaved(
            ROUNDS,
            lambda r=rows, k=kernel: GraspDensity.build(*r, kernel=k),
            lambda d=density, r=more: d.extend(*r).centre_sums(),
            lambda d=density: d.maximum(region),
            lambda d=density: d.maximum(region, count=10),
        )
        print(
            f"{count:7d}  {1e3 * build:6.0f}  {1e3 * centres:8.0f}  {1e3 * extend:16.1f}"
            f"  {1e3 * best:21.1f}  {1e3 * ten:9.1f}  {density.nbytes / 1e6:4.0f}"
        )


def anisotropic(rng: np.random.Generator) -> None:
    """The 6x6 kernel over the pairs of the isotropic one, and a mixture of 2 beside 900 components a row."""
    print("\nanisotropic kernels, microseconds a pose on one core")
    print("rows      isotropic   6x6 of equal widths   ratio")
    for count in (20_000, 160_000):
        plain = IsotropicKernel(0.015, math.radians(15.0))
        rows = shell(count, rng)
        poses = queries(rows, 5_000, plain, rng)
        six = AnisotropicKernel.diagonal([0.015] * 3 + [math.radians(15.0)] * 3)
        iso, full = GraspDensity.build(*rows, kernel=plain), MixtureDensity(*rows, kernel=six)
        one, other = interleaved(
            ROUNDS,
            lambda d=iso, q=poses: d.log_density(*q),
            lambda d=full, q=poses: d.log_density(*q),
        )
        print(f"{count:7d}  {200 * one:9.1f}  {200 * other:20.1f}  {other / one:6.1f}")
    rows = shell(1_000, rng)
    pair = AnisotropicKernel.symmetrised(
        [0.5, 0.5],
        [[0.0] * 6, [0.0, 0.01, 0.0, 0.0, 0.2, 0.0]],
        np.stack([np.diag(np.square([0.015] * 3 + [0.25] * 3))] * 2),
    )
    xi = pair.sample_displacements(900, rng)
    moved = se3.compose(
        rows[0][:, None], rows[1][:, None], xi[None, :, :3], se3.from_rotation_vector(xi[None, :, 3:])
    )
    component = IsotropicKernel(0.01, math.radians(10.0))
    sampled = GraspDensity.build(moved[0].reshape(-1, 3), moved[1].reshape(-1, 4), kernel=component)
    fitted = MixtureDensity(*rows, kernel=pair)
    poses = queries(rows, 300, component, rng)
    slow, quick = interleaved(
        ROUNDS, lambda: sampled.log_density(*poses, cutoff=None), lambda: fitted.log_density(*poses)
    )
    cut, _ = interleaved(ROUNDS, lambda: sampled.log_density(*poses), lambda: None)
    over_all, cut_off, here = (1e6 * s / 300 for s in (slow, cut, quick))
    print(f"1,000 rows of 900 components: {over_all:.0f} summed over all, {cut_off:.0f} cut off")
    quicker = f"{over_all / here:.0f} and {cut_off / here:.0f} times faster"
    print(f"a mirrored mixture of 2: {here:.1f}, {quicker}")


def growth(rng: np.random.Generator, plot: str | None) -> None:
    """Time of a pose against the number of kernels: no steeper than the kernels within reach."""
    kernel = IsotropicKernel(0.015, math.radians(20.0))
    counts = [1_000, 2_000, 5_000, 10_000, 20_000, 40_000, 80_000, 160_000]
    print("\nmicroseconds a pose at 15 mm, 20 deg")
    print("kernels     ours   scikit-learn")
    ours_us, theirs_us = [], []
    for count in counts:
        rows = shell(count, rng)
        density = GraspDensity.build(*rows, kernel=kernel)
        poses = queries(rows, 10_000, kernel, rng)
        doubled = np.concatenate([embedded(kernel, *rows), embedded(kernel, rows[0], se3.jaw_twin(rows[1]))])
        peer = KernelDensity(kernel="gaussian", bandwidth=1.0, rtol=1e-3).fit(doubled)
        peers = max(40, 2_000_000 // count)
        few = embedded(kernel, poses[0][:peers], poses[1][:peers])
        ours, theirs = interleaved(
            3,
            lambda d=density, q=poses: d.log_density(*q),
            lambda k=peer, q=few: k.score_samples(q),
        )
        ours_us.append(1e6 * ours / 10_000)
        theirs_us.append(1e6 * theirs / len(few))
        print(f"{count:7d}  {ours_us[-1]:7.2f}  {theirs_us[-1]:13.1f}")
    if plot is not None:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(figsize=(6, 4))
        axes.loglog(counts, theirs_us, "s--", label="scikit-learn KernelDensity, rtol 1e-3")
        axes.loglog(counts, ours_us, "o-", label="GraspDB")
        axes.set_xlabel("kernels")
        axes.set_ylabel("time a pose, µs (one core)")
        axes.grid(alpha=0.3)
        axes.legend()
        figure.tight_layout()
        figure.savefig(plot, dpi=120)


def main(plot: str | None = None) -> None:
    """Print every table."""
    rng = np.random.default_rng(0)
    against_scikit_learn(rng)
    brute_force(rng)
    maxima(rng)
    anisotropic(rng)
    growth(rng, plot)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plot", metavar="FILE")
    main(parser.parse_args().plot)
