"""Triangles of strips and fans, as OpenGL draws them."""

from __future__ import annotations

import numpy as np

from graspdb_geometry.mesh_reading.content import FaceArray


def triangles_of_strip(corners: FaceArray) -> FaceArray:
    """Triangles (n, 3) of a strip of vertex numbers (k,); -1 starts a new one. Every other one is turned."""
    found = [np.empty((0, 3), dtype=np.int64)]
    for strip in np.split(corners, np.flatnonzero(corners == -1)):
        strip = strip[strip != -1]
        if len(strip) >= 3:
            triangles = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
            triangles[1::2] = triangles[1::2, [1, 0, 2]]
            found.append(triangles)
    triangles = np.concatenate(found)
    # Strips turn corners and jump by triangles that repeat a vertex.
    a, b, c = triangles.T
    return np.asarray(triangles[(a != b) & (b != c) & (c != a)])


def triangles_of_fan(corners: FaceArray) -> FaceArray:
    """Triangles (k - 2, 3) of a fan of vertex numbers (k,)."""
    return np.stack([np.full(max(len(corners) - 2, 0), corners[0]), corners[1:-1], corners[2:]], axis=1)
