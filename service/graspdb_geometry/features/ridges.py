"""Ridges: the edges that a gripper sees on an object, from its geometry alone.

A ridge is where two smooth pieces of surface meet at an outward bend of more than `LEAST_BEND`: segments with
a tangent t and the mean n of the two normals beside it. What only looks like an edge is none: seams between
convex parts, faces inside of the solid, and the facets that a sampled curve is made of. Inward bends are no
ridges either: nothing there can be held.

Closed meshes of one piece tell by their own triangles. Where several closed pieces or convex parts overlap or
touch, the solid is their union: around each point of an edge, on a small circle across it, the directions
into the union must form one sector of less than a half turn less `LEAST_BEND`; its ends are the faces.

Lengths are metres in the object frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, cKDTree

from graspdb_geometry._compiled import ridges
from graspdb_geometry.collision import Surface

__all__ = [
    "LEAST_BEND",
    "REACH_M",
    "Ridges",
    "Solid",
    "parts_solid",
    "ridges_of_mesh",
    "ridges_of_parts",
    "unit",
]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
#: Whether points (n, 3) lie in a solid, (n,) bool.
Solid = Callable[[FloatArray], npt.NDArray[np.bool_]]

#: Bend (radians between the normals) beyond which an edge is a ridge; a twelve-sided tube, whose facets bend
#: by exactly 30 degrees, is still round.
LEAST_BEND = math.radians(30.1)
#: Facets of a curve sampled more coarsely than this are faces of their own: a hexagon has ridges.
_MOST_FACET_BEND = math.radians(50.0)
#: Bends that count as those of a curve's other facets, and how unequal the widths of neighbours may be.
_LEAST_FACET_BEND, _MOST_WIDTHS = math.radians(10.0), 3.0
#: Tangents at the two sides of a facet differ by less: those of a cone's do, triangles of a sphere more.
_FACET_TANGENTS = math.cos(math.radians(65.0))

#: A grasp farther from every ridge than this is at none.
REACH_M = 0.03
#: Two ridges as near as this to each other's distance, with other directions, are a tie.
_TIE_M, _TIE_COSINE = 1e-4, math.cos(math.radians(30.0))

#: Radius of the circle on which the union is looked at, directions on half of it, spacing along an edge.
_CIRCLE_M, _DIRECTIONS, _SPACING_M, _MOST_SAMPLES = 1e-4, 24, 2e-3, 64
_BISECTIONS = 12
_BLOCK = 16


@dataclass(frozen=True, eq=False)
class Ridges:
    """Segments (S) of ridges.

    Attributes
    ----------
    ends : (S, 2, 3) metres
    tangents : (S, 3)
        Unit, along the segment; the sign means nothing.
    normals : (S, 3)
        Unit, the mean of the two adjacent ones: outwards, across the tangent.
    sides : (S, 2, 3)
        The two adjacent normals.
    """

    ends: FloatArray
    tangents: FloatArray
    normals: FloatArray
    sides: FloatArray

    def __len__(self) -> int:
        return len(self.ends)

    @property
    def nbytes(self) -> int:
        return sum(a.nbytes for a in (self.ends, self.tangents, self.normals, self.sides))

    def nearest(self, positions: npt.ArrayLike, *, reach_m: float = REACH_M) -> tuple[IntArray, FloatArray]:
        """The nearest segment of each position (n, 3): its number, and the distance in metres.

        The number is -1 beyond ``reach_m`` (the distance infinite) and -2 where another ridge, of another
        direction, is as near.

        Raises
        ------
        ValueError
            For positions that are not (n, 3) and finite.
        """
        p = np.ascontiguousarray(positions, dtype=np.float64)
        if p.ndim != 2 or p.shape[1] != 3 or not np.isfinite(p).all():
            raise ValueError("positions must have shape (n, 3) and be finite")
        which = np.full(len(p), -1, dtype=np.int64)
        distances = np.full(len(p), np.inf)
        if len(self) and len(p):
            order, boxes = self._blocks()
            ridges.nearest(
                p, np.ascontiguousarray(self.ends[order]), boxes, _BLOCK, float(reach_m),
                np.ascontiguousarray(self.tangents[order]), np.ascontiguousarray(self.normals[order]),
                _TIE_COSINE, _TIE_M, which, distances,
            )  # fmt: skip
            which = np.where(which >= 0, order[np.maximum(which, 0)], which)
        return which, distances

    def frames(self, positions: npt.ArrayLike, *, reach_m: float = REACH_M) -> FloatArray:
        """Frames (n, 3, 3) of the nearest ridge: columns t, n x t and n; NaN where there is none, or a tie.

        For a grasp on the ridge n points against the approach and n x t along the closing axis.
        """
        which, _ = self.nearest(positions, reach_m=reach_m)
        found = np.full((len(which), 3, 3), np.nan)
        known = which >= 0
        t, n = self.tangents[which[known]], self.normals[which[known]]
        found[known] = np.stack([t, np.cross(n, t), n], axis=-1)
        return found

    def _blocks(self) -> tuple[IntArray, FloatArray]:
        """Segments in an order of neighbours, and bounds (B, 2, 3) of runs of them."""
        order = np.asarray(cKDTree(self.ends.mean(axis=1), leafsize=_BLOCK).indices, dtype=np.int64)
        low, high = self.ends[order].min(axis=1), self.ends[order].max(axis=1)
        starts = np.arange(0, len(order), _BLOCK)
        boxes = np.stack([np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)], axis=1)
        return order, np.ascontiguousarray(boxes)


@dataclass(frozen=True, eq=False)
class _Bends:
    """Edges (E) that bend outwards: ends (E, 2, 3) and the normals (E, 2, 3) beside them."""

    ends: FloatArray
    sides: FloatArray

    def take(self, chosen: npt.NDArray[np.bool_] | IntArray) -> _Bends:
        return _Bends(self.ends[chosen], self.sides[chosen])

    @property
    def angles(self) -> FloatArray:
        return _angle(self.sides[:, 0], self.sides[:, 1])

    @property
    def tangents(self) -> FloatArray:
        return unit(self.ends[:, 1] - self.ends[:, 0])


def ridges_of_mesh(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> Ridges:
    """Ridges of a surface of triangles.

    Parameters
    ----------
    vertices : (V, 3) metres, merged where they coincide
    faces : (F, 3) int, counterclockwise seen from outside
        Closed surfaces, which may overlap; of open ones the edges between two triangles count.

    Raises
    ------
    ValueError
        For wrong shapes, indices out of range or values that are not finite.
    """
    points, index = _checked(vertices, faces)
    bends, odd = _bends(points, index)
    pieces = _pieces(index, len(points))
    if pieces > 1 or len(odd):
        solid = Surface(points, index, watertight=True).contains
        # Edges where several sheets meet have no two normals of their own: any direction starts the circle.
        spare = _Bends(odd, np.zeros((len(odd), 2, 3)))
        bends = _exposed(_joined(bends, spare), solid)
    return _ridges(bends)


def ridges_of_parts(parts: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]]) -> Ridges:
    """Ridges of the union of convex parts (vertices (V, 3) in metres, faces (F, 3)).

    Raises
    ------
    ValueError
        As `ridges_of_mesh`, and without parts.
    """
    if not parts:
        raise ValueError("there must be at least one part")
    checked = [_checked(*part) for part in parts]
    found = [_bends(points, index)[0] for points, index in checked]
    bends = found[0]
    for other in found[1:]:
        bends = _joined(bends, other)
    if len(parts) > 1:
        bends = _exposed(bends, parts_solid([points for points, _ in checked]))
    return _ridges(bends)


def parts_solid(parts: Sequence[FloatArray]) -> Solid:
    """The union of convex parts given by their corners (V, 3)."""
    planes, bounds = [], []
    for corners in parts:
        equations = np.unique(np.round(np.asarray(ConvexHull(corners).equations), 12), axis=0)
        planes.append(np.column_stack([equations[:, :3], -equations[:, 3]]))
        bounds.append(np.stack([corners.min(axis=0), corners.max(axis=0)]))
    starts = np.concatenate([[0], np.cumsum([len(p) for p in planes])]).astype(np.int64)
    table: FloatArray = np.concatenate(planes)
    boxes: FloatArray = np.stack(bounds)

    def within(points: FloatArray) -> npt.NDArray[np.bool_]:
        found = np.empty(len(points), dtype=np.bool_)
        ridges.inside_parts(np.ascontiguousarray(points), table, starts, boxes, found)
        return found

    return within


# ------------------------------------------------------------------------------------------ edges


def _checked(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> tuple[FloatArray, IntArray]:
    points = np.asarray(vertices, dtype=np.float64)
    index = np.asarray(faces, dtype=np.int64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError("vertices must be (V, 3) and finite")
    if index.ndim != 2 or index.shape[1] != 3 or not len(index):
        raise ValueError("faces must be (F, 3) with at least one row")
    if int(index.min()) < 0 or int(index.max()) >= len(points):
        raise ValueError("faces must refer to existing vertices")
    # The same place is the same vertex, or every edge of a triangle soup would be a border.
    places, number = np.unique(points, axis=0, return_inverse=True)
    return places, number.reshape(-1)[index].astype(np.int64)


def _bends(points: FloatArray, faces: IntArray) -> tuple[_Bends, FloatArray]:
    """Edges between two triangles that bend outwards, facets' included; and those of more than two."""
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    flat = area > 1e-12 * np.maximum(np.ptp(corners, axis=1).max(axis=1) ** 2, 1e-300)
    normals = normals / np.where(area > 0.0, area, 1.0)[:, None]
    begin, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    owner, opposite = np.repeat(np.arange(len(faces)), 3), faces[:, [2, 0, 1]].ravel()
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    key = low * len(points) + high
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.concatenate([[True], np.diff(key[order]) > 0]))
    count = np.diff(np.concatenate([first, [len(order)]]))
    a, b = order[first[count == 2]], order[first[count == 2] + 1]
    # Wound alike, the two run along their edge in opposite directions.
    kept = (begin[a] == end[b]) & flat[owner[a]] & flat[owner[b]]
    a, b = a[kept], b[kept]
    sides = np.stack([normals[owner[a]], normals[owner[b]]], axis=1)
    outward = np.einsum("ei,ei->e", points[opposite[b]] - points[begin[a]], sides[:, 0]) < 0.0
    found = _Bends(np.stack([points[low[a]], points[high[a]]], axis=1), sides)
    several = order[first[count > 2]]
    shared = np.stack([points[low[several]], points[high[several]]], axis=1)
    return found.take(outward & (found.angles > _LEAST_FACET_BEND)), shared.reshape(-1, 2, 3)


