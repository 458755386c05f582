"""Learning of an object's own attempts: trees, a kernel's own widths, and how to weigh them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb_density import DiagonalKernel, IsotropicKernel, Reach, SuccessModel, validate_reach
from graspdb_density.se3 import Floats, Poses
from graspdb_density.success.axis_bandwidth import LEAST_OF_EACH as LEAST_THAT_CHOOSE
from graspdb_density.success.axis_bandwidth import fit_axis_bandwidths
from graspdb_density.success.calibration import Blocks, assign_blocks
from graspdb_density.success.kernel_regression import Attempts, SuccessKernel

from .boosted_trees import BoostedTrees
from .grasp_features import GraspFeatures
from .stack import Stack, logit_of
from .stacking import Distances, Learned, Predicted, neighbours, stacked

__all__ = ["LEAST_ATTEMPTS", "LEAST_BLOCKS", "LEAST_OF_EACH", "fit_stack"]

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

#: Fewer attempts, successes or failures among them, or blocks of space teach nothing.
LEAST_ATTEMPTS, LEAST_OF_EACH, LEAST_BLOCKS = 60, 12, 8
#: Attempts learned from and judged at most, half of them successes.
_LEARNED, _JUDGED = 30_000, 6_000
_FOLDS = 5
#: Edge of the blocks in widths of the kernel, and its bounds in metres.
_BLOCK_WIDTHS, _BLOCK_M = 3.0, (0.01, 0.03)
#: The same without trees.
_SPOT_M = 0.005
#: With as many blocks they need not be smaller.
_MANY_BLOCKS = 40
#: Own widths lose at most so much of what the others lose, in nats.
_BETTER = 0.99


def fit_stack(
    model: SuccessModel,
    features: GraspFeatures | None,
    *,
    reach: Reach,
    kernel: SuccessKernel | None = None,
    own_widths: bool = False,
    others: BoostedTrees | None = None,
    threads: int = 1,
    breathe: Callable[[], None] = lambda: None,
) -> Stack | None:
    """Learn from the attempts of a model; None where there are too few to.

    Parameters
    ----------
    model
        Where collisions are tested, of attempts that did not collide.
    features : GraspFeatures or None
        None where object or gripper have no known shape.
    reach
        Of the model.
    kernel
        Of the kernel estimate that the stack is to be better than; None: the model's.
    own_widths
        Whether the attempts may choose a width for every axis themselves, in place of that kernel's.
    others : BoostedTrees or None
        Trees of other objects' attempts, none of this one's.
    breathe
        Called between steps of a few seconds at most.
    """
    every = model.attempts()
    succeeded = every.share >= 0.5
    if len(succeeded) < LEAST_ATTEMPTS or min(succeeded.sum(), (~succeeded).sum()) < LEAST_OF_EACH:
        return None
    plain = model if kernel is None or model.kernel == kernel else _model(every, None, kernel)
    # Questions come where attempts are: the kernel estimate alone is set right for as much as is near there,
    # and only what was tried at the same position is left out.
    edge = _SPOT_M if features is None else float(np.clip(_BLOCK_WIDTHS * plain.widest_m, *_BLOCK_M))
    blocks = _blocks(every.poses.positions, edge)
    if blocks is None:
        return None
    breathe()
    own, used = None, plain
    if own_widths and isinstance(plain.kernel, IsotropicKernel):
        own = _own_widths(every, plain.kernel)
    if own is not None:
        used = model if model.kernel == own else _model(every, None, own)
    if used is not model:
        reach = validate_reach(used, threads=threads)
    breathe()
    task = _Fit(every, plain, used, reach, features, others, blocks, threads, breathe)
    return task.stack(own)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Attempts to learn from: under the density's widths, and under those used; how far these tell."""

    every: Attempts
    plain: SuccessModel
    used: SuccessModel
    reach: Reach
    features: GraspFeatures | None
    others: BoostedTrees | None
    blocks: Blocks
    threads: int
    breathe: Callable[[], None]

    def stack(self, own: DiagonalKernel | None) -> Stack:
        """Learned of all; weighed and judged by attempts that are predicted without their block."""
        every, fold, used, threads = self.every, self.blocks.fold, self.used, self.threads
        succeeded = every.share >= 0.5
        rng = np.random.default_rng(0)
        learned, _ = _sample(succeeded, every.weight, _LEARNED, rng)
        judged, weight = _sample(succeeded, every.weight, _JUDGED, rng)
        self.breathe()
        lesson = _Lesson.of(every, learned, self.features, threads)
        plain, kernel, trials, widths, turned = (np.empty(len(judged)) for _ in range(5))
        described = None if self.features is None else self.features.at(every.poses[judged], threads)
        trees = None if described is None else np.empty(len(judged))
        for number in range(self.blocks.folds):
            rows = np.flatnonzero(fold[judged] == number)
            if not rows.size:
                continue
            poses, out, rest = (
                every.poses[judged[rows]],
                np.flatnonzero(fold == number),
                fold[learned] != number,
            )
            kernel[rows], trials[rows] = self._without(used, out, poses)
            plain[rows] = kernel[rows] if used is self.plain else self._without(self.plain, out, poses)[0]
            near = _model(every, learned[rest], used.kernel).support(poses, threads=threads)[1]
            widths[rows], turned[rows] = near.position_widths, near.rotation_widths
            self.breathe()
            part = lesson.learned(rest)
            if trees is not None and described is not None and part is not None:
                trees[rows] = part.logit(described[rows])
            self.breathe()
        others = None if self.others is None or described is None else self.others.logit(described)
        told = Predicted(
            logit_of(kernel), trials / (1.0 + trials), trees, others, plain,
            every.share[judged], weight, self.blocks.block[judged], fold[judged],
            neighbours(every.poses[judged], fold[judged], (used.widest_m, max(used.sigmas[3:]))),
        )  # fmt: skip
        made = Learned(lesson.learned(None), None if others is None else self.others, own, used.size)
        return stacked(told, made, Distances(widths, turned, self.reach))

    def _without(self, model: SuccessModel, out: Ints, poses: Poses) -> tuple[Floats, Floats]:
        """What the kernel estimate says without some of the attempts."""
        found = model.without(_model(self.every, out, model.kernel), poses, threads=self.threads)
        self.breathe()
        return found


