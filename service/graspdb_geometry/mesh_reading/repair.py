"""Mending of surfaces that are not closed, as far as that is no guess about the object.

Seams are sewn, triangles wound alike, small holes filled. A large hole is left: it may be the mouth of a
vessel without thickness, and a lid on it would make another object.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from graspdb_geometry.mesh_reading.formats import FaceArray, FloatArray

IntArray = npt.NDArray[np.int64]

#: Vertices nearer than this share of the mesh's diagonal are one.
SEAM_SHARE = 1e-5
#: A hole larger than this share of the surface is no flaw of the mesh.
HOLE_SHARE = 0.05
MAX_HOLE_EDGES = 2_000
#: A hole's rim may leave its plane by this share of its size.
_FLAT_SHARE = 0.2


@dataclass
class Repaired:
    """A mended surface, what was done to it, and what was left undone."""

    vertices: FloatArray
    faces: FaceArray
    done: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)


def repair(vertices: FloatArray, faces: FaceArray) -> Repaired:
    """Sew, wind and fill a surface; the same input gives the same output.

    Parameters
    ----------
    vertices : (V, 3) float64
    faces : (F, 3) int

    Returns
    -------
    Repaired
        ``done`` and ``left`` in words, for the user.
    """
    mesh = Repaired(np.asarray(vertices), np.asarray(faces, dtype=np.int64))
    _sew(mesh)
    if len(mesh.faces):
        _wind(mesh)
        _fill(mesh)
        _, count = np.unique(_undirected(_edges(mesh.faces)), return_counts=True)
        if np.any(count > 2):
            mesh.left.append(f"{int(np.sum(count > 2))} edges belong to more than two triangles")
    return mesh


def _edges(faces: FaceArray) -> IntArray:
    """Directed edges (3 F, 2); edge ``k`` is of triangle ``k % F``."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _undirected(edges: IntArray) -> IntArray:
    """One number for each edge, the same both ways."""
    low, high = edges.min(axis=1), edges.max(axis=1)
    keys: IntArray = low * (int(edges.max()) + 1) + high
    return keys


def _areas(vertices: FloatArray, faces: FaceArray) -> FloatArray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def _sew(mesh: Repaired) -> None:
    """Merge vertices along seams, drop triangles that collapse or stand twice."""
    # Only along open edges: elsewhere fine detail may be as small.
    edges = _edges(mesh.faces)
    _, first, count = np.unique(_undirected(edges), return_index=True, return_counts=True)
    rim = np.unique(edges[first[count == 1]])
    number = np.arange(len(mesh.vertices))
    if len(rim):
        reach = SEAM_SHARE * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        pairs = cKDTree(mesh.vertices[rim]).query_pairs(reach, output_type="ndarray")
        if len(pairs):
            graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rim),) * 2)
            _, group = connected_components(graph, directed=False)
            _, first = np.unique(group, return_index=True)
            number[rim] = rim[first][group]
            merged = int(np.sum(number != np.arange(len(number))))
            mesh.done.append(f"{merged} vertices merged")
    faces = number[mesh.faces]
    kept = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[kept]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(first) < len(faces):
        mesh.done.append(f"{len(faces) - len(first)} triangles stood twice")
        faces = faces[np.sort(first)]
    used, faces = np.unique(faces, return_inverse=True)
    mesh.vertices, mesh.faces = mesh.vertices[used], faces.reshape(-1, 3)


def _wind(mesh: Repaired) -> None:
    """Wind neighbours alike, and each closed piece that was not outwards."""
    edges = _edges(mesh.faces)
    triangle = np.tile(np.arange(len(mesh.faces)), 3)
    _, which, count = np.unique(_undirected(edges), return_inverse=True, return_counts=True)
    shared = np.flatnonzero(count[which] == 2)
    pairs = shared[np.argsort(which[shared], kind="stable")].reshape(-1, 2)
    one, two = triangle[pairs[:, 0]], triangle[pairs[:, 1]]
    unlike = edges[pairs[:, 0], 0] == edges[pairs[:, 1], 0]
    if not np.any(unlike):
        return
    size = (len(mesh.faces),) * 2
    graph = coo_matrix((np.ones(len(one)), (one, two)), shape=size).tocsr()
    parity = coo_matrix((unlike + 1.0, (one, two)), shape=size).tocsr()
    parity = parity.maximum(parity.T)
    _, piece = connected_components(graph, directed=False)
    turned = np.zeros(len(mesh.faces), dtype=np.bool_)
    for number in np.unique(piece[one[unlike]]):
        members = np.flatnonzero(piece == number)
        order, before = breadth_first_order(graph, members[0], directed=False)
        steps = np.asarray(parity[before[order[1:]], order[1:]]).reshape(-1) > 1.5
        for at, step in zip(order[1:].tolist(), steps.tolist(), strict=True):
            turned[at] = turned[before[at]] ^ step
        trial = mesh.faces[members].copy()
        trial[turned[members]] = trial[turned[members]][:, ::-1]
        corners = mesh.vertices[trial] - mesh.vertices[trial[0, 0]]
        volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
        if volume < 0:
            turned[members] ^= True
    mesh.faces = mesh.faces.copy()
    mesh.faces[turned] = mesh.faces[turned][:, ::-1]
    mesh.done.append(f"{int(turned.sum())} triangles turned to face outwards")


