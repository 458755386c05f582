"""Bags of ROS 1 and 2, read without ROS: moveit_msgs/Grasp, geometry_msgs/PoseArray and PoseStamped."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from graspdb.interop import joints
from graspdb.interop.formats.messages import LEFT, POSTURES, QUALITY
from graspdb.interop.formats.source import CHUNK, SourceFile, Wishes
from graspdb.interop.grasps import Raw, Report, problem

GRASP, TRANSLATION = "moveit_msgs/msg/Grasp", "moveit_msgs/msg/GripperTranslation"
POSE_ARRAY, POSE = "geometry_msgs/msg/PoseArray", "geometry_msgs/msg/PoseStamped"
#: Messages that bags of ROS 2 before Iron do not define themselves, and no distribution's own set has.
_DEFINITIONS = {
    TRANSLATION: "geometry_msgs/Vector3Stamped direction\nfloat32 desired_distance\nfloat32 min_distance\n",
    GRASP: "\n".join(
        [
            "string id",
            "trajectory_msgs/JointTrajectory pre_grasp_posture",
            "trajectory_msgs/JointTrajectory grasp_posture",
            "geometry_msgs/PoseStamped grasp_pose",
            "float64 grasp_quality",
            "moveit_msgs/GripperTranslation pre_grasp_approach",
            "moveit_msgs/GripperTranslation post_grasp_retreat",
            "moveit_msgs/GripperTranslation post_place_retreat",
            "float32 max_contact_force",
            "string[] allowed_touch_objects",
        ]
    ),
}


def extra() -> Any:
    """The package that reads and writes bags; ImportError that says how to install it."""
    try:
        importlib.import_module("rosbags.highlevel")
        importlib.import_module("rosbags.rosbag2")
        importlib.import_module("rosbags.typesys")
        return importlib.import_module("rosbags")
    except ImportError as error:
        raise ImportError("A bag needs rosbags: pip install 'graspdb[rosbag]'") from error


@functools.cache
def typestore() -> Any:
    """The messages of ROS 2 Humble, and MoveIt's grasps; one, as it keeps what it compiled to write them."""
    types = extra().typesys
    store = types.get_typestore(types.Stores.ROS2_HUMBLE)
    for name, text in _DEFINITIONS.items():
        store.register(types.get_types_from_msg(text, name))
    return store


def has_grasps(source: SourceFile, topic: str | None) -> bool:
    """Whether a bag has moveit_msgs/Grasp, which say more than poses; of this topic, unless None."""
    with _opened(source) as bag:
        return any(c.msgtype == GRASP and topic in (None, c.topic) for c in bag.connections)


def read_grasps(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """Every moveit_msgs/Grasp of a bag; the frame of ``grasp_pose`` must be the object's."""
    yield from _read(source, wishes, report, (GRASP,))


def read_poses(source: SourceFile, wishes: Wishes, report: Report) -> Iterator[Raw]:
    """Every pose of a bag's PoseArray and PoseStamped, in the order in which they were recorded."""
    yield from _read(source, wishes, report, (POSE_ARRAY, POSE))


def _read(source: SourceFile, wishes: Wishes, report: Report, kinds: tuple[str, ...]) -> Iterator[Raw]:
    only = wishes.only.get("topic")
    with _opened(source) as bag:
        chosen = [c for c in bag.connections if c.msgtype in kinds and only in (None, c.topic)]
        if not chosen:
            there = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections})) or "nothing"
            raise problem(
                source.name, f"has no topic of {' or '.join(kinds)} that was asked for; has {there}"
            )
        for topic in sorted({f"{c.topic} ({c.msgtype})" for c in bag.connections if c not in chosen}):
            report.drop(f"topic {topic}")
        for topic in sorted({f"{c.topic} ({c.msgtype})" for c in chosen}):
            report.recognise(f"topic {topic}")
        first, rows, references = 0, _Rows(source.name), set(report.references)
        for connection, _, content in bag.messages(connections=chosen):
            try:
                message = bag.deserialize(content, connection.msgtype)
            except Exception as error:  # noqa: BLE001
                # Whatever a broken message makes the package raise is the file's fault.
                raise problem(
                    source.name, f"a message of {connection.topic} can't be read: {error}"
                ) from None
            rows.add(message, connection.msgtype, references, report)
            report.references = sorted(references - {""})
            if len(rows.numbers) >= CHUNK:
                yield rows.raw(first)
                first, rows = first + len(rows.numbers), _Rows(source.name)
        if rows.numbers or not first:
            yield rows.raw(first)


class _Rows:
    """Poses and scores of messages, until they are enough."""

    def __init__(self, file: str) -> None:
        self._file = file
        self.numbers: list[list[float]] = []
        self.scores: list[float] = []
        self._postures: dict[str, list[Any]] = {kind: [] for kind in joints.KINDS}

    def add(self, message: Any, kind: str, references: set[str], report: Report) -> None:
        if kind == GRASP:
            stamped = message.grasp_pose
            references.add(stamped.header.frame_id)
            self._pose(stamped.pose)
            self.scores.append(float(message.grasp_quality))
            for name, posture in POSTURES.items():
                self._postures[posture].append(self._posture(name, getattr(message, name), report))
            for name in LEFT:
                if _said(getattr(message, name)):
                    report.drop(name)
            return
        references.add(message.header.frame_id)
        for pose in message.poses if kind == POSE_ARRAY else [message.pose]:
            self._pose(pose)

    def _posture(self, what: str, trajectory: Any, report: Report) -> Any:
        """The joints' values at a trajectory's end, None where it has none."""
        if not trajectory.points:
            return None
        if len(trajectory.points) > 1:
            report.drop("points of postures before the last one")
        last = trajectory.points[-1]
        if len(last.velocities) or len(last.accelerations) or len(last.effort):
            report.drop("velocities, accelerations and effort of postures")
        return joints.values_of(self._file, what, list(trajectory.joint_names), last.positions.tolist())

    def _pose(self, pose: Any) -> None:
        p, q = pose.position, pose.orientation
        self.numbers.append([p.x, p.y, p.z, q.x, q.y, q.z, q.w])

    def raw(self, first: int) -> Raw:
        values = np.array(self.numbers, dtype=np.float64).reshape(-1, 7)
        qualities = {QUALITY: np.array(self.scores)} if self.scores else {}
        more = self._postures if self.scores else {}
        turns = values[:, 3:]
        return Raw(first, values[:, :3], turns, order="xyzw", qualities=qualities, more=more)


def _said(value: Any) -> bool:
    """Whether a field that no trial has holds anything."""
    if hasattr(value, "desired_distance"):
        return bool(value.desired_distance)
    return bool(value)


@contextmanager
def _opened(source: SourceFile) -> Iterator[Any]:
    package = extra()
    reader = package.highlevel.AnyReader
    try:
        bag = reader([source.bag], default_typestore=typestore())
        bag.open()
    except ImportError:
        raise
    except Exception as error:  # noqa: BLE001
        # The package raises its own errors, YAML's, SQLite's and others for what is no whole bag.
        raise problem(source.name, f"is no whole bag: {error}") from None
    try:
        yield bag
    finally:
        bag.close()
