"""What attempts at some objects tell of another one, by what the same jaw closes on there.

Trees learn of what the jaw closes on alone, for where that is on its object is of no use to another object.
How they are weighed beside an object's first attempts, and how far they are off, is learned from objects that
were left out, whole: of each one its first attempts are the kernel estimate, and its others are predicted.
Without any attempt that is what trees say, set right.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, stdtrit

from graspdb_density import SuccessModel, choose_widths
from graspdb_density.kde.rows import Rows
from graspdb_density.se3 import Floats, Poses
from graspdb_density.success.calibration import brier_skill
from graspdb_geometry.closing import FEATURES

from .boosted_trees import BoostedTrees
from .grasp_features import GraspFeatures, monotonic_of
from .stack import LeftOut, Stack, logit_of, packed, trees_among, unpacked
from .stacking import Learned, Predicted, neighbours, stacked

__all__ = [
    "LEAST_OBJECTS",
    "LEAST_OF_AN_OBJECT",
    "LEAST_OF_EACH",
    "MOST_OF_AN_OBJECT",
    "Lesson",
    "Transfer",
    "fit_transfer",
]

Ints = NDArray[np.int64]

#: Fewer objects teach nothing of another one; attempts at each, and of either outcome among them.
LEAST_OBJECTS, LEAST_OF_AN_OBJECT, LEAST_OF_EACH = 3, 60, 12
#: Attempts at each object that are learned from at most, and that judge.
MOST_OF_AN_OBJECT, _JUDGED = 3_000, 600
#: An object's first attempts: none, and a few.
_FIRST = (0, 10, 30, 100)
#: Groups of objects that are left out in turn.
_FOLDS = 5
#: Chance that trees which tell nothing are believed.
_CHANCE = 0.05


class Lesson(NamedTuple):
    """Attempts (N) at one object that closed on something: poses, by how much each succeeded, as how much of
    one it counts, and what the jaw closed on, (N, len(FEATURES)). ``shape`` is equal where objects are.
    """

    shape: str
    poses: Poses
    share: Floats
    weight: Floats
    closed: NDArray[np.float32]

    @property
    def teaches(self) -> bool:
        """Whether it has enough attempts of both outcomes."""
        won = int((self.share >= 0.5).sum())
        few = min(won, len(self.share) - won) < LEAST_OF_EACH
        return len(self.share) >= LEAST_OF_AN_OBJECT and not few


@dataclass(frozen=True, eq=False, slots=True)
class Transfer:
    """What was learned of some objects; immutable.

    Attributes
    ----------
    stack : Stack
        With the trees of all objects, for another object's first attempts; what it left out are whole objects
        with few attempts.
    untried : LeftOut
        The same objects without any attempt; ``kernel`` is the share of those that hold something which
        succeed, as if that were known.
    folds : tuple of BoostedTrees
        Trees without some of the objects.
    fold : mapping of str to int
        Which trees are without an object of this shape.
    objects : int
        How many it was learned from.
    """

    stack: Stack
    untried: LeftOut
    folds: tuple[BoostedTrees, ...]
    fold: Mapping[str, int]

    @property
    def objects(self) -> int:
        return len(self.fold)

    @property
    def better_untried(self) -> bool:
        """Whether it predicts objects without any attempt better than the share of their successes does."""
        return _better(self.untried)

    @property
    def better_with_few(self) -> bool:
        """Whether it predicts objects with few attempts better than the kernel estimate does."""
        return _better(self.stack.left_out)

    def trees_for(self, shape: str) -> BoostedTrees:
        """Trees that know nothing of objects of this shape."""
        number = self.fold.get(shape)
        assert self.stack.trees is not None
        return self.stack.trees if number is None else self.folds[number]

    def stack_for(self, shape: str) -> Stack:
        """The stack for the first attempts at an object."""
        return replace(self.stack, trees=self.trees_for(shape))

    def prior(self, shape: str, features: GraspFeatures, poses: Poses, threads: int = 1) -> Floats:
        """How likely grasps at poses (M) succeed, (M,), by other objects alone."""
        untried = np.full(len(poses), 0.5), np.zeros(len(poses))
        return expit(self.stack_for(shape).combined(*untried, features.at(poses, threads))[0])

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held."""
        return self.stack.nbytes + sum(each.nbytes for each in self.folds) + 57 * len(self.untried.share)

    def to_bytes(self) -> bytes:
        """All of it, to be kept; `of_bytes` reads it again."""
        arrays: dict[str, NDArray[Any]] = {**self.stack.arrays, **self.untried.arrays("untried")}
        for number, each in enumerate(self.folds):
            arrays |= {f"fold{number}_{name}": array for name, array in each.arrays.items()}
        names = sorted(self.fold)
        arrays["shapes"] = np.array(names, dtype=np.str_)
        arrays["fold_of"] = np.array([self.fold[name] for name in names], dtype=np.int64)
        return packed(arrays)

    @classmethod
    def of_bytes(cls, content: bytes) -> Transfer:
        """What `to_bytes` wrote; ValueError for anything else."""

        def made(arrays: Mapping[str, NDArray[Any]]) -> Transfer:
            number = arrays["fold_of"].tolist()
            found = [trees_among(arrays, f"fold{each}_") for each in range(max(number) + 1)]
            folds = tuple(each for each in found if each is not None)
            if len(folds) < len(found):
                raise ValueError("trees are missing")
            fold = dict(zip(arrays["shapes"].tolist(), number, strict=True))
            return cls(Stack.of_arrays(arrays), LeftOut.of_arrays(arrays, "untried"), folds, fold)

        return unpacked(content, "transfer", made)


