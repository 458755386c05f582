"""What a successful grasp tells about its vicinity: ``P(T(A) succeeds | A succeeds)`` by displacement T.

Translations ``x``, ``y``, ``z`` are along the axes of a frame given for each grasp (``alignment``): the
gripper's, the object's principal axes, those of the nearest edge, or of the pair of surfaces or edges it
closes on. Rotations ``rx``, ``ry``, ``rz`` are
about the gripper's axes; in planes of two they are compositions ``R_a(alpha) R_b(beta)`` (figure 8), of which
``R_x(180) R_y(180)`` is the jaw's mirror, not components of a rotation vector.

`empirical` counts pairs of trials: translations between trials at the same rotation, rotations between trials
at the same position. A displacement that leads to a pose nobody tried is unknown, not a failure. Profiles
along one axis of trials on a grid, whose pairs lie at a lattice's places, are told as `profiles` says.
`smoothed` is the paper's method: the density of successes in the place of a trial. Intervals come from
resampling the grasps A: each takes part in many pairs, which are not independent.

Reference: Bodenhagen, Detry, Piater and Krueger, sections II-A and III-A, figures 8 to 12.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from .._compiled import pairs as pairloops
from ..kde.weighted_sums import Progress
from ..se3 import Floats
from . import pair_candidates
from .displacement_bins import (
    LEAST_SUCCESSES,
    PLANES,
    Alignment,
    Anisotropy,
    Bins,
    Counts,
    Frames,
    Histogram,
    Tallies,
    aligned_axes,
    check_enough,
    report,
    resampling,
)
from .displacement_density import attempt_density, smoothed
from .half_width import Tolerance
from .lattice_profiles import Profiles

__all__ = [
    "LEAST_SUCCESSES",
    "PLANES",
    "Alignment",
    "Anisotropy",
    "Bins",
    "Frames",
    "Histogram",
    "Tolerance",
    "attempt_density",
    "empirical",
    "smoothed",
]

#: Grasps in a step of the compiled loops, between calls of ``progress``.
_STEP = 64


def empirical(
    positions: ArrayLike,
    quaternions_xyzw: ArrayLike,
    success: ArrayLike,
    *,
    rotation_keys: ArrayLike | None = None,
    position_keys: ArrayLike | None = None,
    alignment: Alignment = "gripper",
    frames: Frames | None = None,
    rotate_in_frame: bool = False,
    symmetric: bool = True,
    weights: ArrayLike | None = None,
    bins: Bins | None = None,
    tolerance_m: float = 0.005,
    tolerance: float = math.radians(7.5),
    max_grasps: int = 2_000,
    max_candidates: int = 50_000_000,
    level: float = 0.9,
    seed: int = 0,
    progress: Progress | None = None,
) -> Anisotropy:
    """Count what became of trials displaced from successes.

    Parameters
    ----------
    positions, quaternions_xyzw : (N, 3) metres, (N, 4)
        Every trial that was simulated or tried, collisions and other failures included.
    success : (N,) bool
    rotation_keys, position_keys : (N,) int or None
        Equal for trials at the same rotation, or position, of a grid. None: trials pair whose rotations are
        within ``tolerance`` and whose positions are within ``tolerance_m``.
    alignment, frames
        ``gripper``: no frames. ``object``: (3, 3), columns are the principal axes. ``edge``: (N, 3, 3),
        columns tangent, normal x tangent, normal of the edge nearest to each trial, or a function that tells
        those of poses; ``surface-pair``: likewise, the pair's axes named as the gripper's that they are
        nearest to. Where not finite, the gripper's own axes.
    rotate_in_frame : bool
        Rotate about the axes of the frame instead of the gripper's.
    symmetric : bool
        Whether the jaw is: then a pair counts for the twins as well.
    weights : (N,) or None
        Importance of each success as an A (eq 1), where trials were not spread evenly.
    tolerance_m, tolerance
        How far the coordinates that a histogram or profile does not show may be off, metres and radians. On a
        grid: half its steps.
    max_grasps, max_candidates : int
        Limits on the successes A, drawn at random, and on the pairs looked at.

    Raises
    ------
    ValueError
        For fewer than `LEAST_SUCCESSES` successes, no failure, no pair within reach, or wrong arguments.
    """
    p, q = se3.Poses.of(positions, quaternions_xyzw)
    won = np.asarray(success)
    if won.shape != (len(p),) or (won.dtype != np.bool_ and not np.all((won == 0) | (won == 1))):
        raise ValueError(f"success has shape ({len(p)},) and is true or false")
    won = won.astype(bool)
    check_enough(int(won.sum()))
    if won.all():
        raise ValueError("the empirical method needs failures; there are only successes")
    layout = bins or Bins()
    rng = np.random.default_rng(seed)
    grasps = rng.permutation(np.flatnonzero(won))[:max_grasps].astype(np.int64)
    shifted = (
        pair_candidates.near_rotations(q, grasps, tolerance)
        if rotation_keys is None
        else pair_candidates.same_key(_keys(rotation_keys, len(p)), grasps)
    )
    turned = (
        pair_candidates.near_positions(p, grasps, tolerance_m)
        if position_keys is None
        else pair_candidates.same_key(_keys(position_keys, len(p)), grasps)
    )
    # At least LEAST_SUCCESSES, then as many as the limit on work allows.
    work = np.cumsum(shifted.lengths() + turned.lengths())
    count = max(min(LEAST_SUCCESSES, len(grasps)), int(np.searchsorted(work, max_candidates, side="right")))
    grasps = grasps[:count]
    axes, aligned = aligned_axes(alignment, frames, p, q, grasps)
    share = resampling(weights, grasps, len(p), rng)
    columns = share.shape[1]
    along = Tallies(
        Counts.empty(layout.slices * layout.across**2, columns),
        Counts.empty(3 * layout.line("position"), columns),
    )
    about = Tallies(
        Counts.empty(3 * layout.angles**2, columns), Counts.empty(3 * layout.line("rotation"), columns)
    )
    quaternions = se3.from_matrix(axes) if rotate_in_frame else q[grasps]
    used = [0, 0]
    # Of trials on a grid profiles are told from each grasp's own pairs, which are at a lattice's places.
    along_lines = Profiles(
        0 if rotation_keys is None else len(grasps), layout.line("position"), layout.profile_m, tolerance_m
    )
    about_lines = Profiles(
        0 if position_keys is None else len(grasps), layout.line("rotation"), layout.profile, tolerance
    )
    near_p, near_q, near_won, near_order, near_grasps = _streamed(p, q, won, shifted.order, grasps)
    for begin in range(0, len(grasps), _STEP):
        part = slice(begin, begin + _STEP)
        used[0] += pairloops.translation_pairs(
            near_p, near_q, near_won, near_order, near_grasps[part], axes[part], share[part],
            shifted.first[begin : begin + _STEP + 1], shifted.runs, symmetric,
            math.cos(0.5 * tolerance) if rotation_keys is None else -1.0,
            layout.extent_m, layout.slices, layout.slice_m, layout.across, layout.profile_m,
            layout.line("position"), tolerance_m, along.planes.tried, along.planes.won, along.planes.pairs,
            along.lines.tried, along.lines.won, along.lines.pairs, along.lines.moved, along_lines.found[part],
        )  # fmt: skip
        used[1] += pairloops.rotation_pairs(
            p, q, won, turned.order, grasps[part], quaternions[part], share[part],
            turned.first[begin : begin + _STEP + 1], turned.runs, symmetric, rotate_in_frame,
            tolerance_m if position_keys is None else -1.0, layout.angles, layout.line("rotation"),
            layout.profile, tolerance, about.planes.tried, about.planes.won, about.planes.pairs,
            about.lines.tried, about.lines.won, about.lines.pairs, about.lines.moved, about_lines.found[part],
        )  # fmt: skip
        if progress is not None:
            progress(min(1.0, (begin + _STEP) / len(grasps)))
    if not any(used):
        raise ValueError(
            "no trial lies within reach of a success at the same rotation or the same position: trials on a "
            "grid, or many more, are needed"
        )
    # The twin of A sees every translation mirrored; an edge's tangent has no sign either.
    mirrored = (symmetric and alignment in ("gripper", "surface-pair")) or alignment == "edge"
    if mirrored:
        _mirror(along, layout)
    if rotation_keys is not None:
        _take(along_lines, along.lines, share, mirrored)
    if position_keys is not None:
        _take(about_lines, about.lines, share, symmetric and not rotate_in_frame)
    return report(
        "empirical", alignment, layout, along, about, len(grasps), (used[0], used[1]), level, aligned
    )


def _streamed(
    p: Floats, q: Floats, won: NDArray[np.bool_], order: NDArray[np.int64], grasps: NDArray[np.int64]
) -> tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Trials copied into the order in which the loops visit them, which is worth it for long runs."""
    rows = np.arange(len(order))
    place = np.empty(len(order), dtype=np.int64)
    place[order] = rows
    return p[order], q[order], won[order], rows, place[grasps]


