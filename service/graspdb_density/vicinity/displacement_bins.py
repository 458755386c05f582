"""What the two ways to measure a grasp's vicinity share: how displacements are binned and aligned, how the
grasps are resampled, and the report made of weighted tallies.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from .._compiled.pairs import Tally
from ..se3 import Floats, Poses
from .half_width import Tolerance, quantiles, tolerances

__all__ = [
    "LEAST_SUCCESSES",
    "PLANES",
    "Alignment",
    "Anisotropy",
    "Bins",
    "Frames",
    "Histogram",
    "aligned_axes",
    "bootstrap_weights",
    "check_enough",
    "summary",
]

Alignment = Literal["gripper", "object", "edge", "surface-pair"]
#: Axes of grasps: an array, or what tells those (n, 3, 3) of poses (n).
Frames = ArrayLike | Callable[[Poses], Floats]
#: Fewer successes than this say nothing about their vicinity.
LEAST_SUCCESSES = 20
PLANES = (("rx", "ry"), ("rx", "rz"), ("ry", "rz"))
_RESAMPLES = 200


@dataclass(frozen=True, slots=True)
class Bins:
    """How displacements are binned.

    With the defaults every multiple of 10 mm and of 15 degrees, the usual steps of a grid, falls inside a bin
    and not on its edge.

    Attributes
    ----------
    extent_m, across : half width of the histograms in x and y (metres) and their bins along each
    slices, slice_m : slices in z and their depth, metres
    angles : bins of the circle; one is centred on 0
    reach_m, profile_m : reach of the profiles and the width of their bins, metres
    reach, profile : the same for rotations, radians
    """

    extent_m: float = 0.04
    across: int = 9
    slices: int = 5
    slice_m: float = 0.016
    angles: int = 24
    reach_m: float = 0.08
    profile_m: float = 0.005
    reach: float = math.pi / 2.0
    profile: float = math.radians(7.5)

    def line(self, kind: Literal["position", "rotation"]) -> int:
        """Bins of a profile, odd."""
        reach, step = (self.reach_m, self.profile_m) if kind == "position" else (self.reach, self.profile)
        return 2 * max(1, round(reach / step)) + 1

    def side(self) -> Floats:
        """Edges in x and y, metres."""
        return np.linspace(-self.extent_m, self.extent_m, self.across + 1)

    def depth(self) -> Floats:
        """Edges of the slices in z, metres."""
        return np.asarray((np.arange(self.slices + 1) - 0.5 * self.slices) * self.slice_m)

    def circle(self) -> Floats:
        """Edges of the angles, radians."""
        return np.asarray((np.arange(self.angles + 1) - 0.5) * (2.0 * math.pi / self.angles) - math.pi)


@dataclass(frozen=True, eq=False, slots=True)
class Histogram:
    """P over two displacements.

    Attributes
    ----------
    axes : two of x, y or rx, ry, rz
    edges : ((n + 1,), (n + 1,))
        Metres or radians, rising.
    slice_m : (float, float) or None
        Range of z of a histogram of translations.
    probability, low, high : (n, n)
        First axis first; nan where nothing was tried.
    count : (n, n) int64
        Pairs (empirical; one counts at its mirror image too) or evaluations (of a density) behind each bin.
    """

    axes: tuple[str, str]
    edges: tuple[Floats, Floats]
    slice_m: tuple[float, float] | None
    probability: Floats
    low: Floats
    high: Floats
    count: NDArray[np.int64]


@dataclass(frozen=True, eq=False, slots=True)
class Anisotropy:
    """The report: five histograms of translations by z, one for each plane of rotations, and the tolerance
    along and about every axis.

    ``grasps`` successes A were displaced, ``aligned`` of them along axes of their own, the others along the
    gripper's; ``translation_pairs`` and ``rotation_pairs`` are pairs of trials, 0 for the density's method.
    Intervals hold with probability ``level``.
    """

    method: str
    alignment: str
    translations: tuple[Histogram, ...]
    rotations: tuple[Histogram, ...]
    tolerances: tuple[Tolerance, ...]
    grasps: int
    translation_pairs: int
    rotation_pairs: int
    level: float
    aligned: int


def check_enough(successes: int) -> None:
    """Refuse a statement from too few successes."""
    if successes < LEAST_SUCCESSES:
        raise ValueError(
            f"a statement about the vicinity of a success needs at least {LEAST_SUCCESSES} successes; there "
            f"are {successes}, so {LEAST_SUCCESSES - successes} more are needed"
        )


def aligned_axes(
    alignment: Alignment, frames: Frames | None, poses: Poses, grasps: NDArray[np.int64]
) -> tuple[Floats, int]:
    """Frames (A, 3, 3) of the grasps, and how many have one of their own rather than the gripper's."""
    chosen = poses[grasps]
    own = se3.to_matrix(chosen.quaternions_xyzw)
    if alignment == "gripper":
        if frames is not None:
            raise ValueError("alignment with the gripper takes no frames")
        return own, len(grasps)
    if alignment not in ("object", "edge", "surface-pair"):
        raise ValueError(f"alignment is gripper, object, edge or surface-pair, not {alignment!r}")
    if frames is None:
        raise ValueError(f"alignment with the {alignment} needs its frames")
    if alignment == "object":
        f = np.asarray(frames, dtype=np.float64)
        if f.shape != (3, 3):
            raise ValueError(f"the object's principal axes have shape (3, 3), not {f.shape}")
        f = np.broadcast_to(f, (len(grasps), 3, 3))
        known = np.ones(len(grasps), dtype=bool)
    else:
        f = np.asarray(frames(chosen) if callable(frames) else frames, dtype=np.float64)
        expected = len(grasps) if callable(frames) else len(poses)
        if f.shape != (expected, 3, 3):
            raise ValueError(f"frames of grasps have shape ({expected}, 3, 3), not {f.shape}")
        f = f if callable(frames) else f[grasps]
        known = np.asarray(np.isfinite(f).all(axis=(1, 2)), dtype=bool)
        f = np.where(known[:, None, None], f, own)
    gram = np.einsum("nji,njk->nik", f, f)
    if not np.all(np.abs(gram - np.eye(3)) < se3.UNIT_TOLERANCE) or np.any(np.linalg.det(f) < 0.0):
        raise ValueError("the columns of a frame must be orthonormal and right-handed")
    return np.ascontiguousarray(f), int(known.sum())


