"""The paper's analytic anisotropic kernel (eq 7 and 8): a reference that nothing else rests on.

For rotations the von Mises-Fisher pair with its angle weighted by direction: ``exp(sigma_r cos(w beta))`` and
its antipode's, ``w = sqrt(theta^T S^-1 theta)`` with theta the vector part of the relative quaternion ``mu^-1
q`` and S = diag(widths^2). ``w beta`` is held at pi / 2: beyond, the cosine would rise again into lobes of no
meaning. For positions a Gaussian with a covariance. The normaliser is numerical: the paper's is that of the
isotropic case, and its experiments are left to future work.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import quad

from graspdb_density import se3
from graspdb_density.kernels.isotropic import HAAR_VOLUME
from graspdb_density.se3 import Floats

__all__ = ["AnalyticKernel"]

_TWO_PI = 2.0 * math.pi
_HALF_PI = 0.5 * math.pi


@dataclass(frozen=True, eq=False)
class AnalyticKernel:
    """A density of displacements: translations along the gripper's axes, turns in its frame.

    Parameters
    ----------
    covariance : (3, 3) of translations, square metres; what the jaw's turn would change is averaged with its
        mirror image
    widths : (3,) about x, y, z, relative
    beta : radians per unit of w
    sigma_r : concentration

    Raises
    ------
    ValueError
        For wrong shapes, values that are not finite or not positive, or a covariance that is not positive
        definite.
    """

    covariance: Floats
    widths: Floats
    beta: float
    sigma_r: float

    def __post_init__(self) -> None:
        s, c = np.array(self.widths, dtype=np.float64), np.array(self.covariance, dtype=np.float64)
        if s.shape != (3,) or not np.isfinite(s).all() or np.any(s <= 0.0):
            raise ValueError("widths must be three positive and finite numbers")
        if not (0.0 < self.beta < math.inf and 0.0 < self.sigma_r < math.inf):
            raise ValueError("beta and sigma_r must be positive and finite")
        if c.shape != (3, 3) or not np.isfinite(c).all() or not np.allclose(c, c.T, rtol=1e-6, atol=1e-15):
            raise ValueError("covariance must be symmetric, finite and of shape (3, 3)")
        a = np.array([-1.0, -1.0, 1.0])
        c = 0.5 * (c + a[:, None] * c * a)
        if np.linalg.eigvalsh(c)[0] <= 0.0:
            raise ValueError("covariance must be positive definite")
        object.__setattr__(self, "widths", s)
        object.__setattr__(self, "covariance", c)

    @cached_property
    def log_normaliser(self) -> float:
        """Log of the integral of the kernel's terms over positions and the Haar measure of rotations."""
        # Directions by a product rule, angles by adaptive quadrature: volume element 4 sin^2(angle / 2).
        node, weight = np.polynomial.legendre.leggauss(48)
        phi = (np.arange(96) + 0.5) * _TWO_PI / 96
        ring = np.sqrt(1.0 - node**2)[:, None]
        height = np.broadcast_to(node[:, None], (48, 96))
        axes = np.stack([ring * np.cos(phi), ring * np.sin(phi), height], axis=-1)

        def shell(angle: float) -> float:
            terms = np.exp(self._rotation(axes * math.sin(0.5 * angle)))
            return float(weight @ terms.mean(axis=1)) * _TWO_PI * 4.0 * math.sin(0.5 * angle) ** 2

        total, _ = quad(shell, 0.0, math.pi, epsrel=1e-9, limit=200)
        _, logdet = np.linalg.slogdet(self.covariance)
        return math.log(total) + 1.5 * math.log(_TWO_PI) + 0.5 * float(logdet)

    def log_kernel(self, translations: ArrayLike, quaternions_xyzw: ArrayLike) -> Floats:
        """Log density at displacements (..., 3), (..., 4), nats of 1/(m^3 rad^3)."""
        t, q = np.asarray(translations, dtype=np.float64), np.asarray(quaternions_xyzw, dtype=np.float64)
        squared = np.einsum("...i,ij,...j->...", t, np.linalg.inv(self.covariance), t)
        return np.asarray(self._rotation(q[..., :3]) - 0.5 * squared - self.log_normaliser)

    def kernel(self, translations: ArrayLike, quaternions_xyzw: ArrayLike) -> Floats:
        """Density at displacements, 1/(m^3 rad^3)."""
        return np.exp(self.log_kernel(translations, quaternions_xyzw))

    def gradient(self, translations: ArrayLike, quaternions_xyzw: ArrayLike) -> tuple[Floats, Floats]:
        """Gradient of the log density by the translation (..., 3), 1/m, and by a rotation vector in the tool
        (..., 3), ``q <- q exp(r)``.
        """
        t, q = np.asarray(translations, dtype=np.float64), np.asarray(quaternions_xyzw, dtype=np.float64)
        q = np.where(q[..., 3:] < 0.0, -q, q)
        v, upright = q[..., :3], q[..., 3:]
        angle = self._weighted_angle(v)[..., None]
        held = angle >= _HALF_PI
        cosine = np.where(held, 0.0, np.cos(angle))
        # d/dc of sigma (c - 1) + log(1 + e^(-2 sigma c)), then dc/dv = -sin(w beta) beta dw/dv.
        steep = self.sigma_r * np.tanh(self.sigma_r * cosine)
        by_v = -steep * self.beta**2 * np.sinc(angle / math.pi) * v / self.widths**2
        by_v = np.where(held, 0.0, by_v)
        around = 0.5 * (upright * by_v + np.cross(by_v, v))
        return np.asarray(-t @ np.linalg.inv(self.covariance)), np.asarray(around)

    def sample_displacements(self, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Draw translations (count, 3) and turns (count, 4).

        Rotation vectors by rejection from a Gaussian and a uniform part, which together lie above the kernel:
        ``1 - cos a >= 4 a^2 / pi^2`` up to pi / 2, and ``sin(h) >= 2 h / pi`` for half angles h.
        """
        root = np.linalg.cholesky(self.covariance)
        translations = rng.standard_normal((count, 3)) @ root.T
        spread = math.pi**2 * self.widths / (math.sqrt(8.0 * self.sigma_r) * self.beta)
        floor = math.exp(-self.sigma_r)
        peaked = _TWO_PI**1.5 * float(np.prod(spread))
        share = peaked / (peaked + floor * HAAR_VOLUME)
        out = np.empty((0, 4))
        while len(out) < count:
            tries = 8 * (count - len(out)) + 64
            drawn = np.where(
                rng.random(tries)[:, None] < share,
                rng.standard_normal((tries, 3)) * spread,
                se3.to_rotation_vector(se3.random_quaternions(tries, rng)),
            )
            drawn = drawn[np.linalg.norm(drawn, axis=1) < math.pi]
            element = np.sinc(np.linalg.norm(drawn, axis=1) / _TWO_PI) ** 2
            turns = se3.from_rotation_vector(drawn)
            above = np.exp(-0.5 * np.sum((drawn / spread) ** 2, axis=1)) + floor * element
            kept = rng.random(len(drawn)) * 2.0 * above < np.exp(self._rotation(turns[:, :3])) * element
            out = np.concatenate([out, turns[kept]])
        return translations, out[:count]

    def _weighted_angle(self, v: Floats) -> Floats:
        return np.asarray(self.beta * np.sqrt(np.sum((v / self.widths) ** 2, axis=-1)))

    def _rotation(self, v: Floats) -> Floats:
        """Log of both terms at vector parts (..., 3) of either sign, 0 or a little more at none."""
        cosine = np.cos(np.minimum(self._weighted_angle(v), _HALF_PI))
        return np.asarray(self.sigma_r * (cosine - 1.0) + np.log1p(np.exp(-2.0 * self.sigma_r * cosine)))
