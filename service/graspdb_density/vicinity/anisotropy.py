"""What a successful grasp tells about its vicinity: ``P(T(A) succeeds | A succeeds)`` by displacement T.

Translations ``x``, ``y``, ``z`` are along the axes of a frame given for each grasp (``alignment``): the
gripper's, the object's principal axes, those of the nearest edge, or of the pair of surfaces or edges it
closes on. Rotations ``rx``, ``ry``, ``rz`` are about the gripper's axes; in planes of two they are
compositions ``R_a(alpha) R_b(beta)`` (figure 8), of which ``R_x(180) R_y(180)`` is the jaw's mirror, not
components of a rotation vector.

`empirical_anisotropy` counts pairs of trials: translations between trials at the same rotation, rotations
between trials at the same position. A displacement that leads to a pose nobody tried is unknown, not a
failure. Profiles along one axis of trials on a grid, whose pairs lie at a lattice's places, are told as
`LatticeProfiles` says. `density_anisotropy` is the paper's method: the density of successes in the place of
a trial. Intervals come from resampling the grasps A: each takes part in many pairs, which are not
independent.

Reference: Bodenhagen, Detry, Piater and Krueger, sections II-A and III-A, figures 8 to 12.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._compiled.pairs import (
    Displaced,
    RotationBins,
    Tally,
    TranslationBins,
    Trials,
    rotation_pairs,
    translation_pairs,
)
from ..kde.weighted_sums import Progress
from ..se3 import Floats, Poses
from . import pair_candidates
from .displacement_bins import (
    LEAST_SUCCESSES,
    Alignment,
    Anisotropy,
    Bins,
    Frames,
    aligned_axes,
    bootstrap_weights,
    check_enough,
    summary,
)
from .lattice_profiles import LatticeProfiles

__all__ = ["empirical_anisotropy"]

#: Grasps in a step of the compiled loops, between calls of ``progress``.
_STEP = 64
_LAYOUT = Bins()
#: How far the coordinates that a histogram or profile does not show may be off: half the usual steps of a
#: grid.
_OFF_AXIS_M, _OFF_AXIS = 0.005, math.radians(7.5)
_TRANSLATIONS = TranslationBins(
    _LAYOUT.extent_m, _LAYOUT.slices, _LAYOUT.slice_m, _LAYOUT.across,
    _LAYOUT.profile_m, _LAYOUT.line("position"), _OFF_AXIS_M,
)  # fmt: skip
_ROTATIONS = RotationBins(_LAYOUT.angles, _LAYOUT.profile, _LAYOUT.line("rotation"), _OFF_AXIS)


# long: the options of the report, explained one by one.
def empirical_anisotropy(
    poses: Poses,
    success: ArrayLike,
    *,
    rotation_keys: ArrayLike | None = None,
    position_keys: ArrayLike | None = None,
    alignment: Alignment = "gripper",
    frames: Frames | None = None,
    symmetric: bool = True,
    weights: ArrayLike | None = None,
    max_grasps: int = 2_000,
    max_candidates: int = 50_000_000,
    level: float = 0.9,
    seed: int = 0,
    progress: Progress | None = None,
) -> Anisotropy:
    """Count what became of trials displaced from successes.

    Parameters
    ----------
    poses : N
        Every trial that was simulated or tried, collisions and other failures included.
    success : (N,) bool
    rotation_keys, position_keys : (N,) int or None
        Equal for trials at the same rotation, or position, of a grid. None: trials pair whose rotations are
        within 7.5 degrees and whose positions are within 5 mm.
    alignment, frames
        ``gripper``: no frames. ``object``: (3, 3), columns are the principal axes. ``edge``: (N, 3, 3),
        columns tangent, normal x tangent, normal of the edge nearest to each trial, or a function that tells
        those of poses; ``surface-pair``: likewise, the pair's axes named as the gripper's that they are
        nearest to. Where not finite, the gripper's own axes.
    symmetric : bool
        Whether the jaw is: then a pair counts for the twins as well.
    weights : (N,) or None
        Importance of each success as an A (eq 1), where trials were not spread evenly.
    max_grasps, max_candidates : int
        Limits on the successes A, drawn at random, and on the pairs looked at.

    Raises
    ------
    ValueError
        For fewer than `LEAST_SUCCESSES` successes, no failure, no pair within reach, or wrong arguments.
    """
    won = np.asarray(success)
    if won.shape != (len(poses),) or (won.dtype != np.bool_ and not np.all((won == 0) | (won == 1))):
        raise ValueError(f"success has shape ({len(poses)},) and is true or false")
    won = won.astype(bool)
    check_enough(int(won.sum()))
    if won.all():
        raise ValueError("the empirical method needs failures; there are only successes")
    p, q = poses.positions, poses.quaternions_xyzw
    rng = np.random.default_rng(seed)
    grasps = rng.permutation(np.flatnonzero(won))[:max_grasps].astype(np.int64)
    shifted = (
        pair_candidates.near_rotations(q, grasps, _OFF_AXIS)
        if rotation_keys is None
        else pair_candidates.same_key(_keys(rotation_keys, len(p)), grasps)
    )
    turned = (
        pair_candidates.near_positions(p, grasps, _OFF_AXIS_M)
        if position_keys is None
        else pair_candidates.same_key(_keys(position_keys, len(p)), grasps)
    )
    # At least LEAST_SUCCESSES, then as many as the limit on work allows.
    work = np.cumsum(shifted.lengths() + turned.lengths())
    count = max(min(LEAST_SUCCESSES, len(grasps)), int(np.searchsorted(work, max_candidates, side="right")))
    grasps = grasps[:count]
    axes, aligned = aligned_axes(alignment, frames, poses, grasps)
    share = bootstrap_weights(weights, grasps, len(p), rng)
    near, near_grasps = _in_order(Trials(p, q, won, shifted.order), grasps)
    translations = _Pairs(
        translation_pairs,
        near,
        Displaced(near_grasps, axes, share, shifted.first, shifted.runs),
        _TRANSLATIONS,
        planes=_LAYOUT.slices * _LAYOUT.across**2,
        limit=math.cos(0.5 * _OFF_AXIS),
        symmetric=symmetric,
        on_grid=rotation_keys is not None,
    )
    rotations = _Pairs(
        rotation_pairs,
        Trials(p, q, won, turned.order),
        Displaced(grasps, axes, share, turned.first, turned.runs),
        _ROTATIONS,
        planes=3 * _LAYOUT.angles**2,
        limit=_OFF_AXIS_M,
        symmetric=symmetric,
        on_grid=position_keys is not None,
    )
    for begin in range(0, len(grasps), _STEP):
        translations.count(begin)
        rotations.count(begin)
        if progress is not None:
            progress(min(1.0, (begin + _STEP) / len(grasps)))
    if not translations.used and not rotations.used:
        raise ValueError(
            "no trial lies within reach of a success at the same rotation or the same position: trials on a "
            "grid, or many more, are needed"
        )
    # The twin of A sees every translation mirrored; an edge's tangent has no sign either.
    mirrored = (symmetric and alignment in ("gripper", "surface-pair")) or alignment == "edge"
    along = translations.tallies(mirrored=mirrored)
    return Anisotropy(
        "empirical",
        alignment,
        *summary(_LAYOUT, along, rotations.tallies(mirrored=symmetric), level),
        grasps=len(grasps),
        translation_pairs=translations.used,
        rotation_pairs=rotations.used,
        level=level,
        aligned=aligned,
    )


class _Pairs:
    """Pairs of trials of one kind: histograms in planes of two displacements, and a profile an axis.

    ``limit`` is what a compiled loop takes for trials off the grid, ``planes`` the bins of the histograms.
    """

    def __init__(
        self,
        loop: Callable[..., int],
        trials: Trials,
        displaced: Displaced,
        bins: TranslationBins | RotationBins,
        *,
        planes: int,
        limit: float,
        symmetric: bool,
        on_grid: bool,
    ) -> None:
        self._loop, self._trials, self._displaced, self._bins = loop, trials, displaced, bins
        self._symmetric, self._limit = symmetric, -1.0 if on_grid else limit
        columns = displaced.weights.shape[1]
        self._planes, self._lines = _empty(planes, columns), _empty(3 * bins.profile_bins, columns)
        # Of trials on a grid profiles are told from each grasp's own pairs, which are at a lattice's places.
        grasps = len(displaced.rows) if on_grid else 0
        self._profiles = LatticeProfiles(grasps, bins.profile_bins, bins.profile, bins.off_axis)
        self.used = 0

    def count(self, begin: int) -> None:
        """The pairs of some grasps, from ``begin`` on."""
        self.used += self._loop(
            self._trials, _some(self._displaced, begin), self._bins, self._symmetric, self._limit,
            self._planes, self._lines, self._profiles.pair_sums[begin : begin + _STEP],
        )  # fmt: skip

    def tallies(self, *, mirrored: bool) -> tuple[Tally, Tally]:
        """In planes and on lines; what the grasps' twins saw is added where ``mirrored``."""
        planes, lines = self._planes, self._lines
        # Pairs of rotations stand for their twins already, but for the profiles of a lattice.
        if mirrored and isinstance(self._bins, TranslationBins):
            cells = np.arange(len(planes.pairs)).reshape(_LAYOUT.slices, _LAYOUT.across, _LAYOUT.across)
            planes = _mirrored(planes, cells[:, ::-1, ::-1].ravel(), np.ones(len(planes.pairs)))
            image = np.arange(len(lines.pairs)).reshape(3, -1)
            sign = np.ones(image.shape)
            image[:2], sign[:2] = image[:2, ::-1].copy(), -1.0
            lines = _mirrored(lines, image.ravel(), sign.ravel())
        return planes, _of_lattice(self._profiles, lines, self._displaced.weights, mirrored)


