"""What searches hand on and answer: poses with their scores, and when two grasps count as distinct."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..se3 import Floats, Poses

__all__ = [
    "Admissible",
    "Maximum",
    "Pull",
    "Score",
    "ScoredPoses",
    "Separation",
    "distinct_from",
    "ranked_by_density_where_flat",
]

Bools = NDArray[np.bool_]
#: Whether poses are free of what a region can't express, collisions for one: (K,) bool.
Admissible = Callable[[Poses], Bools]
#: Scores poses: (K,), higher is better.
Score = Callable[[Poses], Floats]
#: Moves poses.
Pull = Callable[[Poses], Poses]
#: Densities this many e-folds below the highest are as low as any where they decide between equal scores.
_DEEPEST = 30.0


@dataclass(frozen=True, eq=False, slots=True)
class Maximum:
    """A grasp found by a search.

    Attributes
    ----------
    position : (3,) metres, quaternion_xyzw : (4,)
        Tool frame in the object frame.
    log_density : nats of 1/(m^3 rad^3)
    active_constraints
        Names of the region's limits that hold it, see `Region.active`.
    score
        What it was chosen by: the log density, unless another score was asked for.
    """

    position: Floats
    quaternion_xyzw: Floats
    log_density: float
    active_constraints: tuple[str, ...] = ()
    score: float = math.nan


class Separation(NamedTuple):
    """Two grasps are distinct when farther apart than this or turned by more than this."""

    metres: float
    radians: float


@dataclass(frozen=True, eq=False, slots=True)
class ScoredPoses:
    """Poses (K) with scores (K,)."""

    poses: Poses
    scores: Floats

    @classmethod
    def unscored(cls, poses: Poses) -> ScoredPoses:
        """Poses that nothing was compared by yet."""
        return cls(poses, np.zeros(len(poses)))

    @classmethod
    def joined(cls, *parts: ScoredPoses) -> ScoredPoses:
        """All poses of some parts, in order."""
        poses = Poses.concatenate([part.poses for part in parts])
        return cls(poses, np.concatenate([part.scores for part in parts]))

    def __len__(self) -> int:
        return len(self.scores)

    def __getitem__(self, rows: slice | NDArray[np.integer] | Bools) -> ScoredPoses:
        """Some of the poses."""
        return ScoredPoses(self.poses[rows], self.scores[rows])

    def ranked(self) -> ScoredPoses:
        """The same, best first."""
        return self[np.argsort(-self.scores, kind="stable")]

    def put(self, rows: int | Bools, other: ScoredPoses, others: int | NDArray[np.intp] | Bools) -> None:
        """Overwrite some poses by some of another's."""
        self.poses.positions[rows] = other.poses.positions[others]
        self.poses.quaternions_xyzw[rows] = other.poses.quaternions_xyzw[others]
        self.scores[rows] = other.scores[others]


def ranked_by_density_where_flat(
    scores: Floats, log_density: Floats, highest: float, resolution: float
) -> Floats:
    """What scores (K,) are ranked by, so that of equal ones the densest is best.

    Around a pose tried again and again a success probability is the same everywhere but for rounding, which
    must not choose.

    Parameters
    ----------
    log_density : (K,)
        In the unit of ``highest``, which is about the highest there is.
    resolution : float
        Differences of scores that mean nothing: what an e-fold of density is worth. 0: scores rank alone.
    """
    if not resolution:
        return scores
    return np.asarray(scores - resolution * np.minimum(highest - log_density, _DEEPEST))


def distinct_from(poses: Poses, separation: Separation, *, twins: bool) -> Admissible:
    """Whether a pose is distinct from all given ones.

    With ``twins`` a pose and the one turned half around the jaw's approach are the same.
    """

    def distinct(asked: Poses) -> Bools:
        p, q = asked
        near = np.zeros(len(asked), dtype=np.bool_)
        for at, to in zip(poses.positions, poses.quaternions_xyzw, strict=True):
            angle = se3.angle_between(q, to)
            if twins:
                angle = np.minimum(angle, se3.angle_between(q, se3.jaw_twin(to)))
            near |= (np.linalg.norm(p - at, axis=1) <= separation.metres) & (angle <= separation.radians)
        return ~near

    return distinct
