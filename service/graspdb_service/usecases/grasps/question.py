"""The best grasps under constraints: by density, by success probability, or by a mean under noise.

Before any success they are chosen by the prior of the object's edges, where geometry and gripper are known.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from graspdb.wire import BestGrasps, Grasp, GraspConstraints, Interval, KernelInfo, Ranking, WorldPose
from graspdb_density import (
    GraspDensity,
    Maximum,
    MixtureDensity,
    ModeSearch,
    PoseNoise,
    SuccessModel,
    expected,
    se3,
)
from graspdb_density.search.scored_poses import Score
from graspdb_service.problems import conflict
from graspdb_service.usecases.densities.cache import Built, KernelChoice, kernel_of
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.densities.prior import Prior
from graspdb_service.usecases.densities.success_models import LEVEL
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.grasps import search
from graspdb_service.usecases.grasps.constraints import Constraints, constraints
from graspdb_service.usecases.grasps.search import Bools, Floats, Question
from graspdb_service.usecases.trials.selection import Filters

_NEAREST_TRIALS = 5
#: Up to so many attempts a model of success probability is built at once; above, it must be asked for.
FEW_ATTEMPTS = 500_000
#: Draws of the noise that a mean is taken over, and while searching.
_NOISE_DRAWS, _FEW_DRAWS = 256, 16
_CHANCES = frozenset({"success_probability", "interval", "effective_trials"})


def best_grasps(ctx: Estimators, slug: str, request: GraspConstraints) -> tuple[BestGrasps, int]:
    """The best distinct grasps under the request's constraints, and the object's internal id.

    422 names fields that contradict each other; 409 what needs a mesh, a gripper or attempts.
    """
    choice, _ = kernel_of(request)
    constraints(request)
    with ctx.compute.admitted():
        built = ctx.densities.get(slug, Filters.of(request), choice)
        prior = None if built.density is not None else _prior(ctx, request, built, choice)
        kernel = built.kernel if prior is None else prior.kernel
        question = _question(ctx, slug, request, built, built.search if prior is None else prior.search)
        if question is None:
            return _answer(built, built.kernel, "no_successes", []), built.object_row.id
        ranking = question.ranking
        found = ctx.compute.run(lambda: search.found(question))
        if found:
            grasps = _described(ctx, question, found)
            status = "ok" if len(grasps) >= request.count else "fewer"
            return _answer(built, kernel, status, grasps, ranking=ranking), built.object_row.id
        closest = ctx.compute.run(lambda: search.closest(question))
        nearest = _described(ctx, question, closest)
        return _answer(built, kernel, "infeasible", [], *nearest, ranking=ranking), built.object_row.id


def _prior(ctx: Estimators, request: GraspConstraints, built: Built, choice: KernelChoice) -> Prior | None:
    """What to choose from before any success, where it may be and can be known."""
    if request.prior is False or choice.stored is not None:
        return None
    get = ctx.priors.get if request.prior else ctx.priors.known
    return get(built.object_row, built.selected, choice)


def _answer(
    built: Built,
    kernel: KernelInfo,
    status: str,
    grasps: list[Grasp],
    nearest: Grasp | None = None,
    *,
    ranking: Ranking | None = None,
) -> BestGrasps:
    return BestGrasps.model_validate(
        {
            "status": status,
            "grasps": grasps,
            "nearest": nearest,
            "ranking": ranking,
            "revision": built.revision,
            "kernel": kernel,
        }
    )


# -- what is asked -----------------------------------------------------------------------------------------


def _question(
    ctx: Estimators, slug: str, request: GraspConstraints, built: Built, modes: ModeSearch | None
) -> Question | None:
    """A question about a density; None where there is nothing to choose from.

    Before any success the search is in the prior, and ``built`` has none.
    """
    limits = constraints(request, jaw_symmetric=built.selected.jaw_symmetric)
    needed = request.collision_free or request.pregrasp_distance_m is not None or request.max_width_m
    if needed:
        test: CollisionTest | None = ctx.scenes.require(built.object_row, built.selected)
    else:
        test = ctx.scenes.test(built.object_row, built.selected)
    if limits.obstacles and built.selected.profile is None:
        raise conflict("gripper-unknown", "Obstacles need the gripper's shape: name one (gripper=)")
    if modes is None:
        return None
    model, chances = None, _wants_chances(request, built)
    if chances:
        model = ctx.successes.model(slug, built, collisions_known=test is not None)
    averaged = request.robust_of or ("density" if model is None else "success_probability")
    of_chances = request.objective == "success_probability" or (
        request.objective == "robust" and averaged == "success_probability"
    )
    if of_chances and model is None and built.density is None:
        # Nothing was tried: no chance ranks what no trial tells of.
        return None
    if of_chances and model is None:
        raise conflict(
            "no-attempts",
            "Only successes are known, so no success probability: post failures, too, or rank by the density",
        )
    question = Question(
        request=request,
        built=built,
        search=modes,
        limits=limits,
        test=test,
        chances=chances,
        model=model,
        admissible=None,
        ranking=Ranking(objective=request.objective, score="density, 1/(m^3 rad^3)"),
        score=None,
        of_chances=of_chances,
        quick=None,
        threads=ctx.compute.threads,
    )
    return ctx.compute.run(lambda: _with_score(question, averaged))


def _with_score(question: Question, averaged: str) -> Question:
    """A question with what ranks poses, and what refuses them."""
    question = replace(question, admissible=search.admissible_for(question))
    if question.built.density is None:
        question = _holding(question)
    if question.request.objective == "robust":
        return _robust(question, averaged)
    if question.of_chances:
        model = question.model
        assert model is not None
        told = f"lower end of the success probability's {LEVEL:.0%} interval"
        ranking = Ranking(objective="success_probability", score=told)
        score = _chances(question, model.whole, "low")
        quick = score if model.quick is model.whole else _chances(question, model.quick, "low")
        return replace(question, ranking=ranking, score=score, quick=quick)
    return question


def _holding(question: Question) -> Question:
    """A question about a prior: between the grasps on its pairs lie others that hold nothing."""
    admissible, test, threads = question.admissible, question.test, question.threads
    assert test is not None

    def holds(positions: Floats, quaternions: Floats) -> Bools:
        allowed = test.holds(positions, quaternions, threads)
        if admissible is not None and allowed.any():
            allowed[allowed] = admissible(positions[allowed], quaternions[allowed])
        return allowed

    return replace(question, admissible=holds)


def _wants_chances(request: GraspConstraints, built: Built) -> bool:
    """Whether grasps come with a success probability; the same for the same request and revision."""
    if request.objective == "success_probability":
        return True
    if request.objective == "robust" and request.robust_of != "density":
        return True
    if request.include is not None:
        return not _CHANCES.isdisjoint(request.include)
    return sum(built.selected.outcomes.values()) <= FEW_ATTEMPTS


def _robust(question: Question, averaged: str) -> Question:
    request = question.request
    told: dict[str, str] = {}
    noises: dict[str, PoseNoise] = {}
    pivot, named = _pivot(question)
    told_as = {
        "pose_noise": f"the object about {named}, on the left",
        "tool_noise": "the tool, on the right",
    }
    for name in told_as:
        metres = getattr(request, f"{name}_m") or 0.0
        degrees = getattr(request, f"{name}_deg") or 0.0
        noises[name] = PoseNoise(metres, math.radians(degrees), pivot if name == "pose_noise" else (0.0,) * 3)
        if metres or degrees:
            told[name] = f"{1000 * metres:g} mm and {degrees:g} degrees per axis, of {told_as[name]}"
    if averaged == "success_probability":
        assert question.model is not None
        value = _chances(question, question.model.quick, "probability")
    else:
        value, noises = _widened(question, noises)
    if any(noise.sigma_position_m or noise.sigma_rotation for noise in noises.values()):
        score, quick = (
            expected(value, object_noise=noises["pose_noise"], tool_noise=noises["tool_noise"], samples=draws)
            for draws in (_NOISE_DRAWS, _FEW_DRAWS)
        )
    else:
        score = quick = value
    unit = ", 1/(m^3 rad^3)" if averaged == "density" else ""
    ranking = Ranking.model_validate(
        {
            "objective": "robust",
            "score": f"mean {averaged.replace('_', ' ')} under the noise{unit}",
            "robust_of": averaged,
            **told,
        }
    )
    return replace(question, ranking=ranking, score=score, quick=quick)


def _widened(question: Question, noises: dict[str, PoseNoise]) -> tuple[Score, dict[str, PoseNoise]]:
    """A density under a kernel that is wider by the noise, and the noise that is left to draw.

    An isotropic kernel takes all noise of the tool and the object's shifts; the object's turns move a grasp
    the farther the longer its lever, which no one kernel does.
    """
    density, at_object, at_tool = question.asked, noises["pose_noise"], noises["tool_noise"]
    if isinstance(density, MixtureDensity):
        return lambda p, q: density.density(se3.Poses(p, q)), noises
    shift = math.hypot(at_object.sigma_position_m, at_tool.sigma_position_m)
    wider = GraspDensity.build(
        density.poses,
        kernel=density.kernel.widened(shift, at_tool.sigma_rotation),
        weights=density.weights,
        symmetric=density.symmetric,
    )
    left = {
        "pose_noise": replace(at_object, sigma_position_m=0.0),
        "tool_noise": replace(at_tool, sigma_position_m=0.0, sigma_rotation=0.0),
    }
    return lambda p, q: wider.density(se3.Poses(p, q)), left


def _pivot(question: Question) -> tuple[tuple[float, float, float], str]:
    """What the object turns about: its bounding box's centre, object frame."""
    info = question.built.object_row.mesh_info
    if info is not None:
        corners = np.array([info["bounding_box"]["lower"], info["bounding_box"]["upper"]])
        named = "its bounding box's centre"
    else:
        positions = question.density.positions
        corners = np.array([positions.min(axis=0), positions.max(axis=0)])
        named = "the centre of the successes' bounding box, for there is no mesh"
    x, y, z = (float(value) for value in corners.mean(axis=0))
    return (x, y, z), named


