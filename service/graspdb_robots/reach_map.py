"""A map of what an arm reaches: cells of place and approach, each with joints that led there.

Drawn once from joints within their limits, uniformly. A cell that no draw fell into may be reached all the
same: the map says where to look first and where to start from, never what can't be done.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ._compiled import chain
from .arm import Floats

_DRAWS, _BLOCK = 400_000, 50_000
#: Cells along each axis of the cube that the arm reaches, and along each edge of a cube of directions.
_CELLS, _SIDES = 16, 3
#: Joints kept of one cell.
_KEPT = 4
#: The cube is so much larger than what was drawn.
_BEYOND = 1.02


@dataclass(frozen=True, eq=False)
class ReachMap:
    """Numbers (K,) of cells that were met, sorted, and joints (K, n) that led there.

    ``origin`` (3,) and ``cell`` are the cube's lower corner and the cells' edge, metres, root's frame.
    """

    origin: Floats
    cell: float
    known: NDArray[np.int64]
    joints: Floats

    @classmethod
    def build(cls, forward: Callable[[Floats], Floats], lower: Floats, upper: Floats) -> ReachMap:
        """Draw joints between limits (n,), and keep where the flange was."""
        rng = np.random.default_rng(0)
        drawn = rng.uniform(lower, upper, (_DRAWS, len(lower)))
        poses = np.concatenate([forward(drawn[start : start + _BLOCK]) for start in range(0, _DRAWS, _BLOCK)])
        places = poses[:, :3, 3]
        middle = (places.min(axis=0) + places.max(axis=0)) / 2
        half = _BEYOND * float(np.abs(places - middle).max()) + 1e-3
        origin, cell = middle - half, 2.0 * half / _CELLS
        numbers = np.empty(_DRAWS, dtype=np.int64)
        chain.cell_numbers(poses, origin, cell, _SIDES, _CELLS, numbers)
        order = np.argsort(numbers, kind="stable")
        numbers = numbers[order]
        first = np.searchsorted(numbers, numbers)
        kept = np.arange(_DRAWS) - first < _KEPT
        return cls(origin, cell, numbers[kept], drawn[order[kept]])

    @property
    def nbytes(self) -> int:
        """Bytes that it keeps."""
        return self.known.nbytes + self.joints.nbytes

    def seeds(self, pose: Floats, out: Floats) -> int:
        """Write joints to start from for a pose (4, 4) of the flange to out (most, n): how many."""
        return int(
            chain.seeds_of(
                pose, self.origin, self.cell, _SIDES, _CELLS, self.known, self.joints, len(out), out
            )
        )

    def knows(self, poses: Floats) -> NDArray[np.bool_]:
        """Whether a draw was in the cell of each pose (N, 4, 4)."""
        numbers = np.empty(len(poses), dtype=np.int64)
        chain.cell_numbers(np.ascontiguousarray(poses), self.origin, self.cell, _SIDES, _CELLS, numbers)
        at = np.minimum(np.searchsorted(self.known, numbers), len(self.known) - 1)
        return np.asarray(self.known[at] == numbers)

    def outside(self, places: Floats) -> NDArray[np.bool_]:
        """Which places (N, 3) lie beyond the cube about all that was drawn, by more than a cell."""
        end = self.origin + _CELLS * self.cell
        return np.asarray(np.any((places < self.origin - self.cell) | (places > end + self.cell), axis=1))
