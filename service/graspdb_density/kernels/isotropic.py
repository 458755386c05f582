"""The isotropic kernel on R^3 x SO(3).

Equations 2 to 4 of Bodenhagen, Detry, Piater and Krueger, *What a successful grasp tells about the success
chances of grasps in its vicinity*: a Gaussian in position times an antipodal pair of von Mises-Fisher
densities on the unit quaternions.

Measure. Densities here are with respect to Lebesgue measure on positions and the Haar measure of SO(3) whose
volume is 8 pi^2 (rotation vectors near the identity): the unit is 1/(m^3 rad^3). A density per area of the
quaternions' sphere S3 (area 2 pi^2, both signs counted) is four times that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ive

from ..se3 import Floats, Poses

__all__ = ["HAAR_VOLUME", "IsotropicKernel", "sample_von_mises_fisher"]

#: Volume of SO(3) in the measure of every density of this package, rad^3.
HAAR_VOLUME = 8.0 * math.pi**2

#: Widths outside these limits are mistakes of unit (millimetres, degrees) rather than choices.
POSITION_LIMITS_M = (1e-5, 10.0)
ROTATION_LIMITS = (math.radians(0.1), math.radians(120.0))


@dataclass(frozen=True, slots=True)
class IsotropicKernel:
    """One width in position, one in rotation.

    Parameters
    ----------
    sigma_position_m
        Standard deviation per axis, metres.
    sigma_rotation
        Standard deviation of the rotation vector per axis, radians (the RMS total angle is sqrt(3) times
        that).

    Raises
    ------
    ValueError
        For widths that are not finite, not positive or absurd.
    """

    sigma_position_m: float
    sigma_rotation: float

    def __post_init__(self) -> None:
        for name, unit, (low, high) in (
            ("sigma_position_m", "m", POSITION_LIMITS_M),
            ("sigma_rotation", "rad", ROTATION_LIMITS),
        ):
            value = getattr(self, name)
            if not isinstance(value, int | float | np.floating | np.integer) or not math.isfinite(value):
                raise ValueError(f"{name} must be a finite number, not {value!r}")
            if not low <= value <= high:
                raise ValueError(f"{name} must be between {low:.4g} and {high:.4g} {unit}, not {value:.6g}")
            object.__setattr__(self, name, float(value))

    @property
    def kappa(self) -> float:
        """Concentration on S3: a quaternion halves the angle, so 4 / sigma_rotation^2."""
        return 4.0 / self.sigma_rotation**2

    @property
    def log_peak(self) -> float:
        """Log density of one kernel at its centre without its antipode's tail, nats of 1/(m^3 rad^3).

        ``log((2 pi sigma^2)^(-3/2)) + log(C4 e^kappa / 2) - log 4`` with ``C4 = kappa / (4 pi^2 I1(kappa))``;
        the exponentially scaled Bessel function keeps it finite at every width.
        """
        position = -1.5 * math.log(2.0 * math.pi * self.sigma_position_m**2)
        kappa = self.kappa
        rotation = math.log(kappa / (4.0 * math.pi**2 * float(ive(1, kappa))))
        return position + rotation - math.log(2.0) - math.log(4.0)

    def log_kernel(self, poses: Poses, centres: Poses) -> Floats:
        """Log of one kernel (eq 2-4) without the jaw's symmetry, float64, arrays broadcast; nats of
        1/(m^3 rad^3).
        """
        offset = poses.positions - centres.positions
        squared = np.sum(offset * offset, axis=-1) / self.sigma_position_m**2
        dot = np.abs(np.sum(poses.quaternions_xyzw * centres.quaternions_xyzw, axis=-1))
        rotation = self.kappa * (dot - 1.0) + np.log1p(np.exp(-2.0 * self.kappa * dot))
        return np.asarray(self.log_peak - 0.5 * squared + rotation, dtype=np.float64)

    def widened(self, sigma_position_m: float, sigma_rotation: float) -> IsotropicKernel:
        """The kernel convolved with isotropic tool noise of the given deviations per axis (either may be
        0).
        """
        return IsotropicKernel(
            math.hypot(self.sigma_position_m, sigma_position_m),
            math.hypot(self.sigma_rotation, sigma_rotation),
        )

    @property
    def overall_covariance(self) -> Floats:
        """(6, 6) of displacements, m^2 and rad^2."""
        return np.diag([self.sigma_position_m**2] * 3 + [self.sigma_rotation**2] * 3)

    def sample_displacements(self, count: int, rng: np.random.Generator) -> Poses:
        """Draw displacements from a kernel centred on the identity."""
        translations = rng.standard_normal((count, 3)) * self.sigma_position_m
        return Poses(translations, sample_von_mises_fisher(self.kappa, count, rng))


def sample_von_mises_fisher(kappa: float, count: int, rng: np.random.Generator) -> Floats:
    """Unit quaternions about the identity by Wood's rejection (1994) in dimension 4, shape (count, 4)."""
    b = (-2.0 * kappa + math.sqrt(4.0 * kappa * kappa + 9.0)) / 3.0
    x0 = (1.0 - b) / (1.0 + b)
    c = kappa * x0 + 3.0 * math.log(1.0 - x0 * x0)
    cosine = np.empty(0)
    while cosine.size < count:
        # The acceptance is above 0.6, so two rounds nearly always do.
        tries = int((count - cosine.size) * 1.8) + 16
        z = rng.beta(1.5, 1.5, tries)
        w = (1.0 - (1.0 + b) * z) / (1.0 - (1.0 - b) * z)
        kept = kappa * w + 3.0 * np.log(1.0 - x0 * w) - c >= np.log(rng.random(tries))
        cosine = np.concatenate([cosine, w[kept]])
    w = cosine[:count]
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    sine = np.sqrt(np.maximum(0.0, 1.0 - w * w))
    return np.concatenate([sine[:, None] * direction, w[:, None]], axis=1)
