"""Anisotropic kernels: normalisation, mirror, the fast density against float64, samples, maxima."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

import brute_force
from graspdb_density import IsotropicKernel, Region, se3
from graspdb_density.kde.mixture import MixtureDensity
from graspdb_density.kde.rows import Rows
from graspdb_density.kde.weighted_sums import KernelRows
from graspdb_density.kernels.gaussian_mixture import AnisotropicKernel, mirror
from graspdb_density.search.mode_search import ModeSearch

Poses = tuple[se3.Floats, se3.Floats]
Shell = Callable[[int, np.random.Generator], Poses]
Moved = Callable[[Poses, int, float, float, np.random.Generator], Poses]

DEG = math.pi / 180.0
SMALL = 1e-4 * np.eye(6)
ONE = AnisotropicKernel.diagonal([0.007, 0.02, 0.01, 12 * DEG, 22 * DEG, 15 * DEG])
WIDE = AnisotropicKernel.diagonal([0.01, 0.03, 0.01, 20 * DEG, 40 * DEG, 25 * DEG])
PAIR = AnisotropicKernel.symmetrised(
    [0.6, 0.4],
    [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.012, 0.004, 0.0, 0.3, 0.0]],
    np.stack([np.diag(np.square([0.01] * 3 + [turn] * 3)) for turn in (0.2, 0.15)]),
)


def correlated(rng: np.random.Generator, frame: str) -> AnisotropicKernel:
    root = rng.standard_normal((6, 6)) * 0.3 + np.eye(6)
    scale = np.array([0.01, 0.015, 0.01, 0.2, 0.25, 0.2]) * 0.6
    cov = (root @ root.T) * scale[:, None] * scale
    return AnisotropicKernel.gaussian(cov, frame=frame)  # type: ignore[arg-type]


@pytest.mark.parametrize("kernel", [ONE, WIDE, PAIR], ids=["one", "wide", "pair"])
def test_kernels_integrate_to_one(kernel: AnisotropicKernel) -> None:
    """Importance sampling from an isotropic kernel wider than any of its directions."""
    rng = np.random.default_rng(0)
    count = 400_000
    spread = np.sqrt(np.diag(kernel.overall_covariance))
    cover = IsotropicKernel(1.2 * float(spread[:3].max()), 1.2 * float(spread[3:].max()))
    p, q = cover.sample_displacements(count, rng)
    log_cover = cover.log_kernel(se3.Poses(p, q), se3.Poses(np.zeros(3), se3.IDENTITY))
    ratio = np.exp(kernel.log_kernel(np.hstack([p, se3.to_rotation_vector(q)])) - log_cover)
    error = ratio.std() / math.sqrt(count)
    assert error < 0.015
    assert abs(ratio.mean() - 1.0) < 4.5 * error


def test_normaliser_agrees_with_the_series() -> None:
    """1 - tr/12 + (tr^2 + 2 tr T^2)/360, short of the next term, -E|theta|^6/20160; 0.98306 at 15 degrees."""
    for degrees in (15.0, 30.0, 40.0):
        variance = (degrees * DEG) ** 2
        kernel = AnisotropicKernel.diagonal([0.01] * 3 + [degrees * DEG] * 3)
        plain = -3.0 * math.log(2.0 * math.pi) - 3.0 * math.log(0.01) - 1.5 * math.log(variance)
        share = math.exp(plain - float(kernel.log_peaks[0]))
        trace = 3.0 * variance
        series = 1.0 - trace / 12.0 + (trace**2 + 6.0 * variance**2) / 360.0
        assert share == pytest.approx(series - 105.0 * variance**3 / 20_160.0, abs=6e-5)
        if degrees == 15.0:
            assert share == pytest.approx(0.98306, abs=1e-5)


@pytest.mark.parametrize("frame", ["gripper", "fixed"])
def test_the_jaws_turn_changes_nothing(frame: str, shell: Shell, moved: Moved) -> None:
    rng = np.random.default_rng(1)
    kernel = correlated(rng, frame)
    a = mirror(kernel.frame)
    xi = rng.standard_normal((50, 6)) * np.sqrt(np.diag(kernel.overall_covariance))
    np.testing.assert_allclose(kernel.log_kernel(xi), kernel.log_kernel(a * xi), atol=1e-9)
    rows = shell(500, rng)
    frames = None if frame == "gripper" else se3.to_matrix(se3.random_quaternions(500, rng))
    density = MixtureDensity(se3.Poses.of(*rows), kernel=kernel, frames=frames)
    p, q = moved(rows, 60, 0.01, 0.2, rng)
    value = density.log_density(se3.Poses.of(p, q))
    np.testing.assert_allclose(density.log_density(se3.Poses.of(p, se3.jaw_twin(q))), value, atol=2e-3)
    np.testing.assert_allclose(density.log_density(se3.Poses.of(p, -q)), value, atol=1e-4)
    summed = KernelRows(Rows.of(se3.Poses.of(*rows)), kernel, frames=frames)
    np.testing.assert_allclose(
        summed.exact_log_density(se3.Poses.of(p, se3.jaw_twin(q))),
        summed.exact_log_density(se3.Poses.of(p, q)),
        atol=1e-9,
    )


@pytest.mark.parametrize("kernel", [ONE, WIDE, PAIR], ids=["one", "wide", "pair"])
@pytest.mark.parametrize("plain", [True, False])
def test_fast_density_equals_float64(
    kernel: AnisotropicKernel, plain: bool, shell: Shell, moved: Moved
) -> None:
    rng = np.random.default_rng(2)
    rows = shell(3_000, rng)
    weights = None if plain else rng.uniform(0.2, 2.0, 3_000)
    flags = True if plain else rng.random(3_000) < 0.6
    density = MixtureDensity(se3.Poses.of(*rows), kernel=kernel, weights=weights, symmetric=flags)
    summed = KernelRows(Rows.of(se3.Poses.of(*rows), weights=weights, symmetric=flags), kernel)
    poses = se3.Poses.of(*moved(rows, 300, 0.012, 0.2, rng))
    error = np.abs(np.expm1(density.log_density(poses, threads=2) - summed.exact_log_density(poses)))
    assert error.max() < 2e-3
    assert np.median(error) < 1e-4
    far = se3.Poses(poses.positions[:10] + 2.0, poses.quaternions_xyzw[:10])
    np.testing.assert_allclose(density.log_density(far), summed.exact_log_density(far), rtol=1e-9)
    assert (density.log_density(far) < -500.0).all()


def test_reference_sums_kernels_as_defined(shell: Shell, moved: Moved) -> None:
    """The compiled float64 sum against displacements computed with `se3`."""
    rng = np.random.default_rng(3)
    rows = shell(200, rng)
    density = KernelRows(Rows.of(se3.Poses.of(*rows)), PAIR)
    poses = moved(rows, 20, 0.01, 0.2, rng)
    expected = np.empty(20)
    for j, (p, q) in enumerate(zip(*poses, strict=True)):
        total = 0.0
        for turned in (rows[1], se3.jaw_twin(rows[1])):
            move = se3.rotate(se3.conjugate(turned), p - rows[0])
            turn = se3.to_rotation_vector(se3.multiply(se3.conjugate(turned), q))
            total += 0.5 * float(np.exp(PAIR.log_kernel(np.hstack([move, turn]))).mean())
        expected[j] = math.log(total)
    np.testing.assert_allclose(density.exact_log_density(se3.Poses.of(*poses)), expected, atol=1e-6)


def test_equal_widths_are_the_isotropic_kernel(shell: Shell, moved: Moved) -> None:
    """A Gaussian in the tangent space and von Mises-Fisher on the sphere differ little at 10 degrees."""
    rng = np.random.default_rng(4)
    rows = shell(2_000, rng)
    kernel = AnisotropicKernel.diagonal([0.015] * 3 + [10 * DEG] * 3)
    assert kernel.isotropic.sigma_position_m == pytest.approx(0.015)
    poses = moved(rows, 200, 0.015, 10 * DEG, rng)
    aniso = MixtureDensity(se3.Poses.of(*rows), kernel=kernel).log_density(se3.Poses.of(*poses))
    iso = brute_force.log_density(IsotropicKernel(0.015, 10 * DEG), se3.Poses.of(*rows), se3.Poses.of(*poses))
    assert np.abs(aniso - iso).mean() < 0.01


def test_displacements_drawn_have_the_kernels_moments() -> None:
    rng = np.random.default_rng(5)
    move, turn = PAIR.sample_displacements(100_000, rng)
    xi = np.hstack([move, se3.to_rotation_vector(turn)])
    np.testing.assert_allclose(xi.mean(axis=0), 0.0, atol=2e-3)
    spread = np.sqrt(np.diag(PAIR.overall_covariance))
    # Rotations a little less: the volume element thins out large ones.
    np.testing.assert_allclose(xi.std(axis=0) / spread, 1.0, atol=0.03)


def test_maximum_is_feasible_and_no_worse_than_rows_and_samples(shell: Shell) -> None:
    rng = np.random.default_rng(7)
    density = MixtureDensity(se3.Poses.of(*shell(1_000, rng)), kernel=ONE)
    region = Region(approach=[0.0, 0.0, -1.0], approach_angle=0.7)
    search = ModeSearch(density)
    (best,) = search.maxima(region)
    assert region.contains(best.position[None], best.quaternion_xyzw[None]).all()
    p, q = density.sample(4_000, rng)
    inside = region.contains(p, q)
    assert best.score >= density.log_density(se3.Poses.of(p[inside], q[inside])).max() - 1e-3
    assert search.global_maximum().score >= best.score - 1e-6


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AnisotropicKernel.diagonal([0.01, 0.01, 0.0, 0.1, 0.1, 0.1]), "singular"),
        (lambda: AnisotropicKernel.diagonal([0.01] * 3 + [0.1, 0.8, 0.1]), "takes a mixture"),
        (lambda: AnisotropicKernel.diagonal([20.0] * 3 + [0.1] * 3), "position width"),
        (lambda: AnisotropicKernel.gaussian(np.eye(5)), "shape"),
        (lambda: AnisotropicKernel.gaussian(np.full((6, 6), np.nan)), "finite"),
        (
            lambda: AnisotropicKernel(np.ones(1), np.full((1, 6), 0.01), 1e-4 * np.eye(6)[None]),
            "jaw is turned",
        ),
        (lambda: AnisotropicKernel(np.zeros(1), np.zeros((1, 6)), 1e-4 * np.eye(6)[None]), "positive"),
        (lambda: AnisotropicKernel(np.ones(2), np.zeros((1, 6)), 1e-4 * np.eye(6)[None]), "have shapes"),
        (lambda: AnisotropicKernel.gaussian(SMALL, frame="world"), "frame is"),  # type: ignore[arg-type]
        (lambda: AnisotropicKernel.gaussian(1e-4 * (np.eye(6) + np.eye(6, k=2))), "not symmetric"),
    ],
)
def test_bad_kernels_are_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_frames_must_fit_the_kernel() -> None:
    p, q = np.zeros((1, 3)), se3.IDENTITY[None]
    with pytest.raises(ValueError, match="takes no frames"):
        MixtureDensity(se3.Poses.of(p, q), kernel=ONE, frames=np.eye(3))
    fixed = AnisotropicKernel.diagonal([0.01] * 3 + [0.1] * 3, frame="fixed")
    with pytest.raises(ValueError, match="needs frames"):
        MixtureDensity(se3.Poses.of(p, q), kernel=fixed)
    assert MixtureDensity(se3.Poses.of(p, q), kernel=fixed, frames=np.eye(3)).size == 1


@pytest.mark.parametrize("frame", ["gripper", "fixed"])
def test_extending_equals_building(frame: str, shell: Shell, moved: Moved) -> None:
    rng = np.random.default_rng(31)
    kernel = correlated(rng, frame)
    p, q = shell(3_000, rng)
    weights, symmetric = rng.uniform(0.2, 5.0, 3_000), rng.random(3_000) < 0.7
    frames = se3.to_matrix(se3.random_quaternions(3_000, rng)) if frame == "fixed" else None

    def part(rows: slice) -> dict[str, object]:
        return {
            "weights": weights[rows],
            "symmetric": symmetric[rows],
            "frames": None if frames is None else frames[rows],
        }

    first, rest = slice(0, 2_500), slice(2_500, 3_000)
    old = MixtureDensity(se3.Poses.of(p[first], q[first]), kernel=kernel, **part(first))  # type: ignore[arg-type]
    search = ModeSearch(old)
    search.global_maximum()
    grown = old.extend(se3.Poses.of(p[rest], q[rest]), **part(rest))  # type: ignore[arg-type]
    built = MixtureDensity(se3.Poses.of(p, q), kernel=kernel, **part(slice(None)))  # type: ignore[arg-type]
    poses = moved((p, q), 300, 0.01, 0.2, rng)
    np.testing.assert_allclose(
        grown.log_density(se3.Poses.of(*poses)), built.log_density(se3.Poses.of(*poses)), atol=1e-5
    )
    far = poses[0] + 1.0, poses[1]
    np.testing.assert_allclose(
        grown.log_density(se3.Poses.of(*far)), built.log_density(se3.Poses.of(*far)), rtol=1e-6
    )
    # Two units in the last place of kappa, about 100 here.
    np.testing.assert_allclose(
        grown.isotropic.log_density(se3.Poses.of(*poses)),
        built.isotropic.log_density(se3.Poses.of(*poses)),
        atol=2e-5,
    )
    top = search.extended(grown).global_maximum().log_density
    assert math.exp(top - ModeSearch(built).global_maximum().log_density) > 0.999
    assert grown.size == 3_000
    assert old.size == 2_500
    assert grown.nbytes > old.nbytes
