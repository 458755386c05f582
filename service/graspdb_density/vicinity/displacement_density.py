"""The paper's way to measure a grasp's vicinity: the density of successes in the place of a trial.

Where nobody tried there is nothing to compare with: a displaced pose that no attempt but A itself lies near
is unknown, not a failure, and profiles end where pairs of attempts do.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .. import se3
from .._compiled.pairs import Tally
from ..kde.isotropic import GraspDensity
from ..kde.weighted_sums import Progress
from ..se3 import Floats, Poses
from .displacement_bins import (
    Alignment,
    Anisotropy,
    Bins,
    Frames,
    aligned_axes,
    bootstrap_weights,
    check_enough,
    summary,
)
from .tried_range import tried_range

__all__ = ["density_anisotropy"]

#: Attempts per m^3 rad^3: everywhere the same, or a function of poses.
Attempts = float | Callable[[Poses], Floats]
#: A pose is tried where attempts there are worth one within three standard deviations of a kernel.
_TRIED = math.exp(-4.5)


# long: the options of the report, explained one by one.
def density_anisotropy(
    successes: GraspDensity,
    attempts: Attempts,
    *,
    tried: Poses | None = None,
    alignment: Alignment = "gripper",
    frames: Frames | None = None,
    bins: Bins | None = None,
    max_grasps: int = 100,
    level: float = 0.9,
    seed: int = 0,
    threads: int = 1,
    progress: Progress | None = None,
) -> Anisotropy:
    """The paper's method: mean over A of ``min(1, n d(T(A)) / rho)``, A's own kernel left out of d.

    ``n d`` is the density of the n successes and rho that of attempts, so their quotient is a share of
    attempts; without rho, "0 to 100 %" has no scale. The answer is smoothed by the kernel.

    Parameters
    ----------
    successes : GraspDensity
    attempts : float or callable
        Attempts per m^3 rad^3, twins sharing one attempt: for a grid its attempts / (8 pi^2 times its
        volume); or a function of poses, such as their number times their density.
    tried : M or None
        The attempts, the successes among them, or many of them: beyond them nothing is known, and A does not
        count as an attempt at poses near its own. None: everything was tried.
    alignment, frames
        As for `empirical_anisotropy`; frames (N, 3, 3) are those of the rows of ``successes``.
    max_grasps : int
        Successes A, drawn at random by weight.

    Raises
    ------
    ValueError
        For fewer than `LEAST_SUCCESSES` rows, attempts that are not positive, or wrong frames.
    """
    check_enough(successes.size)
    if not callable(attempts) and not (math.isfinite(attempts) and attempts > 0.0):
        raise ValueError("the density of attempts must be positive")
    layout = bins or Bins()
    rng = np.random.default_rng(seed)
    count = min(max_grasps, successes.size)
    grasps = rng.choice(successes.size, size=count, replace=False, p=successes.weights).astype(np.int64)
    axes, aligned = aligned_axes(alignment, frames, successes.poses, grasps)
    share = bootstrap_weights(None, grasps, successes.size, rng)
    corners = [
        _plane_translations(layout),
        _line_displacements(layout.line("position"), layout.profile_m, 0),
        _plane_rotations(layout),
        _line_displacements(layout.line("rotation"), layout.profile, 3),
    ]
    low, high = (np.concatenate(ends) for ends in zip(*corners, strict=True))
    values = np.empty((count, len(low)))
    for number, a in enumerate(grasps):
        moves = low + (high - low) * rng.random(low.shape)
        values[number] = _shares(
            successes,
            attempts,
            int(a),
            axes[number],
            alignment,
            moves,
            rng,
            threads,
            everywhere=tried is None,
        )
        if progress is not None:
            progress((number + 1) / count)
    bounds = np.cumsum([len(first) for first, _ in corners])[:-1]
    parts = zip(np.split(values, bounds, axis=1), np.split(0.5 * (low + high), bounds), strict=True)
    planes, lines, turned_planes, turned_lines = (_mean_tally(part, share, middle) for part, middle in parts)
    if tried is not None:
        kernel, twins = successes.kernel, bool(successes.symmetric.all())
        found = tried_range(
            tried, successes.poses[grasps], axes,
            off_axis_m=kernel.sigma_position_m, off_axis=kernel.sigma_rotation,
            reach_m=layout.reach_m + 0.5 * layout.profile_m, reach=layout.reach + 0.5 * layout.profile,
            twins=twins,
            mirrored=alignment == "edge" or (twins and alignment in ("gripper", "surface-pair")),
        )  # fmt: skip
        lines = _within(lines, found.along, layout.profile_m)
        turned_lines = _within(turned_lines, found.about, layout.profile)
    return Anisotropy(
        "density",
        alignment,
        *summary(layout, (planes, lines), (turned_planes, turned_lines), level),
        grasps=count,
        translation_pairs=0,
        rotation_pairs=0,
        level=level,
        aligned=aligned,
    )


def _plane_translations(layout: Bins) -> tuple[Floats, Floats]:
    """Corners (n, 6) of the bins of the histograms of translations.

    Displacements are translations, then angles about x, y, z, composed in that order.
    """
    slice_, x, y = np.indices((layout.slices, layout.across, layout.across)).reshape(3, -1)
    side, depth = layout.side(), layout.depth()
    low, high = np.zeros((len(x), 6)), np.zeros((len(x), 6))
    for corner, shift in ((low, 0), (high, 1)):
        corner[:, 0], corner[:, 1], corner[:, 2] = side[x + shift], side[y + shift], depth[slice_ + shift]
    return low, high


def _plane_rotations(layout: Bins) -> tuple[Floats, Floats]:
    """Corners (n, 6) of the bins of the histograms of rotations."""
    step, start = 2.0 * math.pi / layout.angles, layout.circle()
    plane, i, j = np.indices((3, layout.angles, layout.angles)).reshape(3, -1)
    low, row = np.zeros((len(plane), 6)), np.arange(len(plane))
    first, second = np.array([3, 3, 4])[plane], np.array([4, 5, 5])[plane]
    low[row, first], low[row, second] = start[i], start[j]
    high = low.copy()
    high[row, first] += step
    high[row, second] += step
    return low, high


def _line_displacements(count: int, step: float, first: int) -> tuple[Floats, Floats]:
    """Corners (n, 6) of the bins of three profiles, along or about the axes from ``first`` on."""
    low, high = np.zeros((3, count, 6)), np.zeros((3, count, 6))
    for axis in range(3):
        centre = (np.arange(count) - count // 2) * step
        low[axis, :, first + axis], high[axis, :, first + axis] = centre - 0.5 * step, centre + 0.5 * step
    return low.reshape(-1, 6), high.reshape(-1, 6)


def _shares(
    successes: GraspDensity,
    attempts: Attempts,
    row: int,
    frame: Floats,
    alignment: Alignment,
    moves: Floats,
    rng: np.random.Generator,
    threads: int,
    *,
    everywhere: bool,
) -> Floats:
    """``min(1, n d(T(A)) / rho)`` for one A and a displacement in every bin: nan where nothing was tried, 0
    where everything was ``everywhere``.
    """
    twin = bool(successes.symmetric[row])
    own = successes.quaternions_xyzw[row]
    # Either twin may be the one displaced: for frames that turn with the jaw that mirrors x and y.
    turned: NDArray[np.bool_] = np.asarray((rng.random(len(moves)) < 0.5) & twin)
    base = np.where(turned[:, None], se3.jaw_twin(own), own)
    shift = moves[:, :3].copy()
    turning = alignment in ("gripper", "surface-pair")
    if alignment == "edge" or (turning and twin):
        flip: NDArray[np.bool_] = turned if turning else np.asarray(rng.random(len(moves)) < 0.5)
        shift[flip, :2] *= -1.0
    p = successes.positions[row] + shift @ frame.T
    q = base
    for axis in range(3):
        vector = np.zeros((len(moves), 3))
        vector[:, axis] = moves[:, 3 + axis]
        q = se3.multiply(q, se3.from_rotation_vector(vector))
    poses, kernel = Poses(p, q), successes.kernel
    density = successes.density(poses, threads=threads)
    mine = np.exp(kernel.log_kernel(poses, successes.poses[row]))
    if twin:
        turned_centre = Poses(successes.positions[row], se3.jaw_twin(own))
        mine = 0.5 * (mine + np.exp(kernel.log_kernel(poses, turned_centre)))
    rest = np.maximum(density - successes.weights[row] * mine, 0.0) * successes.size
    rho = attempts(poses) if callable(attempts) else np.full(len(moves), attempts)
    if not everywhere:
        rho = np.maximum(rho - mine, 0.0)
        # What one attempt is worth at its own pose, which a symmetric jaw shares with its twin.
        least = _TRIED * math.exp(kernel.log_peak) * (0.5 if twin else 1.0)
        rho = np.where(rho >= least, rho, np.nan)
    quotient = np.divide(rest, rho, out=np.zeros_like(rest), where=(rho > 0.0) | np.isnan(rho))
    return np.asarray(np.minimum(1.0, quotient), dtype=np.float64)


def _mean_tally(values: Floats, share: NDArray[np.float32], middle: Floats) -> Tally:
    """Tally of shares (A, bins) in the place of successes, nan where nothing was tried; ``middle`` (bins, 6)
    of the displacements.
    """
    known = np.isfinite(values)
    tried = (known.T.astype(np.float64) @ share.astype(np.float64)).astype(np.float32)
    won = (np.where(known, values, 0.0).T @ share.astype(np.float64)).astype(np.float32)
    pairs = known.sum(axis=0)
    moved = middle.sum(axis=1)
    return Tally(tried, won, pairs, moved * pairs, np.abs(moved))


def _within(lines: Tally, reach: Floats, step: float) -> Tally:
    """Profiles (3 n bins) without what lies farther than ``reach`` (3, 2) towards minus and plus."""
    count = len(lines.pairs) // 3
    middle = (np.arange(count) - count // 2) * step
    away = np.where(middle > 0.0, reach[:, 1:], reach[:, :1]).ravel()
    inside = np.tile(np.abs(middle) < 0.5 * step, 3) | (lines.farthest - 0.5 * step < away)
    pairs, farthest = np.where(inside, lines.pairs, 0), np.minimum(lines.farthest, away)
    return Tally(
        np.where(inside[:, None], lines.tried, 0.0).astype(np.float32),
        np.where(inside[:, None], lines.won, 0.0).astype(np.float32),
        pairs,
        np.tile(np.sign(middle), 3) * farthest * pairs,
        farthest,
    )
