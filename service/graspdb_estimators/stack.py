"""Learned success probabilities: the kernel estimate set right, and stacked with trees where shapes tell.

``logit p = a + b t + s (c k + d)``: t is the logit of boosted trees on what the jaw closes on, k that of the
kernel estimate, and s = n / (1 + n) how much there is near, n the effective trials (Wolpert 1992, Breiman
1996). Without trees ``logit p = a + c k`` sets the kernel estimate right: its averages blur the edges of
success (Platt 1999). b and c are not negative, so that no order is turned round. Where even the surest
succeed no more often than some share, or the worst as often as another, p lies between these two: chance that
no pose explains.

Both are learned from predictions of attempts whose block of space was left out. So is what they may be off
by: neighbours err alike, by a normal deviation of the logit, whose variance grows with what the kernel
estimate and the trees differ by and with how little is near; and how far from an attempt predictions are
better than the share of successes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from io import BytesIO
from typing import Any, Literal, NamedTuple
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, nnls
from scipy.spatial import cKDTree
from scipy.special import expit

from graspdb_density import Reach, SuccessModel, se3
from graspdb_density.se3 import Floats, Poses
from graspdb_density.success.calibration import Blocks, assign_blocks, brier_skill
from graspdb_density.success.kernel_regression import SUCCESS_CUTOFF, Attempts
from graspdb_density.success.reach import least_mean

from .boosted_trees import BoostedTrees
from .grasp_features import GraspFeatures

__all__ = ["LEAST_ATTEMPTS", "LEAST_BLOCKS", "LEAST_OF_EACH", "LeftOut", "Stack", "Verdict", "fit_stack"]

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Verdict = Literal["better", "no better"]

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
#: Probabilities nearer to 0 or 1 than this say as much as this.
_CLIP = 1e-3
#: Precision of the prior of the weights of the stack about "trees alone" or "the kernel estimate as it is".
_PRECISION = 1.0
#: How far the limits of probability may be from 0 and 1, what that costs in nats, and probabilities nearer to
#: 0 or 1 than can be told.
_MOST_CHANCE, _COST, _LEAST_CHANCE = 0.3, 10.0, 1e-6
#: Least variance of the logit where nothing is near.
_LEAST_DOUBT = 0.5
#: Neighbours by which errors are judged, and the least p (1 - p) that they are counted by.
_NEIGHBOURS, _LEAST_OWN = 3, 0.01
#: Correlation of what neighbours are off by: they are a width or so apart.
_ALIKE = 0.6
#: Distances that predictions may reach to are multiples of this many widths.
_STEP = 0.25


@dataclass(frozen=True, eq=False, slots=True)
class LeftOut:
    """Attempts (J) predicted without their block of space.

    Attributes
    ----------
    share, weight : (J,)
        By how much each succeeded, and how many it stands for.
    block : (J,) int64
    kernel, learned, low, high : (J,)
        What the kernel estimate and the stack say, and the ends of the stack's 90 % interval.
    told : (J,) bool
        Whether an attempt of another block is within reach.
    """

    share: Floats
    weight: Floats
    block: Ints
    kernel: Floats
    learned: Floats
    low: Floats
    high: Floats
    told: Bools

    @property
    def verdict(self) -> Verdict:
        """Whether the stack predicts better than the kernel estimate, by Brier's score and its interval."""
        gain = (self.kernel - self.share) ** 2 - (self.learned - self.share) ** 2
        least = least_mean(gain, self.weight, self.block)
        return "better" if least is not None and least > 0.0 else "no better"

    @property
    def coverage(self) -> float:
        """Share of the blocks, of those predicted between 0.05 and 0.95, whose successes lie within what the
        intervals and chance explain, chance at the level of the intervals; nan without such blocks.
        """
        names, group, count = np.unique(self.block, return_inverse=True, return_counts=True)
        group = group.reshape(-1)
        mean, low, high, won = (
            np.bincount(group, weights=column, minlength=len(names)) / count
            for column in (self.learned, self.low, self.high, self.share)
        )
        uncertain = (mean > 0.05) & (mean < 0.95)
        if not uncertain.any():
            return math.nan
        from scipy.stats import binom  # late: 0.5 s

        n, k = count[uncertain], won[uncertain] * count[uncertain]
        least, most = binom.ppf(0.05, n, low[uncertain]), binom.ppf(0.95, n, high[uncertain])
        return float(np.mean((least <= np.ceil(k)) & (np.floor(k) <= most)))

    @property
    def skills(self) -> tuple[float, float]:
        """Brier skill of the stack and of the kernel estimate."""
        return tuple(  # type: ignore[return-value]
            brier_skill(values, self.share, weights=self.weight) for values in (self.learned, self.kernel)
        )


