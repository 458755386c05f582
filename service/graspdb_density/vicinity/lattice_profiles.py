"""P(success) along and about one axis, from trials on a grid.

At one rotation of a grid pairs of trials exist at the lattice's displacements only. Turned into a grasp's
axes they fall irregularly along each, and seldom on it: neighbouring bins hold pairs of different grasps, and
pairs off the axis by up to half a step fare worse than those on it. Counted bin by bin, the share zigzags and
half widths come out up to 40 % too small. So

- a bin weighs pairs by how near they are, falling to nothing at one step of the grid. At a rotation whose
  axes are the lattice's these weights sum to the same everywhere, at any other nearly, so every bin is of the
  same grasps. A itself, which succeeded, stands where no pair can be, at no displacement;
- what being off the axis costs is taken off: slopes of success by both offsets, in proportion to the share
  there is, from pairs of one grasp compared with each other. Compared from grasp to grasp they would mislead:
  rotations along the lattice have no offsets, and may forgive more or less than others.

On grids of 10 mm and 15 degrees whose answer is known (boxes, ellipsoids and cones) half widths are within
2.5 mm, 4 degrees for rotations, down to half widths of half a step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .._compiled.options import exact
from ..se3 import Floats

__all__ = ["LatticeProfiles"]

#: Bins beyond a profile's reach whose pairs its outermost bins still weigh.
_MARGIN = 2
#: A grid's step, of the largest offset: pairs are off the axis by half a step at most.
_STEP = 2.0
#: How far around a bin pairs tell slopes, in steps: fewer make those noisy, more make them another place's.
_AROUND = 2.5
#: Sums of a bin: weight, successes, both offsets, A's own weight.
_SUMS = 5
#: Sums of a distance: the upper half of the slopes' equations, their right side.
_EQUATIONS = 9
#: Rounds in which slopes and shares, which depend on each other, settle.
_ROUNDS = 3
#: The least share that slopes are in proportion to.
_LEAST_SHARE = 0.02
#: Of the trace, added to the equations' diagonal, so that they have a solution where no pair is off the axis.
_RIDGE = 1e-3
#: Grasps whose sums are held at once.
_BLOCK = 256


class LatticeProfiles:
    """Pairs near three axes by grasp, in bins of displacement of ``step``, the middle one about 0.

    Parameters
    ----------
    grasps : int
        Successes A; 0 where trials are on no grid.
    bins : int
        Of each profile, odd.
    step, off_axis : float
        Width of a bin, and how far pairs may be off an axis: metres or radians.

    Attributes
    ----------
    pair_sums : (grasps, 3, bins and margins, 5)
        Where the loops over pairs note number, successes, and sums of displacements and of both offsets.
    """

    def __init__(self, grasps: int, bins: int, step: float, off_axis: float) -> None:
        self.bins, self.step, self.off_axis = bins, step, off_axis
        self.pair_sums: Floats = np.zeros((grasps, 3, bins + 2 * _MARGIN, 5))

    def shares(self, weights: NDArray[np.float32], *, mirrored: bool) -> tuple[Floats, Floats]:
        """Share that succeeds at each bin's middle, and its weight; nan without pairs.

        Parameters
        ----------
        weights : (grasps, columns)
        mirrored : bool
            Count what the grasps' twins saw too, who look the other way along the first two axes.

        Returns
        -------
        share, weight : (3 bins, columns)
        """
        columns, middle = weights.shape[1], self.bins // 2
        sums = self._summed(weights, _SUMS)
        if mirrored:
            sums[:, :2] += sums[:, :2, ::-1].copy()
        away = np.abs(np.arange(self.bins) - middle)
        own = np.clip(1.0 - away * self.step / (_STEP * self.off_axis), 0.0, None) * sums[..., 4]
        weight = sums[..., 0] + own
        with np.errstate(divide="ignore", invalid="ignore"):
            plain = (sums[..., 1] + own) / weight
            off = np.nan_to_num(sums[..., 2:4] / weight[..., None])
        share = plain
        for turn in range(_ROUNDS):
            # Offsets cost in proportion to what there is to lose, which hardly changes with distance.
            fall = _folded(share[0])
            part = slice(0, columns if turn == _ROUNDS - 1 else 1)
            slopes = self._slopes(fall, weights[:, part])[:, :, away] * fall[:, away, None]
            share = np.clip(plain[part] - np.einsum("...i,...i->...", slopes, off[part]), 0.0, 1.0)
        return np.asarray(share.reshape(columns, -1).T), np.asarray(weight.reshape(columns, -1).T)

    def _slopes(self, fall: Floats, weights: NDArray[np.float32]) -> Floats:
        """Share lost by offset, of what there is, (columns, 3, bins // 2 + 1, 2)."""
        sums = self._summed(weights, _EQUATIONS, fall)
        # Offsets of the largest, so that the numbers are alike.
        scale = np.array([1.0, self.off_axis, self.off_axis])
        matrix = sums[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*sums.shape[:-1], 3, 3)
        matrix = matrix / (scale[:, None] * scale)
        trace = np.trace(matrix, axis1=-2, axis2=-1)
        matrix += (_RIDGE * np.where(trace > 0.0, trace, 1.0))[..., None, None] * np.eye(3)
        right = sums[..., 6:] / scale
        # With both offsets, with either alone, with none: the best where being off the axis gains nothing,
        # which is all that few rotations, whose displacements and offsets go together, can tell.
        best, slopes = np.zeros(right.shape[:-1]), np.zeros((*right.shape[:-1], 2))
        for used in ((0, 1, 2), (0, 1), (0, 2)):
            part = matrix[..., used, :][..., used]
            solved = np.linalg.solve(part, right[..., used, None])[..., 0]
            base = right[..., 0] ** 2 / matrix[..., 0, 0]
            gain = np.einsum("...i,...i->...", solved, right[..., used]) - base
            better = (solved[..., 1:] <= 0.0).all(axis=-1) & (gain > best)
            best = np.where(better, gain, best)
            found = np.zeros_like(slopes)
            found[..., [i - 1 for i in used[1:]]] = solved[..., 1:]
            slopes = np.where(better[..., None], found, slopes)
        return np.asarray(slopes / self.off_axis, dtype=np.float64)

    def _summed(self, weights: NDArray[np.float32], number: int, fall: Floats | None = None) -> Floats:
        """Sums over the grasps of what the compiled loops tell of each, (columns, 3, bins, number)."""
        rows = self.bins if fall is None else self.bins // 2 + 1
        total = np.zeros((weights.shape[1], 3 * rows * number))
        for begin in range(0, len(self.pair_sums), _BLOCK):
            found = self.pair_sums[begin : begin + _BLOCK]
            each = np.zeros((len(found), 3, rows, number))
            if fall is None:
                _sum_shares(found, self.step, _STEP * self.off_axis, each)
            else:
                _sum_equations(found, fall, self.step, _AROUND * _STEP * self.off_axis, each)
            part = each.reshape(len(found), total.shape[1]).astype(np.float32)
            total += weights[begin : begin + _BLOCK].T @ part
        return total.reshape(-1, 3, rows, number)


def _folded(share: Floats) -> Floats:
    """Mean share of both sides by distance, (3, bins // 2 + 1); unknown ones as the nearest known."""
    middle = share.shape[1] // 2
    both = np.stack([share[:, middle:], share[:, middle::-1]])
    known = np.isfinite(both)
    count = known.sum(axis=0)
    mean = np.where(known, both, 0.0).sum(axis=0) / np.maximum(count, 1)
    at = np.arange(mean.shape[1])
    for axis in range(3):
        have = count[axis] > 0
        mean[axis] = np.interp(at, at[have], mean[axis, have]) if have.any() else 1.0
    return np.asarray(np.maximum(mean, _LEAST_SHARE))


@exact
def _sum_shares(nearby, step, near, sums):  # type: ignore[no-untyped-def]
    """Weight, successes and offsets of each grasp's pairs about every bin, by weights that fall linearly to 0
    at ``near``; A's own weight (A, 3, bins, 5).

    That one is 1 where all of the grid around A was tried, and less where less was.
    """
    bins = sums.shape[2]
    margin = (nearby.shape[2] - bins) // 2
    reach = int(near / step)
    for a in range(sums.shape[0]):
        for axis in range(3):
            found = nearby[a, axis]
            own = 0.0
            for k in range(found.shape[0]):
                n = found[k, 0]
                if n <= 0.0:
                    continue
                at = found[k, 2] / n
                own += n * max(0.0, 1.0 - 0.5 * abs(at) / near)
                for b in range(max(0, k - margin - reach), min(bins, k - margin + reach + 1)):
                    weight = 1.0 - abs(at - (b - bins // 2) * step) / near
                    if weight > 0.0:
                        sums[a, axis, b, 0] += weight * n
                        sums[a, axis, b, 1] += weight * found[k, 1]
                        sums[a, axis, b, 2] += weight * found[k, 3]
                        sums[a, axis, b, 3] += weight * found[k, 4]
            for b in range(bins):
                sums[a, axis, b, 4] = min(own, 1.0)


@exact
def _sum_equations(nearby, fall, step, around, sums):  # type: ignore[no-untyped-def]
    """Least squares of each grasp's pairs within ``around`` of every distance, from its own means: success by
    ``fall`` (3, distances), the share of all grasps at that distance, and by that times both offsets.
    """
    bins = sums.shape[2]
    mean = np.empty(4)
    x = np.empty(4)
    for a in range(sums.shape[0]):
        for axis in range(3):
            found = nearby[a, axis]
            for b in range(bins):
                out = sums[a, axis, b]
                for second in range(2):
                    total = 0.0
                    if not second:
                        mean[:] = 0.0
                    for k in range(found.shape[0]):
                        n = found[k, 0]
                        if n <= 0.0:
                            continue
                        at = abs(found[k, 2] / n) / step
                        if abs(at - b) * step > around:
                            continue
                        low = min(int(at), bins - 1)
                        high = min(low + 1, bins - 1)
                        f = fall[axis, low] + min(at - low, 1.0) * (fall[axis, high] - fall[axis, low])
                        x[0], x[1] = found[k, 1] / n, f
                        x[2], x[3] = f * found[k, 3] / n, f * found[k, 4] / n
                        if not second:
                            total += n
                            for i in range(4):
                                mean[i] += n * x[i]
                            continue
                        for i in range(4):
                            x[i] -= mean[i]
                        out[0] += n * x[1] * x[1]
                        out[1] += n * x[1] * x[2]
                        out[2] += n * x[1] * x[3]
                        out[3] += n * x[2] * x[2]
                        out[4] += n * x[2] * x[3]
                        out[5] += n * x[3] * x[3]
                        for i in range(3):
                            out[6 + i] += n * x[0] * x[1 + i]
                    if not second:
                        if total <= 0.0:
                            break
                        for i in range(4):
                            mean[i] /= total
