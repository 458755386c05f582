"""Rows of grasps under one kernel, evaluated under many weightings at once.

`GraspDensity` answers queries under one weighting, fast. Statistics ask for the same kernels under other
weights (bootstrap replicates, subsets, left-out blocks) and for kernels that are not isotropic: a Gaussian or
a mixture of Gaussians over the displacement ``xi = (F_i^T (p - p_i), Log(q_i^-1 q))`` (metres, radians) with
F_i a frame for every row, the gripper's own axes by default. The kernel matrix (poses x rows) is never
stored: an entry is used where it arises.

Error. Entries further than ``CUTOFF`` standard deviations of position or below ``LEAST`` of the largest are
dropped: a similarity by eq 9 rises by about 1e-4 for it. Values are float32, within 1e-5.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from .._compiled import weighted
from .._compiled.threads import for_blocks
from ..kernels.gaussian_mixture import AnisotropicKernel, Kernel
from ..kernels.isotropic import IsotropicKernel
from ..se3 import Floats, Poses
from .cell_list import Cells
from .isotropic import GraspDensity
from .rows import Rows

__all__ = ["CUTOFF", "TRUSTED_SUM", "KernelRows", "Progress"]

#: Kernels further than this many standard deviations of position are dropped.
CUTOFF = 5.0
#: Kernel values not above this share of the largest are dropped.
LEAST = 1e-6
#: Mixture sums below this many smallest weights are taken again without a cut-off.
TRUSTED_SUM = 1e-2
_POSE_BLOCK = 512
#: Wider than this, a row's farther twin and its antipodes add more than 1e-4 of a kernel.
_WIDE_ROTATION = math.radians(20.0)

#: Called with the share done, in [0, 1]; an exception it raises cancels the work and reaches the caller.
Progress = Callable[[float], None]


class KernelRows:
    """Grasps sorted for evaluation under one kernel. Immutable; safe to use from several threads.

    Parameters
    ----------
    rows : (N), at least one
        Weights in any unit.
    kernel
    frames : (N, 3, 3) or (3, 3) or None
        Columns are the axes that translations are measured along, object frame; required by a kernel whose
        frame is ``fixed``, refused by every other.

    Raises
    ------
    ValueError
        For no rows, wrong frames, or frames that do not fit the kernel.
    """

    def __init__(self, rows: Rows, kernel: Kernel, *, frames: ArrayLike | None = None) -> None:
        if not len(rows):
            raise ValueError("statistics of a density need at least one grasp")
        self.kernel = kernel
        self.rows = rows.over(float(rows.weights.sum()))
        #: Whether the axes of translations turn with the jaw: they are each row's gripper's.
        self.turning = frames is None
        self._frames = None if frames is None else _frames(frames, len(rows))
        if isinstance(kernel, IsotropicKernel):
            self._reach = CUTOFF * kernel.sigma_position_m
            self.log_unit = kernel.log_peak
            return
        if self.turning != (kernel.frame == "gripper"):
            need = "takes no frames" if kernel.frame == "gripper" else "needs frames"
            raise ValueError(f"a kernel in the {kernel.frame} frame {need}")
        along, _ = kernel.widest
        self._reach = float(np.max(np.linalg.norm(kernel.means[:, :3], axis=1) + CUTOFF * along))
        self.log_unit = float(kernel.log_peaks.max())
        self.mixture = _compiled_mixture(kernel)
        #: Far from every row a rotation by the other vector may be the nearer one.
        self.exact_mixture = self.mixture._replace(wraps=True)

    @cached_property
    def frames(self) -> Floats:
        """(N, 3, 3) axes that translations are measured along."""
        return se3.to_matrix(self.poses.quaternions_xyzw) if self._frames is None else self._frames

    @cached_property
    def _cells(self) -> Cells:
        # Made on demand: densities of their own keep other cells.
        return Cells.build(Rows.of(self.poses, symmetric=self.symmetric), self._reach / CUTOFF)

    @cached_property
    def _sorted_frames(self) -> NDArray[np.float32]:
        return np.ascontiguousarray(self.frames.reshape(-1, 9)[self._cells.rows].T, dtype=np.float32)

    @cached_property
    def exact(self) -> weighted.MixtureRows:
        """The rows in float64, as the sum without a cut-off takes them."""
        return weighted.MixtureRows(
            self.poses.positions,
            self.poses.quaternions_xyzw,
            np.ascontiguousarray(self.frames.reshape(-1, 9)),
            self.symmetric,
            np.log(self.rows.twin_weights),
            self.turning,
        )

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held, those made on demand included."""
        made = [
            self.__dict__[name] for name in ("frames", "_sorted_frames", "_cells") if name in self.__dict__
        ]
        return int(self.rows.nbytes + sum(part.nbytes for part in made))

    @property
    def poses(self) -> Poses:
        return self.rows.poses

    @property
    def weights(self) -> Floats:
        """(N,) summing to 1."""
        return self.rows.weights

    @property
    def symmetric(self) -> NDArray[np.bool_]:
        """(N,) whether a row has a twin."""
        return self.rows.symmetric

    @property
    def size(self) -> int:
        """Rows; twins are not counted."""
        return len(self.rows)

    def subset(self, rows: NDArray[np.int64]) -> KernelRows:
        """The rows given, weights renormalised."""
        frames = None if self._frames is None else self._frames[rows]
        return KernelRows(self.rows[rows], self.kernel, frames=frames)

    # -- evaluation

    def sums(
        self,
        poses: Poses,
        weightings: NDArray[np.floating],
        *,
        least: float = LEAST,
        threads: int = 1,
        progress: Progress | None = None,
    ) -> NDArray[np.float32]:
        """Kernel sums ``K V`` at poses.

        Parameters
        ----------
        poses : (M)
        weightings : (N, B)
            V, one column a weighting of the rows.
        least : float
            Kernel values not above this share of the largest are dropped.
        progress
            May be called from several threads, one at a time.

        Returns
        -------
        (M, B) float32
            In units of ``exp(log_unit)`` 1/(m^3 rad^3).
        """
        p, q = poses
        if weightings.ndim != 2 or len(weightings) != self.size:
            raise ValueError(f"weightings have shape ({self.size}, B), not {weightings.shape}")
        cells, padded = self._cells, self._padded(weightings)
        out = np.empty((len(p), padded.shape[1]), dtype=np.float32)
        # Neighbours one after the other find their rows' weights in the cache.
        order = np.lexsort(np.floor(p.T / self._reach))
        p, q = p[order], q[order]
        radius = self._reach * cells.arrays.scale
        done = 0
        guard = threading.Lock()

        def work(begin: int, end: int) -> None:
            nonlocal done
            if isinstance(self.kernel, IsotropicKernel):
                weighted.isotropic_sums(
                    cells.arrays, p[begin:end], q[begin:end], self.kernel.kappa, radius,
                    self.kernel.sigma_rotation > _WIDE_ROTATION, least, padded, out[begin:end],
                )  # fmt: skip
            else:
                weighted.mixture_sums(
                    cells.arrays, self._sorted_frames, self.turning, p[begin:end], q[begin:end],
                    self.mixture.single(), radius, least, padded, out[begin:end],
                )  # fmt: skip
            if progress is not None:
                with guard:
                    done += end - begin
                    progress(done / len(p))

        for_blocks(work, len(p), block=_POSE_BLOCK, threads=threads)
        result = np.empty((len(p), weightings.shape[1]), dtype=np.float32)
        result[order] = out[:, : weightings.shape[1]]
        return result

    def _padded(self, weightings: NDArray[np.floating]) -> NDArray[np.float32]:
        """Weightings of the sorted rows, a twin's share each, filled up to whole vectors."""
        rows = self._cells.rows
        share = np.where(self.symmetric, 0.5, 1.0)[rows]
        width = -(-weightings.shape[1] // weighted.LANES) * weighted.LANES
        padded = np.zeros((self.size, width), dtype=np.float32)
        padded[:, : weightings.shape[1]] = weightings[rows] * share[:, None].astype(np.float32)
        return padded

    def log_density(self, poses: Poses, *, threads: int = 1) -> Floats:
        """Log density at poses, nats of 1/(m^3 rad^3), right however far from every row."""
        if isinstance(self.kernel, IsotropicKernel):
            return self._isotropic(self.kernel).log_density(poses, cutoff=CUTOFF, threads=threads)
        raw = (self.weights / self.weights.mean()).astype(np.float32)[:, None]
        sums = self.sums(poses, raw, least=0.0, threads=threads)[:, 0].astype(np.float64)
        # Where little is left, what lies beyond the cut-off may count as much: those poses are taken again.
        near = sums > TRUSTED_SUM * float(raw.min())
        out = np.empty(len(poses))
        out[near] = np.log(sums[near]) - math.log(self.size) + self.log_unit
        if not near.all():
            out[~near] = self.exact_log_density(poses[~near], threads=threads)
        return out

    def _isotropic(self, kernel: IsotropicKernel) -> GraspDensity:
        """The same rows as a density."""
        return GraspDensity.build(
            self.poses,
            kernel=kernel,
            weights=self.weights,
            symmetric=self.symmetric,
        )

    def exact_log_density(self, poses: Poses, *, threads: int = 1) -> Floats:
        """As `log_density`, over all rows at every pose: for the few that are far from all of them."""
        p, q = poses
        if isinstance(self.kernel, IsotropicKernel):
            return self._isotropic(self.kernel).log_density(poses, cutoff=None, threads=threads)
        values = [
            weighted.mixture_log_sum(self.exact, self.exact_mixture, at, to)
            for at, to in zip(p, q, strict=True)
        ]
        return self.log_unit + np.array(values)

    # -- sampling

    def sample(self, count: int, rng: np.random.Generator) -> Poses:
        """Draw grasps, systematic over rows and with a random mirror.

        One uniform offset places all draws on the cumulated weights, so that every row is drawn its expected
        number of times, rounded up or down: averages over the draws vary less than with independent ones.
        """
        if count < 0:
            raise ValueError(f"cannot draw {count} samples")
        edges = np.cumsum(self.weights)
        steps = (np.arange(count) + rng.random()) / max(count, 1)
        row = np.minimum(np.searchsorted(edges, steps * edges[-1], side="right"), self.size - 1)
        turned = rng.random(count) < 0.5
        return self.displaced(row, turned, self.kernel.sample_displacements(count, rng))

    def displaced(self, row: NDArray[np.intp], turned: NDArray[np.bool_], displacements: Poses) -> Poses:
        """Poses at displacements from rows (n,), along their axes, or from their twins where they are
        ``turned`` and have one.
        """
        turned = turned & self.symmetric[row]
        centre = self.poses[row].turned(turned)
        moves, turns = displacements
        if not isinstance(self.kernel, IsotropicKernel):
            # The twin's own x and y axes point the other way.
            flip = np.where((turned & self.turning)[:, None], np.array([-1.0, -1.0, 1.0]), 1.0)
            moves = np.einsum("nij,nj->ni", self.frames[row], moves * flip)
        return Poses(centre.positions + moves, se3.multiply(centre.quaternions_xyzw, turns))


def _compiled_mixture(kernel: AnisotropicKernel) -> weighted.Mixture:
    """A kernel's components as the compiled loops take them."""
    whitening = np.linalg.inv(np.linalg.cholesky(kernel.covariances)) / math.sqrt(2.0)
    offset = np.einsum("cij,cj->ci", whitening, kernel.means)
    rows, columns = np.tril_indices(6)
    peaks = kernel.log_peaks
    _, about = kernel.widest
    # Beyond pi the same rotation has another vector; it counts where a component reaches that far.
    reach = np.linalg.norm(kernel.means[:, 3:], axis=1) + 5.3 * about
    return weighted.Mixture(
        np.concatenate([whitening[:, rows, columns], offset], axis=1),
        peaks - peaks.max(),
        bool(np.any(reach > math.pi)),
    )


def _frames(frames: ArrayLike, count: int) -> Floats:
    f = np.asarray(frames, dtype=np.float64)
    if f.shape not in ((3, 3), (count, 3, 3)):
        raise ValueError(f"frames have shape ({count}, 3, 3) or (3, 3), not {f.shape}")
    gram = np.einsum("...ji,...jk->...ik", f, f)
    if not np.all(np.abs(gram - np.eye(3)) < se3.UNIT_TOLERANCE):
        raise ValueError("the columns of a frame must be orthonormal")
    return np.array(np.broadcast_to(f, (count, 3, 3)))
