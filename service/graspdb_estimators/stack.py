"""Learned success probabilities: the kernel estimate set right, and stacked with trees where shapes tell.

``logit p = a + b t + s (c k + d) + e u``: t is the logit of boosted trees on what the jaw closes on, k that
of the kernel estimate, s = n / (1 + n) how much there is near, n the effective trials, and u the logit of
trees that learned of other objects, where there are any (Wolpert 1992, Breiman 1996). Without trees ``logit p
= a + c k`` sets the kernel estimate right: its averages blur the edges of success (Platt 1999). b, c and e
are not negative, so that no order is turned round. Where even the surest
succeed no more often than some share, or the worst as often as another, p lies between these two: chance that
no pose explains.

Both are learned from predictions of attempts whose block of space was left out. So is what they may be off
by: neighbours err alike, by a normal deviation of the logit, whose variance grows with what the kernel
estimate and the trees differ by and with how little is near; and how far from an attempt predictions are
better than the share of successes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from io import BytesIO
from typing import Any, Literal, TypeVar
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from graspdb_density import DiagonalKernel, Reach
from graspdb_density.se3 import Floats
from graspdb_density.success.calibration import brier_skill
from graspdb_density.success.reach import least_mean

from .boosted_trees import BoostedTrees

__all__ = ["LeftOut", "Stack", "Verdict"]

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Verdict = Literal["better", "no better"]
T = TypeVar("T")

#: Probabilities nearer to 0 or 1 than this say as much as this.
_CLIP = 1e-3
#: Probabilities nearer to 0 or 1 than can be told.
LEAST_CHANCE = 1e-6


@dataclass(frozen=True, eq=False, slots=True)
class LeftOut:
    """Attempts (J) predicted without their block of space, or without their object.

    Attributes
    ----------
    share, weight : (J,)
        By how much each succeeded, and how many it stands for.
    block : (J,) int64
    kernel, learned, low, high : (J,)
        What the kernel estimate says, under the widths of the density, and the stack, and the ends of the
        stack's 90 % interval.
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

    def arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """All there is of it, by name."""
        return {f"{prefix}_{each.name}": getattr(self, each.name) for each in fields(self)}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> LeftOut:
        """What :meth:`arrays` is of; KeyError without."""
        return cls(*(arrays[f"{prefix}_{each.name}"] for each in fields(cls)))

    def some(self, rows: Bools) -> LeftOut:
        """Some of them."""
        return LeftOut(*(getattr(self, each.name)[rows] for each in fields(self)))

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
    others : BoostedTrees or None
        Trees of other objects, which ask the first of the same features; None where there are none.
    weights : (4,) or (5,)
        a, b, c and d; and e with trees of other objects.
    limits : (2,)
        The least and the greatest probability there is.
    doubt : (3,)
        Variance of the logit: everywhere, by 1 - s, and by (k - t)^2 s.
    kernel : DiagonalKernel or None
        Of the attempts' own widths, by which it was learned; None: of the density's.
    reach_widths : float
        Up to how many widths of position from an attempt it tells.
    attempts : int
        How many it was learned from.
    left_out : LeftOut
    """

    trees: BoostedTrees | None
    others: BoostedTrees | None
    weights: Floats
    limits: Floats
    doubt: Floats
    kernel: DiagonalKernel | None
    reach_widths: float
    attempts: int
    left_out: LeftOut

    def reach(self, of_kernel: Reach) -> Reach:
        """How far it tells, where the kernel estimate tells so far."""
        if self.reach_widths <= of_kernel.position:
            return of_kernel
        return replace(of_kernel, position=self.reach_widths, validated_position=self.reach_widths)

    def combined(
        self, kernel: Floats, trials: Floats, features: NDArray[np.floating] | None
    ) -> tuple[Floats, Floats]:
        """Logit of success and its standard deviation, each (M,).

        Parameters
        ----------
        kernel, trials : (M,)
            The kernel estimate's probability and effective trials.
        features : (M, F) or None
            What trees ask, if there are any.
        """
        near = trials / (1.0 + trials)
        k = logit_of(kernel)
        trees, others = (
            None if each is None or features is None else each.logit(features)
            for each in (self.trees, self.others)
        )
        logit = terms(k, near, trees, others) @ (self.weights if trees is not None else self.weights[[0, 2]])
        spread = np.sqrt(doubts(k, near, trees) @ self.doubt)
        return within(logit, self.limits), np.asarray(spread)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held."""
        held = sum(each.nbytes for each in (self.trees, self.others) if each is not None)
        return held + 57 * len(self.left_out.share)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """All there is of it, by name."""
        arrays: dict[str, NDArray[Any]] = {
            "weights": self.weights,
            "limits": self.limits,
            "doubt": self.doubt,
            "numbers": np.array([self.reach_widths, float(self.attempts)]),
            **self.left_out.arrays("held"),
        }
        for which, each in (("trees", self.trees), ("others", self.others)):
            if each is not None:
                arrays |= {f"{which}_{name}": array for name, array in each.arrays.items()}
        if self.kernel is not None:
            arrays["sigmas"] = np.array(self.kernel.sigmas)
            if self.kernel.axes is not None:
                arrays["axes"] = np.reshape(self.kernel.axes, (3, 3))
        return arrays

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Stack:
        """What :attr:`arrays` is of; KeyError, TypeError or ValueError for anything else."""
        trees, others = (trees_among(arrays, which) for which in ("trees_", "others_"))
        reach, attempts = arrays["numbers"].tolist()
        kernel = DiagonalKernel.of(arrays["sigmas"], arrays.get("axes")) if "sigmas" in arrays else None
        held = LeftOut.of_arrays(arrays, "held")
        weights, limits, doubt = (arrays[name] for name in ("weights", "limits", "doubt"))
        return cls(trees, others, weights, limits, doubt, kernel, reach, int(attempts), held)

    def to_bytes(self) -> bytes:
        """All of it, to be kept; `of_bytes` reads it again."""
        return packed(self.arrays)

    @classmethod
    def of_bytes(cls, content: bytes) -> Stack:
        """What `to_bytes` wrote; ValueError for anything else."""
        return unpacked(content, "stack", cls.of_arrays)


