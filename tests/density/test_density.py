"""The fast path against the float64 reference, normalisation, symmetries, samples, extension."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import brute_force
from graspdb_density import HAAR_VOLUME, GraspDensity, IsotropicKernel, se3
from graspdb_density.search.start_ranking import centre_sums

Poses = tuple[se3.Floats, se3.Floats]
Shell = Callable[[int, np.random.Generator], Poses]
Moved = Callable[[Poses, int, float, float, np.random.Generator], Poses]

KERNELS = [
    IsotropicKernel(0.015, math.radians(15.0)),
    IsotropicKernel(0.015, math.radians(20.0)),
    IsotropicKernel(0.03, math.radians(30.0)),
    IsotropicKernel(0.008, math.radians(60.0)),
]


def mixed(rng: np.random.Generator, rows: Poses) -> dict[str, Any]:
    """Uneven weights, some jaws not symmetric."""
    return {"weights": rng.uniform(0.1, 3.0, len(rows[0])), "symmetric": rng.random(len(rows[0])) < 0.7}


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
@pytest.mark.parametrize("plain", [True, False])
def test_fast_path_equals_the_reference(
    kernel: IsotropicKernel, plain: bool, shell: Shell, moved: Moved
) -> None:
    rng = np.random.default_rng(0)
    rows = shell(6_000, rng)
    extra = {} if plain else mixed(rng, rows)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel, **extra)
    poses = moved(rows, 200, kernel.sigma_position_m, kernel.sigma_rotation, rng)
    expected = brute_force.log_density(kernel, se3.Poses.of(*rows), se3.Poses.of(*poses), **extra)
    exact = density.log_density(se3.Poses.of(*poses), cutoff=None)
    np.testing.assert_allclose(exact, expected, atol=2e-5)
    error = np.abs(np.expm1(density.log_density(se3.Poses.of(*poses)) - expected))
    assert error.max() < 1e-3
    assert np.median(error) < 4e-4
    finer = np.abs(np.expm1(density.log_density(se3.Poses.of(*poses), cutoff=5.0) - expected))
    assert np.median(finer) < 3e-5


@pytest.mark.parametrize("width_deg", [4.0, 10.5, 15.4, 24.9, 35.0])
def test_without_a_cut_off_every_term_counts(width_deg: float, shell: Shell, moved: Moved) -> None:
    """Brute force in float32 where that is fine, whatever is near: twins, antipodes, or nothing."""
    rng = np.random.default_rng(30)
    kernel = IsotropicKernel(0.015, math.radians(width_deg))
    rows = shell(2_500, rng)
    extra = mixed(rng, rows)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel, **extra)
    p, q = moved(rows, 150, 0.04, 1.0, rng)
    p[:20] += 0.5
    expected = brute_force.log_density(kernel, se3.Poses.of(*rows), se3.Poses.of(p, q), **extra)
    got = density.log_density(se3.Poses.of(p, q), cutoff=None, threads=2)
    assert (np.abs(got - expected) < 2e-5 + 1e-6 * (kernel.log_peak - expected)).all()
    np.testing.assert_array_equal(density.log_density(se3.Poses.of(p[:1], q[:1]), cutoff=None), got[:1])


@pytest.mark.parametrize("kernel", KERNELS[:3], ids=str)
def test_log_density_is_right_far_from_data(kernel: IsotropicKernel, shell: Shell) -> None:
    rng = np.random.default_rng(1)
    rows = shell(3_000, rng)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel)
    far = rng.uniform(-3.0, 3.0, (100, 3))
    turns = se3.random_quaternions(100, rng)
    expected = brute_force.log_density(kernel, se3.Poses.of(*rows), se3.Poses.of(far, turns))
    got = density.log_density(se3.Poses.of(far, turns))
    assert np.isfinite(got).all()
    assert (expected < -1_000.0).any()
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=2e-5)


def test_sparse_and_odd_data(moved: Moved) -> None:
    """One row, coincident rows, and outliers far outside the rest."""
    rng = np.random.default_rng(2)
    kernel = KERNELS[0]
    one = np.array([[0.1, 0.2, 0.3]]), se3.random_quaternions(1, rng)
    twice = np.repeat(one[0], 500, axis=0), np.repeat(one[1], 500, axis=0)
    cloud = rng.normal(size=(4_000, 3)) * 0.02, se3.random_quaternions(4_000, rng)
    cloud[0][:5] = [[40.0, 0, 0], [0, -70.0, 0], [0, 0, 90.0], [30.0, 30.0, 30.0], [40.0, 0.01, 0.0]]
    for rows in (one, twice, cloud):
        density = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel)
        near = moved(rows, 50, 0.01, 0.1, rng)
        poses = np.concatenate([near[0], rows[0][:5]]), np.concatenate([near[1], rows[1][:5]])
        expected = brute_force.log_density(kernel, se3.Poses.of(*rows), se3.Poses.of(*poses))
        np.testing.assert_allclose(density.log_density(se3.Poses.of(*poses)), expected, atol=4e-3)
        np.testing.assert_allclose(
            density.log_density(se3.Poses.of(*poses), cutoff=None), expected, atol=4e-3
        )


@pytest.mark.parametrize("kernel", [KERNELS[1], KERNELS[2]], ids=str)
@pytest.mark.parametrize("flags", [True, False])
def test_integrates_to_one(kernel: IsotropicKernel, flags: bool, shell: Shell) -> None:
    """Importance sampling from a density twice as wide, which covers this one."""
    rng = np.random.default_rng(3)
    rows = shell(300, rng)
    weights = rng.uniform(0.2, 2.0, 300)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel, weights=weights, symmetric=flags)
    wider = GraspDensity.build(
        se3.Poses.of(*rows),
        kernel=kernel.widened(kernel.sigma_position_m, kernel.sigma_rotation),
        symmetric=flags,
    )
    poses = wider.sample(30_000, rng)
    ratio = np.exp(density.log_density(se3.Poses.of(*poses)) - wider.log_density(se3.Poses.of(*poses)))
    assert abs(ratio.mean() - 1.0) < 5.0 * ratio.std() / math.sqrt(len(ratio))
    assert ratio.std() / math.sqrt(len(ratio)) < 0.02


def test_uniform_rows_give_the_uniform_density() -> None:
    """An absolute check of the measure: rows uniform in a cube and over all rotations."""
    rng = np.random.default_rng(4)
    side, margin = 0.3, 0.08
    rows = rng.uniform(0.0, side, (60_000, 3)), se3.random_quaternions(60_000, rng)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=IsotropicKernel(0.02, math.radians(25.0)))
    inner = rng.uniform(margin, side - margin, (2_000, 3)), se3.random_quaternions(2_000, rng)
    values = density.density(se3.Poses.of(*inner)) * side**3 * HAAR_VOLUME
    assert values.mean() == pytest.approx(1.0, abs=0.02)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), width_deg=st.sampled_from([15.0, 20.0, 35.0]))
def test_invariances(seed: int, width_deg: float, shell: Shell, moved: Moved) -> None:
    rng = np.random.default_rng(seed)
    kernel = IsotropicKernel(0.015, math.radians(width_deg))
    rows = shell(400, rng)
    weights = rng.uniform(0.1, 2.0, 400)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel, weights=weights)
    p, q = moved(rows, 40, 0.01, 0.1, rng)
    value = density.log_density(se3.Poses.of(p, q))
    np.testing.assert_allclose(density.log_density(se3.Poses.of(p, -q)), value, atol=1e-5)
    np.testing.assert_allclose(density.log_density(se3.Poses.of(p, se3.jaw_twin(q))), value, atol=1e-5)
    signs = np.where(rng.random(400) < 0.5, -1.0, 1.0)[:, None]
    turned = np.where(rng.random(400)[:, None] < 0.5, se3.jaw_twin(rows[1]), rows[1])
    again = GraspDensity.build(se3.Poses.of(rows[0], signs * turned), kernel=kernel, weights=7.0 * weights)
    np.testing.assert_allclose(again.log_density(se3.Poses.of(p, q)), value, atol=1e-3)
    frame = rng.normal(size=3), se3.random_quaternions(1, rng)[0]
    elsewhere = GraspDensity.build(
        se3.Poses(*se3.compose(se3.Poses(*frame), se3.Poses(*rows))), kernel=kernel, weights=weights
    )
    np.testing.assert_allclose(
        elsewhere.log_density(se3.Poses(*se3.compose(se3.Poses(*frame), se3.Poses(p, q)))), value, atol=2e-3
    )


def test_a_row_without_symmetry_has_no_twin() -> None:
    kernel = KERNELS[0]
    p, q = np.zeros((1, 3)), se3.IDENTITY[None]
    alone = GraspDensity.build(se3.Poses.of(p, q), kernel=kernel, symmetric=False)
    both = GraspDensity.build(se3.Poses.of(p, q), kernel=kernel, symmetric=[True])
    twin = se3.jaw_twin(q)
    assert float(both.log_density(se3.Poses.of(p, q))[0]) == pytest.approx(
        float(both.log_density(se3.Poses.of(p, twin))[0]), abs=1e-6
    )
    assert float(
        alone.log_density(se3.Poses.of(p, q))[0] - both.log_density(se3.Poses.of(p, q))[0]
    ) == pytest.approx(math.log(2.0), abs=1e-6)
    # Half a turn away nothing is left of the kernel: two antipodal tails of cosine 0.
    assert float(
        alone.log_density(se3.Poses.of(p, twin))[0] - alone.log_density(se3.Poses.of(p, q))[0]
    ) == pytest.approx(math.log(2.0) - kernel.kappa, abs=1e-5)


@pytest.mark.parametrize("degrees", [5.0, 10.0, 20.0, 45.0])
@pytest.mark.parametrize("distance", [0.0, 0.1, 1.0])
def test_rows_without_a_twin_are_told_from_far_away_and_half_a_turn(degrees: float, distance: float) -> None:
    """What the twin would have is far above what there is: no overflow of it may get into the sum."""
    kernel = IsotropicKernel(0.01, math.radians(degrees))
    rng = np.random.default_rng(0)
    p, q = 0.01 * rng.standard_normal((200, 3)), np.tile(se3.IDENTITY, (200, 1))
    q = se3.multiply(q, se3.from_rotation_vector(0.1 * rng.standard_normal((200, 3))))
    density = GraspDensity.build(se3.Poses.of(p, q), kernel=kernel, symmetric=False)
    poses = p[:40] + np.array([distance, 0.0, 0.0]), se3.jaw_twin(q[40:80])
    expected = brute_force.log_density(kernel, se3.Poses.of(p, q), se3.Poses.of(*poses), symmetric=False)
    for cutoff in (4.0, None):
        np.testing.assert_allclose(
            density.log_density(se3.Poses.of(*poses), cutoff=cutoff), expected, rtol=2e-6, atol=5e-3
        )


def test_samples_follow_the_density(shell: Shell) -> None:
    """Mean inverse density ratio of samples to a wider density is 1, and moments are those of the mixture."""
    rng = np.random.default_rng(6)
    kernel = KERNELS[0]
    rows = shell(50, rng)
    weights = rng.uniform(0.1, 2.0, 50)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel, weights=weights)
    p, q = density.sample(40_000, rng)
    assert len(density.sample(0, rng)) == 0
    share = weights / weights.sum()
    mean = share @ rows[0]
    spread = share @ ((rows[0] - mean) ** 2) + kernel.sigma_position_m**2
    np.testing.assert_allclose(p.mean(axis=0), mean, atol=5.0 * np.sqrt(spread / len(p)).max())
    np.testing.assert_allclose(p.var(axis=0), spread, rtol=0.05)
    # E over samples of g/d is the mass of g where d reaches: 1 for any normalised g.
    narrower = GraspDensity.build(
        se3.Poses.of(*rows), kernel=IsotropicKernel(0.012, math.radians(12.0)), weights=weights
    )
    ratio = np.exp(narrower.log_density(se3.Poses.of(p, q)) - density.log_density(se3.Poses.of(p, q)))
    assert abs(ratio.mean() - 1.0) < 5.0 * ratio.std() / math.sqrt(len(ratio))
    twins = (
        np.sum(se3.angle_between(q, rows[1][0]) < math.radians(60.0)),
        np.sum(se3.angle_between(q, se3.jaw_twin(rows[1][0])) < math.radians(60.0)),
    )
    assert min(twins) > 0.8 * max(twins)


@pytest.mark.parametrize("parts", [1, 7])
def test_extending_equals_rebuilding(parts: int, shell: Shell, moved: Moved) -> None:
    rng = np.random.default_rng(7)
    kernel = KERNELS[0]
    rows = shell(9_000, rng)
    extra = mixed(rng, rows)
    first = 3_000
    density = GraspDensity.build(
        se3.Poses.of(rows[0][:first], rows[1][:first]),
        kernel=kernel,
        weights=extra["weights"][:first],
        symmetric=extra["symmetric"][:first],
    )
    known = centre_sums(density, None, 1)
    before = density.log_density(se3.Poses.of(rows[0][:50], rows[1][:50]))
    grown = density
    for chunk in np.array_split(np.arange(first, 9_000), parts):
        grown = grown.extend(
            se3.Poses.of(rows[0][chunk], rows[1][chunk]), extra["weights"][chunk], extra["symmetric"][chunk]
        )
    rebuilt = GraspDensity.build(se3.Poses.of(*rows), kernel=kernel, **extra)
    poses = moved(rows, 500, 0.015, 0.2, rng)
    assert grown.size == rebuilt.size == 9_000
    for cutoff in (None, 4.0):
        np.testing.assert_allclose(
            grown.log_density(se3.Poses.of(*poses), cutoff=cutoff),
            rebuilt.log_density(se3.Poses.of(*poses), cutoff=cutoff),
            atol=1e-5,
        )
    np.testing.assert_array_equal(density.log_density(se3.Poses.of(rows[0][:50], rows[1][:50])), before)
    ratio = (
        centre_sums(grown, known, 1).values
        / centre_sums(rebuilt, None, 1).values
        * (grown._unit / rebuilt._unit)
    )
    np.testing.assert_allclose(ratio, 1.0, atol=1e-4)
    assert grown.effective_sample_size == pytest.approx(rebuilt.effective_sample_size)
    np.testing.assert_array_equal(grown.cells.rows[np.argsort(grown.cells.rows)], np.arange(9_000))


def test_rows_carried_over_keep_their_sums_up_to_date(shell: Shell) -> None:
    rng = np.random.default_rng(8)
    rows = shell(8_000, rng)
    old = GraspDensity.build(se3.Poses.of(rows[0][:7_500], rows[1][:7_500]), kernel=KERNELS[0])
    known = centre_sums(old, None, 1)
    grown = old.extend(se3.Poses.of(rows[0][7_500:], rows[1][7_500:]))
    fresh = GraspDensity.build(se3.Poses.of(*rows), kernel=KERNELS[0])
    # New rows are added to old ones within their own reach: other cells at the rim of 3 standard deviations.
    now, anew = centre_sums(grown, known, 1), centre_sums(fresh, None, 1)
    np.testing.assert_allclose(now.values, anew.values, rtol=0.05)


def test_threads_give_the_same_answer(shell: Shell, moved: Moved) -> None:
    rng = np.random.default_rng(9)
    rows = shell(3_000, rng)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=KERNELS[0])
    poses = moved(rows, 9_001, 0.02, 0.3, rng)
    np.testing.assert_array_equal(
        density.log_density(se3.Poses.of(*poses)), density.log_density(se3.Poses.of(*poses), threads=4)
    )


def test_memory_of_a_large_density(shell: Shell) -> None:
    rows = shell(160_000, np.random.default_rng(10))
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=KERNELS[0])
    assert density.nbytes < 150e6


def test_bad_input_is_refused() -> None:
    p, q, kernel = np.zeros((2, 3)), np.tile(se3.IDENTITY, (2, 1)), KERNELS[0]
    with pytest.raises(ValueError, match="at least one"):
        GraspDensity.build(se3.Poses.of(p[:0], q[:0]), kernel=kernel)
    with pytest.raises(ValueError, match="positive and finite"):
        GraspDensity.build(se3.Poses.of(p, q), kernel=kernel, weights=[1.0, 0.0])
    with pytest.raises(ValueError, match="weights have shape"):
        GraspDensity.build(se3.Poses.of(p, q), kernel=kernel, weights=[1.0])
    with pytest.raises(ValueError, match="symmetric"):
        GraspDensity.build(se3.Poses.of(p, q), kernel=kernel, symmetric=[True])
    density = GraspDensity.build(se3.Poses.of(p, q), kernel=kernel)
    with pytest.raises(ValueError, match="cutoff must be between"):
        density.log_density(se3.Poses.of(p, q), cutoff=0.5)
    with pytest.raises(ValueError, match="finite"):
        density.log_density(se3.Poses.of(np.full((1, 3), np.inf), q[:1]))
    assert density.extend(se3.Poses.of(p[:0], q[:0])) is density