def _fill(mesh: Repaired) -> None:
    """Fill the small holes with flat patches."""
    loops, tangled = _rims(mesh.faces)
    if tangled:
        mesh.left.append(f"{tangled} open edges form no simple rim")
    if not loops:
        return
    surface = float(_areas(mesh.vertices, mesh.faces).sum())
    patches = []
    large = crooked = 0
    for loop in loops:
        patch = _patch(mesh.vertices, loop)
        if patch is None:
            crooked += 1
        elif float(_areas(mesh.vertices, patch).sum()) > HOLE_SHARE * surface:
            large += 1
        else:
            patches.append(patch)
    if patches:
        mesh.faces = np.concatenate([mesh.faces, *patches])
        mesh.done.append(f"{len(patches)} hole{'s' if len(patches) > 1 else ''} filled")
    if large:
        mesh.left.append(f"{large} of its holes are larger than {HOLE_SHARE:.0%} of the surface")
    if crooked:
        mesh.left.append(f"{crooked} of its holes have a rim that no flat patch fits")


def _rims(faces: FaceArray) -> tuple[list[IntArray], int]:
    """Closed loops of open edges, in the direction that a patch needs, and how many edges are in none."""
    edges = _edges(faces)
    _, which, count = np.unique(_undirected(edges), return_inverse=True, return_counts=True)
    rim = edges[count[which] == 1]
    following: dict[int, list[int]] = {}
    for start, end in rim.tolist():
        # Against the triangle's own direction.
        following.setdefault(end, []).append(start)
    loops = []
    for start in sorted(following):
        path: list[int] = [start]
        place = {start: 0}
        while following.get(path[-1]):
            at = following[path[-1]].pop()
            if at not in place:
                place[at] = len(path)
                path.append(at)
                continue
            # Back at a vertex of the path: a loop is complete. Rims that touch in a vertex come apart here.
            loop, path = path[place[at] :], path[: place[at] + 1]
            for vertex in loop[1:]:
                del place[vertex]
            if 3 <= len(loop) <= MAX_HOLE_EDGES:
                loops.append(np.array(loop, dtype=np.int64))
    return loops, len(rim) - sum(len(loop) for loop in loops)


def _patch(vertices: FloatArray, loop: IntArray) -> FaceArray | None:
    """Triangles over a rim by clipping ears in its plane; None where it is not flat enough for that."""
    points = vertices[loop]
    centred = points - points.mean(axis=0)
    # Twice the vector area of the loop (Newell): its normal, whichever way it bends.
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    length = float(np.linalg.norm(normal))
    size = float(np.linalg.norm(centred, axis=1).max())
    if length < 1e-6 * size * size:
        return None
    normal /= length
    if float(np.abs(centred @ normal).max()) > _FLAT_SHARE * size:
        return None
    u = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    u /= np.linalg.norm(u)
    flat = np.stack([centred @ u, centred @ np.cross(normal, u)], axis=1)
    ears = _clip_ears(flat)
    return None if ears is None else loop[ears]


def _clip_ears(points: FloatArray) -> IntArray | None:
    """Triangulate a simple counter-clockwise polygon (n, 2) (Meisters 1975); None if it crosses itself."""
    left = list(range(len(points)))
    triangles: list[tuple[int, int, int]] = []
    while len(left) > 3:
        best: tuple[float, int] | None = None
        for k in range(len(left)):
            i, j, m = left[k - 1], left[k], left[(k + 1) % len(left)]
            quality = _ear(points, left, i, j, m)
            if quality is not None and (best is None or quality > best[0]):
                best = quality, k
                # Looking for the best each time takes n^3: a good one will do, of many corners any.
                if quality > 0.3 or len(left) > 60:
                    break
        if best is None:
            return None
        k = best[1]
        triangles.append((left[k - 1], left[k], left[(k + 1) % len(left)]))
        left.pop(k)
    triangles.append((left[0], left[1], left[2]))
    return np.array(triangles, dtype=np.int64)


def _ear(points: FloatArray, left: list[int], i: int, j: int, m: int) -> float | None:
    """How good an ear the corner j is: area over squared longest side; None if it is none."""
    a, b, c = points[i], points[j], points[m]
    area = float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
    longest = max(float(np.sum((p - q) ** 2)) for p, q in ((a, b), (b, c), (c, a)))
    if area <= 1e-9 * longest:
        return None
    others = points[[k for k in left if k not in (i, j, m)]]
    outside = np.zeros(len(others), dtype=np.bool_)
    for p, q in ((a, b), (b, c), (c, a)):
        side = (q[0] - p[0]) * (others[:, 1] - p[1]) - (q[1] - p[1]) * (others[:, 0] - p[0])
        outside |= side < 0
    return area / longest if bool(np.all(outside)) else None
