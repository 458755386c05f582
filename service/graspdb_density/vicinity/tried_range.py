"""How far pairs of trials lie apart along and about each axis: beyond, a smoothed density tells nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..se3 import Floats, Poses

__all__ = ["TriedRange", "tried_range"]


@dataclass(frozen=True, eq=False, slots=True)
class TriedRange:
    """The farthest displacements that pairs of trials have, the other coordinates nearly unchanged.

    Attributes
    ----------
    along : (3, 2)
        Along x, y and z towards minus and plus, metres, not negative; 0 where there is none.
    about : (3, 2)
        About them, radians.
    """

    along: Floats
    about: Floats


def tried_range(
    trials: Poses,
    grasps: Poses,
    axes: Floats,
    *,
    off_axis_m: float,
    off_axis: float,
    reach_m: float,
    reach: float,
    twins: bool,
    mirrored: bool,
) -> TriedRange:
    """Of pairs of any of A grasps with any of N trials.

    Parameters
    ----------
    axes : (A, 3, 3)
        Columns are what translations are measured along; rotations are about the gripper's axes.
    off_axis_m, off_axis
        How far the other coordinates may be off, metres and radians.
    reach_m, reach
        What lies farther apart is not looked at, metres and radians.
    twins
        Whether a jaw turned half about its approach is the same.
    mirrored
        Whether x and y have no sign.
    """
    along, about = np.zeros((3, 2)), np.zeros((3, 2))
    for number in range(len(grasps)):
        shift = trials.positions - grasps.positions[number]
        near = np.flatnonzero(np.abs(shift).max(axis=1) <= max(reach_m, off_axis_m) * math.sqrt(3.0))
        own, turned = grasps.quaternions_xyzw[number], trials.quaternions_xyzw[near]
        shift = shift[near]
        _widen(along, reach_m, *_translations(shift @ axes[number], own, turned, off_axis_m, off_axis, twins))
        still = np.linalg.norm(shift, axis=1) <= off_axis_m
        _widen(about, reach, *_rotations(own, turned[still], off_axis, twins))
    if mirrored:
        along[:2] = along[:2].max(axis=1, keepdims=True)
    return TriedRange(along, about)


def _widen(ends: Floats, reach: float, amount: Floats, known: NDArray[np.bool_]) -> None:
    """Let ends (3, 2) hold those amounts (n, 3) that are known (n, 3) and not beyond the reach."""
    values = np.where(known & (np.abs(amount) <= reach), amount, 0.0)
    if len(values):
        ends[:, 0] = np.maximum(ends[:, 0], -values.min(axis=0))
        ends[:, 1] = np.maximum(ends[:, 1], values.max(axis=0))


def _translations(
    shift: Floats, own: Floats, turned: Floats, off_axis_m: float, off_axis: float, twins: bool
) -> tuple[Floats, NDArray[np.bool_]]:
    angle = se3.angle_between(turned, own)
    if twins:
        angle = np.minimum(angle, se3.angle_between(turned, se3.jaw_twin(own)))
    near = np.abs(shift) <= off_axis_m
    others = np.stack([near[:, (axis + 1) % 3] & near[:, (axis + 2) % 3] for axis in range(3)], axis=1)
    return shift, np.asarray(others & (angle <= off_axis)[:, None])


def _rotations(own: Floats, turned: Floats, off_axis: float, twins: bool) -> tuple[Floats, NDArray[np.bool_]]:
    relative = se3.multiply(se3.conjugate(own), turned)
    if twins:
        # Either may be the one turned half, or both.
        other = se3.multiply(se3.conjugate(se3.jaw_twin(own)), turned)
        relative = np.concatenate([relative, se3.jaw_twin(relative), other, se3.jaw_twin(other)])
    vector, real = relative[:, :3], relative[:, 3:]
    about = vector**2 + real**2 >= math.cos(0.5 * off_axis) ** 2
    angle = 2.0 * np.arctan2(vector, real)
    return np.asarray(angle - 2.0 * math.pi * np.floor((angle + math.pi) / (2.0 * math.pi))), about
