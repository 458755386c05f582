"""Convex parts of a solid: it is cut with planes, the worst piece first, until its pieces are nearly convex.

The search is greedy (as in Lien and Amato, "Approximate convex decomposition of polyhedra", CAGD 25, 2008):
each cut is the one of a few dozen planes that leaves the least volume between pieces and their hulls. Planes
along faces at concave edges cut a modelled part exactly, planes across the axes the rest. What has been cut
so far is a decomposition at any moment, so the search ends when it is good enough or its time is over.
"""

from __future__ import annotations

import heapq
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import manifold3d
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from graspdb_geometry.meshes import Part

FloatArray = npt.NDArray[np.float64]
Plane = tuple[FloatArray, float]

#: Triangles that a piece is simplified to before the search, as far as its tolerance allows.
FACES = 3_000
#: Vertices that a part is simplified to, for the physics gets slow beyond, as long as neighbours still meet:
#: hulls that shrink by more than this share of what parts may be off leave cracks between them. Beyond the
#: second number they are simplified whatever becomes of them.
MAX_PART_VERTICES, MOST_PART_VERTICES = 128, 256
_MEETING_SHARE = 0.125
#: Planes along faces at concave edges that are tried, those of the longest edges.
_CREASES = 24
#: Planes that are tried for any piece.
_FEWEST = 9
#: So far outside of a face, as a share of the piece's extent, lies the plane along it.
_OUTSIDE_SHARE = 1e-6
#: Where planes across each axis are tried, as shares of the piece's extent; fewer of them for many triangles.
_SHARES = ((0.15, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85), (0.3, 0.5, 0.7), (0.5,))
#: Triangles that all planes tried for one cut may have to split: a piece with many is cut again and again, so
#: that no single cut of it matters much.
_WORK = 60_000
#: A piece with less than this share of the solid's box is a crumb of the cutting.
_CRUMB = 1e-7
#: A cut is worth it that saves this share of what a hull adds.
_WORTH = 0.05
#: Boxes nearer than this share of their coordinates touch.
_TOUCHING = 1e-9
#: Every piece more must save this share of the volume of the piece that is cut.
_PIECE_SHARE = 1e-3


@dataclass(frozen=True)
class Piece:
    """A connected solid, its convex hull, and how deep the solid lies below its hull, metres."""

    solid: manifold3d.Manifold
    hull: manifold3d.Manifold
    depth_m: float

    @property
    def excess_m3(self) -> float:
        """The volume that the hull adds."""
        return float(self.hull.volume() - self.solid.volume())


@dataclass
class Search:
    """The pieces so far of one or several bodies, and what finding them took.

    ``deadline`` is by the processor's time of this process (:func:`time.process_time`).
    """

    deadline: float
    pieces: list[Piece] = field(default_factory=list)
    cuts: int = 0
    seconds: float = 0.0

    def over(self) -> bool:
        """Whether its time has run out."""
        return time.process_time() >= self.deadline

    def left_s(self, target_m: float) -> float:
        """About how long it still takes, by the cuts so far."""
        wanted = sum(
            np.ceil(piece.depth_m / target_m) - 1 for piece in self.pieces if piece.depth_m > target_m
        )
        a_cut = self.seconds / self.cuts if self.cuts else 0.5
        return float(min(wanted * a_cut, max(0.0, self.deadline - time.process_time())))


def solid_of(part: Part) -> manifold3d.Manifold | None:
    """A closed surface as a solid; None if it bounds none."""
    vertices, faces = part
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(np.ascontiguousarray(vertices, dtype=np.float64), faces.astype(np.uint64))
    )
    return solid if solid.status() == manifold3d.Error.NoError and not solid.is_empty() else None


def simplified(solid: manifold3d.Manifold, tolerance_m: float) -> manifold3d.Manifold:
    """A solid with fewer triangles whose surface has moved by ``tolerance_m`` at most."""
    for share in (0.125, 0.25, 0.5, 1.0):
        found = solid.simplify(share * tolerance_m)
        if not found.is_empty() and found.num_tri() <= FACES:
            return found
    return solid if found.is_empty() else found


