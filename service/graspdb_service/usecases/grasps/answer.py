"""The best grasps under constraints: by density, by success probability, or by a mean under noise.

Before any success they are chosen by the prior of the object's edges, where geometry and gripper are known.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from graspdb.wire import (
    BestGraspRequest,
    BestGrasps,
    EstimatorInfo,
    Grasp,
    GraspConstraints,
    Interval,
    Pose,
    ReachInfo,
    WorldPose,
)
from graspdb.wire.base import Quadruple
from graspdb_density import Maximum, Separation, se3
from graspdb_service.usecases.cells import scenes
from graspdb_service.usecases.cells.reach import RobotQuestion, joints_of
from graspdb_service.usecases.densities.cache import kernel_of
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.densities.evidence import symmetries
from graspdb_service.usecases.densities.evidence.calibrations import doubts, of_simulation
from graspdb_service.usecases.densities.success_models import LEVEL, Estimates
from graspdb_service.usecases.densities.support import reach_info, support_of
from graspdb_service.usecases.grasps.conflict import Conflict, conflict_of
from graspdb_service.usecases.grasps.constraints import Constraints, constraints
from graspdb_service.usecases.grasps.likelihood import log_density
from graspdb_service.usecases.grasps.question import Question, asks_chance, question_of
from graspdb_service.usecases.grasps.search import ScoreSearch, closest
from graspdb_service.usecases.runtime.asked import outage, outage_warnings
from graspdb_service.usecases.trials.pose_frames import NO_TWINS, frame_of
from graspdb_service.usecases.trials.selection import Selected

_NEAREST_TRIALS = 5
#: Grasps that a robot is asked why it takes none of them.
_TRIED = 20
#: From here on an object's pose in the world is doubted, metres.
_FAR_M = 100.0


def best_grasps(
    ctx: Estimators, slug: str, request: GraspConstraints
) -> tuple[BestGrasps, Selected, tuple[str, ...]]:
    """The best distinct grasps under the request's constraints, the selection that they are of, and stamps of
    the robot and the scene that they depend on.

    422 names fields that contradict each other; 409 for what needs a mesh, a gripper or attempts that are not
    there, and as the selection.
    """
    choice, _ = kernel_of(request)
    request = of_simulation(request)
    with ctx.compute.within(request):
        selected = ctx.densities.selections.resolve(slug, request)
        frame = frame_of(selected, request.pose_frame, request.convention)
        scene = None
        if isinstance(request, BestGraspRequest) and request.scene is not None and request.object_pose:
            scene = scenes.standing(ctx.database, request.scene)
        limits = constraints(request, selected, frame, scene, ctx.scenes)
        built = ctx.densities.get(selected, choice)
        question = question_of(ctx, request, built, limits)
        answer: dict[str, Any] = {"status": "no_successes", "grasps": [], "kernel": built.kernel}
        if question is not None:
            answer = {
                "kernel": question.kernel,
                "ranking": question.ranking,
                "reach": reach_info(question.model),
                "calibration": question.calibration,
                "symmetry": question.symmetry,
                **_answer(ctx, request, question),
            }
    robot = None if question is None else question.robot
    near = request.near if selected.jaw_symmetric else None
    answer["grasps"] = [_as_asked(grasp, limits, near) for grasp in answer["grasps"]]
    if answer.get("nearest") is not None:
        answer["nearest"] = _as_asked(answer["nearest"], limits, near)
    told = {
        **frame.told(),
        "reference": "world" if limits.in_world else "object",
        "revision": built.revision,
        "estimator": _estimator(question),
        "selection": built.selection,
        "stale": outage() is not None,
        "warnings": [
            *outage_warnings(built.revision),
            *ctx.evidence.warnings(built),
            *doubts(None if question is None else question.calibration),
            *symmetries.doubts(None if question is None else question.symmetry),
            *frame.warnings,
            *_far_off(limits),
            *(() if robot is None else robot.warnings),
            *([NO_TWINS] if request.near is not None and near is None else []),
        ],
    }
    stamps = [*([] if robot is None else [robot.stamp]), *([] if scene is None else [scene.stamp])]
    return BestGrasps.model_validate({**told, **answer}), built.selected, tuple(stamps)


def _estimator(question: Question | None) -> EstimatorInfo:
    """Who told the success probabilities, or would have."""
    if question is None:
        return EstimatorInfo()
    told = EstimatorInfo() if question.model is None else question.model.estimator
    untried = question.untried
    return told if untried is None else told.model_copy(update={"prior": untried.info})


def _answer(ctx: Estimators, request: GraspConstraints, question: Question) -> dict[str, Any]:
    engine, bounds = question.engine, question.bounds
    found = ctx.compute.run(lambda: engine.best(bounds))
    if question.robot is not None:
        grasps = _taken(ctx, question, question.robot, found)
    else:
        grasps = _described(ctx, question, found)
    if grasps:
        return {"status": "ok" if len(grasps) >= bounds.count else "fewer", "grasps": grasps}
    out_of_reach = None if question.robot is None else _out_of_reach(ctx, question, question.robot)
    if out_of_reach is not None:
        return out_of_reach
    centres = question.search.centres
    poses = question.limits.candidates
    if poses is None:
        poses = centres.poses
    widths = Separation(centres.kernel.sigma_position_m, centres.kernel.sigma_rotation)
    nearest = _described(ctx, question, ctx.compute.run(lambda: closest(engine, bounds, poses, widths)))
    found_conflict = _conflict(ctx, request, question)
    return {
        "status": "infeasible",
        "grasps": [],
        "nearest": nearest[0] if nearest else None,
        "conflict": found_conflict.constraints,
        "relax": found_conflict.relax,
    }


def _taken(ctx: Estimators, question: Question, robot: RobotQuestion, found: list[Maximum]) -> list[Grasp]:
    """Grasps as the robot takes them, with its joints."""
    taken, motions = ctx.compute.run(lambda: robot.taken(found))
    grasps = _described(ctx, question, taken)
    return [grasp.model_copy(update=joints_of(motion)) for grasp, motion in zip(grasps, motions, strict=True)]


def _out_of_reach(ctx: Estimators, question: Question, robot: RobotQuestion) -> dict[str, Any] | None:
    """The answer where it is the robot that takes no grasp, and why; None where there is none to take."""
    anyones = question.bounds.whoever_takes(_TRIED)
    found = ctx.compute.run(lambda: question.engine.best(anyones))
    if not found:
        return None
    poses = se3.Poses(
        np.array([item.position for item in found]), np.array([item.quaternion_xyzw for item in found])
    )
    place, why = ctx.compute.run(lambda: robot.why_none(poses))
    nearest = _described(ctx, question, found[place : place + 1])[0]
    return {"status": "infeasible", "grasps": [], "nearest": nearest, "conflict": ["robot"], "reach": why}


def _conflict(ctx: Estimators, request: GraspConstraints, question: Question) -> Conflict:
    """Which constraints exclude each other, as grasps are ranked by what noise averages."""
    averaged = question.ranking.robust_of or question.ranking.objective
    plain = dict.fromkeys(("robust_of", "pose_noise_m", "pose_noise_deg", "tool_noise_m", "tool_noise_deg"))
    if isinstance(request, BestGraspRequest):
        # Whether there is a grasp that no robot takes is known by now.
        plain |= dict.fromkeys(("object_belief", "robot", "robot_base_pose", "joints_now", "lift_m"))
    by_chance = asks_chance(request)
    chances = ("success_probability", "effective_trials") if by_chance else ("density",)
    asked = request.model_copy(update={**plain, "count": 1, "objective": averaged, "include": list(chances)})
    built = question.built

    def ask(request: GraspConstraints) -> Grasp | None:
        limits = constraints(
            request, built.selected, question.limits.frame, question.limits.scene, ctx.scenes
        )
        other = question_of(ctx, request, built, limits)
        if other is None:
            return None
        engine = other.engine
        if limits.candidates is None and not by_chance:
            # Whether there is a grasp does not depend on what ranks it, and the density is found fastest.
            engine = ScoreSearch(other.wide, ctx.compute.threads)
        found = ctx.compute.run(lambda: engine.best(other.bounds))
        return next(iter(_described(ctx, other, found)), None)

    return conflict_of(asked, ask, collisions_known=question.test is not None)


def _described(ctx: Estimators, question: Question, found: list[Maximum]) -> list[Grasp]:
    """What is known of grasps that a search found."""
    if not found:
        return []
    limits, test, built, threads = question.limits, question.test, question.built, ctx.compute.threads
    poses = se3.Poses(
        np.array([item.position for item in found]), np.array([item.quaternion_xyzw for item in found])
    )
    logs = np.array([item.log_density for item in found])
    if question.wide is not question.search:
        # Of the density of the successes alone, whatever was looked through.
        logs = log_density(ctx, question.search.density, poses, None)

    def known() -> tuple[Any, Any, Any, list[list[int]], Any]:
        """Whether they are free, how far open the jaw comes and is on the object, the sequence numbers of the
        nearest successes.
        """
        free = None if test is None else test.free(poses, threads=threads)
        openings = question.openings(poses, threads)
        widths = None if test is None else test.widths(poses, threads=threads)
        nearest: list[list[int]] = [[] for _ in found]
        if not question.prior:
            rows = (
                question.search.centres.nearest_rows(poses[i], _NEAREST_TRIALS) for i in range(len(poses))
            )
            nearest = [built.seq[row].tolist() for row in rows]
        return free, openings, widths, nearest, question.search.relative(logs, threads)

    free, openings, widths, nearest, relative = ctx.compute.run(known)
    estimates = None
    if question.chances:
        clear = None if question.believed is None else free
        estimates = ctx.successes.estimate(question.model, poses, clear)
        if question.untried is not None:
            estimates.prior[:] = question.untried.told(poses, ~estimates.enough, free, question.model)
    reach, grasps = reach_info(question.model), []
    for i, item in enumerate(found):
        density = math.exp(logs[i])
        grasps.append(
            Grasp.model_validate(
                {
                    "position": tuple(item.position.tolist()),
                    "quaternion_xyzw": tuple(item.quaternion_xyzw.tolist()),
                    "world": _world(limits, se3.Poses(item.position, item.quaternion_xyzw)),
                    "score": density if question.ranking.objective == "density" else item.score,
                    "density": density,
                    "log_density": float(logs[i]),
                    "relative": float(relative[i]),
                    **({} if estimates is None else _chances(estimates, i, reach)),
                    "collision_free": None if free is None else bool(free[i]),
                    "prior": question.prior,
                    "candidate": _place(limits, item),
                    "width_m": None if widths is None or math.isnan(widths[i]) else float(widths[i]),
                    "opening_m": None if openings is None else float(openings[i]),
                    "nearest_trials": nearest[i],
                    "active_constraints": limits.named(item.active_constraints),
                }
            )
        )
    return grasps


def _chances(estimates: Estimates, row: int, reach: ReachInfo | None) -> dict[str, Any]:
    """How likely one of the grasps succeeds, and what that rests on."""
    support = support_of(estimates, row, reach)
    chances: dict[str, Any] = {"effective_trials": support.effective_trials, "support": support}
    if math.isfinite(estimates.probability[row]):
        low, high = float(estimates.low[row]), float(estimates.high[row])
        chances["success_probability"] = float(estimates.probability[row])
        chances["interval"] = Interval(level=LEVEL, low=low, high=high)
    if math.isfinite(estimates.prior[row]):
        chances["prior_success_probability"] = float(estimates.prior[row])
    return chances


def _far_off(limits: Constraints) -> list[str]:
    """That the object lies where none does, which is most often a pose in millimetres."""
    off = 0.0 if limits.object_pose is None else float(np.linalg.norm(limits.object_pose.positions))
    if off < _FAR_M:
        return []
    return [
        f"By object_pose the object lies {off:,.0f} m from the world's origin: positions are in metres, so"
        " divide millimetres by 1,000"
    ]


def _world(limits: Constraints, pose: se3.Poses) -> WorldPose | None:
    """One pose in the object frame as one in the world, where the object's pose is known."""
    if limits.object_pose is None:
        return None
    p, q = se3.compose(limits.object_pose, pose)
    q = se3.canonical(se3.normalise(q))
    return WorldPose(position=tuple(p.tolist()), quaternion_xyzw=tuple(q.tolist()))


