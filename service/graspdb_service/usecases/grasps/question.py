"""The question for the best grasps, complete: about which density, within which bounds, by which engine."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from graspdb.wire import (
    BestGraspRequest,
    CalibrationInfo,
    GraspConstraints,
    KernelInfo,
    Ranking,
    SymmetryInfo,
)
from graspdb.wire.queries import PreOpening
from graspdb_density import ModeSearch, Separation
from graspdb_density.se3 import Poses
from graspdb_density.search.mode_search import DISTINCT
from graspdb_density.search.scored_poses import Admissible, distinct_from
from graspdb_geometry.grippers import shape_of
from graspdb_service.problems import conflict
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.cells.reach import RobotQuestion, robot_question
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.cache import kernel_of
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.densities.evidence.calibrations import calibrated
from graspdb_service.usecases.densities.learned.learning import Model
from graspdb_service.usecases.densities.prior import Prior
from graspdb_service.usecases.densities.untried import UntriedChance
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.grasps import objectives
from graspdb_service.usecases.grasps.admissible import NearSuccesses, all_of, clear_of, likely_enough
from graspdb_service.usecases.grasps.constraints import Constraints
from graspdb_service.usecases.grasps.likelihood import CHANCES
from graspdb_service.usecases.grasps.search import Bounds, CandidateRanking, Engine, ScoreSearch
from graspdb_service.usecases.trials.selection import Selected

#: Up to so many attempts a model of success probability is built at once; above, it must be asked for.
FEW_ATTEMPTS = 500_000


@dataclass(frozen=True, eq=False)
class Question:
    """A request about one density, everything looked up.

    ``test`` says what collides, ``believed`` the same where success probabilities may rest on it. ``search``
    and ``kernel`` are of the density of successes, or before any of the prior of the object's edges;
    ``wide`` is where grasps are looked for: ``search``, or where symmetries take the successes, too.
    ``chances``: whether grasps are told with their success probability, by ``model`` if there is one, and
    ``untried`` where it does not tell.
    """

    built: Built
    search: ModeSearch
    wide: ModeSearch
    kernel: KernelInfo
    limits: Constraints
    test: CollisionTest | None
    believed: CollisionTest | None
    chances: bool
    model: Model | None
    untried: UntriedChance | None
    bounds: Bounds
    engine: Engine
    ranking: Ranking
    calibration: CalibrationInfo | None
    symmetry: SymmetryInfo | None
    pre_opening_m: PreOpening
    robot: RobotQuestion | None = None

    @property
    def prior(self) -> bool:
        return self.built.search is None

    def openings(self, poses: Poses, threads: int) -> Floats | None:
        """How far open the jaw comes to poses (n,), metres; None where no gripper is known."""
        if self.test is not None:
            return self.test.openings(poses, threads)
        profile, asked = self.built.selected.profile, self.pre_opening_m
        if profile is None:
            return None
        return np.full(len(poses), asked if isinstance(asked, float) else profile.max_opening_m)


def question_of(
    ctx: Estimators, request: GraspConstraints, built: Built, limits: Constraints
) -> Question | None:
    """What a request asks of a density; None where there is nothing to choose from; 409 for what needs a
    mesh, a gripper or attempts that are not there.
    """
    source = _prior(ctx, request, built) if built.search is None else built
    row, selected = built.object_row, built.selected
    needed = request.collision_free or request.pregrasp_distance_m is not None or request.max_width_m
    test = (ctx.scenes.require if needed else ctx.scenes.test)(selected, request.pre_opening_m)
    if limits.obstacles and selected.profile is None:
        raise conflict("gripper-unknown", "Obstacles need the gripper's shape: name one (gripper=)")
    if source is None or source.search is None:
        return None
    chances = _wants_chances(request, built)
    believed, model, calibration, symmetry = _chances(ctx, request, built) if chances else 4 * (None,)
    untried = ctx.successes.untried(selected, believed) if chances else None
    by_success = _by_success(request, model)
    expected = model is None and _by_others(request, untried)
    if not expected and (by_success or asks_chance(request)) and model is None:
        _without_attempts(built)
        return None
    search, kernel, threads = source.search, source.kernel, ctx.compute.threads
    wide = search
    if by_success and symmetry is not None and symmetry.applied:
        wide = ctx.symmetries.search(request, built, search)
    near = NearSuccesses(wide.centres)
    robot = _robot(ctx, request, selected, limits)

    def ranked() -> tuple[ScoreSearch, Ranking]:
        chance = model if by_success else None
        if expected and untried is not None:
            return objectives.by_others(search, untried, threads)
        if request.objective == "robust":
            averaged = None if chance is None else (chance.quick, believed)
            pull = None if chance is None else near.pull
            return objectives.by_mean(request, row, wide, averaged, pull, threads, limits.belief)
        if chance is not None:
            return objectives.by_success(wide, chance, believed, near.pull, threads)
        return objectives.by_density(search, threads)

    closes = _closing(ctx, request, built, test, by_success and model is not None)

    def complete() -> Question:
        by, ranking = ranked()
        by = by.with_breath()
        engine: Engine = by
        if limits.candidates is not None:
            separated = request.min_separation_m is not None or request.min_separation_deg is not None
            engine = CandidateRanking(limits.candidates, by, separated)
        about = near if by_success and not expected else None
        bounds = bounds_of(request, built, limits, search, test, closes, about, model, threads)
        if robot is not None:
            bounds = replace(bounds, dear=robot.test)
        found = built, search, wide, kernel, limits, test, believed, chances, model, untried, bounds
        return Question(*found, engine, ranking, calibration, symmetry, request.pre_opening_m, robot)

    return ctx.compute.run(complete)


def _closing(
    ctx: Estimators, request: GraspConstraints, built: Built, test: CollisionTest | None, by_success: bool
) -> CollisionTest | None:
    """By what a best grasp has to close on something; None where its density sees to that."""
    if by_success and request.collision_free is not False:
        # Between grasps that held lie others that hold nothing, as they do between those on a prior's pairs.
        closes = ctx.evidence.closing(built)
        return None if closes is None else closes.preshaped(request.pre_opening_m)
    return test if built.search is None else None


def _without_attempts(built: Built) -> None:
    """None before any trial; 409 where only successes were posted."""
    if built.search is None:
        # Nothing was tried: no chance ranks what no trial tells of.
        return
    raise conflict(
        "no-attempts",
        "Only successes are known, so no success probability: post failures, too, or rank by the density",
    )


def _robot(
    ctx: Estimators, request: GraspConstraints, selected: Selected, limits: Constraints
) -> RobotQuestion | None:
    if not isinstance(request, BestGraspRequest) or request.robot is None:
        return None
    assert limits.object_pose is not None
    return robot_question(ctx.robots, ctx.scenes, request, selected, limits.object_pose, limits.scene)


def _chances(
    ctx: Estimators, request: GraspConstraints, built: Built
) -> tuple[CollisionTest | None, Model | None, CalibrationInfo | None, SymmetryInfo | None]:
    """What success probabilities rest on: geometry where it is believed, attempts, also where symmetries take
    them, and a correction.
    """
    believed = ctx.evidence.believed(built)
    believed = None if believed is None else believed.preshaped(request.pre_opening_m)
    model = ctx.successes.model(built, collisions_known=believed is not None)
    model, symmetry = ctx.symmetries.applied(request, built, model)
    if model is None or request.calibrated_for is None:
        return believed, model, None, symmetry
    return believed, *calibrated(ctx, built, model, believed, request.calibrated_for), symmetry


def _prior(ctx: Estimators, request: GraspConstraints, built: Built) -> Prior | None:
    """What to choose from before any success, where it may be and can be known."""
    choice, _ = kernel_of(request)
    if request.prior is False or choice.stored is not None:
        return None
    get = ctx.priors.get if request.prior else ctx.priors.known
    return get(built.selected, choice, request.pre_opening_m)


def _wants_chances(request: GraspConstraints, built: Built) -> bool:
    """Whether grasps come with a success probability; the same for the same request and revision."""
    if request.objective == "success_probability" or asks_chance(request):
        return True
    if request.calibrated_for or request.symmetry == "auto":
        return True
    if request.objective == "robust" and request.robust_of != "density":
        return True
    if request.include is not None:
        return not set(CHANCES).isdisjoint(request.include)
    return sum(built.selected.outcomes.values()) <= FEW_ATTEMPTS


def asks_chance(request: GraspConstraints) -> bool:
    """Whether a grasp must have a success probability, so likely or from so many trials."""
    return request.min_success_probability is not None or request.min_effective_trials is not None


def _by_success(request: GraspConstraints, model: Model | None) -> bool:
    """Whether success probabilities or their mean rank; where attempts tell them, if nothing is said."""
    if request.objective == "robust" and request.robust_of is None:
        return model is not None
    return "success_probability" in (request.objective, request.robust_of)


def _by_others(request: GraspConstraints, untried: UntriedChance | None) -> bool:
    """Whether what other objects tell ranks, if no attempt does: where success probabilities were to."""
    if request.objective != "success_probability" or asks_chance(request):
        return False
    return untried is not None and untried.by_others


def bounds_of(
    request: GraspConstraints,
    built: Built,
    limits: Constraints,
    search: ModeSearch,
    test: CollisionTest | None,
    closes: CollisionTest | None,
    near: NearSuccesses | None,
    model: Model | None,
    threads: int,
) -> Bounds:
    """Region, separation, and every constraint that a region can't express, the cheap ones first.

    ``closes`` says where the jaw must be free, with something between its fingers; ``test`` where free.
    """
    metres, degrees = request.min_separation_m, request.min_separation_deg
    separation = Separation(
        DISTINCT.metres if metres is None else metres,
        DISTINCT.radians if degrees is None else math.radians(degrees),
    )
    checks: list[Admissible] = []
    if near is not None:
        checks.append(near)
    if limits.exclude is not None and len(limits.exclude):
        twins = bool(search.centres.symmetric.all())
        checks.append(distinct_from(limits.exclude, separation, twins=twins))
    distance = request.pregrasp_distance_m or 0.0
    if closes is not None:
        checks.append(lambda poses: closes.holds(poses, threads))
    if test is not None and request.collision_free is not False and (closes is None or distance):
        checks.append(lambda poses: test.free_on_the_way(poses, distance, threads))
    profile = built.selected.profile
    if limits.obstacles and profile is not None:
        jaw = shape_of(profile)
        if test is None and isinstance(request.pre_opening_m, float):
            jaw = jaw.at(request.pre_opening_m)
        checks.append(clear_of(limits, jaw, test, distance, threads))
    wide = request.max_width_m
    if wide is not None and test is not None:
        checks.append(lambda poses: test.widths(poses, threads) <= wide)
    if model is not None and asks_chance(request):
        probability, trials = request.min_success_probability, request.min_effective_trials
        checks.append(likely_enough(model, probability or 0.0, trials or 0.0, threads))
    return Bounds(limits.region, all_of(checks), request.count, separation)
