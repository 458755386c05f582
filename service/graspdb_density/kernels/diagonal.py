"""A Gaussian over displacements with a bandwidth for every axis, for success rather than for density."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..se3 import UNIT_TOLERANCE, Poses

__all__ = ["DiagonalKernel"]


@dataclass(frozen=True, slots=True)
class DiagonalKernel:
    """``exp(-sum xi^2 / (2 sigma^2))``: xi the translation along the gripper's axes, or along fixed ones of
    the object, and the rotation vector in the gripper's frame. Two are equal where their numbers are.

    Attributes
    ----------
    sigmas : (6,)
        Standard deviations along (metres) and about (radians) x, y, z.
    axes : (9,) or None
        Of translations, object frame: a matrix row by row whose columns they are; None: the gripper's.
    """

    sigmas: tuple[float, ...]
    axes: tuple[float, ...] | None = None

    @classmethod
    def of(cls, sigmas: ArrayLike, axes: ArrayLike | None = None) -> DiagonalKernel:
        """From arrays (6,) and (3, 3).

        Raises
        ------
        ValueError
            For bandwidths that are not positive and finite, or axes that are not orthonormal.
        """
        widths = np.asarray(sigmas, dtype=np.float64)
        if widths.shape != (6,) or not np.isfinite(widths).all() or (widths <= 0.0).any():
            raise ValueError("widths have shape (6,), are positive and finite")
        if axes is None:
            return cls(tuple(widths.tolist()))
        f = np.asarray(axes, dtype=np.float64)
        if f.shape != (3, 3) or not np.all(np.abs(f.T @ f - np.eye(3)) < UNIT_TOLERANCE):
            raise ValueError("the columns of axes (3, 3) must be orthonormal")
        return cls(tuple(widths.tolist()), tuple(f.ravel().tolist()))

    def along(self, poses: Poses) -> Poses:
        """Poses with their positions along the fixed axes, where there are such."""
        if self.axes is None:
            return poses
        turned = np.ascontiguousarray(poses.positions @ np.reshape(self.axes, (3, 3)))
        return Poses(turned, poses.quaternions_xyzw)

    def back(self, along: Poses) -> Poses:
        """What `along` made of poses (N), in the object frame again."""
        if self.axes is None:
            return along
        positions = np.ascontiguousarray(along.positions @ np.reshape(self.axes, (3, 3)).T)
        return Poses(positions, along.quaternions_xyzw)
