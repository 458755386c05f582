"""Pairs of surfaces and of edges that a parallel jaw can close on, and how a grasp lies to them.

``surfaces``: two plane faces with opposed normals that look away from each other, one behind the other.
``coplanar-edges``: two parallel ridges of one face whose other faces look away from each other.
``parallel-edges``: two parallel ridges that point away from each other, whatever lies between. In every case
the gap is no wider than the jaw opens. Facets of sampled curves are faces here: a jaw closes on two opposite
ones.

A pair has a region between its two sides: a box about a centre with the axes e (its longest way), c (from one
side to the other) and f = e x c. A grasp is at a pair whose region, widened by `MARGIN_M` sideways, holds the
origin of its tool frame; of several it is at the one whose c its closing axis is most parallel to.

Lengths are metres in the object frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from graspdb_geometry._compiled.ridges import regions
from graspdb_geometry.collision import Surface
from graspdb_geometry.features.ridges import Ridges, Solid, parts_solid, unit
from graspdb_geometry.poses import PoseArrays, checked

__all__ = ["KINDS", "MARGIN_M", "JawPairs", "Kind", "pairs_of_mesh", "pairs_of_parts"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Kind = Literal["surfaces", "coplanar-edges", "parallel-edges"]
KINDS: tuple[Kind, ...] = ("surfaces", "coplanar-edges", "parallel-edges")

#: How far beside a pair's region a grasp may be: half a finger's width.
MARGIN_M = 0.01
#: Normals count as opposed, and tangents as parallel, within this.
_PARALLEL = math.cos(math.radians(10.0))
#: Mean normals of ridges lie between two faces, each of which may be at another angle.
_OPPOSED = math.cos(math.radians(20.0))
#: A grasp whose closing axis is farther from c than this is not aligned with the pair.
_ALIGNED = math.cos(math.radians(45.0))
#: Triangles of one face: their normals agree to this, in radians.
_COPLANAR = 1e-3
_LEAST_GAP_M, _LEAST_AREA_M2, _LEAST_LENGTH_M = 5e-4, 1e-5, 3e-3
_MOST_FACES, _MOST_EDGES, _MOST_PAIRS = 600, 1_200, 2_000
_SAMPLES, _LEAST_OVERLAP, _MOST_BORDERS = 160, 6, 16
_OUTSIDE_M = 1e-4
#: Steps of an additive sequence that fills four dimensions evenly: powers of 1 / g, where g^5 = g + 1.
_STEPS = 1.1673039782614187 ** -np.arange(1.0, 5.0)


#: Centres, axes and half extents; of one region or of several.
Regions = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class JawPairs:
    """Pairs (P), widest regions first within a kind.

    Attributes
    ----------
    kinds : (P,) int64
        Index into `KINDS`.
    centres : (P, 3) metres
    axes : (P, 3, 3)
        Columns e, c, f.
    half : (P, 3) metres
        Half extents of the region along e, c and f; along c half the gap.
    """

    kinds: IntArray
    centres: FloatArray
    axes: FloatArray
    half: FloatArray

    def __len__(self) -> int:
        return len(self.kinds)

    @property
    def gaps_m(self) -> FloatArray:
        """How far apart the two sides are, (P,)."""
        return np.asarray(2.0 * self.half[:, 1])

    @property
    def nbytes(self) -> int:
        return sum(a.nbytes for a in (self.kinds, self.centres, self.axes, self.half))

    def of(self, *kinds: Kind) -> JawPairs:
        """Those of some kinds only."""
        return self._some(np.isin(self.kinds, [KINDS.index(kind) for kind in kinds]))

    def within(self, opening_m: float) -> JawPairs:
        """Those whose gap is no wider than a jaw opens."""
        return self._some(self.gaps_m <= opening_m)

    def _some(self, chosen: npt.NDArray[np.bool_]) -> JawPairs:
        return JawPairs(self.kinds[chosen], self.centres[chosen], self.axes[chosen], self.half[chosen])

    def at(self, poses: PoseArrays) -> tuple[IntArray, FloatArray]:
        """The pair that each of n grasps is at, -1 at none, and its closing axis' angle to c.

        Angles are in radians, 0 to pi / 2; NaN at none.
        """
        p, axes = _axes(poses)
        which = np.full(len(p), -1, dtype=np.int64)
        cosine = np.full(len(p), np.nan)
        if len(self) and len(p):
            regions(
                p, np.ascontiguousarray(axes[:, :, 1]), self.centres, self.axes,
                self.half + np.array([MARGIN_M, 0.0, MARGIN_M]), which, cosine,
            )  # fmt: skip
        return which, np.arccos(np.clip(cosine, 0.0, 1.0))

    def grasps(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """About ``count`` grasps spread over the regions, at least one a pair; always the same.

        The tool's origin lies in the middle of the gap, anywhere along e and f; y is c or its opposite, and
        the turn about it any.

        Returns
        -------
        positions : (n, 3) metres
        quaternions_xyzw : (n, 4)
        weights : (n,)
            Sum to 1; a pair's are in proportion to its region, widened by `MARGIN_M` along e and f: so edges,
            which have no width, count too.
        """
        if not len(self):
            return np.empty((0, 3)), np.empty((0, 4)), np.empty(0)
        share = (self.half[:, 0] + MARGIN_M) * (self.half[:, 2] + MARGIN_M)
        share = share / share.sum()
        number = np.maximum(np.rint(share * count), 1.0).astype(np.int64)
        pair = np.repeat(np.arange(len(self)), number)
        spread = (np.arange(1, len(pair) + 1)[:, None] * _STEPS) % 1.0
        axes, half = self.axes[pair], self.half[pair]
        e, c, f = axes[:, :, 0], axes[:, :, 1], axes[:, :, 2]
        along = (2.0 * spread[:, :2] - 1.0) * half[:, [0, 2]]
        positions = self.centres[pair] + along[:, :1] * e + along[:, 1:] * f
        turn = 2.0 * math.pi * spread[:, 2:3]
        z = np.sin(turn) * e + np.cos(turn) * f
        y = np.where(spread[:, 3:] < 0.5, c, -c)
        rotations = Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=-1))
        return positions, np.asarray(rotations.as_quat()), share[pair] / number[pair]

    def frames(self, poses: PoseArrays) -> FloatArray:
        """Frames (n, 3, 3) of the pairs that grasps are at, their axes named as the gripper's.

        y is c, z that of the other two which the approach is nearest to, each with the sign nearest to the
        gripper's own axis, x = y x z. NaN at no pair, and where the closing axis is more than 45 degrees
        from c.
        """
        which, angle = self.at(poses)
        _, axes = _axes(poses)
        found = np.full((len(which), 3, 3), np.nan)
        known = np.flatnonzero((which >= 0) & (np.cos(np.nan_to_num(angle, nan=2.0)) > _ALIGNED))
        own, pair = axes[known], self.axes[which[known]] if len(self) else np.empty((0, 3, 3))
        y = pair[:, :, 1] * _sign(np.einsum("ni,ni->n", pair[:, :, 1], own[:, :, 1]))[:, None]
        approach = np.einsum("nij,ni->nj", pair, own[:, :, 2])[:, [0, 2]]
        choice = np.argmax(np.abs(approach), axis=1)
        rows = np.arange(len(known))
        z = pair[rows, :, 2 * choice] * _sign(approach[rows, choice])[:, None]
        found[known] = np.stack([np.cross(y, z), y, z], axis=-1)
        return found


def pairs_of_mesh(
    vertices: npt.ArrayLike, faces: npt.ArrayLike, ridges: Ridges, *, watertight: bool, opening_m: float
) -> JawPairs:
    """Pairs on a surface of triangles.

    Parameters
    ----------
    vertices, faces : (V, 3) metres, (F, 3) int
    ridges
        Of the same surface.
    watertight : bool
        The surface, or several closed pieces of it, bound a solid: what is inside of it is left out.
    opening_m : float
        Widest gap.
    """
    points, index = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    solid = Surface(points, index, watertight=True).contains if watertight else None
    return _pairs(points[index], ridges, solid, opening_m)


def pairs_of_parts(
    parts: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]], ridges: Ridges, *, opening_m: float
) -> JawPairs:
    """Pairs on the union of convex parts (vertices (V, 3) in metres, faces (F, 3))."""
    checked = [(np.asarray(v, dtype=np.float64), np.asarray(f, dtype=np.int64)) for v, f in parts]
    corners = np.concatenate([v[f] for v, f in checked])
    return _pairs(corners, ridges, parts_solid([v for v, _ in checked]), opening_m)


def _pairs(corners: FloatArray, ridges: Ridges, solid: Solid | None, opening_m: float) -> JawPairs:
    if not (math.isfinite(opening_m) and opening_m > 0.0):
        raise ValueError("opening_m must be positive")
    found = [_surfaces(corners, solid, opening_m), *_edges(ridges, opening_m)]
    kinds = np.concatenate([np.full(len(part[0]), kind) for kind, part in enumerate(found)])
    centres, axes, half = (np.concatenate([part[i] for part in found]) for i in range(3))
    return JawPairs(kinds.astype(np.int64), centres, axes, half)


# ---------------------------------------------------------------------------------------- surfaces


@dataclass(frozen=True, eq=False)
class _Face:
    """A plane piece of surface: triangles, normal, area, directions of its borders, and points spread over
    what is exposed of it.
    """

    corners: FloatArray
    normal: FloatArray
    area: float
    borders: FloatArray
    points: FloatArray
    exposed: float


def _surfaces(corners: FloatArray, solid: Solid | None, opening_m: float) -> Regions:
    faces = _faces(corners, solid)
    found: list[Regions] = []
    normals = np.array([face.normal for face in faces]).reshape(-1, 3)
    middles = np.array([face.points.mean(axis=0) for face in faces]).reshape(-1, 3)
    first, second = np.nonzero(np.triu(normals @ normals.T <= -_PARALLEL, 1))
    # Apart along the normal, each looking away from the other.
    gap = np.einsum("pi,pi->p", middles[first] - middles[second], normals[first])
    kept = (gap > _LEAST_GAP_M) & (gap < 1.5 * opening_m)
    for i, j in zip(first[kept].tolist(), second[kept].tolist(), strict=True):
        # The larger one's samples are too sparse to meet the smaller.
        small, large = (faces[i], faces[j]) if faces[i].area <= faces[j].area else (faces[j], faces[i])
        c = unit(small.normal - large.normal)
        depth = (small.points - large.corners[0, 0]) @ large.normal / (c @ large.normal)
        opposite = small.points - depth[:, None] * c
        over = _covered(opposite, large) & (depth > 0.0)
        if over.sum() < _LEAST_OVERLAP or over.mean() * small.exposed < _LEAST_AREA_M2:
            continue
        middle = 0.5 * (small.points + opposite)[over]
        thick = float(np.mean(depth[over]))
        if not _LEAST_GAP_M < thick <= opening_m:
            continue
        found.append(_region(middle, c, thick, np.concatenate([small.borders, large.borders])))
    return _largest(found)


def _faces(corners: FloatArray, solid: Solid | None) -> list[_Face]:
    """Plane faces, largest first."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    corners, cross, area = corners[area > 1e-12], cross[area > 1e-12], area[area > 1e-12]
    if not len(corners):
        return []
    normals = unit(cross)
    label = _coplanar(corners, normals)
    total = np.bincount(label, weights=area)
    rng = np.random.default_rng(0)
    found = []
    for number in np.argsort(-total, kind="stable")[:_MOST_FACES]:
        if total[number] < _LEAST_AREA_M2:
            break
        own = np.flatnonzero(label == number)
        points, _ = spread_points(corners[own], area[own], _SAMPLES, rng)
        normal = unit(cross[own].sum(axis=0))
        if solid is not None:
            free = ~solid(points + _OUTSIDE_M * normal)
            if free.sum() < _LEAST_OVERLAP:
                continue
        else:
            free = np.ones(len(points), dtype=bool)
        exposed = float(total[number] * free.mean())
        found.append(
            _Face(corners[own], normal, float(total[number]), _borders(corners[own]), points[free], exposed)
        )
    return found


