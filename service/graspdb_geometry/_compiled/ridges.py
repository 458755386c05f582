"""Numba kernels of ridges: which points lie inside a solid, and the segment nearest to a point."""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import numba as nb
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@nb.njit(cache=True, nogil=True)
def inside_parts(points, planes, starts, bounds, found):
    """Fill found: whether a point (n, 3) lies in a convex part, given by its planes (n.x <= d) and bounds."""
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        found[i] = False
        for part in range(starts.shape[0] - 1):
            b = bounds[part]
            if x < b[0, 0] or y < b[0, 1] or z < b[0, 2] or x > b[1, 0] or y > b[1, 1] or z > b[1, 2]:
                continue
            held = True
            for k in range(starts[part], starts[part + 1]):
                if planes[k, 0] * x + planes[k, 1] * y + planes[k, 2] * z > planes[k, 3]:
                    held = False
                    break
            if held:
                found[i] = True
                break


@nb.njit(cache=True, inline="always")
def _squared_distance(x, a, b):
    """From a point to the segment a b."""
    d0, d1, d2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    e0, e1, e2 = x[0] - a[0], x[1] - a[1], x[2] - a[2]
    length = d0 * d0 + d1 * d1 + d2 * d2
    share = 0.0
    if length > 0.0:
        share = min(max((d0 * e0 + d1 * e1 + d2 * e2) / length, 0.0), 1.0)
    e0 -= share * d0
    e1 -= share * d1
    e2 -= share * d2
    total: float = e0 * e0 + e1 * e1 + e2 * e2
    return total


@nb.njit(cache=True, inline="always")
def _below(x, box):
    """Squared distance from a point to a box (2, 3), a lower bound for what is in it."""
    total = 0.0
    for a in range(3):
        d = max(box[0, a] - x[a], x[a] - box[1, a])
        if d > 0.0:
            total += d * d
    return total


@nb.njit(cache=True, nogil=True)
def nearest(points, segments, boxes, block, reach, tangents, normals, least_cosine, tie, which, distances):
    """Fill which: the nearest segment (S, 2, 3) of each point, -1 beyond reach, -2 at a tie; and distances.

    ``boxes`` bound ``block`` consecutive segments each. A tie is another segment no more than ``tie`` further
    away whose tangent (either sign) or normal differs by more than the angle with this cosine.
    """
    for i in range(points.shape[0]):
        x = points[i]
        best = reach * reach
        found = -1
        for b in range(boxes.shape[0]):
            if _below(x, boxes[b]) > best:
                continue
            for s in range(b * block, min((b + 1) * block, segments.shape[0])):
                d = _squared_distance(x, segments[s, 0], segments[s, 1])
                if d < best or (d == best and found < 0):
                    best = d
                    found = s
        which[i] = found
        distances[i] = np.sqrt(best) if found >= 0 else np.inf
        if found < 0:
            continue
        limit = (distances[i] + tie) ** 2
        for b in range(boxes.shape[0]):
            if which[i] == -2:
                break
            if _below(x, boxes[b]) > limit:
                continue
            for s in range(b * block, min((b + 1) * block, segments.shape[0])):
                along = 0.0
                across = 0.0
                for a in range(3):
                    along += tangents[s, a] * tangents[found, a]
                    across += normals[s, a] * normals[found, a]
                if abs(along) >= least_cosine and across >= least_cosine:
                    continue
                if _squared_distance(x, segments[s, 0], segments[s, 1]) <= limit:
                    which[i] = -2
                    break


@nb.njit(cache=True, nogil=True)
def regions(points, closing, centres, axes, half, which, cosine):
    """Fill which: of the boxes (P) that hold a point the one whose second axis is most parallel to its
    closing axis, -1 in none; and the cosine of that angle.
    """
    for i in range(points.shape[0]):
        which[i] = -1
        best = -1.0
        for p in range(centres.shape[0]):
            held = True
            for a in range(3):
                u = 0.0
                for k in range(3):
                    u += axes[p, k, a] * (points[i, k] - centres[p, k])
                if abs(u) > half[p, a]:
                    held = False
                    break
            if held:
                c = 0.0
                for k in range(3):
                    c += axes[p, k, 1] * closing[i, k]
                if abs(c) > best:
                    best = abs(c)
                    which[i] = p
        cosine[i] = best if which[i] >= 0 else np.nan
