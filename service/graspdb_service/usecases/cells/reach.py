"""Which grasps a robot's arm can take in a question: its reach, what it says where it takes none."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from graspdb.wire import BestGraspRequest, GraspJoints, LinkCollision, Obstacles, ReachRequest, RobotReach
from graspdb.wire.frames.gripper_frames import BASE, IDENTITY, compose, inverse
from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_density.search.lazy_search import DearTest
from graspdb_density.search.scored_poses import Maximum
from graspdb_geometry.grippers import shape_of
from graspdb_robots.arm import Floats
from graspdb_service.problems import conflict, invalid
from graspdb_service.usecases.cells.robots import PreparedRobot, Robots
from graspdb_service.usecases.cells.standing import StandingScene, boxes_of, matrices, pose_of
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.runtime.compute import breathe, breathing
from graspdb_service.usecases.trials.pose_frames import pose_frame
from graspdb_service.usecases.trials.selection import Selected

if TYPE_CHECKING:
    from graspdb_robots.reaching import ArmMotion, Reaching

#: Places for the robot that are looked at where it reaches nothing: so far off, metres, in so many
#: directions.
_AROUND_M, _DIRECTIONS = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3), 12
#: Grasps that an arm is tried with at each of them.
_FEW = 3


@dataclass(frozen=True, eq=False)
class RobotQuestion:
    """The reach of a robot in one question.

    ``stamp`` is another one whenever the robot or where its gripper is mounted is; ``warnings`` say what is
    not tested.
    """

    reaching: Reaching
    robot: PreparedRobot
    stamp: str
    warnings: tuple[str, ...]

    @property
    def test(self) -> DearTest:
        """The reach as a search asks for it."""
        reaching = self.reaching
        cost = None
        if reaching.cell.now is not None:
            cost = breathing(lambda poses: reaching.travel(matrices(poses)), "moving the arm")
        return DearTest(
            breathing(lambda poses: reaching.reaches(matrices(poses)), "testing the arm's reach"),
            lambda poses: reaching.likely(matrices(poses)),
            cost,
        )

    def taken(self, found: list[Maximum]) -> tuple[list[Maximum], list[ArmMotion]]:
        """Grasps as the arm takes them, each the twin that its joints lead to, and how."""
        grasps, motions = [], []
        for item in found:
            breathe()
            pose = Poses(item.position[None], item.quaternion_xyzw[None])
            motion = self.reaching.motion(matrices(pose)[0])
            if motion is None:
                continue
            quaternion = item.quaternion_xyzw
            if motion.twin:
                quaternion = se3.canonical(se3.jaw_twin(quaternion))
            grasps.append(
                Maximum(item.position, quaternion, item.log_density, item.active_constraints, item.score)
            )
            motions.append(motion)
        return grasps, motions

    def why_none(self, poses: Poses) -> tuple[int, RobotReach]:
        """Which of some grasps, the best first, the arm comes nearest to, and what keeps it from that."""
        from graspdb_robots.reaching import REASONS  # extra: robot

        grasps, found = matrices(poses), []
        for i, grasp in enumerate(grasps):
            breathe()
            met = self.reaching.obstruction(grasp)
            if met is not None:
                found.append((-REASONS.index(met.reason), met.off_m, i, met))
        if not found:
            return 0, RobotReach(reason="collision", tested=len(grasps))
        _, _, place, met = min(found, key=lambda item: item[:3])
        base = self._nearest_base(grasps)
        told = RobotReach(
            reason=met.reason,
            link=met.link,
            other=met.other,
            colliding=[LinkCollision(link=a, other=b) for a, b in self.reaching.colliding(met)],
            joints=None if met.joints is None else met.joints.tolist(),
            off_m=met.off_m,
            nearest_base_pose=None if base is None else pose_of(base),
            tested=len(grasps),
        )
        return place, told

    def _nearest_base(self, grasps: Floats) -> Floats | None:
        """The root's pose in the world, shifted along its x and y, from which a grasp can be taken."""
        from graspdb_robots.reaching import Reaching  # extra: robot

        for distance in _AROUND_M:
            for turn in np.arange(_DIRECTIONS) * 2 * math.pi / _DIRECTIONS:
                breathe()
                base = self.reaching.base.copy()
                base[:2, 3] += distance * np.array([math.cos(turn), math.sin(turn)])
                other = Reaching(self.reaching.cell, base)
                likely = grasps[other.likely(grasps)][:_FEW]
                if len(likely) and other.reaches(likely).any():
                    return base
        return None


def joints_of(motion: ArmMotion) -> dict[str, Any]:
    """What an answer says of how the arm takes a grasp."""

    def listed(joints: Floats | None) -> list[float] | None:
        return None if joints is None else joints.tolist()

    joints = GraspJoints(
        pregrasp=listed(motion.pregrasp), grasp=motion.grasp.tolist(), lift=listed(motion.lift)
    )
    return {
        "joints": joints,
        "joint_margin": motion.margin if math.isfinite(motion.margin) else None,
        "manipulability": motion.manipulability,
    }