@dataclass(frozen=True, eq=False, slots=True)
class Stack:
    """What was learned; immutable.

    Attributes
    ----------
    trees : BoostedTrees or None
        None where geometry is not known.
    weights : (4,)
        a, b, c and d.
    limits : (2,)
        The least and the greatest probability there is.
    doubt : (3,)
        Variance of the logit: everywhere, by 1 - s, and by (k - t)^2 s.
    reach_widths : float
        Up to how many widths of position from an attempt it tells.
    attempts : int
        How many it was learned from.
    left_out : LeftOut
    """

    trees: BoostedTrees | None
    weights: Floats
    limits: Floats
    doubt: Floats
    reach_widths: float
    attempts: int
    left_out: LeftOut

    def reach(self, of_kernel: Reach) -> Reach:
        """How far it tells, where the kernel estimate tells so far."""
        if self.reach_widths <= of_kernel.position:
            return of_kernel
        return replace(of_kernel, position=self.reach_widths, validated_position=self.reach_widths)

    def combined(self, kernel: Floats, trials: Floats, trees: Floats | None) -> tuple[Floats, Floats]:
        """Logit of success and its standard deviation, each (M,).

        Parameters
        ----------
        kernel, trials : (M,)
            The kernel estimate's probability and effective trials.
        trees : (M,) or None
            The trees' logit, if there are any.
        """
        near = trials / (1.0 + trials)
        k = _logit(kernel)
        logit = _terms(k, near, trees) @ (self.weights if trees is not None else self.weights[[0, 2]])
        spread = np.sqrt(_doubts(k, near, trees) @ self.doubt)
        return _within(logit, self.limits), np.asarray(spread)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held."""
        return (0 if self.trees is None else self.trees.nbytes) + 57 * len(self.left_out.share)

    def to_bytes(self) -> bytes:
        """All of it, to be kept; `of_bytes` reads it again."""
        arrays: dict[str, NDArray[Any]] = {
            "weights": self.weights,
            "limits": self.limits,
            "doubt": self.doubt,
            "numbers": np.array([self.reach_widths, float(self.attempts)]),
            **{f"held_{each.name}": getattr(self.left_out, each.name) for each in fields(LeftOut)},
        }
        if self.trees is not None:
            arrays |= {f"trees_{name}": array for name, array in self.trees.arrays.items()}
        written = BytesIO()
        np.savez_compressed(written, **arrays)  # type: ignore[arg-type]
        return written.getvalue()

    @classmethod
    def of_bytes(cls, content: bytes) -> Stack:
        """What `to_bytes` wrote; ValueError for anything else."""
        try:
            with np.load(BytesIO(content), allow_pickle=False) as found:
                arrays = dict(found)
            held = LeftOut(*(arrays[f"held_{each.name}"] for each in fields(LeftOut)))
            trees = {
                name.removeprefix("trees_"): a for name, a in arrays.items() if name.startswith("trees_")
            }
            made = BoostedTrees.of_arrays(trees) if trees else None
            reach, attempts = arrays["numbers"].tolist()
            weights, limits, doubt = (arrays[name] for name in ("weights", "limits", "doubt"))
            return cls(made, weights, limits, doubt, reach, int(attempts), held)
        except (ValueError, TypeError, AttributeError, KeyError, EOFError, OSError, BadZipFile) as error:
            raise ValueError(f"these bytes are no stack: {error}") from None


def fit_stack(
    model: SuccessModel,
    features: GraspFeatures | None,
    *,
    reach: Reach,
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
    breathe
        Called between steps of a few seconds at most.
    """
    every = model.attempts()
    succeeded = every.share >= 0.5
    if len(succeeded) < LEAST_ATTEMPTS or min(succeeded.sum(), (~succeeded).sum()) < LEAST_OF_EACH:
        return None
    # Questions come where attempts are: the kernel estimate alone is set right for as much as is near there,
    # and only what was tried at the same position is left out.
    edge = _SPOT_M if features is None else float(np.clip(_BLOCK_WIDTHS * model.widest_m, *_BLOCK_M))
    blocks = _blocks(every.poses.positions, edge)
    if blocks is None:
        return None
    rng = np.random.default_rng(0)
    learned, _ = _sample(succeeded, every.weight, _LEARNED, rng)
    judged, weight = _sample(succeeded, every.weight, _JUDGED, rng)
    breathe()
    lesson = _Lesson.of(every, learned, features, threads)
    kernel, trials, widths, turned = (np.empty(len(judged)) for _ in range(4))
    trees = np.empty(len(judged)) if features is not None else None
    for number in range(blocks.folds):
        rows = np.flatnonzero(blocks.fold[judged] == number)
        if not rows.size:
            continue
        poses, rest = every.poses[judged[rows]], blocks.fold[learned] != number
        out = _model(model, every, np.flatnonzero(blocks.fold == number))
        kernel[rows], trials[rows] = model.without(out, poses, threads=threads)
        breathe()
        near = _model(model, every, learned[rest]).support(poses, threads=threads)[1]
        widths[rows], turned[rows] = near.position_widths, near.rotation_widths
        breathe()
        fold = lesson.learned(rest)
        if trees is not None and features is not None and fold is not None:
            trees[rows] = fold.logit(features.at(poses, threads))
        breathe()
    told = _Predicted(
        _logit(kernel), trials / (1.0 + trials), trees,
        every.share[judged], weight, blocks.block[judged], blocks.fold[judged],
        _neighbours(every.poses[judged], blocks.fold[judged], (model.widest_m, max(model.sigmas[3:]))),
    )  # fmt: skip
    return _stacked(told, lesson.learned(None), reach, widths, turned, model.size)


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


