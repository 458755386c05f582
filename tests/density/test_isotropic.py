"""The isotropic kernel and its float64 reference against eq 2-4 evaluated independently."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import iv, ive

from graspdb_density import HAAR_VOLUME, IsotropicKernel, se3
from graspdb_density.kernels.isotropic import sample_von_mises_fisher
from graspdb_density.se3 import Poses

WIDTHS_DEG = [5.0, 15.0, 20.0, 30.0, 60.0]


@pytest.mark.parametrize("width_deg", WIDTHS_DEG)
def test_rotation_part_integrates_to_one_over_the_haar_measure(width_deg: float) -> None:
    kernel = IsotropicKernel(1.0, math.radians(width_deg))
    position_peak = -1.5 * math.log(2.0 * math.pi)

    def shell(angle: float) -> float:
        # Rotations by an angle in [a, a + da] have Haar volume 4 pi (2 sin(a/2))^2 da.
        q = np.array([0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0)])
        log = kernel.log_kernel(Poses(np.zeros(3), q), Poses(np.zeros(3), se3.IDENTITY)) - position_peak
        return float(np.exp(log)) * 4.0 * math.pi * (2.0 * math.sin(angle / 2.0)) ** 2

    total, _ = quad(shell, 0.0, math.pi, epsabs=1e-13, epsrel=1e-13, limit=200)
    assert total == pytest.approx(1.0, abs=1e-10)


@pytest.mark.parametrize("width_deg", [15.0, 30.0])
def test_formula(width_deg: float) -> None:
    kernel = IsotropicKernel(0.02, math.radians(width_deg))
    kappa = kernel.kappa
    assert kappa == pytest.approx({15.0: 58.4, 30.0: 14.6}[width_deg], abs=0.05)
    q = se3.from_rotation_vector([0.2, -0.3, 0.1])
    offset = np.array([0.01, -0.02, 0.03])
    c4 = kappa / (4.0 * math.pi**2 * iv(1, kappa))
    on_sphere = c4 / 2.0 * (math.exp(kappa * q[3]) + math.exp(-kappa * q[3]))
    gauss = (2.0 * math.pi * 0.02**2) ** -1.5 * math.exp(-0.5 * float(offset @ offset) / 0.02**2)
    expected = math.log(gauss * on_sphere / 4.0)
    got = kernel.log_kernel(Poses(offset, q), Poses(np.zeros(3), se3.IDENTITY))
    assert float(got) == pytest.approx(expected, abs=1e-12)


def test_uniform_limit_is_one_over_the_volume() -> None:
    kernel = IsotropicKernel(1.0, math.radians(120.0))
    values = kernel.log_kernel(
        Poses(np.zeros(3), se3.random_quaternions(20_000, np.random.default_rng(0))),
        Poses(np.zeros(3), se3.IDENTITY),
    )
    mean = np.exp(values + 1.5 * math.log(2.0 * math.pi)).mean()
    assert mean == pytest.approx(1.0 / HAAR_VOLUME, rel=0.02)


@pytest.mark.parametrize("width_deg", WIDTHS_DEG)
def test_wood_sampling_has_the_moments_of_the_distribution(width_deg: float) -> None:
    kernel = IsotropicKernel(0.01, math.radians(width_deg))
    count = 40_000
    q = sample_von_mises_fisher(kernel.kappa, count, np.random.default_rng(2))
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-12)
    error = q[:, 3].std() / math.sqrt(count)
    mean_cosine = ive(2, kernel.kappa) / ive(1, kernel.kappa)
    assert abs(q[:, 3].mean() - mean_cosine) < 5.0 * error
    np.testing.assert_allclose(q[:, :3].mean(axis=0), 0.0, atol=5.0 * q[:, :3].std() / math.sqrt(count))


def test_width_is_the_deviation_of_the_rotation_vector_per_axis() -> None:
    for width_deg, seen_deg in ((15.0, 15.02), (20.0, 20.02)):
        q = sample_von_mises_fisher(4.0 / math.radians(width_deg) ** 2, 200_000, np.random.default_rng(3))
        per_axis = np.degrees(se3.to_rotation_vector(q)).std(axis=0)
        np.testing.assert_allclose(per_axis, seen_deg, atol=0.15)


@given(st.floats(0.001, 0.1), st.floats(2.0, 60.0), st.integers(0, 2**32 - 1))
def test_symmetries_of_the_kernel(sigma: float, width_deg: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    kernel = IsotropicKernel(sigma, math.radians(width_deg))
    p, c = rng.normal(size=(2, 3)) * sigma
    q, r = se3.random_quaternions(2, rng)
    value = kernel.log_kernel(Poses(p, q), Poses(c, r))
    assert float(kernel.log_kernel(Poses(p, -q), Poses(c, r))) == pytest.approx(float(value), abs=1e-9)
    assert float(kernel.log_kernel(Poses(c, r), Poses(p, q))) == pytest.approx(float(value), abs=1e-9)
    frame_p, frame_q = rng.normal(size=3), se3.random_quaternions(1, rng)[0]
    there = se3.compose(Poses(frame_p, frame_q), Poses(p, q))
    here = se3.compose(Poses(frame_p, frame_q), Poses(c, r))
    assert float(kernel.log_kernel(Poses(*there), Poses(*here))) == pytest.approx(float(value), abs=1e-6)


@pytest.mark.parametrize(
    ("position", "rotation", "message"),
    [
        (0.0, 0.2, "sigma_position_m must be between"),
        (-0.01, 0.2, "sigma_position_m must be between"),
        (15.0, 0.2, "sigma_position_m must be between"),
        (math.nan, 0.2, "sigma_position_m must be a finite number"),
        (0.01, math.inf, "sigma_rotation must be a finite number"),
        (0.01, 15.0, "sigma_rotation must be between"),
        (0.01, 0.0, "sigma_rotation must be between"),
        ("0.01", 0.2, "sigma_position_m must be a finite number"),
    ],
)
def test_absurd_widths_are_refused(position: float, rotation: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        IsotropicKernel(position, rotation)


def test_widening_adds_variances() -> None:
    wide = IsotropicKernel(0.03, 0.3).widened(0.04, 0.4)
    assert (wide.sigma_position_m, wide.sigma_rotation) == pytest.approx((0.05, 0.5))
