"""The best grasps of a density inside a region.

The density is cached at every kernel centre. Centres are scored by what they promise at the nearest feasible
pose; well separated ones, projected into the region, start a projected mean shift (`ascent`), first over a
sample of the kernels where there is one, then, from the best ends, over all. Where the best climb ends in a
collision, random steps from the best poses that do not look for the edge of the free space. What was passed
on the way is kept: from that pool come the distinct runners-up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .. import se3
from .._compiled.threads import for_blocks
from ..kde.cell_list import Cells
from ..se3 import Floats
from . import mean_shift
from .region import Region

if TYPE_CHECKING:
    from ..kde.isotropic import GraspDensity

__all__ = ["Admissible", "Maximum", "Pool", "Search", "distinct_from", "nearest", "search"]

#: Whether poses (K, 3), (K, 4) are free of what a region can't express, collisions for one: (K,) bool.
Admissible = Callable[[Floats, Floats], NDArray[np.bool_]]

#: A pose is within a kernel's cut-off when position and rotation are each within this many
#: standard deviations.
REACH = 4.0
_STARTS = 24
#: Kernel widths between two starts.
_SPREAD = 1.0
#: All starts climb a few steps among the nearest kernels; those that then are near the best climb on. The
#: cuts are exponents, of 3 and 4 standard deviations.
_FIRST_STEPS, _FIRST_CUT = 20, 4.5
_STEPS, _CUT = 60, 8.0
_PROMISING, _FINALISTS = 0.95, 8
#: Share of starts without a near kernel from which on the second cut is used at once.
_LOST = 0.2
#: A climb ends where the next step promises no more than this in log density.
_GAIN = 1e-5
#: Where centres are ranked by a sample of kernels: so many times the starts for every level below the whole,
#: steps of the first climbs, and how many times the finalists' ends go on among all kernels.
_ROUGH, _ROUGH_STEPS, _DOUBTFUL = 2, 8, 6
#: Kernel widths between the ends of climbs that go on, and between the poses passed that are kept.
_MERGED, _APART = 0.5, 0.3
#: Around blocked climbs: poses searched from, random steps at a time, how often; the cut there.
_EXPLORED, _AROUND = ((32, 10, 4), (8, 16, 7), (3, 24, 14)), 6.0
#: Landmarks scored at a time and looked at closer at a time, at first.
_BLOCK, _SHORTLIST = 4096, 1024
#: Poses shown to ``admissible`` in all while looking for starts.
_MOST_CHECKS = 8192


@dataclass(frozen=True, eq=False, slots=True)
class Maximum:
    """A grasp found by a search.

    Attributes
    ----------
    position : (3,) metres, quaternion_xyzw : (4,)
        Tool frame in the object frame.
    log_density : nats of 1/(m^3 rad^3)
    active_constraints
        Names of the region's limits that hold it, see `Region.active`.
    score
        What it was chosen by: the log density, unless another score was asked for.
    """

    position: Floats
    quaternion_xyzw: Floats
    log_density: float
    active_constraints: tuple[str, ...] = ()
    score: float = math.nan


@dataclass(slots=True)
class Pool:
    """Feasible poses with their kernel sums, best first after `sort`."""

    positions: Floats
    quaternions: Floats
    sums: Floats

    def sort(self) -> Pool:
        order = np.argsort(-self.sums, kind="stable")
        return Pool(self.positions[order], self.quaternions[order], self.sums[order])

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Pool:
        return Pool(self.positions[index], self.quaternions[index], self.sums[index])

    def joined(self, other: Pool) -> Pool:
        return Pool(
            np.concatenate([self.positions, other.positions]),
            np.concatenate([self.quaternions, other.quaternions]),
            np.concatenate([self.sums, other.sums]),
        )

    def __len__(self) -> int:
        return len(self.sums)


def search(
    density: GraspDensity,
    region: Region | None,
    *,
    count: int = 1,
    min_separation_m: float = 0.01,
    min_separation: float = math.radians(20.0),
    admissible: Admissible | None = None,
    threads: int = 1,
) -> list[Maximum]:
    """The ``count`` best distinct grasps, best first; fewer where there are no more, none where none is in
    reach.

    Parameters
    ----------
    density, region
        None: no constraint but ``admissible``.
    min_separation_m, min_separation
        Two grasps are distinct when they are farther apart than this many metres or turned by more than this
        many radians; the jaw's twins are one grasp where every row is symmetric.
    admissible
        Called with poses (K, 3), (K, 4), answers (K,) bool. Never is a pose returned that it refused.
    threads

    Notes
    -----
    A pose is in reach when some kernel's centre is within 4 standard deviations of it in position and in
    rotation.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, not {count}")
    if not (min_separation_m >= 0.0 and min_separation >= 0.0):
        raise ValueError("separations must not be negative")
    region = region or Region()
    return Search(density, region, admissible, threads).run(count, min_separation_m, min_separation)