def _empty(bins: int, columns: int) -> Tally:
    counted = np.zeros((bins, columns), dtype=np.float32)
    return Tally(counted, counted.copy(), np.zeros(bins, dtype=np.int64), np.zeros(bins), np.zeros(bins))


def _some(displaced: Displaced, begin: int) -> Displaced:
    part = slice(begin, begin + _STEP)
    rows, frames, weights, first, runs = displaced
    return Displaced(rows[part], frames[part], weights[part], first[begin : begin + _STEP + 1], runs)


def _mirrored(tally: Tally, image: NDArray[np.int64], sign: Floats) -> Tally:
    """With what was counted in every bin's mirror image."""
    tried, won, pairs, moved, farthest = tally
    return Tally(
        tried + tried[image],
        won + won[image],
        pairs + pairs[image],
        moved + sign * moved[image],
        np.maximum(farthest, farthest[image]),
    )


def _in_order(trials: Trials, grasps: NDArray[np.int64]) -> tuple[Trials, NDArray[np.int64]]:
    """Trials copied into the order in which the loops visit them, which is worth it for long runs."""
    p, q, won, order = trials
    rows = np.arange(len(order))
    place = np.empty(len(order), dtype=np.int64)
    place[order] = rows
    return Trials(p[order], q[order], won[order], rows), place[grasps]


def _keys(keys: ArrayLike, count: int) -> NDArray[np.int64]:
    k = np.asarray(keys)
    if k.shape != (count,) or not np.issubdtype(k.dtype, np.integer):
        raise ValueError(f"keys are integers of shape ({count},)")
    return k.astype(np.int64)


def _of_lattice(
    profiles: LatticeProfiles, lines: Tally, weights: NDArray[np.float32], mirrored: bool
) -> Tally:
    """Profiles of a grid in the place of tallies bin by bin; those off the grid."""
    if not len(profiles.pair_sums):
        return lines
    share, weight = profiles.shares(weights, mirrored=mirrored)
    at: Floats = (np.arange(profiles.bins, dtype=np.float64) - profiles.bins // 2) * profiles.step
    return Tally(
        weight.astype(np.float32),
        (np.nan_to_num(share) * weight).astype(np.float32),
        lines.pairs,
        np.tile(at, 3) * lines.pairs,
        lines.farthest,
    )
