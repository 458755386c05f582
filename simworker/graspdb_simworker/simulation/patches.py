"""Where a jaw and an object touch, as patches of small areas: what :mod:`.carrying` balances forces on.

A finger and a convex part touch at one of the finger's faces, the one into which the part reaches least. What
of the part's surface lies over that face, and no farther from it than a reach, is cut out and divided into
small areas, each with its depth. So two faces that lie on each other touch in a whole polygon, a round side
in a strip, an edge in a line, however coarsely or finely any of them is meshed.

The pressure on such a patch acts along one normal: the direction of the integral of depth times inward normal
over the part's cut surface. By the divergence theorem that is the finger's normal where an edge, a corner or
a whole face of the part presses on it, and the part's own where its face leans on the finger's rim.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from graspdb_simworker.simulation.bodies import Gripper, MassProperties, Part

AREAS = 8192
"""Room for so many areas: what would be more is divided less finely."""
BODY, LEVER, NORMAL, AREA, DEPTH, SHEAR, OPENS, KEY, COLUMNS = 0, 3, 6, 9, 10, 11, 14, 15, 16
"""Columns of an area: its place on the object in the principal frame and from the centre of mass in the
jaw's axes (metres), the patch's normal into the object, size (m^2) and depth (m); shear (m); by how much the
finger moves along y as the jaw opens by one; and which patch it is of."""
SHALLOW_M = 0.001
"""A part that reaches less into a finger than this, from the inner side, touches that side."""
_SLOPE_M = 1e-4
"""An area's depth varies by no more than this, or it is divided further."""
_SOON_M = 1.5e-4
"""What is farther from a face is not divided: it does not come to touch it before patches are found again."""
_LEAST_COSINE = 0.2


class ConvexBody(NamedTuple):
    """An object's convex parts in its principal frame: vertices (V, 3), metres, triangles (T, 3) of them,
    where each part's begin in either, (P + 1,), and spheres around the parts, (P, 3) and (P,)."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    first_vertex: NDArray[np.int64]
    first_triangle: NDArray[np.int64]
    centres: NDArray[np.float64]
    radii: NDArray[np.float64]


class Jaw(NamedTuple):
    """The boxes of palm and fingers, metres in the tool frame: half a finger's width (x), its thickness (y),
    where it begins and ends (z); half the palm's extents (x, y), whose front is where fingers begin."""

    half_width: float
    thickness: float
    base: float
    tip: float
    palm_x: float
    palm_y: float


def body_of(parts: Sequence[Part], mass: MassProperties) -> ConvexBody:
    """Convex parts, outward faces or inward ones, as patches are cut from."""
    vertices = [mass.to_principal(np.asarray(v, dtype=np.float64)) for v, _ in parts]
    first_vertex = np.cumsum([0, *map(len, vertices)])
    triangles = []
    for (_, faces), points, first in zip(parts, vertices, first_vertex, strict=False):
        corners = points[np.asarray(faces)]
        outward = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) >= 0.0
        triangles.append(np.asarray(faces)[:, :: 1 if outward else -1] + first)
    centres = np.array([0.5 * (points.min(axis=0) + points.max(axis=0)) for points in vertices])
    spheres = zip(vertices, centres, strict=True)
    return ConvexBody(
        np.ascontiguousarray(np.concatenate(vertices)),
        np.ascontiguousarray(np.concatenate(triangles), dtype=np.int64),
        first_vertex.astype(np.int64),
        np.cumsum([0, *map(len, triangles)]).astype(np.int64),
        centres,
        np.array([np.linalg.norm(points - centre, axis=1).max() for points, centre in spheres]),
    )


def jaw_of(gripper: Gripper) -> Jaw:
    """A gripper's boxes."""
    palm_x, palm_y, _ = gripper.palm_half_extents
    return Jaw(
        0.5 * gripper.finger_width_m,
        gripper.finger_thickness_m,
        gripper.tip_offset_m - gripper.finger_length_m,
        gripper.tip_offset_m,
        palm_x,
        palm_y,
    )


@njit(cache=True)
def _clip(polygon, count, axis, sign, limit, cut):  # type: ignore[no-untyped-def]
    """What of a convex polygon (count, 3) has sign * x[axis] <= limit; returns its number of corners."""
    kept = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        here, there = sign * polygon[i, axis] - limit, sign * polygon[j, axis] - limit
        if here <= 0.0:
            cut[kept, 0], cut[kept, 1], cut[kept, 2] = polygon[i, 0], polygon[i, 1], polygon[i, 2]
            kept += 1
        if (here < 0.0 < there) or (there < 0.0 < here):
            share = here / (here - there)
            for k in range(3):
                cut[kept, k] = polygon[i, k] + share * (polygon[j, k] - polygon[i, k])
            kept += 1
    return kept


