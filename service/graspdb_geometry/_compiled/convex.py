"""Numba kernels: gripper boxes against convex polyhedra, exactly.

Two convex polyhedra meet exactly when an edge of one meets the other as a solid: a corner of their
intersection lies on three faces, so at least two of the same polyhedron (an edge of it, inside the other) or
all three (its vertex).  The same argument gives the extent of the intersection.  Everything is computed in
the tool frame, where the gripper's boxes are aligned with the axes.

Cheap tests come first (bounding sphere, box about the transformed part, the part's face planes); each of them
only ever proves two solids apart.
"""

from __future__ import annotations

import numba as nb
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
#: Vertices (V, 3) and where each part's begin (parts + 1), planes (P, 4) as n, d with n.x <= d inside and
#: where they begin, edges (E, 2) as vertex numbers within the part and where they begin, bounding spheres'
#: centres (parts, 3) and radii (parts).
Model = tuple[FloatArray, IntArray, FloatArray, IntArray, IntArray, IntArray, FloatArray, FloatArray]

_INF = np.inf


@nb.njit(cache=True, inline="always")
def _clip_slab(a: float, b: float, low: float, high: float, t0: float, t1: float) -> tuple[float, float]:
    """Clip the parameters of the segment a + t (b - a) to low <= . <= high on one axis."""
    d = b - a
    if d == 0.0:
        if a < low or a > high:
            return 1.0, 0.0
        return t0, t1
    u = (low - a) / d
    v = (high - a) / d
    if u > v:
        u, v = v, u
    return max(t0, u), min(t1, v)


@nb.njit(cache=True, inline="always")
def _segment_in_box(va: FloatArray, vb: FloatArray, c: FloatArray, h: FloatArray) -> tuple[float, float]:
    """Parameters of the piece of a segment inside the box with centre c and half extents h."""
    t0, t1 = _clip_slab(va[0], vb[0], c[0] - h[0], c[0] + h[0], 0.0, 1.0)
    if t0 <= t1:
        t0, t1 = _clip_slab(va[1], vb[1], c[1] - h[1], c[1] + h[1], t0, t1)
        if t0 <= t1:
            t0, t1 = _clip_slab(va[2], vb[2], c[2] - h[2], c[2] + h[2], t0, t1)
    return t0, t1


@nb.njit(cache=True)
def _box_edge_meets_part(c: FloatArray, h: FloatArray, planes: FloatArray, count: int) -> bool:
    """Does one of the box's twelve edges meet the solid of the given half-spaces (tool frame)?"""
    for axis in range(3):
        j = (axis + 1) % 3
        k = (axis + 2) % 3
        for corner in range(4):
            sj = c[j] + (h[j] if corner & 1 else -h[j])
            sk = c[k] + (h[k] if corner & 2 else -h[k])
            t0 = c[axis] - h[axis]
            t1 = c[axis] + h[axis]
            for m in range(count):
                slope = planes[m, axis]
                rest = planes[m, 3] - planes[m, j] * sj - planes[m, k] * sk
                if slope > 0.0:
                    t1 = min(t1, rest / slope)
                elif slope < 0.0:
                    t0 = max(t0, rest / slope)
                elif rest < 0.0:
                    t1 = -_INF
                if t0 > t1:
                    break
            if t0 <= t1:
                return True
    return False


@nb.njit(cache=True)
def _part_edge_meets_box(
    c: FloatArray, h: FloatArray, points: FloatArray, edges: IntArray, first: int, last: int
) -> bool:
    """Does one of the part's edges first..last meet the solid box?"""
    for e in range(first, last):
        t0, t1 = _segment_in_box(points[edges[e, 0]], points[edges[e, 1]], c, h)
        if t0 <= t1:
            return True
    return False


