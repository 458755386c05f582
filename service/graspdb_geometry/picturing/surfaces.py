"""Surfaces to be drawn: triangles with a colour, and normals that are smooth where the surface is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Colour = tuple[float, float, float]

_CREASE = math.cos(math.radians(38.0))
"""Triangles that meet at a corner by less than this angle are one smooth surface."""
_MOST_SMOOTH = 200_000
"""Triangles of a surface that is smoothed: of more, each is smaller than a pixel."""
_MOST_AT_CORNER = 64


@dataclass(frozen=True, eq=False)
class Body:
    """Triangles by their corners (n, 3, 3) in metres, the normals (n, 3, 3) there, and a colour, 0 to 1."""

    corners: Floats
    normals: Floats
    colour: Colour

    @classmethod
    def of_mesh(cls, vertices: Floats, faces: NDArray[np.int64], colour: Colour) -> Body:
        """A mesh, vertices (v, 3) and faces (n, 3), smooth but for its creases."""
        corners = np.asarray(vertices, dtype=np.float64)[faces]
        return cls(corners, _smooth(corners, np.asarray(faces)), colour)

    @classmethod
    def of_box(cls, half: Floats, centre: Floats, pose: Floats, colour: Colour) -> Body:
        """A box with these half extents (3,) about a centre (3,), in the frame of a pose (4, 4)."""
        corners = (np.asarray(centre) + np.asarray(half) * _BOX) @ pose[:3, :3].T + pose[:3, 3]
        flat = np.repeat(_flat(corners)[:, None], 3, axis=1)
        return cls(corners, flat, colour)

    @property
    def points(self) -> Floats:
        """All corners, (3 n, 3)."""
        return self.corners.reshape(-1, 3)


def _box() -> Floats:
    """Triangles (12, 3, 3) of the cube from -1 to 1, counter-clockwise from outside."""
    found = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
            if side < 0:
                square = square[::-1]
            corners = np.empty((4, 3))
            corners[:, axis] = side
            corners[:, (axis + 1) % 3], corners[:, (axis + 2) % 3] = square[:, 0], square[:, 1]
            found += [corners[[0, 1, 2]], corners[[0, 2, 3]]]
    return np.array(found)


_BOX = _box()


def _flat(corners: Floats) -> Floats:
    """Unit normals (n, 3) of triangles; zero for those without an area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(np.divide(normals, length, out=np.zeros_like(normals), where=length > 0))


def _smooth(corners: Floats, faces: NDArray[np.int64]) -> Floats:
    """Normals (n, 3, 3) at the corners of triangles: the mean of those around that bend little, by angle."""
    flat = _flat(corners)
    own = np.repeat(flat[:, None], 3, axis=1)
    if len(faces) > _MOST_SMOOTH:
        return own
    before, after = np.roll(corners, 1, axis=1) - corners, np.roll(corners, -1, axis=1) - corners
    lengths = np.linalg.norm(before, axis=2) * np.linalg.norm(after, axis=2)
    cosine = np.einsum("nij,nij->ni", before, after) / np.maximum(lengths, 1e-300)
    weighted = (np.arccos(np.clip(cosine, -1.0, 1.0))[..., None] * flat[:, None]).reshape(-1, 3)
    flat_of = np.repeat(flat, 3, axis=0)
    order = np.argsort(faces.ravel(), kind="stable")
    _, starts, counts = np.unique(faces.ravel()[order], return_index=True, return_counts=True)
    total = own.reshape(-1, 3).copy()
    few = counts <= _MOST_AT_CORNER
    for count in np.unique(counts[few]):
        # All vertices with as many corners at once: (m, count) corners of each.
        at = order[starts[few & (counts == count)][:, None] + np.arange(count)]
        alike = np.einsum("mic,mjc->mij", flat_of[at], flat_of[at]) > _CREASE
        total[at] = np.einsum("mij,mjc->mic", alike, weighted[at])
    length = np.linalg.norm(total, axis=1, keepdims=True)
    smooth = np.where(length > 1e-12, total / np.maximum(length, 1e-300), own.reshape(-1, 3))
    return smooth.reshape(-1, 3, 3)
