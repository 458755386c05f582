"""What stands around in a question, in the world: obstacles of the request, and a stored scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import Obstacles, Pose, SceneCreate
from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_geometry.collision import Scene, Surface
from graspdb_geometry.grippers import GripperShape
from graspdb_geometry.poses import PoseArrays
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.trial_columns import Bools


@dataclass(frozen=True, eq=False)
class PlacedSolid:
    """An object that stands around as an obstacle; ``pose`` (one) is its frame in that of the grasps."""

    solid: Scene | Surface
    pose: Poses

    def collides(
        self,
        poses: PoseArrays,
        shape: GripperShape,
        opening_m: float | None = None,
        threads: int = 1,
        retreat_m: float = 0.0,
    ) -> Bools:
        """Whether the gripper overlaps it in each pose; as that of a scene."""
        own = Poses(np.asarray(poses.positions), np.asarray(poses.quaternions_xyzw))
        p, q = se3.compose(se3.inverse(self.pose), own)
        return self.solid.collides(
            Poses(p, se3.normalise(q)), shape, opening_m, threads=threads, retreat_m=retreat_m
        )


@dataclass(frozen=True, eq=False)
class StandingScene:
    """A stored scene that a question names: what is in it, its stamp, and the objects in it by their ids."""

    content: SceneCreate
    stamp: str
    rows: Mapping[str, ObjectRow]


def matrices(poses: Poses) -> NDArray[np.float64]:
    """Poses (N) as (N, 4, 4)."""
    found = np.zeros((len(poses), 4, 4))
    found[:, :3, :3] = se3.to_matrix(poses.quaternions_xyzw)
    found[:, :3, 3] = poses.positions
    found[:, 3, 3] = 1.0
    return found


def pose_of(matrix: NDArray[np.float64]) -> Pose:
    """A pose (4, 4) as answers have it."""
    quaternion = se3.canonical(se3.from_matrix(matrix[:3, :3]))
    return Pose(position=tuple(matrix[:3, 3].tolist()), quaternion_xyzw=tuple(quaternion.tolist()))


def boxes_of(given: Obstacles) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (N, 4, 4) and edges (N, 3) of boxes, in the frame that they are given in."""
    p = np.array([box.position for box in given.boxes]).reshape(-1, 3)
    q = np.array([box.quaternion_xyzw for box in given.boxes]).reshape(-1, 4)
    return matrices(Poses(p, q)), np.array([box.size_m for box in given.boxes]).reshape(-1, 3)
