"""From a file's poses to those of the tool in the object's frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.interop.formats.known import TIPS
from graspdb.interop.frames import approach_of, follow, precede
from graspdb.interop.grasps import Floats, Raw
from graspdb.poses import Poses, matrices, quaternions_of
from graspdb.wire.base import MAX_COORDINATE_M, UNIT_TOLERANCE


@dataclass(frozen=True)
class Placing:
    """How a pose of the file becomes one of the tool: a factor, what is left of it, what is right of it.

    ``fixed`` (4, 4) stands on the right; ``tip_offset_m`` is from the tool to the fingertips, where the file
    says where these are; ``into_object`` (4, 4) stands on the left, None where poses are in the object's.
    ``swapped`` takes quaternions in the other order than they were read, ``object_swapped`` the object's.
    ``axes_told`` is whether the format itself, and not somebody, says which axes approach and close.
    """

    frame: str
    convention: str
    factor: float
    fixed: Floats
    tip_offset_m: float = 0.0
    into_object: Floats | None = None
    swapped: bool = False
    object_swapped: bool = False
    axes_told: bool = False

    def place(self, raw: Raw) -> Poses:
        """Poses of the tool in the object's frame; ValueError names the first grasp that has none."""
        for bad, what in self.faults(raw):
            if np.any(bad):
                raise ValueError(f"grasp {raw.first + int(np.argmax(bad))} {what}")
        poses = Poses(raw.position * self.factor, self._quaternions(raw))
        if raw.object_position is not None:
            assert raw.object_quaternion is not None
            turn = raw.object_quaternion
            turn = swapped_order(turn, raw.object_order) if self.object_swapped else turn
            there = matrices(raw.object_position * self.factor, _unit(turn))
            poses = precede(np.asarray(np.linalg.inv(there), dtype=np.float64), poses)
        if self.into_object is not None:
            poses = precede(self.into_object, poses)
        poses = follow(poses, self.fixed)
        if self.frame != TIPS:
            return poses
        assert raw.ahead_m is not None
        # With our axes z approaches: the tool's origin lies its tip offset behind the fingertips.
        ahead = (raw.ahead_m * self.factor - self.tip_offset_m)[:, None]
        return Poses(poses.position + ahead * approach_of(poses), poses.quaternion_xyzw)

    def faults(self, raw: Raw) -> Iterator[tuple[NDArray[np.bool_], str]]:
        """Which grasps (N,) have no pose, and why, a reason after the other."""
        yield from self._of_positions(raw.position, "a position")
        if raw.rotation is not None:
            yield _infinite(raw.rotation), "has a rotation that is not finite"
            gram = np.einsum("nki,nkj->nij", raw.rotation, raw.rotation)
            off = np.abs(gram - np.eye(3)).max(axis=(1, 2), initial=0.0) > 2 * UNIT_TOLERANCE
            yield np.asarray(off), "must have a rotation: the columns of its matrix are not orthonormal"
            with np.errstate(invalid="ignore"):
                mirrored = np.linalg.det(raw.rotation) < 0
            yield mirrored, "must have a rotation, not a reflection"
        elif raw.quaternion is not None:
            yield _no_unit(raw.quaternion), f"must have a unit quaternion, within {UNIT_TOLERANCE:g}"
        if raw.object_position is not None and raw.object_quaternion is not None:
            yield from self._of_positions(raw.object_position, "an object's position")
            told = f"must have a unit quaternion of the object, within {UNIT_TOLERANCE:g}"
            yield _no_unit(raw.object_quaternion), told

    def _of_positions(self, position: Floats, what: str) -> Iterator[tuple[NDArray[np.bool_], str]]:
        yield _infinite(position), f"has {what} that is not finite"
        far = np.abs(position * self.factor).max(axis=1, initial=0.0) > MAX_COORDINATE_M
        yield np.asarray(far), f"has {what} more than 1 km from the origin: is the unit right (--unit)?"

    def _quaternions(self, raw: Raw) -> Floats:
        if raw.rotation is not None:
            return quaternions_of(np.asarray(raw.rotation, dtype=np.float64))
        assert raw.quaternion is not None
        return _unit(swapped_order(raw.quaternion, raw.order) if self.swapped else raw.quaternion)


def swapped_order(quaternion: Floats, order: str | None) -> Floats:
    """Quaternions xyzw that were read in this order, read in the other one."""
    return quaternion[:, [1, 2, 3, 0] if order == "xyzw" else [3, 0, 1, 2]]


def _infinite(numbers: Floats) -> NDArray[np.bool_]:
    return np.asarray(~np.isfinite(numbers).all(axis=tuple(range(1, numbers.ndim))))


def _no_unit(quaternion: Floats) -> NDArray[np.bool_]:
    return np.asarray(~(np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) <= UNIT_TOLERANCE))


def _unit(quaternion: Floats) -> Floats:
    return np.asarray(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))
