"""How densely attempts were made, where nobody tells: what their own poses say (for eq 1).

The balance heuristic weighs a success by ``1 / sum_s n_s g_s(x)`` over the strategies s that trials were
chosen by. Of a strategy that tells no density, ``n_s g_s(x)`` is estimated as ``sum_j K(x; x_j)`` over its
own attempts, failures included, under the kernel of the density that is weighed. So however often one grasp
is repeated, its successes together weigh no more than the volume of the kernels that cover them; and no
success weighs more than the volume of its own kernel.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..kernels.isotropic import IsotropicKernel
from ..se3 import Floats, Poses
from .isotropic import CUTOFF, GraspDensity

__all__ = ["attempts_per_volume", "own_exposure"]


def attempts_per_volume(attempts: GraspDensity, poses: Poses, *, threads: int = 1) -> Floats:
    """``sum_j K(x; x_j)`` at poses (M,), attempts per m^3 rad^3; 0 beyond the kernels' cut-off.

    ``attempts`` is a density whose rows all have the weight 1.
    """
    sums = attempts.kernel_sums(poses, cutoff=CUTOFF, threads=threads)
    return np.asarray(sums * math.exp(attempts.kernel.log_peak), dtype=np.float64)


def own_exposure(kernel: IsotropicKernel, symmetric: NDArray[np.bool_]) -> Floats:
    """What one attempt adds at its own pose, (N,): where its jaw is symmetric its twin has half of it."""
    return np.asarray(math.exp(kernel.log_peak) * np.where(symmetric, 0.5, 1.0), dtype=np.float64)
