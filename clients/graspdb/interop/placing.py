"""From a file's poses to those of the tool in the object's frame."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from graspdb.interop.formats.known import TIPS
from graspdb.interop.frames import approach_of, follow, precede
from graspdb.interop.grasps import Floats, Raw
from graspdb.poses import Poses, quaternions_of
from graspdb.wire.base import MAX_COORDINATE_M, UNIT_TOLERANCE


@dataclass(frozen=True)
class Placing:
    """How a pose of the file becomes one of the tool: a factor, what is left of it, what is right of it.

    ``fixed`` (4, 4) stands on the right; ``tip_offset_m`` is from the tool to the fingertips, where the file
    says where these are; ``into_object`` (4, 4) stands on the left, None where poses are in the object's.
    ``swapped`` takes quaternions in the other order than they were read.
    """

    frame: str
    convention: str
    factor: float
    fixed: Floats
    tip_offset_m: float = 0.0
    into_object: Floats | None = None
    swapped: bool = False

    def place(self, raw: Raw) -> Poses:
        """Poses of the tool in the object's frame; ValueError names the first grasp that has none."""
        position = raw.position * self.factor
        _refuse(raw, ~np.isfinite(position).all(axis=1), "has a position that is not finite")
        far = np.abs(position).max(axis=1, initial=0.0) > MAX_COORDINATE_M
        _refuse(raw, far, "lies more than 1 km from the origin: is the unit right (--unit)?")
        poses = Poses(position, self._quaternions(raw))
        if self.into_object is not None:
            poses = precede(self.into_object, poses)
        poses = follow(poses, self.fixed)
        if self.frame != TIPS:
            return poses
        assert raw.ahead_m is not None
        # With our axes z approaches: the tool's origin lies its tip offset behind the fingertips.
        ahead = (raw.ahead_m * self.factor - self.tip_offset_m)[:, None]
        return Poses(poses.position + ahead * approach_of(poses), poses.quaternion_xyzw)

    def _quaternions(self, raw: Raw) -> Floats:
        if raw.rotation is not None:
            _refuse(raw, ~np.isfinite(raw.rotation).all(axis=(1, 2)), "has a rotation that is not finite")
            try:
                return quaternions_of(np.asarray(raw.rotation, dtype=np.float64))
            except ValueError as error:
                found = re.match(r"pose (\d+) (.*)", str(error))
                assert found is not None
                raise ValueError(f"grasp {raw.first + int(found[1])} {found[2]}") from None
        assert raw.quaternion is not None
        quaternion = raw.quaternion
        if self.swapped:
            quaternion = quaternion[:, [1, 2, 3, 0] if raw.order == "xyzw" else [3, 0, 1, 2]]
        norm = np.linalg.norm(quaternion, axis=1, keepdims=True)
        off = ~(np.abs(norm[:, 0] - 1.0) <= UNIT_TOLERANCE)
        _refuse(raw, off, f"must have a unit quaternion, within {UNIT_TOLERANCE:g}")
        return np.asarray(quaternion / norm)


def _refuse(raw: Raw, bad: Any, what: str) -> None:
    if np.any(bad):
        raise ValueError(f"grasp {raw.first + int(np.argmax(bad))} {what}")
