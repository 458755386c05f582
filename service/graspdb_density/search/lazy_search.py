"""The best grasps where one test is dear: whether a robot's arm gets there, for one.

Other searches ask what is admissible of hundreds of poses before they climb. This one walks down the centres
in the order of what they are worth, asks the dear test of one after the other, and climbs from those few that
pass it. A hint, which is cheap and may err, says of which to ask first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .. import se3
from ..se3 import Floats, Poses
from .multi_start import REACH, Indices, MultiStart
from .scored_poses import Admissible, Bools, Maximum, ScoredPoses, Separation

__all__ = ["ClimbedSearch", "DearTest", "LazySearch"]

#: Centres looked at in all, and at a time.
MOST_CENTRES, _BLOCK = 20_000, 512
#: Poses asked of the dear test at a time, while none has passed it; how many that pass are
#: compared, kernel widths between them, and how many of the best are climbed from.
_ASKED, _PASSED, _CLIMBED = 16, 12, 3
#: Poses that the hint speaks against and that rank higher than one that passed are asked all the same; at
#: most so many after something passed, and so many where nothing did.
_DOUBTED, _DOUBTED_IN_VAIN = 512, 4_000
#: Centres that are looked at for more once something passed.
_FARTHER = 2_048
#: Steps tried from each pose at a time, and how often; a step's length in kernel widths, at first.
_TRIES, _ROUNDS, _STEP = 6, 5, 0.5
#: Kernel widths between poses that pass and are compared.
_APART = 0.5
#: Scores that differ by less are equal: then what is cheaper to take wins.
_EQUAL = 1e-6


@dataclass(frozen=True, eq=False)
class DearTest:
    """A test of poses (K,) that costs much, what it is likely to say, and what is preferred among equals.

    ``cost`` (K,) is asked only of what passed; less is better.
    """

    passes: Admissible
    likely: Admissible
    cost: Callable[[Poses], Floats] | None = None


class ClimbedSearch(MultiStart):
    """A search by starts that says what poses are worth, and steps from them; ``exactly`` is of how many at
    once that can be afforded.
    """

    exactly: ClassVar[int]

    def worth(self, poses: Poses) -> ScoredPoses:
        """Poses with what they are ranked by."""
        raise NotImplementedError

    def told(self, best: ScoredPoses) -> Floats:
        """The scores (K,) that an answer tells."""
        raise NotImplementedError

    def step_from(
        self, at: ScoredPoses, step: Floats, tries: int, rng: np.random.Generator
    ) -> tuple[ScoredPoses, Floats]:
        """From each of K poses, the best admissible of random steps; and lengths (K,) to try next."""
        raise NotImplementedError


class LazySearch:
    """One search: ``search`` knows what is admissible by cheap tests, ``dear`` is asked of few poses.

    ``asked`` counts of how many it was.
    """

    def __init__(self, search: ClimbedSearch, dear: DearTest) -> None:
        self.search, self.dear = search, dear
        self.asked = 0

    def run(self, count: int, separation: Separation) -> list[Maximum]:
        """The best distinct grasps."""
        passed = self.walked(count, separation)
        if not len(passed):
            return []
        found = self.search.worth(passed)
        found = ScoredPoses.joined(found, self.climbed(found.ranked()[:_CLIMBED])).ranked()
        best = self.distinct(self.cheapest_first(found, count), count, separation)
        return self.search.maxima(best, self.search.told(best))

    # -- down the centres

    def walked(self, count: int, separation: Separation) -> Poses:
        """Poses that pass, most of them the first in the order of what they are worth."""
        passed, doubted = list[Poses](), list[Poses]()
        wanted, looked = max(_PASSED, 2 * count), 0
        apart = self.search.widths(_APART) if count == 1 else separation
        for block in self.ranked():
            likely = np.asarray(self.dear.likely(block), dtype=bool)
            rows = np.flatnonzero(likely)
            rows = rows[self.first(block[rows], wanted - _size(passed))]
            # What ranks lower than what passed is not worth a doubt.
            end = rows[0] if rows.size and not passed else 0 if passed else len(block)
            doubted.append(block[:end][np.flatnonzero(~likely[:end])])
            looked += len(block)
            if rows.size:
                passed.append(block[rows])
            enough = passed and len(self.distinct(_unscored(passed), wanted, apart)) >= wanted
            if enough or looked >= (_FARTHER if passed else MOST_CENTRES):
                break
        left = _DOUBTED if passed else _DOUBTED_IN_VAIN
        for block in doubted:
            before = self.asked
            rows = self.first(block, wanted, left)
            left -= self.asked - before
            if rows.size:
                passed.append(block[rows])
            if left <= 0 or (rows.size and _size(passed) >= 2 * wanted):
                break
        return Poses.concatenate(passed) if passed else Poses(np.empty((0, 3)), np.empty((0, 4)))

    def ranked(self) -> Iterator[Poses]:
        """Feasible poses nearest to centres, best first, so many at a time."""
        search, done = self.search, False
        reach = search.widths(REACH)
        for rows, turned in search.candidates():
            centres = search.centres(rows, turned)
            p, q, inside = search.region.project(centres.positions, centres.quaternions_xyzw)
            inside &= np.linalg.norm(p - centres.positions, axis=1) <= reach.metres
            inside &= se3.angle_between(q, centres.quaternions_xyzw) <= reach.radians
            valued = search.valued(Poses(p, q)[inside]).poses
            if not done:
                # A sample of the kernels, or a rough score, ranks centres within some 10 %.
                first = search.worth(valued[: search.exactly]).ranked().poses
                valued = Poses.concatenate([first, valued[search.exactly :]])
                done = True
            for start in range(0, len(valued), _BLOCK):
                yield valued[start : start + _BLOCK]

    def first(self, poses: Poses, wanted: int, most: int = MOST_CENTRES) -> Indices:
        """Rows of the first poses that pass all tests, the dear one asked of ``most`` at most."""
        passed: list[Indices] = []
        start, left = 0, most
        while start < len(poses) and sum(map(len, passed)) < wanted and left > 0:
            rows = np.arange(start, min(start + _ASKED, len(poses)))
            start += _ASKED
            if self.search.admissible is not None:
                rows = rows[np.flatnonzero(self.search.admissible(poses[rows]))]
            if rows.size:
                left -= len(rows)
                passed.append(rows[np.flatnonzero(self.pass_dear(poses[rows]))])
        return np.concatenate(passed) if passed else np.empty(0, dtype=np.intp)

    def pass_dear(self, poses: Poses) -> Bools:
        """Ask the dear test."""
        self.asked += len(poses)
        return np.asarray(self.dear.passes(poses), dtype=bool)

    # -- up from there

    def climbed(self, at: ScoredPoses) -> ScoredPoses:
        """Where random steps lead to from poses that pass, over poses that do."""
        cheap, search = self.search.admissible, self.search

        def both(poses: Poses) -> Bools:
            allowed = np.ones(len(poses), dtype=bool) if cheap is None else np.array(cheap(poses), dtype=bool)
            allowed[allowed] = self.pass_dear(poses[np.flatnonzero(allowed)])
            return allowed

        rng = np.random.default_rng(0)
        step = np.full(len(at), _STEP)
        search.admissible = both
        try:
            for _ in range(_ROUNDS):
                at, step = search.step_from(at, step, _TRIES, rng)
        finally:
            search.admissible = cheap
        return search.worth(at.poses)

    def cheapest_first(self, found: ScoredPoses, count: int) -> ScoredPoses:
        """The same order, but of equally good ones the one that costs least first."""
        if self.dear.cost is None or len(found) < 2:
            return found
        scale = max(float(np.abs(found.scores[0])), 1e-300)
        ranks = np.floor((found.scores[0] - found.scores) / (_EQUAL * scale))
        head = np.flatnonzero(ranks <= ranks[min(count, len(ranks)) - 1])
        if len(head) < 2 or len(np.unique(ranks[head])) == len(head):
            return found
        costs = self.dear.cost(found.poses[head])
        order = np.arange(len(found))
        order[: len(head)] = head[np.lexsort((costs, ranks[head]))]
        return found[order]

    def distinct(self, ranked: ScoredPoses, count: int, separation: Separation) -> ScoredPoses:
        """The first ``count`` distinct ones."""
        kept: Indices = self.search.thin(ranked.poses, 0, count, separation)
        return ranked[kept]


def _size(parts: list[Poses]) -> int:
    return sum(map(len, parts))


def _unscored(parts: list[Poses]) -> ScoredPoses:
    return ScoredPoses.unscored(Poses.concatenate(parts))