def _coplanar(corners: FloatArray, normals: FloatArray) -> IntArray:
    """Which face each triangle is of: joined over edges at which the normals agree."""
    _, number = np.unique(np.round(corners.reshape(-1, 3) / 1e-7), axis=0, return_inverse=True)
    index = number.reshape(-1, 3).astype(np.int64)
    begin, end = index.ravel(), index[:, [1, 2, 0]].ravel()
    owner = np.repeat(np.arange(len(index)), 3)
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    order = np.lexsort((high, low))
    same = (np.diff(low[order]) == 0) & (np.diff(high[order]) == 0)
    a, b = owner[order[:-1][same]], owner[order[1:][same]]
    flat = np.linalg.norm(normals[a] - normals[b], axis=1) < _COPLANAR
    graph = coo_array(
        (np.ones(int(flat.sum()), dtype=np.int8), (a[flat], b[flat])), shape=(len(index), len(index))
    )
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _borders(corners: FloatArray) -> FloatArray:
    """Directions (k, 3) of the longest edges that only one of the triangles has."""
    ends = np.stack([corners, corners[:, [1, 2, 0]]], axis=2).reshape(-1, 2, 3)
    _, number = np.unique(np.round(ends.reshape(-1, 3) / 1e-7), axis=0, return_inverse=True)
    pair = np.sort(number.reshape(-1, 2), axis=1)
    _, first, count = np.unique(pair, axis=0, return_index=True, return_counts=True)
    along = ends[first[count == 1], 1] - ends[first[count == 1], 0]
    if not len(along):
        along = ends[:, 1] - ends[:, 0]
    longest = np.argsort(-np.linalg.norm(along, axis=1), kind="stable")[:_MOST_BORDERS]
    return unit(along[longest])


