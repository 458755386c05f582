"""A success model that answers by what was learned."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, ndtri

from graspdb_density import NearestAttempts, SuccessEstimate, SuccessModel
from graspdb_density.se3 import Floats, Poses
from graspdb_density.success.kernel_regression import Plain

from .grasp_features import GraspFeatures
from .stack import Stack

__all__ = ["StackedModel"]


class StackedModel(SuccessModel):
    """The attempts of a model under what a stack learned of them, or of nearly the same.

    Parameters
    ----------
    model
    stack
    features : GraspFeatures or None
        Of the object and gripper that its trees were learned on; None for a stack without trees.
    """

    def __init__(self, model: SuccessModel, stack: Stack, features: GraspFeatures | None) -> None:
        super().__init__(model.kernel, model.parts, model.motions)
        self.stack = stack
        self.features = features

    def evaluate_near(
        self, poses: Poses, *, level: float = 0.9, threads: int = 1
    ) -> tuple[SuccessEstimate, NearestAttempts]:
        kernel = self.without_quantiles(poses, everywhere=True, threads=threads)
        logit, half = self._learned(kernel, poses, level, threads)
        low = np.maximum(expit(logit - half) - kernel.spread, 0.0)
        high = np.minimum(expit(logit + half) + kernel.spread, 1.0)
        return SuccessEstimate(expit(logit), low, high, kernel.trials, level), kernel.nearest

    def evaluate(self, poses: Poses, *, level: float = 0.9, threads: int = 1) -> SuccessEstimate:
        return self.evaluate_near(poses, level=level, threads=threads)[0]

    def probability(self, poses: Poses, *, threads: int = 1) -> Floats:
        return self.without_interval(poses, threads=threads)[0]

    def without_interval(
        self, poses: Poses, *, everywhere: bool = False, threads: int = 1
    ) -> tuple[Floats, Floats, NearestAttempts]:
        kernel = self.without_quantiles(poses, everywhere=everywhere, threads=threads)
        return expit(self._learned(kernel, poses, 0.9, threads)[0]), kernel.trials, kernel.nearest

    def support(self, poses: Poses, *, threads: int = 1) -> tuple[Floats, NearestAttempts]:
        kernel = self.without_quantiles(poses, everywhere=True, threads=threads)
        return kernel.trials, kernel.nearest

    def lower_end(
        self,
        poses: Poses,
        *,
        level: float = 0.9,
        near: Callable[[NearestAttempts], NDArray[np.bool_]] | None = None,
        threads: int = 1,
    ) -> Floats:
        kernel = self.without_quantiles(poses, everywhere=False, threads=threads)
        logit, half = self._learned(kernel, poses, level, threads)
        low = np.maximum(expit(logit - half) - kernel.spread, 0.0)
        if near is None:
            return low
        return np.where(near(kernel.nearest), low, np.minimum(low, self.untried_low(level)))

    def _learned(self, kernel: Plain, poses: Poses, level: float, threads: int) -> tuple[Floats, Floats]:
        """Logit of success, and half the length of its interval, (M,)."""
        described = None
        if self.stack.trees is not None and self.features is not None:
            described = self.features.at(poses, threads)
        logit, spread = self.stack.combined(kernel.probability, kernel.trials, described)
        return logit, float(ndtri(0.5 + 0.5 * level)) * spread