def _chances(question: Question, model: SuccessModel, column: Literal["low", "probability"]) -> Score:
    """A column of the success probability as a score: 0 where the open gripper collides."""
    test, threads = question.test, question.threads

    def score(positions: Floats, quaternions: Floats) -> Floats:
        values = np.zeros(len(positions))
        index = np.arange(len(positions))
        if test is not None:
            index = np.flatnonzero(test.free(positions, quaternions, threads=threads))
        if not len(index):
            return values
        p, q = positions[index], quaternions[index]
        if column == "low":
            values[index] = model.lower_end(p, q, level=LEVEL, threads=threads)
        else:
            values[index] = model.probability(p, q, threads=threads)
        return values

    return score


# -- what is said of a grasp -------------------------------------------------------------------------------


def _described(ctx: Estimators, question: Question, found: list[Maximum]) -> list[Grasp]:
    """What is known of grasps that a search found."""
    if not found:
        return []
    density, limits, test = question.density, question.limits, question.test
    prior = question.built.density is None
    positions = np.array([item.position for item in found])
    quaternions = np.array([item.quaternion_xyzw for item in found])

    def known() -> tuple[Bools | None, Floats | None, list[list[int]], Floats]:
        free = None if test is None else test.free(positions, quaternions, threads=question.threads)
        widths = None if test is None else test.widths(positions, quaternions, threads=question.threads)
        nearest = [
            [] if prior else _nearest_trials(question.built, density, p, q)
            for p, q in zip(positions, quaternions, strict=True)
        ]
        logs = np.array([item.log_density for item in found])
        return free, widths, nearest, question.search.relative(logs, question.threads)

    free, widths, nearest, relative = ctx.compute.run(known)
    estimates = None
    if question.chances:
        estimates = ctx.successes.under(question.model, positions, quaternions, free)
    grasps = []
    for i, item in enumerate(found):
        world = limits.to_world(item.position, item.quaternion_xyzw)
        chances: dict[str, object] = {}
        if estimates is not None:
            chances["effective_trials"] = float(estimates.effective_trials[i])
        if estimates is not None and math.isfinite(estimates.probability[i]):
            low, high = float(estimates.low[i]), float(estimates.high[i])
            chances["success_probability"] = float(estimates.probability[i])
            chances["interval"] = Interval(level=LEVEL, low=low, high=high)
        measured = None if widths is None or math.isnan(widths[i]) else float(widths[i])
        grasps.append(
            Grasp.model_validate(
                {
                    "position": tuple(item.position.tolist()),
                    "quaternion_xyzw": tuple(item.quaternion_xyzw.tolist()),
                    "world": None
                    if world is None
                    else WorldPose(
                        position=tuple(world[0].tolist()), quaternion_xyzw=tuple(world[1].tolist())
                    ),
                    "score": math.exp(item.log_density) if question.score is None else item.score,
                    "density": math.exp(item.log_density),
                    "log_density": item.log_density,
                    "relative": float(relative[i]),
                    **chances,
                    "collision_free": None if free is None else bool(free[i]),
                    "prior": prior,
                    "candidate": _place(limits, item),
                    "width_m": measured,
                    "nearest_trials": nearest[i],
                    "active_constraints": limits.named(item.active_constraints),
                }
            )
        )
    return grasps


def _place(limits: Constraints, item: Maximum) -> int | None:
    """The place of a grasp among the candidates."""
    if limits.candidates is None:
        return None
    apart = np.linalg.norm(limits.candidates[0] - item.position, axis=1)
    apart += se3.angle_between(limits.candidates[1], item.quaternion_xyzw)
    return int(np.argmin(apart))


def _nearest_trials(built: Built, density: GraspDensity, position: Floats, quaternion: Floats) -> list[int]:
    """Sequence numbers of the successes nearest to a pose in the kernel's own measure."""
    rows = density.nearest_rows(se3.Poses(position, quaternion), _NEAREST_TRIALS)
    return [int(seq) for seq in built.seq[rows]]
