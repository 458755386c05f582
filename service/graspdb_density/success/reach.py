"""How far from what was tried a success probability can be believed.

A kernel regression answers everywhere, and its effective trials do not tell how far they lie: one attempt
five widths away counts as one trial. So attempts are predicted again with everything near them left out: what
was tried no farther away than some distance, and of the rest what lies to one side, as if the attempt stood
at the edge of what was tried. Predictions reach as far as that distance may grow while they are still better,
by Brier's score, than the share of successes alone. Distances of position and of rotation are judged apart,
for an object may forgive one and not the other, in standard deviations of the kernel.

Neither distance is asked in one direction alone, and attempts may lie along a line of directions: a tool
that only ever turned about one axis tells nothing of the others. So no component of a displacement, along or
about an axis of the gripper, reaches farther than those between attempts near one another.

Attempts of one block of space fare alike: means over attempts are compared by how they differ between blocks.

Where too few attempts tell, or predictions beat nothing, no distance is validated. What lies as near to an
attempt as nearly all attempts lie to another one was tried itself, as far as the attempts can tell: it is
within reach for that reason alone, if it is no farther than one width.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from .._compiled import diagonal, isotropic
from .._compiled.threads import for_blocks
from ..kde.isotropic import scaled_radius
from ..se3 import Floats, Poses
from .calibration import assign_blocks
from .kernel_regression import SUCCESS_CUTOFF, NearestAttempts, SuccessModel, shrunk_share

__all__ = ["Reach", "least_mean", "validate_reach"]

Bools = NDArray[np.bool_]

#: Distances tried are multiples of this many widths, up to the kernels' cut-off.
_STEP = 0.25
_SHELLS = round(SUCCESS_CUTOFF / _STEP)
#: Attempts judged at most, half of them successes, and pairs looked at: of more, every so many'th.
_JUDGED, _PAIRS = 800, 1_000_000
#: Fewer judged attempts, or blocks of space that hold them, tell nothing. Blocks are this many widths long.
_LEAST_JUDGED, _LEAST_BLOCKS, _BLOCK_WIDTHS = 20, 5, 3.0
#: Chance that a distance is validated at which predictions are no better than the share.
_CHANCE = 0.05
#: Pairs whose displacements are looked at, and the fewest within the cut-off that tell of an axis.
_DISPLACED, _LEAST_PAIRS = 100_000, 20
#: Within the distance that this share of attempts keep from the nearest other one a pose counts as tried
#: itself; the distance is bounded, in widths.
_NEARLY_ALL, _NEAREST, _FARTHEST = 0.95, 0.2, 1.0
_BLOCK = 16


@dataclass(frozen=True, slots=True)
class Reach:
    """Up to which distance from an attempt success probabilities are told, in widths of the kernel.

    Attributes
    ----------
    position, rotation
        Both must hold of the nearest attempt.
    validated_position, validated_rotation
        Up to where left-out attempts are predicted better than by the share of successes; None where too few
        tell, 0 where they are predicted no better.
    attempts
        How many there were when it was validated.
    along : (6,)
        Up to where a displacement from the nearest attempt is told along each axis, metres, and about it,
        radians; axes as in `NearestAttempts.displacement`.
    """

    position: float
    rotation: float
    validated_position: float | None
    validated_rotation: float | None
    attempts: int
    along: tuple[float, ...] = (math.inf,) * 6

    def covers(self, nearest: NearestAttempts) -> Bools:
        """Whether poses (M,) are within reach of the attempt nearest to each."""
        near = (nearest.position_widths <= self.position) & (nearest.rotation_widths <= self.rotation)
        if nearest.displacement is not None:
            near &= (np.abs(nearest.displacement) <= np.array(self.along)).all(axis=1)
        return np.asarray(near)


def validate_reach(model: SuccessModel, *, threads: int = 1) -> Reach:
    """How far the predictions of a model reach; the same for the same attempts in the same order.

    ValueError without any attempt.
    """
    if not model.size:
        raise ValueError("a reach needs at least one attempt")
    judged = _Judged.of(model, np.random.default_rng(0))
    sums, nearest = judged.left_out(threads)
    known = np.isfinite(nearest[:, 0])
    spacing = np.full(2, _NEAREST)
    if known.any():
        spacing = np.quantile(nearest[known, 1:], _NEARLY_ALL, axis=0)
    tried = np.clip(spacing, _NEAREST, _FARTHEST)
    sigmas = np.array(model.sigmas)
    along = np.maximum(judged.ranges(), sigmas * np.repeat(tried, 3))
    position, rotation = (_validated(judged, sums[:, kind]) for kind in range(2))
    return Reach(
        position=max(float(tried[0]), position or 0.0),
        rotation=max(float(tried[1]), rotation or 0.0),
        validated_position=position,
        validated_rotation=rotation,
        attempts=model.size,
        along=tuple(along.tolist()),
    )


@dataclass(frozen=True, eq=False)
class _Judged:
    """Attempts (J) that are predicted again, their positions along the kernel's axes.

    ``own`` (P, J) is each one's place in its part of the model, -1 in the others; ``share`` (J,) by how much
    each succeeded, ``weight`` (J,) what each stands for, ``worth`` (J,) as how much of an attempt it counts;
    ``sides`` (J, 6) directions of translation and rotation; ``pairs`` (K, 2) of them, drawn at random.
    """

    model: SuccessModel
    poses: Poses
    own: NDArray[np.int64]
    share: Floats
    weight: Floats
    worth: Floats
    sides: Floats
    pairs: NDArray[np.int64]

    @classmethod
    def of(cls, model: SuccessModel, rng: np.random.Generator) -> _Judged:
        """Half of them successes, where there are as many: those are few among many failures."""
        poses, own, shares, stands_for, counts = [], [], [], [], []
        for number, part in enumerate(model.parts):
            size = part.size
            alike = sum(other.size for other in model.parts if (other.share >= 0.5) == (part.share >= 0.5))
            most = math.ceil(_JUDGED // 2 * size / alike)
            # By when they came, not by how they are sorted, which depends on how they were added.
            places = np.argsort(part.cells.rows)[rng.permutation(size)[:most]]
            poses.append(part.cells.poses(places))
            every = np.full((len(model.parts), len(places)), -1, dtype=np.int64)
            every[number] = places
            own.append(every)
            shares.append(np.full(len(places), part.share))
            stands_for.append(np.full(len(places), part.weight * size / len(places)))
            counts.append(np.full(len(places), part.weight))
        rows = np.concatenate(own, axis=1)
        sides = rng.standard_normal((rows.shape[1], 6))
        pairs = rng.integers(0, rows.shape[1], (_DISPLACED, 2))
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        share, weights, worth = (np.concatenate(column) for column in (shares, stands_for, counts))
        return cls(model, Poses.concatenate(poses), rows, share, weights, worth, sides, pairs)

    def ranges(self) -> Floats:
        """How far apart attempts near one another lie along and about each axis, metres and radians, (6,)."""
        found = []
        for number, part in enumerate(self.model.parts):
            pairs = self.pairs[self.own[number, self.pairs[:, 0]] >= 0]
            places = self.own[number, pairs[:, 0]].astype(np.float64)
            found.append(self.model.displacements(part.cells, places, self.poses[pairs[:, 1]]))
        apart = np.concatenate(found)
        near = apart[np.hypot(apart[:, 2], apart[:, 3]) <= SUCCESS_CUTOFF, 4:]
        if len(near) < _LEAST_PAIRS:
            return np.zeros(6)
        return np.asarray(np.quantile(np.abs(near), _NEARLY_ALL, axis=0))

    def left_out(self, threads: int) -> tuple[Floats, Floats]:
        """Kernel sums (J, 2, K, 3) by the shells of `diagonal.left_out_sums`, and nearest attempts (J, 3)."""
        model, count = self.model, len(self.poses)
        sums, nearest = np.zeros((count, 2, _SHELLS, 3)), np.full((count, 3), np.inf)
        radius = scaled_radius(SUCCESS_CUTOFF)
        step = max(1, math.ceil(self._visited(radius) / _PAIRS))
        for number in range(len(model.parts)):
            work = partial(self._add, number, step, radius, sums, nearest)
            for_blocks(work, count, block=_BLOCK, threads=threads)
        return sums, nearest

    def _visited(self, radius: float) -> int:
        """Pairs of a judged attempt and one within the radius."""
        visited, count = 0, np.empty(len(self.poses), dtype=np.int64)
        for part in self.model.parts:
            isotropic.reached(part.cells.arrays, *self.poses, radius, count)
            visited += int(count.sum())
        return visited

    def _add(
        self,
        number: int,
        step: int,
        radius: float,
        sums: Floats,
        nearest: Floats,
        begin: int,
        end: int,
    ) -> None:
        """The sums of some judged attempts over a part of the model."""
        rows = slice(begin, end)
        (cells, share, weight, _), (p, q) = self.model.parts[number], self.poses[rows]
        added = np.zeros_like(sums[rows])
        diagonal.left_out_sums(
            cells.arrays, share, p, q, self.own[number, rows], self.sides[rows],
            self.model.half(cells), self.model.turning, radius, step, _STEP, added, nearest[rows],
        )  # fmt: skip
        sums[rows] += weight * added


def _validated(judged: _Judged, sums: Floats) -> float | None:
    """The largest distance in widths up to which left-out attempts are predicted better than by the share.

    Parameters
    ----------
    sums : (J, K, 3)
        By the distance of what was tried, in steps.
    """
    model, won = judged.model, judged.share
    if model.size < _LEAST_JUDGED:
        return None
    try:
        block = assign_blocks(judged.poses.positions, edge_m=_BLOCK_WIDTHS * model.widest_m).block
    except ValueError:
        # All in one place.
        return None
    # Without the attempt itself: its own outcome must not be in the share that it is compared with.
    successful, total_worth = model.worth
    share = (successful - judged.worth * won) / (total_worth - judged.worth)
    beyond = np.cumsum(sums[:, ::-1], axis=1)[:, ::-1]
    reached: float | None = None
    for number in range(_SHELLS):
        successes, total, squares = beyond[:, number].T
        probability, _, _ = shrunk_share(successes, total, squares, share)
        gain = (share - won) ** 2 - (probability - won) ** 2
        known = total > 0.0
        better = least_mean(gain[known], judged.weight[known], block[known])
        if better is None or better <= 0.0:
            # Nothing tells: that is no verdict where even the nearest are too few.
            return 0.0 if reached is None and better is not None else reached
        reached = number * _STEP
    return reached


def least_mean(values: Floats, weights: Floats, block: NDArray[np.int64]) -> float | None:
    """The lower end of the interval of a weighted mean whose values are alike within blocks; None for few.

    Student's t of as many degrees of freedom as there are blocks but one, by the blocks' summed deviations.
    """
    names, group = np.unique(block, return_inverse=True)
    if len(values) < _LEAST_JUDGED or len(names) < _LEAST_BLOCKS:
        return None
    total = float(weights.sum())
    mean = float(np.dot(weights, values)) / total
    deviations = np.bincount(group.reshape(-1), weights=weights * (values - mean))
    freedom = len(names) - 1
    error = math.sqrt(len(names) / freedom * float(np.dot(deviations, deviations))) / total
    return mean + float(stdtrit(freedom, _CHANCE)) * error
