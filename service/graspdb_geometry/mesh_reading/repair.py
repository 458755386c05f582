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

from graspdb_geometry.mesh_reading.content import FaceArray, FloatArray
from graspdb_geometry.mesh_reading.polygons import clip_ears, fan_of_line, flattened, lie_on_a_line

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

#: Vertices nearer than this share of the mesh's diagonal are one.
SEAM_SHARE = 1e-5
#: A hole larger than this share of the surface is no flaw of the mesh.
HOLE_SHARE = 0.05
MAX_HOLE_EDGES = 2_000
#: Where more of a piece's triangles are wound the other way, the rest does not tell which side is out.
_TELLING_SHARE = 0.1
#: A hole's rim may leave its plane by this share of its size.
_FLAT_SHARE = 0.2


@dataclass
class Repaired:
    """A mended surface, what was done to it, and what was left undone.

    ``wound`` (F,) tells the triangles of pieces whose winding was so mixed that it does not say which side is
    out.
    """

    vertices: FloatArray
    faces: FaceArray
    wound: BoolArray
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
    first = _repaired(vertices, faces, keep_walls=True)
    if first.left:
        # Triangles both ways round may be walls between bodies that touch, not a surface drawn twice.
        second = _repaired(vertices, faces, keep_walls=False)
        if not second.left:
            return second
    return first


def _repaired(vertices: FloatArray, faces: FaceArray, *, keep_walls: bool) -> Repaired:
    mesh = Repaired(np.asarray(vertices), np.asarray(faces, dtype=np.int64), np.empty(0, dtype=np.bool_))
    _sew(mesh, keep_walls=keep_walls)
    if len(mesh.faces):
        _wind(mesh)
        _fill(mesh)
        _, count = np.unique(_undirected(_edges(mesh.faces)), return_counts=True)
        odd = (count > 2) & (count % 2 == 1)
        if np.any(odd):
            mesh.left.append(f"{int(np.sum(odd))} edges belong to more than two triangles")
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


def _sew(mesh: Repaired, *, keep_walls: bool) -> None:
    """Merge vertices along seams, drop triangles that collapse or stand twice.

    Of triangles that stand both ways round one is kept, or with ``keep_walls`` false none.
    """
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
    _, first, which = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    if len(first) < len(faces):
        if not keep_walls:
            turns = _turns(faces)
            both_ways = np.bincount(which.ravel(), turns > 0) * np.bincount(which.ravel(), turns < 0)
            first = first[both_ways == 0]
        mesh.done.append(f"{len(faces) - len(first)} triangles stood twice")
        faces = faces[np.sort(first)]
    used, faces = np.unique(faces, return_inverse=True)
    mesh.vertices, mesh.faces = mesh.vertices[used], faces.reshape(-1, 3)
    mesh.wound = np.zeros(len(mesh.faces), dtype=np.bool_)


def _turns(faces: FaceArray) -> IntArray:
    """1 for triangles that go up through their sorted vertices, -1 for those that go down."""
    a, b, c = faces.T
    return np.where((a < b).astype(int) + (b < c) + (c < a) == 2, 1, -1)


def _wind(mesh: Repaired) -> None:
    """Wind neighbours alike, as most of a piece's triangles are."""
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
    against = coo_matrix((unlike * 1.0, (one, two)), shape=size).tocsr()
    graph, against = graph + graph.T, against + against.T
    _, piece = connected_components(graph, directed=False)
    turned = np.zeros(len(mesh.faces), dtype=np.bool_)
    for number in np.unique(piece[one[unlike]]):
        members = np.flatnonzero(piece == number)
        order, before = breadth_first_order(graph, members[0], directed=False)
        steps = np.asarray(against[before[order[1:]], order[1:]]).reshape(-1) > 0.0
        for at, step in zip(order[1:].tolist(), steps.tolist(), strict=True):
            turned[at] = turned[before[at]] ^ step
        if 2 * int(turned[members].sum()) > len(members):
            turned[members] ^= True
        mesh.wound[members] = turned[members].mean() > _TELLING_SHARE
    mesh.faces = mesh.faces.copy()
    mesh.faces[turned] = mesh.faces[turned][:, ::-1]
    mesh.done.append(f"{int(turned.sum())} triangles turned to face as their neighbours do")


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
        mesh.wound = np.pad(mesh.wound, (0, len(mesh.faces) - len(mesh.wound)))
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
    plane = flattened(points)
    if plane is None:
        # A slit, as where one side of a seam has a vertex more.
        return fan_of_line(loop) if lie_on_a_line(points) else None
    ring, heights = plane
    if float(np.abs(heights).max()) > _FLAT_SHARE * float(np.linalg.norm(ring, axis=1).max()):
        return None
    ears = clip_ears(ring)
    return None if ears is None else loop[ears]