def add(search: Search, solid: manifold3d.Manifold) -> None:
    """Take up another body."""
    search.pieces += _pieces(solid, 0.0)


@dataclass(frozen=True)
class Goal:
    """How deep pieces may be below their hulls, metres, and by how much these may be larger in sum, m^3."""

    depth_m: float
    excess_m3: float


def refine(search: Search, goal: Goal, max_pieces: int, progress: Callable[[Search, float], None]) -> None:
    """Cut the deepest piece, and then that with the most excess, again and again, until they reach the goal
    or the time is over."""
    done: set[int] = set()
    while len(search.pieces) < max_pieces and not search.over():
        left = [piece for piece in search.pieces if id(piece) not in done]
        deep = [piece for piece in left if piece.depth_m > goal.depth_m]
        swollen = not deep and sum(piece.excess_m3 for piece in search.pieces) > goal.excess_m3
        if not left or not (deep or swollen):
            return
        worst = max(left, key=lambda piece: piece.depth_m if deep else piece.excess_m3)
        began = time.process_time()
        found = _cut(worst, search)
        search.seconds += time.process_time() - began
        if found:
            at = search.pieces.index(worst)
            search.pieces[at : at + 1] = found
            search.cuts += 1
        else:
            done.add(id(worst))
        progress(search, goal.depth_m)


def merge(search: Search, goal: Goal) -> None:
    """Join neighbours whose common hull does for the goal, those first that add least to it."""
    pieces = dict(enumerate(search.pieces))
    spare = goal.excess_m3 - sum(piece.excess_m3 for piece in search.pieces)
    pairs = [
        (_added(pieces[a], pieces[b]), a, b) for a in pieces for b in range(a) if _meet(pieces[a], pieces[b])
    ]
    heapq.heapify(pairs)
    numbers = itertools.count(len(pieces))
    while pairs and not search.over():
        _, one, two = heapq.heappop(pairs)
        if one not in pieces or two not in pieces:
            continue
        joined = _pieces(pieces[one].solid + pieces[two].solid, 0.0)
        if len(joined) != 1 or joined[0].depth_m > goal.depth_m:
            continue
        more = joined[0].excess_m3 - pieces[one].excess_m3 - pieces[two].excess_m3
        if more > max(spare, 0.0):
            continue
        spare -= more
        del pieces[one], pieces[two]
        number = next(numbers)
        pieces[number] = joined[0]
        for other, piece in pieces.items():
            if other != number and _meet(piece, joined[0]):
                heapq.heappush(pairs, (_added(piece, joined[0]), number, other))
    search.pieces = list(pieces.values())


def hulls(search: Search, tolerance_m: float) -> Iterator[FloatArray]:
    """The vertices (n, 3) of each piece's hull, few enough for the physics."""
    for piece in search.pieces:
        hull = piece.hull
        share = 0.05
        while share < 100.0 and hull.num_vert() > (
            MAX_PART_VERTICES if share <= _MEETING_SHARE else MOST_PART_VERTICES
        ):
            hull = piece.hull.simplify(share * tolerance_m)
            share *= 1.5
        yield np.array(hull.to_mesh64().vert_properties[:, :3])


def _added(one: Piece, two: Piece) -> float:
    """The volume that a common hull would add."""
    hull = manifold3d.Manifold.batch_hull([one.hull, two.hull])
    return float(hull.volume() - one.solid.volume() - two.solid.volume())


def _meet(one: Piece, two: Piece) -> bool:
    """Whether boxes touch."""
    first, second = np.array(one.hull.bounding_box()), np.array(two.hull.bounding_box())
    reach = _TOUCHING * float(np.abs(np.concatenate([first, second])).max())
    return bool(np.all(first[:3] <= second[3:] + reach) and np.all(second[:3] <= first[3:] + reach))


# -------------------------------------------------------------------------------------------- one cut


