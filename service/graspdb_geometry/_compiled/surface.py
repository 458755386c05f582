"""Numba kernels: gripper boxes against a triangle surface, through a tree of bounding boxes.

A box and a triangle are apart exactly when an axis separates them.  A box that meets no triangle lies wholly
inside or outside of a closed surface: a ray from its centre tells, or where it grazes an edge the winding
number (van Oosterom and Strackee, "The solid angle of a plane triangle", IEEE TBME 30, 1983).
"""

from __future__ import annotations

import numba as nb
import numpy as np
import numpy.typing as npt

from graspdb_geometry._compiled.convex import _rotation, _to_tool

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
#: Node boxes (M, 2, 3) as centre and half extents; for an inner node the numbers of its children, for a leaf
#: first = -1 - begin and second = end of its triangles; triangles' corners (F, 3, 3) in the leaves' order.
Tree = tuple[FloatArray, IntArray, FloatArray]

_STACK = 128
#: Ray direction of the inside test and two directions that complete it to a right-handed frame (rows 2, 0,
#: 1); askew, so that it seldom meets an edge of an object aligned with the axes.
_RAY = np.array(
    [
        [-0.4771563349473102, 0.8788184294947678, 0.0],
        [-0.35996881525897373, -0.19544583365535792, 0.9122627791090749],
        [0.8017133428231696, 0.4352919641885339, 0.4096054465606958],
    ]
)


@nb.njit(cache=True, inline="always")
def _boxes_apart(
    c: FloatArray, h: FloatArray, node: FloatArray, p: FloatArray, r: FloatArray, centre: FloatArray
) -> bool:
    """Whether a face direction of either box separates the tool's box from a node's (conservative)."""
    _to_tool(node[0], p, r, centre)
    d0 = centre[0] - c[0]
    d1 = centre[1] - c[1]
    d2 = centre[2] - c[2]
    n = node[1]
    if abs(d0) > h[0] + n[0] * abs(r[0, 0]) + n[1] * abs(r[1, 0]) + n[2] * abs(r[2, 0]):
        return True
    if abs(d1) > h[1] + n[0] * abs(r[0, 1]) + n[1] * abs(r[1, 1]) + n[2] * abs(r[2, 1]):
        return True
    if abs(d2) > h[2] + n[0] * abs(r[0, 2]) + n[1] * abs(r[1, 2]) + n[2] * abs(r[2, 2]):
        return True
    for a in range(3):
        d = r[a, 0] * d0 + r[a, 1] * d1 + r[a, 2] * d2
        if abs(d) > n[a] + h[0] * abs(r[a, 0]) + h[1] * abs(r[a, 1]) + h[2] * abs(r[a, 2]):
            return True
    return False


@nb.njit(cache=True, inline="always")
def _apart(a: float, b: float, reach: float) -> bool:
    """Whether an interval from a to b, or b to a, lies outside of -reach to reach."""
    return min(a, b) > reach or max(a, b) < -reach


@nb.njit(cache=True)
def _box_meets_triangle(h: FloatArray, t: FloatArray) -> bool:
    """Whether no axis separates a box about the origin (half extents h, along the axes) from a triangle.

    Axes: the box's, the triangle's normal, the products of their edges (Akenine-Moller, "Fast 3D
    triangle-box overlap testing", J. Graphics Tools 6, 2001).
    """
    for k in range(3):
        if min(t[0, k], t[1, k], t[2, k]) > h[k] or max(t[0, k], t[1, k], t[2, k]) < -h[k]:
            return False
    for v in range(3):
        if abs(t[v, 0]) <= h[0] and abs(t[v, 1]) <= h[1] and abs(t[v, 2]) <= h[2]:
            return True
    a0, a1, a2 = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    b0, b1, b2 = t[2, 0] - t[1, 0], t[2, 1] - t[1, 1], t[2, 2] - t[1, 2]
    n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    if abs(n0 * t[0, 0] + n1 * t[0, 1] + n2 * t[0, 2]) > h[0] * abs(n0) + h[1] * abs(n1) + h[2] * abs(n2):
        return False
    for v in range(3):
        # Both ends of an edge are at the same place of an axis that is perpendicular to it.
        w, u = (v + 1) % 3, (v + 2) % 3
        e0, e1, e2 = t[w, 0] - t[v, 0], t[w, 1] - t[v, 1], t[w, 2] - t[v, 2]
        a, b = e1 * t[v, 2] - e2 * t[v, 1], e1 * t[u, 2] - e2 * t[u, 1]
        if _apart(a, b, h[1] * abs(e2) + h[2] * abs(e1)):
            return False
        a, b = e2 * t[v, 0] - e0 * t[v, 2], e2 * t[u, 0] - e0 * t[u, 2]
        if _apart(a, b, h[0] * abs(e2) + h[2] * abs(e0)):
            return False
        a, b = e0 * t[v, 1] - e1 * t[v, 0], e0 * t[u, 1] - e1 * t[u, 0]
        if _apart(a, b, h[0] * abs(e1) + h[1] * abs(e0)):
            return False
    return True


