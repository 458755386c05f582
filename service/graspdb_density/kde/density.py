"""What every density can do, whatever its kernels."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..se3 import Floats, Poses
from .isotropic import CUTOFF, GraspDensity

__all__ = ["Density", "SearchedDensity"]


class Density(Protocol):
    """A density of grasps, 1/(m^3 rad^3): `GraspDensity`, `MixtureDensity`, `KernelRows`."""

    def log_density(self, poses: Poses, *, threads: int = 1) -> Floats:
        """(M,) nats, right however far from every row."""

    def sample(self, count: int, rng: np.random.Generator) -> Poses:
        """Grasps drawn from it."""


class SearchedDensity(Density, Protocol):
    """A density that queries ask and searches climb: `GraspDensity`, `MixtureDensity`."""

    @property
    def size(self) -> int:
        """Rows; twins are not counted."""

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held."""

    def sample_rows(self, rows: NDArray[np.integer], rng: np.random.Generator) -> Poses:
        """A draw from the kernel of each of some rows, their twins left out."""

    @property
    def isotropic(self) -> GraspDensity:
        """The same rows under the isotropic kernel of equal determinants: itself where it is that."""

    def log_density(self, poses: Poses, *, cutoff: float | None = CUTOFF, threads: int = 1) -> Floats:
        """(M,) nats, right however far from every row.

        ``cutoff`` is the reach of the first sum, in standard deviations of position, where the kernel has
        such; None: no reach, all rows are summed.
        """
