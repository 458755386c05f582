"""Triangles of polygons of any shape: convex, concave, with a bridge to a hole, a little bent."""

from __future__ import annotations

from collections.abc import Sequence

import manifold3d
import numpy as np
import numpy.typing as npt

from graspdb_geometry.mesh_reading.content import FaceArray, FloatArray, FormatError

IntArray = npt.NDArray[np.int64]

#: A polygon whose triangles cover more than its outline by this share of its squared length crosses itself.
_CROSSING_SHARE = 1e-4


def triangles_of(vertices: FloatArray, corners: Sequence[int] | IntArray, lengths: IntArray) -> FaceArray:
    """Split polygons into triangles with the same winding.

    Parameters
    ----------
    vertices : (V, 3) float64
    corners : (sum of lengths,) int
        Vertex of each corner, polygon after polygon.
    lengths : (P,) int
        Corners of each polygon, 3 at least.

    Returns
    -------
    (sum of lengths - 2 P, 3) int64

    Raises
    ------
    FormatError
        A corner that does not exist, or a polygon that crosses itself.
    """
    try:
        flat = np.asarray(corners, dtype=np.int64)
    except OverflowError:
        raise FormatError("a face refers to a vertex that does not exist") from None
    if flat.size and (int(flat.min()) < 0 or int(flat.max()) >= len(vertices)):
        raise FormatError("a face refers to a vertex that does not exist")
    first = np.cumsum(lengths) - lengths
    found = [flat[first[lengths == 3, None] + np.arange(3)]]
    for length in np.unique(lengths[lengths > 3]).tolist():
        polygons = flat[first[lengths == length, None] + np.arange(length)]
        fan = np.array([(0, k, k + 1) for k in range(1, length - 1)], dtype=np.int64)
        convex = _are_convex(vertices, polygons)
        found.append(polygons[convex][:, fan].reshape(-1, 3))
        found.extend(polygon[_clipped(vertices[polygon])] for polygon in polygons[~convex])
    return np.concatenate(found)


def flattened(points: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """A ring of points (n, 3) in its own plane (n, 2), counter-clockwise, and heights above it (n,).

    None if the ring encloses no area.
    """
    centred = points - points.mean(axis=0)
    # Twice the vector area of the ring (Newell): its normal, whichever way it bends.
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    area = float(np.linalg.norm(normal))
    size = float(np.linalg.norm(centred, axis=1).max())
    if area <= 1e-6 * size * size:
        return None
    normal /= area
    u = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    u /= np.linalg.norm(u)
    flat = np.stack([centred @ u, centred @ np.cross(normal, u)], axis=1)
    return flat, np.asarray(centred @ normal)


def clip_ears(ring: FloatArray) -> IntArray | None:
    """Triangles (n - 2, 3) of a counter-clockwise ring (n, 2); None if it crosses itself."""
    triangles = np.asarray(manifold3d.triangulate([ring]), dtype=np.int64)
    if len(triangles) != len(ring) - 2:
        return None
    covered = float(np.abs(_signed_areas(ring, triangles)).sum())
    x, y = ring.T
    enclosed = 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    length = float(np.linalg.norm(ring - np.roll(ring, -1, axis=0), axis=1).sum())
    return triangles if covered - enclosed <= _CROSSING_SHARE * length * length / 12 else None


def fan_of_line(ring: IntArray) -> FaceArray:
    """Triangles (n - 2, 3) without area over a ring of vertices (n,) that lie on a line."""
    first = np.full(len(ring) - 2, ring[0])
    return np.stack([first, ring[1:-1], ring[2:]], axis=1)


def _signed_areas(points: FloatArray, triangles: IntArray) -> FloatArray:
    a, b, c = (points[triangles[:, k]] for k in range(3))
    first, second = b - a, c - a
    return np.asarray(0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]))


def _are_convex(vertices: FloatArray, polygons: IntArray) -> npt.NDArray[np.bool_]:
    """Which of polygons (P, n) turn one way at every corner and once around, so that a fan covers them."""
    points = vertices[polygons]
    points = points - points.mean(axis=1, keepdims=True)
    following, before = np.roll(points, -1, axis=1), np.roll(points, 1, axis=1)
    normal = np.cross(points, following).sum(axis=1, keepdims=True)
    turns = np.einsum("pnk,pnk->pn", np.cross(points - before, following - points), normal)
    spokes = points[:, 1:] - points[:, :1]
    fans = np.einsum("pnk,pnk->pn", np.cross(spokes[:, :-1], spokes[:, 1:]), normal)
    scale = 1e-9 * np.einsum("pnk,pnk->p", normal, normal)[:, None]
    return np.asarray(np.all(turns >= -scale, axis=1) & np.all(fans >= -scale, axis=1) & (scale[:, 0] > 0))


def _clipped(points: FloatArray) -> IntArray:
    plane = flattened(points)
    ears = None if plane is None else clip_ears(plane[0])
    if ears is not None:
        return ears
    if plane is None and lie_on_a_line(points):
        # No area, but its neighbours count on its edges.
        return fan_of_line(np.arange(len(points)))
    raise FormatError(
        f"a polygon of {len(points)} corners crosses itself: mend or triangulate it where the file was made"
    )


def lie_on_a_line(points: FloatArray) -> bool:
    """Whether points (n, 3) leave a line by a ten-thousandth of their extent at most."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= 1e-4 * spread[0])
