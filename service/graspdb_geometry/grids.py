"""Grids of grasp poses: positions on a cubic lattice times rotations on a Hopf grid.

Rotations follow Yershova, Jain, LaValle and Mitchell, "Generating uniform incremental grids on SO(3) using
the Hopf fibration" (IJRR 2010): the sphere of approach directions is divided by HEALPix (Górski et al.,
"HEALPix: a framework for high-resolution discretization", ApJ 622, 2005, eq 4 to 9) and the turn about the
approach by equal steps.  A pose is identified by one integer, its index in the whole grid, so that a sweep
can be cut into chunks, sampled and repeated without anyone storing poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from graspdb_geometry.permutation import SeededPermutation

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MIN_ROTATION_STEP_DEG = 1.0
MAX_ROTATION_STEP_DEG = 90.0
MIN_POSITION_STEP_M = 1e-4
MAX_POSITION_STEP_M = 1.0
MAX_MARGIN_M = 10.0
MAX_COORDINATE_M = 100.0
#: Indices must fit a signed 64-bit integer with room to spare.
MAX_FULL_TOTAL = 2**60
#: A position this share of a step outside the box still counts as inside: meshes are stored as float32, whose
#: rounding must not decide whether a lattice plane that touches the box belongs to the grid.
_EDGE_TOLERANCE_STEPS = 1e-3


@dataclass(frozen=True)
class HopfGrid:
    """Rotations of a Hopf grid, addressed by ``pixel * psi_count + psi_index``.

    Attributes
    ----------
    nside : int
        HEALPix resolution; there are ``12 nside^2`` approach directions and ``6 nside`` turns about each,
        so that both are spaced by about 60 / nside degrees.
    pixel_quaternions : (12 nside^2, 4) float64
        xyzw, the rotation Rz(phi) Ry(theta) Rz(-phi), which tilts z into the pixel's centre without a twist.
    half_turns : (6 nside, 2) float64
        Sine and cosine of half of each turn psi = 2 pi k / (6 nside) about the tool's z axis.
    """

    nside: int
    pixel_quaternions: FloatArray
    half_turns: FloatArray

    @property
    def pixel_count(self) -> int:
        """Number of approach directions."""
        return 12 * self.nside**2

    @property
    def psi_count(self) -> int:
        """Turns about each approach direction; even, so the jaw's half turn maps the grid onto itself."""
        return 6 * self.nside

    @property
    def size(self) -> int:
        """Number of rotations, ``72 nside^3``."""
        return self.pixel_count * self.psi_count

    def quaternions(self, rotation_indices: npt.ArrayLike) -> FloatArray:
        """Quaternions of the given rotations.

        Only products and sums of two tables enter, so a rotation has the same bits in whatever array it is
        asked for.

        Parameters
        ----------
        rotation_indices : (n,) int
            In [0, size).

        Returns
        -------
        (n, 4) float64
            Unit quaternions xyzw.
        """
        index = np.asarray(rotation_indices, dtype=np.int64)
        pixel, turn = np.divmod(index, self.psi_count)
        x, y, z, w = self.pixel_quaternions[pixel].T
        s, c = self.half_turns[turn].T
        return np.stack([x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s], axis=-1)

    def twin(self, rotation_indices: npt.ArrayLike) -> IntArray:
        """Index of each rotation after the jaw's half turn about its own z axis."""
        index = np.asarray(rotation_indices, dtype=np.int64)
        pixel, turn = np.divmod(index, self.psi_count)
        twins: IntArray = pixel * self.psi_count + (turn + self.psi_count // 2) % self.psi_count
        return twins


def healpix_centres(nside: int) -> tuple[FloatArray, FloatArray]:
    """Centres of the HEALPix pixels in ring order (Górski et al. 2005, eq 4 to 9).

    Parameters
    ----------
    nside : int
        Resolution, at least 1.

    Returns
    -------
    cos_theta, phi : (12 nside^2,) float64
        Cosine of the colatitude, and longitude in [0, 2 pi).
    """
    cosines = []
    longitudes = []
    for ring in range(1, 4 * nside):
        mirrored = 4 * nside - ring
        if ring < nside or mirrored < nside:  # polar caps: ring i holds 4 i pixels
            i = min(ring, mirrored)
            z = 1.0 - i * i / (3.0 * nside * nside)
            z = z if ring < nside else -z
            phi = (np.pi / (2 * i)) * (np.arange(1, 4 * i + 1) - 0.5)
        else:  # equatorial belt: every second ring is shifted by half a pixel
            z = 4.0 / 3.0 - 2.0 * ring / (3.0 * nside)
            shift = 0.5 if (ring - nside) % 2 == 0 else 1.0
            phi = (np.pi / (2 * nside)) * (np.arange(1, 4 * nside + 1) - shift)
        cosines.append(np.full(phi.size, z))
        longitudes.append(phi)
    return np.concatenate(cosines), np.concatenate(longitudes)


def nside_of_step(step_deg: float) -> int:
    """HEALPix resolution whose spacing is nearest to a step: ``round(60 / step_deg)``, at least 1.

    Raises
    ------
    ValueError
        If the step is not within [1, 90] degrees; finer grids would hold more than 15 million rotations.
    """
    step = _finite("rotation_step_deg", step_deg)
    if not MIN_ROTATION_STEP_DEG <= step <= MAX_ROTATION_STEP_DEG:
        raise ValueError(
            f"rotation_step_deg must lie between {MIN_ROTATION_STEP_DEG:g} and {MAX_ROTATION_STEP_DEG:g}"
        )
    return max(1, round(60.0 / step))


@lru_cache(maxsize=8)
def hopf_grid(step_deg: float) -> HopfGrid:
    """Build the Hopf grid nearest to a step in degrees; 15 degrees give nside 4 and 4,608 rotations."""
    nside = nside_of_step(step_deg)
    cos_theta, phi = healpix_centres(nside)
    half_theta = 0.5 * np.arccos(np.clip(cos_theta, -1.0, 1.0))
    # Rz(phi) Ry(theta) Rz(-phi) turns about the axis (-sin phi, cos phi, 0).
    pixels = np.stack(
        [
            -np.sin(half_theta) * np.sin(phi),
            np.sin(half_theta) * np.cos(phi),
            np.zeros_like(phi),
            np.cos(half_theta),
        ],
        axis=-1,
    )
    count = 6 * nside
    half_psi = np.pi * np.arange(count) / count
    turns = np.stack([np.sin(half_psi), np.cos(half_psi)], axis=-1)
    pixels.setflags(write=False)
    turns.setflags(write=False)
    return HopfGrid(nside, pixels, turns)


@dataclass(frozen=True)
class PoseGrid:
    """The poses of a sweep, in a fixed order, without storing them.

    Positions are the integer multiples of ``position_step_m`` (object frame) inside the mesh's bounding box
    plus the margin, x slowest; each is combined with every rotation of the Hopf grid.  The full index of a
    pose is ``position_index * n_rotations + rotation_index`` and depends on box, steps and margin only: a
    region, the jaw's symmetry and ``max_poses`` choose among the same indices.

    Parameters
    ----------
    lower, upper : (3,) float
        The mesh's bounding box, metres, object frame.
    position_step_m, rotation_step_deg, margin_m : float
        Lattice step, spacing of the rotations, and how far positions reach beyond the box.
    symmetric : bool
        The gripper is symmetric: simulate only psi < pi.
    max_poses : int or None
        Take this many poses at random: a prefix of a permutation, so a larger number with the same seed
        contains the smaller plan.
    seed : int
        Of that permutation, [0, 2^63).
    region : ((3,), (3,)) or None
        Keep only positions in this box, metres, object frame.

    Raises
    ------
    ValueError
        Naming the field that is out of range, or that no position is left.
    """

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    position_step_m: float = 0.01
    rotation_step_deg: float = 15.0
    margin_m: float = 0.02
    symmetric: bool = True
    max_poses: int | None = None
    seed: int = 0
    region: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None

    def __post_init__(self) -> None:
        """Check every field, so that a bad grid fails where it is made."""
        if isinstance(self.seed, bool) or not 0 <= self.seed < 2**63:
            raise ValueError("seed must lie in [0, 2^63)")
        if self.max_poses is not None and (isinstance(self.max_poses, bool) or self.max_poses < 1):
            raise ValueError("max_poses must be at least 1")
        if self.full_total > MAX_FULL_TOTAL:
            raise ValueError("position_step_m is too small for this box: the grid exceeds 2^60 poses")

    @cached_property
    def _lattice(self) -> _Lattice:
        step = _finite("position_step_m", self.position_step_m)
        if not MIN_POSITION_STEP_M <= step <= MAX_POSITION_STEP_M:
            raise ValueError(
                f"position_step_m must lie between {MIN_POSITION_STEP_M:g} and {MAX_POSITION_STEP_M:g} metres"
            )
        margin = _finite("margin_m", self.margin_m)
        if not 0.0 <= margin <= MAX_MARGIN_M:
            raise ValueError(f"margin_m must lie between 0 and {MAX_MARGIN_M:g} metres")
        lower, upper = _box("lower, upper", self.lower, self.upper)
        first, last = _lattice_range(lower - margin, upper + margin, step)
        if np.any(last < first):
            raise ValueError(
                "position_step_m is too large: no multiple of it lies inside the box plus margin_m"
            )
        kept_first, kept_last = first, last
        if self.region is not None:
            low, high = _lattice_range(*_box("region", self.region[0], self.region[1]), step)
            kept_first, kept_last = np.maximum(first, low), np.minimum(last, high)
            if np.any(kept_last < kept_first):
                raise ValueError("region contains no position of the grid")
        return _Lattice(first, last - first + 1, kept_first - first, kept_last - kept_first + 1)

    @property
    def rotations(self) -> HopfGrid:
        """The rotation grid."""
        return hopf_grid(float(self.rotation_step_deg))

    @property
    def rotation_count(self) -> int:
        """Rotations of the full grid, both of each jaw-symmetric pair."""
        return 72 * nside_of_step(self.rotation_step_deg) ** 3

    @property
    def position_count(self) -> int:
        """Positions kept, inside the region if there is one."""
        return _product(self._lattice.kept_shape)

    @property
    def full_total(self) -> int:
        """Poses of the whole grid: the range of pose indices, before region, symmetry and ``max_poses``."""
        return _product(self._lattice.shape) * self.rotation_count

    @property
    def candidate_total(self) -> int:
        """Poses left by region and symmetry, before ``max_poses``."""
        return self.position_count * self._kept_rotations

    @property
    def total(self) -> int:
        """Poses of the plan, after region, symmetry and ``max_poses``."""
        return self.candidate_total if self.max_poses is None else min(self.max_poses, self.candidate_total)

    @property
    def volume_m3(self) -> float:
        """Volume V that the kept positions stand for, each a cube of one step.

        A pose of this grid has the proposal density 1 / (8 pi^2 V) in 1/(m^3 rad^3).
        """
        return float(self.position_count * float(self.position_step_m) ** 3)

    @property
    def _kept_rotations(self) -> int:
        return self.rotation_count // 2 if self.symmetric else self.rotation_count

    @cached_property
    def _permutation(self) -> SeededPermutation:
        return SeededPermutation(self.candidate_total, self.seed)

    def pose_indices(self, start: int, stop: int) -> IntArray:
        """Full-grid indices of the poses start..stop of the plan.

        Without ``max_poses`` the plan is in index order; with it, in the order of the seeded permutation, and
        each requested range is sorted.

        Parameters
        ----------
        start, stop : int
            A range within [0, total].

        Returns
        -------
        (stop - start,) int64
            Ascending.
        """
        if not 0 <= start <= stop <= self.total:
            raise ValueError(f"start and stop must satisfy 0 <= start <= stop <= {self.total}")
        rank = np.arange(start, stop, dtype=np.int64)
        if self.max_poses is not None:
            rank = np.sort(self._permutation(rank))
        lattice = self._lattice
        position, rotation = np.divmod(rank, self._kept_rotations)
        ix, iy, iz = np.unravel_index(position, tuple(int(n) for n in lattice.kept_shape))
        ix, iy, iz = ix + lattice.kept_offset[0], iy + lattice.kept_offset[1], iz + lattice.kept_offset[2]
        position = (ix * lattice.shape[1] + iy) * lattice.shape[2] + iz
        if self.symmetric:
            half = 3 * nside_of_step(self.rotation_step_deg)
            pixel, turn = np.divmod(rotation, half)
            rotation = pixel * (2 * half) + turn
        indices: IntArray = position * self.rotation_count + rotation
        return indices

    def poses(self, pose_indices: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Poses of full-grid indices, the tool frame in the object frame.

        Parameters
        ----------
        pose_indices : (n,) int
            In [0, full_total); they need not belong to the plan.

        Returns
        -------
        positions : (n, 3) float64
            Metres.
        quaternions : (n, 4) float64
            Unit quaternions xyzw.
        """
        index = np.asarray(pose_indices, dtype=np.int64).reshape(-1)
        if index.size and (int(index.min()) < 0 or int(index.max()) >= self.full_total):
            raise ValueError(f"pose_index must lie in [0, {self.full_total})")
        lattice = self._lattice
        position, rotation = np.divmod(index, self.rotation_count)
        cell = np.stack(np.unravel_index(position, tuple(int(n) for n in lattice.shape)), axis=-1)
        positions = np.asarray(cell + lattice.first, dtype=np.float64) * float(self.position_step_m)
        return positions, self.rotations.quaternions(rotation)


class _Lattice(NamedTuple):
    """Integer ranges of the position lattice, x, y, z each."""

    first: IntArray
    shape: IntArray
    kept_offset: IntArray
    kept_shape: IntArray


def _lattice_range(lower: FloatArray, upper: FloatArray, step: float) -> tuple[IntArray, IntArray]:
    first: IntArray = np.ceil(lower / step - _EDGE_TOLERANCE_STEPS).astype(np.int64)
    last: IntArray = np.floor(upper / step + _EDGE_TOLERANCE_STEPS).astype(np.int64)
    return first, last


def _product(sizes: IntArray) -> int:
    # In Python integers: NumPy's product would wrap around without a word.
    return int(sizes[0]) * int(sizes[1]) * int(sizes[2])


def _finite(name: str, value: float) -> float:
    number = float(value)
    if not np.isfinite(number):
        raise ValueError(f"{name} must be finite")
    return number


def _box(name: str, lower: npt.ArrayLike, upper: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    low = np.asarray(lower, dtype=np.float64)
    high = np.asarray(upper, dtype=np.float64)
    if low.shape != (3,) or high.shape != (3,):
        raise ValueError(f"{name} must be two corners of three numbers each")
    if not (np.all(np.isfinite(low)) and np.all(np.isfinite(high))):
        raise ValueError(f"{name} must be finite")
    if np.any(np.abs(low) > MAX_COORDINATE_M) or np.any(np.abs(high) > MAX_COORDINATE_M):
        raise ValueError(f"{name} must lie within {MAX_COORDINATE_M:g} m of the origin")
    if np.any(low > high):
        raise ValueError(f"{name}: the lower corner must not exceed the upper one")
    return low, high
