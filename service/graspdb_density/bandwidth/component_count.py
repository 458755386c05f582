"""How many Gaussians a kernel needs to be like the statistics of displacements that it stands for: the
counterpart of `bhattacharyya.sampled_kernel_curve` (figure 13) for mixtures.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..kde.bhattacharyya import Coefficient, DisplacementWindow
from ..kde.weighted_sums import Progress
from ..kernels.gaussian_mixture import MOST_ROTATION, AnisotropicKernel
from ..kernels.isotropic import IsotropicKernel
from ..se3 import Floats
from .mixture_fit import Displacements, mixture_parts, sampled_rows, similarity_to_sampled

__all__ = ["MIXTURES", "mixture_curve"]

#: Gaussians of the mixtures compared.
MIXTURES = tuple(range(1, 17))


def mixture_curve(
    found: Displacements,
    *,
    components: IsotropicKernel,
    window: DisplacementWindow,
    rng: np.random.Generator,
    counts: Sequence[int] = MIXTURES,
    reference: int = 20_000,
    fitted: int = 2_000,
    points: int = 4_000,
    threads: int = 1,
    progress: Progress | None = None,
) -> dict[int, Coefficient]:
    """Similarity of mixtures of Gaussians to the sampled kernel of all displacements, by their number.

    A Gaussian off the jaw's plane of symmetry is a pair with its mirror image and counts as one. What turns
    farther than a component may be wide is made as wide as it may be.

    Parameters
    ----------
    found
        Displacements inside the window.
    components
        Widths of the sampled kernel's components, which the Gaussians' covariances include.
    fitted : int
        At most this many displacements, drawn by weight, are fitted.
    """
    share = found.weights / found.weights.sum()
    whole_rows = rng.choice(len(share), size=min(reference, len(share)), replace=False, p=share)
    whole = sampled_rows(found.vectors[whole_rows], components)
    chosen = rng.choice(len(share), size=min(fitted, len(share)), replace=False, p=share)
    added = components.overall_covariance
    likeness = {}
    for count in counts:
        weights, means, covariances = mixture_parts(found.vectors[chosen], count)
        kernel = AnisotropicKernel.symmetrised(weights, means, _narrowed(covariances + added))
        likeness[count] = similarity_to_sampled(
            kernel, whole, rng, points=points, window=window, threads=threads
        )
        if progress is not None:
            progress(len(likeness) / len(counts))
    return likeness


def _narrowed(covariances: Floats) -> Floats:
    """Covariances (C, 6, 6) whose rotations are at most as wide as a component's may be."""
    widest = np.sqrt(np.linalg.eigvalsh(covariances[:, 3:, 3:])[:, -1])
    factor = np.ones((len(covariances), 6))
    factor[:, 3:] = np.minimum(1.0, MOST_ROTATION / widest)[:, None]
    return np.asarray(factor[:, :, None] * covariances * factor[:, None, :])
