"""Triangles of an arm's solids, for those who draw it: what is drawn is what is tested."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from .arm import Floats, LinkSolid

#: Circles of latitude, and points on each, of what has a radius.
_CIRCLES, _ROUND = 7, 16


def triangles_of(solid: LinkSolid) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3) of a solid's hull, metres, in the frame of the joint that moves it, and faces (F, 3),
    counter-clockwise from outside. What has a radius is round by less than 4 % of it.
    """
    points = solid.points
    if solid.radius_m > 0.0:
        points = (points[:, None] + solid.radius_m * _directions()).reshape(-1, 3)
    hull = ConvexHull(points)
    numbers = np.full(len(points), -1, dtype=np.int64)
    numbers[hull.vertices] = np.arange(len(hull.vertices))
    vertices, faces = points[hull.vertices], numbers[hull.simplices]
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("fc,fc->f", normals, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward, ::-1]
    return vertices, faces


def _directions() -> Floats:
    polar = np.linspace(0.0, np.pi, _CIRCLES)
    turn = np.arange(_ROUND) * 2 * np.pi / _ROUND
    rings = [
        np.column_stack([np.sin(p) * np.cos(turn), np.sin(p) * np.sin(turn), np.full(_ROUND, np.cos(p))])
        for p in polar[1:-1]
    ]
    return np.concatenate([*rings, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
