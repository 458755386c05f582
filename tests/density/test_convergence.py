"""Eq 9 against brute force and theory, curves, verdicts and the kernels behind them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp

import brute_force
from graspdb_density import IsotropicKernel, se3
from graspdb_density.bandwidth import matching
from graspdb_density.kde.rows import Rows
from graspdb_density.kde.weighted_sums import KernelRows
from graspdb_density.kernels.gaussian_mixture import (
    AnisotropicKernel,
    Frame,
    Kernel,
    mirror,
    rotation_normaliser,
)
from graspdb_density.se3 import Floats, Poses
from graspdb_density.statistics import convergence as cv
from graspdb_density.statistics.incremental_bootstrap import IncrementalCurve

Pair = tuple[Floats, Floats]
Shell = Callable[[int, np.random.Generator], Pair]
KERNEL = IsotropicKernel(0.015, math.radians(15.0))


def _gaussian(*deviations: float, frame: Frame = "gripper") -> AnisotropicKernel:
    return AnisotropicKernel.diagonal(deviations, frame=frame)


def _random_mixture(
    rng: np.random.Generator, scale: float = 1.0, frame: Frame = "gripper"
) -> AnisotropicKernel:
    """Two pairs of components, each a mirror image of the other."""
    widths = np.array([0.02, 0.01, 0.015, 0.25, 0.4, 0.2]) * scale
    means, covariances = [], []
    for _ in range(2):
        root = rng.standard_normal((6, 6)) * 0.3 + np.eye(6)
        cov = widths[:, None] * (root @ root.T) * widths
        mean = rng.standard_normal(6) * widths
        means += [mean, mirror(frame) * mean]
        covariances += [cov, mirror(frame)[:, None] * cov * mirror(frame)]
    return AnisotropicKernel([0.3, 0.3, 0.2, 0.2], np.array(means), np.array(covariances), frame)


def _brute_log_density(kernel: AnisotropicKernel, rows: Pair, frames: Floats | None, at: Pair) -> Floats:
    """Sum over rows, twins, components and both wraps in float64 with general-purpose pieces only."""
    lists: list[Floats] = []
    normaliser = rotation_normaliser(kernel.means[:, 3:], kernel.covariances[:, 3:, 3:])
    for turned in (False, True):
        q = se3.jaw_twin(rows[1]) if turned else rows[1]
        axes = se3.to_matrix(q) if frames is None else frames
        move = np.einsum("nij,mni->mnj", axes, at[0][:, None] - rows[0])
        vector = se3.to_rotation_vector(se3.multiply(se3.conjugate(q)[None], at[1][:, None]))
        angle = np.linalg.norm(vector, axis=-1, keepdims=True)
        for wrapped in (vector, vector * (1.0 - 2.0 * math.pi / np.maximum(angle, 1e-9))):
            xi = np.concatenate([move, wrapped], axis=-1)
            for w, mean, cov, z in zip(
                kernel.weights, kernel.means, kernel.covariances, normaliser, strict=True
            ):
                d = xi - mean
                square = np.einsum("mni,ij,mnj->mn", d, np.linalg.inv(cov), d)
                log_norm = 0.5 * np.linalg.slogdet(cov)[1] + 3.0 * math.log(2.0 * math.pi) + math.log(z)
                lists.append(math.log(w) - log_norm - 0.5 * square)
    result: Floats = logsumexp(np.concatenate(lists, axis=1), axis=1) - math.log(2.0 * len(rows[0]))
    return result


# -- kernels evaluated row by row


@pytest.mark.parametrize("degrees", [10.0, 15.0, 25.0, 50.0])
def test_isotropic_sums_equal_the_reference_under_every_weighting(shell: Shell, degrees: float) -> None:
    rng = np.random.default_rng(1)
    p, q = shell(400, rng)
    kernel = IsotropicKernel(0.03, math.radians(degrees))
    symmetric = rng.random(400) < 0.7
    rows = KernelRows(Rows.of(se3.Poses.of(p, q), symmetric=symmetric), kernel)
    at = tuple(rows.sample(60, rng))
    weightings = rng.random((400, 37))
    sums = rows.sums(se3.Poses.of(*at), weightings, least=0.0)
    for column in (0, 31, 36):
        w = weightings[:, column]
        expected = brute_force.log_density(
            kernel, se3.Poses.of(p, q), se3.Poses.of(*at), weights=w, symmetric=symmetric
        )
        got = np.log(sums[:, column] / w.sum()) + rows.log_unit
        assert np.max(np.abs(got - expected)) < 2e-3
        assert np.median(np.abs(got - expected)) < 1e-4


@pytest.mark.parametrize("framed", [False, True])
def test_mixture_density_equals_brute_force(shell: Shell, framed: bool) -> None:
    rng = np.random.default_rng(2)
    rows = shell(150, rng)
    frames = se3.to_matrix(se3.random_quaternions(150, rng)) if framed else None
    kernel = _random_mixture(rng, frame="fixed" if framed else "gripper")
    density = KernelRows(Rows.of(se3.Poses.of(*rows)), kernel, frames=frames)
    near = tuple(density.sample(80, rng))
    far = near[0] + rng.standard_normal((80, 3)) * 0.3, se3.random_quaternions(80, rng)
    for at in (near, far):
        got = density.log_density(se3.Poses.of(*at))
        assert np.max(np.abs(got - _brute_log_density(kernel, rows, frames, at))) < 2e-3


def test_a_round_gaussian_agrees_with_the_isotropic_kernel(shell: Shell) -> None:
    """The two families differ by how they curve on SO(3), of the order of the squared width."""
    rng = np.random.default_rng(3)
    p, q = shell(2_000, rng)
    narrow = IsotropicKernel(0.02, math.radians(6.0))
    density = KernelRows(Rows.of(se3.Poses.of(p, q)), narrow)
    round_one = KernelRows(Rows.of(se3.Poses.of(p, q)), _gaussian(*[0.02] * 3, *[math.radians(6.0)] * 3))
    at = tuple(density.sample(500, rng))
    assert (
        np.max(np.abs(density.log_density(se3.Poses.of(*at)) - round_one.log_density(se3.Poses.of(*at))))
        < 0.05
    )


@given(st.lists(st.floats(2.0, 40.0), min_size=3, max_size=3))
@settings(max_examples=25, deadline=None)
def test_rotation_normaliser_agrees_with_its_series(degrees: list[float]) -> None:
    cov = np.diag(np.radians(degrees) ** 2)
    trace = np.trace(cov)
    fourth = trace**2 + 2.0 * np.trace(cov @ cov)
    got = rotation_normaliser(np.zeros((1, 3)), cov[None])[0]
    assert got == pytest.approx(1.0 - trace / 12.0 + fourth / 360.0, abs=3e-3)
    if max(degrees) <= 20.0:
        assert got == pytest.approx(1.0 - trace / 12.0 + fourth / 360.0, abs=1e-4)


@pytest.mark.parametrize("kernel", [KERNEL, _gaussian(0.03, 0.01, 0.02, 0.5, 0.69, 0.3)])
def test_draws_follow_the_density(kernel: Kernel) -> None:
    """Importance sampling: uniform poses weighted by the density have the moments of the draws."""
    rng = np.random.default_rng(4)
    rows = KernelRows(Rows.of(se3.Poses.of(np.zeros((1, 3)), se3.random_quaternions(1, rng))), kernel)
    p, q = rows.sample(40_000, rng)
    if isinstance(kernel, IsotropicKernel):
        spread = np.full(3, kernel.sigma_position_m)
    else:
        spread = np.sqrt(np.diag(kernel.covariances[0]))[:3]
    wide_p = rng.standard_normal((200_000, 3)) * 1.3 * spread.max()
    wide_q = se3.random_quaternions(200_000, rng)
    log_proposal = -0.5 * np.sum((wide_p / (1.3 * spread.max())) ** 2, axis=1)
    log_proposal -= 1.5 * math.log(2.0 * math.pi) + 3.0 * math.log(1.3 * spread.max())
    log_proposal -= math.log(8.0 * math.pi**2)
    ratio = np.exp(rows.log_density(se3.Poses.of(wide_p, wide_q)) - log_proposal)
    # The density integrates to one over positions and rotations.
    assert ratio.mean() == pytest.approx(1.0, abs=6.0 * ratio.std() / math.sqrt(len(ratio)))
    for axis in range(3):
        square = wide_p[:, axis] ** 2
        expected = np.average(square, weights=ratio)
        error = math.sqrt(np.sum((ratio * (square - expected)) ** 2)) / ratio.sum()
        assert np.mean(p[:, axis] ** 2) == pytest.approx(expected, abs=5.0 * error + 0.02 * expected)
    turn = np.abs(np.sum(q * rows.poses.quaternions_xyzw[0], axis=1))
    other = np.abs(np.sum(wide_q * rows.poses.quaternions_xyzw[0], axis=1))
    expected = np.average(other, weights=ratio)
    error = math.sqrt(np.sum((ratio * (other - expected)) ** 2)) / ratio.sum()
    assert turn.mean() == pytest.approx(expected, abs=5.0 * error)


def test_rows_and_their_frames_are_checked(shell: Shell) -> None:
    p, q = shell(10, np.random.default_rng(0))
    with pytest.raises(ValueError, match="orthonormal"):
        KernelRows(Rows.of(se3.Poses.of(p, q)), _gaussian(*[0.1] * 6, frame="fixed"), frames=2.0 * np.eye(3))
    with pytest.raises(ValueError, match="at least one"):
        KernelRows(Rows.of(se3.Poses.of(p[:0], q[:0])), KERNEL)


# -- similarity


def _exact_similarity(rows: KernelRows, counts: Floats, points: int, rng: np.random.Generator) -> float:
    """BC(m, d_b) with densities from the float64 reference, no truncation."""
    assert isinstance(rows.kernel, IsotropicKernel)
    at = tuple(rows.sample(points, rng))
    own = tuple(rows.poses)
    whole = brute_force.log_density(rows.kernel, se3.Poses.of(*own), se3.Poses.of(*at), weights=rows.weights)
    chosen = counts > 0
    again = brute_force.log_density(
        rows.kernel,
        se3.Poses.of(own[0][chosen], own[1][chosen]),
        se3.Poses.of(*at),
        weights=(rows.weights * counts)[chosen],
    )
    return float(np.exp(0.5 * (again - whole)).mean())


def test_similarity_equals_the_reference(shell: Shell) -> None:
    rng = np.random.default_rng(5)
    p, q = shell(300, rng)
    rows = KernelRows(
        Rows.of(se3.Poses.of(p, q), weights=rng.uniform(0.2, 1.0, 300)), IsotropicKernel(0.03, 0.4)
    )
    got = cv.bootstrap_similarity(rows, rng, replicates=200, points=4_000)
    exact = [
        _exact_similarity(rows, np.bincount(rng.integers(300, size=300), minlength=300), 2_000, rng)
        for _ in range(12)
    ]
    error = np.std(exact, ddof=1) / math.sqrt(len(exact)) + got.std(ddof=1) / math.sqrt(200)
    assert got.shape == (200,)
    assert got.mean() == pytest.approx(np.mean(exact), abs=4.0 * error + 1e-3)


def test_far_apart_grasps_follow_the_multinomial() -> None:
    """Kernels that share nothing: BC_b = mean of sqrt(c_i), and E sqrt(Poisson(1)) is .773."""
    rng = np.random.default_rng(6)
    p = np.arange(4_000)[:, None] * np.array([1.0, 0.0, 0.0])
    rows = KernelRows(Rows.of(se3.Poses.of(p, se3.random_quaternions(4_000, rng))), KERNEL)
    k = np.arange(60)
    poisson = np.exp(-1.0 - np.cumsum(np.log(np.maximum(k, 1))))
    expected = float(np.sum(np.sqrt(k) * poisson))
    got = cv.bootstrap_similarity(rows, rng, replicates=60, points=8_000)
    assert got.mean() == pytest.approx(expected, abs=3e-3)


@pytest.mark.parametrize("points", [1_000, 4_000])
def test_the_deviation_is_that_of_replicates_not_of_points(shell: Shell, points: int) -> None:
    """Few points tell the mean and the spread of s that many tell."""
    rows = KernelRows(
        Rows.of(se3.Poses.of(*shell(200, np.random.default_rng(3)))), IsotropicKernel(0.03, 0.4)
    )
    few = cv.bootstrap_similarity(rows, np.random.default_rng(1), replicates=400, points=points)
    many = cv.bootstrap_similarity(rows, np.random.default_rng(2), replicates=400, points=60_000)
    assert few.std(ddof=1) == pytest.approx(many.std(ddof=1), rel=0.15)
    assert few.mean() == pytest.approx(many.mean(), abs=3e-3)


def test_one_place_has_converged() -> None:
    rows = KernelRows(Rows.of(se3.Poses.of(np.zeros((50, 3)), np.tile(se3.IDENTITY, (50, 1)))), KERNEL)
    got = cv.bootstrap_similarity(rows, np.random.default_rng(0), points=200)
    assert got.mean() == pytest.approx(1.0, abs=1e-6)
    assert got.std(ddof=1) < 1e-6


@given(st.integers(0, 1_000), st.floats(0.005, 0.05), st.booleans())
@settings(max_examples=15, deadline=None)
def test_similarity_is_a_share_and_does_not_know_units_of_weight(
    seed: int, sigma: float, twins: bool
) -> None:
    rng = np.random.default_rng(seed)
    p, q = rng.uniform(-0.1, 0.1, (60, 3)), se3.random_quaternions(60, rng)
    w = rng.uniform(0.1, 1.0, 60)
    values = []
    for scale in (1.0, 1e6):
        rows = KernelRows(
            Rows.of(se3.Poses.of(p, q), weights=w * scale, symmetric=twins), IsotropicKernel(sigma, 0.3)
        )
        values.append(cv.bootstrap_similarity(rows, np.random.default_rng(seed), points=300, replicates=8))
    assert np.all(values[0] <= 1.0 + 1e-6)
    assert np.all(values[0] > 0.0)
    np.testing.assert_allclose(values[0], values[1], rtol=1e-4)


def test_threads_change_nothing_and_progress_can_cancel(shell: Shell) -> None:
    rng = np.random.default_rng(7)
    rows = KernelRows(Rows.of(se3.Poses.of(*shell(3_000, rng))), KERNEL)
    one = cv.bootstrap_similarity(rows, np.random.default_rng(1), points=2_000, replicates=10)
    two = cv.bootstrap_similarity(rows, np.random.default_rng(1), points=2_000, replicates=10, threads=2)
    np.testing.assert_array_equal(one, two)

    class StopError(Exception):
        pass

    seen: list[float] = []

    def progress(share: float) -> None:
        seen.append(share)
        if share > 0.4:
            raise StopError

    with pytest.raises(StopError):
        cv.bootstrap_similarity(rows, rng, points=2_000, replicates=10, progress=progress)
    assert seen == sorted(seen)
    assert seen[-1] < 1.0


# -- curves


@pytest.fixture(scope="module")
def curve(shell: Shell) -> cv.ConvergenceCurve:
    p, q = shell(1_600, np.random.default_rng(8))
    return IncrementalCurve.of(
        Rows.of(Poses.of(p, q)), IsotropicKernel(0.025, 0.4), points=3_000, replicates=20, seed=3
    ).curve


def test_curve_rises_and_shows_its_parts(curve: cv.ConvergenceCurve) -> None:
    assert [point.grasps for point in curve.points] == [25, 50, 100, 200, 400, 800, 1_600]
    s = np.array([point.similarity for point in curve.points])
    assert np.all(np.diff(s) > 0.0)
    assert all(point.replicates.shape == (5, 20) for point in curve.points)
    assert curve.held_out == 160
    likelihood = [point.log_likelihood for point in curve.points]
    assert likelihood[-1] > likelihood[0]
    assert all(0.0 < point.log_likelihood_error < 5.0 for point in curve.points)


def test_wider_kernels_converge_sooner_and_are_less_likely(shell: Shell, curve: cv.ConvergenceCurve) -> None:
    p, q = shell(1_600, np.random.default_rng(8))
    wide = IncrementalCurve.of(
        Rows.of(Poses.of(p, q)), IsotropicKernel(0.05, 0.8), points=3_000, replicates=20, seed=3
    ).curve
    assert all(w.similarity > n.similarity for w, n in zip(wide.points, curve.points, strict=True))
    assert wide.points[-1].log_likelihood < curve.points[-1].log_likelihood
    value, low, high = cv.needed_ratio(wide, curve, target=0.9)
    assert low <= value <= high < 0.6


def test_curve_is_the_same_for_a_seed(shell: Shell) -> None:
    p, q = shell(200, np.random.default_rng(9))
    one, two, other = (
        IncrementalCurve.of(Rows.of(Poses.of(p, q)), KERNEL, points=200, replicates=5, seed=seed).curve
        for seed in (1, 1, 2)
    )
    assert [a.similarity for a in one.points] == [a.similarity for a in two.points]
    assert [a.log_likelihood for a in one.points] == [a.log_likelihood for a in two.points]
    assert [a.similarity for a in one.points] != [a.similarity for a in other.points]


def test_too_few_grasps_say_how_many_are_needed(shell: Shell) -> None:
    p, q = shell(37, np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"at least 200 .* there are 37, so 163 more"):
        IncrementalCurve.of(Rows.of(Poses.of(p, q)), KERNEL)
    with pytest.raises(ValueError, match="at least 200"):
        IncrementalCurve.of(Rows.of(Poses.of(p[:0], q[:0])), KERNEL)
    p, q = shell(200, np.random.default_rng(0))
    with pytest.raises(ValueError, match="2 replicates and 2 points"):
        IncrementalCurve.of(Rows.of(Poses.of(p, q)), KERNEL, replicates=1)
    with pytest.raises(ValueError, match="5 subsets"):
        IncrementalCurve.of(Rows.of(Poses.of(p, q)), KERNEL, subsets=4)


def _synthetic(exponent: float, scale: float, noise: float, seed: int = 0) -> cv.ConvergenceCurve:
    rng = np.random.default_rng(seed)
    points = []
    for n in (100, 200, 400, 800):
        values = 1.0 - scale * n**-exponent + noise * rng.standard_normal((5, 50))
        points.append(cv.CurvePoint(n, float(values.mean()), noise, values, 0.0, 1.0))
    return cv.ConvergenceCurve(tuple(points), 10)


@given(st.floats(0.3, 1.0), st.floats(1.0, 6.0))
@settings(max_examples=40, deadline=None)
def test_a_power_law_is_extrapolated_exactly(exponent: float, scale: float) -> None:
    curve = _synthetic(exponent, min(scale, 0.9 * 100.0**exponent), 0.0)
    scale = min(scale, 0.9 * 100.0**exponent)
    truth = (scale / 0.05) ** (1.0 / exponent)
    needed = cv.grasps_needed(curve)
    if truth > 100.0:
        expected = truth if truth < 800.0 * 1_000.0 else math.inf
        assert needed.grasps == pytest.approx(expected, rel=1e-6)
        assert needed.extrapolated == (truth > 800.0)
    assert cv.verdict(curve).exponent == pytest.approx(exponent, abs=1e-6)


def test_the_interval_of_what_is_needed_covers_the_truth() -> None:
    truth = (2.0 / 0.05) ** (1.0 / 0.5)
    hits = 0
    for seed in range(40):
        needed = cv.grasps_needed(_synthetic(0.5, 2.0, 0.01, seed), seed=seed)
        assert needed.low <= needed.grasps <= needed.high
        hits += needed.low <= truth <= needed.high
    assert hits >= 30


def test_verdicts() -> None:
    enough = cv.verdict(_synthetic(0.5, 0.8, 1e-4))
    assert enough.state == "enough"
    assert enough.more == (0.0, 0.0, 0.0)
    more = cv.verdict(_synthetic(0.5, 2.5, 1e-4))
    assert more.state == "more"
    assert more.more[1] == pytest.approx(2_500 - 800, rel=0.02)
    flat = cv.verdict(_synthetic(0.0, 0.3, 1e-4))
    assert flat.state == "more"
    assert flat.needed.grasps > 100_000
    assert flat.more[2] == math.inf
    borderline = cv.verdict(_synthetic(0.5, 0.05 * 800**0.5, 0.02))
    assert borderline.state == "borderline"


# -- matching


def test_determinants_of_the_blocks_are_matched() -> None:
    kernel = _random_mixture(np.random.default_rng(0))
    cov = kernel.overall_covariance
    match = matching.match_determinants(kernel)
    assert match.reached
    assert match.kernel.sigma_position_m**6 == pytest.approx(np.linalg.det(cov[:3, :3]))
    assert match.kernel.sigma_rotation**6 == pytest.approx(np.linalg.det(cov[3:, 3:]))
    again = matching.match_determinants(KERNEL)
    assert again.kernel.sigma_position_m == pytest.approx(KERNEL.sigma_position_m)


def test_overall_covariance_is_that_of_draws() -> None:
    rng = np.random.default_rng(1)
    kernel = _random_mixture(rng)
    which = rng.choice(4, 200_000, p=kernel.weights)
    draws = kernel.means[which] + np.einsum(
        "nij,nj->ni", np.linalg.cholesky(kernel.covariances)[which], rng.standard_normal((200_000, 6))
    )
    got, expected = kernel.overall_covariance, np.cov(draws.T)
    scale = np.sqrt(np.outer(np.diag(got), np.diag(got)))
    assert np.max(np.abs(got - expected) / scale) < 0.02


@given(st.floats(-2.0, 1.9))
@settings(max_examples=40, deadline=None)
def test_likelihood_match_takes_the_wider_of_two(target: float) -> None:
    def likelihood(kernel: IsotropicKernel) -> float:
        x = math.log(kernel.sigma_position_m / KERNEL.sigma_position_m)
        return 2.0 - 5.0 * x * x

    match = matching.match_likelihood(target, KERNEL, likelihood)
    assert match.reached
    assert match.achieved == pytest.approx(target, abs=0.011)
    assert likelihood(match.kernel) == pytest.approx(match.achieved)
    assert match.kernel.sigma_position_m >= KERNEL.sigma_position_m * 0.95


def test_unreachable_likelihood_gives_the_best_there_is() -> None:
    match = matching.match_likelihood(9.0, KERNEL, lambda k: -((k.sigma_position_m - 0.015) ** 2))
    assert not match.reached
    assert match.kernel.sigma_position_m == pytest.approx(0.015, rel=0.01)


def test_success_is_matched_by_measured_rates() -> None:
    def rate(kernel: IsotropicKernel) -> float:
        return float(math.exp(-kernel.sigma_position_m / 0.02))

    factors = np.geomspace(0.5, 2.0, 9)
    rates = [rate(matching.scaled(KERNEL, float(f))) for f in factors]
    even = np.ones(9)
    match = matching.match_success(0.4, KERNEL, rates, factors=factors, draws=even)
    assert match.reached
    assert rate(match.kernel) == pytest.approx(0.4, abs=0.01)
    none = matching.match_success(0.9, KERNEL, rates, factors=factors, draws=even)
    assert not none.reached
    assert none.achieved == pytest.approx(max(rates))
    with pytest.raises(ValueError, match="rates"):
        matching.match_success(0.4, KERNEL, [1.2, 0.3], factors=[1.0, 2.0], draws=[1, 1])


def test_noisy_rates_are_made_monotone() -> None:
    match = matching.match_success(
        0.25, KERNEL, [0.3, 0.2, 0.3, 0.1], factors=[0.5, 1.0, 1.5, 2.0], draws=[10, 100, 100, 10]
    )
    assert match.reached
    assert match.achieved == pytest.approx(0.25)


def test_few_draws_tell_less_of_the_width_that_matches() -> None:
    def rate(kernel: IsotropicKernel) -> float:
        return float(math.exp(-kernel.sigma_position_m / 0.02))

    factors = np.geomspace(0.4, 1.6, 7)
    rates = [rate(matching.scaled(KERNEL, f)) for f in factors]
    match = matching.match_success(0.4, KERNEL, rates, factors=factors, draws=np.ones(7))
    right = match.kernel.sigma_position_m
    rng = np.random.default_rng(0)
    spans, inside = [], 0
    for draws in (200, 5_000):
        for _ in range(30):
            found = [rng.binomial(draws, r) / draws for r in rates]
            target = rng.binomial(draws, 0.4) / draws
            low, high = matching.success_ends(
                target, KERNEL, found, factors=list(factors), draws=[draws] * 7, target_draws=draws
            )
            inside += low.sigma_position_m <= right <= high.sigma_position_m
            spans.append(high.sigma_position_m - low.sigma_position_m)
    # 54 of 60 are expected.
    assert inside >= 46
    assert np.median(spans[30:]) < 0.4 * np.median(spans[:30])


def test_a_ratio_knows_how_well_the_reference_is_known(shell: Shell) -> None:
    p, q = shell(400, np.random.default_rng(3))
    narrow, curve, wide = (
        IncrementalCurve.of(
            Rows.of(Poses.of(p, q)), matching.scaled(KERNEL, factor), points=2_000, replicates=20
        ).curve
        for factor in (0.8, 1.0, 1.25)
    )
    value, low, high = cv.needed_ratio(curve, curve, target=0.9)
    same = cv.needed_ratio(curve, curve, ends=(curve, curve), target=0.9)
    assert same == pytest.approx((value, low, high))
    widened = cv.needed_ratio(curve, curve, ends=(narrow, wide), target=0.9)
    assert widened[0] == value
    # A wider reference needs fewer, so that the other would need more of them, and the reverse.
    assert widened[1] < min(low, cv.needed_ratio(curve, narrow, target=0.9)[0] * 1.01)
    assert widened[2] > max(high, cv.needed_ratio(curve, wide, target=0.9)[0] * 0.99)


@pytest.mark.parametrize("framed", [False, True])
def test_a_curve_under_an_anisotropic_kernel(shell: Shell, framed: bool) -> None:
    """A Gaussian of the isotropic kernel's widths gives its curve, whatever the frames."""
    rng = np.random.default_rng(10)
    p, q = shell(400, rng)
    frames = se3.to_matrix(se3.random_quaternions(400, rng)) if framed else None
    kernel = IsotropicKernel(0.03, math.radians(12.0))
    gaussian = _gaussian(*[0.03] * 3, *[math.radians(12.0)] * 3, frame="fixed" if framed else "gripper")
    one = IncrementalCurve.of(Rows.of(Poses.of(p, q)), kernel, points=2_000, replicates=20).curve
    two = IncrementalCurve.of(
        Rows.of(Poses.of(p, q)), gaussian, frames=frames, points=2_000, replicates=20
    ).curve
    for a, b in zip(one.points, two.points, strict=True):
        assert a.similarity == pytest.approx(b.similarity, abs=0.03)
        assert a.log_likelihood == pytest.approx(b.log_likelihood, abs=0.3)