def _keys(keys: ArrayLike, count: int) -> NDArray[np.int64]:
    k = np.asarray(keys)
    if k.shape != (count,) or not np.issubdtype(k.dtype, np.integer):
        raise ValueError(f"keys are integers of shape ({count},)")
    return k.astype(np.int64)


def _take(profiles: Profiles, lines: Counts, weights: NDArray[np.float32], mirrored: bool) -> None:
    """Profiles of a grid into the tallies they are reported from."""
    share, weight = profiles.shares(weights, mirrored=mirrored)
    lines.tried = weight.astype(np.float32)
    lines.won = (np.nan_to_num(share) * weight).astype(np.float32)
    middle = profiles.bins // 2
    at: Floats = (np.arange(profiles.bins, dtype=np.float64) - middle) * profiles.step
    lines.moved = np.tile(at, 3) * lines.pairs


def _mirror(along: Tallies, layout: Bins) -> None:
    index = np.arange(len(along.planes.pairs)).reshape(layout.slices, layout.across, layout.across)
    along.planes.mirror(index[:, ::-1, ::-1].ravel())
    lines = np.arange(len(along.lines.pairs)).reshape(3, -1)
    images = lines.copy()
    images[:2] = lines[:2, ::-1]
    turns = np.zeros(lines.shape, dtype=bool)
    turns[:2] = True
    along.lines.mirror(images.ravel(), turns=turns.ravel())