@nb.njit(cache=True)
def _meets(
    c: FloatArray, h: FloatArray, p: FloatArray, r: FloatArray, tree: Tree, stack: IntArray, room: FloatArray
) -> bool:
    """Whether the tool's box with centre c and half extents h meets a triangle of the tree.

    ``room`` (8, 3) is written to. Nodes are compared with the box about the tool's box first, which takes
    three differences.
    """
    nodes, links, triangles = tree
    about, reach, size, t = room[0], room[1], room[2:5], room[5:8]
    for k in range(3):
        about[k] = p[k] + r[k, 0] * c[0] + r[k, 1] * c[1] + r[k, 2] * c[2]
        for i in range(3):
            size[k, i] = abs(r[k, i])
        reach[k] = size[k, 0] * h[0] + size[k, 1] * h[1] + size[k, 2] * h[2]
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        d0, n0 = nodes[node, 0, 0] - about[0], nodes[node, 1, 0]
        if abs(d0) > n0 + reach[0]:
            continue
        d1, n1 = nodes[node, 0, 1] - about[1], nodes[node, 1, 1]
        if abs(d1) > n1 + reach[1]:
            continue
        d2, n2 = nodes[node, 0, 2] - about[2], nodes[node, 1, 2]
        if abs(d2) > n2 + reach[2]:
            continue
        apart = False
        for k in range(3):
            d = abs(d0 * r[0, k] + d1 * r[1, k] + d2 * r[2, k])
            if d > h[k] + n0 * size[0, k] + n1 * size[1, k] + n2 * size[2, k]:
                apart = True
                break
        if apart:
            continue
        if links[node, 0] >= 0:
            stack[depth] = links[node, 0]
            stack[depth + 1] = links[node, 1]
            depth += 2
            continue
        for f in range(-1 - links[node, 0], links[node, 1]):
            for v in range(3):
                d0 = triangles[f, v, 0] - about[0]
                d1 = triangles[f, v, 1] - about[1]
                d2 = triangles[f, v, 2] - about[2]
                for k in range(3):
                    t[v, k] = d0 * r[0, k] + d1 * r[1, k] + d2 * r[2, k]
            if _box_meets_triangle(h, t):
                return True
    return False


@nb.njit(cache=True)
def winding_number(x: FloatArray, triangles: FloatArray) -> float:
    """How often the surface winds about the point x: about 1 inside a closed outward surface, 0 outside."""
    total = 0.0
    for f in range(triangles.shape[0]):
        ax = triangles[f, 0, 0] - x[0]
        ay = triangles[f, 0, 1] - x[1]
        az = triangles[f, 0, 2] - x[2]
        bx = triangles[f, 1, 0] - x[0]
        by = triangles[f, 1, 1] - x[1]
        bz = triangles[f, 1, 2] - x[2]
        cx = triangles[f, 2, 0] - x[0]
        cy = triangles[f, 2, 1] - x[1]
        cz = triangles[f, 2, 2] - x[2]
        la = np.sqrt(ax * ax + ay * ay + az * az)
        lb = np.sqrt(bx * bx + by * by + bz * bz)
        lc = np.sqrt(cx * cx + cy * cy + cz * cz)
        volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        dots = (ax * bx + ay * by + az * bz) * lc
        dots += (bx * cx + by * cy + bz * cz) * la
        dots += (cx * ax + cy * ay + cz * az) * lb
        total += np.arctan2(volume, la * lb * lc + dots)
    return total / (2.0 * np.pi)


@nb.njit(cache=True)
def inside(x: FloatArray, tree: Tree, stack: IntArray) -> bool:
    """Whether the closed surface winds about the point x: signed crossings of a ray.

    A ray that passes too close to an edge for rounding leaves the answer to the winding number, which is
    slower by far.
    """
    nodes, links, triangles = tree
    d = _RAY[2]
    crossings = 0
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        t0 = 0.0
        t1 = np.inf
        for a in range(3):
            low = (nodes[node, 0, a] - nodes[node, 1, a] - x[a]) / d[a]
            high = (nodes[node, 0, a] + nodes[node, 1, a] - x[a]) / d[a]
            t0 = max(t0, min(low, high))
            t1 = min(t1, max(low, high))
        if t0 > t1 + 1e-12:
            continue
        if links[node, 0] >= 0:
            stack[depth] = links[node, 0]
            stack[depth + 1] = links[node, 1]
            depth += 2
            continue
        for f in range(-1 - links[node, 0], links[node, 1]):
            t = triangles[f]
            u0, v0, s0 = _ray_frame(t[0], x)
            u1, v1, s1 = _ray_frame(t[1], x)
            u2, v2, s2 = _ray_frame(t[2], x)
            w0 = u1 * v2 - v1 * u2
            w1 = u2 * v0 - v2 * u0
            w2 = u0 * v1 - v0 * u1
            size = max(abs(u0), abs(v0), abs(u1), abs(v1), abs(u2), abs(v2))
            close = 1e-13 * size * size
            if (w0 > close or w1 > close or w2 > close) and (w0 < -close or w1 < -close or w2 < -close):
                continue
            total = w0 + w1 + w2
            if abs(w0) <= close or abs(w1) <= close or abs(w2) <= close:
                return winding_number(x, triangles) > 0.5
            if w0 * s0 + w1 * s1 + w2 * s2 > 0.0 and total > 0.0:
                crossings += 1
            elif w0 * s0 + w1 * s1 + w2 * s2 < 0.0 and total < 0.0:
                crossings -= 1
    return crossings > 0