class _Halves(NamedTuple):
    """What a plane leaves of a solid, and the volume that the hulls of that add."""

    solids: list[manifold3d.Manifold]
    cost: float


def _cut(piece: Piece, search: Search) -> list[Piece]:
    """The pieces that the best plane leaves; none if no plane does any good.

    A ring or a frame is none the better for one cut: where the best is worth little, the planes across the
    middle are judged by the best cut after them, and at last the longest axis is halved.
    """
    points, corners = _surface(piece.solid)
    crumb = _CRUMB * float(np.prod(np.maximum(np.ptp(points, axis=0), 1e-9)))
    enough = piece.excess_m3 * (1.0 - _WORTH)
    best = _best(piece.solid, _tried(points, corners), crumb, search)
    if best is None or best.cost > enough:
        middles = [_halves(piece.solid, plane, crumb) for plane in _across(points, _SHARES[-1])]
        ahead = [(_cost_after(halves.solids, crumb, search), halves) for halves in middles if halves]
        if ahead:
            cost, halves = min(ahead, key=lambda found: found[0])
            if cost <= enough:
                best = halves
            elif best is None or best.cost > piece.excess_m3 * (1.0 - _WORTH / 5):
                best = middles[-1] or best
    return [] if best is None else [made for solid in best.solids for made in _pieces(solid, crumb)]


def _best(
    solid: manifold3d.Manifold, planes: Iterable[Plane], crumb_m3: float, search: Search
) -> _Halves | None:
    """The halves of least cost; None if no plane cuts the solid."""
    best: _Halves | None = None
    for plane in planes:
        if search.over():
            break
        halves = _halves(solid, plane, crumb_m3)
        if halves is not None and (best is None or halves.cost < best.cost):
            best = halves
    return best


def _halves(solid: manifold3d.Manifold, plane: Plane, crumb_m3: float) -> _Halves | None:
    normal, offset = plane
    halves = solid.split_by_plane(normal.tolist(), offset)
    solids = [connected for half in halves for connected in _connected(half, crumb_m3)]
    if len(solids) < 2:
        return None
    cost = sum(found.hull().volume() - found.volume() for found in solids)
    return _Halves(solids, cost + _PIECE_SHARE * solid.volume() * (len(solids) - 2))


def _cost_after(solids: list[manifold3d.Manifold], crumb_m3: float, search: Search) -> float:
    """The least cost of solids after one more cut of each."""
    total = 0.0
    for solid in solids:
        uncut = solid.hull().volume() - solid.volume()
        points, corners = _surface(solid)
        shares = _SHARES[1] if len(corners) <= _WORK // 36 else _SHARES[2]
        best = _best(solid, _across(points, shares), crumb_m3, search)
        total += uncut if best is None else min(uncut, best.cost)
    return float(total)


def _pieces(solid: manifold3d.Manifold, crumb_m3: float) -> list[Piece]:
    found = []
    for connected in _connected(solid, crumb_m3):
        hull = connected.hull()
        found.append(Piece(connected, hull, _depth(connected, hull)))
    return found


def _connected(solid: manifold3d.Manifold, crumb_m3: float) -> list[manifold3d.Manifold]:
    """The connected solids of one, crumbs left out."""
    surfaces = solid.decompose()
    if any(surface.volume() < -crumb_m3 for surface in surfaces):
        # A cavity's surface is none by itself. Cuts will open it.
        return [solid]
    return [surface for surface in surfaces if surface.volume() > crumb_m3]


def _depth(solid: manifold3d.Manifold, hull: manifold3d.Manifold) -> float:
    """How deep the surface of a solid lies below its hull at most, over points of every triangle."""
    points, corners = _surface(solid)
    tested = np.concatenate(
        [points, corners.mean(axis=1), 0.5 * (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3)]
    )
    try:
        # Not by the triangles of the hull itself: in a cut's plane they may be slivers of any direction.
        planes = ConvexHull(_surface(hull)[0]).equations
    except QhullError:  # too thin to tell
        return 0.0
    depth = np.full(len(tested), np.inf)
    for first in range(0, len(planes), 256):
        some = planes[first : first + 256]
        np.minimum(depth, -(tested @ some[:, :3].T + some[:, 3]).max(axis=1), out=depth)
    return float(max(0.0, depth.max()))


