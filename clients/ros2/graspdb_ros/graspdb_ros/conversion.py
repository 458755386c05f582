"""From GraspDB's answers to messages of ROS 2, and back: whichever package has the types.

``types`` maps names such as ``geometry_msgs/msg/Pose`` to classes that take their fields as keywords: those
of a ROS installation, or the ones that rosbags makes of the same definitions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Types = Mapping[str, Any]

#: A covariance of no more than this in all is none: trackers that know none send zeros.
_NOTHING = 1e-15


def object_pose(message: Any) -> dict[str, Any] | list[float]:
    """What ``best_grasps(object_pose=...)`` takes, of a ``PoseWithCovariance``: seven numbers, or mean and
    covariance where that is not zero.

    ROS has a covariance's rotations about fixed axes, x, y and z of the header's frame, as GraspDB does.
    """
    at, turn = message.pose.position, message.pose.orientation
    mean = [at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]
    covariance = np.array(message.covariance, dtype=np.float64).reshape(6, 6)
    if np.abs(covariance).max() <= _NOTHING:
        return mean
    return {"mean": mean, "covariance": covariance.tolist()}


def joints_now(message: Any, names: Sequence[str]) -> list[float] | None:
    """Positions of a ``JointState`` in the order of a robot's joints; None where one of them is not in it."""
    known = dict(zip(message.name, message.position, strict=False))
    return [float(known[name]) for name in names] if all(name in known for name in names) else None


def header(types: Types, frame_id: str, stamp: Any = None) -> Any:
    """A header; the stamp is zero where none is given, which means now."""
    when = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0) if stamp is None else stamp
    return types["std_msgs/msg/Header"](stamp=when, frame_id=frame_id)


def pose_stamped(types: Types, matrix: Any, head: Any) -> Any:
    """A ``PoseStamped`` of a homogeneous matrix (4, 4)."""
    position, (x, y, z, w) = np.asarray(matrix)[:3, 3].tolist(), _quaternion(np.asarray(matrix)[:3, :3])
    place = types["geometry_msgs/msg/Point"](x=position[0], y=position[1], z=position[2])
    turn = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    pose = types["geometry_msgs/msg/Pose"](position=place, orientation=turn)
    return types["geometry_msgs/msg/PoseStamped"](header=head, pose=pose)


def joint_positions(types: Types, grasp: Any, names: Sequence[str], head: Any) -> Any:
    """A ``JointTrajectory`` of a grasp's pregrasp, grasp and lift, as far as it has them; no times."""
    wanted = (grasp.joints.pregrasp, grasp.joints.grasp, grasp.joints.lift)
    point, still = types["trajectory_msgs/msg/JointTrajectoryPoint"], types["builtin_interfaces/msg/Duration"]
    none = np.zeros(0)
    points = [
        point(
            positions=np.array(joints),
            velocities=none,
            accelerations=none,
            effort=none,
            time_from_start=still(sec=0, nanosec=0),
        )
        for joints in wanted
        if joints is not None
    ]
    made = types["trajectory_msgs/msg/JointTrajectory"]
    return made(header=head, joint_names=list(names), points=points)


def best_grasp(types: Types, grasps: Sequence[Any], names: Sequence[str], head: Any) -> dict[str, Any]:
    """The fields of an answer of ``BestGrasp``, of grasps with their poses in the world."""
    nan = math.nan
    return {
        "success": bool(len(grasps)),
        "message": "",
        "grasps": [pose_stamped(types, grasp.world, head) for grasp in grasps],
        "scores": [nan if grasp.score is None else grasp.score for grasp in grasps],
        "success_probabilities": [
            nan if grasp.success_probability is None else grasp.success_probability for grasp in grasps
        ],
        "joints": [
            joint_positions(types, grasp, names, head) for grasp in grasps if grasp.joints is not None
        ],
    }


def grasp_candidates(types: Types, grasps: Sequence[Any], head: Any) -> dict[str, Any]:
    """The feedback of ``SampleGraspPoses``: candidates with costs, 0 for the best one, in e-folds of what
    they were ranked by.
    """
    scores = [max(float(grasp.score or 0.0), 1e-300) for grasp in grasps]
    return {
        "grasp_candidates": [pose_stamped(types, grasp.world, head) for grasp in grasps],
        "costs": [math.log(scores[0] / score) for score in scores],
    }


def _quaternion(rotation: Any) -> tuple[float, float, float, float]:
    """The unit quaternion x, y, z, w of a rotation matrix, by its largest part."""
    r = rotation
    squares = np.array(
        [
            1 + r[0, 0] - r[1, 1] - r[2, 2],
            1 - r[0, 0] + r[1, 1] - r[2, 2],
            1 - r[0, 0] - r[1, 1] + r[2, 2],
            1 + r[0, 0] + r[1, 1] + r[2, 2],
        ]
    )
    rows = np.array(
        [
            [squares[0], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], squares[1], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[2], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], squares[3]],
        ]
    )
    row = rows[int(np.argmax(squares))]
    x, y, z, w = (row / np.linalg.norm(row)).tolist()
    return x, y, z, w
