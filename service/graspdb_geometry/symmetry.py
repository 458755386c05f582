"""Symmetries of a surface: an axis of revolution, axes of a few turns, and mirror planes.

Every symmetry of a surface keeps the centroid of its area and its second moments, so axes and normals of
planes are among their principal directions. Where two moments are equal, what lies across the third is found
by harmonics of the azimuth; where all three are, axes are sought where the sixth moment is largest or
smallest. Candidates are then judged by the surface itself: points of it, moved, must lie on it again.

Meshes are polygons and scans are noisy, so a symmetry holds within a tolerance: nearly all of the area must
come to lie within it, and nothing many times as far.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from graspdb_geometry.deviation import DENSE_SAMPLES, distances, surface_samples, to_triangles
from graspdb_geometry.mesh_reading.content import FloatArray

__all__ = ["Axis", "MirrorPlane", "Symmetry", "find_symmetry", "tolerance_of"]

#: A symmetry holds up to the larger of these, metres and a share of the surface's middle size ...
TOLERANCE_M, TOLERANCE_SHARE = 0.5e-3, 0.005
#: ... for this share of the area; the rest lies no farther off than so many tolerances.
_NEARLY_ALL, _STRAY = 0.99, 4.0
#: Points that are moved, of these first some, and triangles of the nearest samples that they are compared to.
_POINTS, _FIRST, _NEAREST = 1_500, 200, 8
#: Moments that differ by less than this share are taken for equal.
_EQUAL = 0.03
#: Turns that no surface of few facets is symmetric under by chance, radians: none is a part of a circle.
_TURNS = (0.37, 0.83, 1.31, 1.97, 2.63)
#: Turns of axes that are looked for, and harmonics of the azimuth that tell planes.
_ORDERS, _HARMONICS = (6, 5, 4, 3, 2), 6
#: Strongest of them that are asked, and how faint one tells nothing beside the strongest.
_TOLD, _FAINT = 3, 1e-4
#: The moment whose extremes are tried as axes, directions in which it is looked at, and most extremes.
_MOMENT, _DIRECTIONS, _EXTREMES, _STEPS = 6, 4_000, 20, 60
#: From so many triangles on each is so small that sums over a few points of it are exact enough.
_MANY = 20_000
#: Most elements of a group without an axis of revolution: an icosahedron's.
_MOST = 120
#: Directions closer than this cosine are one.
_SAME = math.cos(math.radians(8.0))


@dataclass(frozen=True, eq=False)
class Axis:
    """An axis through the centre: unit ``direction`` (3,); ``order`` turns, None for a surface of revolution.

    ``deviation_m``: within it lies all but a hundredth of the turned surface.
    """

    direction: FloatArray
    order: int | None
    deviation_m: float


@dataclass(frozen=True, eq=False)
class MirrorPlane:
    """A mirror plane through the centre: unit ``normal`` (3,), and the deviation as an `Axis` has it."""

    normal: FloatArray
    deviation_m: float


@dataclass(frozen=True, eq=False)
class Symmetry:
    """What moves a surface onto itself.

    Attributes
    ----------
    centre : (3,)
        Centroid of the area, metres: on every axis and plane.
    axes
        That of revolution first, then by order.
    planes
        Beside an axis of revolution only the plane across it: every plane through the axis is one, too.
    ball
        Whether every line through the centre is an axis; ``axes`` has one of them.
    tolerance_m
        Up to where it holds.
    """

    centre: FloatArray
    axes: tuple[Axis, ...]
    planes: tuple[MirrorPlane, ...]
    ball: bool
    tolerance_m: float

    @property
    def axis(self) -> Axis | None:
        """That of revolution."""
        return next((axis for axis in self.axes if axis.order is None), None)

    def __bool__(self) -> bool:
        return bool(self.axes or self.planes)

    def elements(self, *, mirrors: bool) -> FloatArray:
        """Orthogonal matrices (n, 3, 3) about the centre, the identity first: proper ones, and with
        ``mirrors`` improper ones. Of those about an axis of revolution one of each kind: `about` turns them.
        """
        if self.axis is None:
            found = _closure(_generators(self.axes, self.planes))
        else:
            along = self.axis.direction
            found = [np.eye(3), _mirror(_across(along))]
            found += [_mirror(plane.normal) @ m for plane in self.planes for m in tuple(found)]
        kept = [matrix for matrix in found if mirrors or np.linalg.det(matrix) > 0.0]
        return np.array(kept)

    def about(self, count: int) -> FloatArray:
        """``count`` equal turns (count, 3, 3) about the axis of revolution, the identity first."""
        assert self.axis is not None
        return np.array([_turn(self.axis.direction, math.tau * k / count) for k in range(count)])


def tolerance_of(size_m: float) -> float:
    """Up to where symmetries of a surface of this size hold, metres."""
    return max(TOLERANCE_M, TOLERANCE_SHARE * size_m)


def find_symmetry(corners: npt.ArrayLike, *, seed: int = 0) -> Symmetry:
    """The symmetries of a triangle surface, closed or not; the same input gives the same answer.

    Parameters
    ----------
    corners : (F, 3, 3)
        Triangles, metres.

    Raises
    ------
    ValueError
        For no triangles, or none with an area.
    """
    triangles = np.asarray(corners, dtype=np.float64)
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3) or not len(triangles):
        raise ValueError(f"triangles have shape (F, 3, 3), not {triangles.shape}")
    surface = _Surface(triangles, np.random.default_rng(seed))
    if surface.is_ball():
        up = np.array([0.0, 0.0, 1.0])
        return Symmetry(
            surface.centre, (Axis(up, None, 0.0),), (MirrorPlane(up, 0.0),), True, surface.tolerance
        )
    axes, planes = _found(surface)
    ordered = sorted(axes, key=lambda axis: -math.inf if axis.order is None else -axis.order)
    return Symmetry(surface.centre, tuple(ordered), tuple(planes), False, surface.tolerance)


class _Surface:
    """Triangles about their centroid, and what candidates are judged by.

    ``centre`` (3,): the centroid; ``moments`` (3, 3) of the area about it; ``nodes`` (n, 3) and ``weights``
    (n,): sums over them are means over the area.
    """

    def __init__(self, triangles: FloatArray, rng: np.random.Generator) -> None:
        doubled = np.linalg.norm(
            np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
        )
        triangles, areas = triangles[doubled > 0.0], doubled[doubled > 0.0]
        if not len(areas):
            raise ValueError("no triangle has an area")
        share = areas / areas.sum()
        self.centre = share @ triangles.mean(axis=1)
        self.triangles = triangles - self.centre
        self.nodes, self.weights = _quadrature(self.triangles, share)
        self.moments = np.einsum("n,ni,nj->ij", self.weights, self.nodes, self.nodes)
        # A box's side has this moment, by its length.
        self.tolerance = tolerance_of(math.sqrt(12.0 * float(np.linalg.eigvalsh(self.moments)[1])))
        count = max(DENSE_SAMPLES, 2 * len(areas))
        self._face, self._samples = surface_samples(self.triangles, count, rng)
        self._tree = cKDTree(self._samples)
        chosen = rng.choice(len(areas), _POINTS, p=share)
        inside = rng.dirichlet(np.ones(3), _POINTS)
        self.points = np.einsum("nk,nki->ni", inside, self.triangles[chosen])

    def is_ball(self) -> bool:
        away = np.linalg.norm(self.points, axis=1)
        return float(np.ptp(np.quantile(away, [1.0 - _NEARLY_ALL, _NEARLY_ALL]))) <= self.tolerance

    def deviation(self, matrices: Sequence[FloatArray]) -> float | None:
        """How far the moved surface is off, metres; None where it is not the same within the tolerance."""
        for some in (slice(0, _FIRST), slice(_FIRST, None)):
            off = 0.0
            for matrix in matrices:
                moved = np.concatenate([self.points[some] @ matrix.T, self.points[some] @ matrix])
                apart = self._apart(moved)
                if np.mean(apart > self.tolerance) > 1.0 - _NEARLY_ALL:
                    return None
                if apart.max() > _STRAY * self.tolerance:
                    return None
                off = max(off, float(np.quantile(apart, _NEARLY_ALL)))
        return off

    def _apart(self, points: FloatArray) -> FloatArray:
        """Distances from the surface; exact where they decide."""
        _, nearest = self._tree.query(points, k=_NEAREST)
        best = to_triangles(points[:, None], self.triangles[self._face[nearest]]).min(axis=1)
        doubtful = np.flatnonzero(best > self.tolerance)
        if 0 < len(doubtful) <= 0.1 * len(points):
            best[doubtful] = distances(points[doubtful], self.triangles, self._face, self._samples)
        return np.asarray(best)


def _found(surface: _Surface) -> tuple[list[Axis], list[MirrorPlane]]:
    """Axes and planes of a surface that is no ball."""
    values, vectors = np.linalg.eigh(surface.moments)
    alike = [values[k + 1] - values[k] <= _EQUAL * values[k + 1] for k in range(2)]
    if not any(alike):
        return _about_each(surface, vectors.T)
    if all(alike):
        candidates = [*_extremes(surface), *vectors.T]
    else:
        candidates = [vectors[:, 2] if alike[0] else vectors[:, 0]]
    axes: list[Axis] = []
    planes: list[MirrorPlane] = []
    group = [np.eye(3)]
    looked_at: list[FloatArray] = []
    for direction in candidates:
        if not all(_new(matrix @ direction, looked_at) for matrix in group):
            # A symmetry that is known takes it to one that was looked at.
            continue
        looked_at.append(direction)
        found = _about(surface, direction)
        if any(axis.order is None for axis in found[0]):
            return found
        axes += [axis for axis in found[0] if _new(axis.direction, [a.direction for a in axes])]
        planes += [plane for plane in found[1] if _new(plane.normal, [p.normal for p in planes])]
        group = _closure(_generators(axes, planes))
    return axes, planes


def _about_each(surface: _Surface, directions: FloatArray) -> tuple[list[Axis], list[MirrorPlane]]:
    """Of moments that differ: half turns and planes, for no other turn keeps them."""
    axes, planes = [], []
    for direction in directions:
        off = surface.deviation([_half_turn(direction)])
        if off is not None:
            axes.append(Axis(direction, 2, off))
        off = surface.deviation([_mirror(direction)])
        if off is not None:
            planes.append(MirrorPlane(direction, off))
    return axes, planes


def _about(surface: _Surface, direction: FloatArray) -> tuple[list[Axis], list[MirrorPlane]]:
    """What a direction is the axis of, the plane across it, and what lies across."""
    axes, planes = [], []
    off = surface.deviation([_mirror(direction)])
    if off is not None:
        planes.append(MirrorPlane(direction, off))
    off = surface.deviation([_turn(direction, turn) for turn in _TURNS])
    if off is not None:
        return [Axis(direction, None, off)], planes
    for order in _ORDERS:
        off = surface.deviation([_turn(direction, math.tau / order)])
        if off is not None:
            axes.append(Axis(direction, order, off))
            break
    across = _across_by_harmonics(surface, direction)
    for off, normal in _that_keep(surface, across, _mirror):
        if _new(normal, [plane.normal for plane in planes]):
            planes.append(MirrorPlane(normal, off))
    for off, normal in _that_keep(surface, across, _half_turn):
        if _new(normal, [axis.direction for axis in axes]):
            axes.append(Axis(normal, 2, off))
    return axes, planes


def _that_keep(
    surface: _Surface, directions: Sequence[FloatArray], of: Callable[[FloatArray], FloatArray]
) -> list[tuple[float, FloatArray]]:
    """How far the surface is off, and the direction, of those whose motion keeps it, the nearest first."""
    found = []
    for direction in directions:
        off = surface.deviation([of(direction)])
        if off is not None:
            found.append((off, direction))
    return sorted(found, key=lambda pair: pair[0])


def _across_by_harmonics(surface: _Surface, direction: FloatArray) -> list[FloatArray]:
    """Directions (3,) across an axis that may be normals of planes, or axes of half turns.

    Seen from the azimuth of a plane through the axis every harmonic of the surface is real, from that of an
    axis of half turns that of what lies as far above as below.
    """
    first = _across(direction)
    second = np.cross(direction, first)
    x, y, z = (surface.nodes @ axis for axis in (first, second, direction))
    size = math.sqrt(float(np.trace(surface.moments)))
    told = []
    for order in range(1, _HARMONICS + 1):
        power = ((x + 1j * y) / size) ** order
        for value in (power, power * z / size):
            told.append((abs(surface.weights @ value), order, np.angle(surface.weights @ value)))
    strongest = max(strength for strength, _, _ in told)
    told = sorted((item for item in told if item[0] > _FAINT * strongest), reverse=True)
    found: list[FloatArray] = []
    for _, order, phase in told[:_TOLD]:
        for k in range(2 * order):
            angle = phase / order + math.pi * k / (2 * order)
            normal = math.cos(angle) * first + math.sin(angle) * second
            if all(abs(float(normal @ other)) < 1.0 - 1e-6 for other in found):
                found.append(normal)
    return found


def _extremes(surface: _Surface) -> list[FloatArray]:
    """Directions in which the sixth moment of the area is locally largest or smallest, the clearest first."""
    powers = [(a, b, _MOMENT - a - b) for a in range(_MOMENT + 1) for b in range(_MOMENT + 1 - a)]
    count = [math.factorial(_MOMENT) / math.prod(math.factorial(k) for k in each) for each in powers]
    terms = [np.prod(surface.nodes ** np.array(each), axis=1) for each in powers]
    factors = np.array(count) * np.array([surface.weights @ term for term in terms])

    def moment(directions: FloatArray) -> FloatArray:
        return np.asarray(
            sum(
                f * np.prod(directions ** np.array(each), axis=-1)
                for f, each in zip(factors, powers, strict=True)
            )
        )

    k = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1.0 - k / _DIRECTIONS, math.pi * (1.0 + math.sqrt(5.0)) * k
    around = np.sqrt(1.0 - z * z)
    directions = np.column_stack([around * np.cos(turn), around * np.sin(turn), z])
    both = np.concatenate([directions, -directions])
    values = np.tile(moment(directions), 2)
    near = np.asarray(cKDTree(both).query(directions, k=9)[1])
    beside = values[near[:, 1:]]
    values, middle = values[:_DIRECTIONS], float(np.median(values))
    found = np.flatnonzero((values >= beside.max(axis=1)) | (values <= beside.min(axis=1)))
    found = found[np.argsort(-np.abs(values[found] - middle), kind="stable")]
    chosen: list[FloatArray] = []
    for i in found:
        sign = 1.0 if values[i] > middle else -1.0
        direction = _climbed(moment, sign, directions[i])
        if _new(direction, chosen) and len(chosen) < _EXTREMES:
            chosen.append(direction)
    return chosen


def _climbed(height: Callable[[FloatArray], FloatArray], sign: float, direction: FloatArray) -> FloatArray:
    """A direction (3,) moved to where a function is highest nearby, or lowest by the sign."""
    step = 0.05
    turns = np.arange(12) * (math.tau / 12.0)
    # Along the ridge of an axis of revolution the way never ends.
    for _ in range(_STEPS):
        first = _across(direction)
        second = np.cross(direction, first)
        ring = direction + step * (np.outer(np.cos(turns), first) + np.outer(np.sin(turns), second))
        ring = np.concatenate([direction[None], ring / np.linalg.norm(ring, axis=1, keepdims=True)])
        best = int(np.argmax(sign * height(ring)))
        step = step if best else 0.5 * step
        direction = ring[best]
    return direction


def _quadrature(triangles: FloatArray, share: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) and weights (n,) whose sums are means over the area: of polynomials up to the eighth
    degree, or of many small triangles of the second.
    """
    if len(triangles) > _MANY:
        barycentric, factors = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6.0, np.full(3, 1.0 / 3.0)
    else:
        at, weight = np.polynomial.legendre.leggauss(5)
        at, weight = 0.5 * (at + 1.0), 0.5 * weight
        u, v = (grid.ravel() for grid in np.meshgrid(at, at, indexing="ij"))
        factors = np.outer(weight, weight).ravel() * 2.0 * (1.0 - u)
        barycentric = np.column_stack([u, (1.0 - u) * v, (1.0 - u) * (1.0 - v)])
    nodes = np.einsum("qk,fki->fqi", barycentric, triangles)
    return nodes.reshape(-1, 3), np.outer(share, factors).ravel()


