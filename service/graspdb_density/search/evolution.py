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
from .multi_start import MOST_CHECKS, REACH, Indices
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
from .start_ranking import CentreScores
from .strategies import Strategies

__all__ = ["EvolutionSearch"]

_CANDIDATES = 64
#: Centres whose score is asked for before any is climbed from: a density tells little of where another score
#: is high. The best of them are brought into the region so many at a time.
_ASKED, _LOOKED = 2048, 256
#: Random search: from how many poses, steps one tries at a time, how often.
_FIRST, _TRIES, _ROUNDS = 24, 6, 6
#: Of what it passed, so many are valued by the score itself. From the best start strategies: so many for so
#: many generations, then the best of them, each of so many poses a generation.
_FINALISTS, _PLAN, _POPULATION = 24, ((10, 10), (5, 10)), 10
#: Of what strategies led to by a score that is not the one asked for, so many are valued by that.
_RESCORED = 12
#: What a leading score led to ends by short strategies of the score itself; their first step, kernel widths.
_ENDING, _ENDING_STEP = ((2, 8), (1, 8)), 0.15
#: Generations of a runner-up's strategy, which stays away from the other answers, and how many have one.
_RUNNER_UP, _RUNNERS_UP = ((1, 16),), 8
#: Draws around centres in reach, and how many of them may join the starts where those are few: where the
#: nearest poses of centres are refused, others may not be.
_DRAWN, _JOINING = 1024, 64
#: As many equal scores, the highest of those that random search passed, make a plateau.
_FLAT = 16
#: A number whose multiples scatter (Knuth, The Art of Computer Programming, volume 3, 6.4).
_SCATTER = 2_654_435_761
#: A pose that was moved by less, metres or radians, is where it was.
_STILL = 1e-6
#: Steps in kernel widths.
_FIRST_STEP, _LAST_STEP = 0.6, 0.4


@dataclass(eq=False)
class EvolutionSearch(ClimbedSearch):
    """The best distinct grasps by ``score``.

    Starts are well separated centres of the density, projected into the region, those of the highest score
    among at most 2,048 centres: half of them where the density is highest, half scattered. From the
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
    known
        What ``rough`` gives at centres, as far as it was asked before.
    """

    exactly: ClassVar[int] = 64
    score: Score
    rough: Score
    pull: Pull | None
    resolution: float = 0.0
    rescored: int = 0
    leading: Score | None = None
    known: CentreScores = field(default_factory=CentreScores)
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
        best = self.rescoring(best[: max(2 * count, _RESCORED)])
        if self.leading is not None:
            best = ScoredPoses.joined(best, self.ended(best)).ranked()
        best = self.choose(best, count, separation)
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

    def ended(self, best: ScoredPoses) -> ScoredPoses:
        """Where short strategies lead by the score itself from the best that others led to."""
        leading, self.leading = self.leading, None
        try:
            return self.evolve(best, _ENDING, step=_ENDING_STEP)
        finally:
            self.leading = leading

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
        places, half = np.flatnonzero(bounds > -np.inf), _ASKED // 2
        rest = places[:0]
        if len(places) > _ASKED:
            dense = np.argpartition(-bounds[places], half)
            others = places[dense[half:]]
            # Always the same ones first, whatever the region: what is known of them serves the next search.
            scattered = (self.ranking.order[others] * _SCATTER) % 2**32
            first = np.argpartition(scattered, half)
            places = np.concatenate([places[dense[:half]], others[first[:half]]])
            rest = others[first[half:]]
        places = places[np.argsort(-bounds[places], kind="stable")]
        if len(places):
            yield self.ranking.order[places], turned[places]
        # Where none of the first is admissible another may be.
        for part in np.array_split(rest, -(-len(rest) // _ASKED) or 1):
            if len(part):
                yield self.ranking.order[part], turned[part]

    def starts(self, wanted: int, separation: Separation) -> ScoredPoses:
        starts = ScoredPoses.unscored(Poses(np.empty((0, 3)), np.empty((0, 4))))
        looked: list[Poses] = []
        for rows, turned in self.candidates():
            looked.append(self.centres(rows, turned))
            worth = self.known.at(rows, self.density.poses, lambda poses: self.values(self.rough, poses))
            best = np.argsort(-worth, kind="stable")
            for first in range(0, len(best), _LOOKED):
                some = best[first : first + _LOOKED]
                near = self.brought_in(looked[-1][some], worth[some])
                starts = self.add_distinct(starts, near, wanted, separation)
                if len(starts) >= wanted or self.checks >= MOST_CHECKS:
                    break
            if len(starts) >= wanted or self.checks >= MOST_CHECKS:
                break
        if len(starts) >= wanted or not looked:
            return starts
        return self.joined_by_draws(starts, looked[0], separation)

    def brought_in(self, centres: Poses, worth: Floats) -> ScoredPoses:
        """The poses of the region nearest to some centres (K), those in reach, by the rough score, best
        first; ``worth`` (K,) is that of the centres themselves.
        """
        p, q, inside = self.region.project(*centres)
        reach = self.widths(REACH)
        away, turned = (
            np.linalg.norm(p - centres.positions, axis=1),
            se3.angle_between(q, centres.quaternions_xyzw),
        )
        inside &= (away <= reach.metres) & (turned <= reach.radians)
        moved = (away > _STILL) | (turned > _STILL)
        scores = worth.copy()
        if (inside & moved).any():
            scores[inside & moved] = self.values(self.rough, Poses(p, q)[inside & moved])
        return ScoredPoses(Poses(p, q), scores)[inside].ranked()

    def joined_by_draws(self, starts: ScoredPoses, near: Poses, separation: Separation) -> ScoredPoses:
        """The starts, and some draws from the kernels ``near``, which are in reach."""
        rng = np.random.default_rng(0)
        centres = near[rng.integers(0, len(near), _DRAWN)]
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
        self,
        starts: ScoredPoses,
        plan: tuple[tuple[int, int], ...],
        apart: Admissible | None = None,
        step: float = _LAST_STEP,
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
        step
            The first one, in kernel widths.
        """
        best = starts[np.arange(len(starts))]
        strategies = Strategies(len(best), step, _POPULATION)
        on = begun = np.argsort(-best.scores, kind="stable")[: plan[0][0]]
        for several, generations in plan:
            on = on[np.argsort(-best.scores[on], kind="stable")[:several]]
            for _ in range(generations):
                steps = strategies.ask(on)
                tried = self.tried(starts.poses[np.repeat(on, _POPULATION)], steps.reshape(-1, 6), apart)
                scores = tried.scores.reshape(len(on), _POPULATION)
                # What is refused ranks last, the farther the later.
                ranked = np.lexsort((np.sum(steps**2, axis=2), -scores), axis=1)
                strategies.tell(on, np.take_along_axis(steps, ranked[..., None], axis=1))
                top = ranked[:, 0] + _POPULATION * np.arange(len(on))
                for i, place in zip(on, top, strict=True):
                    if tried.scores[place] > best.scores[i]:
                        best.put(i, tried, place)
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