def _pieces(faces: IntArray, vertices: int) -> int:
    """Pieces of surface that share no vertex."""
    begin, end = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    graph = coo_array((np.ones(len(begin), dtype=np.int8), (begin, end)), shape=(vertices, vertices))
    _, label = connected_components(graph, directed=False)
    return len(np.unique(label[faces[:, 0]]))


def _joined(a: _Bends, b: _Bends) -> _Bends:
    return _Bends(np.concatenate([a.ends, b.ends]), np.concatenate([a.sides, b.sides]))


# ------------------------------------------------------------------------------------------ unions


def _exposed(bends: _Bends, solid: Solid) -> _Bends:
    """The stretches of edges on which the union bends outwards, with the union's normals."""
    if not len(bends.ends):
        return bends
    start, along = bends.ends[:, 0], bends.ends[:, 1] - bends.ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    number = np.clip(np.ceil(length / _SPACING_M), 1, _MOST_SAMPLES).astype(np.int64)
    edge = np.repeat(np.arange(len(number)), number)
    place = np.arange(len(edge)) - np.repeat(np.cumsum(number) - number, number)
    points = start[edge] + ((place + 0.5) / number[edge])[:, None] * along[edge]
    sides = _sectors(points, bends.tangents[edge], bends.sides[edge], solid)
    good: npt.NDArray[np.bool_] = np.asarray(np.isfinite(sides).all(axis=(1, 2)))
    # Runs of neighbouring good samples between the same two faces become a segment.
    same = np.zeros(len(edge), dtype=bool)
    same[1:] = (edge[1:] == edge[:-1]) & good[1:] & good[:-1]
    same[1:] &= np.nan_to_num(np.einsum("nsi,nsi->ns", sides[1:], sides[:-1])).min(axis=1) > math.cos(0.02)
    first = np.flatnonzero(good & ~same)
    last = np.flatnonzero(good & ~np.append(same[1:], False))
    share = np.stack([place[first] / number[edge[first]], (place[last] + 1) / number[edge[last]]], axis=1)
    ends = start[edge[first], None] + share[:, :, None] * along[edge[first], None]
    found = _Bends(ends, sides[(first + last) // 2])
    found = found.take(found.angles > _LEAST_FACET_BEND)
    # Parts that touch along an edge have it twice.
    where = np.sort(np.round(found.ends / 1e-7), axis=1).reshape(len(found.ends), -1)
    _, chosen = np.unique(where, axis=0, return_index=True)
    return found.take(np.sort(chosen))


def _sectors(points: FloatArray, tangents: FloatArray, sides: FloatArray, solid: Solid) -> FloatArray:
    """Normals (n, 2, 3) of the union's two faces along edges at points (n, 3); NaN where it has no two.

    The circle starts in the edge's own solid, opposite to the mean of its normals.
    """
    mean = sides.sum(axis=1)
    helper = np.eye(3)[np.argmin(np.abs(tangents), axis=1)]
    lone = np.linalg.norm(mean, axis=1) < 1e-6
    mean[lone] = np.cross(tangents, helper)[lone]
    u = -unit(mean - np.einsum("ni,ni->n", mean, tangents)[:, None] * tangents)
    v = np.cross(tangents, u)

    def held(angle: FloatArray) -> npt.NDArray[np.bool_]:
        """(n, k) for angles (n, k)."""
        c, s = np.cos(angle)[..., None], np.sin(angle)[..., None]
        at = points[:, None] + _CIRCLE_M * (c * u[:, None] + s * v[:, None])
        return solid(at.reshape(-1, 3)).reshape(angle.shape)

    step = math.pi / _DIRECTIONS
    turn = np.arange(2 * _DIRECTIONS) * step
    flags = held(np.broadcast_to(turn, (len(points), len(turn))))
    # Where the start is not inside (sheets that share an edge), begin at the first direction that is.
    shift = np.argmax(flags, axis=1)
    shift[flags[:, 0]] = 0
    rows = np.arange(len(points))
    flags = flags[rows[:, None], (np.arange(len(turn)) + shift[:, None]) % len(turn)]
    forward = np.argmin(flags, axis=1)
    backward = np.argmin(flags[:, ::-1], axis=1)
    one: npt.NDArray[np.bool_] = np.asarray(flags.sum(axis=1) == forward + backward)
    one &= flags.any(axis=1) & ~flags.all(axis=1)
    ends = []
    for count, sign in ((forward, 1.0), (backward, -1.0)):
        # The last direction inside, seen from the start, and the first outside.
        within = (count - 1.0 if sign > 0.0 else -count.astype(np.float64)) * step
        beyond = within + sign * step
        for _ in range(_BISECTIONS):
            middle = 0.5 * (within + beyond)
            hit = held((middle + shift * step)[:, None])[:, 0]
            within, beyond = np.where(hit, middle, within), np.where(hit, beyond, middle)
        ends.append(0.5 * (within + beyond) + shift * step)
    found = np.empty((len(points), 2, 3))
    for side, (angle, sign) in enumerate(zip(ends, (1.0, -1.0), strict=True)):
        # Across the face's direction, away from the sector.
        normal = angle + sign * 0.5 * math.pi
        found[:, side] = np.cos(normal)[:, None] * u + np.sin(normal)[:, None] * v
    straight: npt.NDArray[np.bool_] = np.asarray(ends[0] - ends[1] > math.pi - _LEAST_FACET_BEND)
    found[~one | straight] = np.nan
    return found


# ------------------------------------------------------------------------------------------ facets


def _ridges(bends: _Bends) -> Ridges:
    kept = bends.take((bends.angles > LEAST_BEND) & ~_facets(bends))
    return Ridges(kept.ends, kept.tangents, unit(kept.sides.sum(axis=1)), kept.sides)


def _facets(bends: _Bends) -> npt.NDArray[np.bool_]:
    """Edges (E,) between two facets of a sampled curve.

    On both sides the next edge across the facet bends alike, and the two facets are about as wide.
    """
    angles = bends.angles
    found = np.zeros(len(angles), dtype=bool)
    asked = np.flatnonzero((angles > LEAST_BEND) & (angles <= _MOST_FACET_BEND))
    if not len(asked):
        return found
    middle, tangents = bends.ends.mean(axis=1), bends.tangents
    size = float(np.ptp(bends.ends.reshape(-1, 3), axis=0).max())
    offset = np.einsum("esi,ei->es", bends.sides, middle) / max(size, 1e-9)
    # Planes as points: those of one facet coincide.
    planes = np.concatenate([bends.sides, offset[:, :, None]], axis=2)
    tree = cKDTree(planes.reshape(-1, 4))
    for e in asked.tolist():
        widths = []
        for side in (0, 1):
            near = np.unique(np.array(tree.query_ball_point(planes[e, side], 0.01), dtype=np.int64) // 2)
            near = near[near != e]
            alike = (angles[near] >= 0.5 * angles[e]) & (angles[near] <= _MOST_FACET_BEND)
            alike &= np.abs(tangents[near] @ tangents[e]) > _FACET_TANGENTS
            near = near[alike]
            across = np.cross(bends.sides[e, side], tangents[e])
            apart = middle[near] - middle[e]
            width = np.abs(apart @ across)
            length = np.linalg.norm(bends.ends[e, 1] - bends.ends[e, 0])
            beside = (width > 1e-3 * length) & (np.abs(apart @ tangents[e]) <= 0.75 * length)
            if beside.any():
                widths.append(float(width[beside].min()))
        found[e] = len(widths) == 2 and max(widths) <= _MOST_WIDTHS * min(widths)
    return found


def _angle(a: FloatArray, b: FloatArray) -> FloatArray:
    """Between unit vectors (n, 3), radians; exact for small ones, too."""
    return np.asarray(2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(a - b, axis=1), 0.0, 1.0)))


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors (..., 3) of length 1."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))
