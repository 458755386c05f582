"""Of many attempts a sample is shared by symmetry; what all tell in their own places must not be lost."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..se3 import Floats, Poses
from .kernel_regression import NearestAttempts, SuccessEstimate, SuccessModel

__all__ = ["FullerModel"]


class FullerModel(SuccessModel):
    """Two models of the same object: at every pose that one answers of which more effective trials tell.

    Which one that is does not depend on outcomes, so neither's interval is too narrow for the choice. The
    nearest attempt is that of either.
    """

    def __init__(self, shared: SuccessModel, own: SuccessModel) -> None:
        super().__init__(shared.kernel, shared.parts, shared.motions)
        self.own = own

    @property
    def size(self) -> int:
        return self.own.size

    @property
    def sampled(self) -> int:
        """How many attempts are shared."""
        return super().size

    @property
    def prior_share(self) -> float:
        return self.own.prior_share

    @property
    def nbytes(self) -> int:
        return super().nbytes + self.own.nbytes

    def evaluate(self, poses: Poses, *, level: float = 0.9, threads: int = 1) -> SuccessEstimate:
        return self.evaluate_near(poses, level=level, threads=threads)[0]

    def evaluate_near(
        self, poses: Poses, *, level: float = 0.9, threads: int = 1
    ) -> tuple[SuccessEstimate, NearestAttempts]:
        shared, near = super().evaluate_near(poses, level=level, threads=threads)
        own, nearer = self.own.evaluate_near(poses, level=level, threads=threads)
        fuller = own.effective_trials >= shared.effective_trials
        probability, low, high, trials = (
            np.where(fuller, getattr(own, name), getattr(shared, name))
            for name in ("probability", "low", "high", "effective_trials")
        )
        return SuccessEstimate(probability, low, high, trials, level), _nearest(near, nearer)

    def probability(self, poses: Poses, *, threads: int = 1) -> Floats:
        return self.without_interval(poses, threads=threads)[0]

    def without_interval(
        self, poses: Poses, *, everywhere: bool = False, threads: int = 1
    ) -> tuple[Floats, Floats, NearestAttempts]:
        p, n, near = super().without_interval(poses, everywhere=everywhere, threads=threads)
        own_p, own_n, nearer = self.own.without_interval(poses, everywhere=everywhere, threads=threads)
        fuller = own_n >= n
        return np.where(fuller, own_p, p), np.where(fuller, own_n, n), _nearest(near, nearer)

    def lower_end(
        self,
        poses: Poses,
        *,
        level: float = 0.9,
        near: Callable[[NearestAttempts], NDArray[np.bool_]] | None = None,
        threads: int = 1,
    ) -> Floats:
        both = (
            super().lower_end(poses, level=level, near=near, threads=threads),
            self.own.lower_end(poses, level=level, near=near, threads=threads),
        )
        _, trials, _ = super().without_interval(poses, threads=threads)
        _, own, _ = self.own.without_interval(poses, threads=threads)
        return np.where(own >= trials, both[1], both[0])


def _nearest(a: NearestAttempts, b: NearestAttempts) -> NearestAttempts:
    """The nearer of two attempts at each pose."""
    nearer = b.widths <= a.widths
    metres, radians, along, about = (
        np.where(nearer, getattr(b, name), getattr(a, name))
        for name in ("position_m", "rotation", "position_widths", "rotation_widths")
    )
    displacement = None
    if a.displacement is not None and b.displacement is not None:
        displacement = np.where(nearer[:, None], b.displacement, a.displacement)
    return NearestAttempts(metres, radians, along, about, displacement)