def fit_transfer(
    lessons: Sequence[Lesson], *, threads: int = 1, breathe: Callable[[], None] = lambda: None
) -> Transfer | None:
    """Learn from attempts at several objects; None where too few teach.

    Parameters
    ----------
    lessons
        Of objects tried with one gripper. Those of one shape are left out together.
    breathe
        Called between steps of a few seconds at most.
    """
    some = [lesson for lesson in lessons if lesson.teaches]
    shapes = sorted({lesson.shape for lesson in some})
    if len(shapes) < LEAST_OBJECTS:
        return None
    shuffled = np.random.default_rng(0).permutation(len(shapes))
    fold = {shapes[place]: number % _FOLDS for number, place in enumerate(shuffled)}
    folds = []
    for number in range(min(_FOLDS, len(shapes))):
        folds.append(_trees([each for each in some if fold[each.shape] != number]))
        breathe()
    predicted = []
    for number, lesson in enumerate(some):
        predicted.append(_predicted(lesson, number, fold[lesson.shape], folds[fold[lesson.shape]], threads))
        breathe()
    untried = np.concatenate([each.near == 0.0 for each in predicted])
    told = _together(predicted)
    whole = Learned(_trees(some), None, None, sum(len(each.share) for each in some))
    stack = stacked(told, whole, None)
    left_out = stack.left_out
    return Transfer(
        replace(stack, left_out=left_out.some(~untried)), left_out.some(untried), tuple(folds), fold
    )


def _trees(lessons: Sequence[Lesson]) -> BoostedTrees:
    weight = np.concatenate([lesson.weight for lesson in lessons])
    return BoostedTrees.fit(
        np.concatenate([lesson.closed for lesson in lessons]),
        np.concatenate([lesson.share for lesson in lessons]),
        None if np.ptp(weight) == 0.0 else weight,
        monotonic=monotonic_of(FEATURES),
    )


def _predicted(lesson: Lesson, number: int, fold: int, trees: BoostedTrees, threads: int) -> Predicted:
    """Some attempts at an object by trees without it and its first attempts, for every number of these."""
    rng = np.random.default_rng(number)
    order = rng.permutation(len(lesson.share))
    judged, rest = order[:_JUDGED], order[_JUDGED:]
    if len(rest) < len(judged):
        judged, rest = np.array_split(order, 2)
    poses, share = lesson.poses[judged], lesson.share[judged]
    logit = trees.logit(lesson.closed[judged])
    pairs = neighbours(poses, np.zeros(len(judged), dtype=np.int64), (0.01, 0.25))
    parts = []
    for first in _FIRST:
        kernel, trials = np.full(len(judged), 0.5), np.zeros(len(judged))
        plain = np.full(len(judged), float(np.average(lesson.share, weights=lesson.weight)))
        if first:
            model = _of_first(lesson, rest[:first])
            if first > len(rest) or model is None:
                continue
            kernel, trials, _ = model.without_interval(poses, everywhere=True, threads=threads)
            # Where nothing is near at all the number of attempts is still not none.
            plain, trials = kernel, np.maximum(trials, np.finfo(np.float64).tiny)
        weight = lesson.weight[judged] / lesson.weight[judged].sum()
        which = np.full(len(judged), number), np.full(len(judged), fold)
        near = trials / (1.0 + trials)
        parts.append(Predicted(logit_of(kernel), near, logit, None, plain, share, weight, *which, pairs))
    return _together(parts)


def _of_first(lesson: Lesson, rows: Ints) -> SuccessModel | None:
    """The kernel estimate of some attempts, under the widths that a density of theirs has."""
    won = lesson.share[rows] >= 0.5
    if won.sum() < 2:
        return None
    kernel = choose_widths(Rows.of(lesson.poses[rows[won]])).kernel
    return SuccessModel.build(lesson.poses[rows], won, kernel=kernel, weights=lesson.weight[rows])


def _together(parts: Sequence[Predicted]) -> Predicted:
    """Predictions of several lots as one."""
    starts = np.cumsum([0, *(len(part.share) for part in parts)])
    pairs = [part.pairs + start for part, start in zip(parts, starts, strict=False)]
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in Predicted._fields
        if name not in ("pairs", "others")
    }
    return Predicted(**columns, others=None, pairs=np.concatenate(pairs))


def _better(held: LeftOut) -> bool:
    """Whether predictions of objects are better than the kernel's, by Brier skill and how that differs from
    object to object: objects fare otherwise than blocks of one, and are few.
    """
    gains = []
    for each in np.unique(held.block):
        rows = held.block == each
        learned, kernel = (
            brier_skill(column[rows], held.share[rows], weights=held.weight[rows])
            for column in (held.learned, held.kernel)
        )
        gains.append(learned - kernel)
    gain = np.array(gains)[np.isfinite(gains)]
    if len(gain) < LEAST_OBJECTS:
        return False
    error = float(gain.std(ddof=1)) / math.sqrt(len(gain))
    return float(gain.mean()) + float(stdtrit(len(gain) - 1, _CHANCE)) * error > 0.0
