"""The best grasps by any score of a pose, and scores averaged over pose noise.

A density has its own climb (`maximum`). A success probability's lower end, an expectation under noise or a
mixture kernel's density have none; here they are searched by values alone, from where an isotropic density is
high: first by random steps, then by evolution strategies that learn how the score falls off.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from cmaes import CMA
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri
from scipy.stats import qmc

from .. import se3
from ..se3 import Floats
from .mode_search import Admissible, Maximum, Pool, Search, distinct_from
from .region import Region

if TYPE_CHECKING:
    from ..kde.isotropic import GraspDensity

__all__ = ["PoseNoise", "Pull", "Score", "expected", "search_scored"]

#: Scores poses (K, 3), (K, 4): (K,), higher is better.
Score = Callable[[Floats, Floats], Floats]
#: Moves poses (K, 3), (K, 4).
Pull = Callable[[Floats, Floats], tuple[Floats, Floats]]

_CANDIDATES = 192
#: Centres whose score is asked for before any is climbed from: a density tells little of where another score
#: is high.
_ASKED = 4096
#: First climbs, by random steps: how many, steps one tries at a time, how often.
_FIRST, _TRIES, _ROUNDS = 64, 8, 12
#: Of what they passed, so many are valued by the score itself. From the best the last climbs start: so many
#: for so many generations, then the best of them, each of so many poses a generation.
_FINALISTS, _LAST, _POPULATION = 32, ((12, 12), (6, 12), (3, 24)), 14
#: Generations of a runner-up's climb, which stays away from the other answers, and how many climb.
_RUNNER_UP, _RUNNERS_UP = 20, 8
#: Draws around centres in reach, and how many of them may join the starts: where the nearest poses of centres
#: are refused, others may not be.
_DRAWN, _JOINING = 2048, 64
#: Steps in kernel widths.
_FIRST_STEP, _LAST_STEP = 0.6, 0.4


def search_scored(
    density: GraspDensity,
    score: Score,
    region: Region | None = None,
    *,
    count: int = 1,
    min_separation_m: float = 0.01,
    min_separation: float = math.radians(20.0),
    admissible: Admissible | None = None,
    pull: Pull | None = None,
    rough: Score | None = None,
    threads: int = 1,
) -> list[Maximum]:
    """The ``count`` best distinct grasps by ``score``, best first; arguments as in `maximum.search`.

    Candidates are well separated centres of the density, projected into the region, those of the highest
    score among at most 4,096 centres: half of them where the density is highest, half drawn at random. The
    best climb by random steps that shrink as they fail. Of where these led, the best climb on by CMA-ES
    (Hansen and Ostermeier, 2001), which learns along which directions a score falls off slowly. All is drawn
    from fixed seeds. ``Maximum.score`` is the score. ``pull`` brings poses nearer to where they are
    admissible; random steps end where it puts them. ``rough``, nearly the score but faster, ranks candidates
    and leads the first climbs.
    """
    found = _ScoredSearch(density, region or Region(), admissible, threads, score, pull, rough or score)
    return found.run(count, min_separation_m, min_separation)


class _ScoredSearch(Search):
    starts_wanted = _CANDIDATES

    def __init__(
        self,
        density: GraspDensity,
        region: Region,
        admissible: Admissible | None,
        threads: int,
        score: Score,
        pull: Pull | None,
        rough: Score,
    ) -> None:
        super().__init__(density, region, admissible, threads)
        self.score = score
        self.pull = pull
        self.felt = rough

    def run(self, count: int, separation_m: float, separation: float) -> list[Maximum]:
        apart = separation_m, separation
        starts = self.starts(max(self.starts_wanted, 3 * count), *self.widths(1.0))
        if count > 1 and len(starts):
            # Runners-up may have to be farther apart than the best starts are.
            starts = starts.joined(self.starts(2 * count, *apart))
        if not len(starts):
            return []
        pool = self.first_climbs(starts)
        # More than are wanted: those that climb drive out others on their way.
        best = self.scored(pool.take(self.choose(pool, max(2 * count, _FINALISTS), *apart))).sort()
        best = best.joined(self.last_climbs(best, _LAST)).sort()
        best = best.take(self.choose(best, count, *apart))
        for place in range(1, min(len(best), _RUNNERS_UP)):
            rest = best.take(np.arange(len(best)) != place)
            away = distinct_from(
                rest.positions,
                rest.quaternions,
                separation_m=separation_m,
                separation=separation,
                twins=self.twins,
            )
            on = self.last_climbs(best.take(np.array([place])), ((1, _RUNNER_UP),), away)
            best.positions[place], best.quaternions[place], best.sums[place] = (
                on.positions[0],
                on.quaternions[0],
                on.sums[0],
            )
        logs = self.density.log_density(best.positions, best.quaternions)
        return self.maxima(best, logs, best.sums)

    def sums(self, positions: Floats, quaternions: Floats) -> Floats:
        return self.asked(self.score, positions, quaternions)

    def asked(self, score: Score, positions: Floats, quaternions: Floats) -> Floats:
        values = np.asarray(score(positions, quaternions), dtype=np.float64)
        if values.shape != (len(positions),):
            raise ValueError(f"the score answered shape {values.shape} for {len(positions)} poses")
        return values

    def candidates(self) -> Iterator[tuple[NDArray[np.intp], NDArray[np.bool_]]]:
        promise, turned = self.scores(0, self.density.size)
        places = np.flatnonzero(promise > -np.inf)
        rest = places[:0]
        if len(places) > _ASKED:
            places = places[np.argsort(-promise[places], kind="stable")]
            others = np.random.default_rng(0).permutation(places[_ASKED // 2 :])
            places = np.concatenate([places[: _ASKED // 2], others[: _ASKED // 2]])
            rest = others[_ASKED // 2 :]
        # Where none of the first is admissible another may be.
        for part in (places, *np.array_split(rest, -(-len(rest) // _ASKED) or 1)):
            if len(part):
                yield self.guide.order[part], turned[part]

    def starts(self, wanted: int, separation_m: float, separation: float) -> Pool:
        found = super().starts(wanted, separation_m, separation)
        rows, turned = next(self.candidates(), (np.empty(0, dtype=np.intp), np.empty(0, dtype=bool)))
        if not len(rows):
            return found
        rng = np.random.default_rng(0)
        some = rng.integers(0, len(rows), _DRAWN)
        rows, turned = rows[some], turned[some]
        quaternions = self.density.quaternions_xyzw[rows]
        quaternions = np.where(turned[:, None], se3.jaw_twin(quaternions), quaternions)
        away, turns = self.density.kernel.sample_displacements(_DRAWN, rng)
        p, q, inside = self.landed(self.density.positions[rows] + away, se3.multiply(quaternions, turns))
        drawn = self.valued(p[inside], q[inside])
        return self.add_distinct(found, drawn, len(found) + _JOINING, separation_m, separation)

    def landed(self, positions: Floats, quaternions: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Poses brought into the region, pulled to where they are admissible, and which are inside then."""
        p, q, inside = self.region.project(positions, quaternions)
        if self.pull is not None:
            p, q = self.pull(p, q)
        return p, q, inside & self.region.contains(p, q)

    def valued(self, positions: Floats, quaternions: Floats) -> Pool:
        return Pool(positions, quaternions, self.asked(self.felt, positions, quaternions)).sort()

    def first_climbs(self, starts: Pool) -> Pool:
        """The starts and what random steps from the best of them passed, by the rough score, best first."""
        rng = np.random.default_rng(0)
        ends, pool = starts.take(np.argsort(-starts.sums, kind="stable")[:_FIRST]), starts
        step = np.full(len(ends), _FIRST_STEP)
        for _ in range(_ROUNDS):
            ends, step, moved = self.tried(ends, step, _TRIES, rng)
            pool = pool.joined(ends.take(moved))
        return pool.sort()

    def last_climbs(
        self, starts: Pool, plan: tuple[tuple[int, int], ...], kept: Admissible | None = None
    ) -> Pool:
        """The best admissible pose that evolution from each start found, of the best starts.

        Parameters
        ----------
        starts
            With their scores.
        plan
            How many climb, for how many generations, how many of them go on, and so forth.
        kept
            Refuses poses besides ``admissible``.
        """
        found = Pool(starts.positions.copy(), starts.quaternions.copy(), starts.sums.copy())
        climbs = [CMA(np.zeros(6), _LAST_STEP, seed=0, population_size=_POPULATION) for _ in found.sums]
        on = begun = np.argsort(-found.sums, kind="stable")[: plan[0][0]]
        for climbers, generations in plan:
            on = on[np.argsort(-found.sums[on], kind="stable")[:climbers]]
            for _ in range(generations):
                steps = np.array([[climbs[i].ask() for _ in range(_POPULATION)] for i in on])
                poses = self.stepped_to(starts.take(np.repeat(on, _POPULATION)), steps.reshape(-1, 6), kept)
                for i, moves, part in zip(on, steps, np.split(np.arange(len(poses)), len(on)), strict=True):
                    # What is refused ranks last, the farther the later.
                    ranked = np.lexsort((np.sum(moves**2, axis=1), -poses.sums[part]))
                    places = np.argsort(ranked).astype(np.float64)
                    climbs[i].tell(list(zip(moves, places.tolist(), strict=True)))
                    top = part[ranked[0]]
                    if poses.sums[top] > found.sums[i]:
                        found.positions[i], found.quaternions[i] = (
                            poses.positions[top],
                            poses.quaternions[top],
                        )
                        found.sums[i] = poses.sums[top]
        return found.take(begun)

    def stepped_to(self, at: Pool, steps: Floats, kept: Admissible | None) -> Pool:
        """Poses ``steps`` (K, 6) kernel widths away, with scores: -inf where they are refused."""
        kernel = self.density.kernel
        away = steps * np.repeat([kernel.sigma_position_m, kernel.sigma_rotation], 3)
        turned = se3.multiply(at.quaternions, se3.from_rotation_vector(away[:, 3:]))
        p, q, allowed = self.landed(at.positions + away[:, :3], turned)
        for refuses in (kept, self.admissible and self.check):
            if refuses is not None and allowed.any():
                allowed[allowed] = refuses(p[allowed], q[allowed])
        values = np.full(len(p), -np.inf)
        if allowed.any():
            values[allowed] = self.sums(p[allowed], q[allowed])
        return Pool(p, q, values)

    def tried(
        self, ends: Pool, step: Floats, tries: int, rng: np.random.Generator
    ) -> tuple[Pool, Floats, NDArray[np.bool_]]:
        """From each of some poses, the best of random steps where that is better and admissible.

        Returns
        -------
        ends : Pool
        step : (K,)
            Lengths to try next, in kernel widths, longer after a success and shorter after a failure.
        moved : (K,) bool
        """
        kernel = self.density.kernel
        scale = np.repeat(step, tries)[:, None]
        at, to = np.repeat(ends.positions, tries, axis=0), np.repeat(ends.quaternions, tries, axis=0)
        away = at + rng.standard_normal(at.shape) * scale * kernel.sigma_position_m
        turns = se3.from_rotation_vector(rng.standard_normal(at.shape) * scale * kernel.sigma_rotation)
        p, q, inside = self.landed(away, se3.multiply(to, turns))
        scores = np.full(len(p), -np.inf)
        scores[inside] = self.asked(self.felt, p[inside], q[inside])
        better = scores > np.repeat(ends.sums, tries)
        if self.admissible is not None and better.any():
            better[better] = self.check(p[better], q[better])
        scores[~better] = -np.inf
        winner = scores.reshape(len(ends), tries).argmax(axis=1) + np.arange(len(ends)) * tries
        moved: NDArray[np.bool_] = scores[winner] > -np.inf
        there = Pool(
            np.where(moved[:, None], p[winner], ends.positions),
            np.where(moved[:, None], q[winner], ends.quaternions),
            np.where(moved, scores[winner], ends.sums),
        )
        return there, np.where(moved, np.minimum(1.1 * step, 1.0), 0.6 * step), moved


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Gaussian noise of a pose, deviations per axis in metres and radians.

    As noise of the object's pose it acts on the left, about ``pivot`` (object frame, metres): 5 degrees at a
    lever of 100 mm move a grasp by 9 mm. As tool noise it acts on the right and the pivot is the tool's
    origin.
    """

    sigma_position_m: float
    sigma_rotation: float
    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        values = (self.sigma_position_m, self.sigma_rotation, *self.pivot)
        if not all(math.isfinite(v) for v in values) or min(values[:2]) < 0.0:
            raise ValueError("noise must be finite and not negative")


def expected(
    value: Score,
    *,
    object_noise: PoseNoise | None = None,
    tool_noise: PoseNoise | None = None,
    samples: int = 64,
) -> Score:
    """The mean of ``value`` (a density or a probability, not a logarithm) under pose noise, itself a score.

    The noise is a fixed scrambled Sobol set of ``samples`` draws, so that the mean is a smooth function of
    the pose; its error falls nearly as 1 / samples.
    """
    if samples < 1:
        raise ValueError(f"samples must be at least 1, not {samples}")
    normal = ndtri(
        qmc.Sobol(12, rng=np.random.default_rng(0)).random(2 ** math.ceil(math.log2(samples)))[:samples]
    )
    left_p, left_q = _draws(object_noise, normal[:, :6])
    right_p, right_q = _draws(tool_noise, normal[:, 6:])
    pivot = np.zeros(3) if object_noise is None else np.array(object_noise.pivot)

    def mean(positions: ArrayLike, quaternions: ArrayLike) -> Floats:
        p, q = np.asarray(positions, dtype=np.float64), np.asarray(quaternions, dtype=np.float64)
        seen_p = pivot + se3.rotate(left_q[:, None], p[None] - pivot) + left_p[:, None]
        seen_q = se3.multiply(left_q[:, None], q[None])
        at, to = se3.compose(seen_p, seen_q, right_p[:, None], right_q[:, None])
        values = value(at.reshape(-1, 3), se3.normalise(to.reshape(-1, 4)))
        return np.asarray(values.reshape(samples, len(p)).mean(axis=0), dtype=np.float64)

    return mean


def _draws(noise: PoseNoise | None, normal: Floats) -> tuple[Floats, Floats]:
    scale = (0.0, 0.0) if noise is None else (noise.sigma_position_m, noise.sigma_rotation)
    return normal[:, :3] * scale[0], se3.from_rotation_vector(normal[:, 3:] * scale[1])