class Search:
    """One search; `sums` ranks poses and `climbed` refines them."""

    starts_wanted = _STARTS

    def __init__(
        self, density: GraspDensity, region: Region, admissible: Admissible | None, threads: int
    ) -> None:
        self.density = density
        self.region = region
        self.admissible = admissible
        self.threads = threads
        self.twins = bool(density.symmetric.all())
        self.checks = 0
        self.guide = density.guide(threads)

    # -- steps
    # ------------------------------------------------------------------------------------------------------

    def run(self, count: int, separation_m: float, separation: float) -> list[Maximum]:
        starts = self.starts(max(self.starts_wanted, 3 * count) * self.rough, *self.widths(_SPREAD))
        if count > 1 and len(starts):
            # Runners-up may have to be farther apart than the best starts are.
            starts = starts.joined(self.starts(2 * count, separation_m, separation))
        if not len(starts):
            return []
        finalists = max(_FINALISTS, 2 * count)
        passed, ends = self.climbed(starts, finalists)
        found = ends.sort().take(np.arange(min(1, len(ends))))
        good = len(found) > 0 and bool(self.region.contains(found.positions, found.quaternions)[0])
        blocked = False
        if good and self.admissible is not None:
            # Where the gripper collides there, look around the best poses where it does not.
            blocked = not self.check(found.positions, found.quaternions)[0]
        if count > 1 or blocked or not good:
            pool = self.pool(starts, passed, ends, 4 * finalists)
            if blocked:
                pool = pool.joined(self.explore(pool)).sort()
            found = pool.take(self.choose(pool, count, separation_m, separation))
        if not len(found):
            return []
        logs = self.density.log_density(found.positions, found.quaternions)
        return self.maxima(found, logs, logs)

    def maxima(self, found: Pool, logs: Floats, scores: Floats) -> list[Maximum]:
        """What is answered, best first."""
        order = np.argsort(-scores, kind="stable")
        p, q = found.positions[order], se3.canonical(found.quaternions[order])
        return [
            Maximum(p[i], q[i], float(logs[row]), self.region.active(p[i], q[i]), float(scores[row]))
            for i, row in enumerate(order)
        ]

    @property
    def rough(self) -> int:
        """How many times the starts it takes where centres are ranked by a sample."""
        return max(1, _ROUGH * (len(self.guide.levels) - 1))

    def widths(self, count: float) -> tuple[float, float]:
        """So many kernel widths, in metres and radians."""
        kernel = self.density.kernel
        return count * kernel.sigma_position_m, count * kernel.sigma_rotation

    def starts(self, wanted: int, separation_m: float, separation: float) -> Pool:
        """Distinct feasible poses to climb from, admissible ones only, the most promising first."""
        density, reach = self.density, self.widths(REACH)
        found = Pool(np.empty((0, 3)), np.empty((0, 4)), np.empty(0))
        for rows, turned in self.candidates():
            positions, quaternions = density.positions[rows], density.quaternions_xyzw[rows]
            quaternions = np.where(turned[:, None], se3.jaw_twin(quaternions), quaternions)
            near_p, near_q, inside = self.region.project(positions, quaternions)
            # Scores were optimistic about how far the region is; now the distance is known.
            inside &= np.linalg.norm(near_p - positions, axis=1) <= reach[0]
            inside &= se3.angle_between(near_q, quaternions) <= reach[1]
            fresh = self.valued(near_p[inside], near_q[inside])
            found = self.add_distinct(found, fresh, wanted, separation_m, separation)
            if len(found) >= wanted or self.checks >= _MOST_CHECKS:
                break
        return found

    def valued(self, positions: Floats, quaternions: Floats) -> Pool:
        """Poses to start from, not compared yet: the first step of a climb takes their sums."""
        return Pool(positions, quaternions, np.zeros(len(positions)))

    def add_distinct(
        self, found: Pool, fresh: Pool, wanted: int, separation_m: float, separation: float
    ) -> Pool:
        """Join to ``found`` the fresh poses distinct from all before, in order, up to ``wanted`` in all."""
        both = found.joined(fresh)
        return both.take(self.distinct(both, len(found), wanted, separation_m, separation, _MOST_CHECKS))

    def candidates(self) -> Iterator[tuple[NDArray[np.intp], NDArray[np.bool_]]]:
        """Rows whose feasible pose is in reach, the most promising first, in growing batches, and whether
        the jaw's twin is nearer.

        No row promises more than its own centre is worth, so rows are scored in the order of that and only
        as far as needed.
        """
        guide, count = self.guide, self.density.size
        places, scores = np.empty(0, dtype=np.intp), np.empty(0)
        turned = np.empty(0, dtype=bool)
        begin, block, size = 0, _BLOCK, _SHORTLIST
        while True:
            while True:
                ahead = float(guide.landmarks[begin, 7]) if begin < count else -math.inf
                certain = scores > ahead
                if begin == count or np.count_nonzero(certain) >= size:
                    break
                end = min(begin + block, count)
                fresh, flips = self.scores(begin, end)
                known = np.flatnonzero(fresh > -np.inf)
                places, scores = (
                    np.concatenate([places, begin + known]),
                    np.concatenate([scores, fresh[known]]),
                )
                turned = np.concatenate([turned, flips[known]])
                begin, block = end, 2 * block
            index = np.flatnonzero(certain)
            if not len(index):
                return
            if len(index) > size:
                index = index[np.argpartition(-scores[index], size)[:size]]
            index = index[np.argsort(-scores[index], kind="stable")]
            yield guide.order[places[index]], turned[index]
            rest = np.ones(len(places), dtype=bool)
            rest[index] = False
            places, scores, turned = places[rest], scores[rest], turned[rest]
            size *= 2

    def scores(self, begin: int, end: int) -> tuple[Floats, NDArray[np.bool_]]:
        """Promises of some landmarks and whether the jaw's twin keeps them: `mean_shift.score_centres`."""
        guide, region, kernel = self.guide, self.region, self.density.kernel
        scores, turned = np.empty(end - begin), np.empty(end - begin, dtype=bool)

        def work(first: int, last: int) -> None:
            part = slice(begin + first, begin + last)
            mean_shift.score_centres(
                guide.landmarks[part], guide.twins[part], region.planes, region.balls, region.cones,
                kernel.sigma_position_m, kernel.kappa,
                REACH * kernel.sigma_position_m, REACH * kernel.sigma_rotation,
                scores[first:last], turned[first:last],
            )  # fmt: skip

        for_blocks(work, end - begin, block=16_384, threads=self.threads)
        return scores, turned

    def distinct(
        self, pool: Pool, known: int, limit: int, separation_m: float, separation: float, most_checks: int
    ) -> NDArray[np.intp]:
        """Indices of the first ``limit`` distinct admissible poses of a pool, after ``known`` that are."""
        usable = np.ones(len(pool), dtype=bool)
        confirmed = np.full(len(pool), self.admissible is None)
        confirmed[:known] = True
        kept = np.empty(max(limit, known), dtype=np.int64)
        while True:
            index = np.flatnonzero(usable)
            kept[:known] = np.arange(known)
            total = mean_shift.thin(
                pool.positions[index], pool.quaternions[index], known, limit, separation_m, separation,
                self.twins, kept,
            )  # fmt: skip
            picked = np.asarray(index[kept[:total]], dtype=np.intp)
            doubtful = picked[~confirmed[picked]]
            if not doubtful.size:
                return picked
            if self.checks >= most_checks:
                return np.asarray(picked[confirmed[picked]], dtype=np.intp)
            # The more were refused, the more of the next in line go along: what was too near to a refused
            # one comes up next, and a call costs as much as ten poses.
            line = index[~confirmed[index]][: len(pool) - len(index)]
            batch = np.union1d(doubtful, line)
            allowed = self.check(pool.positions[batch], pool.quaternions[batch])
            confirmed[batch[allowed]] = True
            usable[batch[~allowed]] = False

    def climbed(self, starts: Pool, finalists: int) -> tuple[Pool, Pool]:
        """Poses passed while climbing, with the climbs' own sums, and the best ends, with sums over all."""
        levels, sampled = self.guide.levels, len(self.guide.levels) > 1
        cut, steps = _FIRST_CUT, _ROUGH_STEPS if sampled else _FIRST_STEPS
        passed, ends = self.climb(starts, steps, cut, levels[0])
        if np.mean(ends.sums == 0.0) > _LOST:
            # In the tails no kernel is that near.
            cut = _CUT
            passed, ends = self.climb(starts, steps, cut, levels[0])
        for cells in levels[1:]:
            # A sample has more and sharper peaks than the whole, and another one is the highest.
            few = _DOUBTFUL * finalists if cells is levels[-1] else len(ends)
            on, ends = self.climb(self.thinned(ends, few, _MERGED), _FIRST_STEPS, cut, cells)
            passed = passed.joined(on)
        ends = self.scored(self.thinned(ends, 2 * finalists, _MERGED))
        on, last = self.climb(best_of(ends, _PROMISING, finalists), _STEPS)
        return passed.joined(on), self.scored(last)

    def pool(self, starts: Pool, passed: Pool, ends: Pool, most: int) -> Pool:
        """The best feasible poses seen, those to choose from, best first; starts because all are admissible
        and far from each other.
        """
        return self.scored(self.thinned(passed, most, _APART).joined(starts)).joined(ends).sort()

    def climb(
        self, starts: Pool, steps: int, cut: float = _CUT, cells: Cells | None = None
    ) -> tuple[Pool, Pool]:
        """Poses passed from every start and the ends; their sums, and those of the starts from then on, are
        those of `mean_shift.climb`.
        """
        density, region, cells = self.density, self.region, cells or self.density.cells
        path = np.zeros((len(starts), steps, mean_shift.PATH))
        lengths = np.empty(len(starts), dtype=np.int64)

        def work(begin: int, end: int) -> None:
            part = slice(begin, end)
            mean_shift.climb(
                cells.data, cells.start, cells.table, cells.centre, cells.scale,
                region.planes, region.balls, region.cones, density.kernel.kappa, cut,
                starts.positions[part], starts.quaternions[part], _GAIN, path[part], lengths[part],
            )  # fmt: skip

        for_blocks(work, len(starts), block=4, threads=self.threads)
        passed = path[np.arange(steps)[None, :] < lengths[:, None]]
        ends = pool_of(path[np.arange(len(starts)), np.maximum(lengths, 1) - 1])
        still = lengths == 0
        starts.sums = np.where(still, 0.0, path[:, 0, 7])
        # Nothing near enough to climb on: the start is the end.
        ends.positions[still], ends.quaternions[still] = starts.positions[still], starts.quaternions[still]
        ends.sums[still] = 0.0
        return pool_of(passed), ends

    def scored(self, pool: Pool) -> Pool:
        """With sums over all kernels."""
        return Pool(pool.positions, pool.quaternions, self.sums(pool.positions, pool.quaternions))

    def thinned(self, pool: Pool, most: int, apart: float) -> Pool:
        """The best poses of a pool that are ``apart`` kernel widths from each other."""
        pool = pool.sort()
        kept = np.empty(most, dtype=np.int64)
        total = mean_shift.thin(
            pool.positions, pool.quaternions, 0, most, *self.widths(apart), self.twins, kept
        )
        return pool.take(kept[:total])

    def check(self, positions: Floats, quaternions: Floats) -> NDArray[np.bool_]:
        assert self.admissible is not None
        self.checks += len(positions)
        allowed = np.asarray(self.admissible(positions, quaternions), dtype=bool)
        if allowed.shape != (len(positions),):
            raise ValueError(f"admissible answered shape {allowed.shape} for {len(positions)} poses")
        return allowed

    def sums(self, positions: Floats, quaternions: Floats) -> Floats:
        return self.density.kernel_sums(positions, quaternions, cutoff=REACH, threads=self.threads)

    def choose(self, pool: Pool, count: int, separation_m: float, separation: float) -> NDArray[np.intp]:
        """Indices of the best distinct admissible poses of a sorted pool."""
        if not len(pool):
            return np.empty(0, dtype=np.intp)
        index = np.flatnonzero(self.region.contains(pool.positions, pool.quaternions))
        budget = self.checks + _MOST_CHECKS
        return index[self.distinct(pool.take(index), 0, count, separation_m, separation, budget)]

    def explore(self, pool: Pool) -> Pool:
        """Random search from the best admissible poses, where the climbs that ignored it ended in collisions:
        from many for a little, from the best of them further.
        """
        rng = np.random.default_rng(0)
        ends = pool.take(self.choose(pool, _EXPLORED[0][0], *self.widths(1.0)))
        step = np.full(len(ends), 0.5)
        passed = ends.take(np.arange(0))
        levels = self.guide.levels
        for climbs, tries, rounds in _EXPLORED:
            order = np.argsort(-ends.sums, kind="stable")[:climbs]
            ends, step = ends.take(order), step[order]
            # First among the finest sample, if there is one.
            cells = levels[-1] if len(passed) else levels[max(-2, -len(levels))]
            for _ in range(rounds):
                ends, step = self.stepped(ends, step, tries, rng, cells)
            # Sums so far told which step around one pose is better; now poses are compared.
            ends = self.scored(ends)
            passed = passed.joined(ends)
        return passed

    def stepped(
        self, ends: Pool, step: Floats, tries: int, rng: np.random.Generator, cells: Cells
    ) -> tuple[Pool, Floats]:
        """From each of some poses, the best of random steps where that is better and admissible.

        Returns
        -------
        ends : Pool
            The sums of those that moved are of the kernels near before.
        step : (K,)
            Lengths to try next, in kernel widths, shorter after a failure.
        """
        kernel, region = self.density.kernel, self.region
        count = len(ends)
        scale = step[:, None, None]
        moves = rng.standard_normal((count, tries, 3)) * (scale * kernel.sigma_position_m)
        turns = rng.standard_normal((count, tries, 3)) * (scale * kernel.sigma_rotation)
        p, q = np.empty((count, tries, 3)), np.empty((count, tries, 4))
        values = np.empty((count, 1 + tries))

        def work(begin: int, end: int) -> None:
            part = slice(begin, end)
            mean_shift.scatter(
                cells.data, cells.start, cells.table, cells.centre, cells.scale,
                region.planes, region.balls, region.cones, kernel.kappa, _AROUND,
                ends.positions[part], ends.quaternions[part], moves[part], turns[part],
                p[part], q[part], values[part],
            )  # fmt: skip

        for_blocks(work, count, block=8, threads=self.threads)
        scores = values[:, 1:]
        better = scores > values[:, :1]
        if self.admissible is not None and better.any():
            better[better] = self.check(p[better], q[better])
        scores[~better] = -np.inf
        each, winner = np.arange(count), scores.argmax(axis=1)
        moved: NDArray[np.bool_] = scores[each, winner] > -np.inf
        there = Pool(
            np.where(moved[:, None], p[each, winner], ends.positions),
            np.where(moved[:, None], q[each, winner], ends.quaternions),
            np.where(moved, scores[each, winner], ends.sums),
        )
        return there, np.where(moved, np.minimum(step, 1.0), 0.6 * step)