def _surface(solid: manifold3d.Manifold) -> tuple[FloatArray, FloatArray]:
    """Vertices (V, 3) and triangles (F, 3, 3) of a solid."""
    mesh = solid.to_mesh64()
    points = np.array(mesh.vert_properties[:, :3])
    return points, points[mesh.tri_verts.astype(np.int64)]


# -------------------------------------------------------------------------------------------- planes


def _tried(points: FloatArray, corners: FloatArray) -> list[Plane]:
    """The planes to try for one cut, no more than :data:`_WORK` allows."""
    most = max(_FEWEST, _WORK // len(corners))
    creases = _creases(corners)[: max(_CREASES // 4, most // 3)]
    for shares in _SHARES:
        across = _across(points, shares)
        if len(creases) + len(across) <= most:
            break
    return [*creases, *across]


def _across(points: FloatArray, shares: Sequence[float]) -> list[Plane]:
    """Planes across the axes of space and of the points themselves, the longest last."""
    centred = points - points.mean(axis=0)
    _, own = np.linalg.eigh(centred.T @ centred)
    turned = np.abs(own).max(axis=0).min() < 0.999
    axes = np.concatenate([np.eye(3), own.T]) if turned else np.eye(3)
    extents = np.ptp(points @ axes.T, axis=0)
    return [
        (axes[k], float((points @ axes[k]).min() + share * extents[k]))
        for k in np.argsort(extents, kind="stable")
        for share in shares
    ]


def _creases(corners: FloatArray) -> list[Plane]:
    """Planes of the triangles at concave edges, those first that most of such edges lie in."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(length, 1e-300)[:, None]
    extent = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    one, two, edge_length = _concave_edges(corners, normals, 1e-4 * extent)
    sides = np.concatenate([one, two])
    weight = np.concatenate([edge_length, edge_length])
    planes = np.concatenate(
        [normals[sides], np.einsum("ij,ij->i", normals[sides], corners[sides, 0])[:, None]], axis=1
    )
    rounded = np.round(planes / [1e-3, 1e-3, 1e-3, 1e-4 * extent])
    _, first, which = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    weights = np.bincount(which.ravel(), weight)
    order = np.argsort(-weights, kind="stable")[:_CREASES]
    # A little outside of the face: cut in it, what stands on both its ends hangs together by it.
    outside = _OUTSIDE_SHARE * extent
    return [(planes[first[k], :3], float(planes[first[k], 3]) + outside) for k in order]


def _concave_edges(
    corners: FloatArray, normals: FloatArray, least_m: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], FloatArray]:
    """Pairs of triangles at concave edges, and the edges' lengths; bends below ``least_m`` are flat."""
    count = len(corners)
    starts = corners.reshape(-1, 3)
    ends = np.roll(corners, -1, axis=1).reshape(-1, 3)
    _, number = np.unique(np.concatenate([starts, ends]), axis=0, return_inverse=True)
    start, end = number.ravel()[: 3 * count], number.ravel()[3 * count :]
    size = int(number.max()) + 1
    forward, backward = start * size + end, end * size + start
    order = np.argsort(forward, kind="stable")
    at = np.minimum(np.searchsorted(forward[order], backward), 3 * count - 1)
    twin = order[at]
    paired = (forward[twin] == backward) & (start < end)
    one, two = np.flatnonzero(paired) // 3, twin[paired] // 3
    opposite = np.roll(corners, -2, axis=1).reshape(-1, 3)[twin[paired]]
    rise = np.einsum("ij,ij->i", normals[one], opposite - starts[paired])
    concave = rise > least_m
    lengths = np.linalg.norm(ends - starts, axis=1)[paired]
    return one[concave], two[concave], lengths[concave]