def robot_question(
    robots: Robots,
    scenes: Scenes,
    request: BestGraspRequest | ReachRequest,
    selected: Selected,
    object_pose: Poses,
    scene: StandingScene | None,
) -> RobotQuestion:
    """The reach of the robot that a request names; 404 where there is none, 409 where its gripper is not
    known or not where on it the tool is, 422 for joints of another number.
    """
    assert request.robot is not None
    robot = robots.prepared(request.robot)
    # Heavy, and only of a service that has robots.
    from graspdb_robots.reaching import Reaching, RobotCell  # extra: robot

    profile = selected.profile
    if profile is None:
        raise conflict("gripper-unknown", "A robot's reach needs its gripper: name one (gripper=)")
    arm = robot.kinematics.arm
    now = request.joints_now
    if now is not None and len(now) != len(arm.joints):
        names = ", ".join(arm.joints)
        raise invalid("joints_now", f"has {len(now)} values and {request.robot!r} {len(arm.joints)}: {names}")
    in_tool = _flange_in_tool(robot, selected)
    at = matrices(Poses(object_pose.positions[None], object_pose.quaternions_xyzw[None]))[0]
    base = np.eye(4)
    if request.robot_base_pose is not None:
        values = np.array(request.robot_base_pose)
        base = matrices(Poses(values[None, :3], values[None, 3:]))[0]
    obstacles, points, radius, untold = _standing(robots, scenes, request, selected, at, scene)
    warnings = list(untold)
    if robot.info.untested:
        warnings.append(
            f"Links of {request.robot} not tested for collisions, for their shapes could not be read:"
            f" {', '.join(robot.info.untested)}; PUT the robot as a zip with its meshes"
        )
    cell = RobotCell(
        kinematics=robot.kinematics,
        shapes=robot.shapes,
        gripper=_gripper(request, selected, in_tool),
        flange_in_tool=in_tool,
        object_pose=at,
        obstacles=obstacles,
        points=points,
        point_radius_m=radius,
        distance_m=request.pregrasp_distance_m or 0.0,
        lift_m=request.lift_m or 0.0,
        symmetric=selected.jaw_symmetric,
        now=None if now is None else np.array(now),
    )
    mount = robot.info.gripper_mount
    stamp = f"{robot.info.sha256} {None if mount is None else mount.model_dump_json()}"
    return RobotQuestion(Reaching(cell, base), robot, stamp, tuple(warnings))


def _flange_in_tool(robot: PreparedRobot, selected: Selected) -> Floats:
    mount, profile = robot.info.gripper_mount, selected.profile
    named = "flange" if mount is None and profile is not None and "flange" in profile.frames else BASE
    pose = pose_frame(named, None, profile, selected.gripper).fixed or IDENTITY
    if named == BASE and mount is not None:
        pose = compose(pose, inverse(mount))
    found: Floats = matrices(Poses(np.array([pose.position]), np.array([pose.quaternion_xyzw])))[0]
    return found


def _gripper(
    request: BestGraspRequest | ReachRequest, selected: Selected, flange_in_tool: Floats
) -> tuple[Floats, ...]:
    """Corners of the gripper's boxes in the flange's frame; of a jaw that opens as each grasp needs the palm
    alone.
    """
    assert selected.profile is not None
    shape, asked = shape_of(selected.profile), request.pre_opening_m
    halves, centres = (shape.at(asked) if isinstance(asked, float) else shape).boxes()
    first = 2 if asked == "auto" else 0
    signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    back = np.linalg.inv(flange_in_tool)
    return tuple(
        (centre + signs * half) @ back[:3, :3].T + back[:3, 3]
        for half, centre in zip(halves[first:], centres[first:], strict=True)
    )


def _standing(
    robots: Robots,
    scenes: Scenes,
    request: BestGraspRequest | ReachRequest,
    selected: Selected,
    at: Floats,
    scene: StandingScene | None,
) -> tuple[tuple[Any, ...], Floats, float, list[str]]:
    """Obstacles in the world, points and their radius, and what is not tested."""
    from graspdb_robots.collision import Obstacle  # extra: robot

    found, points, radii, untold = [], [np.zeros((0, 3))], [0.0], []

    def add(given: Obstacles, name: str, frame: Floats) -> None:
        poses, sizes = boxes_of(given)
        for i, (pose, size) in enumerate(zip(poses, sizes, strict=True)):
            found.append(Obstacle(f"{name}.boxes.{i}", frame @ pose, size_m=size))
        if given.points:
            points.append(np.array(given.points) @ frame[:3, :3].T + frame[:3, 3])
            radii.append(given.point_radius_m)

    if request.obstacles is not None:
        add(request.obstacles, "obstacles", np.eye(4) if request.in_world else at)
    if scene is not None:
        add(scene.content, "scene", np.eye(4))
        for i, item in enumerate(scene.content.objects):
            shape = robots.mesh_shape(scene.rows[item.object], scenes)
            pose = np.array(item.pose)
            placed = matrices(Poses(pose[None, :3], pose[None, 3:]))[0]
            if shape is not None:
                found.append(Obstacle(f"scene.objects.{i}", placed, shape=shape))
    own = robots.mesh_shape(selected.row, scenes)
    if own is None:
        untold.append("The robot's links were not tested against the object, which has no mesh")
    else:
        found.append(Obstacle("object", at, shape=own, held=True))
    return tuple(found), np.concatenate(points), max(radii), untold