def bootstrap_weights(
    weights: ArrayLike | None, grasps: NDArray[np.int64], rows: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Weight of every A as observed and in each resample of the grasps, (A, 1 + resamples)."""
    own = np.ones(len(grasps))
    if weights is not None:
        w = np.asarray(weights, dtype=np.float64)
        if w.shape != (rows,) or not np.all(np.isfinite(w)) or np.any(w < 0.0) or not w[grasps].sum() > 0.0:
            raise ValueError(f"weights have shape ({rows},), are finite and not negative")
        own = w[grasps] / w[grasps].mean()
    again = rng.multinomial(len(grasps), np.full(len(grasps), 1.0 / len(grasps)), size=_RESAMPLES)
    columns = np.concatenate([np.ones((1, len(grasps))), again]) * own
    return np.ascontiguousarray(columns.T, dtype=np.float32)


def summary(
    layout: Bins,
    along: tuple[Tally, Tally],
    about: tuple[Tally, Tally],
    level: float,
) -> tuple[tuple[Histogram, ...], tuple[Histogram, ...], tuple[Tolerance, ...]]:
    """Translations, rotations and tolerances of a report by tallies in planes and on lines, along
    translations and about rotations.
    """
    if not 0.0 < level < 1.0:
        raise ValueError("level lies between 0 and 1")
    side, depth, circle = layout.side(), layout.depth(), layout.circle()
    cells = (layout.slices, layout.across, layout.across)
    translations = tuple(
        Histogram(("x", "y"), (side, side), (float(depth[i]), float(depth[i + 1])), *parts)
        for i, parts in enumerate(_quantiles(along[0], cells, level))
    )
    rotations = tuple(
        Histogram(PLANES[i], (circle, circle), None, *parts)
        for i, parts in enumerate(_quantiles(about[0], (3, layout.angles, layout.angles), level))
    )
    lines: list[Tolerance] = []
    for tally, names, step in (
        (along[1], ("x", "y", "z"), layout.profile_m),
        (about[1], ("rx", "ry", "rz"), layout.profile),
    ):
        lines += tolerances(
            names, _probability(tally), tally.tried, tally.pairs, tally.moved, step=step, level=level,
            farthest=tally.farthest,
        )  # fmt: skip
    return translations, rotations, tuple(lines)


def _probability(tally: Tally) -> Floats:
    """(bins, 1 + resamples), nan where nothing was tried."""
    tried = tally.tried.astype(np.float64)
    return np.asarray(np.where(tried > 0.0, tally.won / np.where(tried > 0.0, tried, 1.0), np.nan))


def _quantiles(
    tally: Tally, shape: tuple[int, int, int], level: float
) -> list[tuple[Floats, Floats, Floats, NDArray[np.int64]]]:
    """Probability, interval and pairs of every histogram."""
    value = _probability(tally)
    low, high = quantiles(value[:, 1:], level)
    # Resamples may have left out every A of a bin; a bin whose few pairs agree has no spread to resample.
    low, high = np.fmin(low, value[:, 0]), np.fmax(high, value[:, 0])
    parts = [array.reshape(shape) for array in (value[:, 0], low, high)]
    number = tally.pairs.reshape(shape)
    return [(parts[0][i], parts[1][i], parts[2][i], number[i]) for i in range(shape[0])]