@nb.njit(cache=True, inline="always")
def _ray_frame(point: FloatArray, x: FloatArray) -> tuple[float, float, float]:
    """Coordinates of a point seen from x: two across the ray, one along it."""
    e = _RAY
    dx = point[0] - x[0]
    dy = point[1] - x[1]
    dz = point[2] - x[2]
    return (
        e[0, 0] * dx + e[0, 1] * dy + e[0, 2] * dz,
        e[1, 0] * dx + e[1, 1] * dy + e[1, 2] * dz,
        e[2, 0] * dx + e[2, 1] * dy + e[2, 2] * dz,
    )


@nb.njit(cache=True, nogil=True)
def collides(
    positions: FloatArray,
    quaternions: FloatArray,
    boxes: FloatArray,
    tree: Tree,
    solid: bool,
    hits: npt.NDArray[np.bool_],
) -> None:
    """Fill hits: whether a box (B, 2, 3: centre, half extents; tool frame) overlaps the surface or solid."""
    nodes = tree[0]
    r = np.empty((3, 3))
    room = np.empty((8, 3))
    centre = np.empty(3)
    stack = np.empty(_STACK, dtype=np.int64)
    for i in range(positions.shape[0]):
        p = positions[i]
        _rotation(quaternions[i], r)
        hit = False
        for b in range(boxes.shape[0]):
            if _meets(boxes[b, 0], boxes[b, 1], p, r, tree, stack, room):
                hit = True
                break
        if not hit and solid:
            for b in range(boxes.shape[0]):
                outside = False
                for a in range(3):
                    centre[a] = (
                        p[a] + r[a, 0] * boxes[b, 0, 0] + r[a, 1] * boxes[b, 0, 1] + r[a, 2] * boxes[b, 0, 2]
                    )
                    if abs(centre[a] - nodes[0, 0, a]) > nodes[0, 1, a]:
                        outside = True
                if not outside and inside(centre, tree, stack):
                    hit = True
                    break
        hits[i] = hit


@nb.njit(cache=True, nogil=True)
def contains(points: FloatArray, tree: Tree, found: npt.NDArray[np.bool_]) -> None:
    """Fill found: whether a point (n, 3) lies in the union of the solids that the surfaces bound."""
    nodes = tree[0]
    stack = np.empty(_STACK, dtype=np.int64)
    for i in range(points.shape[0]):
        found[i] = True
        for a in range(3):
            if abs(points[i, a] - nodes[0, 0, a]) > nodes[0, 1, a]:
                found[i] = False
        if found[i]:
            found[i] = inside(points[i], tree, stack)


@nb.njit(cache=True, nogil=True)
def points_collide(
    positions: FloatArray,
    quaternions: FloatArray,
    boxes: FloatArray,
    points: FloatArray,
    radius: float,
    hits: npt.NDArray[np.bool_],
) -> None:
    """Fill hits: whether a ball about one of the points overlaps a box (B, 2, 3: centre, half extents)."""
    r = np.empty((3, 3))
    x = np.empty(3)
    reach = 0.0
    for b in range(boxes.shape[0]):
        far = 0.0
        for a in range(3):
            far += (abs(boxes[b, 0, a]) + boxes[b, 1, a]) ** 2
        reach = max(reach, np.sqrt(far) + radius)
    for i in range(positions.shape[0]):
        p = positions[i]
        _rotation(quaternions[i], r)
        hits[i] = False
        for k in range(points.shape[0]):
            dx = points[k, 0] - p[0]
            dy = points[k, 1] - p[1]
            dz = points[k, 2] - p[2]
            if dx * dx + dy * dy + dz * dz > reach * reach:
                continue
            _to_tool(points[k], p, r, x)
            for b in range(boxes.shape[0]):
                d2 = 0.0
                for a in range(3):
                    d = abs(x[a] - boxes[b, 0, a]) - boxes[b, 1, a]
                    if d > 0.0:
                        d2 += d * d
                if d2 <= radius * radius:
                    hits[i] = True
                    break
            if hits[i]:
                break
