"""Kernel density estimates on R^3 x SO(3), evaluated fast.

A density is ``d(x) = sum_i w_i (K(x; x_i) + K(x; x_i M)) / 2`` with weights that sum to 1, M the jaw's turn
(right multiplication by half a turn about tool z); a row that is not symmetric has no twin. Unit: 1/(m^3
rad^3), see `kernels`.

Error. Against the float64 sum over every row, see `GraspDensity.log_density`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from .._compiled import isotropic, nearest
from ..kernels.isotropic import HAAR_VOLUME, IsotropicKernel
from ..se3 import Floats, Poses
from .cell_list import Cells
from .importance_weights import effective_sample_size
from .rows import Rows

__all__ = ["CUTOFF", "TWIN_ROTATION", "WIDE_ROTATION", "GraspDensity"]

#: Default cut-off in standard deviations of position.
CUTOFF = 4.0
#: From these rotation widths on, both twins are summed, and their antipodes too; below the first, the nearer
#: twin stands for both. At the limits what is neglected is below 1e-3 of one kernel's mass.
TWIN_ROTATION, WIDE_ROTATION = math.radians(20.5), math.radians(28.0)
#: Concentrations that float32 is fine enough for, that need only the nearer twin, and no antipodes.
_FLOAT32_KAPPA, _NEARER_KAPPA, _TWINS_KAPPA = 130.0, 85.0, 30.0
#: From sums this large on, exponents are small enough for float32.
_FLOAT32_SUM = 1e-9
_CUTOFF_LIMITS = (2.0, 10.0)
_QUERY_BLOCK = 1024


class GraspDensity:
    """An immutable density. Use `build` and `extend`; every method is safe to call from several threads."""

    def __init__(self, kernel: IsotropicKernel, rows: Rows, cells: Cells, unit: float) -> None:
        self._kernel = kernel
        self._rows = rows
        self._cells = cells
        self._unit = unit
        self._total = float(rows.weights.sum())

    # -- building

    @classmethod
    def build(
        cls,
        poses: Poses,
        *,
        kernel: IsotropicKernel,
        weights: ArrayLike | None = None,
        symmetric: ArrayLike | bool = True,
    ) -> GraspDensity:
        """Build from grasps in the object frame.

        Parameters
        ----------
        poses : (N), at least one
        kernel
            Widths.
        weights : (N,) or None
            Positive, in any unit; normalised to sum to 1. None: equal.
        symmetric : bool or (N,)
            Whether the row's jaw is mirror-symmetric.

        Raises
        ------
        ValueError
            For wrong shapes, values that are not finite, weights that are not positive, or no row.
        """
        if not len(poses):
            raise ValueError("a density needs at least one grasp")
        rows = Rows.of(poses, weights, symmetric)
        unit = float(rows.weights.mean())
        return cls(kernel, rows, Cells.build(rows.over(unit), kernel.sigma_position_m), unit)

    def extend(
        self,
        poses: Poses,
        weights: ArrayLike | None = None,
        symmetric: ArrayLike | bool = True,
    ) -> GraspDensity:
        """A density with further rows, weights in the unit of the first ones (None: their mean).

        Equal to building from all rows within 1e-5 of the density. The cost is that of the rows added and a
        copy.
        """
        if not len(poses):
            return self
        more = Rows.of(poses, weights, symmetric, fill=self._total / self.size)
        cells = self._cells.extend(more.over(self._unit))
        return GraspDensity(self._kernel, self._rows.joined(more), cells, self._unit)

    def reweighted(self, weights: ArrayLike) -> GraspDensity:
        """The same rows with other weights (N,), in the unit of the first ones; for the cost of a copy.

        ValueError for weights that are not positive and finite.
        """
        rows = Rows.of(self.poses, weights, self.symmetric)
        cells = self._cells.reweighted(rows.over(self._unit).twin_weights)
        return GraspDensity(self._kernel, rows, cells, self._unit)

    # -- what it holds

    @property
    def kernel(self) -> IsotropicKernel:
        return self._kernel

    @property
    def isotropic(self) -> GraspDensity:
        """Itself: a mixture's is the density under the isotropic kernel nearest to its own."""
        return self

    @property
    def size(self) -> int:
        """Rows; the twins of symmetric ones are not counted."""
        return len(self.poses)

    @property
    def rows(self) -> Rows:
        """Poses, weights summing to 1 and symmetry, read-only use."""
        return self._rows.over(self._total)

    @property
    def poses(self) -> Poses:
        """(N), read-only use."""
        return self._rows.poses

    @property
    def positions(self) -> Floats:
        """(N, 3) metres, read-only use."""
        return self.poses.positions

    @property
    def quaternions_xyzw(self) -> Floats:
        """(N, 4), read-only use."""
        return self.poses.quaternions_xyzw

    @property
    def weights(self) -> Floats:
        """(N,) summing to 1."""
        return np.asarray(self._rows.weights / self._total, dtype=np.float64)

    @property
    def raw_weights(self) -> Floats:
        """(N,) in the unit of the cells, of about 1."""
        return np.asarray(self._rows.weights / self._unit, dtype=np.float64)

    @property
    def symmetric(self) -> NDArray[np.bool_]:
        """(N,) whether a row has a twin."""
        return self._rows.symmetric

    @property
    def effective_sample_size(self) -> float:
        """(sum w)^2 / sum w^2."""
        return effective_sample_size(self._rows.weights)

    @property
    def nbytes(self) -> int:
        """Bytes of every array held."""
        return self._rows.nbytes + self._cells.nbytes

    @property
    def cells(self) -> Cells:
        """The sorted kernels, for the compiled loops of this package."""
        return self._cells

    @property
    def wide(self) -> int:
        """Which terms of a kernel are summed, as `compiled` counts them."""
        width = self._kernel.sigma_rotation
        return int(width > TWIN_ROTATION) + int(width > WIDE_ROTATION)

    @property
    def log_unit(self) -> float:
        """What turns the log of a compiled kernel sum into a log density."""
        return self._kernel.log_peak - math.log(self._total / self._unit)

    # -- evaluation

    def log_density(self, poses: Poses, *, cutoff: float | None = CUTOFF, threads: int = 1) -> Floats:
        """Log density at poses, nats of 1/(m^3 rad^3), finite and right however far from data.

        Parameters
        ----------
        poses : (M)
        cutoff
            Kernels nearer than this many standard deviations of position are summed; those beyond too
            wherever they might matter (`stages`). None: all.
        threads
            At most this many, of the package's own pool.

        Notes
        -----
        Error of the density against the float64 sum over every row with a cut-off of 4 or 5, measured on an
        ellipsoid shell of 2,000 to 160,000 rows, widths of 5 to 50 mm and 5 to 60 degrees: about one kernel
        width from rows median below 4e-5, 99 of 100 below 5e-4, most 2e-3. Two and a half widths out, where a
        few rows are all there is, 99 of 100 below 4e-3 and most 3e-2: poses turned half way between the twins
        of those rows, of which the nearer one stands for both up to 20.5 degrees. Poses further than any
        cut-off are summed without one, as all are where there is none: there the error is 2e-5, or 1e-6 of
        what the log density lies below the kernel's peak if that is more, from rounding to float32.
        """
        cells, kappa = self._cells.arrays, self._kernel.kappa
        steps = stages(self._kernel, cutoff)
        terms, least = brute_terms(self._kernel, self._total / self._unit)
        # The least weight there can be bounds what skipping far blocks may lose.
        margin = 16.0 + math.log(self._total / float(self._rows.weights.min()))

        def loop(p: Floats, q: Floats, out: Floats) -> None:
            if len(steps):
                isotropic.log_sums(cells, p, q, kappa, steps, self.wide, margin, out)
            else:
                isotropic.all_log_sums(cells, p, q, kappa, terms, least, margin, out)

        return self._cells.at_poses(loop, poses, block=_QUERY_BLOCK, threads=threads) + self.log_unit

    def density(self, poses: Poses, *, cutoff: float | None = CUTOFF, threads: int = 1) -> Floats:
        """Density at poses, 1/(m^3 rad^3); underflows to 0 only below 1e-300."""
        return np.exp(self.log_density(poses, cutoff=cutoff, threads=threads))

    def kernel_sums(self, poses: Poses, *, cutoff: float, threads: int = 1) -> Floats:
        """Kernel sums (M,) within a cut-off, 0 where nothing is in reach."""
        cells, kappa, radius = self._cells.arrays, self._kernel.kappa, scaled_radius(cutoff)

        def loop(p: Floats, q: Floats, out: Floats) -> None:
            isotropic.sums(cells, p, q, kappa, radius, self.wide, out)

        return self._cells.at_poses(loop, poses, block=16, threads=threads)

    def nearest_rows(self, pose: Poses, count: int) -> NDArray[np.intp]:
        """The ``count`` rows, or all if there are fewer, whose kernels are highest at one pose with weights
        left out: the nearest in the kernel's own measure, nearest first.
        """
        cells, kernel = self._cells, self._kernel
        count = min(count, self.size)
        best, places = np.empty(count), np.empty(count, dtype=np.int64)
        radius = scaled_radius(CUTOFF)
        nearest.nearest_rows(cells.arrays, *pose, kernel.kappa, radius, best, places)
        # Nothing outside the ball has an exponent above that of its surface.
        if best[-1] > -radius * radius:
            return np.asarray(cells.rows[places], dtype=np.intp)
        twins = np.where(self.symmetric, kernel.log_kernel(pose, self.poses.turned()), -np.inf)
        value = np.maximum(kernel.log_kernel(pose, self.poses), twins)
        highest = np.argpartition(-value, count - 1)[:count]
        return np.asarray(highest[np.argsort(-value[highest], kind="stable")])

    def nearest_each(self, poses: Poses, *, within: float) -> tuple[NDArray[np.intp], Floats]:
        """The row nearest to every one of M poses, in the kernel's own measure.

        Returns
        -------
        rows : (M,)
            -1 where no row's position is within so many standard deviations.
        distance : (M,)
            In standard deviations, position and rotation together: ``sqrt(-2 e)`` of the kernel's exponent e;
            inf where there is no row.
        """
        cells = self._cells
        best, places = np.empty(len(poses)), np.empty(len(poses), dtype=np.int64)
        radius = within / math.sqrt(2.0)
        nearest.nearest_each(cells.arrays, *poses, self._kernel.kappa, radius, best, places)
        found = places >= 0
        rows = np.where(found, cells.rows[places], -1).astype(np.intp)
        return rows, np.where(found, np.sqrt(np.maximum(-2.0 * best, 0.0)), np.inf)

    # -- sampling

    def sample(self, count: int, rng: np.random.Generator) -> Poses:
        """Draw grasps, both twins of symmetric rows alike."""
        if count < 0:
            raise ValueError(f"cannot draw {count} samples")
        edges = np.cumsum(self._rows.weights)
        row = np.minimum(np.searchsorted(edges, rng.random(count) * edges[-1], side="right"), self.size - 1)
        return self._displaced(
            self.poses[row].turned(self._rows.symmetric[row] & (rng.random(count) < 0.5)), rng
        )

    def sample_rows(self, rows: NDArray[np.integer], rng: np.random.Generator) -> Poses:
        """A draw from the kernel of each of some rows, their twins left out."""
        return self._displaced(self.poses[rows], rng)

    def _displaced(self, centres: Poses, rng: np.random.Generator) -> Poses:
        move, turn = self._kernel.sample_displacements(len(centres), rng)
        return Poses(centres.positions + move, se3.multiply(centres.quaternions_xyzw, turn))


