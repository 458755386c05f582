"""What grasps are ranked by: the density, the success probability, or either's mean under noise."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from graspdb.wire import GraspConstraints, Ranking
from graspdb.wire.queries import GraspBounds
from graspdb_density import GraspDensity, ModeSearch, PoseNoise, Reach, SuccessModel, expected
from graspdb_density.se3 import Poses
from graspdb_density.search.pose_noise import expected_over
from graspdb_density.search.scored_poses import Pull, Score
from graspdb_estimators import StackedModel
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.densities.learned.learning import Model
from graspdb_service.usecases.densities.success_models import LEVEL
from graspdb_service.usecases.densities.untried import UntriedChance
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.grasps.constraints import Belief
from graspdb_service.usecases.grasps.search import ScoreSearch
from graspdb_service.usecases.runtime.compute import breathing

#: Draws of the noise that a mean is taken over, that lead strategies where a density is averaged, and while
#: searching. A success probability with collisions in it is not smooth: led by 64 draws, two in twenty
#: searches ended at 0.990 and 0.992 of the best.
_NOISE_DRAWS, _LEADING_DRAWS, _FEW_DRAWS = 256, 32, 16
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
    # What is within reach of a sample is within reach of all.
    rough = score if model.quick is model.whole else lower_end_score(model.quick, model.reach, test, threads)
    told = f"lower end of the success probability's {LEVEL:.0%} interval"
    ranking = Ranking(objective="success_probability", score=told)
    # What was learned may rank otherwise than the kernel estimate, which leads to where it is high.
    rescored = _RESCORED if isinstance(model.whole, StackedModel) else 0
    return ScoreSearch(search, threads, score, rough, pull, _RESOLUTION, rescored), ranking


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
    value: Score | None,
    pull: Pull | None,
    threads: int,
    belief: Belief | None = None,
) -> tuple[ScoreSearch, Ranking]:
    """The mean under noise of a success probability ``value`` (None: of the density), and over where the
    object is believed to be.
    """
    noises, told = noises_of(request, row, search.centres)
    if belief is not None:
        told["pose_noise"] = belief.told
    averaged = "density" if value is None else "success_probability"
    mean = None
    if value is None:
        wider, noises = _widened(search, noises)
        value = partial(_density, wider, threads)
        # Where the object does not turn, the mean is the wider density itself.
        mean = None if any(_any(noise) for noise in noises.values()) else wider
    value = breathing(value, "scoring poses")
    score = rough = value
    leading = None
    if any(_any(noise) for noise in noises.values()):
        score, led, rough = (
            expected(value, object_noise=noises["pose_noise"], tool_noise=noises["tool_noise"], samples=draws)
            for draws in (_NOISE_DRAWS, _LEADING_DRAWS, _FEW_DRAWS)
        )
        leading = led if averaged == "density" else None
    if belief is not None:
        mean = leading = None
        likeliest = np.argsort(-belief.weights, kind="stable")[:_FEW_DRAWS]
        share = belief.weights[likeliest] / belief.weights[likeliest].sum()
        rough = expected_over(rough, belief.displacements[likeliest], share)
        score = expected_over(score, belief.displacements, belief.weights)
    unit = ", 1/(m^3 rad^3)" if averaged == "density" else ""
    ranking = Ranking.model_validate(
        {
            "objective": "robust",
            "score": f"mean {averaged.replace('_', ' ')} under the noise{unit}",
            "robust_of": averaged,
            **told,
        }
    )
    resolution = 0.0 if averaged == "density" else _RESOLUTION
    return ScoreSearch(search, threads, score, rough, pull, resolution, mean=mean, leading=leading), ranking


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
