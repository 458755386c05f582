"""Bags of ROS 2, written without ROS: moveit_msgs/Grasp, and the same poses as a PoseArray to be seen."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from graspdb.interop.formats.rosbags import GRASP, POSE_ARRAY, TRANSLATION, extra, typestore
from graspdb.interop.grasps import Report
from graspdb.interop.writers.content import Content
from graspdb.interop.writers.messages import grasp_messages

#: Of the format; ROS 2 Humble reads it, and every later one.
_VERSION = 8
TOPIC = "/grasps"


def bag(path: Path, contents: Iterator[Content], report: Report) -> None:
    """A folder with a bag: topics ``/grasps`` (a message a grasp), ``/grasps/poses`` (a run in one)."""
    store, rosbag2 = typestore(), extra().rosbag2
    messages = _Messages(store.types)
    report.assume("an empty frame_id is the object's frame; every message is of the time 0")
    with rosbag2.Writer(path, version=_VERSION) as file:
        one = file.add_connection(TOPIC, GRASP, typestore=store)
        many = file.add_connection(f"{TOPIC}/poses", POSE_ARRAY, typestore=store)
        scored = None
        for content in contents:
            scored = scored if content.first else content.score()
            grasps = [messages.grasp(values) for values in grasp_messages(content, scored, report)]
            for message in grasps:
                file.write(one, 0, store.serialize_cdr(message, GRASP))
            poses = [grasp.grasp_pose.pose for grasp in grasps]
            array = store.types[POSE_ARRAY](header=messages.header(""), poses=poses)
            file.write(many, 0, store.serialize_cdr(array, POSE_ARRAY))


class _Messages:
    """ROS's messages of the plain data that MoveIt's YAML has."""

    def __init__(self, types: Any) -> None:
        self._types = types

    def grasp(self, values: dict[str, Any]) -> Any:
        stamped, pose = values["grasp_pose"], values["grasp_pose"]["pose"]
        geometry = "geometry_msgs/msg/"
        score = values["grasp_quality"]
        return self._types[GRASP](
            id=values["id"],
            pre_grasp_posture=self._posture(values["pre_grasp_posture"]),
            grasp_posture=self._posture(values["grasp_posture"]),
            grasp_pose=self._types[geometry + "PoseStamped"](
                header=self.header(stamped["header"]["frame_id"]),
                pose=self._types[geometry + "Pose"](
                    position=self._types[geometry + "Point"](**pose["position"]),
                    orientation=self._types[geometry + "Quaternion"](**pose["orientation"]),
                ),
            ),
            grasp_quality=np.nan if score is None else score,
            pre_grasp_approach=self._translation(values["pre_grasp_approach"]),
            post_grasp_retreat=self._translation(values["post_grasp_retreat"]),
            post_place_retreat=self._translation(values["post_place_retreat"]),
            max_contact_force=values["max_contact_force"],
            allowed_touch_objects=values["allowed_touch_objects"],
        )

    def header(self, frame: str) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
        return self._types["std_msgs/msg/Header"](stamp=time, frame_id=frame)

    def _posture(self, values: dict[str, Any]) -> Any:
        none = np.zeros(0)
        soon = self._types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
        point = self._types["trajectory_msgs/msg/JointTrajectoryPoint"]
        points = [
            point(np.array(item["positions"], dtype=np.float64), none, none, none, soon)
            for item in values["points"]
        ]
        trajectory = self._types["trajectory_msgs/msg/JointTrajectory"]
        return trajectory(self.header(""), values["joint_names"], points)

    def _translation(self, values: dict[str, Any]) -> Any:
        direction = values["direction"]
        return self._types[TRANSLATION](
            direction=self._types["geometry_msgs/msg/Vector3Stamped"](
                header=self.header(direction["header"]["frame_id"]),
                vector=self._types["geometry_msgs/msg/Vector3"](**direction["vector"]),
            ),
            desired_distance=values["desired_distance"],
            min_distance=values["min_distance"],
        )