def distinct_from(
    positions: Floats, quaternions: Floats, *, separation_m: float, separation: float, twins: bool
) -> Admissible:
    """Whether a pose is distinct from all given ones (N, 3), (N, 4): farther apart or turned by more.

    With ``twins`` a pose and the one turned half around the jaw's approach are the same.
    """

    def distinct(p: Floats, q: Floats) -> NDArray[np.bool_]:
        near = np.zeros(len(p), dtype=np.bool_)
        for at, to in zip(positions, quaternions, strict=True):
            angle = se3.angle_between(q, to)
            if twins:
                angle = np.minimum(angle, se3.angle_between(q, se3.jaw_twin(to)))
            near |= (np.linalg.norm(p - at, axis=1) <= separation_m) & (angle <= separation)
        return ~near

    return distinct


def best_of(pool: Pool, share: float, most: int) -> Pool:
    """The best poses, at most ``most``, whose sums are at least ``share`` of the highest."""
    pool = pool.sort()
    enough = int(np.sum(pool.sums >= share * pool.sums[0]))
    return pool.take(np.arange(min(enough, most)))


def pool_of(rows: Floats) -> Pool:
    return Pool(rows[:, 0:3].copy(), rows[:, 3:7].copy(), rows[:, 7].copy())


def nearest(
    density: GraspDensity, region: Region, *, admissible: Admissible | None = None, candidates: int = 256
) -> Maximum | None:
    """The feasible pose of highest density among the projections of the centres nearest to a region.

    For an answer where no pose is in reach of a kernel: its ``log_density`` is right though tiny. None where
    the region is empty or ``admissible`` refuses all candidates.
    """
    kernel = density.kernel
    scores, turned = np.empty(density.size), np.empty(density.size, dtype=bool)
    mean_shift.score_centres(
        np.concatenate([density.positions, density.quaternions_xyzw, np.zeros((density.size, 1))], axis=1),
        density.symmetric, region.planes, region.balls, region.cones, kernel.sigma_position_m, kernel.kappa,
        math.inf, math.inf, scores, turned,
    )  # fmt: skip
    if density.size > candidates:
        best = np.argpartition(-scores, candidates)[:candidates]
    else:
        best = np.arange(density.size)
    quaternions = density.quaternions_xyzw[best]
    quaternions = np.where(turned[best][:, None], se3.jaw_twin(quaternions), quaternions)
    p, q, inside = region.project(density.positions[best], quaternions)
    inside &= region.contains(p, q)
    p, q = p[inside], q[inside]
    if admissible is not None and len(p):
        allowed = np.asarray(admissible(p, q), dtype=bool)
        p, q = p[allowed], q[allowed]
    if not len(p):
        return None
    values = density.log_density(p, q)
    top = int(np.argmax(values))
    value = float(values[top])
    return Maximum(p[top], se3.canonical(q[top]), value, region.active(p[top], q[top]), value)
