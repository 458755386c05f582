"""What a trial is worth: by how much the success probability of the best grasp is expected to rise.

Beliefs are a continuous correlated beta process (Goetschalckx, Poupart and Hoey 2011; for grasps Laskey et
al. 2015 and Mahler et al. 2016): at a pose the success probability has a Beta distribution that starts from a
mean worth one trial, and every attempt counts there by the kernel between them. Effective trials, by which
intervals are told, do not fall off with distance; these do, so that what was tried far away settles nothing.

Were the success probability theta of a grasp known, the better of it and of the best one believed so far
would be taken: E max(theta, best) - best is the value of that knowledge (Howard 1966), the expected
improvement, and the knowledge gradient of many trials there (Frazier and Powell 2010). One trial alone mostly
changes no decision, and would rank all grasps alike. The grasp that is told to be the best, by whatever rule,
may be believed to be worse: what it falls short counts, too, so that it is tried before it is relied on, as
the leader is in top-two sampling (Russo 2020).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

from ..se3 import Floats, Poses
from .kernel_regression import PRIOR_TRIALS, SuccessModel

__all__ = ["Beliefs", "Choice", "expected_excess"]

#: Beta distributions need some of either outcome.
_LEAST = 1e-6
#: What a grasp counts at others below this changes nothing there.
_NOTHING = 1e-3


@dataclass(frozen=True, eq=False, slots=True)
class Choice:
    """Rows (count,) to try, in the order in which they were chosen, and what each was expected to gain."""

    rows: NDArray[np.intp]
    gains: Floats


@dataclass(frozen=True, eq=False, slots=True)
class Beliefs:
    """How likely each of M grasps holds, and how sure that is.

    Attributes
    ----------
    poses : M
    mean : (M,)
        Expected success probability of a grasp that comes to its pose.
    trials : (M,)
        As how many trials those around count there, besides the one that the prior mean is worth.
    comes : (M,)
        Share of executions that come to the pose without a collision, 0 to 1, as far as geometry tells: of
        those alone trials decide.
    """

    poses: Poses
    mean: Floats
    trials: Floats
    comes: Floats

    def __post_init__(self) -> None:
        shape = (len(self.poses),)
        for name in ("mean", "trials", "comes"):
            values = getattr(self, name)
            if values.shape != shape or not np.isfinite(values).all() or (values < 0.0).any():
                raise ValueError(f"{name} must be finite, not negative and of shape {shape}")
        if (self.mean > 1.0).any() or (self.comes > 1.0).any():
            raise ValueError("mean and comes are shares, at most 1")

    @property
    def expected(self) -> Floats:
        """(M,) expected success probability of an execution."""
        return self.mean * self.comes

    def gains(self, answer: int | None = None) -> Floats:
        """By how much knowing the success probability of each (M,) would raise that of the best grasp.

        ``answer`` is the row that is told to be the best grasp now; None: that with the highest expectation.
        """
        best = float(self.expected.max())
        found = self._excess(best, np.arange(len(self.poses)))
        if answer is not None:
            found[answer] += best - self.expected[answer]
        return found

    def choose(self, count: int, seen: SuccessModel, answer: int | None = None) -> Choice:
        """The grasps to try together, one after the other: each by its gain once those before were tried with
        the outcomes that are expected of them, so that no spot is tried twice for the same reason.

        ``seen`` is an empty or other model with the kernel, and the object's motions, by which trials tell of
        one another. Once the answer is tried, the highest expectation is what others have to exceed.
        """
        if not len(self.poses):
            raise ValueError("there is nothing to choose from")
        beliefs, gain, best = self, self.gains(answer), float(self.expected.max())
        rows, gains = np.empty(count, dtype=np.intp), np.empty(count)
        for place in range(count):
            row = int(np.argmax(gain))
            rows[place], gains[place] = row, gain[row]
            told = seen.nearness(beliefs.poses[row : row + 1], beliefs.poses)
            beliefs = replace(beliefs, trials=beliefs.trials + told)
            if row == answer:
                # What it falls short of the best was for not knowing.
                answer = None
            changed = np.flatnonzero(told > _NOTHING)
            changed = changed[changed != answer]
            gain[changed] = beliefs._excess(best, changed)
        return Choice(rows, gains)

    def _excess(self, threshold: float, rows: NDArray[np.intp]) -> Floats:
        """E max(theta comes - threshold, 0) of rows."""
        comes = np.maximum(self.comes[rows], _LEAST)
        return comes * expected_excess(self.mean[rows], self.trials[rows], threshold / comes)


def expected_excess(mean: Floats, trials: Floats, threshold: Floats) -> Floats:
    """E max(theta - threshold, 0) for theta of Beta distributions (M,) with a mean, worth so many trials and
    one more.
    """
    worth = PRIOR_TRIALS + trials
    alpha = np.maximum(mean * worth, _LEAST)
    beta = np.maximum((1.0 - mean) * worth, _LEAST)
    at = np.clip(threshold, 0.0, 1.0)
    centre = alpha / (alpha + beta)
    above = centre * (1.0 - betainc(alpha + 1.0, beta, at)) - at * (1.0 - betainc(alpha, beta, at))
    return np.asarray(np.maximum(above, 0.0), dtype=np.float64)
