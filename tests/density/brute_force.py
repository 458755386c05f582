"""Densities by brute force in float64: what every faster path is tested against.

Nothing here is cut off, sorted or approximated; the cost is the number of poses times the number of rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from graspdb_density import IsotropicKernel
from graspdb_density.se3 import Floats, Poses


def log_density(
    kernel: IsotropicKernel,
    rows: Poses,
    poses: Poses,
    *,
    weights: ArrayLike | None = None,
    symmetric: ArrayLike | bool = True,
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
    weight = np.ones(len(rows)) if weights is None else np.asarray(weights, dtype=np.float64)
    weight = weight / weight.sum()
    twin = np.broadcast_to(np.asarray(symmetric, dtype=bool), (len(rows),))
    turned = rows.turned()
    with np.errstate(divide="ignore"):
        first = np.log(np.where(twin, 0.5 * weight, weight))
        second = np.log(np.where(twin, 0.5 * weight, 0.0))
    result = np.empty(len(poses))
    for start in range(0, len(poses), 64):
        part = slice(start, start + 64)
        at = Poses(poses.positions[part, None], poses.quaternions_xyzw[part, None])
        own, other = kernel.log_kernel(at, rows) + first, kernel.log_kernel(at, turned) + second
        result[part] = logsumexp(np.concatenate([own, other], axis=1), axis=1)
    return result
