"""The example for ROS 2: what it makes of answers, with the message types of rosbags; the node compiles."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from graspdb.wire import GraspJoints

FOLDER = Path(__file__).parents[2] / "clients/ros2"
STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types


@pytest.fixture(scope="module")
def conversion() -> ModuleType:
    path = FOLDER / "graspdb_ros/graspdb_ros/conversion.py"
    spec = importlib.util.spec_from_file_location("conversion", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def grasp(turn: Any, *, score: float = 2.0, joints: GraspJoints | None = None) -> SimpleNamespace:
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = turn.as_matrix(), [0.4, 0.1, 0.3]
    return SimpleNamespace(world=world, score=score, success_probability=None, joints=joints)


def sent(message: Any) -> Any:
    """A message as it comes out at the other end."""
    name = message.__msgtype__
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, name), name)


def test_the_sources_compile() -> None:
    for path in FOLDER.rglob("*.py"):
        compile(path.read_text(), str(path), "exec")


@pytest.mark.parametrize("seed", range(8))
def test_a_grasp_s_pose_is_that_of_its_message(conversion: ModuleType, seed: int) -> None:
    turn = Rotation.random(random_state=seed)
    head = conversion.header(TYPES, "world")
    message = sent(conversion.pose_stamped(TYPES, grasp(turn).world, head))
    assert message.header.frame_id == "world"
    at, said = message.pose.position, message.pose.orientation
    assert (at.x, at.y, at.z) == (0.4, 0.1, 0.3)
    assert (Rotation.from_quat([said.x, said.y, said.z, said.w]) * turn.inv()).magnitude() < 1e-9


def test_joints_become_positions_in_order(conversion: ModuleType) -> None:
    joints = GraspJoints(pregrasp=[0.1, 0.2], grasp=[0.3, 0.4])
    head = conversion.header(TYPES, "world")
    fields = conversion.best_grasp(TYPES, [grasp(Rotation.identity(), joints=joints)], ["a", "b"], head)
    message = sent(fields["joints"][0])
    assert message.joint_names == ["a", "b"]
    assert [list(point.positions) for point in message.points] == [[0.1, 0.2], [0.3, 0.4]]
    assert (fields["success"], fields["scores"]) == (True, [2.0])
    assert math.isnan(fields["success_probabilities"][0])


def test_costs_of_candidates_rise_from_nothing(conversion: ModuleType) -> None:
    some = [grasp(Rotation.identity(), score=score) for score in (2.0, 1.0)]
    fields = conversion.grasp_candidates(TYPES, some, conversion.header(TYPES, "world"))
    assert fields["costs"] == [0.0, pytest.approx(math.log(2))]
    assert len(fields["grasp_candidates"]) == 2


def test_a_covariance_of_zeros_is_none(conversion: ModuleType) -> None:
    point, turn = TYPES["geometry_msgs/msg/Point"](1.0, 2.0, 3.0), TYPES["geometry_msgs/msg/Quaternion"]
    pose = TYPES["geometry_msgs/msg/Pose"](point, turn(0.0, 0.0, 0.0, 1.0))
    seen = TYPES["geometry_msgs/msg/PoseWithCovariance"]
    assert conversion.object_pose(sent(seen(pose, np.zeros(36)))) == [1, 2, 3, 0, 0, 0, 1]
    doubtful = conversion.object_pose(sent(seen(pose, np.eye(6).ravel() * 1e-4)))
    assert doubtful["mean"] == [1, 2, 3, 0, 0, 0, 1]
    assert np.allclose(doubtful["covariance"], np.eye(6) * 1e-4)


def test_joint_states_are_put_into_the_robots_order(conversion: ModuleType) -> None:
    none = np.zeros(0)
    state = TYPES["sensor_msgs/msg/JointState"]
    message = sent(
        state(conversion.header(TYPES, ""), ["b", "finger", "a"], np.array([2.0, 0.0, 1.0]), none, none)
    )
    assert conversion.joints_now(message, ["a", "b"]) == [1.0, 2.0]
    assert conversion.joints_now(message, ["a", "c"]) is None
