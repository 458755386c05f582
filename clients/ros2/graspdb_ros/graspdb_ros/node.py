"""A node that offers GraspDB's best grasps: the service ``best_grasp`` and the action ``sample_grasps``.

An example, which has not been run: see the README beside it.
"""

from __future__ import annotations

from typing import Any

import rclpy
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Pose, PoseStamped, PoseWithCovarianceStamped, Quaternion
from graspdb_interfaces.srv import BestGrasp
from moveit_task_constructor_msgs.action import SampleGraspPoses
from rclpy.action import ActionServer
from rclpy.node import Node
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from graspdb import Client
from graspdb.errors import GraspDBError
from graspdb_ros import conversion

TYPES = {
    f"{package}/msg/{kind.__name__}": kind
    for package, kinds in {
        "builtin_interfaces": (Duration, Time),
        "geometry_msgs": (Point, Pose, PoseStamped, Quaternion),
        "std_msgs": (Header,),
        "trajectory_msgs": (JointTrajectory, JointTrajectoryPoint),
    }.items()
    for kind in kinds
}


class Grasps(Node):
    """Asks GraspDB for whoever asks in ROS."""

    def __init__(self) -> None:
        super().__init__("graspdb")
        texts = {"url": "http://127.0.0.1:8000", "robot": "", "scene": "", "gripper": "", "frame": "tool"}
        texts |= {"object": "", "object_pose_topic": "object_pose"}
        for name, default in texts.items():
            self.declare_parameter(name, default)
        self.declare_parameter("count", 10)
        self.declare_parameter("pregrasp_distance_m", 0.08)
        self.declare_parameter("lift_m", 0.1)
        self._db = Client(self._said("url"))
        robot = self._said("robot")
        self._names = [joint.name for joint in self._db.robots.get(robot).joints] if robot else []
        self._seen: PoseWithCovarianceStamped | None = None
        self.create_subscription(PoseWithCovarianceStamped, self._said("object_pose_topic"), self._see, 1)
        self.create_service(BestGrasp, "best_grasp", self._answer)
        self._action = ActionServer(self, SampleGraspPoses, "sample_grasps", self._sample)

    def _said(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _see(self, message: PoseWithCovarianceStamped) -> None:
        self._seen = message

    def _ask(self, object: str, pose: Any, count: int, **more: Any) -> Any:
        """The best grasps; GraspDBError where there are none."""
        chosen = {name: self._said(name) or None for name in ("robot", "scene", "gripper")}
        return self._db.objects.get(object).best_grasps(
            count=count,
            object_pose=conversion.object_pose(pose),
            frame=self._said("frame"),
            **{name: value for name, value in {**chosen, **more}.items() if value},
        )

    def _answer(self, request: BestGrasp.Request, response: BestGrasp.Response) -> BestGrasp.Response:
        ways = {"pregrasp_distance_m": request.pregrasp_distance_m}
        if self._names:
            ways["lift_m"] = request.lift_m
            ways["joints_now"] = conversion.joints_now(request.joints_now, self._names)
        try:
            grasps = self._ask(request.object, request.object_pose.pose, request.count or 1, **ways)
        except (GraspDBError, ValueError) as error:
            response.success, response.message = False, str(error)
            return response
        head = conversion.header(TYPES, request.object_pose.header.frame_id)
        for name, value in conversion.best_grasp(TYPES, grasps, self._names, head).items():
            setattr(response, name, value)
        return response

    def _sample(self, goal: Any) -> SampleGraspPoses.Result:
        """Candidates of the object of the parameter, where it was seen last."""
        result = SampleGraspPoses.Result()
        if self._seen is None:
            self.get_logger().error("no object pose was seen yet")
            result.grasp_state = "failed"
            goal.abort()
            return result
        ways = {"pregrasp_distance_m": self._said("pregrasp_distance_m")}
        if self._names:
            ways["lift_m"] = self._said("lift_m")
        try:
            grasps = self._ask(self._said("object"), self._seen.pose, self._said("count"), **ways)
        except (GraspDBError, ValueError) as error:
            self.get_logger().error(str(error))
            result.grasp_state = "failed"
            goal.abort()
            return result
        head = conversion.header(TYPES, self._seen.header.frame_id)
        goal.publish_feedback(SampleGraspPoses.Feedback(**conversion.grasp_candidates(TYPES, grasps, head)))
        result.grasp_state = "success"
        goal.succeed()
        return result


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    node = Grasps()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