@dataclass(frozen=True, eq=False)
class _Lesson:
    """What trees learn from: features (N, F), None without shapes; by how much attempts (N,) succeeded, and
    their weights, None where they weigh alike. (Drawn by outcome, they weigh otherwise than they stand for:
    to trees that is a constant of the logit, which the stack has.)
    """

    features: GraspFeatures | None
    described: NDArray[np.float32] | None
    share: Floats
    weight: Floats | None

    @classmethod
    def of(cls, every: Attempts, rows: Ints, features: GraspFeatures | None, threads: int) -> _Lesson:
        described = None if features is None else features.at(every.poses[rows], threads).astype(np.float32)
        weight = None if np.ptp(every.weight) == 0.0 else every.weight[rows]
        return cls(features, described, every.share[rows], weight)

    def learned(self, rows: Bools | None) -> BoostedTrees | None:
        """Trees of some of the attempts, None: of all; None without shapes."""
        if self.features is None or self.described is None:
            return None
        some = slice(None) if rows is None else rows
        return BoostedTrees.fit(
            self.described[some],
            self.share[some],
            None if self.weight is None else self.weight[some],
            monotonic=self.features.monotonic,
        )


def _blocks(positions: Floats, edge: float) -> Blocks | None:
    """Blocks of this edge, or of half of it and so on where those are few; None where they are too few."""
    while True:
        try:
            blocks = assign_blocks(positions, edge_m=edge, folds=_FOLDS)
        except ValueError:
            # All in one place.
            blocks = None
        if blocks is not None and blocks.count >= _MANY_BLOCKS:
            return blocks
        if edge <= _SPOT_M:
            return blocks if blocks is not None and blocks.count >= LEAST_BLOCKS else None
        edge = max(0.5 * edge, _SPOT_M)


def _sample(succeeded: Bools, weight: Floats, most: int, rng: np.random.Generator) -> tuple[Ints, Floats]:
    """Rows drawn at random, half of them successes where there are as many, and what each stands for."""
    rows, stands_for = [], []
    wins, losses = np.flatnonzero(succeeded), np.flatnonzero(~succeeded)
    fewer = min(len(wins), len(losses), most // 2)
    for members in (wins, losses):
        count = min(len(members), most - fewer if len(members) > most // 2 else len(members))
        drawn = np.sort(rng.choice(members, size=count, replace=False))
        rows.append(drawn)
        stands_for.append(weight[drawn] * (len(members) / count))
    return np.concatenate(rows), np.concatenate(stands_for)


def _model(every: Attempts, rows: Ints | None, kernel: SuccessKernel) -> SuccessModel:
    """A model of some attempts, None: of all, under a kernel."""
    some = slice(None) if rows is None else rows
    share, whole = every.share[some], np.isin(every.share, (0.0, 1.0)).all()
    return SuccessModel.build(
        every.poses[some],
        share >= 0.5 if whole else share,
        kernel=kernel,
        symmetric=every.symmetric[some],
        weights=every.weight[some],
    )


def _own_widths(every: Attempts, present: IsotropicKernel) -> DiagonalKernel | None:
    """The widths along the gripper's axes, or the object's, that predict best; None where they predict no
    better than a kernel's, or too few attempts choose.
    """
    won = every.share >= 0.5
    if min(won.sum(), (~won).sum()) < LEAST_THAT_CHOOSE:
        return None
    found = [
        fit_axis_bandwidths(every.poses, won, axes=axes, symmetric=every.symmetric, present=present)
        for axes in (None, np.eye(3))
    ]
    best = min(found, key=lambda each: each.log_loss)
    return best.kernel if best.log_loss < _BETTER * best.present_log_loss else None