def _generators(axes: Sequence[Axis], planes: Sequence[MirrorPlane]) -> list[FloatArray]:
    turns = [_turn(axis.direction, math.tau / axis.order) for axis in axes if axis.order]
    return [*turns, *(_mirror(plane.normal) for plane in planes)]


def _closure(generators: Sequence[FloatArray]) -> list[FloatArray]:
    """The group that matrices generate, the identity first; at most an icosahedron's."""
    found = np.eye(3)[None]
    fresh = found
    while len(fresh) and len(found) < _MOST:
        known = len(found)
        for generator in generators:
            for matrix in fresh @ generator:
                if len(found) < _MOST and float(np.abs(found - matrix).max(axis=(1, 2)).min()) > 0.1:
                    found = np.concatenate([found, _orthogonal(matrix)[None]])
        fresh = found[known:]
    return list(found)


def _orthogonal(matrix: FloatArray) -> FloatArray:
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ v)


def _new(direction: FloatArray, others: Sequence[FloatArray]) -> bool:
    return all(abs(float(direction @ other)) < _SAME for other in others)


def _turn(direction: FloatArray, angle: float) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(angle * np.asarray(direction)).as_matrix())


def _half_turn(direction: FloatArray) -> FloatArray:
    return _turn(direction, math.pi)


def _mirror(normal: FloatArray) -> FloatArray:
    return np.asarray(np.eye(3) - 2.0 * np.outer(normal, normal))


def _across(direction: FloatArray) -> FloatArray:
    """A unit vector across a direction."""
    least = np.eye(3)[int(np.argmin(np.abs(direction)))]
    across = np.cross(direction, least)
    return np.asarray(across / np.linalg.norm(across))
