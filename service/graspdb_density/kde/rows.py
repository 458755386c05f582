"""What a density is made of: grasps, how much each counts, and whether its jaw may be turned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..se3 import Floats, Poses

__all__ = ["Rows"]


@dataclass(frozen=True, eq=False, slots=True)
class Rows:
    """Weighted grasps as one value; `Rows.of` checks, the plain constructor trusts its arrays.

    Attributes
    ----------
    poses : (N)
    weights : (N,)
        Positive, in any unit; a symmetric row's is shared by its two twins.
    symmetric : (N,) bool
        Whether a row has its twin under the jaw's turn.
    """

    poses: Poses
    weights: Floats
    symmetric: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        poses: Poses,
        weights: ArrayLike | None = None,
        symmetric: ArrayLike | bool = True,
        *,
        fill: float = 1.0,
    ) -> Rows:
        """Rows with their weights (None: ``fill`` for each) and flags (one for all, or one each).

        Raises
        ------
        ValueError
            For wrong shapes, or weights that are not positive and finite.
        """
        count = len(poses)
        w = np.full(count, fill) if weights is None else np.array(weights, dtype=np.float64)
        if w.shape != (count,):
            raise ValueError(f"weights have shape ({count},), not {w.shape}")
        if not (np.isfinite(w).all() and (w > 0.0).all()):
            raise ValueError("weights must be positive and finite")
        flags = np.asarray(symmetric, dtype=bool)
        if flags.ndim and flags.shape != (count,):
            raise ValueError(f"symmetric is one flag or has shape ({count},), not {flags.shape}")
        return cls(poses, w, np.array(np.broadcast_to(flags, (count,))))

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, rows: slice | NDArray[np.integer] | NDArray[np.bool_]) -> Rows:
        """Some of the rows."""
        return Rows(self.poses[rows], self.weights[rows], self.symmetric[rows])

    def joined(self, more: Rows) -> Rows:
        """These rows and, behind them, some more."""
        return Rows(
            Poses.concatenate([self.poses, more.poses]),
            np.concatenate([self.weights, more.weights]),
            np.concatenate([self.symmetric, more.symmetric]),
        )

    def over(self, unit: float) -> Rows:
        """The same with weights in another unit."""
        return Rows(self.poses, self.weights / unit, self.symmetric)

    @property
    def twin_weights(self) -> Floats:
        """(N,) what either twin of a row counts, or the row that has none."""
        return np.where(self.symmetric, 0.5, 1.0) * self.weights

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return int(sum(part.nbytes for part in (*self.poses, self.weights, self.symmetric)))
