"""Multi-start search: distinct feasible poses to start from, and the choice among poses that searches passed.

Starts are centres of kernels, projected into the region. No centre is worth more at its nearest feasible pose
than at itself, so centres are looked at in the order of `StartRanking` and only as far as needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .. import se3
from .._compiled.threads import for_blocks
from ..kde.isotropic import GraspDensity
from ..se3 import Floats, Poses
from . import mean_shift
from .region import Region
from .scored_poses import Admissible, Bools, Maximum, Score, ScoredPoses, Separation
from .start_ranking import StartRanking

__all__ = ["MOST_CHECKS", "REACH", "MultiStart"]

Indices = NDArray[np.intp]

#: A pose is within a kernel's cut-off when position and rotation are each within this many
#: standard deviations.
REACH = 4.0
#: Centres bounded at a time and looked at closer at a time, at first.
_BLOCK, _SHORTLIST = 4096, 1024
#: Poses shown to ``admissible`` in all while looking for starts.
MOST_CHECKS = 8192


@dataclass(eq=False)
class MultiStart:
    """One search. Its kinds say what is climbed, and how.

    Attributes
    ----------
    density, ranking
        Whose centres searches start from.
    log_density
        What answers are told with.
    checks
        Poses shown to ``admissible`` so far.
    """

    density: GraspDensity
    ranking: StartRanking
    log_density: Score
    region: Region
    admissible: Admissible | None
    threads: int
    checks: int = field(default=0, init=False)
    twins: bool = field(init=False)

    def __post_init__(self) -> None:
        self.twins = bool(self.density.symmetric.all())

    def widths(self, count: float) -> Separation:
        """So many kernel widths."""
        kernel = self.density.kernel
        return Separation(count * kernel.sigma_position_m, count * kernel.sigma_rotation)

    # -- starts

    def all_starts(self, wanted: int, count: int, separation: Separation) -> ScoredPoses:
        """Starts for ``count`` answers: runners-up may have to be farther apart than the best starts are."""
        starts = self.starts(wanted, self.widths(1.0))
        if count > 1 and len(starts):
            return ScoredPoses.joined(starts, self.starts(2 * count, separation))
        return starts

    def starts(self, wanted: int, separation: Separation) -> ScoredPoses:
        """Distinct feasible poses to climb from, admissible ones only, the most promising first."""
        reach = self.widths(REACH)
        starts = ScoredPoses.unscored(Poses(np.empty((0, 3)), np.empty((0, 4))))
        for rows, turned in self.candidates():
            centres = self.centres(rows, turned)
            p, q, inside = self.region.project(centres.positions, centres.quaternions_xyzw)
            # Bounds were optimistic about how far the region is; now the distance is known.
            inside &= np.linalg.norm(p - centres.positions, axis=1) <= reach.metres
            inside &= se3.angle_between(q, centres.quaternions_xyzw) <= reach.radians
            starts = self.add_distinct(starts, self.valued(Poses(p, q)[inside]), wanted, separation)
            if len(starts) >= wanted or self.checks >= MOST_CHECKS:
                break
        return starts

    def centres(self, rows: Indices, turned: Bools) -> Poses:
        """Centres of rows, or of their jaw's twins."""
        return Poses(self.density.positions[rows], self.density.quaternions_xyzw[rows]).turned(turned)

    def valued(self, poses: Poses) -> ScoredPoses:
        """Poses to start from, in the order in which they are to be taken."""
        return ScoredPoses.unscored(poses)

    def candidates(self) -> Iterator[tuple[Indices, Bools]]:
        """Rows whose feasible pose is in reach, by falling bound, in growing batches, and whether the jaw's
        twin is nearer.
        """
        ranking, count = self.ranking, self.density.size
        bounds, turned = np.full(count, -np.inf), np.zeros(count, dtype=bool)
        begin, block, size = 0, _BLOCK, _SHORTLIST
        while True:
            while True:
                # Nothing behind can have a higher bound than the next centre's own value.
                ahead = float(ranking.centres[begin, 7]) if begin < count else -math.inf
                best = np.flatnonzero(bounds[:begin] > ahead)
                if begin == count or len(best) >= size:
                    break
                end = min(begin + block, count)
                bounds[begin:end], turned[begin:end] = self.bounds(begin, end)
                begin, block = end, 2 * block
            if not len(best):
                return
            if len(best) > size:
                best = best[np.argpartition(-bounds[best], size)[:size]]
            best = best[np.argsort(-bounds[best], kind="stable")]
            yield ranking.order[best], turned[best]
            bounds[best] = -np.inf
            size *= 2

    def bounds(self, begin: int, end: int) -> tuple[Floats, Bools]:
        """Bounds of the log sum at the feasible poses nearest to some centres, and whether the jaw's twin
        is nearer: `mean_shift.bound_centres`.
        """
        ranking, kernel, reach = self.ranking, self.density.kernel, self.widths(REACH)
        bounds, turned = np.empty(end - begin), np.empty(end - begin, dtype=bool)

        def work(first: int, last: int) -> None:
            part = slice(begin + first, begin + last)
            mean_shift.bound_centres(
                ranking.centres[part], ranking.twins[part], self.region.limits,
                kernel.sigma_position_m, kernel.kappa, *reach, bounds[first:last], turned[first:last],
            )  # fmt: skip

        for_blocks(work, end - begin, block=16_384, threads=self.threads)
        return bounds, turned

    # -- choosing

    def add_distinct(
        self, known: ScoredPoses, fresh: ScoredPoses, wanted: int, separation: Separation
    ) -> ScoredPoses:
        """Join to ``known`` the fresh poses distinct from all before, in order, up to ``wanted`` in all."""
        both = ScoredPoses.joined(known, fresh)
        return both[self.distinct(both.poses, len(known), wanted, separation, MOST_CHECKS)]

    def choose(self, ranked: ScoredPoses, count: int, separation: Separation) -> ScoredPoses:
        """The first distinct admissible poses inside the region."""
        inside = self.region.contains(ranked.poses.positions, ranked.poses.quaternions_xyzw)
        ranked = ranked[inside]
        return ranked[self.distinct(ranked.poses, 0, count, separation, self.checks + MOST_CHECKS)]

    def distinct(
        self, poses: Poses, known: int, limit: int, separation: Separation, most_checks: int
    ) -> Indices:
        """Indices of the first ``limit`` distinct admissible poses, after ``known`` that are."""
        usable = np.ones(len(poses), dtype=bool)
        confirmed = np.full(len(poses), self.admissible is None)
        confirmed[:known] = True
        while True:
            index = np.flatnonzero(usable)
            picked: Indices = index[self.thin(poses[index], known, limit, separation)]
            doubtful = picked[~confirmed[picked]]
            if not doubtful.size:
                return picked
            if self.checks >= most_checks:
                return np.asarray(picked[confirmed[picked]])
            # The more were refused, the more of the next in line go along: what was too near to a refused
            # one comes up next, and a call costs as much as ten poses.
            line = index[~confirmed[index]][: len(poses) - len(index)]
            batch = np.union1d(doubtful, line)
            allowed = self.check(poses[batch])
            confirmed[batch[allowed]] = True
            usable[batch[~allowed]] = False

    def thin(self, poses: Poses, known: int, limit: int, separation: Separation) -> Indices:
        """Indices of at most ``limit`` mutually distinct poses, in order, the first ``known`` for certain."""
        kept: Indices = np.arange(max(limit, known))
        total = mean_shift.thin(
            poses.positions, poses.quaternions_xyzw, known, limit, *separation, self.twins, kept
        )
        return kept[:total]

    def check(self, poses: Poses) -> Bools:
        """Ask ``admissible``."""
        assert self.admissible is not None
        self.checks += len(poses)
        allowed = np.asarray(self.admissible(poses), dtype=bool)
        if allowed.shape != (len(poses),):
            raise ValueError(f"admissible answered shape {allowed.shape} for {len(poses)} poses")
        return allowed

    def best_tries(
        self, at: ScoredPoses, least: Floats, positions: Floats, quaternions: Floats, scores: Floats
    ) -> tuple[ScoredPoses, Bools]:
        """Of T tries (K, T) from each of K poses the best, where it is above ``least`` (K,) and admissible,
        else the pose itself; and which those are.
        """
        better = scores > least[:, None]
        if self.admissible is not None and better.any():
            better[better] = self.check(Poses(positions[better], quaternions[better]))
        scores[~better] = -np.inf
        each, winner = np.arange(len(at)), scores.argmax(axis=1)
        moved: Bools = scores[each, winner] > -np.inf
        ends = ScoredPoses(
            Poses(
                np.where(moved[:, None], positions[each, winner], at.poses.positions),
                np.where(moved[:, None], quaternions[each, winner], at.poses.quaternions_xyzw),
            ),
            np.where(moved, scores[each, winner], at.scores),
        )
        return ends, moved

    def maxima(self, best: ScoredPoses, scores: Floats | None = None) -> list[Maximum]:
        """The answer, best first by log density; in the order given where ``scores`` are told instead."""
        if not len(best):
            return []
        logs = self.log_density(best.poses)
        order = np.argsort(-logs, kind="stable") if scores is None else np.arange(len(best))
        scores = logs if scores is None else scores
        p, q = best.poses.positions[order], se3.canonical(best.poses.quaternions_xyzw[order])
        return [
            Maximum(p[i], q[i], float(logs[row]), self.region.active(p[i], q[i]), float(scores[row]))
            for i, row in enumerate(order)
        ]
