"""The Bhattacharyya coefficient against closed forms, and the sampled kernel's curve."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspdb_density import GraspDensity, IsotropicKernel, se3
from graspdb_density.kde import bhattacharyya as sm
from graspdb_density.kde.weighted_sums import KernelRows
from graspdb_density.se3 import Poses

TURN = math.radians(20.0)


def _one(x: float, sigma: float = 0.02) -> GraspDensity:
    kernel = IsotropicKernel(sigma, TURN)
    return GraspDensity.build(Poses.of([[x, 0.0, 0.0]], [se3.IDENTITY]), kernel=kernel, symmetric=False)


@given(st.floats(0.0, 4.0), st.floats(0.4, 2.5))
@settings(max_examples=25, deadline=None)
def test_gaussians_in_closed_form(distance: float, ratio: float) -> None:
    """exp(-d^2 / (4 (s1^2 + s2^2))) (2 s1 s2 / (s1^2 + s2^2))^(3/2), the rotation parts being equal."""
    s1, s2 = 0.02, 0.02 * ratio
    gap = distance * s1
    total = s1 * s1 + s2 * s2
    expected = math.exp(-gap * gap / (4.0 * total)) * (2.0 * s1 * s2 / total) ** 1.5
    got = sm.bhattacharyya(_one(0.0, s1), _one(gap, s2), np.random.default_rng(1), points=6_000)
    assert got.value == pytest.approx(expected, abs=5.0 * got.standard_error + 2e-3)
    assert got.standard_error < 0.01


def test_equal_densities_have_one_and_distant_ones_nothing() -> None:
    rng = np.random.default_rng(0)
    same = sm.bhattacharyya(_one(0.0), _one(0.0), rng, points=500)
    assert same.value == pytest.approx(1.0, abs=1e-9)
    assert same.standard_error < 1e-9
    assert sm.bhattacharyya(_one(0.0), _one(5.0), rng, points=500).value < 1e-12


def test_it_is_symmetric() -> None:
    one = sm.bhattacharyya(_one(0.0, 0.02), _one(0.03, 0.03), np.random.default_rng(1))
    two = sm.bhattacharyya(_one(0.03, 0.03), _one(0.0, 0.02), np.random.default_rng(2))
    assert one.value == pytest.approx(two.value, abs=4.0 * math.hypot(one.standard_error, two.standard_error))


def test_the_standard_error_is_that_of_repetitions() -> None:
    window = sm.DisplacementWindow(0.04)
    for inside in (None, window):
        found = [
            sm.bhattacharyya(
                _one(0.0, 0.03), _one(0.03, 0.02), np.random.default_rng(seed), points=400, window=inside
            )
            for seed in range(150)
        ]
        spread = np.std([f.value for f in found], ddof=1)
        assert np.mean([f.standard_error for f in found]) == pytest.approx(spread, rel=0.25)


def test_a_window_restricts_and_normalises_both() -> None:
    """One-dimensional truth: the other axes and rotations are the same in both and cancel."""
    half = 0.03
    x = np.linspace(-half, half, 20_001)

    def inside(at: float) -> np.ndarray:
        value = np.exp(-0.5 * ((x - at) / 0.02) ** 2)
        return np.asarray(value / np.trapezoid(value, x))

    expected = np.trapezoid(np.sqrt(inside(0.0) * inside(0.03)), x)
    got = sm.bhattacharyya(
        _one(0.0),
        _one(0.03),
        np.random.default_rng(3),
        points=40_000,
        window=sm.DisplacementWindow(half),
    )
    assert got.value == pytest.approx(expected, abs=4.0 * got.standard_error)
    with pytest.raises(ValueError, match="no draw inside"):
        sm.bhattacharyya(_one(3.0), _one(0.0), np.random.default_rng(0), window=sm.DisplacementWindow(half))
    with pytest.raises(ValueError, match="window"):
        sm.DisplacementWindow(-1.0)


def test_mirrored_displacements_are_those_of_the_turned_jaw() -> None:
    rng = np.random.default_rng(4)
    base_p, base_q = rng.standard_normal((20, 3)), se3.random_quaternions(20, rng)
    t, r = rng.standard_normal((20, 3)), se3.random_quaternions(20, rng)
    moved_p, moved_q = se3.compose(Poses(base_p, base_q), Poses(t, r))
    mt, mr = sm.mirrored_displacements(Poses.of(t, r))
    other_p, other_q = se3.compose(Poses(base_p, se3.jaw_twin(base_q)), Poses(mt, mr))
    np.testing.assert_allclose(other_p, moved_p, atol=1e-12)
    assert np.max(se3.angle_between(other_q, se3.jaw_twin(moved_q))) < 1e-6


def test_sampled_kernel_curve_rises_towards_one() -> None:
    rng = np.random.default_rng(5)
    t = rng.standard_normal((6_000, 3)) * [0.02, 0.006, 0.02]
    r = se3.from_rotation_vector(rng.standard_normal((6_000, 3)) * [0.2, 0.6, 0.2])
    curve = sm.sampled_kernel_curve(
        Poses.of(t, r),
        components=IsotropicKernel(0.01, math.radians(10.0)),
        window=sm.DisplacementWindow(),
        rng=rng,
        counts=(30, 300, 3_000, 100_000),
        points=2_000,
    )
    assert list(curve) == [30, 300, 3_000]
    values = [point.value for point in curve.values()]
    assert values == sorted(values)
    assert values[-1] > 0.97
    with pytest.raises(ValueError, match="at least 100 are needed"):
        sm.sampled_kernel_curve(
            Poses.of(t + 1.0, r),
            components=IsotropicKernel(0.01, 0.2),
            window=sm.DisplacementWindow(),
            rng=rng,
        )


def test_sampled_kernel_is_mirror_symmetric() -> None:
    rng = np.random.default_rng(6)
    t, r = rng.standard_normal((50, 3)) * 0.02, se3.from_rotation_vector(rng.standard_normal((50, 3)) * 0.4)
    kernel = sm.sampled_kernel_rows(Poses.of(t, r), IsotropicKernel(0.01, 0.2))
    assert isinstance(kernel, KernelRows)
    assert kernel.size == 100
    at_t, at_r = rng.standard_normal((30, 3)) * 0.02, se3.random_quaternions(30, rng)
    np.testing.assert_allclose(
        kernel.log_density(Poses.of(at_t, at_r)),
        kernel.log_density(Poses.of(*sm.mirrored_displacements(Poses.of(at_t, at_r)))),
        atol=1e-3,
    )


class Known:
    """A density that draws one pose and can't tell itself at some."""

    def __init__(self, values: list[float]) -> None:
        self._values = values

    def log_density(self, poses: se3.Poses, *, threads: int = 1) -> np.ndarray:
        return np.resize(np.array(self._values), len(poses))

    def sample(self, count: int, rng: np.random.Generator) -> se3.Poses:
        return se3.Poses(np.zeros((count, 3)), np.tile(se3.IDENTITY, (count, 1)))


def test_where_a_density_is_zero_nothing_is_shared_and_a_wrong_one_is_not_hidden() -> None:
    rng = np.random.default_rng(0)
    alike = sm.bhattacharyya(Known([1.0]), Known([1.0]), rng, points=400)
    assert alike.value == pytest.approx(1.0)
    half = sm.bhattacharyya(Known([1.0]), Known([1.0, -math.inf]), rng, points=400)
    assert half.value == pytest.approx(0.5)
    assert math.isfinite(half.standard_error)
    assert math.isnan(sm.bhattacharyya(Known([1.0]), Known([1.0, math.nan]), rng, points=400).value)
