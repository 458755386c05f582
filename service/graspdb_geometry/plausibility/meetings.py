"""What each pose's gripper would meet: the object, nothing, or not even its neighbourhood."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from graspdb_geometry.collision import Scene, Surface
from graspdb_geometry.grippers import GripperShape
from graspdb_geometry.plausibility.doubt import Doubt, IntArray, Target
from graspdb_geometry.poses import ToolPoses

BoolArray = npt.NDArray[np.bool_]

#: Meshes, calibrations and profiles are that accurate: only what is farther off is doubtful.
TOLERANCE_M = 0.002
#: Poses whose geometry is tested, drawn from all where there are more.
SAMPLE = 512

_SMALLEST_M = 1e-4
_LARGEST_M = 2.0


def meetings(poses: ToolPoses, target: Target) -> list[Doubt]:
    """Poses that lie beyond every grasp, beyond the gripper's reach, collide, or close on nothing.

    A pose counts once, but that one out of reach may approach away from the object, too.

    Parameters
    ----------
    poses : (n), checked
    target : Target
        Collisions and closing are tested where it has a solid and a shape, on at most :data:`SAMPLE` poses.
    """
    positions, quaternions = (np.asarray(part) for part in poses)
    count = len(positions)
    offsets = target.offsets(positions)
    distance = np.linalg.norm(offsets, axis=1)
    beyond = distance > target.limit_m
    out = distance > target.reach_m + TOLERANCE_M
    doubts = [
        Doubt("implausible-poses", np.flatnonzero(beyond), count),
        Doubt("out-of-reach", np.flatnonzero(out & ~beyond), count),
    ]
    lost = np.flatnonzero(out)
    if len(lost):
        approach = Rotation.from_quat(quaternions[lost]).apply([0.0, 0.0, 1.0])
        away = lost[np.einsum("ij,ij->i", approach, offsets[lost]) < 0.0]
        doubts.append(Doubt("approaches-away", away, count))
    if target.solid is not None and target.shape is not None:
        near = np.flatnonzero(~out)
        rows = near[sample(len(near), SAMPLE)]
        # Those out of reach have been looked at, too: the count is of all in the sample.
        examined = count if len(rows) == len(near) else len(rows)
        some = ToolPoses(positions[rows], quaternions[rows])
        hits = collides(some, target.solid, target.shape)
        empty = ~hits & ~encloses(some, target.solid, target.shape)
        doubts += [
            Doubt("collides", rows[hits], examined),
            Doubt("closes-on-nothing", rows[empty], examined),
        ]
    return [doubt for doubt in doubts if len(doubt.rows)]


def collides(poses: ToolPoses, solid: Scene | Surface, shape: GripperShape) -> BoolArray:
    """Whether the open gripper overlaps the object by more than the tolerance, (n,)."""
    slim = replace(
        shape,
        max_opening_m=min(shape.max_opening_m + 2 * TOLERANCE_M, _LARGEST_M),
        finger_width_m=_less(shape.finger_width_m),
        finger_thickness_m=_less(shape.finger_thickness_m),
        # Palm and fingertips draw back, so that the palm's face counts as the fingers' do.
        tip_offset_m=max(shape.tip_offset_m - TOLERANCE_M, 0.0),
        palm_size_m=(
            _less(shape.palm_size_m[0]),
            _less(shape.palm_size_m[1]),
            _less(shape.palm_size_m[2]),
        ),
    )
    return solid.collides(poses, slim)


def encloses(poses: ToolPoses, solid: Scene | Surface, shape: GripperShape) -> BoolArray:
    """Whether something is between the open fingers, or within the tolerance of it, (n,)."""
    # A gripper whose closed fingers fill the room between the open ones of the other, as far ahead as
    # the tips ever are.
    ahead = shape.farthest_tip_m - shape.tip_offset_m
    filling = GripperShape(
        max_opening_m=shape.max_opening_m,
        finger_width_m=min(shape.finger_width_m + 2 * TOLERANCE_M, _LARGEST_M),
        finger_thickness_m=max(shape.max_opening_m / 2, _SMALLEST_M),
        finger_length_m=min(shape.finger_length_m + ahead + 2 * TOLERANCE_M, _LARGEST_M),
        tip_offset_m=shape.farthest_tip_m + TOLERANCE_M,
        palm_size_m=(_SMALLEST_M, _SMALLEST_M, _SMALLEST_M),
    )
    return solid.collides(poses, filling, opening_m=0.0)


def sample(count: int, most: int) -> IntArray:
    """Ascending numbers below ``count``: all, or ``most`` of them drawn, always the same ones."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(count).choice(count, most, replace=False, shuffle=False))


def _less(size_m: float) -> float:
    return max(size_m - 2 * TOLERANCE_M, _SMALLEST_M)
