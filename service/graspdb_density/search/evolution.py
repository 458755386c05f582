"""Search by values alone: random search, then evolution strategies.

A density has its own climb (`mode_search`). A success probability's lower end, an expectation under noise or
a mixture kernel's density have none: from where an isotropic density is high, random steps first, then
evolution strategies that learn how the score falls off.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from .. import se3
from ..se3 import Floats, Poses
from .lazy_search import ClimbedSearch
from .multi_start import REACH, Indices
from .scored_poses import (
    Admissible,
    Bools,
    Maximum,
    Pull,
    Score,
    ScoredPoses,
    Separation,
    distinct_from,
    ranked_by_density_where_flat,
)

__all__ = ["EvolutionSearch"]

_CANDIDATES = 192
#: Centres whose score is asked for before any is climbed from: a density tells little of where another score
#: is high.
_ASKED = 4096
#: Random search: from how many poses, steps one tries at a time, how often.
_FIRST, _TRIES, _ROUNDS = 64, 8, 12
#: Of what it passed, so many are valued by the score itself. From the best start strategies: so many for so
#: many generations, then the best of them, each of so many poses a generation.
_FINALISTS, _PLAN, _POPULATION = 32, ((12, 12), (6, 12), (3, 24)), 14
#: Of what strategies led to by a score that is not the one asked for, so many are valued by that.
_RESCORED = 24
#: Generations of a runner-up's strategy, which stays away from the other answers, and how many have one.
_RUNNER_UP, _RUNNERS_UP = ((1, 20),), 8
#: Draws around centres in reach, and how many of them may join the starts: where the nearest poses of centres
#: are refused, others may not be.
_DRAWN, _JOINING = 2048, 64
#: As many equal scores, the highest of those that random search passed, make a plateau.
_FLAT = 16
#: Steps in kernel widths.
_FIRST_STEP, _LAST_STEP = 0.6, 0.4


@dataclass(eq=False)
class EvolutionSearch(ClimbedSearch):
    """The best distinct grasps by ``score``.

    Starts are well separated centres of the density, projected into the region, those of the highest score
    among at most 4,096 centres: half of them where the density is highest, half drawn at random. From the
    best, random steps that shrink as they fail. Of where these led, the best go on by CMA-ES (Hansen and
    Ostermeier, 2001), which learns along which directions a score falls off slowly. All is drawn from fixed
    seeds.

    Attributes
    ----------
    score
        `Maximum.score`.
    rough
        Nearly the score but faster: ranks starts and leads the random search.
    pull
        Brings poses nearer to where they are admissible; random steps end where it puts them.
    resolution
        See `ranked_by_density_where_flat`; the density is the isotropic one that is started from, asked only
        where the best scores of the random search are equal.
    rescored
        So many of the best by ``rough`` are ranked by the score before some are chosen: for a score that may
        rank otherwise.
    leading
        Nearer to the score than ``rough`` and faster than it: leads the strategies; the best of their ends
        are then valued by the score. None: the score itself leads.
    """

    exactly: ClassVar[int] = 64
    score: Score
    rough: Score
    pull: Pull | None
    resolution: float = 0.0
    rescored: int = 0
    leading: Score | None = None
    flat: bool = field(default=False, init=False)

    def run(self, count: int, separation: Separation) -> list[Maximum]:
        """The best distinct grasps."""
        starts = self.all_starts(max(_CANDIDATES, 3 * count), count, separation)
        if not len(starts):
            return []
        passed = self.random_search(starts)
        if self.rescored:
            best = passed[: self.rescored]
            passed = ScoredPoses(best.poses, self.values(self.score, best.poses)).ranked()
        self.flat = self.is_flat(passed.scores)
        if self.flat:
            passed = ScoredPoses(passed.poses, self.told_apart(passed.scores, passed.poses)).ranked()
        # More than are wanted: those that go on drive out others on their way.
        best = self.choose(passed, max(2 * count, _FINALISTS), separation)
        best = self.led(best.poses).ranked()
        best = ScoredPoses.joined(best, self.evolve(best, _PLAN)).ranked()
        best = self.choose(self.rescoring(best[: max(2 * count, _RESCORED)]), count, separation)
        for place in range(1, min(len(best), _RUNNERS_UP)):
            others = best.poses[np.arange(len(best)) != place]
            apart = distinct_from(others, separation, twins=self.twins)
            ended = self.evolve(self.led(best.poses[place : place + 1]), _RUNNER_UP, apart)
            ended = self.rescoring(ended)
            if ended.scores[0] > best.scores[place]:
                best.put(place, ended, 0)
        best = best.ranked()
        return self.maxima(best, self.values(self.score, best.poses) if self.flat else best.scores)

    def led(self, poses: Poses) -> ScoredPoses:
        """Poses as strategies see them."""
        values = self.values(self.leading or self.score, poses)
        return ScoredPoses(poses, self.told_apart(values, poses))

    def rescoring(self, led: ScoredPoses) -> ScoredPoses:
        """What strategies saw, ranked by the score."""
        if self.leading is None:
            return led
        values = self.values(self.score, led.poses)
        return ScoredPoses(led.poses, self.told_apart(values, led.poses)).ranked()

    def values(self, score: Score, poses: Poses) -> Floats:
        """A score at poses (K,)."""
        values = np.asarray(score(poses), dtype=np.float64)
        if values.shape != (len(poses),):
            raise ValueError(f"the score answered shape {values.shape} for {len(poses)} poses")
        return values

    def is_flat(self, scores: Floats) -> bool:
        """Whether the best of some scores (K,) differ by less than means anything."""
        return len(scores) >= _FLAT and bool(np.ptp(np.partition(scores, -_FLAT)[-_FLAT:]) < self.resolution)

    def told_apart(self, scores: Floats, poses: Poses) -> Floats:
        """What poses (K,) are ranked by: their scores, and the density where those are flat."""
        if not self.flat or not len(poses):
            return scores
        sums = self.density.kernel_sums(poses, cutoff=REACH, threads=self.threads)
        logs = np.log(np.maximum(sums, np.finfo(np.float64).tiny))
        return ranked_by_density_where_flat(scores, logs, float(self.ranking.centres[0, 7]), self.resolution)

    # -- starts

    def candidates(self) -> Iterator[tuple[Indices, Bools]]:
        bounds, turned = self.bounds(0, self.density.size)
        places = np.flatnonzero(bounds > -np.inf)
        rest = places[:0]
        if len(places) > _ASKED:
            places = places[np.argsort(-bounds[places], kind="stable")]
            others = np.random.default_rng(0).permutation(places[_ASKED // 2 :])
            places = np.concatenate([places[: _ASKED // 2], others[: _ASKED // 2]])
            rest = others[_ASKED // 2 :]
        # Where none of the first is admissible another may be.
        for part in (places, *np.array_split(rest, -(-len(rest) // _ASKED) or 1)):
            if len(part):
                yield self.ranking.order[part], turned[part]

    def starts(self, wanted: int, separation: Separation) -> ScoredPoses:
        starts = super().starts(wanted, separation)
        near = next(self.candidates(), None)
        if near is None:
            return starts
        rng = np.random.default_rng(0)
        some = rng.integers(0, len(near[0]), _DRAWN)
        centres = self.centres(near[0][some], near[1][some])
        moves, turns = self.density.kernel.sample_displacements(_DRAWN, rng)
        moved = Poses(centres.positions + moves, se3.multiply(centres.quaternions_xyzw, turns))
        drawn, inside = self.landed(moved)
        return self.add_distinct(starts, self.valued(drawn[inside]), len(starts) + _JOINING, separation)

    def valued(self, poses: Poses) -> ScoredPoses:
        return ScoredPoses(poses, self.values(self.rough, poses)).ranked()

    def landed(self, poses: Poses) -> tuple[Poses, Bools]:
        """Poses brought into the region, pulled to where they are admissible, and which are inside then."""
        p, q, inside = self.region.project(*poses)
        poses = Poses(p, q) if self.pull is None else self.pull(Poses(p, q))
        return poses, inside & self.region.contains(*poses)

    # -- random search

    def random_search(self, starts: ScoredPoses) -> ScoredPoses:
        """The starts and what random steps from the best of them passed, by the rough score, best first."""
        rng = np.random.default_rng(0)
        ends, passed = starts.ranked()[:_FIRST], [starts]
        step = np.full(len(ends), _FIRST_STEP)
        for _ in range(_ROUNDS):
            ends, step, moved = self.stepped(ends, step, rng)
            passed.append(ends[moved])
        return ScoredPoses.joined(*passed).ranked()

    def stepped(
        self, at: ScoredPoses, step: Floats, rng: np.random.Generator
    ) -> tuple[ScoredPoses, Floats, Bools]:
        """From each of K poses, the best of random steps where that is better and admissible; lengths (K,) to
        try next, in kernel widths, longer after a success and shorter after a failure; and which moved.
        """
        kernel, count = self.density.kernel, len(at)
        scale = np.repeat(step, _TRIES)[:, None]
        tried = at.poses[np.repeat(np.arange(count), _TRIES)]
        moves = rng.standard_normal((len(tried), 3)) * scale * kernel.sigma_position_m
        turns = rng.standard_normal((len(tried), 3)) * scale * kernel.sigma_rotation
        turned = se3.multiply(tried.quaternions_xyzw, se3.from_rotation_vector(turns))
        tried, inside = self.landed(Poses(tried.positions + moves, turned))
        scores = np.full(len(tried), -np.inf)
        scores[inside] = self.values(self.rough, tried[inside])
        shape = count, _TRIES, -1
        p, q = tried.positions.reshape(shape), tried.quaternions_xyzw.reshape(shape)
        ends, moved = self.best_tries(at, at.scores, p, q, scores.reshape(count, _TRIES))
        return ends, np.where(moved, np.minimum(1.1 * step, 1.0), 0.6 * step), moved

    # -- where one test is dear

    def worth(self, poses: Poses) -> ScoredPoses:
        return ScoredPoses(poses, self.told_apart(self.values(self.score, poses), poses))

    def told(self, best: ScoredPoses) -> Floats:
        return best.scores

    def step_from(
        self, at: ScoredPoses, step: Floats, tries: int, rng: np.random.Generator
    ) -> tuple[ScoredPoses, Floats]:
        ends, step, _ = self.stepped(at, step, rng)
        return ends, step

    # -- evolution

    def evolve(
        self, starts: ScoredPoses, plan: tuple[tuple[int, int], ...], apart: Admissible | None = None
    ) -> ScoredPoses:
        """The best admissible pose that a strategy from each of the best starts found.

        Parameters
        ----------
        starts
            With their scores.
        plan
            How many go on, for how many generations; how many of them go on, and so forth.
        apart
            Refuses poses besides ``admissible``.
        """
        from cmaes import CMA  # late: 0.5 s, for it imports scipy.stats; a density's best grasp needs none

        best = starts[np.arange(len(starts))]
        strategies = [CMA(np.zeros(6), _LAST_STEP, seed=0, population_size=_POPULATION) for _ in best.scores]
        on = begun = np.argsort(-best.scores, kind="stable")[: plan[0][0]]
        for several, generations in plan:
            on = on[np.argsort(-best.scores[on], kind="stable")[:several]]
            for _ in range(generations):
                steps = np.array([[strategies[i].ask() for _ in range(_POPULATION)] for i in on])
                tried = self.tried(starts.poses[np.repeat(on, _POPULATION)], steps.reshape(-1, 6), apart)
                for i, moves, part in zip(on, steps, np.split(np.arange(len(tried)), len(on)), strict=True):
                    # What is refused ranks last, the farther the later.
                    ranked = np.lexsort((np.sum(moves**2, axis=1), -tried.scores[part]))
                    places = np.argsort(ranked).astype(np.float64)
                    strategies[i].tell(list(zip(moves, places.tolist(), strict=True)))
                    top = part[ranked[0]]
                    if tried.scores[top] > best.scores[i]:
                        best.put(i, tried, top)
        return best[begun]

    def tried(self, at: Poses, steps: Floats, apart: Admissible | None) -> ScoredPoses:
        """Poses ``steps`` (K, 6) kernel widths away, with scores: -inf where they are refused."""
        away = steps * np.repeat(self.widths(1.0), 3)
        turned = se3.multiply(at.quaternions_xyzw, se3.from_rotation_vector(away[:, 3:]))
        poses, allowed = self.landed(Poses(at.positions + away[:, :3], turned))
        for refuses in (apart, self.admissible and self.check):
            if refuses is not None and allowed.any():
                allowed[allowed] = refuses(poses[allowed])
        values = np.full(len(poses), -np.inf)
        if allowed.any():
            values[allowed] = self.led(poses[allowed]).scores
        return ScoredPoses(poses, values)
