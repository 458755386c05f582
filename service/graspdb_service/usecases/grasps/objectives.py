"""What grasps are ranked by: the density, the success probability, or either's mean under noise."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import replace
from functools import partial

import numpy as np

from graspdb.wire import GraspConstraints, Ranking
from graspdb.wire.queries import GraspBounds
from graspdb_density import (
    GraspDensity,
    ModeSearch,
    PoseNoise,
    Reach,
    SuccessModel,
    expected,
    nearly_expected,
)
from graspdb_density.se3 import Poses
from graspdb_density.search.pose_noise import expected_over
from graspdb_density.search.scored_poses import Pull, Score
from graspdb_estimators import StackedModel
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.trial_columns import Bools, Floats
from graspdb_service.usecases.densities.learned.learning import Model
from graspdb_service.usecases.densities.success_models import LEVEL
from graspdb_service.usecases.densities.untried import UntriedChance
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.grasps.constraints import Belief
from graspdb_service.usecases.grasps.search import ScoreSearch
from graspdb_service.usecases.runtime.compute import breathing

#: Draws of the noise that a mean is taken over, that lead strategies, and while searching. Where a success
#: probability is averaged, its own change within the noise is taken from so many.
_NOISE_DRAWS, _LEADING_DRAWS, _FEW_DRAWS, _VALUED_DRAWS = 256, 32, 16, 8
#: Draws tested for collisions, which decide more than the probability's change does and cost less.
_TESTED_DRAWS = 96
#: Within how many standard deviations attempts tell while searching.
_NARROWED = 3.5
#: Differences of a success probability that mean nothing.
_RESOLUTION = 1e-5
#: The best by the kernel estimate that are ranked anew by what was learned.
_RESCORED = 1_000


def by_density(search: ModeSearch, threads: int) -> tuple[ScoreSearch, Ranking]:
    """The density itself."""
    return ScoreSearch(search, threads), Ranking(objective="density", score="density, 1/(m^3 rad^3)")


def by_success(
    search: ModeSearch, model: Model, test: CollisionTest | None, pull: Pull, threads: int
) -> tuple[ScoreSearch, Ranking]:
    """The lower end of the success probability's interval."""
    score = lower_end_score(model.whole, model.reach, test, threads)
    rough = lower_end_score(model.whole.narrowed(_NARROWED), model.reach, test, threads)
    told = f"lower end of the success probability's {LEVEL:.0%} interval"
    ranking = Ranking(objective="success_probability", score=told)
    # What was learned may rank otherwise than the kernel estimate, which leads to where it is high.
    rescored = _RESCORED if isinstance(model.whole, StackedModel) else 0
    alike = model.quick, model.reach, _named(test)
    found = ScoreSearch(search, threads, score, rough, pull, _RESOLUTION, rescored, alike=alike)
    return replace(found, leading=None if rescored else rough), ranking


def by_others(search: ModeSearch, untried: UntriedChance, threads: int) -> tuple[ScoreSearch, Ranking]:
    """The success probability before any attempt, as other objects tell it."""
    objects = untried.info.objects or 0
    told = f"success probability as attempts at {objects} other objects tell it"
    ranking = Ranking(objective="success_probability", score=told)
    score = partial(untried.score, threads=threads)
    return ScoreSearch(search, threads, score, score, None, _RESOLUTION), ranking


def by_mean(
    request: GraspConstraints,
    row: ObjectRow,
    search: ModeSearch,
    chance: tuple[SuccessModel, CollisionTest | None] | None,
    pull: Pull | None,
    threads: int,
    belief: Belief | None = None,
) -> tuple[ScoreSearch, Ranking]:
    """The mean under noise of the success probability by a model, 0 where a test finds collisions (None: of
    the density), and over where the object is believed to be.
    """
    noises, told = noises_of(request, row, search.centres)
    if belief is not None:
        told["pose_noise"] = belief.told
    averaged = "density" if chance is None else "success_probability"
    ranking = Ranking.model_validate(
        {
            "objective": "robust",
            "score": f"mean {averaged.replace('_', ' ')} under the noise"
            + (", 1/(m^3 rad^3)" if chance is None else ""),
            "robust_of": averaged,
            **told,
        }
    )
    if chance is None:
        found = _mean_density(search, noises, threads)
        resolution = 0.0
    else:
        found = _mean_chance(search, noises, *chance, threads)
        resolution = _RESOLUTION
    if belief is not None:
        assert found.score is not None
        assert found.rough is not None
        likeliest = np.argsort(-belief.weights, kind="stable")[:_FEW_DRAWS]
        share = belief.weights[likeliest] / belief.weights[likeliest].sum()
        found = replace(
            found,
            score=expected_over(found.score, belief.displacements, belief.weights),
            rough=expected_over(found.rough, belief.displacements[likeliest], share),
            mean=None,
            leading=None
            if found.leading is None
            else expected_over(found.rough, belief.displacements, belief.weights),
            alike=None,
        )
    return replace(found, pull=pull, resolution=resolution), ranking


def _mean_density(search: ModeSearch, noises: dict[str, PoseNoise], threads: int) -> ScoreSearch:
    """By the density's mean under noise."""
    wider, left = _widened(search, noises)
    value = breathing(partial(_density, wider, threads), "scoring poses")
    if not any(_any(noise) for noise in left.values()):
        # Where the object does not turn, the mean is the wider density itself.
        return ScoreSearch(search, threads, value, value, mean=wider)
    score, leading, rough = (
        expected(value, object_noise=left["pose_noise"], tool_noise=left["tool_noise"], samples=draws)
        for draws in (_NOISE_DRAWS, _LEADING_DRAWS, _FEW_DRAWS)
    )
    return ScoreSearch(search, threads, score, rough, leading=leading, alike=(wider, *left.values()))


