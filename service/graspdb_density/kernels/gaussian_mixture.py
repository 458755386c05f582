"""Kernels whose width differs by direction: Gaussians and mixtures of Gaussians over the displacement.

The displacement from a row's pose (p_i, q_i) to a pose (p, q) is ``xi = (F_i^T (p - p_i), Log(q_i^-1 q))``:
metres and radians, translation first, F_i the gripper's axes or another frame at the row, the rotation vector
the shortest and in the gripper's frame. On R^3 x SO(3) rather than SE(3), the position's Jacobian is 1
(compare Barfoot and Furgale 2014).

A symmetric jaw turned about its approach axis sees ``A xi``, and a kernel that changed under it would give a
grasp and its twin different densities. So a kernel must be invariant: a single Gaussian by ``S = A S A^T``,
components in pairs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from .. import se3
from ..se3 import Floats, Poses
from .isotropic import POSITION_LIMITS_M, IsotropicKernel

__all__ = [
    "MOST_ROTATION",
    "AnisotropicKernel",
    "Frame",
    "Kernel",
    "mirror",
    "rotation_normaliser",
]

#: Axes a row's translations are measured along: the gripper's, which turn with the jaw, or others, which do
#: not.
Frame = Literal["gripper", "fixed"]

#: Largest standard deviation of a component's rotation, about any axis. Wider shapes are mixtures: the
#: tangent space holds no wider Gaussian.
MOST_ROTATION = math.radians(40.0)
_MOST_COMPONENTS = 64
_TWO_PI = 2.0 * math.pi
#: Of a displacement: its translation, and its rotation vector.
_ALONG, _ABOUT = slice(0, 3), slice(3, 6)


def mirror(frame: Frame) -> Floats:
    """Diagonal (6,) of A, what the jaw's turn does to a displacement."""
    if frame == "gripper":
        return np.array([-1.0, -1.0, 1.0, -1.0, -1.0, 1.0])
    return np.array([1.0, 1.0, 1.0, -1.0, -1.0, 1.0])