class _Predicted(NamedTuple):
    """Predictions (J,) of attempts without their fold: the kernel's logit, how much is near, the trees'.

    And by how much they succeeded, what they weigh, their block and their fold; which are neighbours (K, 2).
    """

    kernel: Floats
    near: Floats
    trees: Floats | None
    share: Floats
    weight: Floats
    block: Ints
    fold: Ints
    pairs: Ints

    @property
    def terms(self) -> Floats:
        return _terms(self.kernel, self.near, self.trees)


def _stacked(
    told: _Predicted,
    trees: BoostedTrees | None,
    reach: Reach,
    widths: Floats,
    turned: Floats,
    attempts: int,
) -> Stack:
    """The stack of what was predicted without its block, `widths` of position from the nearest attempt."""
    terms = told.terms
    logit = np.empty(len(terms))
    # What it predicts of a fold is weighed by the others, too.
    for number in np.unique(told.fold):
        out = told.fold == number
        weights, limits = _weighed(terms[~out], told.share[~out], told.weight[~out])
        logit[out] = _within(terms[out] @ weights, limits)
    weights, limits = _weighed(terms, told.share, told.weight)
    if told.trees is None:
        weights = np.array([weights[0], 0.0, weights[1], 0.0])
    probability = expit(logit)
    doubts = _doubts(told.kernel, told.near, told.trees)
    doubt = _variances(probability, doubts, told)
    half = 1.6448536269514722 * np.sqrt(doubts @ doubt)
    inside = turned <= reach.rotation
    # What kernels alone tell of the far side of what was tried, their own reach has judged.
    reached = reach.position
    if told.trees is not None:
        reached = max(reached, _reached(probability, told, widths, inside))
    held = LeftOut(
        told.share, told.weight, told.block, expit(told.kernel), probability,
        expit(logit - half), expit(logit + half), inside & (widths <= reached),
    )  # fmt: skip
    return Stack(trees, weights, limits, doubt, reached, attempts, held)


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


def _model(like: SuccessModel, every: Attempts, rows: Ints) -> SuccessModel:
    """A model of some attempts under the kernel of another."""
    share, whole = every.share[rows], np.isin(every.share, (0.0, 1.0)).all()
    return SuccessModel.build(
        every.poses[rows],
        share >= 0.5 if whole else share,
        kernel=like.kernel,
        symmetric=every.symmetric[rows],
        weights=every.weight[rows],
    )


def _logit(p: Floats) -> Floats:
    clipped = np.clip(p, _CLIP, 1.0 - _CLIP)
    return np.asarray(np.log(clipped) - np.log1p(-clipped), dtype=np.float64)


def _terms(kernel: Floats, near: Floats, trees: Floats | None) -> Floats:
    """What the weights of the stack are of, (M, 4), or (M, 2) without trees."""
    one = np.ones(len(kernel))
    if trees is None:
        return np.stack([one, kernel], axis=1)
    return np.stack([one, trees, near * kernel, near], axis=1)


def _doubts(kernel: Floats, near: Floats, trees: Floats | None) -> Floats:
    """What the variance of the logit is made of, (M, 3)."""
    differ = np.zeros(len(kernel)) if trees is None else near * (kernel - trees) ** 2
    return np.stack([np.ones(len(kernel)), 1.0 - near, differ], axis=1)


