"""What a search for the best grasps goes by, made once for a density.

Rows in the order of what their centres are worth, so that a search looks at no more of them than it needs;
and the kernels to climb among: all of them and, where that makes climbs slow, samples of them, coarse first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..kde.cell_list import Cells
from .start_ranking import CentreSums, drawn

if TYPE_CHECKING:
    from ..kde.isotropic import GraspDensity

__all__ = ["Guide", "guide_for"]

#: How many times the kernels of the ranking's sample the finer one has, and how many times its kernels there
#: must be for it to pay.
_FINER, _WORTH = 4.0, 2.0


@dataclass(frozen=True, eq=False, slots=True)
class Guide:
    """Of a density's N rows.

    Attributes
    ----------
    order : (N,)
        Rows by falling worth.
    landmarks : (N, 8) float32
        In that order: position in metres, quaternion, log of the kernel sum. A row fills one line of the
        processor's cache.
    twins : (N,)
        In that order: whether the jaw is symmetric.
    levels
        Kernels to climb among, from a sample to all.
    """

    order: NDArray[np.intp]
    landmarks: NDArray[np.float32]
    twins: NDArray[np.bool_]
    levels: tuple[Cells, ...]

    @property
    def nbytes(self) -> int:
        """Bytes held, those of the ranking and the density left out."""
        own = self.order.nbytes + self.landmarks.nbytes + self.twins.nbytes
        return own + sum(cells.nbytes for cells in self.levels[1:-1])


def guide_for(density: GraspDensity, ranking: CentreSums) -> Guide:
    order = np.argsort(-ranking.values, kind="stable")
    worth = np.log(np.maximum(ranking.values, 1e-300))
    landmarks = np.concatenate(
        [density.positions, density.quaternions_xyzw, worth[:, None]], axis=1, dtype=np.float32
    )[order]
    return Guide(order, landmarks, density.symmetric[order], _levels(density, ranking))


def _levels(density: GraspDensity, ranking: CentreSums) -> tuple[Cells, ...]:
    whole, sample = density.cells, ranking.sample
    if sample is None:
        return (whole,)
    if _WORTH * _FINER * sample.data.shape[1] > density.size:
        return sample, whole
    rows, weights = drawn(density, whole.rows.astype(np.int64), _FINER * ranking.rate)
    finer = Cells.build(
        density.positions[rows],
        density.quaternions_xyzw[rows],
        weights,
        density.symmetric[rows],
        density.kernel.sigma_position_m,
    )
    return sample, finer, whole
