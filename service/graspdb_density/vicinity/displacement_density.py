"""The paper's way to measure a grasp's vicinity: the density of successes in the place of a trial."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..kde import brute_force
from ..kde.isotropic import GraspDensity
from ..kde.weighted_sums import Progress
from ..se3 import Floats
from .displacement_bins import (
    Alignment,
    Anisotropy,
    Bins,
    Counts,
    Frames,
    Tallies,
    aligned_axes,
    check_enough,
    report,
    resampling,
)

__all__ = ["attempt_density", "smoothed"]


def smoothed(
    successes: GraspDensity,
    attempts: float | Callable[[Floats, Floats], Floats],
    *,
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
        volume); or a function of poses, see `attempt_density`.
    alignment, frames
        As for `empirical`; frames (N, 3, 3) are those of the rows of ``successes``.
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
    axes, aligned = aligned_axes(alignment, frames, successes.positions, successes.quaternions_xyzw, grasps)
    share = resampling(None, grasps, successes.size, rng)
    moves = _bin_moves(layout)
    values: list[Floats] = []
    for number, a in enumerate(grasps):
        vectors = [_drawn(low, high, rng) for low, high in moves]
        values.append(_shares(successes, attempts, int(a), axes[number], alignment, vectors, rng, threads))
        if progress is not None:
            progress((number + 1) / count)
    table = np.array(values)
    parts = np.split(table, np.cumsum([len(low) for low, _ in moves])[:-1], axis=1)
    counts = [_mean_counts(part, share) for part in parts]
    for line, (low, high), columns in ((counts[1], moves[1], (0, 1, 2)), (counts[3], moves[3], (3, 4, 5))):
        line.moved = (0.5 * (low + high))[:, columns].sum(axis=1) * line.pairs
    along, about = Tallies(counts[0], counts[1]), Tallies(counts[2], counts[3])
    return report("density", alignment, layout, along, about, count, (0, 0), level, aligned)


def attempt_density(attempts: GraspDensity) -> Callable[[Floats, Floats], Floats]:
    """Attempts per m^3 rad^3 around poses, for `smoothed`, from the density of all of them."""
    return lambda p, q: attempts.size * attempts.density(se3.Poses(p, q))


def _bin_moves(layout: Bins) -> list[tuple[Floats, Floats]]:
    """Corners (n, 6) of the displacements of every bin: planes and lines of translations, then of rotations.

    Rotations are stored as angles about x, y, z, composed in that order.
    """
    result: list[tuple[Floats, Floats]] = []
    side = np.linspace(-layout.extent_m, layout.extent_m, layout.across + 1)
    depth = (np.arange(layout.slices + 1) - 0.5 * layout.slices) * layout.slice_m
    cells = np.stack(
        np.meshgrid(*(np.arange(n) for n in (layout.slices, layout.across, layout.across)), indexing="ij"),
        axis=-1,
    ).reshape(-1, 3)
    low, high = np.zeros((len(cells), 6)), np.zeros((len(cells), 6))
    for corner, shift in ((low, 0), (high, 1)):
        corner[:, 0], corner[:, 1] = side[cells[:, 1] + shift], side[cells[:, 2] + shift]
        corner[:, 2] = depth[cells[:, 0] + shift]
    result.append((low, high))
    result.append(_line_moves(layout.line("position"), layout.profile_m, 0))
    step = 2.0 * math.pi / layout.angles
    start = (np.arange(layout.angles) - 0.5) * step - math.pi
    low = np.zeros((3, layout.angles, layout.angles, 6))
    for plane, (a, b) in enumerate(((3, 4), (3, 5), (4, 5))):
        low[plane, :, :, a] = start[:, None]
        low[plane, :, :, b] = start[None, :]
    low = low.reshape(-1, 6)
    used = np.zeros((3, layout.angles**2, 6))
    for plane, pair in enumerate(((3, 4), (3, 5), (4, 5))):
        used[plane, :, pair] = step
    result.append((low, low + used.reshape(-1, 6)))
    result.append(_line_moves(layout.line("rotation"), layout.profile, 3))
    return result


def _line_moves(count: int, step: float, first: int) -> tuple[Floats, Floats]:
    low, high = np.zeros((3, count, 6)), np.zeros((3, count, 6))
    for axis in range(3):
        centre = (np.arange(count) - count // 2) * step
        low[axis, :, first + axis], high[axis, :, first + axis] = centre - 0.5 * step, centre + 0.5 * step
    return low.reshape(-1, 6), high.reshape(-1, 6)


def _drawn(low: Floats, high: Floats, rng: np.random.Generator) -> Floats:
    return np.asarray(low + (high - low) * rng.random(low.shape), dtype=np.float64)


def _shares(
    successes: GraspDensity,
    attempts: float | Callable[[Floats, Floats], Floats],
    row: int,
    frame: Floats,
    alignment: Alignment,
    vectors: list[Floats],
    rng: np.random.Generator,
    threads: int,
) -> Floats:
    """``min(1, n d(T(A)) / rho)`` for one A and one displacement in every bin."""
    moves = np.concatenate(vectors)
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
    poses, centre = se3.Poses(p, q), se3.Poses(successes.positions[row], own)
    density = successes.density(poses, threads=threads)
    weight = successes.weights[row]
    kernel = successes.kernel
    mine = np.exp(brute_force.kernel_log_density(kernel, poses, centre))
    if twin:
        turned_centre = se3.Poses(centre.positions, se3.jaw_twin(own))
        mine = 0.5 * (mine + np.exp(brute_force.kernel_log_density(kernel, poses, turned_centre)))
    rest = np.maximum(density - weight * mine, 0.0) * successes.size
    rho = attempts(p, q) if callable(attempts) else attempts
    with np.errstate(divide="ignore", invalid="ignore"):
        quotient = np.where(rest > 0.0, rest / rho, 0.0)
    return np.asarray(np.minimum(1.0, quotient), dtype=np.float64)


def _mean_counts(values: Floats, share: NDArray[np.float32]) -> Counts:
    """Tallies of shares (A, bins) in the place of successes."""
    bins = values.shape[1]
    tried = np.broadcast_to(share.sum(axis=0), (bins, share.shape[1])).astype(np.float32)
    won = (values.T @ share.astype(np.float64)).astype(np.float32)
    return Counts(tried, won, np.full(bins, len(values), dtype=np.int64), np.zeros(bins))