def rotation_normaliser(means: ArrayLike, covariances: ArrayLike) -> Floats:
    """Haar volume under ``exp(-(r - m)^T T^-1 (r - m) / 2)`` over all rotation vectors r, relative to the
    Gaussian's own, shape (C,).

    The expectation of the volume element ``(2 sin(|r| / 2) / |r|)^2`` by Gauss-Hermite quadrature with 12^3
    nodes. For zero means it agrees with ``1 - tr T / 12 + (tr^2 + 2 tr T^2) / 360`` within 1e-4 up to 40
    degrees per axis.

    Parameters
    ----------
    means : (C, 3) radians
    covariances : (C, 3, 3) rad^2
    """
    node, weight = np.polynomial.hermite_e.hermegauss(12)
    grid = np.stack(np.meshgrid(node, node, node, indexing="ij"), axis=-1).reshape(-1, 3)
    weights = (weight[:, None, None] * weight[:, None] * weight).ravel() / (2.0 * math.pi) ** 1.5
    mean, cov = np.asarray(means, dtype=np.float64), np.asarray(covariances, dtype=np.float64)
    vectors = mean[:, None, :] + np.einsum("cij,nj->cni", np.linalg.cholesky(cov), grid)
    half = 0.5 * np.linalg.norm(vectors, axis=2)
    return np.asarray(np.sinc(half / np.pi) ** 2 @ weights, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class AnisotropicKernel:
    """A mixture of Gaussians over displacements, invariant under the jaw's turn.

    Parameters
    ----------
    weights : (C,) positive, normalised here
    means : (C, 6) metres, radians
    covariances : (C, 6, 6) positive definite, rotation at most `MOST_ROTATION` about any axis
    frame
        What translations are measured along.

    Raises
    ------
    ValueError
        For wrong shapes, values that are not finite, covariances that are singular, not symmetric or too
        wide, or a mixture that the jaw's turn changes (`symmetrised` makes one that it does not).
    """

    weights: Floats
    means: Floats
    covariances: Floats
    frame: Frame = "gripper"

    def __post_init__(self) -> None:
        w = np.atleast_1d(np.array(self.weights, dtype=np.float64))
        m = np.atleast_2d(np.array(self.means, dtype=np.float64))
        s = np.array(self.covariances, dtype=np.float64)
        if self.frame not in ("gripper", "fixed"):
            raise ValueError(f"frame is gripper or fixed, not {self.frame!r}")
        if w.ndim != 1 or m.shape != (len(w), 6) or s.shape != (len(w), 6, 6):
            raise ValueError(
                "weights (C,), means (C, 6) and covariances (C, 6, 6) have shapes "
                f"{w.shape}, {m.shape}, {s.shape}"
            )
        if not 1 <= len(w) <= _MOST_COMPONENTS:
            raise ValueError(f"a kernel has 1 to {_MOST_COMPONENTS} components, not {len(w)}")
        if not (np.isfinite(w).all() and np.isfinite(m).all() and np.isfinite(s).all() and (w > 0.0).all()):
            raise ValueError("weights must be positive, means and covariances finite")
        for i, cov in enumerate(s):
            _check_covariance(cov, i)
        object.__setattr__(self, "weights", w / w.sum())
        object.__setattr__(self, "means", m)
        object.__setattr__(self, "covariances", 0.5 * (s + s.transpose(0, 2, 1)))
        if not self._invariant():
            raise ValueError(
                "the kernel changes when the jaw is turned: left and right of the gripper would disagree; "
                "symmetrise it, or give components in mirrored pairs"
            )

    @classmethod
    def gaussian(cls, covariance: ArrayLike, *, frame: Frame = "gripper") -> AnisotropicKernel:
        """One Gaussian about no displacement; a covariance (6, 6) that A changes becomes ``(S + A S A) /
        2``.
        """
        s = np.array(covariance, dtype=np.float64)
        if s.shape != (6, 6):
            raise ValueError(f"a covariance has shape (6, 6), not {s.shape}")
        a = mirror(frame)
        return cls(np.ones(1), np.zeros((1, 6)), 0.5 * (s + a[:, None] * s * a)[None], frame)

    @classmethod
    def diagonal(cls, sigmas: ArrayLike, *, frame: Frame = "gripper") -> AnisotropicKernel:
        """Standard deviations (6,) along x, y, z (metres) and about x, y, z (radians)."""
        return cls.gaussian(np.diag(np.square(np.asarray(sigmas, dtype=np.float64))), frame=frame)

    @classmethod
    def symmetrised(
        cls, weights: ArrayLike, means: ArrayLike, covariances: ArrayLike, *, frame: Frame = "gripper"
    ) -> AnisotropicKernel:
        """A mixture averaged with its mirror image: components that A changes become pairs of half weight."""
        w = np.atleast_1d(np.array(weights, dtype=np.float64))
        m = np.atleast_2d(np.array(means, dtype=np.float64))
        s = np.array(covariances, dtype=np.float64)
        a = mirror(frame)
        image = a[:, None] * s * a
        own = np.array([_close(m[i], a * m[i]) and _close(s[i], image[i]) for i in range(len(w))])
        return cls(
            np.concatenate([w[own], 0.5 * w[~own], 0.5 * w[~own]]),
            np.concatenate([m[own], m[~own], a * m[~own]]),
            np.concatenate([s[own], s[~own], image[~own]]),
            frame,
        )

    def _invariant(self) -> bool:
        a = mirror(self.frame)
        left = list(range(len(self.weights)))
        for i in range(len(self.weights)):
            m, s = a * self.means[i], a[:, None] * self.covariances[i] * a
            match = next(
                (
                    j
                    for j in left
                    if math.isclose(self.weights[j], self.weights[i], rel_tol=1e-6)
                    and _close(self.means[j], m)
                    and _close(self.covariances[j], s)
                ),
                None,
            )
            if match is None:
                return False
            left.remove(match)
        return True

    @cached_property
    def log_peaks(self) -> Floats:
        """Log density of every component at its mean, weight included, (C,) nats of 1/(m^3 rad^3).

        ``w / ((2 pi)^3 sqrt|S| E)`` with E the mean volume element of the rotations it covers.
        """
        _, logdet = np.linalg.slogdet(self.covariances)
        rotation = rotation_normaliser(self.means[:, 3:], self.covariances[:, 3:, 3:])
        return np.asarray(np.log(self.weights / rotation) - 3.0 * math.log(_TWO_PI) - 0.5 * logdet)

    @cached_property
    def widest(self) -> tuple[Floats, Floats]:
        """Largest standard deviation of each component along any axis (C,), metres, and about any (C,),
        radians.
        """
        along, about = (np.linalg.eigvalsh(self.covariances[:, part, part]) for part in (_ALONG, _ABOUT))
        return np.sqrt(along[:, -1]), np.sqrt(about[:, -1])

    @property
    def overall_covariance(self) -> Floats:
        """(6, 6) of displacements, the spread of the means included."""
        centre = self.weights @ self.means
        off = self.means - centre
        return np.asarray(
            np.einsum("c,cij->ij", self.weights, self.covariances + off[:, :, None] * off[:, None, :])
        )

    @property
    def isotropic(self) -> IsotropicKernel:
        """The isotropic kernel whose position and rotation blocks have the same determinants."""
        s = self.overall_covariance
        return IsotropicKernel(
            float(np.linalg.det(s[:3, :3]) ** (1.0 / 6.0)), float(np.linalg.det(s[3:, 3:]) ** (1.0 / 6.0))
        )

    def log_kernel(self, displacements: ArrayLike) -> Floats:
        """Log density at displacements (..., 6), float64, both wraps of the rotation; the reference."""
        xi = np.asarray(displacements, dtype=np.float64)
        angle = np.linalg.norm(xi[..., 3:], axis=-1, keepdims=True)
        other = xi.copy()
        other[..., 3:] *= 1.0 - _TWO_PI / np.maximum(angle, 1e-12)
        inverse = np.linalg.inv(self.covariances)
        terms = []
        for x in (xi, other):
            off = x[..., None, :] - self.means
            terms.append(self.log_peaks - 0.5 * np.einsum("...ci,cij,...cj->...c", off, inverse, off))
        return np.asarray(logsumexp(np.concatenate(terms, axis=-1), axis=-1), dtype=np.float64)

    def sample_displacements(self, count: int, rng: np.random.Generator) -> Poses:
        """Draw displacements, by rejection on the volume element of rotations, which is at most 1."""
        roots = np.linalg.cholesky(self.covariances)
        # A component is drawn by its weight, whatever share of its tangent Gaussian the rejection keeps.
        component = rng.choice(len(self.weights), size=count, p=self.weights / self.weights.sum())
        out = np.empty((count, 6))
        todo = np.arange(count)
        while todo.size:
            which = component[todo]
            noise = rng.standard_normal((len(todo), 6))
            draw = self.means[which] + np.einsum("nij,nj->ni", roots[which], noise)
            half = 0.5 * np.linalg.norm(draw[:, 3:], axis=1)
            kept = rng.random(len(todo)) < np.sinc(half / np.pi) ** 2
            out[todo[kept]] = draw[kept]
            todo = todo[~kept]
        return Poses(out[:, :3], se3.from_rotation_vector(out[:, 3:]))


Kernel = IsotropicKernel | AnisotropicKernel


def _check_covariance(cov: Floats, index: int) -> None:
    if not np.allclose(cov, cov.T, rtol=1e-6, atol=1e-12):
        raise ValueError(f"covariance {index} is not symmetric")
    scale = np.sqrt(np.maximum(np.diag(cov), 1e-300))
    # Correlations, so that metres and radians do not decide what is singular.
    if np.any(np.diag(cov) <= 0.0) or np.linalg.eigvalsh(cov / scale[:, None] / scale)[0] < 1e-8:
        raise ValueError(f"covariance {index} is singular or not positive definite")
    widths = np.sqrt(np.linalg.eigvalsh(cov[:3, :3]))
    if widths[0] < POSITION_LIMITS_M[0] or widths[-1] > POSITION_LIMITS_M[1]:
        raise ValueError(f"covariance {index} has a position width outside {POSITION_LIMITS_M} m")
    turn = math.sqrt(float(np.linalg.eigvalsh(cov[3:, 3:])[-1]))
    if turn > MOST_ROTATION * (1.0 + 1e-9):
        raise ValueError(
            f"covariance {index} has a rotation width of {math.degrees(turn):.3g} degrees; "
            f"more than {math.degrees(MOST_ROTATION):.3g} takes a mixture"
        )


def _close(a: Floats, b: Floats) -> bool:
    return bool(np.allclose(a, b, rtol=1e-6, atol=1e-10))
