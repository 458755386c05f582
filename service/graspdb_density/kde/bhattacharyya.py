"""The Bhattacharyya coefficient ``BC = integral of sqrt(d1 d2)`` between densities: 1 where they are equal, 0
where they share nothing.

Sampled from ``(d1 + d2) / 2``, where the average of ``2 sqrt(d1 d2) / (d1 + d2)`` is the coefficient: that
integrand stays within [0, 1], so that its variance is bounded whatever the densities, which sampling from one
of them does not give.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels.isotropic import IsotropicKernel
from ..se3 import Poses
from .density import Density
from .rows import Rows
from .weighted_sums import KernelRows

__all__ = [
    "Coefficient",
    "DisplacementWindow",
    "bhattacharyya",
    "mirrored_displacements",
    "sampled_kernel_curve",
    "sampled_kernel_rows",
]


@dataclass(frozen=True, slots=True)
class Coefficient:
    """A Bhattacharyya coefficient and its Monte Carlo standard error."""

    value: float
    standard_error: float


@dataclass(frozen=True, slots=True)
class DisplacementWindow:
    """Displacements considered: a cube of positions and a ball of rotations about the identity.

    A similarity of kernels has no meaning without its window: most of what two of them differ in may lie far
    out.

    Parameters
    ----------
    position_m : float
        Half edge of the cube, metres; ``math.inf`` for all.
    rotation : float
        Largest angle, radians; pi for all rotations.
    """

    position_m: float = 0.04
    rotation: float = math.pi

    def __post_init__(self) -> None:
        if not self.position_m > 0.0 or not 0.0 < self.rotation <= math.pi:
            raise ValueError("a window has a positive half edge and an angle in (0, pi]")

    def holds(self, displacements: Poses) -> NDArray[np.bool_]:
        """Whether each of M lies inside."""
        p, q = displacements
        angle = 2.0 * np.arccos(np.minimum(np.abs(q[:, 3]), 1.0))
        near: NDArray[np.bool_] = np.max(np.abs(p), axis=1) <= self.position_m
        return near & (angle <= self.rotation + 1e-9)


def bhattacharyya(
    first: Density,
    second: Density,
    rng: np.random.Generator,
    *,
    points: int = 20_000,
    window: DisplacementWindow | None = None,
    threads: int = 1,
) -> Coefficient:
    """BC between two densities, or between two kernels as densities of displacements.

    Parameters
    ----------
    points : int
        Draws in all, half from each.
    window : DisplacementWindow or None
        Compare the two restricted to a window and normalised in it.

    Raises
    ------
    ValueError
        For fewer than 4 points, or where a density has no draw inside the window.
    """
    if points < 4:
        raise ValueError("a coefficient needs at least 4 points")
    half = points // 2
    # Draws from each, so the mixture is stratified: exactly half of the points from either.
    drawn = Poses.concatenate([density.sample(half, rng) for density in (first, second)])
    inside = np.ones(2 * half, dtype=bool) if window is None else window.holds(drawn)
    if not inside[:half].any() or not inside[half:].any():
        raise ValueError("a density has no draw inside the window")
    value = np.zeros(2 * half)
    within = drawn[inside]
    difference = first.log_density(within, threads=threads) - second.log_density(within, threads=threads)
    # 2 sqrt(d1 d2) / (d1 + d2) = 1 / cosh((log d1 - log d2) / 2), without overflow.
    decay = np.exp(-0.5 * np.abs(difference))
    value[inside] = 2.0 * decay / (1.0 + decay * decay)
    shares = [float(inside[:half].mean()), float(inside[half:].mean())]
    scale = 1.0 / math.sqrt(shares[0] * shares[1])
    coefficient = float(value.mean()) * scale
    # Delta method, the strata independent: the shares of the window are estimated from the same draws.
    variance = 0.0
    for part, share in zip((slice(0, half), slice(half, None)), shares, strict=True):
        influence = 0.5 * scale * value[part] - 0.5 * coefficient * inside[part] / share
        variance += float(influence.var(ddof=1)) / half
    return Coefficient(min(coefficient, 1.0), math.sqrt(variance))


def mirrored_displacements(displacements: Poses) -> Poses:
    """Displacements of the same grasps with the jaw mirrored: ``M^-1 xi M``, so x and y change sign in both
    parts.
    """
    return Poses(
        displacements.positions * np.array([-1.0, -1.0, 1.0]),
        displacements.quaternions_xyzw * np.array([-1.0, -1.0, 1.0, 1.0]),
    )


def sampled_kernel_rows(displacements: Poses, components: IsotropicKernel) -> KernelRows:
    """The sampled kernel (eq 5) as a density of displacements: an isotropic component at every sample and at
    its mirror image.
    """
    both = Poses.concatenate([displacements, mirrored_displacements(displacements)])
    return KernelRows(Rows.of(both, symmetric=False), components)


def sampled_kernel_curve(
    displacements: Poses,
    *,
    components: IsotropicKernel,
    window: DisplacementWindow,
    rng: np.random.Generator,
    counts: Sequence[int] = (50, 100, 200, 400, 900, 1_800, 3_600),
    reference: int = 20_000,
    points: int = 8_000,
    threads: int = 1,
) -> dict[int, Coefficient]:
    """Similarity of the sampled kernel to the full statistics by the number of samples (figure 13).

    Parameters
    ----------
    displacements : (N)
        Between successful grasps, in the frame of the first.
    components
        Width of every sample's component; like the window, the answer depends on it.
    counts
        Samples of the kernels compared; those beyond what the window holds are left out.
    reference : int
        At most this many displacements stand for the full statistics.

    Raises
    ------
    ValueError
        Where the window holds fewer than 100 displacements.
    """
    kept = np.flatnonzero(window.holds(displacements))
    if len(kept) < 100:
        raise ValueError(
            f"the window holds {len(kept)} displacements between successes; at least 100 are needed"
        )
    kept = rng.permutation(kept)
    full = kept[:reference]
    whole = sampled_kernel_rows(displacements[full], components)
    # Samples are drawn anew from all displacements, as a kernel would be; overlap with the reference is part
    # of comparing a sample with what it was drawn from.
    found = {}
    for count in counts:
        if not 1 <= count <= len(full):
            continue
        chosen = rng.choice(full, size=count, replace=False)
        one = sampled_kernel_rows(displacements[chosen], components)
        found[count] = bhattacharyya(one, whole, rng, points=points, window=window, threads=threads)
    return found
