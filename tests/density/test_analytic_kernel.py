"""The analytic kernel (eq 7, 8): normalised, symmetric, drawn from, its slope, and where it is isotropic."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from analytic_kernel import AnalyticKernel
from graspdb_density import IsotropicKernel, se3
from graspdb_density.se3 import Poses

COVARIANCE = np.array([[1.0, 0.2, 0.0], [0.2, 4.0, 0.0], [0.0, 0.0, 2.0]]) * 1e-4
KERNEL = AnalyticKernel(COVARIANCE, np.array([0.2, 0.5, 0.3]), 0.6, 15.0)
ORIGIN = np.zeros(3)


def about(axis: int, angles: se3.Floats) -> se3.Floats:
    return se3.from_rotation_vector(angles[:, None] * np.eye(3)[axis])


@pytest.mark.parametrize("sigma_r", [3.0, 15.0])
def test_integrates_to_one(sigma_r: float) -> None:
    """Importance sampling from an isotropic kernel and uniform rotations, half each."""
    rng = np.random.default_rng(0)
    kernel = AnalyticKernel(COVARIANCE, KERNEL.widths, 0.6, sigma_r)
    count = 200_000
    cover = IsotropicKernel(0.025, math.radians(70.0))
    p, q = cover.sample_displacements(count, rng)
    ratio = np.exp(kernel.log_kernel(p, q) - cover.log_kernel(Poses(p, q), Poses(ORIGIN, se3.IDENTITY)))
    error = ratio.std() / math.sqrt(count)
    assert error < 0.02
    assert abs(ratio.mean() - 1.0) < 4.5 * error


def test_axes_and_no_second_lobe() -> None:
    turns = se3.from_rotation_vector(0.4 * np.eye(3))
    about_x, about_y, about_z = KERNEL.log_kernel(np.zeros((3, 3)), turns)
    assert about_y > about_z > about_x
    # Held where the weighted angle passes a quarter turn.
    values = KERNEL.log_kernel(ORIGIN, about(0, np.linspace(0.0, math.pi, 50)))
    assert (np.diff(values) <= 1e-12).all()


def test_the_jaws_turn_and_signs_change_nothing() -> None:
    rng = np.random.default_rng(1)
    t, q = KERNEL.sample_displacements(50, rng)
    value = KERNEL.log_kernel(t, q)
    np.testing.assert_allclose(KERNEL.log_kernel(t, -q), value, atol=1e-12)
    turned = KERNEL.log_kernel(t * [-1.0, -1.0, 1.0], q * [-1.0, -1.0, 1.0, 1.0])
    np.testing.assert_allclose(turned, value, atol=1e-12)
    skewed = AnalyticKernel(COVARIANCE + 1e-5 * (np.eye(3, k=2) + np.eye(3, k=-2)), KERNEL.widths, 0.6, 15.0)
    np.testing.assert_allclose(skewed.covariance, COVARIANCE, atol=1e-18)


def test_small_equal_widths_are_the_isotropic_kernel() -> None:
    """w beta is half the angle where widths are 1 and beta is: von Mises-Fisher."""
    rng = np.random.default_rng(2)
    plain = IsotropicKernel(0.01, math.radians(8.0))
    same = AnalyticKernel(1e-4 * np.eye(3), np.ones(3), 1.0, plain.kappa)
    t = rng.standard_normal((20, 3)) * 0.01
    near = se3.from_rotation_vector(rng.standard_normal((20, 3)) * 0.05)
    own = plain.log_kernel(Poses(t, near), Poses(ORIGIN, se3.IDENTITY))
    np.testing.assert_allclose(same.log_kernel(t, near), own, atol=0.02)
    np.testing.assert_allclose(same.kernel(t, near), np.exp(same.log_kernel(t, near)))


def test_gradient_against_finite_differences() -> None:
    rng = np.random.default_rng(3)
    t, q = KERNEL.sample_displacements(40, rng)
    along, around = KERNEL.gradient(t, q)
    for axis in range(3):
        move, step = np.eye(3)[axis] * 1e-7, np.eye(3)[axis] * 1e-6
        slope = (KERNEL.log_kernel(t + move, q) - KERNEL.log_kernel(t - move, q)) / 2e-7
        np.testing.assert_allclose(along[:, axis], slope, rtol=1e-4, atol=1e-3)
        ahead = KERNEL.log_kernel(t, se3.multiply(q, se3.from_rotation_vector(step)))
        behind = KERNEL.log_kernel(t, se3.multiply(q, se3.from_rotation_vector(-step)))
        np.testing.assert_allclose(around[:, axis], (ahead - behind) / 2e-6, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(KERNEL.gradient(ORIGIN, se3.IDENTITY), 0.0, atol=1e-12)
    # Held: nothing slopes.
    np.testing.assert_array_equal(KERNEL.gradient(ORIGIN, about(0, np.array([2.5])))[1], 0.0)


@pytest.mark.parametrize("sigma_r", [2.0, 15.0])
def test_draws_follow_the_kernel(sigma_r: float) -> None:
    """The mean over draws of any normalised density over the kernel is 1; translations spread as asked."""
    rng = np.random.default_rng(4)
    kernel = AnalyticKernel(COVARIANCE, KERNEL.widths, 0.6, sigma_r)
    t, q = kernel.sample_displacements(60_000, rng)
    assert kernel.sample_displacements(0, rng)[1].shape == (0, 4)
    np.testing.assert_allclose(np.cov(t.T), COVARIANCE, atol=0.03 * COVARIANCE.max())
    for widths in ([0.15, 0.35, 0.2], [0.2, 0.5, 0.3]):
        other = AnalyticKernel(0.8 * COVARIANCE, np.array(widths), 0.7, sigma_r)
        ratio = np.exp(other.log_kernel(t, q) - kernel.log_kernel(t, q))
        error = ratio.std() / math.sqrt(len(ratio))
        assert error < 0.02
        assert abs(ratio.mean() - 1.0) < 4.5 * error


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AnalyticKernel(COVARIANCE, np.array([1.0, 1.0, 0.0]), 1.0, 1.0), "widths"),
        (lambda: AnalyticKernel(COVARIANCE, np.ones(3), 0.0, 1.0), "beta and sigma_r"),
        (lambda: AnalyticKernel(COVARIANCE, np.ones(3), 1.0, math.nan), "beta and sigma_r"),
        (lambda: AnalyticKernel(np.eye(2), np.ones(3), 1.0, 1.0), "shape"),
        (lambda: AnalyticKernel(-np.eye(3), np.ones(3), 1.0, 1.0), "positive definite"),
    ],
)
def test_bad_values_are_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