def spread_points(
    corners: FloatArray, area: FloatArray, count: int, rng: np.random.Generator
) -> tuple[FloatArray, npt.NDArray[np.intp]]:
    """Points (count, 3) over triangles (F, 3, 3), as many as their area takes, and the triangle of each;
    strata of the area rather than chance.
    """
    bounds = np.cumsum(area)
    at = (np.arange(count) + rng.random(count)) / count * bounds[-1]
    chosen = np.minimum(np.searchsorted(bounds, at, side="right"), len(corners) - 1)
    t = corners[chosen]
    u, v = rng.random((2, count))
    folded = u + v > 1.0
    u, v = np.where(folded, 1.0 - u, u), np.where(folded, 1.0 - v, v)
    return t[:, 0] + u[:, None] * (t[:, 1] - t[:, 0]) + v[:, None] * (t[:, 2] - t[:, 0]), chosen


def _covered(points: FloatArray, face: _Face) -> npt.NDArray[np.bool_]:
    """Whether points (n, 3) in a face's plane lie in one of its triangles."""
    inside = np.zeros(len(points), dtype=bool)
    for t in face.corners:
        held = np.ones(len(points), dtype=bool)
        for k in range(3):
            across = np.cross(face.normal, t[(k + 1) % 3] - t[k])
            held &= (points - t[k]) @ across >= -1e-9
        inside |= held
    return inside


