"""The best grasps under constraints: by density, by success probability, or by a mean under noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import BestGrasps, Grasp, GraspConstraints, Interval, Ranking, WorldPose
from graspdb_density import (
    GraspDensity,
    Maximum,
    MixtureDensity,
    PoseNoise,
    SuccessModel,
    expected,
    se3,
    search_scored,
)
from graspdb_density.maximum import Admissible
from graspdb_density.scored import Score
from graspdb_geometry.grippers import GripperShape
from graspdb_service.problems import conflict
from graspdb_service.usecases.constraints import Constraints, Poses, constraints
from graspdb_service.usecases.context import Context
from graspdb_service.usecases.densities import Built, kernel_of
from graspdb_service.usecases.scenes import CollisionTest, shape_of
from graspdb_service.usecases.selection import Filters
from graspdb_service.usecases.success import LEVEL

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_SEPARATION_M = 0.01
_SEPARATION_DEG = 20.0
_NEAREST_TRIALS = 5
#: Successes shown to the collision test at a time while looking for the nearest admissible one.
_CANDIDATES = 1_024
#: Up to so many attempts a model of success probability is built at once; above, it must be asked for.
FEW_ATTEMPTS = 500_000
#: Draws of the noise that a mean is taken over.
_NOISE_DRAWS = 64
_CHANCES = frozenset({"success_probability", "interval", "effective_trials"})


@dataclass(frozen=True, eq=False)
class _Question:
    """A request about one density, everything looked up."""

    request: GraspConstraints
    built: Built
    density: GraspDensity
    limits: Constraints
    test: CollisionTest | None
    chances: bool
    """Whether grasps are told with their success probability."""
    model: SuccessModel | None
    admissible: Admissible | None
    ranking: Ranking
    score: Score | None
    """None: the density's own search."""
    threads: int

    @property
    def asked(self) -> GraspDensity | MixtureDensity:
        """The density under the kernel asked for, where ``density`` is under an isotropic one."""
        return self.density if self.built.shaped is None else self.built.shaped

    @property
    def separation(self) -> tuple[float, float]:
        """Metres and radians from which on two grasps are distinct."""
        request = self.request
        return (
            _or(request.min_separation_m, _SEPARATION_M),
            math.radians(_or(request.min_separation_deg, _SEPARATION_DEG)),
        )


def best_grasps(ctx: Context, slug: str, request: GraspConstraints) -> tuple[BestGrasps, int]:
    """The best distinct grasps under the request's constraints, and the object's internal id.

    Raises
    ------
    ProblemError
        422 naming fields that contradict each other; 409 for what needs a mesh, a gripper or attempts that
        are not there, and as the selection.
    """
    choice, _ = kernel_of(request)
    constraints(request)
    with ctx.compute.admitted():
        built = ctx.densities.get(slug, Filters.of(request), choice)
        question = _question(ctx, slug, request, built)
        if question is None:
            return _answer(built, "no_successes", []), built.object_row.id
        found = ctx.compute.run(lambda: _found(question))
        if found:
            grasps = _described(ctx, question, found)
            status = "ok" if len(grasps) >= request.count else "fewer"
            return _answer(built, status, grasps, ranking=question.ranking), built.object_row.id
        closest = ctx.compute.run(lambda: _closest(question))
        nearest = _described(ctx, question, closest)
        return _answer(built, "infeasible", [], *nearest, ranking=question.ranking), built.object_row.id


def _answer(
    built: Built,
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
            "kernel": built.kernel,
        }
    )


# -- what is asked -----------------------------------------------------------------------------------------


def _question(ctx: Context, slug: str, request: GraspConstraints, built: Built) -> _Question | None:
    """None where there is no success to choose from."""
    limits = constraints(request, jaw_symmetric=built.selected.jaw_symmetric)
    needed = request.collision_free or request.pregrasp_distance_m is not None or request.max_width_m
    if needed:
        test: CollisionTest | None = ctx.scenes.require(built.object_row, built.selected)
    else:
        test = ctx.scenes.test(built.object_row, built.selected)
    if limits.obstacles and built.selected.profile is None:
        raise conflict("gripper-unknown", "Obstacles need the gripper's shape: name one (gripper=)")
    density = built.density
    if density is None:
        return None
    model, chances = None, _wants_chances(request, built)
    if chances:
        model = ctx.successes.model(slug, built, collisions_known=test is not None)
    averaged = request.robust_of or ("density" if model is None else "success_probability")
    of_chances = request.objective == "success_probability" or (
        request.objective == "robust" and averaged == "success_probability"
    )
    if of_chances and model is None:
        raise conflict(
            "no-attempts",
            "Only successes are known, so no success probability: post failures, too, or rank by the density",
        )
    question = _Question(
        request=request,
        built=built,
        density=density,
        limits=limits,
        test=test,
        chances=chances,
        model=model,
        admissible=None,
        ranking=Ranking(objective=request.objective, score="density, 1/(m^3 rad^3)"),
        score=None,
        threads=ctx.compute.threads,
    )
    question = replace(question, admissible=_admissible(question))
    if request.objective == "robust":
        return _robust(question, averaged)
    if of_chances:
        told = f"lower end of the success probability's {LEVEL:.0%} interval"
        ranking = Ranking(objective="success_probability", score=told)
        return replace(question, ranking=ranking, score=_chances(question, "low"))
    return question