def _mean_chance(
    search: ModeSearch,
    noises: dict[str, PoseNoise],
    model: SuccessModel,
    test: CollisionTest | None,
    threads: int,
) -> ScoreSearch:
    """By the success probability's mean under noise."""
    value = breathing(success_score(model, test, threads), "scoring poses")
    if not any(_any(noise) for noise in noises.values()):
        return ScoreSearch(search, threads, value, value, alike=(model, _named(test)))
    at_object, at_tool = noises["pose_noise"], noises["tool_noise"]
    score = expected(value, object_noise=at_object, tool_noise=at_tool, samples=_NOISE_DRAWS)
    chance = breathing(partial(model.probability, threads=threads), "scoring poses")
    leading, rough = (
        nearly_expected(
            chance,
            partial(_free, test, threads),
            object_noise=at_object,
            tool_noise=at_tool,
            tested=tested,
            valued=valued,
        )
        for tested, valued in ((_TESTED_DRAWS, _VALUED_DRAWS), (_FEW_DRAWS, 2))
    )
    alike = model, _named(test), at_object, at_tool
    return ScoreSearch(search, threads, score, rough, leading=leading, alike=alike)


def _free(test: CollisionTest | None, threads: int, poses: Poses) -> Bools:
    return np.ones(len(poses), dtype=np.bool_) if test is None else test.free(poses, threads=threads)


def _named(test: CollisionTest | None) -> Hashable:
    """What tests that say the same have in common."""
    return None if test is None else (test.solid, test.shape, test.pre_opening_m)


def _any(noise: PoseNoise) -> bool:
    return bool(noise.sigma_position_m or noise.sigma_rotation)


def _density(search: ModeSearch, threads: int, poses: Poses) -> Floats:
    return np.exp(search.density.log_density(poses, threads=threads))


def noises_of(
    request: GraspBounds, row: ObjectRow, density: GraspDensity
) -> tuple[dict[str, PoseNoise], dict[str, str]]:
    """The noise of the object's pose and of the tool's that a request asks to withstand, by their names in
    it, and in words where there is any.
    """
    pivot, named = _pivot(row, density)
    about = {"pose_noise": f"the object about {named}, on the left", "tool_noise": "the tool, on the right"}
    told: dict[str, str] = {}
    noises: dict[str, PoseNoise] = {}
    for name, moved in about.items():
        metres = getattr(request, f"{name}_m") or 0.0
        degrees = getattr(request, f"{name}_deg") or 0.0
        noises[name] = PoseNoise(metres, math.radians(degrees), pivot if name == "pose_noise" else (0.0,) * 3)
        if metres or degrees:
            told[name] = f"{1000 * metres:g} mm and {degrees:g} degrees per axis, of {moved}"
    return noises, told


def success_score(model: SuccessModel, test: CollisionTest | None, threads: int) -> Score:
    """The success probability as a score: 0 where the open gripper collides."""
    return _where_free(lambda poses: model.probability(poses, threads=threads), test, threads)


def lower_end_score(model: SuccessModel, reach: Reach, test: CollisionTest | None, threads: int) -> Score:
    """The lower end of its interval: 0 where the open gripper collides; no higher than if nothing had been
    tried where the nearest attempt is out of reach.
    """

    def low(poses: Poses) -> Floats:
        return model.lower_end(poses, level=LEVEL, near=reach.covers, threads=threads)

    return _where_free(low, test, threads)


def _where_free(value: Score, test: CollisionTest | None, threads: int) -> Score:
    def score(poses: Poses) -> Floats:
        if test is None:
            return value(poses)
        values, free = np.zeros(len(poses)), test.free(poses, threads=threads)
        if free.any():
            values[free] = value(poses[free])
        return values

    return score


def _widened(search: ModeSearch, noises: dict[str, PoseNoise]) -> tuple[ModeSearch, dict[str, PoseNoise]]:
    """The search in a density under a kernel that is wider by the noise, and the noise that is left to draw.

    An isotropic kernel takes all noise of the tool and the object's shifts; the object's turns move a grasp
    the farther the longer its lever, which no one kernel does.
    """
    if search.density.isotropic is not search.density:
        return search, noises
    at_object, at_tool = noises["pose_noise"], noises["tool_noise"]
    shift = math.hypot(at_object.sigma_position_m, at_tool.sigma_position_m)
    left = {
        "pose_noise": replace(at_object, sigma_position_m=0.0),
        "tool_noise": replace(at_tool, sigma_position_m=0.0, sigma_rotation=0.0),
    }
    return search.widened(shift, at_tool.sigma_rotation), left


def _pivot(row: ObjectRow, density: GraspDensity) -> tuple[tuple[float, float, float], str]:
    """What the object turns about: its bounding box's centre, object frame."""
    if row.mesh_info is not None:
        corners = np.array([row.mesh_info["bounding_box"][end] for end in ("lower", "upper")])
        named = "its bounding box's centre"
    else:
        corners = np.array([density.positions.min(axis=0), density.positions.max(axis=0)])
        named = "the centre of the successes' bounding box, for there is no mesh"
    x, y, z = (float(value) for value in corners.mean(axis=0))
    return (x, y, z), named