def brute_terms(kernel: IsotropicKernel, total: float) -> tuple[int, float]:
    """Which terms brute force has to sum, and from which sum on it is right within 1e-5.

    A farther twin has a cosine of at most 1 / sqrt(2) and an antipode of at most 0, so all that is left out
    is at most ``total`` (the sum of weights) times their kernel. Rotations narrower than 10 degrees take
    float64: rounding to float32 costs 6e-8 times kappa.
    """
    kappa = kernel.kappa
    if kappa > _FLOAT32_KAPPA:
        return 2, math.inf
    if kappa > _NEARER_KAPPA:
        return 0, max(_FLOAT32_SUM, 1e5 * total * math.exp(-(1.0 - math.sqrt(0.5)) * kappa))
    if kappa > _TWINS_KAPPA:
        return 1, max(_FLOAT32_SUM, 1e5 * total * math.exp(-kappa))
    return 2, _FLOAT32_SUM


def stages(kernel: IsotropicKernel, cutoff: float | None) -> Floats:
    """Radii to try and when to trust them, for `isotropic.log_sums`; shape (T, 3).

    What a cut at c standard deviations leaves out weighs at most exp(-c^2 / 2) a kernel. That is too much
    where the kernels inside are themselves far away: on the fringe of data, which shows in their mean
    exponent of position (3/2 inside a cloud, 1 on a surface, c^2 / 2 at the cut); and where the pose's
    rotation is unlike all around, which shows in their mean value (compared with that at a uniformly random
    rotation). Such poses are taken again with a larger radius and, if that does not help, without one.
    """
    if cutoff is None:
        return np.empty((0, 3))
    # Mean of the rotation's factor, 1 at its peak, over all rotations.
    random = math.exp(-1.5 * math.log(2.0 * math.pi * kernel.sigma_position_m**2) - kernel.log_peak)
    random /= HAAR_VOLUME
    scaled_radius(cutoff)
    return trusted_stages(cutoff, random, lambda reach: reach / math.sqrt(2.0))


def trusted_stages(cutoff: float, random: float, radius: Callable[[float], float]) -> Floats:
    """`stages` by the mean of the rotation's factor over all rotations and the scaled radius of a reach in
    standard deviations.
    """
    rows = []
    for reach in (cutoff, 1.4 * cutoff):
        mean_exponent = max(0.5 * reach * reach - 5.8, 2.2)
        # The kernels that one larger ball adds grow as its volume, at worst.
        least = 0.04 * random * math.exp(8.0 - 0.5 * reach * reach)
        rows.append((radius(reach), mean_exponent, least))
    return np.array(rows)


def scaled_radius(cutoff: float) -> float:
    """A cut-off in standard deviations as a length of the compiled loops.

    Raises
    ------
    ValueError
        Outside 2 to 10.
    """
    if not (math.isfinite(cutoff) and _CUTOFF_LIMITS[0] <= cutoff <= _CUTOFF_LIMITS[1]):
        raise ValueError(f"cutoff must be between 2 and 10 standard deviations or None, not {cutoff!r}")
    return cutoff / math.sqrt(2.0)