def _region(points: FloatArray, c: FloatArray, gap: float, directions: FloatArray) -> Regions:
    """Centre, axes and half extents of points between two surfaces: of the boxes along one of the directions
    (k, 3) of their borders the smallest.
    """
    centre = points.mean(axis=0)
    off = points - centre
    e = unit(directions - (directions @ c)[:, None] * c)
    f = np.cross(e, c)
    spans = np.stack([np.ptp(off @ e.T, axis=0), np.ptp(off @ f.T, axis=0)])
    best = int(np.argmin(spans[0] * spans[1]))
    long = e[best] if spans[0, best] >= spans[1, best] else f[best]
    axes = np.stack([long, c, np.cross(long, c)], axis=-1)
    low, high = (off @ axes).min(axis=0), (off @ axes).max(axis=0)
    half = 0.5 * (high - low)
    half[1] = 0.5 * gap
    return centre + axes @ (np.array([1.0, 0.0, 1.0]) * 0.5 * (low + high)), axes, half


# -------------------------------------------------------------------------------------------- edges


def _edges(ridges: Ridges, opening_m: float) -> tuple[Regions, Regions]:
    """Regions between coplanar edges, and between other parallel ones."""
    ends, tangents, normals, sides = _straight(ridges)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    order = np.argsort(-length, kind="stable")[:_MOST_EDGES]
    order = order[length[order] >= _LEAST_LENGTH_M]
    ends, tangents, normals, sides = ends[order], tangents[order], normals[order], sides[order]
    coplanar: list[Regions] = []
    parallel: list[Regions] = []
    middle = ends.mean(axis=1)
    for i in range(len(ends)):
        t = tangents[i]
        others = i + 1 + np.flatnonzero(np.abs(tangents[i + 1 :] @ t) >= _PARALLEL)
        apart = middle[others] - middle[i]
        apart -= (apart @ t)[:, None] * t
        gap = np.linalg.norm(apart, axis=1)
        near = (gap > _LEAST_GAP_M) & (gap <= opening_m)
        for j, d, g in zip(others[near].tolist(), apart[near], gap[near], strict=True):
            along = (ends[[i, j]] - middle[i]) @ t
            low, high = along.min(axis=1).max(), along.max(axis=1).min()
            if high - low < _LEAST_LENGTH_M:
                continue
            c = d / g
            e = unit(t - (t @ c) * c)
            centre = middle[i] + 0.5 * d + 0.5 * (low + high) * t
            region = (
                centre,
                np.stack([e, c, np.cross(e, c)], axis=-1),
                np.array([(high - low) / 2, g / 2, 0.0]),
            )
            if _share_a_face(sides[i], sides[j], c):
                coplanar.append(region)
            elif normals[i] @ normals[j] <= -_OPPOSED and normals[j] @ c >= _OPPOSED:
                parallel.append(region)
    return _largest(coplanar), _largest(parallel)


