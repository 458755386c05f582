"""Searches for the best grasps: what is asked, which poses are admissible, and where the best ones are."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import GraspConstraints, Ranking
from graspdb_density import GraspDensity, Maximum, MixtureDensity, ModeSearch, Separation, se3
from graspdb_density.search.mode_search import DISTINCT
from graspdb_density.search.scored_poses import Admissible, Score, distinct_from
from graspdb_geometry.grippers import GripperShape
from graspdb_geometry.poses import ToolPoses
from graspdb_service.usecases.densities.cache import Built
from graspdb_service.usecases.densities.success_models import Model
from graspdb_service.usecases.geometry.collision import CollisionTest, shape_of
from graspdb_service.usecases.grasps.constraints import Constraints, Poses

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: Successes shown to the collision test at a time while looking for the nearest admissible one.
_CANDIDATES = 1_024
#: A chance is told within so many standard deviations of a success, position and rotation together. Farther
#: out all kernels are tails, whose ratio is no smaller for it: a few far successes would promise anything.
_NEAR = 2.0
#: Candidates that the quick score ranks first are scored by the score itself, at least so many.
_FEW = 32


@dataclass(frozen=True, eq=False)
class Question:
    """A request about one density, everything looked up."""

    request: GraspConstraints
    built: Built
    search: ModeSearch
    limits: Constraints
    test: CollisionTest | None
    chances: bool
    """Whether grasps are told with their success probability."""
    model: Model | None
    admissible: Admissible | None
    ranking: Ranking
    score: Score | None
    """None: the density's own search."""
    of_chances: bool
    """Whether the score is of success probabilities."""
    quick: Score | None
    """Nearly the score, and much faster: what a search feels its way by."""
    threads: int

    @property
    def asked(self) -> GraspDensity | MixtureDensity:
        """The density under the kernel asked for."""
        return self.search.density

    @property
    def density(self) -> GraspDensity:
        """The density under an isotropic kernel."""
        return self.search.centres

    @property
    def separation(self) -> Separation:
        """From which on two grasps are distinct."""
        metres, degrees = self.request.min_separation_m, self.request.min_separation_deg
        return Separation(
            DISTINCT.metres if metres is None else metres,
            DISTINCT.radians if degrees is None else math.radians(degrees),
        )


def admissible_for(question: Question) -> Admissible | None:
    """Every constraint that a region can't express, the cheap ones first; a score ``of_chances`` has one."""
    request, limits, test, threads = question.request, question.limits, question.test, question.threads
    checks: list[Callable[[Floats, Floats], Bools]] = []
    if question.of_chances:
        checks.append(NearSuccesses(question.density))
    if limits.exclude is not None and len(limits.exclude[0]):
        excluded = se3.Poses(*limits.exclude)
        twins = bool(question.density.symmetric.all())
        checks.append(distinct_from(excluded, question.separation, twins=twins))
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


@dataclass(frozen=True, eq=False)
class NearSuccesses:
    """Whether some success is within so many standard deviations, position and rotation together."""

    density: GraspDensity
    reach: float = _NEAR

    def __call__(self, positions: Floats, quaternions: Floats) -> Bools:
        _, distance = self.density.nearest_each(se3.Poses(positions, quaternions), within=self.reach)
        return np.asarray(distance <= self.reach)

    def pull(self, positions: Floats, quaternions: Floats) -> Poses:
        """Poses a little farther from a success moved straight towards it as far as the reach."""
        density, reach = self.density, self.reach * (1.0 - 1e-4)
        rows, distance = density.nearest_each(se3.Poses(positions, quaternions), within=1.5 * self.reach)
        far = np.flatnonzero((distance > reach) & (rows >= 0))
        p, q = positions.copy(), quaternions.copy()
        if not len(far):
            return p, q
        rows = rows[far]
        centre, to = density.positions[rows], density.quaternions_xyzw[rows]
        # The end of the success's rotation, of its twin's and of both antipodes that is nearest.
        twin = se3.jaw_twin(to)
        own, other = (np.einsum("ij,ij->i", end, q[far]) for end in (to, twin))
        turned = density.symmetric[rows] & (np.abs(other) > np.abs(own))
        to = np.where(turned[:, None], twin, to) * np.sign(np.where(turned, other, own))[:, None]
        kernel = density.kernel
        share = np.ones(len(far))
        for _ in range(3):
            at = centre + share[:, None] * (positions[far] - centre)
            mixed = se3.normalise(to + share[:, None] * (quaternions[far] - to))
            squared = np.sum((at - centre) ** 2, axis=1) / kernel.sigma_position_m**2
            squared += 2.0 * kernel.kappa * (1.0 - np.einsum("ij,ij->i", mixed, to))
            share *= np.minimum(reach / np.sqrt(np.maximum(squared, 1e-12)), 1.0)
        p[far] = centre + share[:, None] * (positions[far] - centre)
        q[far] = se3.normalise(to + share[:, None] * (quaternions[far] - to))
        return p, q


