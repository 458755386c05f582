"""The best grasps of a density inside a region.

The density is cached at every kernel centre. Centres are scored by what they promise at the nearest feasible
pose; well separated ones, projected into the region, start a projected mean shift (`ascent`). What was passed
on the way is kept: from that pool come the distinct runners-up and, where a climb ends in a collision, the
pose to go on from.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from . import ascent, se3
from .region import Region
from .se3 import Floats
from .threads import for_blocks

if TYPE_CHECKING:
    from .density import GraspDensity

__all__ = ["Admissible", "Maximum", "Pool", "Search", "nearest", "search"]

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
_PROMISING, _FINALISTS = 0.9, 8
#: Share of starts without a near kernel from which on the second cut is used at once.
_LOST = 0.2
#: A climb ends where the next step promises no more than this in log density.
_GAIN = 1e-5
#: Where centres are ranked by a sample of kernels: so many times the starts.
_ROUGH_STARTS = 2
#: Kernel widths between the poses passed that are kept.
_APART = 0.3
#: Around blocked climbs: poses searched from, random steps at a time, how often.
_EXPLORED = ((32, 8, 6), (8, 12, 10), (3, 16, 20))
_SHORTLIST = 1024
#: Poses shown to ``admissible`` at a time and in all while looking for starts.
_BATCH = 64
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
        self.ranking = density.ranking(threads)

    # -- steps
    # ------------------------------------------------------------------------------------------------------

    def run(self, count: int, separation_m: float, separation: float) -> list[Maximum]:
        wanted = max(self.starts_wanted, 3 * count)
        starts = self.starts(wanted if self.ranking.sample is None else _ROUGH_STARTS * wanted)
        if not len(starts):
            return []
        pool, ends = self.climbed(starts, max(_FINALISTS, 2 * count))
        pool = starts.joined(pool).sort()
        chosen: list[int] = []
        if self.admissible is not None and len(ends):
            allowed = self.check(ends.positions, ends.quaternions)
            if not allowed[int(np.argmax(ends.sums))]:
                # The best climb ended where the gripper collides: look around the best poses that do not.
                pool = pool.joined(self.explore(pool)).sort()
        chosen = self.choose(pool, count, separation_m, separation)
        if not chosen:
            return []
        found = pool.take(np.array(chosen))
        logs = self.density.log_density(found.positions, found.quaternions)
        scores = self.values(found.positions, found.quaternions)
        maxima = [
            Maximum(p, se3.canonical(q), float(log), self.region.active(p, q), float(score))
            for p, q, log, score in zip(found.positions, found.quaternions, logs, scores, strict=True)
        ]
        return sorted(maxima, key=lambda m: -m.score)

    def values(self, positions: Floats, quaternions: Floats) -> Floats:
        """The scores to report."""
        return self.density.log_density(positions, quaternions)

    def starts(self, wanted: int) -> Pool:
        """Separated feasible poses to climb from, admissible ones only."""
        density = self.density
        kernel = density.kernel
        scores, turned = self.scores()
        pending = np.flatnonzero(scores > -np.inf)
        found = Pool(np.empty((0, 3)), np.empty((0, 4)), np.empty(0))
        size = _SHORTLIST
        while pending.size and len(found) < wanted and self.checks < _MOST_CHECKS:
            if pending.size > size:
                split = np.argpartition(-scores[pending], size)
                head, pending = pending[split[:size]], pending[split[size:]]
            else:
                head, pending = pending, pending[:0]
            size *= 4
            head = head[np.argsort(-scores[head], kind="stable")]
            positions, quaternions = density.positions[head], density.quaternions_xyzw[head]
            flip = turned[head]
            quaternions = np.where(flip[:, None], se3.jaw_twin(quaternions), quaternions)
            near_p, near_q, inside = self.region.project(positions, quaternions)
            # Scores were optimistic about how far the region is; now the distance is known.
            inside &= np.linalg.norm(near_p - positions, axis=1) <= REACH * kernel.sigma_position_m
            inside &= se3.angle_between(near_q, quaternions) <= REACH * kernel.sigma_rotation
            near_p, near_q = near_p[inside], near_q[inside]
            if not len(near_p):
                continue
            found = self.add_distinct(found, near_p, near_q, wanted)
        return found

    def add_distinct(self, found: Pool, positions: Floats, quaternions: Floats, wanted: int) -> Pool:
        """Join to ``found`` the poses distinct by one kernel width, in order, until there are ``wanted``."""
        kernel = self.density.kernel
        joined_p = np.concatenate([found.positions, positions])
        joined_q = np.concatenate([found.quaternions, quaternions])
        known = len(found)
        usable = np.ones(len(joined_p), dtype=bool)
        limit = wanted
        while True:
            rest = np.flatnonzero(usable[known:]) + known
            order = np.concatenate([np.arange(known), rest])
            kept = np.empty(max(limit, known), dtype=np.int64)
            kept[:known] = np.arange(known)
            total = ascent.thin(
                np.ascontiguousarray(joined_p[order]), np.ascontiguousarray(joined_q[order]), known, limit,
                _SPREAD * kernel.sigma_position_m, _SPREAD * kernel.sigma_rotation, self.twins, kept,
            )  # fmt: skip
            picked = order[kept[known:total]]
            if self.admissible is None or not picked.size:
                break
            allowed = self.check(joined_p[picked], joined_q[picked])
            usable[picked[~allowed]] = False
            if allowed.all() or self.checks >= _MOST_CHECKS:
                picked = picked[allowed]
                break
        if not picked.size:
            return found
        fresh = Pool(joined_p[picked], joined_q[picked], np.empty(len(picked)))
        fresh.sums = self.sums(fresh.positions, fresh.quaternions)
        return found.joined(fresh)

    def scores(self) -> tuple[Floats, NDArray[np.bool_]]:
        density, region = self.density, self.region
        kernel = density.kernel
        sums = self.ranking.values
        scores, turned = np.empty(density.size), np.empty(density.size, dtype=bool)

        def work(begin: int, end: int) -> None:
            part = slice(begin, end)
            ascent.score_centres(
                density.positions[part], density.quaternions_xyzw[part], density.symmetric[part], sums[part],
                region.planes, region.balls, region.cones, kernel.sigma_position_m, kernel.kappa,
                REACH * kernel.sigma_position_m, REACH * kernel.sigma_rotation, scores[part], turned[part],
            )  # fmt: skip

        for_blocks(work, density.size, block=16_384, threads=self.threads)
        return scores, turned

    def climbed(self, starts: Pool, finalists: int) -> tuple[Pool, Pool]:
        """Poses passed while climbing, and the ends."""
        passed, ends = self.climb(starts, _FIRST_STEPS, _FIRST_CUT)
        if np.mean(ends.sums == 0.0) > _LOST:
            # In the tails no kernel is that near.
            passed, ends = self.climb(starts, _FIRST_STEPS)
        ends = self.scored(ends)
        on, last = self.climb(best_of(ends, _PROMISING, finalists), _STEPS)
        last = self.scored(last)
        return self.scored(self.thinned(passed.joined(on), 4 * finalists)).joined(ends).joined(last), last

    def climb(self, starts: Pool, steps: int, cut: float = _CUT) -> tuple[Pool, Pool]:
        """Poses passed from every start and the ends; their sums are those of `ascent.climb`."""
        density, region, cells = self.density, self.region, self.density.cells
        path = np.zeros((len(starts), steps, ascent.PATH))
        lengths = np.empty(len(starts), dtype=np.int64)

        def work(begin: int, end: int) -> None:
            part = slice(begin, end)
            ascent.climb(
                cells.data, cells.start, cells.table, cells.centre, cells.scale,
                region.planes, region.balls, region.cones, density.kernel.kappa, cut,
                starts.positions[part], starts.quaternions[part], _GAIN, path[part], lengths[part],
            )  # fmt: skip

        for_blocks(work, len(starts), block=4, threads=self.threads)
        passed = path[np.arange(steps)[None, :] < lengths[:, None]]
        ends = pool_of(path[np.arange(len(starts)), np.maximum(lengths, 1) - 1])
        still = lengths == 0
        # Nothing near enough to climb on: the start is the end.
        ends.positions[still], ends.quaternions[still] = starts.positions[still], starts.quaternions[still]
        ends.sums[still] = 0.0
        return pool_of(passed), ends

    def scored(self, pool: Pool) -> Pool:
        """With sums over all kernels."""
        return Pool(pool.positions, pool.quaternions, self.sums(pool.positions, pool.quaternions))

    def thinned(self, pool: Pool, most: int) -> Pool:
        """The best poses of a pool that are a few tenths of a kernel's width apart."""
        kernel, pool = self.density.kernel, pool.sort()
        kept = np.empty(most, dtype=np.int64)
        total = ascent.thin(
            pool.positions, pool.quaternions, 0, most,
            _APART * kernel.sigma_position_m, _APART * kernel.sigma_rotation, self.twins, kept,
        )  # fmt: skip
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

    def choose(self, pool: Pool, count: int, separation_m: float, separation: float) -> list[int]:
        """Indices of the best distinct admissible poses of a sorted pool."""
        usable = (
            self.region.contains(pool.positions, pool.quaternions) if len(pool) else np.empty(0, dtype=bool)
        )
        confirmed = np.zeros(len(pool), dtype=bool)
        budget = self.checks + _MOST_CHECKS
        while True:
            index = np.flatnonzero(usable)
            kept = np.empty(count, dtype=np.int64)
            total = ascent.thin(
                np.ascontiguousarray(pool.positions[index]), np.ascontiguousarray(pool.quaternions[index]), 0,
                count, separation_m, separation, self.twins, kept,
            )  # fmt: skip
            picked = index[kept[:total]]
            if self.admissible is None:
                return [int(i) for i in picked]
            doubtful = picked[~confirmed[picked]]
            if not doubtful.size:
                return [int(i) for i in picked]
            if self.checks >= budget:
                return [int(i) for i in picked if confirmed[i]]
            # The next in line go along: a call for one pose costs nearly as much as for a batch.
            line = index[~confirmed[index]]
            batch = np.union1d(doubtful, line[:_BATCH])
            allowed = self.check(pool.positions[batch], pool.quaternions[batch])
            confirmed[batch[allowed]] = True
            usable[batch[~allowed]] = False

    def explore(self, pool: Pool) -> Pool:
        """Random search from the best admissible poses, where the climbs that ignored it ended in collisions:
        from many for a little, from the best of them further.
        """
        kernel = self.density.kernel
        rng = np.random.default_rng(0)
        first = self.choose(pool, _EXPLORED[0][0], kernel.sigma_position_m, kernel.sigma_rotation)
        ends, step = pool.take(np.array(first, dtype=np.intp)), np.full(len(first), 0.5)
        passed = ends.take(np.arange(0))
        for climbs, tries, rounds in _EXPLORED:
            order = np.argsort(-ends.sums, kind="stable")[:climbs]
            ends, step = ends.take(order), step[order]
            for _ in range(rounds):
                ends, step, moved = self.stepped(ends, step, tries, rng)
                passed = passed.joined(ends.take(moved))
        return passed

    def stepped(
        self, ends: Pool, step: Floats, tries: int, rng: np.random.Generator, longer: float = 1.0
    ) -> tuple[Pool, Floats, NDArray[np.bool_]]:
        """From each of some poses, the best of random steps where that is better and admissible.

        Returns
        -------
        ends : Pool
        step : (K,)
            Lengths to try next, in kernel widths: times ``longer`` after a success, shorter after a failure.
        moved : (K,) bool
        """
        kernel = self.density.kernel
        scale = np.repeat(step, tries)[:, None]
        at, to = np.repeat(ends.positions, tries, axis=0), np.repeat(ends.quaternions, tries, axis=0)
        away = at + rng.standard_normal(at.shape) * scale * kernel.sigma_position_m
        turns = se3.from_rotation_vector(rng.standard_normal(at.shape) * scale * kernel.sigma_rotation)
        p, q, inside = self.region.project(away, se3.multiply(to, turns))
        scores = np.full(len(p), -np.inf)
        scores[inside] = self.sums(p[inside], q[inside])
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
        return there, np.where(moved, np.minimum(longer * step, 1.0), 0.6 * step), moved


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
    ascent.score_centres(
        density.positions, density.quaternions_xyzw, density.symmetric, np.ones(density.size),
        region.planes, region.balls, region.cones, kernel.sigma_position_m, kernel.kappa, math.inf, math.inf,
        scores, turned,
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
