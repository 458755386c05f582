"""From predictions of attempts that were left out to the stack that weighs them, and its doubts."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, nnls
from scipy.spatial import cKDTree
from scipy.special import expit

from graspdb_density import DiagonalKernel, Reach, se3
from graspdb_density.se3 import Floats, Poses
from graspdb_density.success.kernel_regression import SUCCESS_CUTOFF
from graspdb_density.success.reach import least_mean

from .boosted_trees import BoostedTrees
from .stack import LEAST_CHANCE, LeftOut, Stack, doubts, terms, within

__all__ = ["Distances", "Learned", "Predicted", "neighbours", "stacked"]

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

#: Weights before anything is known, by how many there are: the kernel estimate as it is, trees alone, or both
#: kinds of trees alike; and the precision of that.
_EXPECTED = {
    2: np.array([0.0, 1.0]),
    4: np.array([0.0, 1.0, 0.0, 0.0]),
    5: np.array([0.0, 0.5, 0.0, 0.0, 0.5]),
}
_PRECISION = 1.0
#: How far the limits of probability may be from 0 and 1, and what that costs in nats.
_MOST_CHANCE, _COST = 0.3, 10.0
#: Least variance of the logit where nothing is near.
_LEAST_DOUBT = 0.5
#: Neighbours by which errors are judged, and the least p (1 - p) that they are counted by.
_NEIGHBOURS, _LEAST_OWN = 3, 0.01
#: Correlation of what neighbours are off by: they are a width or so apart.
_ALIKE = 0.6
#: Distances that predictions may reach to are multiples of this many widths.
_STEP = 0.25


class Predicted(NamedTuple):
    """Predictions (J,) of attempts without their fold: the kernel's logit, how much is near, the trees', that
    of others' trees; and the plain kernel estimate's probability, under the density's widths.

    And by how much they succeeded, what they weigh, their block and their fold; which are neighbours (K, 2).
    """

    kernel: Floats
    near: Floats
    trees: Floats | None
    others: Floats | None
    plain: Floats
    share: Floats
    weight: Floats
    block: Ints
    fold: Ints
    pairs: Ints

    @property
    def terms(self) -> Floats:
        return terms(self.kernel, self.near, self.trees, self.others)


class Distances(NamedTuple):
    """How far attempts (J,) are from the nearest one of another fold, in widths of position and of rotation,
    and up to where the kernel estimate tells.
    """

    position: Floats
    rotation: Floats
    reach: Reach


class Learned(NamedTuple):
    """What was learned of all attempts: their trees, those of others, and their kernel's own widths."""

    trees: BoostedTrees | None
    others: BoostedTrees | None
    kernel: DiagonalKernel | None
    attempts: int


def stacked(told: Predicted, learned: Learned, far: Distances | None) -> Stack:
    """The stack of what was predicted without its fold; ``far`` None: of attempts of other objects."""
    columns = told.terms
    logit = np.empty(len(columns))
    # What it predicts of a fold is weighed by the others, too.
    for number in np.unique(told.fold):
        out = told.fold == number
        weights, limits = _weighed(columns[~out], told.share[~out], told.weight[~out])
        logit[out] = within(columns[out] @ weights, limits)
    weights, limits = _weighed(columns, told.share, told.weight)
    if told.trees is None:
        weights = np.array([weights[0], 0.0, weights[1], 0.0])
    probability = expit(logit)
    parts = doubts(told.kernel, told.near, told.trees)
    doubt = _variances(probability, parts, told)
    half = 1.6448536269514722 * np.sqrt(parts @ doubt)
    reached, inside = 0.0, np.ones(len(logit), dtype=np.bool_)
    if far is not None:
        inside = far.rotation <= far.reach.rotation
        # What kernels alone tell of the far side of what was tried, their own reach has judged.
        reached = far.reach.position
        if told.trees is not None:
            reached = max(reached, _reached(probability, told, far.position, inside))
        inside &= far.position <= reached
    held = LeftOut(
        told.share, told.weight, told.block, told.plain, probability,
        expit(logit - half), expit(logit + half), inside,
    )  # fmt: skip
    trees, others, kernel, attempts = learned
    return Stack(trees, others, weights, limits, doubt, kernel, reached, attempts, held)


def _weighed(terms: Floats, share: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """Weights of the terms, near what is expected of them, and limits, by the log loss."""
    count = terms.shape[1]
    mean, lowest = _EXPECTED[count], [None, 0.0, 0.0, None, 0.0][:count]
    scaled = weight / weight.mean()

    def loss(at: Floats) -> tuple[float, Floats]:
        weights, (below, above) = at[:count], at[count:]
        s = expit(terms @ weights)
        room = 1.0 - below - above
        p = np.clip(below + room * s, LEAST_CHANCE, 1.0 - LEAST_CHANCE)
        value = -scaled @ (share * np.log(p) + (1.0 - share) * np.log1p(-p))
        slope = scaled * (p - share) / (p * (1.0 - p))
        along = terms.T @ (slope * room * s * (1.0 - s)) + _PRECISION * (weights - mean)
        value += 0.5 * _PRECISION * np.sum((weights - mean) ** 2) + _COST * (below + above)
        return float(value), np.append(along, [slope @ (1.0 - s) + _COST, _COST - slope @ s])

    bounds = [*((low, None) for low in lowest), (0.0, _MOST_CHANCE), (0.0, _MOST_CHANCE)]
    start = np.append(mean, [_COST / len(terms) * 0.1] * 2)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    return np.asarray(found[:count]), np.array([found[count], 1.0 - found[count + 1]])


def _variances(p: Floats, doubts: Floats, told: Predicted) -> Floats:
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


def neighbours(poses: Poses, block: Ints, sigmas: tuple[float, float]) -> Ints:
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


def _reached(p: Floats, told: Predicted, widths: Floats, inside: Bools) -> float:
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