@nb.njit(cache=True)
def _extent_in_column(
    c: FloatArray,
    h: FloatArray,
    points: FloatArray,
    edges: IntArray,
    first: int,
    last: int,
    planes: FloatArray,
    count: int,
) -> tuple[float, float]:
    """Least and greatest y of the part's solid inside the column; (inf, -inf) if it misses the column."""
    low = _INF
    high = -_INF
    for e in range(first, last):
        va = points[edges[e, 0]]
        vb = points[edges[e, 1]]
        t0, t1 = _segment_in_box(va, vb, c, h)
        if t0 <= t1:
            ya = va[1] + t0 * (vb[1] - va[1])
            yb = va[1] + t1 * (vb[1] - va[1])
            low = min(low, ya, yb)
            high = max(high, ya, yb)
    for corner in range(4):
        x = c[0] + (h[0] if corner & 1 else -h[0])
        z = c[2] + (h[2] if corner & 2 else -h[2])
        y0 = c[1] - h[1]
        y1 = c[1] + h[1]
        for m in range(count):
            slope = planes[m, 1]
            rest = planes[m, 3] - planes[m, 0] * x - planes[m, 2] * z
            if slope > 0.0:
                y1 = min(y1, rest / slope)
            elif slope < 0.0:
                y0 = max(y0, rest / slope)
            elif rest < 0.0:
                y1 = -_INF
            if y0 > y1:
                break
        if y0 <= y1:
            low = min(low, y0)
            high = max(high, y1)
    return low, high


