"""Bandwidths for every axis, chosen to predict success.

What predicts success is not what shapes the density: closing fingers centre a free object, so attempts apart
along the closing axis fare alike, while a few millimetres along the approach decide. Translations are along
the gripper's axes, or along fixed ones of the object: which predict better differs from object to object.

Bandwidths are chosen by the log loss of attempts whose block of space is left out; one half of them chooses,
the other judges. Blocks are small: large ones would hide from the choice whatever changes within them, and
blur. They hold what was tried at one position, so that repeated grasps and a grid's rotations do not predict
themselves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._compiled import diagonal
from ..kde.rows import Rows
from ..kernels.diagonal import DiagonalKernel
from ..kernels.isotropic import IsotropicKernel
from ..se3 import Floats, Poses
from .calibration import Blocks, assign_blocks, brier_skill
from .kernel_regression import checked_outcomes, shrunk_share

__all__ = ["LEAST_OF_EACH", "AxisBandwidths", "fit_axis_bandwidths"]

#: Fewer successes, or failures, than this choose no bandwidths.
LEAST_OF_EACH = 50
#: Least and largest bandwidths (6,), metres and radians, and those that the search starts from.
_LOW = np.repeat([0.002, math.radians(3.0)], 3)
_HIGH = np.repeat([0.04, math.radians(40.0)], 3)
_START = np.repeat([0.015, math.radians(15.0)], 3)
_BLOCK_M = 0.005
_TRAINED_MOST, _JUDGED_MOST, _PAIRS_MOST = 20_000, 1_500, 2_500_000
#: Pairs farther apart than this many of these widths are left out of the choice.
_CUT, _REACH = 0.5 * 3.5**2, np.array([0.025, math.radians(30.0)])
#: Steps of the search, as factors of a bandwidth.
_STEPS = (1.6, 1.25)
_ENOUGH = 1e-4
_CLIP = 1e-3


@dataclass(frozen=True, eq=False, slots=True)
class AxisBandwidths:
    """Kernels that predict success, and how well, on held-out attempts that did not choose them.

    Attributes
    ----------
    kernel : DiagonalKernel
    isotropic : IsotropicKernel
        The best isotropic kernel, chosen the same way.
    log_loss, isotropic_log_loss : float
        Nats an attempt.
    present_log_loss : float
        The same of the kernel that they are to replace; nan without one.
    skill, isotropic_skill : float
        Brier's: 1 perfect, 0 no better than the share of successes; nan where all fared alike.
    attempts, judged : int
        What they were chosen from, and judged on.
    """

    kernel: DiagonalKernel
    isotropic: IsotropicKernel
    log_loss: float
    isotropic_log_loss: float
    present_log_loss: float
    skill: float
    isotropic_skill: float
    attempts: int
    judged: int


def fit_axis_bandwidths(
    poses: Poses,
    success: ArrayLike,
    *,
    axes: ArrayLike | None = None,
    symmetric: ArrayLike | bool = True,
    present: IsotropicKernel | None = None,
) -> AxisBandwidths:
    """Bandwidths for a `SuccessModel`, by the log loss of attempts in blocks of space left out.

    Parameters
    ----------
    poses : N
        Attempts; where collisions are tested, those that did not collide.
    success : (N,) bool
    axes : (3, 3) or None
        Columns are the axes of translations, object frame; None: each gripper's.
    present : IsotropicKernel or None
        A kernel to judge on the same attempts.

    Raises
    ------
    ValueError
        For fewer than `LEAST_OF_EACH` successes or failures, or attempts all in one place.
    """
    won = checked_outcomes(success, len(poses))
    wins, losses = int(won.sum()), int((~won).sum())
    if min(wins, losses) < LEAST_OF_EACH:
        raise ValueError(
            f"widths that predict success are chosen from at least {LEAST_OF_EACH} successes and"
            f" {LEAST_OF_EACH} failures; there are {wins} and {losses}"
        )
    rng = np.random.default_rng(0)
    kept = np.sort(rng.permutation(len(poses))[:_TRAINED_MOST])
    rows, won = Rows.of(poses, symmetric=symmetric)[kept], won[kept]
    blocks = assign_blocks(rows.poses.positions, edge_m=_BLOCK_M)
    along = DiagonalKernel.of(_START, axes).along(rows.poses)
    held = _HeldOut(along, won, rows.symmetric, blocks, turning=axes is None, rng=rng)
    alike = _coordinate_descent(held, _START, ((0, 1, 2), (3, 4, 5)))
    widths = _coordinate_descent(held, alike, tuple((axis,) for axis in range(6)))
    (loss, skill), (alike_loss, alike_skill) = held.verdict(widths), held.verdict(alike)
    return AxisBandwidths(
        kernel=DiagonalKernel.of(widths, axes),
        isotropic=IsotropicKernel(float(alike[0]), float(alike[3])),
        log_loss=loss,
        isotropic_log_loss=alike_loss,
        present_log_loss=math.nan if present is None else held.verdict(_widths_of(present))[0],
        skill=skill,
        isotropic_skill=alike_skill,
        attempts=len(kept),
        judged=int((~held.choosing).sum()),
    )


def _widths_of(kernel: IsotropicKernel) -> Floats:
    return np.repeat([kernel.sigma_position_m, kernel.sigma_rotation], 3)


class _HeldOut:
    """Attempts with what is near them in other folds; blocks of space choose or judge, never both."""

    def __init__(
        self,
        poses: Poses,
        won: NDArray[np.bool_],
        symmetric: NDArray[np.bool_],
        blocks: Blocks,
        *,
        turning: bool,
        rng: np.random.Generator,
    ) -> None:
        # Successes are few: half of what is judged, each class weighted by what it stands for.
        classes = [rng.permutation(np.flatnonzero(won == y))[: _JUDGED_MOST // 2] for y in (True, False)]
        judged = rng.permutation(np.concatenate(classes))
        # Counted on a few first, so that what is kept fits.
        few = judged[: max(1, len(judged) // 20)]
        nothing = np.empty(0, dtype=np.int32), np.empty((0, 6), dtype=np.float32)
        first = np.empty(len(few) + 1, dtype=np.int64)
        every = poses.positions, poses.quaternions_xyzw, symmetric, blocks.fold
        each = diagonal.near_pairs(*every, few, turning, _REACH, _CUT, first, *nothing) / len(few)
        judged = judged[: max(50, int(_PAIRS_MOST / max(1.2 * each, 1.0)))]
        room = min(_PAIRS_MOST, int(1.5 * each * len(judged)) + 10_000)
        self.first = np.empty(len(judged) + 1, dtype=np.int64)
        row, squared = np.empty(room, dtype=np.int32), np.empty((room, 6), dtype=np.float32)
        count = diagonal.near_pairs(*every, judged, turning, _REACH, _CUT, self.first, row, squared)
        count = min(int(count), room)
        self.squared, self.won = squared[:count], won[row[:count]]
        self.outcome = won[judged]
        self.share = float(won.mean())
        shares = {y: np.mean(won == y) / max(np.mean(self.outcome == y), 1e-9) for y in (True, False)}
        self.weight = np.where(self.outcome, shares[True], shares[False])
        names = np.unique(blocks.block)
        first_half = rng.permutation(names)[: (len(names) + 1) // 2]
        self.choosing = np.isin(blocks.block[judged], first_half)
        if self.choosing.all() or not self.choosing.any():
            self.choosing = np.arange(len(judged)) % 2 == 0

    def predicted(self, widths: Floats) -> Floats:
        """Success probability of the judged attempts under bandwidths (6,)."""
        out = np.empty((len(self.outcome), 3))
        diagonal.held_out_sums(self.first, self.won, self.squared, 0.5 / widths**2, _CUT, out)
        won, total, squares = out.T
        return shrunk_share(won, total, squares, self.share)[0]

    def loss(self, widths: Floats) -> float:
        """Log loss of the attempts that choose."""
        chosen = self.choosing
        return _log_loss(self.predicted(widths)[chosen], self.outcome[chosen], self.weight[chosen])

    def verdict(self, widths: Floats) -> tuple[float, float]:
        """Log loss and Brier skill of the attempts that judge."""
        judges = ~self.choosing
        p, y, w = self.predicted(widths)[judges], self.outcome[judges], self.weight[judges]
        return _log_loss(p, y, w), brier_skill(p, y, weights=w)


def _log_loss(p: Floats, y: NDArray[np.bool_], w: Floats) -> float:
    clipped = np.clip(p, _CLIP, 1.0 - _CLIP)
    return float(-np.average(np.where(y, np.log(clipped), np.log1p(-clipped)), weights=w))


def _coordinate_descent(held: _HeldOut, start: Floats, groups: tuple[tuple[int, ...], ...]) -> Floats:
    """Bandwidths of least loss: groups of axes in turn, larger and smaller by shrinking factors."""
    best, loss = start, held.loss(start)
    for step in _STEPS:
        improved = True
        while improved:
            improved = False
            for group in groups:
                for factor in (step, 1.0 / step):
                    tried = best.copy()
                    tried[list(group)] *= factor
                    tried = np.clip(tried, _LOW, _HIGH)
                    value = held.loss(tried)
                    if value < loss - _ENOUGH:
                        best, loss, improved = tried, value, True
    return best
