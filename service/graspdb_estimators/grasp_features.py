"""What estimators learn from: where the grasp is on its object, and what the jaw closes on there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from graspdb_density import se3
from graspdb_density.se3 import Floats, Poses
from graspdb_geometry.closing import DECREASING, FEATURES, INCREASING, ClosingGeometry
from graspdb_geometry.grippers import GripperShape

__all__ = ["GraspFeatures", "monotonic_of"]

_UPPER = np.triu_indices(3)
_PLACE = tuple(f"{name}_{axis}" for name in ("position", "approach") for axis in "xyz")
#: The closing axis; whichever way round, by products of its components.
_AXIS = tuple(f"closing_{axis}" for axis in "xyz")
_LINE = tuple(f"closing_{'xyz'[a]}{'xyz'[b]}" for a, b in zip(*_UPPER, strict=True))


@dataclass(frozen=True, eq=False)
class GraspFeatures:
    """Features of grasps of one object with one gripper.

    Attributes
    ----------
    closing : ClosingGeometry
    shape : GripperShape
    symmetric : bool
        Whether the jaw is mirror-symmetric: then both twins of a grasp have the same features.
    """

    closing: ClosingGeometry
    shape: GripperShape
    symmetric: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return FEATURES + _PLACE + (_LINE if self.symmetric else _AXIS)

    @cached_property
    def monotonic(self) -> NDArray[np.int8]:
        """1 where mechanics has success never fall with a column, -1 where never rise, else 0."""
        return monotonic_of(self.names)

    def at(self, poses: Poses, threads: int = 1) -> Floats:
        """Features (n, F) of grasps with the tool at poses (n); NaN where the jaw closes on nothing."""
        turned = se3.to_matrix(poses.quaternions_xyzw)
        if self.symmetric:
            # One of both twins, so that rounding does not tell them apart.
            other = turned[:, 0, 1] < 0.0
            poses = poses.turned(other)
            turned[other, :, :2] *= -1.0
        closed = self.closing.features(poses, self.shape, threads)
        y = turned[:, :, 1]
        a, b = _UPPER
        axis = y[:, a] * y[:, b] if self.symmetric else y
        return np.concatenate([closed, poses.positions, turned[:, :, 2], axis], axis=1)


def monotonic_of(names: Sequence[str]) -> NDArray[np.int8]:
    """Which way success goes with features (F,), as `GraspFeatures.monotonic`."""
    ways = [1 if name in INCREASING else -1 if name in DECREASING else 0 for name in names]
    return np.array(ways, dtype=np.int8)