@nb.njit(cache=True, inline="always")
def _rotation(q: FloatArray, r: FloatArray) -> None:
    """Fill r with the matrix of the unit quaternion q (xyzw)."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    r[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    r[0, 1] = 2.0 * (x * y - z * w)
    r[0, 2] = 2.0 * (x * z + y * w)
    r[1, 0] = 2.0 * (x * y + z * w)
    r[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    r[1, 2] = 2.0 * (y * z - x * w)
    r[2, 0] = 2.0 * (x * z - y * w)
    r[2, 1] = 2.0 * (y * z + x * w)
    r[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@nb.njit(cache=True, inline="always")
def _to_tool(v: FloatArray, p: FloatArray, r: FloatArray, out: FloatArray) -> None:
    """Fill out with R^T (v - p), a point of the object seen from the tool."""
    dx = v[0] - p[0]
    dy = v[1] - p[1]
    dz = v[2] - p[2]
    out[0] = r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz
    out[1] = r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz
    out[2] = r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz


# long: a chain of tests, cheapest first, in one compiled loop.
@nb.njit(cache=True)
def _near(
    part: int,
    first_box: int,
    last_box: int,
    p: FloatArray,
    r: FloatArray,
    boxes: FloatArray,
    model: Model,
    points: FloatArray,
    planes: FloatArray,
) -> int:
    """Bit mask of the boxes that the cheap tests can't separate from a part.

    Unless the mask is 0, ``points`` and ``planes`` then hold the part's vertices and planes, tool frame.
    """
    vertices, vertex_start, all_planes, plane_start, _, _, centres, radii = model
    centre = points[0]
    _to_tool(centres[part], p, r, centre)
    mask = 0
    for b in range(first_box, last_box):
        d2 = 0.0
        for a in range(3):
            d = abs(centre[a] - boxes[b, 0, a]) - boxes[b, 1, a]
            if d > 0.0:
                d2 += d * d
        if d2 <= radii[part] * radii[part]:
            mask |= 1 << b
    if mask == 0:
        return 0

    low0 = low1 = low2 = _INF
    high0 = high1 = high2 = -_INF
    start = vertex_start[part]
    for v in range(vertex_start[part + 1] - start):
        point = points[v]
        _to_tool(vertices[start + v], p, r, point)
        low0 = min(low0, point[0])
        high0 = max(high0, point[0])
        low1 = min(low1, point[1])
        high1 = max(high1, point[1])
        low2 = min(low2, point[2])
        high2 = max(high2, point[2])
    for b in range(first_box, last_box):
        c = boxes[b, 0]
        h = boxes[b, 1]
        if (
            low0 > c[0] + h[0]
            or high0 < c[0] - h[0]
            or low1 > c[1] + h[1]
            or high1 < c[1] - h[1]
            or low2 > c[2] + h[2]
            or high2 < c[2] - h[2]
        ):
            mask &= ~(1 << b)
    if mask == 0:
        return 0

    start = plane_start[part]
    for m in range(plane_start[part + 1] - start):
        n = all_planes[start + m]
        nx = r[0, 0] * n[0] + r[1, 0] * n[1] + r[2, 0] * n[2]
        ny = r[0, 1] * n[0] + r[1, 1] * n[1] + r[2, 1] * n[2]
        nz = r[0, 2] * n[0] + r[1, 2] * n[1] + r[2, 2] * n[2]
        d = n[3] - n[0] * p[0] - n[1] * p[1] - n[2] * p[2]
        planes[m, 0] = nx
        planes[m, 1] = ny
        planes[m, 2] = nz
        planes[m, 3] = d
        for b in range(first_box, last_box):
            c = boxes[b, 0]
            h = boxes[b, 1]
            nearest = nx * c[0] + ny * c[1] + nz * c[2] - abs(nx) * h[0] - abs(ny) * h[1] - abs(nz) * h[2]
            if nearest > d:
                mask &= ~(1 << b)
        if mask == 0:
            return 0
    return mask


# long: two loops over the same poses that share their buffers.
@nb.njit(cache=True, nogil=True)
def classify(
    positions: FloatArray,
    quaternions: FloatArray,
    boxes: FloatArray,
    model: Model,
    contact: bool,
    codes: npt.NDArray[np.uint8],
    extents: FloatArray,
) -> None:
    """Fill codes (0 collides, 1 empty, 2 contact) and extents (least and greatest y between the fingers).

    positions (n, 3) and quaternions (n, 4) place the tool in the object frame; boxes (4, 2, 3) hold centre
    and half extents of three gripper boxes and of the column between the fingers; without ``contact`` only
    the collision test is made, and 1 means free.
    """
    _, vertex_start, _, plane_start, edges, edge_start, _, _ = model
    parts = vertex_start.size - 1
    most_points = 1
    most_planes = 1
    for part in range(parts):
        most_points = max(most_points, vertex_start[part + 1] - vertex_start[part])
        most_planes = max(most_planes, plane_start[part + 1] - plane_start[part])
    points = np.empty((most_points, 3))
    planes = np.empty((most_planes, 4))
    r = np.empty((3, 3))
    for i in range(positions.shape[0]):
        p = positions[i]
        _rotation(quaternions[i], r)
        extents[i, 0] = np.nan
        extents[i, 1] = np.nan
        hit = False
        for part in range(parts):
            mask = _near(part, 0, 3, p, r, boxes, model, points, planes)
            if mask == 0:
                continue
            plane_count = plane_start[part + 1] - plane_start[part]
            for b in range(3):
                if mask & (1 << b) and (
                    _box_edge_meets_part(boxes[b, 0], boxes[b, 1], planes, plane_count)
                    or _part_edge_meets_box(
                        boxes[b, 0], boxes[b, 1], points, edges, edge_start[part], edge_start[part + 1]
                    )
                ):
                    hit = True
                    break
            if hit:
                break
        if hit:
            codes[i] = 0
            continue
        codes[i] = 1
        if not contact:
            continue
        low = _INF
        high = -_INF
        for part in range(parts):
            mask = _near(part, 3, 4, p, r, boxes, model, points, planes)
            if mask == 0:
                continue
            y0, y1 = _extent_in_column(
                boxes[3, 0],
                boxes[3, 1],
                points,
                edges,
                edge_start[part],
                edge_start[part + 1],
                planes,
                plane_start[part + 1] - plane_start[part],
            )
            low = min(low, y0)
            high = max(high, y1)
        if low <= high:
            codes[i] = 2
            extents[i, 0] = low
            extents[i, 1] = high
