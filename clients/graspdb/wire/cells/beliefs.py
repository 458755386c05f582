"""Where an object is believed to be: a pose with a covariance, or weighted poses as a tracker has them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import Field, model_validator

from graspdb.wire.base import Request, Vector7

MAX_PARTICLES = 64
"""Most poses of a belief."""
#: Metres that count as much as a radian where one of several poses is chosen to stand for them.
_METRES = 0.1

_Row = Annotated[list[Annotated[float, Field(ge=-1e3, le=1e3)]], Field(min_length=6, max_length=6)]


class PoseBelief(Request):
    """Where an object is believed to be: how far it may be off its ``object_pose``, or weighted poses.

    One of the two.
    """

    covariance: Annotated[list[_Row], Field(min_length=6, max_length=6)] | None = None
    """6x6 covariance of ``object_pose``, translation first: metres along the world's axes, and radians about
    them through the object's origin; null for poses."""
    poses: Annotated[list[Vector7], Field(min_length=1, max_length=MAX_PARTICLES)] | None = None
    """Poses of the object in the world: x, y, z in metres and a unit quaternion x, y, z, w each, instead of
    a covariance; null for none."""
    weights: (
        Annotated[list[Annotated[float, Field(ge=0, le=1e12)]], Field(max_length=MAX_PARTICLES)] | None
    ) = None
    """How likely each of the poses is, relative to the others, without a unit; null for alike."""

    @model_validator(mode="after")
    def _one_way(self) -> PoseBelief:
        if (self.covariance is None) == (self.poses is None):
            raise ValueError("give a covariance (with its mean), or poses")
        if self.covariance is not None:
            for i in range(6):
                for j in range(i):
                    one, other = self.covariance[i][j], self.covariance[j][i]
                    scale = math.sqrt(abs(self.covariance[i][i] * self.covariance[j][j]))
                    if abs(one - other) > 1e-6 * scale + 1e-15 or abs(one) > scale * (1 + 1e-6) + 1e-15:
                        raise ValueError("a covariance is symmetric, and none of it exceeds its diagonal")
                if self.covariance[i][i] < 0:
                    raise ValueError("a covariance has no negative variance")
        if self.weights is not None and (
            self.poses is None or len(self.weights) != len(self.poses) or not sum(self.weights) > 0
        ):
            raise ValueError("weights are one for each of the poses, and not all 0")
        return self


def central(poses: Sequence[Any], weights: Sequence[float] | None) -> int:
    """Which of some poses (x, y, z, qx, qy, qz, qw) is nearest to all, by their weights."""
    known = weights or [1.0] * len(poses)

    def apart(one: Sequence[float], other: Sequence[float]) -> float:
        turned = abs(sum(a * b for a, b in zip(one[3:], other[3:], strict=True)))
        return math.dist(one[:3], other[:3]) / _METRES + 2.0 * math.acos(min(turned, 1.0))

    sums = [sum(w * apart(pose, other) for w, other in zip(known, poses, strict=True)) for pose in poses]
    return min(range(len(poses)), key=sums.__getitem__)