def near_successes(density: GraspDensity, reach: float, threads: int) -> Callable[[Floats, Floats], Bools]:
    """Whether some success is within so many standard deviations, position and rotation together."""
    return NearSuccesses(density, reach)


def _clear_of(
    limits: Constraints, shape: GripperShape, distance: float, threads: int
) -> Callable[[Floats, Floats], Bools]:
    def clear(positions: Floats, quaternions: Floats) -> Bools:
        hit = np.zeros(len(positions), dtype=np.bool_)
        for solid in limits.obstacles:
            hit |= solid.collides(
                ToolPoses(positions, quaternions), shape, threads=threads, retreat_m=distance
            )
        return ~hit

    return clear


# -- the search --------------------------------------------------------------------------------------------


def found(question: Question) -> list[Maximum]:
    """The best grasps, best first."""
    if question.limits.candidates is not None:
        return _ranked(question, question.limits.candidates)
    return question.search.maxima(
        question.limits.region,
        count=question.request.count,
        separation=question.separation,
        admissible=question.admissible,
        score=question.score,
        rough=question.quick,
        pull=NearSuccesses(question.density).pull if question.of_chances else None,
        threads=question.threads,
    )


def _ranked(question: Question, poses: Poses) -> list[Maximum]:
    """The admissible ones of given poses, best first, distinct where a separation was asked for."""
    request, density, region = question.request, question.density, question.limits.region
    index = np.flatnonzero(region.contains(*poses))
    if question.admissible is not None and len(index):
        index = index[question.admissible(poses[0][index], poses[1][index])]
    if not len(index):
        return []
    p, q = poses[0][index], poses[1][index]
    few = max(request.count, _FEW)
    if question.quick is not question.score and question.quick is not None and len(p) > few:
        # Only those that may be among the best are worth the score itself.
        best = np.argsort(-question.quick(p, q), kind="stable")[:few]
        p, q = p[best], q[best]
    logs = question.asked.log_density(se3.Poses.of(p, q), threads=question.threads)
    scores = logs if question.score is None else question.score(p, q)
    chosen: list[int] = []
    separated = request.min_separation_m is not None or request.min_separation_deg is not None
    for i in np.argsort(-scores, kind="stable"):
        if len(chosen) == request.count:
            break
        if separated and chosen:
            before = se3.Poses(p[chosen], q[chosen])
            apart = distinct_from(before, question.separation, twins=bool(density.symmetric.all()))
            if not apart(p[i : i + 1], q[i : i + 1])[0]:
                continue
        chosen.append(int(i))
    return [
        Maximum(p[i], se3.canonical(q[i]), float(logs[i]), region.active(p[i], q[i]), float(scores[i]))
        for i in chosen
    ]


def closest(question: Question) -> list[Maximum]:
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
            log = float(question.asked.log_density(se3.Poses.of(p[at], q[at]))[0])
            score = log if question.score is None else float(question.score(p[at], q[at])[0])
            return [Maximum(p[at][0], se3.canonical(q[at][0]), log, (), score)]
    return []