@njit(cache=True)
def _divide(stack, axis, sign, offset, spacing, size, areas, count):  # type: ignore[no-untyped-def]
    """Cut the triangle at the stack's bottom until its pieces are small, and write their centroids and sizes
    (times ``size``) as areas; returns the number of areas then. The face is as in :func:`_face`."""
    top = 1
    while top > 0:
        top -= 1
        longest, edge, nearest = 0.0, 0, -np.inf
        for i in range(3):
            j = (i + 1) % 3
            length = 0.0
            for k in range(3):
                length += (stack[top, j, k] - stack[top, i, k]) ** 2
            rise = abs(stack[top, j, axis] - stack[top, i, axis])
            length = max(math.sqrt(length) / spacing, rise / _SLOPE_M)
            if length > longest:
                longest, edge = length, i
            nearest = max(nearest, sign * (offset - stack[top, i, axis]))
        if longest <= 1.0 or nearest < -_SOON_M or top + 2 > stack.shape[0]:
            if count >= areas.shape[0]:
                return count
            ax, ay, az = stack[top, 0]
            bx, by, bz = stack[top, 1, 0] - ax, stack[top, 1, 1] - ay, stack[top, 1, 2] - az
            cx, cy, cz = stack[top, 2, 0] - ax, stack[top, 2, 1] - ay, stack[top, 2, 2] - az
            nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
            for k in range(3):
                areas[count, LEVER + k] = (stack[top, 0, k] + stack[top, 1, k] + stack[top, 2, k]) / 3.0
            areas[count, AREA] = 0.5 * math.sqrt(nx * nx + ny * ny + nz * nz) * size
            count += 1
            continue
        second = (edge + 1) % 3
        third = (edge + 2) % 3
        for k in range(3):
            middle = 0.5 * (stack[top, edge, k] + stack[top, second, k])
            stack[top + 1, 0, k], stack[top + 1, 1, k] = middle, stack[top, second, k]
            stack[top + 1, 2, k] = stack[top, third, k]
            first, last = stack[top, edge, k], stack[top, third, k]
            stack[top, 0, k], stack[top, 1, k], stack[top, 2, k] = first, middle, last
        top += 2
    return count


# long: one polygon after the other, cut, summed and divided
@njit(cache=True)
def _face(points, triangles, axis, sign, offset, low, high, reach, spacing, areas, count):  # type: ignore[no-untyped-def]
    """Cut a part's surface over one face of a box and write its areas, unless ``spacing`` is 0.

    The face is where x[axis] = offset, its normal ``sign`` along the axis, from ``low`` to ``high`` in the
    two others. Returns how many areas there are then, and how deep the part is in there at most, metres.
    """
    one, two = np.empty((12, 3)), np.empty((12, 3))
    stack = np.empty((48, 3, 3))
    deepest = -np.inf
    across, along = (axis + 1) % 3, (axis + 2) % 3
    push = np.zeros(3)
    began = count
    normal = np.empty(3)
    for t in range(triangles.shape[0]):
        a, b, c = points[triangles[t, 0]], points[triangles[t, 1]], points[triangles[t, 2]]
        if sign * offset - min(sign * a[axis], sign * b[axis], sign * c[axis]) <= -reach:
            continue
        for k in range(3):
            two[0, k], two[1, k], two[2, k] = a[k], b[k], c[k]
        # What lies beyond the opposite face is beside the box and not deep in it.
        corners = _clip(two, 3, axis, -sign, -sign * (low[axis] if sign > 0.0 else high[axis]), one)
        corners = _clip(one, corners, across, 1.0, high[across], two)
        corners = _clip(two, corners, across, -1.0, -low[across], one)
        corners = _clip(one, corners, along, 1.0, high[along], two)
        corners = _clip(two, corners, along, -1.0, -low[along], one)
        corners = _clip(one, corners, axis, sign, sign * offset + reach, two)
        if corners < 3:
            continue
        for i in range(corners):
            deepest = max(deepest, sign * (offset - two[i, axis]))
        if spacing == 0.0:
            continue
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            normal[k] = (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i])
        length = math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        if length == 0.0:
            continue
        facing = -sign * normal[axis] / length
        for i in range(1, corners - 1):
            size, middle = 0.0, 0.0
            for k in range(3):
                p, q = (k + 1) % 3, (k + 2) % 3
                e = (two[i, p] - two[0, p]) * (two[i + 1, q] - two[0, q]) - (two[i, q] - two[0, q]) * (
                    two[i + 1, p] - two[0, p]
                )
                size += e * e
                stack[0, 0, k], stack[0, 1, k], stack[0, 2, k] = two[0, k], two[i, k], two[i + 1, k]
            for m in (0, i, i + 1):
                middle += sign * (offset - two[m, axis]) / 3.0
            for k in range(3):
                push[k] -= 0.5 * math.sqrt(size) * (middle + reach) * normal[k] / length
            if facing > 1e-3:
                count = _divide(stack, axis, sign, offset, spacing, facing, areas, count)
    if count > began:
        length = math.sqrt(push[0] ** 2 + push[1] ** 2 + push[2] ** 2)
        cosine = sign * push[axis] / length if length > 0.0 else 0.0
        if cosine < _LEAST_COSINE:
            push[:] = 0.0
            push[axis], length, cosine = sign, 1.0, 1.0
        for i in range(began, count):
            areas[i, DEPTH] = sign * (offset - areas[i, LEVER + axis]) * cosine
            for k in range(3):
                areas[i, NORMAL + k] = push[k] / length
    return count, deepest


