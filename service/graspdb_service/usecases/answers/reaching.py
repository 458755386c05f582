"""The map of a robot's reach about an object."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from graspdb.wire import ReachMap, ReachRequest
from graspdb_density.se3 import Poses
from graspdb_service.usecases.cells import scenes
from graspdb_service.usecases.cells.reach import RobotQuestion, robot_question
from graspdb_service.usecases.cells.standing import matrices
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.runtime.compute import breathe

if TYPE_CHECKING:
    from graspdb_robots.reaching import Reason


def reach_map(ctx: Estimators, slug: str, request: ReachRequest) -> ReachMap:
    """Which poses the arm takes where it stands, and how many of them from other places.

    404 for a robot or scene that is not there, 409 where the gripper is not known or not where on it the tool
    is, 503 ``deadline`` where it takes too long.
    """
    with ctx.compute.within(request):
        selected = ctx.densities.selections.resolve(slug, request)
        scene = None if request.scene is None else scenes.standing(ctx.database, request.scene)
        at = np.array(request.object_pose)
        question = robot_question(ctx.robots, ctx.scenes, request, selected, Poses(at[:3], at[3:]), scene)
        bases = np.array(request.bases, dtype=np.float64).reshape(-1, 7)
        return ctx.compute.run(lambda: _map(question, _poses(request), Poses(bases[:, :3], bases[:, 3:])))


def _map(question: RobotQuestion, poses: Poses, bases: Poses) -> ReachMap:
    # Heavy, and only of a service that has robots.
    from graspdb_robots.reaching import Reaching  # extra: robot

    grasps, reaching = matrices(poses), question.reaching
    reached, reasons, shares = list[bool](), list["Reason | None"](), list[float]()
    for grasp in grasps:
        breathe()
        met = None if reaching.reaches(grasp[None])[0] else reaching.obstruction(grasp)
        reached.append(met is None)
        reasons.append(None if met is None else met.reason)
    for base in matrices(bases):
        other, taken = Reaching(reaching.cell, base), 0
        for grasp in grasps:
            breathe()
            taken += bool(other.reaches(grasp[None])[0])
        shares.append(taken / len(grasps))
    return ReachMap(reached=reached, reason=reasons, base_share=shares, warnings=list(question.warnings))


def _poses(request: ReachRequest) -> Poses:
    if isinstance(request.poses, list):
        rows = np.array([(*pose.position, *pose.quaternion_xyzw) for pose in request.poses])
        return Poses(rows[:, :3], rows[:, 3:])
    return Poses(np.array(request.poses.position), np.array(request.poses.quaternion_xyzw))
