"""Numba kernels: how much of a triangle surface stands between open fingers."""

from __future__ import annotations

import numba as nb
import numpy as np
import numpy.typing as npt

from graspdb_geometry._compiled.convex import _rotation, _to_tool
from graspdb_geometry._compiled.surface import _STACK, Tree, _boxes_apart

FloatArray = npt.NDArray[np.float64]

#: A triangle cut by six planes has at most this many corners.
_CORNERS = 9


@nb.njit(cache=True)
def _cut(polygon: FloatArray, count: int, axis: int, sign: float, limit: float, out: FloatArray) -> int:
    """The part of a polygon with ``sign * x[axis] <= limit`` (Sutherland and Hodgman, CACM 17, 1974)."""
    kept = 0
    for i in range(count):
        a = polygon[i]
        b = polygon[(i + 1) % count]
        da = sign * a[axis] - limit
        db = sign * b[axis] - limit
        if da <= 0.0:
            out[kept] = a
            kept += 1
        if (da < 0.0 < db) or (db < 0.0 < da):
            t = da / (da - db)
            for k in range(3):
                out[kept, k] = a[k] + t * (b[k] - a[k])
            kept += 1
    return kept


@nb.njit(cache=True, nogil=True)
def surface_extents(
    positions: FloatArray, quaternions: FloatArray, column: FloatArray, tree: Tree, extents: FloatArray
) -> None:
    """Fill extents (n, 2): least and greatest y of the surface inside the column (2, 3: centre, half
    extents) of each pose's tool; NaN where none is."""
    nodes, links, triangles = tree
    r = np.empty((3, 3))
    stack = np.empty(_STACK, dtype=np.int64)
    scratch = np.empty(3)
    polygon = np.empty((_CORNERS + 3, 3))
    other = np.empty((_CORNERS + 3, 3))
    c, h = column[0], column[1]
    for i in range(positions.shape[0]):
        p = positions[i]
        _rotation(quaternions[i], r)
        low, high = np.inf, -np.inf
        stack[0] = 0
        depth = 1
        while depth > 0:
            depth -= 1
            node = stack[depth]
            if _boxes_apart(c, h, nodes[node], p, r, scratch):
                continue
            # What lies between the extremes found so far is worth no look: all but a few of many triangles.
            n = nodes[node, 1]
            reach = n[0] * abs(r[0, 1]) + n[1] * abs(r[1, 1]) + n[2] * abs(r[2, 1])
            if max(scratch[1] - reach, c[1] - h[1]) >= low and min(scratch[1] + reach, c[1] + h[1]) <= high:
                continue
            if links[node, 0] >= 0:
                stack[depth] = links[node, 0]
                stack[depth + 1] = links[node, 1]
                depth += 2
                continue
            for f in range(-1 - links[node, 0], links[node, 1]):
                for v in range(3):
                    _to_tool(triangles[f, v], p, r, polygon[v])
                count = 3
                for axis in range(3):
                    count = _cut(polygon, count, axis, 1.0, c[axis] + h[axis], other)
                    count = _cut(other, count, axis, -1.0, h[axis] - c[axis], polygon)
                    if count == 0:
                        break
                for v in range(count):
                    low = min(low, polygon[v, 1])
                    high = max(high, polygon[v, 1])
        extents[i, 0] = low if low <= high else np.nan
        extents[i, 1] = high if low <= high else np.nan
