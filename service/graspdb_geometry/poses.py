"""Poses of the tool in the object frame, as every question to a geometry takes them."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

__all__ = ["PoseArrays", "ToolPoses", "checked"]

FloatArray = npt.NDArray[np.float64]


class PoseArrays(Protocol):
    """Whatever has the arrays of n poses: `ToolPoses`, or a value of the caller's own."""

    @property
    def positions(self) -> npt.ArrayLike:
        """(n, 3) metres."""

    @property
    def quaternions_xyzw(self) -> npt.ArrayLike:
        """(n, 4) unit."""


class ToolPoses(NamedTuple):
    """The arrays of n poses, (n, 3) metres and (n, 4)."""

    positions: npt.ArrayLike
    quaternions_xyzw: npt.ArrayLike


def checked(poses: PoseArrays) -> tuple[FloatArray, FloatArray]:
    """The arrays, contiguous, quaternions normalised.

    Raises
    ------
    ValueError
        For wrong shapes, values that are not finite, quaternions further than 1e-3 from unit length.
    """
    p = np.ascontiguousarray(poses.positions, dtype=np.float64)
    q = np.ascontiguousarray(poses.quaternions_xyzw, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3:
        raise ValueError("positions must have shape (n, 3)")
    if q.shape != (len(p), 4):
        raise ValueError("quaternions must have shape (n, 4), one for each position")
    if not (np.all(np.isfinite(p)) and np.all(np.isfinite(q))):
        raise ValueError("positions and quaternions must be finite")
    norms = np.linalg.norm(q, axis=1)
    if np.any(np.abs(norms - 1.0) > 1e-3):
        raise ValueError("quaternions must have unit length")
    return p, q / norms[:, None]
