"""Success probabilities under widths for every axis, and widths chosen to predict success.

What predicts success is not what shapes the density: closing fingers centre a free object, so attempts apart
along the closing axis fare alike, while a few millimetres along the approach decide. Translations are along
the gripper's axes, or along fixed ones of the object: which predict better differs from object to object.

Widths are chosen by the log loss of attempts whose block of space is left out; one half of them chooses, the
other judges. Blocks are small: large ones would hide from the choice whatever changes within them, and blur.
They hold what was tried at one position, so that repeated grasps and a grid's rotations do not predict
themselves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._compiled import diagonal
from .._compiled.threads import for_blocks
from ..kde.cell_list import Cells
from ..kde.isotropic import scaled_radius
from ..kernels.isotropic import IsotropicKernel
from ..se3 import UNIT_TOLERANCE, Floats
from .calibration import assign_blocks
from .kernel_regression import PRIOR_TRIALS, SuccessModel, _attempts

__all__ = ["LEAST_OF_EACH", "FittedWidths", "ShapedSuccessModel", "Widths", "fit_widths"]

#: Fewer successes, or failures, than this choose no widths.
LEAST_OF_EACH = 50
#: Widths asked for, metres and radians.
_POSITION_M, _ROTATION = (0.002, 0.04), (math.radians(3.0), math.radians(40.0))
_BLOCK_M = 0.005
_TRAINED_MOST, _JUDGED_MOST, _PAIRS_MOST = 20_000, 1_500, 2_500_000
#: Pairs farther apart than this many of these widths are left out of the choice.
_CUT, _REACH = 0.5 * 3.5**2, np.array([0.025, math.radians(30.0)])
#: Steps of the search, as factors of a width.
_STEPS = (1.6, 1.25)
_ENOUGH = 1e-4
_CLIP = 1e-3
_QUERY_BLOCK = 128
_SORTED_FROM = 256


@dataclass(frozen=True, slots=True)
class Widths:
    """A kernel that predicts success, to be compared with others.

    Attributes
    ----------
    sigmas : (6,)
        Standard deviations along (metres) and about (radians) x, y, z.
    axes : (9,) or None
        Of translations, object frame: a matrix row by row whose columns they are; None: the gripper's.
    """

    sigmas: tuple[float, ...]
    axes: tuple[float, ...] | None = None


class ShapedSuccessModel(SuccessModel):
    """Attempts under a Gaussian over displacements, one width an axis; immutable.

    As `SuccessModel`, but for its kernel: ``k = exp(-sum xi^2 / (2 sigma^2))`` with xi the translation along
    the gripper's axes, or fixed ones, and the rotation vector in the gripper's frame. Use `shaped` and
    `extend`.
    """

    def __init__(
        self,
        widths: Floats,
        axes: Floats | None,
        succeeded: Cells | None,
        failed: Cells | None,
        counts: tuple[int, int],
    ) -> None:
        alike = IsotropicKernel(
            float(np.prod(widths[:3]) ** (1.0 / 3.0)), float(np.prod(widths[3:]) ** (1.0 / 3.0))
        )
        super().__init__(alike, succeeded, failed, counts)
        self._widths = widths
        self._axes = axes

    @classmethod
    def shaped(
        cls,
        positions: ArrayLike,
        quaternions_xyzw: ArrayLike,
        success: ArrayLike,
        *,
        widths: ArrayLike,
        axes: ArrayLike | None = None,
        symmetric: ArrayLike | bool = True,
    ) -> ShapedSuccessModel:
        """Sort attempts; ``widths`` (6,) are standard deviations along (metres) and about (radians) x, y, z.

        The columns of ``axes`` (3, 3), object frame, are those of translations; None: each gripper's.

        Raises
        ------
        ValueError
            As `SuccessModel.build`, and for widths that are not positive and finite, or axes that are none.
        """
        w = np.array(widths, dtype=np.float64)
        if w.shape != (6,) or not np.isfinite(w).all() or (w <= 0.0).any():
            raise ValueError("widths have shape (6,), are positive and finite")
        empty = cls(w, _axes(axes), None, None, (0, 0))
        return empty.extend(positions, quaternions_xyzw, success, symmetric)

    @classmethod
    def under(
        cls,
        widths: Widths,
        positions: ArrayLike,
        quaternions_xyzw: ArrayLike,
        success: ArrayLike,
        *,
        symmetric: ArrayLike | bool = True,
    ) -> ShapedSuccessModel:
        """As `shaped`, with widths and axes as one."""
        axes = None if widths.axes is None else np.reshape(widths.axes, (3, 3))
        return cls.shaped(
            positions, quaternions_xyzw, success, widths=widths.sigmas, axes=axes, symmetric=symmetric
        )

    def extend(
        self,
        positions: ArrayLike,
        quaternions_xyzw: ArrayLike,
        success: ArrayLike,
        symmetric: ArrayLike | bool = True,
    ) -> ShapedSuccessModel:
        """A model with further attempts; what is present is not sorted again."""
        p, q, won, flags = _attempts(positions, quaternions_xyzw, success, symmetric)
        p = self._along(p)
        parts: list[Cells | None] = []
        for present, chosen in ((self._succeeded, won), (self._failed, ~won)):
            columns = p[chosen], q[chosen], np.ones(int(chosen.sum())), flags[chosen]
            if not len(columns[0]):
                parts.append(present)
            elif present is None:
                parts.append(Cells.build(*columns, float(self._widths[:3].max())))
            else:
                parts.append(present.extend(*columns))
        counts = (self._counts[0] + int(won.sum()), self._counts[1] + int((~won).sum()))
        return ShapedSuccessModel(self._widths, self._axes, parts[0], parts[1], counts)

    @property
    def widths(self) -> Floats:
        """Standard deviations (6,), metres and radians."""
        return self._widths.copy()

    def smoothing_bias(
        self, positions: ArrayLike, quaternions_xyzw: ArrayLike, *, threads: int = 1
    ) -> Floats:
        """Probability here less that under widths half as large, (M,)."""
        narrow = ShapedSuccessModel(
            0.5 * self._widths, self._axes, self._succeeded, self._failed, self._counts
        )
        own = self.evaluate(positions, quaternions_xyzw, threads=threads).probability
        return np.asarray(
            own - narrow.evaluate(positions, quaternions_xyzw, threads=threads).probability, dtype=np.float64
        )

    def _along(self, p: Floats) -> Floats:
        """Positions along the fixed axes, where there are such: rows are sorted, and compared, in these."""
        return p if self._axes is None else np.ascontiguousarray(p @ self._axes)

    def _sums(self, cells: Cells | None, p: Floats, q: Floats, cutoff: float, threads: int) -> Floats:
        """Sums of k and k^2 (M, 2)."""
        out = np.zeros((len(p), 2))
        radius = scaled_radius(cutoff)
        if cells is None or not len(p):
            return out
        p = self._along(p)
        half = 0.5 / self._widths**2
        half[:3] /= cells.scale**2
        # No width is larger than the one the cells were made for, so their runs reach far enough.
        order = cells.visiting_order(p) if len(p) >= _SORTED_FROM else np.arange(len(p))
        p, q = p[order], q[order]

        def work(begin: int, end: int) -> None:
            diagonal.shaped_sums(
                cells.data, cells.start, cells.table, cells.centre, cells.scale,
                p[begin:end], q[begin:end], half, self._axes is None, radius, out[begin:end],
            )  # fmt: skip

        for_blocks(work, len(p), block=_QUERY_BLOCK, threads=threads)
        result = np.empty_like(out)
        result[order] = out
        return result


def _axes(axes: ArrayLike | None) -> Floats | None:
    if axes is None:
        return None
    f = np.array(axes, dtype=np.float64)
    if f.shape != (3, 3) or not np.all(np.abs(f.T @ f - np.eye(3)) < UNIT_TOLERANCE):
        raise ValueError("the columns of axes (3, 3) must be orthonormal")
    return f


@dataclass(frozen=True, eq=False, slots=True)
class FittedWidths:
    """Widths that predict success, and how well, on held-out attempts that did not choose them.

    Attributes
    ----------
    widths : (6,) metres, radians
    isotropic : IsotropicKernel
        The best isotropic kernel, chosen the same way.
    log_loss, isotropic_log_loss : float
        Nats an attempt.
    skill, isotropic_skill : float
        Brier's: 1 perfect, 0 no better than the share of successes; nan where all fared alike.
    attempts, judged : int
        What they were chosen from, and judged on.
    """

    widths: Floats
    isotropic: IsotropicKernel
    log_loss: float
    isotropic_log_loss: float
    skill: float
    isotropic_skill: float
    attempts: int
    judged: int


def fit_widths(
    positions: ArrayLike,
    quaternions_xyzw: ArrayLike,
    success: ArrayLike,
    *,
    axes: ArrayLike | None = None,
    symmetric: ArrayLike | bool = True,
    seed: int = 0,
) -> FittedWidths:
    """Widths for `ShapedSuccessModel`, by the log loss of attempts in blocks of space left out.

    Parameters
    ----------
    positions, quaternions_xyzw : (N, 3) metres, (N, 4)
        Attempts; where collisions are tested, those that did not collide.
    success : (N,) bool
    axes : (3, 3) or None
        Columns are the axes of translations, object frame; None: each gripper's.

    Raises
    ------
    ValueError
        For fewer than `LEAST_OF_EACH` successes or failures, or attempts all in one place.
    """
    p, q, won, flags = _attempts(positions, quaternions_xyzw, success, symmetric)
    wins, losses = int(won.sum()), int((~won).sum())
    if min(wins, losses) < LEAST_OF_EACH:
        raise ValueError(
            f"widths that predict success are chosen from at least {LEAST_OF_EACH} successes and"
            f" {LEAST_OF_EACH} failures; there are {wins} and {losses}"
        )
    rng = np.random.default_rng(seed)
    kept = np.sort(rng.permutation(len(p))[:_TRAINED_MOST])
    p, q, won, flags = p[kept], q[kept], won[kept], np.ascontiguousarray(flags[kept])
    blocks = assign_blocks(p, edge_m=_BLOCK_M)
    fixed = _axes(axes)
    along = p if fixed is None else np.ascontiguousarray(p @ fixed)
    held = _HeldOut(along, q, won, flags, blocks.fold, blocks.block, fixed is None, rng)
    alike = _searched(held, np.array([0.015] * 3 + [math.radians(15.0)] * 3), ((0, 1, 2), (3, 4, 5)))
    widths = _searched(held, alike, tuple((axis,) for axis in range(6)))
    (loss, skill), (alike_loss, alike_skill) = held.judged(widths), held.judged(alike)
    return FittedWidths(
        widths=widths,
        isotropic=IsotropicKernel(float(alike[0]), float(alike[3])),
        log_loss=loss,
        isotropic_log_loss=alike_loss,
        skill=skill,
        isotropic_skill=alike_skill,
        attempts=len(p),
        judged=int((~held.choosing).sum()),
    )


class _HeldOut:
    """Attempts with what is near them in other folds; blocks of space choose or judge, never both."""

    def __init__(
        self,
        p: Floats,
        q: Floats,
        won: NDArray[np.bool_],
        symmetric: NDArray[np.bool_],
        fold: NDArray[np.int64],
        block: NDArray[np.int64],
        turning: bool,
        rng: np.random.Generator,
    ) -> None:
        # Successes are few: half of what is judged, each class weighted by what it stands for.
        classes = [rng.permutation(np.flatnonzero(won == y))[: _JUDGED_MOST // 2] for y in (True, False)]
        judged = rng.permutation(np.concatenate(classes))
        widest = _REACH
        # Counted on a few first, so that what is kept fits.
        few = judged[: max(1, len(judged) // 20)]
        nothing = np.empty(0, dtype=np.int32), np.empty((0, 6), dtype=np.float32)
        first = np.empty(len(few) + 1, dtype=np.int64)
        every = p, q, symmetric, fold
        each = diagonal.near_pairs(*every, few, turning, widest, _CUT, first, *nothing) / len(few)
        judged = judged[: max(50, int(_PAIRS_MOST / max(1.2 * each, 1.0)))]
        room = min(_PAIRS_MOST, int(1.5 * each * len(judged)) + 10_000)
        self.first = np.empty(len(judged) + 1, dtype=np.int64)
        row, squared = np.empty(room, dtype=np.int32), np.empty((room, 6), dtype=np.float32)
        count = diagonal.near_pairs(*every, judged, turning, widest, _CUT, self.first, row, squared)
        count = min(int(count), room)
        self.squared, self.won = squared[:count], won[row[:count]]
        self.outcome = won[judged]
        self.share = float(won.mean())
        shares = {y: np.mean(won == y) / max(np.mean(self.outcome == y), 1e-9) for y in (True, False)}
        self.weight = np.where(self.outcome, shares[True], shares[False])
        names = np.unique(block)
        first_half = rng.permutation(names)[: (len(names) + 1) // 2]
        self.choosing = np.isin(block[judged], first_half)
        if self.choosing.all() or not self.choosing.any():
            self.choosing = np.arange(len(judged)) % 2 == 0

    def predicted(self, widths: Floats) -> Floats:
        """Success probability of the judged attempts under widths (6,)."""
        out = np.empty((len(self.outcome), 3))
        diagonal.held_out_sums(self.first, self.won, self.squared, 0.5 / widths**2, _CUT, out)
        won, total, squares = out.T
        reached = total > 0.0
        safe = np.where(reached, total, 1.0)
        trials = np.where(reached, safe * safe / np.where(reached, squares, 1.0), 0.0)
        share = np.where(reached, won / safe, 0.0)
        return np.asarray((PRIOR_TRIALS * self.share + trials * share) / (PRIOR_TRIALS + trials))

    def loss(self, widths: Floats) -> float:
        """Log loss of the attempts that choose."""
        chosen = self.choosing
        return _log_loss(self.predicted(widths)[chosen], self.outcome[chosen], self.weight[chosen])

    def judged(self, widths: Floats) -> tuple[float, float]:
        """Log loss and Brier skill of the attempts that judge."""
        p, y, w = (
            self.predicted(widths)[~self.choosing],
            self.outcome[~self.choosing],
            self.weight[~self.choosing],
        )
        mean = float(np.average(y, weights=w))
        spread = mean * (1.0 - mean)
        skill = 1.0 - float(np.average((p - y) ** 2, weights=w)) / spread if spread > 0.0 else math.nan
        return _log_loss(p, y, w), skill


def _log_loss(p: Floats, y: NDArray[np.bool_], w: Floats) -> float:
    clipped = np.clip(p, _CLIP, 1.0 - _CLIP)
    return float(-np.average(np.where(y, np.log(clipped), np.log1p(-clipped)), weights=w))


def _searched(held: _HeldOut, start: Floats, groups: tuple[tuple[int, ...], ...]) -> Floats:
    """Widths of least loss: groups of axes in turn, larger and smaller by shrinking factors."""
    low = np.array([_POSITION_M[0]] * 3 + [_ROTATION[0]] * 3)
    high = np.array([_POSITION_M[1]] * 3 + [_ROTATION[1]] * 3)
    best, loss = start, held.loss(start)
    for step in _STEPS:
        improved = True
        while improved:
            improved = False
            for group in groups:
                for factor in (step, 1.0 / step):
                    tried = best.copy()
                    tried[list(group)] *= factor
                    tried = np.clip(tried, low, high)
                    value = held.loss(tried)
                    if value < loss - _ENOUGH:
                        best, loss, improved = tried, value, True
    return best