def _share_a_face(first: FloatArray, second: FloatArray, c: FloatArray) -> bool:
    """Whether two edges a way c apart bound one plane and have other faces that look apart."""
    for a in (0, 1):
        for b in (0, 1):
            flat = first[a] @ second[b] >= _PARALLEL and abs(first[a] @ c) < 0.1 and abs(second[b] @ c) < 0.1
            if flat and -first[1 - a] @ c > 0.5 and second[1 - b] @ c > 0.5:
                return True
    return False


def _straight(ridges: Ridges) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Ridges with collinear neighbours joined: ends, tangents, normals and sides."""
    count = len(ridges)
    if not count:
        return ridges.ends, ridges.tangents, ridges.normals, ridges.sides
    _, number = np.unique(np.round(ridges.ends.reshape(-1, 3) / 1e-6), axis=0, return_inverse=True)
    place = number.reshape(-1).astype(np.int64)
    owner = np.repeat(np.arange(count), 2)
    order = np.argsort(place, kind="stable")
    same = np.diff(place[order]) == 0
    a, b = owner[order[:-1][same]], owner[order[1:][same]]
    alike = np.abs(np.einsum("ni,ni->n", ridges.tangents[a], ridges.tangents[b])) > 1.0 - 1e-5
    alike &= np.einsum("ni,ni->n", ridges.normals[a], ridges.normals[b]) > 1.0 - 1e-3
    graph = coo_array((np.ones(int(alike.sum()), dtype=np.int8), (a[alike], b[alike])), shape=(count, count))
    groups, label = connected_components(graph, directed=False)
    first = np.full(groups, -1)
    first[label[::-1]] = np.arange(count)[::-1]
    t, origin = ridges.tangents[first], ridges.ends[first, 0]
    along = np.einsum("sei,si->se", ridges.ends - origin[label][:, None], t[label])
    low, high = np.full(groups, np.inf), np.full(groups, -np.inf)
    np.minimum.at(low, label, along.min(axis=1))
    np.maximum.at(high, label, along.max(axis=1))
    ends = origin[:, None] + np.stack([low, high], axis=1)[:, :, None] * t[:, None]
    return ends, t, ridges.normals[first], ridges.sides[first]


# ------------------------------------------------------------------------------------------ shared


def _largest(regions: list[Regions]) -> Regions:
    if not regions:
        return np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3))
    centres, axes, half = (np.ascontiguousarray(np.stack(column)) for column in zip(*regions, strict=True))
    order = np.argsort(-(half[:, 0] * (half[:, 2] + MARGIN_M)), kind="stable")[:_MOST_PAIRS]
    return centres[order], axes[order], half[order]


def _axes(poses: PoseArrays) -> tuple[FloatArray, FloatArray]:
    """Positions and rotation matrices."""
    p, q = checked(poses)
    return p, np.asarray(Rotation.from_quat(q).as_matrix()) if len(p) else np.empty((0, 3, 3))


def _sign(values: FloatArray) -> FloatArray:
    return np.where(values < 0.0, -1.0, 1.0)
