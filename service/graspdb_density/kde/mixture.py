"""Densities under an anisotropic kernel: a Gaussian or a mixture over displacements, fast and for queries.

`KernelRows` evaluates the same kernels under many weightings at once; this is the one density that queries
ask.
"""

from __future__ import annotations

import copy
import math
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from .._compiled import mixture
from ..kernels.gaussian_mixture import AnisotropicKernel
from ..kernels.isotropic import HAAR_VOLUME
from ..se3 import Floats, Poses
from .cell_list import Cells
from .importance_weights import effective_sample_size
from .isotropic import CUTOFF, GraspDensity, trusted_stages
from .rows import Rows
from .weighted_sums import KernelRows

__all__ = ["NARROW", "MixtureDensity"]

#: Largest rotation width at which a row's nearer twin stands for both.
NARROW = math.radians(25.0)
_QUERY_BLOCK = 512


class MixtureDensity:
    """Kernel density estimate with an anisotropic kernel; immutable, safe to use from several threads.

    Parameters
    ----------
    poses : (N), at least one
    kernel
    weights : (N,) positive, normalised here; None: equal
    symmetric : bool or (N,)
    frames : (N, 3, 3) or (3, 3)
        Columns are the axes translations are measured along, object frame; required by a kernel whose frame
        is ``fixed``, refused by one whose frame is the gripper.

    Raises
    ------
    ValueError
        For wrong shapes or values, or frames that do not fit the kernel.
    """

    def __init__(
        self,
        poses: Poses,
        *,
        kernel: AnisotropicKernel,
        weights: ArrayLike | None = None,
        symmetric: ArrayLike | bool = True,
        frames: ArrayLike | None = None,
    ) -> None:
        rows = KernelRows(Rows.of(poses, weights, symmetric), kernel, frames=frames)
        # Weights are kept in the unit of those given, so that further rows can be added in it.
        self._total = float(rows.size) if weights is None else float(np.sum(weights))
        self._unit = self._total / rows.size
        self._kernel = kernel
        along, about = kernel.widest
        self._offset = float(np.linalg.norm(kernel.means[:, :3], axis=1).max())
        self._spread = float(along.max())
        self._hold(rows, Cells.build(rows.rows.over(1.0 / rows.size), self._spread))
        self._log_unit = rows.log_unit
        turn, mean_turn = float(about.max()), float(np.linalg.norm(kernel.means[:, 3:], axis=1).max())
        self._narrow = turn <= NARROW and mean_turn + 2.5 * turn <= math.radians(75.0)

    def _hold(self, rows: KernelRows, cells: Cells) -> None:
        self._rows, self._cells = rows, cells
        if self._kernel.frame == "gripper":
            # Turned by the rows' own quaternions in the loops.
            self._sorted_frames = np.zeros((9, 1), dtype=np.float32)
        else:
            self._sorted_frames = np.ascontiguousarray(
                rows.frames.reshape(-1, 9)[cells.rows].T, dtype=np.float32
            )

    def extend(
        self,
        poses: Poses,
        weights: ArrayLike | None = None,
        symmetric: ArrayLike | bool = True,
        frames: ArrayLike | None = None,
    ) -> MixtureDensity:
        """A density with further rows, weights in the unit of the first ones (None: their mean).

        Equal to building from all rows within 1e-5 of the density; what is sorted stays sorted.
        """
        if not len(poses):
            return self
        more = Rows.of(poses, weights, symmetric, fill=self._total / self.size)
        if frames is not None:
            frames = np.concatenate([self._rows.frames, KernelRows(more, self._kernel, frames=frames).frames])
        both = self._rows.rows.over(1.0 / self._total).joined(more)
        rows = KernelRows(both, self._kernel, frames=frames)
        grown = copy.copy(self)
        grown.__dict__.pop("isotropic", None)
        grown._total = self._total + float(more.weights.sum())
        grown._hold(rows, self._cells.extend(more.over(self._unit)))
        if "isotropic" in self.__dict__:
            grown.__dict__["isotropic"] = self.isotropic.extend(
                poses, weights=more.weights, symmetric=more.symmetric
            )
        return grown

    @property
    def kernel(self) -> AnisotropicKernel:
        return self._kernel

    @property
    def size(self) -> int:
        """Rows; twins are not counted."""
        return self._rows.size

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held for evaluation, `isotropic` not counted."""
        return self._rows.nbytes + self._cells.nbytes + self._sorted_frames.nbytes

    @property
    def effective_sample_size(self) -> float:
        """(sum w)^2 / sum w^2."""
        return effective_sample_size(self._rows.weights)

    @cached_property
    def isotropic(self) -> GraspDensity:
        """The density under the isotropic kernel of equal determinants: where searches start."""
        return GraspDensity.build(
            self._rows.poses,
            kernel=self._kernel.isotropic,
            weights=self._rows.weights * self._total,
            symmetric=self._rows.symmetric,
        )

    def log_density(self, poses: Poses, *, cutoff: float | None = None, threads: int = 1) -> Floats:
        """Log density at poses, nats of 1/(m^3 rad^3), right however far from every row.

        ``cutoff`` changes nothing: whatever matters is summed, however far.

        Within 1e-3 of the float64 sum near data where rotation widths are at most `NARROW`; wider kernels sum
        both twins and both wraps of every rotation.
        """
        if not self._narrow:
            return self._rows.log_density(poses, threads=threads)
        cells, stages, rows = self._cells.arrays, self._stages(), self._rows
        components, unit = rows.mixture.single(), math.log(self._total / self._unit)
        exact = rows.exact, rows.exact_mixture

        def loop(p: Floats, q: Floats, out: Floats) -> None:
            mixture.mixture_log_sums(cells, self._sorted_frames, p, q, components, stages, unit, *exact, out)

        return self._cells.at_poses(loop, poses, block=_QUERY_BLOCK, threads=threads) + self._log_unit

    def _stages(self) -> Floats:
        """Radii and when to trust them, as `isotropic.stages`."""
        _, logdet = np.linalg.slogdet(self._kernel.overall_covariance[:3, :3])
        # Mean of the rotation's factor over all rotations, relative to the peak of the largest component.
        random = math.exp(-1.5 * math.log(2.0 * math.pi) - 0.5 * logdet - self._log_unit) / HAAR_VOLUME
        scale = self._cells.arrays.scale
        return trusted_stages(CUTOFF, random, lambda reach: (self._offset + reach * self._spread) * scale)

    def sample(self, count: int, rng: np.random.Generator) -> Poses:
        """Draw grasps."""
        return self._rows.sample(count, rng)

    def sample_rows(self, rows: NDArray[np.integer], rng: np.random.Generator) -> Poses:
        """A draw from the kernel of each of some rows, their twins left out."""
        kernel, centres = self._kernel, self._rows.poses[rows]
        parts = rng.choice(len(kernel.weights), size=len(rows), p=kernel.weights / np.sum(kernel.weights))
        roots = np.linalg.cholesky(kernel.covariances)
        xi = kernel.means[parts] + np.einsum("nij,nj->ni", roots[parts], rng.standard_normal((len(rows), 6)))
        return Poses(
            centres.positions + np.einsum("nij,nj->ni", self.frames[rows], xi[:, :3]),
            se3.multiply(centres.quaternions_xyzw, se3.from_rotation_vector(xi[:, 3:])),
        )

    @property
    def symmetric(self) -> NDArray[np.bool_]:
        """(N,) whether a row has a twin."""
        return self._rows.symmetric

    @property
    def frames(self) -> Floats:
        """(N, 3, 3) columns are the axes along which a row's translations are measured, object frame."""
        return self._rows.frames
