"""Densities by brute force in float64: what every faster path is tested against.

Nothing here is cut off, sorted or approximated; the cost is the number of poses times the number of rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from .. import se3
from ..kernels.isotropic import IsotropicKernel
from ..se3 import Floats, Poses

__all__ = ["gradient", "kernel_log_density", "log_density"]


def kernel_log_density(
    kernel: IsotropicKernel,
    poses: Poses,
    centres: Poses,
) -> Floats:
    """Log of one kernel (eq 2-4) without the jaw's symmetry, arrays broadcast; nats of 1/(m^3 rad^3)."""
    offset = np.asarray(poses.positions, dtype=np.float64) - np.asarray(centres.positions, dtype=np.float64)
    squared = np.sum(offset * offset, axis=-1) / kernel.sigma_position_m**2
    dot = np.abs(np.sum(np.asarray(poses.quaternions_xyzw) * np.asarray(centres.quaternions_xyzw), axis=-1))
    kappa = kernel.kappa
    rotation = kappa * (dot - 1.0) + np.log1p(np.exp(-2.0 * kappa * dot))
    return np.asarray(kernel.log_peak - 0.5 * squared + rotation, dtype=np.float64)


def log_density(
    kernel: IsotropicKernel,
    rows: Poses,
    poses: Poses,
    *,
    weights: ArrayLike | None = None,
    symmetric: ArrayLike | bool = True,
    chunk: int = 64,
) -> Floats:
    """Log of ``sum_i w_i (K(x; x_i) + K(x; x_i M)) / 2``, M the jaw's turn; rows not symmetric have no twin.

    Parameters
    ----------
    rows : (N), poses : (M)
    weights : (N,) or None
        Positive, normalised here to sum to 1; None means equal.
    symmetric : bool or (N,)

    Returns
    -------
    (M,) nats of 1/(m^3 rad^3)
    """
    p, q = poses
    weight = np.ones(len(rows)) if weights is None else np.asarray(weights, dtype=np.float64)
    weight = weight / weight.sum()
    twin = np.broadcast_to(np.asarray(symmetric, dtype=bool), (len(rows),))
    turned = rows.turned()
    with np.errstate(divide="ignore"):
        first = np.log(np.where(twin, 0.5 * weight, weight))
        second = np.log(np.where(twin, 0.5 * weight, 0.0))
    result = np.empty(len(p))
    for start in range(0, len(p), chunk):
        part = slice(start, start + chunk)
        at = Poses(p[part, None, :], q[part, None, :])
        terms = np.concatenate(
            [
                kernel_log_density(kernel, at, rows) + first,
                kernel_log_density(kernel, at, turned) + second,
            ],
            axis=1,
        )
        result[part] = logsumexp(terms, axis=1)
    return result


def gradient(
    kernel: IsotropicKernel,
    rows: Poses,
    pose: Poses,
    *,
    weights: ArrayLike | None = None,
    symmetric: ArrayLike | bool = True,
) -> tuple[Floats, Floats]:
    """Gradient of the log density at one pose.

    Returns
    -------
    position_gradient : (3,) 1/m
    quaternion_gradient : (4,) tangent to the unit sphere at the pose's quaternion, per unit of quaternion arc
    """
    centre, turn = rows
    p, q = pose
    weight = np.ones(len(rows)) if weights is None else np.asarray(weights, dtype=np.float64)
    twin = np.broadcast_to(np.asarray(symmetric, dtype=bool), (len(rows),))
    mu = np.concatenate([turn, se3.jaw_twin(turn[twin])])
    at = np.concatenate([centre, centre[twin]])
    w = np.concatenate([np.where(twin, 0.5, 1.0) * weight, 0.5 * weight[twin]])
    dot = mu @ q
    exponent = -0.5 * np.sum((p - at) ** 2, axis=1) / kernel.sigma_position_m**2
    kappa = kernel.kappa
    top = np.max(exponent + kappa * np.abs(dot))
    near = w * np.exp(exponent + kappa * np.abs(dot) - top)
    far = w * np.exp(exponent - kappa * np.abs(dot) - top)
    total = np.sum(near + far)
    shift = (near + far) @ (at - p) / kernel.sigma_position_m**2
    pull = ((near - far) * np.sign(dot)) @ mu * kappa
    return shift / total, (pull - (pull @ q) * q) / total
