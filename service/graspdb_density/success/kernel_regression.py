"""How likely a grasp is to succeed, and how sure that is.

``P = (a m0 + n p) / (a + n)`` with ``p = sum k s / sum k`` over the attempts within reach (s is 1 for a
success), n the effective number of attempts ``(sum k)^2 / sum k^2``, m0 the share of successes among all
attempts and a = 1. Kernels count once an attempt whatever its proposal density: a share of attempts needs no
weighting. The interval is that of the Beta distribution with mean P and n + a trials.

The kernel is isotropic, or a Gaussian with a bandwidth for every axis. The interval covers the truth smoothed
by it, not the truth at a point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv

from .._compiled import diagonal, isotropic
from .._compiled.threads import for_blocks
from ..kde.cell_list import Cells
from ..kde.isotropic import TWIN_ROTATION, scaled_radius
from ..kde.rows import Rows
from ..kernels.diagonal import DiagonalKernel
from ..kernels.isotropic import IsotropicKernel
from ..se3 import Floats, Poses

__all__ = ["PRIOR_TRIALS", "SUCCESS_CUTOFF", "SuccessEstimate", "SuccessKernel", "SuccessModel"]

SuccessKernel = IsotropicKernel | DiagonalKernel

#: Trials the prior share is worth.
PRIOR_TRIALS = 1.0
#: An attempt is within reach when position and rotation together are within this many standard deviations.
SUCCESS_CUTOFF = 5.0
#: Poses a thread takes at once.
_ISOTROPIC_BLOCK, _DIAGONAL_BLOCK = 256, 128


@dataclass(frozen=True, eq=False, slots=True)
class SuccessEstimate:
    """Estimates at M poses.

    Attributes
    ----------
    probability, low, high : (M,)
        Success probability and the ends of its interval.
    effective_trials : (M,)
        0 where no attempt is within reach; there the probability is the share of successes of all attempts.
    level : float
        Probability the interval holds.
    """

    probability: Floats
    low: Floats
    high: Floats
    effective_trials: Floats
    level: float


class SuccessModel:
    """Attempts under a kernel, sorted for evaluation; immutable. Use `build` and `extend`."""

    def __init__(self, kernel: SuccessKernel, succeeded: Cells | None, failed: Cells | None) -> None:
        self.kernel = kernel
        self._succeeded = succeeded
        self._failed = failed

    @classmethod
    def build(
        cls,
        poses: Poses,
        success: ArrayLike,
        *,
        kernel: SuccessKernel,
        symmetric: ArrayLike | bool = True,
    ) -> SuccessModel:
        """Sort attempts.

        Parameters
        ----------
        poses : N
            Every attempt, failures included; attempts that broke off for reasons of their own are left out.
        success : (N,) bool
        kernel
        symmetric : bool or (N,)
            Whether the row's jaw is mirror-symmetric.

        Raises
        ------
        ValueError
            For wrong shapes.
        """
        return cls(kernel, None, None).extend(poses, success, symmetric)

    def extend(self, poses: Poses, success: ArrayLike, symmetric: ArrayLike | bool = True) -> SuccessModel:
        """A model with further attempts; what is present is not sorted again."""
        won = checked_outcomes(success, len(poses))
        if isinstance(self.kernel, IsotropicKernel):
            widest = self.kernel.sigma_position_m
        else:
            # No width is larger than the one the cells are made for, so their runs reach far enough.
            poses, widest = self.kernel.along(poses), max(self.kernel.sigmas[:3])
        attempts = Rows.of(poses, symmetric=symmetric)
        parts: list[Cells | None] = []
        for present, chosen in ((self._succeeded, won), (self._failed, ~won)):
            rows = attempts[chosen]
            if not len(rows):
                parts.append(present)
            elif present is None:
                parts.append(Cells.build(rows, widest))
            else:
                parts.append(present.extend(rows))
        return SuccessModel(self.kernel, parts[0], parts[1])

    @property
    def size(self) -> int:
        """Attempts."""
        return self.successes + (0 if self._failed is None else len(self._failed.rows))

    @property
    def successes(self) -> int:
        return 0 if self._succeeded is None else len(self._succeeded.rows)

    @property
    def prior_share(self) -> float:
        """Share of successes among all attempts, nan without any."""
        return self.successes / self.size if self.size else math.nan

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held."""
        return sum(part.nbytes for part in (self._succeeded, self._failed) if part is not None)

    def evaluate(self, poses: Poses, *, level: float = 0.9, threads: int = 1) -> SuccessEstimate:
        """Success probability with its interval at M poses.

        Raises
        ------
        ValueError
            Without any attempt, or for a level outside (0, 1).
        """
        if not 0.0 < level < 1.0:
            raise ValueError(f"level must be between 0 and 1, not {level!r}")
        probability, trials, alpha, beta = self._beta(poses, threads)
        tail = 0.5 * (1.0 - level)
        low = _quantiles(alpha, beta, tail, threads)
        high = _quantiles(alpha, beta, 1.0 - tail, threads)
        return SuccessEstimate(probability, low, high, trials, level)

    def probability(self, poses: Poses, *, threads: int = 1) -> Floats:
        """The probability of `evaluate` alone, (M,): much faster, for the interval's ends take longest."""
        return self._beta(poses, threads)[0]

    def lower_end(self, poses: Poses, *, level: float = 0.9, threads: int = 1) -> Floats:
        """The lower end of `evaluate` alone, (M,)."""
        _, _, alpha, beta = self._beta(poses, threads)
        return _quantiles(alpha, beta, 0.5 * (1.0 - level), threads)

    def _beta(self, poses: Poses, threads: int) -> tuple[Floats, Floats, Floats, Floats]:
        """Probability, effective trials and the parameters of the interval's Beta distribution, each (M,)."""
        if not self.size:
            raise ValueError("a success probability needs at least one attempt")
        won = self._sums(self._succeeded, poses, threads)
        lost = self._sums(self._failed, poses, threads)
        prior = self.prior_share
        total, squares = (won + lost).T
        probability, trials, share = shrunk_share(won[:, 0], total, squares, prior)
        alpha = PRIOR_TRIALS * prior + trials * share
        beta = PRIOR_TRIALS * (1.0 - prior) + trials * (1.0 - share)
        # Without any success, or any failure, the matching Beta would be a point: the interval then starts
        # from the share that half a trial more of either would give.
        if prior in (0.0, 1.0):
            softened = (self.successes + 0.5) / (self.size + 1.0)
            alpha, beta = alpha + (softened - prior), beta - (softened - prior)
        return probability, trials, alpha, beta

    def _sums(self, cells: Cells | None, poses: Poses, threads: int) -> Floats:
        """Sums of k and k^2 (M, 2)."""
        radius, kernel = scaled_radius(SUCCESS_CUTOFF), self.kernel
        if cells is None:
            return np.zeros((len(poses), 2))
        arrays = cells.arrays
        if isinstance(kernel, DiagonalKernel):
            poses = kernel.along(poses)
            half = 0.5 / np.array(kernel.sigmas) ** 2
            half[:3] /= arrays.scale**2
            turning, block = kernel.axes is None, _DIAGONAL_BLOCK

            def loop(p: Floats, q: Floats, out: Floats) -> None:
                diagonal.square_sums(arrays, p, q, half, turning, radius, out)
        else:
            kappa, wide, block = kernel.kappa, kernel.sigma_rotation > TWIN_ROTATION, _ISOTROPIC_BLOCK

            def loop(p: Floats, q: Floats, out: Floats) -> None:
                isotropic.square_sums(arrays, p, q, kappa, radius, wide, out)

        return cells.at_poses(loop, poses, columns=(2,), block=block, threads=threads)