def _wants_chances(request: GraspConstraints, built: Built) -> bool:
    """Whether grasps come with a success probability; the same for the same request and revision."""
    if request.objective == "success_probability":
        return True
    if request.objective == "robust" and request.robust_of != "density":
        return True
    if request.include is not None:
        return not _CHANCES.isdisjoint(request.include)
    return sum(built.selected.outcomes.values()) <= FEW_ATTEMPTS


def _robust(question: _Question, averaged: str) -> _Question:
    request = question.request
    told = {}
    noises: dict[str, PoseNoise | None] = {"pose_noise": None, "tool_noise": None}
    pivot, named = _pivot(question)
    for name in noises:
        metres = getattr(request, f"{name}_m") or 0.0
        degrees = getattr(request, f"{name}_deg") or 0.0
        if metres or degrees:
            centre = pivot if name == "pose_noise" else (0.0, 0.0, 0.0)
            noises[name] = PoseNoise(metres, math.radians(degrees), centre)
            acts = "the tool, on the right"
            if name == "pose_noise":
                acts = f"the object about {named}, on the left"
            told[name] = f"{1000 * metres:g} mm and {degrees:g} degrees per axis, of {acts}"
    value = question.asked.density if averaged == "density" else _chances(question, "probability")
    mean = expected(
        value, object_noise=noises["pose_noise"], tool_noise=noises["tool_noise"], samples=_NOISE_DRAWS
    )
    unit = ", 1/(m^3 rad^3)" if averaged == "density" else ""
    ranking = Ranking.model_validate(
        {
            "objective": "robust",
            "score": f"mean {averaged.replace('_', ' ')} under the noise{unit}",
            "robust_of": averaged,
            **told,
        }
    )
    return replace(question, ranking=ranking, score=mean)


def _pivot(question: _Question) -> tuple[tuple[float, float, float], str]:
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


def _chances(question: _Question, column: str) -> Score:
    """A column of the success probability as a score: 0 where the open gripper collides."""
    model, test, threads = question.model, question.test, question.threads
    assert model is not None

    def score(positions: Floats, quaternions: Floats) -> Floats:
        values = np.zeros(len(positions))
        index = np.arange(len(positions))
        if test is not None:
            index = np.flatnonzero(test.free(positions, quaternions, threads=threads))
        if len(index):
            found = model.evaluate(positions[index], quaternions[index], level=LEVEL, threads=threads)
            values[index] = getattr(found, column)
        return values

    return score


def _admissible(question: _Question) -> Admissible | None:
    """Every constraint that a region can't express, the cheap ones first."""
    request, limits, test, threads = question.request, question.limits, question.test, question.threads
    checks: list[Callable[[Floats, Floats], Bools]] = []
    if limits.exclude is not None and len(limits.exclude[0]):
        checks.append(_away_from(limits.exclude, question.separation, bool(question.density.symmetric.all())))
    distance = request.pregrasp_distance_m or 0.0
    if test is not None and request.collision_free is not False:
        known = test
        checks.append(lambda p, q: known.free_on_the_way(p, q, distance, threads))
    profile = question.built.selected.profile
    if limits.obstacles and profile is not None:
        checks.append(_clear_of(limits, shape_of(profile), distance, threads))
    if request.max_width_m is not None and test is not None:
        wide, measured = request.max_width_m, test
        checks.append(lambda p, q: measured.widths(p, q, threads) <= wide)
    if not checks:
        return None

    def admissible(positions: Floats, quaternions: Floats) -> Bools:
        left = np.arange(len(positions))
        for check in checks:
            if len(left):
                left = left[check(positions[left], quaternions[left])]
        allowed = np.zeros(len(positions), dtype=np.bool_)
        allowed[left] = True
        return allowed

    return admissible


def _away_from(
    poses: Poses, separation: tuple[float, float], twins: bool
) -> Callable[[Floats, Floats], Bools]:
    def away(positions: Floats, quaternions: Floats) -> Bools:
        near = np.zeros(len(positions), dtype=np.bool_)
        for p, q in zip(*poses, strict=True):
            angle = se3.angle_between(quaternions, q)
            if twins:
                angle = np.minimum(angle, se3.angle_between(quaternions, se3.jaw_twin(q)))
            near |= (np.linalg.norm(positions - p, axis=1) <= separation[0]) & (angle <= separation[1])
        return ~near

    return away


def _clear_of(
    limits: Constraints, shape: GripperShape, distance: float, threads: int
) -> Callable[[Floats, Floats], Bools]:
    def clear(positions: Floats, quaternions: Floats) -> Bools:
        hit = np.zeros(len(positions), dtype=np.bool_)
        for solid in limits.obstacles:
            hit |= solid.collides(positions, quaternions, shape, threads=threads, retreat_m=distance)
        return ~hit

    return clear


# -- the search --------------------------------------------------------------------------------------------


