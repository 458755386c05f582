"""Mode seeking: the best grasps of a density inside a region.

A `ModeSearch` ranks a density's centres once and answers searches from it. A density under an isotropic
kernel is climbed by projected mean shift (`mean_shift`) from well separated centres, first among a sample of
the kernels where there is one, then, from the best ends, among all. Where the best climb ends in a collision,
random steps from the best poses that do not look for the edge of the free space. What was passed on the way
is kept: from that come the distinct runners-up. Any other density, and any other score, is searched by values
alone (`evolution`).
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Hashable
from functools import partial

import numpy as np

from .._compiled.threads import for_blocks
from ..kde.cell_list import Cells
from ..kde.density import SearchedDensity
from ..kde.isotropic import GraspDensity
from ..se3 import Floats, Poses
from . import mean_shift
from .evolution import EvolutionSearch
from .lazy_search import ClimbedSearch, DearTest, LazySearch
from .multi_start import REACH
from .region import Region
from .scored_poses import Admissible, Maximum, Pull, Score, ScoredPoses, Separation
from .start_ranking import CentreScores, CentreSums, StartRanking, centre_sums, rank_starts

__all__ = ["DISTINCT", "MeanShiftSearch", "ModeSearch"]

#: What makes two grasps distinct where nothing is asked.
DISTINCT = Separation(0.01, math.radians(20.0))
_STARTS = 24
#: All starts climb a few steps among the nearest kernels; those that then are near the best climb on. The
#: cuts are exponents, of 3 and 4 standard deviations.
_FIRST_STEPS, _FIRST_CUT = 20, 4.5
_STEPS, _CUT = 60, 8.0
_PROMISING, _FINALISTS = 0.95, 8
#: Share of starts without a near kernel from which on the second cut is used at once.
_LOST = 0.2
#: A climb ends where the next step promises no more than this in log density.
_GAIN = 1e-5
#: Where centres are ranked by a sample of kernels: so many times the starts for every sample to climb among,
#: steps of the first climbs, and how many times the finalists' ends go on among all kernels.
_ROUGH, _ROUGH_STEPS, _DOUBTFUL = 2, 8, 6
#: Kernel widths between the ends of climbs that go on, and between the poses passed that are kept.
_MERGED, _APART = 0.5, 0.3
#: Rough scores of which what they give at centres is kept.
_KEPT = 6
#: Around blocked climbs: poses searched from, random steps at a time, how often; the cut there.
_EXPLORED, _AROUND = ((32, 10, 4), (8, 16, 7), (3, 24, 14)), 6.0


class ModeSearch:
    """Searches in one density; what they share is computed once. Safe to use from several threads.

    Parameters
    ----------
    density
        What is maximised.
    centres
        The density under an isotropic kernel from whose centres searches by values start. None:
        ``density.isotropic``.
    """

    def __init__(self, density: SearchedDensity, centres: GraspDensity | None = None) -> None:
        self.density = density
        self.centres = density.isotropic if centres is None else centres
        self._by_values = self if self.centres is density else ModeSearch(self.centres)
        self._lock = threading.Lock()
        self._sums: CentreSums | None = None
        self._ranking: StartRanking | None = None
        self._global: Maximum | None = None
        self._widening = threading.Lock()
        self._wider: tuple[tuple[float, float], ModeSearch] | None = None
        self._scores: OrderedDict[Hashable, CentreScores] = OrderedDict()

    def extended(self, density: SearchedDensity, centres: GraspDensity | None = None) -> ModeSearch:
        """The search in what the density was extended to: what centres are worth is completed, not computed
        anew.
        """
        if density is self.density:
            return self
        longer = ModeSearch(density, centres)
        longer._sums = self._sums
        if self._by_values is not self:
            longer._by_values = self._by_values.extended(longer.centres)
        return longer

    @property
    def nbytes(self) -> int:
        """Bytes held, those of the density left out."""
        own = sum(part.nbytes for part in (self._sums, self._ranking) if part is not None)
        if self._wider is not None:
            own += self._wider[1].nbytes + self._wider[1].density.nbytes
        own += sum(scores.nbytes for scores in list(self._scores.values()))
        return own + (0 if self._by_values is self else self._by_values.nbytes)

    def widened(self, sigma_position_m: float, sigma_rotation: float) -> ModeSearch:
        """The search in the isotropic density's mean under noise of the tool with these deviations per axis,
        which is a density under a wider kernel. The last one is kept, so that those who ask alike share it.
        """
        asked, density = (sigma_position_m, sigma_rotation), self.density.isotropic
        if not any(asked):
            return self if density is self.density else self._by_values
        with self._widening:
            if self._wider is None or self._wider[0] != asked:
                wider = GraspDensity.build(
                    density.poses,
                    kernel=density.kernel.widened(*asked),
                    weights=density.weights,
                    symmetric=density.symmetric,
                )
                self._wider = asked, ModeSearch(wider)
            return self._wider[1]

    def centre_scores(self, alike: Hashable) -> CentreScores:
        """What searches by one rough score know of centres, kept of the last few scores; None: not kept."""
        if alike is None:
            return CentreScores()
        with self._lock:
            found = self._scores.setdefault(alike, CentreScores())
            self._scores.move_to_end(alike)
            while len(self._scores) > _KEPT:
                self._scores.popitem(last=False)
            return found

    def ranking(self, threads: int = 1) -> StartRanking:
        """The rows of ``density.isotropic``, ranked at the first search."""
        with self._lock:
            if self._ranking is None:
                density = self.density.isotropic
                self._sums = centre_sums(density, self._sums, threads)
                self._ranking = rank_starts(density, self._sums)
            return self._ranking

    def maxima(
        self,
        region: Region | None = None,
        *,
        count: int = 1,
        separation: Separation = DISTINCT,
        admissible: Admissible | None = None,
        score: Score | None = None,
        rough: Score | None = None,
        pull: Pull | None = None,
        resolution: float = 0.0,
        rescored: int = 0,
        dear: DearTest | None = None,
        leading: Score | None = None,
        alike: Hashable = None,
        threads: int = 1,
    ) -> list[Maximum]:
        """The ``count`` best distinct grasps, best first; fewer where there are no more, none where no centre
        of a kernel is within 4 standard deviations in position and in rotation.

        Parameters
        ----------
        region
            None: no constraint but ``admissible``.
        separation
            The jaw's twins are one grasp where every row is symmetric.
        admissible
            Called with K poses, answers (K,) bool. Never is a pose returned that it refused.
        score
            What is best. None: the density.
        rough, pull, resolution, rescored, leading
            See `EvolutionSearch`; where the density is best they say nothing.
        alike
            Names the rough score: searches under the same name share what it gives at centres. None: none do.
        dear
            A test that costs much, which every pose that is returned has passed: see `LazySearch`.
        threads

        Raises
        ------
        ValueError
            For a count below 1, a negative separation, or callables that answer another shape.
        """
        if count < 1:
            raise ValueError(f"count must be at least 1, not {count}")
        if not all(apart >= 0.0 for apart in separation):
            raise ValueError("separations must not be negative")
        log_density = partial(self.density.log_density, threads=threads)
        climbing = score is None and self.density.isotropic is self.density
        start = self if climbing else self._by_values
        common = (
            start.density.isotropic, start.ranking(threads), log_density, region or Region(), admissible,
            threads,
        )  # fmt: skip
        search: MeanShiftSearch | EvolutionSearch = MeanShiftSearch(*common)
        if not climbing:
            score, known = score or log_density, start.centre_scores(alike)
            more = rough or score, pull, resolution, rescored, leading, known
            search = EvolutionSearch(*common, score, *more)
        return (search if dear is None else LazySearch(search, dear)).run(count, separation)

    def global_maximum(self, threads: int = 1) -> Maximum:
        """The highest point of the whole density, computed once."""
        if self._global is None:
            self._global = self.maxima(threads=threads)[0]
        return self._global

    def relative(self, log_density: Floats, threads: int = 1) -> Floats:
        """Log densities relative to the highest there is, 0 to 1."""
        # Rounding may lift a pose at the very maximum above it.
        return np.minimum(np.exp(log_density - self.global_maximum(threads).log_density), 1.0)


class MeanShiftSearch(ClimbedSearch):
    """A multi-start search by mean shift: `climb` moves poses uphill, `scored` compares them."""

    exactly = 2048

    def run(self, count: int, separation: Separation) -> list[Maximum]:
        """The best distinct grasps."""
        # A sample ranks centres roughly: more of them are tried.
        rough = max(1, _ROUGH * (len(self.ranking.coarse_to_fine) - 1))
        starts = self.all_starts(max(_STARTS, 3 * count) * rough, count, separation)
        if not len(starts):
            return []
        finalists = max(_FINALISTS, 2 * count)
        passed, ends = self.climbed(starts.poses, finalists)
        best = ends.ranked()[:1]
        feasible = bool(self.region.contains(*best.poses)[0])
        # Where the gripper collides there, look around the best poses where it does not.
        blocked = feasible and self.admissible is not None and not self.check(best.poses)[0]
        if count > 1 or blocked or not feasible:
            # Starts, too, because all are admissible and far from each other.
            seen = ScoredPoses.joined(self.thinned(passed, 4 * finalists, _APART), starts)
            seen = ScoredPoses.joined(self.scored(seen.poses), ends).ranked()
            if blocked:
                seen = ScoredPoses.joined(seen, self.explored(seen)).ranked()
            best = self.choose(seen, count, separation)
        return self.maxima(best)

    # -- climbing

    def climbed(self, starts: Poses, finalists: int) -> tuple[ScoredPoses, ScoredPoses]:
        """Poses passed while climbing, with the climbs' own sums, and the best ends, with sums over all."""
        first, *finer = self.ranking.coarse_to_fine
        cut, steps = _FIRST_CUT, _ROUGH_STEPS if finer else _FIRST_STEPS
        passed, ends = self.climb(starts, steps, cut, first)
        if np.mean(ends.scores == 0.0) > _LOST:
            # In the tails no kernel is that near.
            cut = _CUT
            passed, ends = self.climb(starts, steps, cut, first)
        for cells in finer:
            # A sample has more and sharper peaks than the whole, and another one is the highest.
            few = _DOUBTFUL * finalists if cells is finer[-1] else len(ends)
            on, ends = self.climb(self.thinned(ends, few, _MERGED).poses, _FIRST_STEPS, cut, cells)
            passed = ScoredPoses.joined(passed, on)
        ends = self.scored(self.thinned(ends, 2 * finalists, _MERGED).poses).ranked()
        promising = int(np.sum(ends.scores >= _PROMISING * ends.scores[0]))
        on, ends = self.climb(ends.poses[: min(promising, finalists)], _STEPS)
        return ScoredPoses.joined(passed, on), self.scored(ends.poses)

    def climb(
        self, starts: Poses, steps: int, cut: float = _CUT, cells: Cells | None = None
    ) -> tuple[ScoredPoses, ScoredPoses]:
        """Poses passed from every start, and the ends; their sums are those of `mean_shift.climb`."""
        cells, count = cells or self.density.cells, len(starts)
        path = np.zeros((count, steps, mean_shift.PATH))
        lengths = np.empty(count, dtype=np.int64)

        def work(begin: int, end: int) -> None:
            part = slice(begin, end)
            mean_shift.climb(
                cells.arrays, self.region.limits, self.density.kernel.kappa, cut, starts.positions[part],
                starts.quaternions_xyzw[part], _GAIN, path[part], lengths[part],
            )  # fmt: skip

        for_blocks(work, count, block=4, threads=self.threads)
        passed = _along(path[np.arange(steps) < lengths[:, None]])
        ends = _along(path[np.arange(count), np.maximum(lengths, 1) - 1])
        # Nothing near enough to climb on: the start is the end.
        still = lengths == 0
        ends.put(still, ScoredPoses.unscored(starts), still)
        return passed, ends

    def scored(self, poses: Poses) -> ScoredPoses:
        """Poses with sums over all kernels."""
        sums = self.density.kernel_sums(poses, cutoff=REACH, threads=self.threads)
        return ScoredPoses(poses, sums)

    def thinned(self, poses: ScoredPoses, most: int, apart: float) -> ScoredPoses:
        """The best poses that are ``apart`` kernel widths from each other, at most ``most``."""
        ranked = poses.ranked()
        return ranked[self.thin(ranked.poses, 0, most, self.widths(apart))]

    # -- where one test is dear

    def worth(self, poses: Poses) -> ScoredPoses:
        return self.scored(poses)

    def told(self, best: ScoredPoses) -> Floats:
        return self.log_density(best.poses)

    def step_from(
        self, at: ScoredPoses, step: Floats, tries: int, rng: np.random.Generator
    ) -> tuple[ScoredPoses, Floats]:
        return self.stepped(at, step, tries, rng, self.ranking.coarse_to_fine[-1])

    # -- the edge of the free space

    def explored(self, seen: ScoredPoses) -> ScoredPoses:
        """Random search from the best admissible poses, where the climbs that ignored it ended in collisions:
        from many for a little, from the best of them further.
        """
        rng = np.random.default_rng(0)
        ends = self.choose(seen, _EXPLORED[0][0], self.widths(1.0))
        step = np.full(len(ends), 0.5)
        levels = self.ranking.coarse_to_fine
        passed: list[ScoredPoses] = []
        for climbs, tries, rounds in _EXPLORED:
            best = np.argsort(-ends.scores, kind="stable")[:climbs]
            ends, step = ends[best], step[best]
            # First among the finest sample, if there is one.
            cells = levels[-1] if passed else levels[-2:][0]
            for _ in range(rounds):
                ends, step = self.stepped(ends, step, tries, rng, cells)
            # Sums so far told which step around one pose is better; now poses are compared.
            ends = self.scored(ends.poses)
            passed.append(ends)
        return ScoredPoses.joined(*passed)

    def stepped(
        self, at: ScoredPoses, step: Floats, tries: int, rng: np.random.Generator, cells: Cells
    ) -> tuple[ScoredPoses, Floats]:
        """From each of K poses, the best of random steps where that is better and admissible, with the sum
        over the kernels near before; and lengths (K,) to try next, in kernel widths, shorter after a failure.
        """
        kernel, count = self.density.kernel, len(at)
        scale = step[:, None, None]
        moves = rng.standard_normal((count, tries, 3)) * (scale * kernel.sigma_position_m)
        turns = rng.standard_normal((count, tries, 3)) * (scale * kernel.sigma_rotation)
        p, q = np.empty((count, tries, 3)), np.empty((count, tries, 4))
        values = np.empty((count, 1 + tries))

        def work(begin: int, end: int) -> None:
            part = slice(begin, end)
            mean_shift.scatter(
                cells.arrays, self.region.limits, kernel.kappa, _AROUND, at.poses.positions[part],
                at.poses.quaternions_xyzw[part], moves[part], turns[part], p[part], q[part], values[part],
            )  # fmt: skip

        for_blocks(work, count, block=8, threads=self.threads)
        ends, moved = self.best_tries(at, values[:, 0], p, q, values[:, 1:])
        return ends, np.where(moved, np.minimum(step, 1.0), 0.6 * step)


def _along(rows: Floats) -> ScoredPoses:
    """Rows (K, PATH) of paths."""
    return ScoredPoses(Poses(rows[:, 0:3].copy(), rows[:, 3:7].copy()), rows[:, 7].copy())
