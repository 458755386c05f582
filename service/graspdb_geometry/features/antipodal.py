"""Opposed points of a surface: where a parallel jaw can close on curved or finely meshed objects.

Plane faces and ridges (`jaw_pairs`) tell all of an object of few faces, and nothing of a smooth one, whose
facets are too small to be faces. Here points are spread over the surface, and each is paired with the point
opposite: their normals look away from each other, and the way from one to the other runs along them.

Lengths are metres in the object frame.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from graspdb_geometry.features.jaw_pairs import JawPairs, spread_points
from graspdb_geometry.features.ridges import Solid, unit

__all__ = ["opposed_points"]

FloatArray = npt.NDArray[np.float64]

_POINTS, _BLOCK = 2_000, 256
#: How far normals may be from opposed, and the way between two points from their mean normal: what friction
#: holds, and twice that, for a point that lies exactly opposite is seldom among those drawn.
_OPPOSED, _ACROSS = math.cos(math.radians(15.0)), math.cos(math.radians(30.0))
_LEAST_GAP_M, _OUTSIDE_M = 5e-4, 1e-4


def opposed_points(corners: npt.ArrayLike, solid: Solid | None, *, opening_m: float) -> JawPairs:
    """Pairs of opposed points on triangles, at most one a point; always the same ones.

    Parameters
    ----------
    corners : (F, 3, 3) metres
        Triangles, counterclockwise seen from outside.
    solid
        What they bound: points inside of it, between parts that overlap, are left out. None: not known.
    opening_m : float
        How far the jaw opens.

    Returns
    -------
    JawPairs
        Of the kind ``surfaces``; regions without extent along e and f.
    """
    if not (math.isfinite(opening_m) and opening_m > 0.0):
        raise ValueError("opening_m must be positive")
    points, normals = _spread(np.asarray(corners, dtype=np.float64))
    if solid is not None and len(points):
        outside = ~solid(points + _OUTSIDE_M * normals)
        points, normals = points[outside], normals[outside]
    first, second = _opposite(points, normals, opening_m)
    c = unit(normals[first] - normals[second])
    gap = np.einsum("pi,pi->p", points[first] - points[second], c)
    helper = np.eye(3)[np.argmin(np.abs(c), axis=1)]
    e = unit(np.cross(helper, c))
    half = np.zeros((len(first), 3))
    half[:, 1] = 0.5 * gap
    return JawPairs(
        np.zeros(len(first), dtype=np.int64),
        np.ascontiguousarray(points[first] - 0.5 * gap[:, None] * c),
        np.ascontiguousarray(np.stack([e, c, np.cross(e, c)], axis=-1)),
        half,
    )


def _spread(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3), evenly by area, and the normals there."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    if not area.sum() > 0.0:
        return np.empty((0, 3)), np.empty((0, 3))
    points, chosen = spread_points(corners, area, _POINTS, np.random.default_rng(0))
    return points, unit(cross[chosen])


def _opposite(
    points: FloatArray, normals: FloatArray, opening_m: float
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Points that have an opposite one, and the one that lies most exactly opposite."""
    found = np.full(len(points), -1, dtype=np.intp)
    for start in range(0, len(points), _BLOCK):
        one, other = np.nonzero(normals[start : start + _BLOCK] @ normals.T <= -_OPPOSED)
        one += start
        apart = points[one] - points[other]
        gap = np.einsum("pi,pi->p", apart, unit(normals[one] - normals[other]))
        across = gap / np.maximum(np.linalg.norm(apart, axis=1), 1e-12)
        good = (gap > _LEAST_GAP_M) & (gap <= opening_m) & (across >= _ACROSS)
        # The last one written stands.
        order = np.flatnonzero(good)[np.argsort(across[good], kind="stable")]
        found[one[order]] = other[order]
    first = np.flatnonzero(found >= 0)
    return first, found[first]