def _found(question: _Question) -> list[Maximum]:
    request, density = question.request, question.density
    if question.limits.candidates is not None:
        return _ranked(question, question.limits.candidates)
    separation_m, separation = question.separation
    if question.score is None:
        return question.asked.maximum(
            question.limits.region,
            count=request.count,
            min_separation_m=separation_m,
            min_separation=separation,
            admissible=question.admissible,
            threads=question.threads,
        )
    return search_scored(
        density,
        question.score,
        question.limits.region,
        count=request.count,
        min_separation_m=separation_m,
        min_separation=separation,
        admissible=question.admissible,
        threads=question.threads,
    )


def _ranked(question: _Question, poses: Poses) -> list[Maximum]:
    """The admissible ones of given poses, best first, distinct where a separation was asked for."""
    request, density, region = question.request, question.density, question.limits.region
    index = np.flatnonzero(region.contains(*poses))
    if question.admissible is not None and len(index):
        index = index[question.admissible(poses[0][index], poses[1][index])]
    if not len(index):
        return []
    p, q = poses[0][index], poses[1][index]
    logs = question.asked.log_density(p, q, threads=question.threads)
    scores = logs if question.score is None else question.score(p, q)
    chosen: list[int] = []
    separated = request.min_separation_m is not None or request.min_separation_deg is not None
    for i in np.argsort(-scores, kind="stable"):
        if len(chosen) == request.count:
            break
        if separated and chosen:
            away = _away_from((p[chosen], q[chosen]), question.separation, bool(density.symmetric.all()))
            if not away(p[i : i + 1], q[i : i + 1])[0]:
                continue
        chosen.append(int(i))
    return [
        Maximum(p[i], se3.canonical(q[i]), float(logs[i]), region.active(p[i], q[i]), float(scores[i]))
        for i in chosen
    ]


def _closest(question: _Question) -> list[Maximum]:
    """The success, or candidate, that violates the region least, in widths of the kernel, and is otherwise
    admissible; or none."""
    density, region, admissible = question.density, question.limits.region, question.admissible
    kernel = density.kernel
    positions, quaternions = question.limits.candidates or (density.positions, density.quaternions_xyzw)
    p, q, _ = region.project(positions, quaternions)
    shift = np.sum((p - positions) ** 2, axis=1) / kernel.sigma_position_m**2
    turn = se3.angle_between(q, quaternions) ** 2 / kernel.sigma_rotation**2
    order = np.argsort(shift + turn, kind="stable")
    for start in range(0, len(order), _CANDIDATES):
        rows = order[start : start + _CANDIDATES]
        p, q = positions[rows], quaternions[rows]
        free = np.arange(len(rows)) if admissible is None else np.flatnonzero(admissible(p, q))
        if free.size:
            at = slice(int(free[0]), int(free[0]) + 1)
            log = float(question.asked.log_density(p[at], q[at])[0])
            score = log if question.score is None else float(question.score(p[at], q[at])[0])
            return [Maximum(p[at][0], se3.canonical(q[at][0]), log, (), score)]
    return []


# -- what is said of a grasp -------------------------------------------------------------------------------


def _described(ctx: Context, question: _Question, found: list[Maximum]) -> list[Grasp]:
    """What is known of grasps that a search found."""
    if not found:
        return []
    density, limits, test = question.density, question.limits, question.test
    asked = question.asked
    positions = np.array([item.position for item in found])
    quaternions = np.array([item.quaternion_xyzw for item in found])

    def known() -> tuple[Bools | None, Floats | None, list[list[int]], float]:
        free = None if test is None else test.free(positions, quaternions, threads=question.threads)
        widths = None if test is None else test.widths(positions, quaternions, threads=question.threads)
        nearest = [
            _nearest_trials(question.built, density, p, q)
            for p, q in zip(positions, quaternions, strict=True)
        ]
        if isinstance(asked, MixtureDensity):
            # It was searched by score, from the density under an isotropic kernel.
            logs = asked.log_density(positions, quaternions, threads=question.threads)
            found[:] = [replace(item, log_density=float(log)) for item, log in zip(found, logs, strict=True)]
            return free, widths, nearest, asked.global_maximum().score
        return free, widths, nearest, asked.global_maximum(question.threads).log_density

    free, widths, nearest, top = ctx.compute.run(known)
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
                    "relative": min(math.exp(item.log_density - top), 1.0),
                    **chances,
                    "collision_free": None if free is None else bool(free[i]),
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
    kernel = density.kernel
    centres, rotations = density.positions, density.quaternions_xyzw
    cosine = np.abs(rotations @ quaternion)
    turned = np.abs(rotations @ se3.jaw_twin(quaternion))
    cosine = np.where(density.symmetric, np.maximum(cosine, turned), cosine)
    squared = np.sum((centres - position) ** 2, axis=1) / kernel.sigma_position_m**2
    value = kernel.kappa * cosine - 0.5 * squared
    count = min(_NEAREST_TRIALS, len(value))
    best = np.argpartition(-value, count - 1)[:count]
    best = best[np.argsort(-value[best], kind="stable")]
    return [int(seq) for seq in built.seq[best]]


def _or(value: float | None, default: float) -> float:
    return default if value is None else value