def packed(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Arrays by their names, to be kept."""
    written = BytesIO()
    np.savez_compressed(written, **dict(arrays))  # type: ignore[arg-type]
    return written.getvalue()


def unpacked(content: bytes, what: str, made: Callable[[Mapping[str, NDArray[Any]]], T]) -> T:
    """What is ``made`` of arrays that were packed; ValueError where these bytes are none of it."""
    try:
        with np.load(BytesIO(content), allow_pickle=False) as found:
            return made(dict(found))
    except (ValueError, TypeError, AttributeError, KeyError, EOFError, OSError, BadZipFile) as error:
        raise ValueError(f"these bytes are no {what}: {error}") from None


def trees_among(arrays: Mapping[str, NDArray[Any]], prefix: str) -> BoostedTrees | None:
    """Trees whose arrays' names begin so, if there are any."""
    found = {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}
    return BoostedTrees.of_arrays(found) if found else None


def logit_of(p: Floats) -> Floats:
    """Logits (M,) of probabilities, as far as these say anything."""
    clipped = np.clip(p, _CLIP, 1.0 - _CLIP)
    return np.asarray(np.log(clipped) - np.log1p(-clipped), dtype=np.float64)


def terms(kernel: Floats, near: Floats, trees: Floats | None, others: Floats | None) -> Floats:
    """What the weights of the stack are of, (M, 5), (M, 4) without trees of others, or (M, 2) without any."""
    one = np.ones(len(kernel))
    if trees is None:
        return np.stack([one, kernel], axis=1)
    columns = [one, trees, near * kernel, near]
    return np.stack(columns if others is None else [*columns, others], axis=1)


def doubts(kernel: Floats, near: Floats, trees: Floats | None) -> Floats:
    """What the variance of the logit is made of, (M, 3)."""
    differ = np.zeros(len(kernel)) if trees is None else near * (kernel - trees) ** 2
    return np.stack([np.ones(len(kernel)), 1.0 - near, differ], axis=1)


def within(logit: Floats, limits: Floats) -> Floats:
    """Logits (M,) of probabilities brought between limits."""
    least, greatest = limits
    p = np.clip(least + (greatest - least) * expit(logit), LEAST_CHANCE, 1.0 - LEAST_CHANCE)
    return np.asarray(np.log(p) - np.log1p(-p))