def _as_asked(grasp: Grasp, limits: Constraints, near: Quadruple | None) -> Grasp:
    """A grasp of the tool as one of the frame that was asked for, the twin that is nearer to a rotation of
    that frame in the reference.
    """
    frame = limits.frame
    if frame.fixed is None and near is None:
        return grasp
    quaternions = [np.array(grasp.quaternion_xyzw)]
    if near is not None:
        quaternions.append(se3.canonical(se3.jaw_twin(quaternions[0])))
    twins = []
    for quaternion in quaternions:
        tool = Pose.model_construct(position=grasp.position, quaternion_xyzw=tuple(quaternion.tolist()))
        pose = frame.one_from_tool(tool)
        rotation = se3.canonical(np.array(pose.quaternion_xyzw))
        world = _world(limits, se3.Poses(np.array(pose.position), rotation))
        said = world.quaternion_xyzw if limits.in_world and world is not None else rotation
        away = 0.0 if near is None else float(se3.angle_between(np.array(said), np.array(near)))
        twins.append((away, pose.position, tuple(rotation.tolist()), world))
    _, position, rotation_found, world = min(twins, key=lambda twin: twin[0])
    given = {"position": position, "quaternion_xyzw": rotation_found, "world": world}
    return grasp.model_copy(update=given)


def _place(limits: Constraints, item: Maximum) -> int | None:
    """The place of a grasp among the candidates."""
    if limits.candidates is None:
        return None
    apart = np.linalg.norm(limits.candidates.positions - item.position, axis=1)
    apart += se3.angle_between(limits.candidates.quaternions_xyzw, item.quaternion_xyzw)
    return int(np.argmin(apart))
