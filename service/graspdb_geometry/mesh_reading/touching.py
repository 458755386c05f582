"""Which triangles of a closed surface bound one body, also where bodies touch in edges and faces."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from graspdb_geometry.mesh_reading.content import FaceArray, FloatArray

IntArray = npt.NDArray[np.int64]

#: Triangles whose directions from their edge differ by less, in radians, lie on one another.
_SAME_ANGLE = 1e-4


def is_closed(faces: FaceArray) -> bool:
    """Whether every directed edge has exactly one opposite: closed, oriented, two triangles an edge.

    Where several sheets share an edge (bodies that touch) each must still be balanced, so a solid put
    together from closed bodies passes.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = int(faces.max()) + 1
    forward = np.sort(edges[:, 0] * count + edges[:, 1])
    backward = np.sort(edges[:, 1] * count + edges[:, 0])
    return bool(np.array_equal(forward, backward))


def bodies_of(vertices: FloatArray, faces: FaceArray) -> IntArray:
    """The body (F,), from 0 on, that each triangle of a closed surface belongs to.

    At an edge of two triangles these are neighbours. At an edge of more, those are that have the inside
    between them: so bodies come apart that touch or stand twice.

    Parameters
    ----------
    vertices : (V, 3) float64
    faces : (F, 3) int
        Closed (:func:`is_closed`).
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    triangle = np.tile(np.arange(len(faces)), 3)
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, edge, count = np.unique(low * (int(edges.max()) + 1) + high, return_inverse=True, return_counts=True)
    plain = np.flatnonzero(count[edge] == 2)
    pairs = [triangle[plain[np.argsort(edge[plain], kind="stable")]].reshape(-1, 2)]
    crowded = np.flatnonzero(count[edge] > 2)
    if crowded.size:
        opens = edges[crowded, 0] > edges[crowded, 1]
        angle = _angles(vertices, faces, low[crowded], high[crowded], triangle[crowded], edge[crowded])
        pairs += _facing(edge[crowded], angle, opens, triangle[crowded])
    one, two = np.concatenate(pairs).T
    graph = coo_matrix((np.ones(len(one)), (one, two)), shape=(len(faces),) * 2)
    _, body = connected_components(graph, directed=False)
    return np.asarray(body, dtype=np.int64)


def _angles(
    vertices: FloatArray, faces: FaceArray, low: IntArray, high: IntArray, triangle: IntArray, edge: IntArray
) -> FloatArray:
    """Directions of triangles around their edge, radians counter-clockwise from one of them, seen against
    the edge's direction from its lower to its higher vertex."""
    along = vertices[high] - vertices[low]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    third = vertices[faces[triangle].sum(axis=1) - low - high] - vertices[low]
    away = third - np.einsum("ij,ij->i", third, along)[:, None] * along
    _, first, which = np.unique(edge, return_index=True, return_inverse=True)
    x = away[first][which]
    y = np.cross(along, x)
    angle = np.arctan2(np.einsum("ij,ij->i", away, y), np.einsum("ij,ij->i", away, x))
    # Rounding must not put a triangle in the same direction a whole turn away.
    return np.asarray(np.mod(angle + _SAME_ANGLE, 2 * np.pi))


def _facing(
    edge: IntArray, angle: FloatArray, opens: npt.NDArray[np.bool_], triangle: IntArray
) -> list[IntArray]:
    """Pairs (n, 2) of triangles with the inside between them: one that opens it and the next that closes it.

    Of those in one direction the closing ones come first, and of several the inner pairs nearer together, so
    that the copies of a body pair with themselves.
    """
    order = np.lexsort((angle, edge))
    new = np.diff(edge[order], prepend=-1) != 0
    apart = np.diff(angle[order], prepend=0.0) > _SAME_ANGLE
    direction = np.empty(len(order), dtype=np.int64)
    direction[order] = np.cumsum(new | apart)
    left = np.lexsort((np.where(opens, -triangle, triangle), opens, direction, edge))
    pairs = []
    while left.size:
        start = np.flatnonzero(np.diff(edge[left], prepend=-1) != 0)
        size = np.diff(np.append(start, len(left)))
        following = np.arange(1, len(left) + 1)
        following[start + size - 1] = start
        found = np.flatnonzero(opens[left] & ~opens[left[following]])
        pairs.append(np.stack([triangle[left[found]], triangle[left[following[found]]]], axis=1))
        gone = np.zeros(len(left), dtype=np.bool_)
        gone[found] = gone[following[found]] = True
        left = left[~gone]
    return pairs