@njit(cache=True)
def _touched_face(points, triangles, low, high, side, reach):  # type: ignore[no-untyped-def]
    """Which face of a finger's box a part touches: (axis, sign), or sign 0 for none.

    ``side`` is the sign of its inner face's normal along y.
    """
    deep = -np.inf
    for v in range(points.shape[0]):
        reached = high[1] - points[v, 1] if side > 0.0 else points[v, 1] - low[1]
        deep = max(deep, reached)
    if deep < SHALLOW_M:
        return 1, side
    best, best_axis, best_sign = np.inf, 1, 0.0
    for axis, sign in ((1, side), (2, 1.0), (0, 1.0), (0, -1.0)):
        offset = high[axis] if sign > 0.0 else low[axis]
        _, depth = _face(points, triangles, axis, sign, offset, low, high, reach, 0.0, np.empty((0, 1)), 0)
        if -reach < depth < best:
            best, best_axis, best_sign = depth, axis, sign
    return best_axis, best_sign


# long: boxes by parts, with what is told apart for each
@njit(cache=True)
def find_areas(body, jaw, centre, axes, fingers, reach, spacing, areas):  # type: ignore[no-untyped-def]
    """Write the areas (n, COLUMNS) in which an object touches a jaw or comes nearer than ``reach``; none if
    ``spacing`` is 0.

    The object's ``centre`` of mass and principal ``axes`` (3, 3), columns, are in the tool frame; ``fingers``
    (2,) how far the inner faces are from y = 0: the first at -y. Returns n, and (2,) how deep the object is
    in either finger's inner side at most, -inf where it is not near. Shear is 0.
    """
    count = 0
    deepest = np.full(2, -np.inf)
    low, high, middle = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for finger in range(2):
        low[finger, 0], high[finger, 0] = -jaw.half_width, jaw.half_width
        low[finger, 2], high[finger, 2] = jaw.base, jaw.tip
    low[0, 1], high[0, 1] = -fingers[0] - jaw.thickness, -fingers[0]
    low[1, 1], high[1, 1] = fingers[1], fingers[1] + jaw.thickness
    # Of the palm only the front: what is beside or behind it never came between the fingers.
    low[2, 0], high[2, 0], low[2, 1], high[2, 1] = -jaw.palm_x, jaw.palm_x, -jaw.palm_y, jaw.palm_y
    low[2, 2], high[2, 2] = jaw.base - jaw.thickness, jaw.base
    for part in range(body.radii.shape[0]):
        for k in range(3):
            middle[k] = centre[k]
            for m in range(3):
                middle[k] += axes[k, m] * body.centres[part, m]
        radius = body.radii[part] + reach
        near = False
        for box in range(3):
            apart = 0.0
            for k in range(3):
                apart += max(0.0, low[box, k] - middle[k], middle[k] - high[box, k]) ** 2
            near = near or apart < radius * radius
        if not near:
            continue
        first, last = body.first_vertex[part], body.first_vertex[part + 1]
        points = np.empty((last - first, 3))
        least, most = np.full(3, np.inf), np.full(3, -np.inf)
        for v in range(first, last):
            for k in range(3):
                x = centre[k]
                for m in range(3):
                    x += axes[k, m] * body.vertices[v, m]
                points[v - first, k] = x
                least[k], most[k] = min(least[k], x), max(most[k], x)
        triangles = body.triangles[body.first_triangle[part] : body.first_triangle[part + 1]] - first
        for box in range(3):
            apart = False
            for k in range(3):
                apart = apart or least[k] > high[box, k] + reach or most[k] < low[box, k] - reach
            if apart:
                continue
            axis, sign = 2, 1.0
            if box < 2:
                side = 1.0 if box == 0 else -1.0
                axis, sign = _touched_face(points, triangles, low[box], high[box], side, reach)
            if sign == 0.0:
                continue
            offset = high[box, axis] if sign > 0.0 else low[box, axis]
            began = count
            count, depth = _face(
                points, triangles, axis, sign, offset, low[box], high[box], reach, spacing, areas, count
            )
            if box < 2 and axis == 1:
                deepest[box] = max(deepest[box], depth)
            for i in range(began, count):
                areas[i, KEY] = 12.0 * part + 4.0 * box + axis
                areas[i, OPENS] = 0.0 if box == 2 else (-1.0 if box == 0 else 1.0)
                for k in range(3):
                    areas[i, LEVER + k] -= centre[k]
                    areas[i, SHEAR + k] = 0.0
                for k in range(3):
                    areas[i, BODY + k] = (
                        axes[0, k] * areas[i, LEVER]
                        + axes[1, k] * areas[i, LEVER + 1]
                        + axes[2, k] * areas[i, LEVER + 2]
                    )
    return count, deepest