def shrunk_share(won: Floats, total: Floats, squares: Floats, prior: float) -> tuple[Floats, Floats, Floats]:
    """Success probability, effective trials and the share it is shrunk from, each (M,).

    Parameters
    ----------
    won, total, squares : (M,)
        Sums of k over successes, and of k and k^2 over all attempts.
    prior : float
        The share of successes among all attempts.
    """
    reached = total > 0.0
    safe = np.where(reached, total, 1.0)
    share = np.where(reached, won / safe, 0.0)
    trials = np.where(reached, safe * (safe / np.where(reached, squares, 1.0)), 0.0)
    return (PRIOR_TRIALS * prior + trials * share) / (PRIOR_TRIALS + trials), trials, share


def _quantiles(alpha: Floats, beta: Floats, level: float, threads: int) -> Floats:
    """Quantiles (M,) of Beta distributions."""
    out = np.empty(len(alpha))

    def work(begin: int, end: int) -> None:
        out[begin:end] = betaincinv(alpha[begin:end], beta[begin:end], level)

    for_blocks(work, len(alpha), block=4_096, threads=threads)
    return out


def checked_outcomes(success: ArrayLike, count: int) -> NDArray[np.bool_]:
    """Whether attempts (N,) succeeded, checked."""
    won = np.asarray(success)
    if won.shape != (count,) or won.dtype != np.bool_:
        raise ValueError(f"success must be bools of shape ({count},), not {won.dtype} of shape {won.shape}")
    return won