def _within(logit: Floats, limits: Floats) -> Floats:
    """Logits (M,) of probabilities brought between limits."""
    least, greatest = limits
    p = np.clip(least + (greatest - least) * expit(logit), _LEAST_CHANCE, 1.0 - _LEAST_CHANCE)
    return np.asarray(np.log(p) - np.log1p(-p))


def _weighed(terms: Floats, share: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Weights of the terms, near "trees alone" or "the kernel as it is", and limits, by the log loss."""
    mean = np.array([0.0, 1.0, 0.0, 0.0]) if terms.shape[1] == 4 else np.array([0.0, 1.0])
    count = len(mean)
    lowest = [None, 0.0, 0.0, None][:count]
    scaled = weight / weight.mean()

    def loss(at: Floats) -> tuple[float, Floats]:
        weights, (below, above) = at[:count], at[count:]
        s = expit(terms @ weights)
        room = 1.0 - below - above
        p = np.clip(below + room * s, _LEAST_CHANCE, 1.0 - _LEAST_CHANCE)
        value = -scaled @ (share * np.log(p) + (1.0 - share) * np.log1p(-p))
        slope = scaled * (p - share) / (p * (1.0 - p))
        along = terms.T @ (slope * room * s * (1.0 - s)) + _PRECISION * (weights - mean)
        value += 0.5 * _PRECISION * np.sum((weights - mean) ** 2) + _COST * (below + above)
        return float(value), np.append(along, [slope @ (1.0 - s) + _COST, _COST - slope @ s])

    bounds = [*((low, None) for low in lowest), (0.0, _MOST_CHANCE), (0.0, _MOST_CHANCE)]
    start = np.append(mean, [_COST / len(terms) * 0.1] * 2)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    return np.asarray(found[:count]), np.array([found[count], 1.0 - found[count + 1]])


def _variances(p: Floats, doubts: Floats, told: _Predicted) -> Floats:
    """Variances (3,) of the logit by moments: what neighbours are off by alike, beyond chance.

    Two attempts are off by y - p each. Chance is each one's own, so the mean of the product is that of what
    both predictions are off by: p (1 - p) sigma of either, sigma^2 the variance of the logit there.
    """
    one, other = told.pairs.T
    off = told.share - p
    own = np.maximum(p * (1.0 - p), _LEAST_OWN)
    both = np.sqrt(own[one] * own[other])
    columns = np.sqrt(doubts[one] * doubts[other]) * both[:, None]
    everywhere, far, apart = nnls(columns, off[one] * off[other] / both)[0] / _ALIKE
    # Few may agree by chance: never surer than what so many tell, nor than the few trials near a pose.
    return np.array([everywhere + 4.0 / len(p), max(far, _LEAST_DOUBT), apart])


def _neighbours(poses: Poses, block: Ints, sigmas: tuple[float, float]) -> Ints:
    """Pairs (K, 2) of poses of one block that are neighbours, by distance in the kernel's widths."""
    turned = se3.to_matrix(poses.quaternions_xyzw)
    y = turned[:, :, 1]
    a, b = np.triu_indices(3)
    at = np.concatenate(
        [poses.positions / sigmas[0], turned[:, :, 2] / sigmas[1], y[:, a] * y[:, b] / sigmas[1]], axis=1
    )
    near = np.asarray(cKDTree(at).query(at, k=min(1 + _NEIGHBOURS, len(at)))[1])
    pairs = np.stack([np.repeat(near[:, 0], near.shape[1] - 1), near[:, 1:].reshape(-1)], axis=1)
    pairs = np.unique(np.sort(pairs[block[pairs[:, 0]] == block[pairs[:, 1]]], axis=1), axis=0)
    return np.asarray(pairs[pairs[:, 0] < pairs[:, 1]], dtype=np.int64)


def _reached(p: Floats, told: _Predicted, widths: Floats, inside: Bools) -> float:
    """The largest distance of position in widths beyond which attempts are still predicted better than by the
    share of successes of the others; 0 where none are.
    """
    share, weight = told.share, told.weight
    won, total = float(weight @ share), float(weight.sum())
    others = (won - weight * share) / (total - weight)
    gain = (others - share) ** 2 - (p - share) ** 2
    reached = 0.0
    for number in range(round(SUCCESS_CUTOFF / _STEP) + 1):
        beyond = inside & (widths >= number * _STEP)
        better = least_mean(gain[beyond], weight[beyond], told.block[beyond])
        if better is None or better <= 0.0 or math.isnan(better):
            break
        reached = number * _STEP
    return reached
