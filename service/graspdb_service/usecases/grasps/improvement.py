"""Which trials would improve the best grasp most: what might be the best, what is believed of each, and which
of them to try.

What might be the best are the grasp that is answered now, grasps about successes, and grasps on the object's
edges. A choice has no density: so draws come from a narrow kernel about each of those chosen, as many from
every one, and the density of all these integrates to 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from graspdb.wire import BestGraspRequest, ProposalsRequest
from graspdb.wire.queries import PostedBounds
from graspdb_density import (
    GraspDensity,
    IsotropicKernel,
    ModeSearch,
    PoseNoise,
    SuccessModel,
    expected,
    se3,
)
from graspdb_density.se3 import Poses
from graspdb_density.success.expected_gain import Beliefs
from graspdb_density.success.kernel_regression import PRIOR_TRIALS
from graspdb_estimators import StackedModel
from graspdb_service.problems import conflict, invalid_fields
from graspdb_service.trial_columns import Floats, Ints
from graspdb_service.usecases.densities.build import Built, KernelChoice
from graspdb_service.usecases.densities.cache import kernel_of
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.densities.learned.learning import Model
from graspdb_service.usecases.densities.prior import Prior
from graspdb_service.usecases.densities.stored_kernel import isotropic
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.grasps import samples
from graspdb_service.usecases.grasps.constraints import Constraints, constraints
from graspdb_service.usecases.grasps.objectives import noises_of
from graspdb_service.usecases.grasps.question import Question, bounds_of, question_of
from graspdb_service.usecases.grasps.samples import Draw
from graspdb_service.usecases.trials.pose_frames import PoseFrame

#: Candidates on edges, and as many among successes, and about them; successes that are looked at for those.
_OF_EACH, _LOOKED_AT = 1_024, 8_192
#: Those about successes lie so far away at most, in kernel widths, drawn evenly.
_ABOUT = 1.5
#: A pose outside the region is moved into it from this far, in the widths of the kernel it is drawn from.
_MOVED = 1.5
#: Width of the kernels drawn from, as a share of the one that tells of success; about so many grasps at most.
_NARROW, _MOST = 0.2, 256
#: Draws of the noise by which collisions in execution are judged.
_NOISE_DRAWS = 16
_BOUNDS = tuple(name for name in PostedBounds.model_fields if name != "reference")
_OF_THE_DRAWS = {"count", "frame", "convention", "near", "name"}
_NOISES = ("pose_noise_m", "pose_noise_deg", "tool_noise_m", "tool_noise_deg")


def refuse_bounds(request: ProposalsRequest) -> None:
    """422 where bounds are asked of a strategy that would not keep them."""
    given = [name for name in _BOUNDS if getattr(request, name) is not None]
    if given:
        told = f"counts with strategy=expected_improvement only, not with {request.strategy}"
        raise invalid_fields([(name, told) for name in given])


def improving(ctx: Estimators, slug: str, request: ProposalsRequest) -> Draw:
    """Draws about the grasps whose trials are expected to raise the success probability of the best grasp
    within the request's bounds most.

    409 where nothing was tried and geometry or gripper are not known, where only successes are known and no
    geometry, and where no grasp is left within the bounds; 422 for bounds that contradict each other.
    """
    asked = _about(request)
    choice, _ = kernel_of(asked)
    with ctx.compute.within(request):
        selected = ctx.densities.selections.resolve(slug, asked)
        limits = constraints(asked, selected, PoseFrame())
        built = ctx.densities.get(selected, choice)
        scene = _scene(ctx, asked, built, limits)
        beliefs, answer = _believed(ctx, asked, scene)
        if not len(beliefs.poses):
            raise conflict(
                "nothing-to-try",
                "No grasp within the bounds is near a success or on the object's edges, clear of collisions:"
                " widen them, name another gripper, or sweep a grid",
            )
        count = min(request.count, _MOST, len(beliefs.poses))
        chosen = ctx.compute.run(lambda: beliefs.choose(count, scene.seen, answer))
        seed, narrow = samples.seed_of(request.seed), _narrow(scene.seen)
        centres, symmetric = beliefs.poses[chosen.rows], selected.jaw_symmetric
        density = GraspDensity.build(centres, kernel=narrow, symmetric=symmetric)
        rows, poses = ctx.compute.run(
            lambda: _about_each(centres, narrow, symmetric, request.count, np.random.default_rng(seed))
        )
        untried = scene.model is None
        drawn = samples.told_of(ctx, density, poses, built, built.kernel, seed, request, prior=untried)
        estimator = drawn.estimator if scene.model is None else scene.model.estimator
        return replace(drawn, expected_gain=chosen.gains[rows], estimator=estimator)


def _about_each(
    centres: Poses, kernel: IsotropicKernel, symmetric: bool, count: int, rng: np.random.Generator
) -> tuple[Ints, Poses]:
    """As many draws about each of the centres as about any other, and one more about some drawn at random: a
    stratified sample of their mixture. Which centre each (count,) is about, and the draws; as many as there
    are centres come in their order.
    """
    rows = np.arange(count)
    if count != len(centres):
        rows = np.resize(rng.permutation(len(centres)), count)
    about = centres[rows]
    if symmetric:
        about = about.turned(rng.random(count) < 0.5)
    moves, turns = kernel.sample_displacements(count, rng)
    turned = se3.multiply(about.quaternions_xyzw, turns)
    return rows, Poses(about.positions + moves, se3.normalise(turned))


@dataclass(frozen=True, eq=False)
class _Scene:
    """What beliefs rest on: how trials tell of one another (``seen``), the model of those there are, and the
    question for the best grasp; None where there are none, or none succeeded. ``prior``: the object's edges.
    """

    built: Built
    limits: Constraints
    seen: SuccessModel
    model: Model | None
    question: Question | None
    prior: Prior | None
    test: CollisionTest | None

    @property
    def search(self) -> ModeSearch:
        """In the successes, or before any in the edges."""
        found = self.built.search or (None if self.prior is None else self.prior.search)
        assert found is not None
        return found


def _about(request: ProposalsRequest) -> BestGraspRequest:
    """The question for the best grasp that trials are to improve."""
    given = {*BestGraspRequest.model_fields} & request.model_fields_set - _OF_THE_DRAWS
    fields = {name: getattr(request, name) for name in given}
    noisy = any(getattr(request, name) for name in _NOISES)
    objective = "robust" if noisy else "success_probability"
    more = {"robust_of": "success_probability"} if noisy else dict.fromkeys(_NOISES)
    return BestGraspRequest.model_construct(**{**fields, **more, "objective": objective})


def _scene(ctx: Estimators, asked: BestGraspRequest, built: Built, limits: Constraints) -> _Scene:
    selected = built.selected
    model = ctx.successes.model(built, collisions_known=ctx.evidence.believed(built) is not None)
    model, _ = ctx.symmetries.applied(asked, built, model)
    choice = KernelChoice()
    if built.density is None:
        # Says what is missing where nothing tells where to begin.
        prior: Prior | None = ctx.priors.get(selected, choice, asked.pre_opening_m)
    else:
        prior = ctx.priors.known(selected, choice, asked.pre_opening_m)
    if model is None and prior is None:
        raise conflict(
            "no-attempts",
            "Only successes are known and no geometry, so nothing tells where a trial would improve the best"
            " grasp: post failures, too, or put a mesh and name a gripper (gripper=)",
        )
    question = None
    if built.density is not None and model is not None:
        question = question_of(ctx, asked, built, limits)
    needed = asked.collision_free or asked.pregrasp_distance_m is not None or asked.max_width_m
    test = (ctx.scenes.require if needed else ctx.scenes.test)(selected, asked.pre_opening_m)
    seen = SuccessModel(isotropic(built.kernel)) if model is None else model.whole
    return _Scene(built, limits, seen, model, question, prior, test)


def _believed(ctx: Estimators, asked: BestGraspRequest, scene: _Scene) -> tuple[Beliefs, int | None]:
    """What is believed of grasps that might be the best, and which of them is answered now, if any is."""
    question, run = scene.question, ctx.compute.run
    found = [] if question is None else run(lambda: question.engine.best(question.bounds))
    answers = [Poses(best.position[None], best.quaternion_xyzw[None]) for best in found]

    def looked_at() -> Poses:
        candidates = _candidates(ctx, scene, np.random.default_rng(0))
        return Poses.concatenate([*answers, candidates[_allowed(ctx, asked, scene, candidates)]])

    poses = run(looked_at)
    prior = _prior_mean(ctx, asked, scene, poses)
    # Where the jaw closes on nothing there is nothing to learn; of what is answered there is.
    kept = prior > 0.0
    kept[: len(answers)] = True
    poses, prior = poses[kept], prior[kept]

    def believed() -> Beliefs:
        mean, trials = _told(ctx, scene, poses, prior)
        return Beliefs(poses, mean, trials, _comes(ctx, asked, scene, poses))

    return run(believed), 0 if answers else None


def _candidates(ctx: Estimators, scene: _Scene, rng: np.random.Generator) -> Poses:
    """Grasps on edges, among successes and about them, in the region or moved into it."""
    region, found = scene.limits.region, [Poses(np.empty((0, 3)), np.empty((0, 4)))]

    def within(poses: Poses, kernel: IsotropicKernel) -> Poses:
        p, q, inside = region.project(*poses)
        moved = np.linalg.norm(p - poses.positions, axis=1) / kernel.sigma_position_m
        inside &= (
            np.hypot(moved, se3.angle_between(q, poses.quaternions_xyzw) / kernel.sigma_rotation) < _MOVED
        )
        return Poses(p, q)[inside]

    if scene.prior is not None:
        edges = scene.prior.density
        rows = rng.permutation(edges.size)[: 8 * _OF_EACH]
        found.append(within(edges.poses[rows], edges.kernel)[:_OF_EACH])
    question = scene.question
    if question is not None and question.model is not None:
        centres = question.wide.centres
        kernel = centres.kernel
        some = within(centres.poses[rng.permutation(centres.size)[:_LOOKED_AT]], kernel)
        if len(some) > _OF_EACH:
            chances = question.model.quick.probability(some, threads=ctx.compute.threads)
            some = some[np.argsort(-chances, kind="stable")[:_OF_EACH]]
        found.append(some)
        if len(some):
            about = some[rng.integers(0, len(some), _OF_EACH)]
            far = rng.uniform(0.0, _ABOUT / math.sqrt(6.0), (_OF_EACH, 1))
            p = about.positions + rng.standard_normal((_OF_EACH, 3)) * far * kernel.sigma_position_m
            turns = rng.standard_normal((_OF_EACH, 3)) * far * kernel.sigma_rotation
            q = se3.multiply(about.quaternions_xyzw, se3.from_rotation_vector(turns))
            found.append(within(Poses(p, se3.normalise(q)), kernel))
    return Poses.concatenate(found)


def _allowed(ctx: Estimators, asked: BestGraspRequest, scene: _Scene, poses: Poses) -> Ints:
    """Rows that the bounds admit, whatever is known of their chances."""
    threads = ctx.compute.threads
    built, test = scene.built, scene.test
    closes = test if built.search is None else None
    bounds = bounds_of(asked, built, scene.limits, scene.search, test, closes, None, None, threads)
    return bounds.allowed(poses)


def _prior_mean(ctx: Estimators, asked: BestGraspRequest, scene: _Scene, poses: Poses) -> Floats:
    """The success probability (n,) that beliefs start from: by other objects or by geometry, where these are
    known and count.
    """
    model = scene.model
    prior = np.full(len(poses), 0.5 if model is None else _share(model.whole))
    untried = ctx.successes.untried(scene.built.selected, scene.test)
    if untried is None or asked.collision_free is False:
        return prior
    every = np.ones(len(poses), dtype=np.bool_)
    return untried.told(poses, every, every, model)


def _told(ctx: Estimators, scene: _Scene, poses: Poses, prior: Floats) -> tuple[Floats, Floats]:
    """Expected success probability (n,) and as how many trials those around count."""
    model, threads = scene.model, ctx.compute.threads
    if model is None:
        return prior, np.zeros(len(poses))
    won, trials = model.whole.counted(poses, threads=threads)
    mean = (PRIOR_TRIALS * prior + won) / (PRIOR_TRIALS + trials)
    if isinstance(model.whole, StackedModel):
        chances, _, nearest = model.whole.without_interval(poses, threads=threads)
        mean = np.where(model.reach.covers(nearest) & (prior > 0.0), chances, mean)
    return np.clip(mean, 0.0, 1.0), trials


def _share(model: SuccessModel) -> float:
    """Share of successes, with half of one in one more."""
    won, total = model.worth
    return (won + 0.5) / (total + 1.0)


def _comes(ctx: Estimators, asked: BestGraspRequest, scene: _Scene, poses: Poses) -> Floats:
    """Share of executions (n,) that come to a pose and hold something by geometry, under the noise that the
    best grasp is to withstand and that of the draws.
    """
    test = scene.test
    if test is None or asked.collision_free is False or test.pre_opening_m == "auto" or not len(poses):
        # With the jaw as far open as each pose needs, a displaced one would be tested by its own opening.
        return np.ones(len(poses))
    narrow, threads = _narrow(scene.seen), ctx.compute.threads
    search = scene.search
    noises, _ = noises_of(asked, scene.built.object_row, search.centres)
    at_object, at_tool = noises["pose_noise"], noises["tool_noise"]
    tool = PoseNoise(
        math.hypot(at_tool.sigma_position_m, narrow.sigma_position_m),
        math.hypot(at_tool.sigma_rotation, narrow.sigma_rotation),
    )

    def free(some: Poses) -> Floats:
        return test.holds(some, threads=threads).astype(np.float64)

    return expected(free, object_noise=at_object, tool_noise=tool, samples=_NOISE_DRAWS)(poses)


def _narrow(seen: SuccessModel) -> IsotropicKernel:
    """The kernel of the draws: as a share of the one by which trials tell of one another."""
    x, y, z, *turns = seen.sigmas
    return IsotropicKernel(_NARROW * math.prod((x, y, z)) ** (1 / 3), _NARROW * math.prod(turns) ** (1 / 3))
