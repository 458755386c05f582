"""How well convex parts follow the mesh they were made from: distances between the two surfaces, volumes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import manifold3d
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from graspdb_geometry.mesh_reading.content import FaceArray, FloatArray
from graspdb_geometry.meshes import Mesh, Part

#: Parts stand for their mesh if they lie at most as far off it as the larger of these, metres and a share of
#: its longest side ...
ACCEPTED_M, ACCEPTED_SHARE = 1e-3, 0.01
#: ... and have its volume, but for this share of it.
ACCEPTED_VOLUME = 0.05
#: Parts are the mesh but for rounding up to these shares of its longest side and of its volume.
_SAME_SHARE, _SAME_VOLUME = 1e-4, 1e-3
#: Points on each surface that are compared, and points that find the nearest triangles of the other one.
SAMPLES = 3_000
DENSE_SAMPLES = 40_000
_NEAREST = 8
#: Cracks between parts that are thinner than this share of what is accepted are none: hulls of fewer vertices
#: do not quite meet.
_CRACK = 0.25
#: More triangles than this are so small that the nearest samples find the nearest ones.
_MAX_EXACT = 100_000


@dataclass(frozen=True)
class Deviation:
    """Distances between the surface of a mesh and that of its parts' union, metres.

    A one-sided Hausdorff distance each way, over sampled points.

    Attributes
    ----------
    bulge_m
        How far the parts' surface lies from the mesh's at most: a hollow that they fill, a corner they lack.
    gap_m
        How far the mesh's surface sticks out of the parts at most.
    """

    bulge_m: float
    gap_m: float

    @property
    def largest_m(self) -> float:
        return max(self.bulge_m, self.gap_m)


def deviation(mesh: Mesh, parts: Sequence[Part], *, seed: int = 0) -> Deviation:
    """Compare the surface of a mesh with that of the union of its convex parts.

    Parts meet in faces inside the object, which belong to no surface: points that another part covers, or
    that have one before them across a crack of a quarter of what is accepted, are left out, and so are faces
    of the mesh inside the parts (meshes are often put together from solids).

    Parameters
    ----------
    mesh : Mesh
    parts : sequence of (vertices (V, 3), faces (F, 3))
        Convex, outward triangles, metres.
    seed : int
        Of the samples: the same input gives the same answer.
    """
    rng = np.random.default_rng(seed)
    extent = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    crack = _CRACK * accepted_m(float(np.ptp(mesh.vertices, axis=0).max()))
    planes = [_planes(vertices, faces) for vertices, faces in parts]
    corners = [vertices[faces] for vertices, faces in parts]
    triangles = np.concatenate(corners)
    owner = np.repeat(np.arange(len(parts)), [len(own) for own in corners])
    face, points = surface_samples(triangles, DENSE_SAMPLES, rng)
    outer = ~_covered(points, owner[face], parts, planes, 1e-4 * extent)
    left = np.flatnonzero(outer)
    before = points[left] + crack * _normals(triangles)[face[left]]
    outer[left] = ~_covered(before, owner[face[left]], parts, planes, 0.0)
    if not np.any(outer):
        return Deviation(extent, extent)
    skin = mesh.vertices[mesh.faces]
    skin_face, skin_points = surface_samples(skin, DENSE_SAMPLES, rng)
    some = rng.permutation(np.flatnonzero(outer))[:SAMPLES]
    bulge = distances(points[some], skin, skin_face, skin_points)
    some = rng.permutation(len(skin_points))[:SAMPLES]
    nobody = np.full(len(some), -1)
    out = skin_points[some][~_covered(skin_points[some], nobody, parts, planes, 0.0)]
    gap = distances(out, triangles, face[outer], points[outer])
    return Deviation(float(np.max(bulge)), float(np.max(gap, initial=0.0)))


@dataclass(frozen=True)
class Fit:
    """How far convex parts stand for the mesh that they are of.

    Attributes
    ----------
    deviation_m
        The larger of the distances in :class:`Deviation`, metres.
    accepted_m
        Up to where they stand for a mesh of this size, metres.
    same_m
        Up to where they are the mesh itself, metres.
    volume
        That of the parts' union as a share of the mesh's; None where the mesh encloses none.
    """

    deviation_m: float
    accepted_m: float
    same_m: float
    volume: float | None

    @property
    def accepted(self) -> bool:
        """Whether what is simulated with the parts holds for the mesh."""
        same = self.volume is None or abs(self.volume - 1.0) <= ACCEPTED_VOLUME
        return same and self.deviation_m <= self.accepted_m

    @property
    def same(self) -> bool:
        """Whether the parts are the mesh but for rounding."""
        same = self.volume is None or abs(self.volume - 1.0) <= _SAME_VOLUME
        return same and self.deviation_m <= self.same_m

    def __str__(self) -> str:
        told = f"up to {1000 * self.deviation_m:.3g} mm off the mesh's ({1000 * self.accepted_m:.3g} mm do)"
        if self.volume is None:
            return told
        least, most = 1.0 - ACCEPTED_VOLUME, 1.0 + ACCEPTED_VOLUME
        return f"{told}, their volume is {self.volume:.1%} of its ({least:.0%} to {most:.0%} do)"


def fit(mesh: Mesh, parts: Sequence[Part], volume_m3: float | None) -> Fit:
    """Compare convex parts with the solids of a mesh, or its surface where it encloses none.

    ``volume_m3`` is the mesh's, None where it encloses none. Sheets beside the solids are left out: no part
    can follow them.
    """
    side = float(np.ptp(mesh.vertices, axis=0).max())
    solid = of_bodies(mesh) if mesh.sound and mesh.bodies else mesh
    share = None if volume_m3 is None else united_volume(parts) / volume_m3
    return Fit(deviation(solid, parts).largest_m, accepted_m(side), _SAME_SHARE * side, share)


def accepted_m(longest_side_m: float) -> float:
    """How far parts may lie off a mesh of this size, metres."""
    return max(ACCEPTED_M, ACCEPTED_SHARE * longest_side_m)


def of_bodies(mesh: Mesh) -> Mesh:
    """The mesh of its bodies alone."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in mesh.bodies[:-1]])
    return Mesh(
        np.concatenate([vertices for vertices, _ in mesh.bodies]),
        np.concatenate([faces + offset for (_, faces), offset in zip(mesh.bodies, offsets, strict=True)]),
        bodies=mesh.bodies,
    )


def united_volume(parts: Sequence[Part]) -> float:
    """Volume in cubic metres of the union of convex parts, which may touch and overlap."""
    hulls = [manifold3d.Manifold.hull_points(np.ascontiguousarray(vertices)) for vertices, _ in parts]
    return float(manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add).volume())


def distances(
    points: FloatArray, triangles: FloatArray, sample_face: npt.NDArray[np.int64], samples: FloatArray
) -> FloatArray:
    """From points (n, 3) to the surface of triangles (F, 3, 3), through the triangles of the nearest samples
    of it, and those that could be nearer."""
    if not len(points):
        return np.empty(0)
    _, nearest = cKDTree(samples).query(points, k=min(_NEAREST, len(samples)))
    candidates = triangles[sample_face[nearest.reshape(len(points), -1)]]
    best = to_triangles(points[:, None], candidates).min(axis=1)
    if len(triangles) > _MAX_EXACT:
        return np.asarray(best)
    # A triangle's bounding sphere rules out most of those that no sample has found.
    centres = triangles.mean(axis=1)
    radii = np.linalg.norm(triangles - centres[:, None], axis=-1).max(axis=1)
    block = max(1, 4_000_000 // len(triangles))
    for first in range(0, len(points), block):
        some = points[first : first + block]
        low = cdist(some, centres) - radii
        row, face = np.nonzero(low < best[first : first + block, None])
        for part in range(0, len(row), 500_000):
            rows, faces = row[part : part + 500_000], face[part : part + 500_000]
            np.minimum.at(best, first + rows, to_triangles(some[rows], triangles[faces]))
    return np.asarray(best)


def to_triangles(p: FloatArray, triangles: FloatArray) -> FloatArray:
    """Distance of points (..., 3) to triangles (..., 3, 3): to the plane where the foot is inside, else the
    nearest edge."""
    a, b, c = (triangles[..., k, :] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=-1)
    normal = normal / np.maximum(length, 1e-300)[..., None]
    height = np.einsum("...i,...i->...", p - a, normal)
    inside = length > 0.0
    edges = np.full(height.shape, np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        square = np.einsum("...i,...i->...", along, along)
        share = np.einsum("...i,...i->...", p - start, along) / np.maximum(square, 1e-300)
        foot = start + np.clip(share, 0.0, 1.0)[..., None] * along
        edges = np.minimum(edges, np.linalg.norm(p - foot, axis=-1))
        inside = inside & (np.einsum("...i,...i->...", np.cross(along, p - start), normal) >= 0.0)
    return np.asarray(np.where(inside, np.abs(height), edges))


def _normals(corners: FloatArray) -> FloatArray:
    """Unit normals (F, 3) of triangles; zero for those without area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None])


def _areas(corners: FloatArray) -> FloatArray:
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(0.5 * np.linalg.norm(normals, axis=1))


def surface_samples(
    corners: FloatArray, count: int, rng: np.random.Generator
) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Points (count, 3) on triangles (F, 3, 3), half by area and half as many for each, and whose each is."""
    areas = _areas(corners)
    cumulated = np.cumsum(areas / areas.sum() + 1.0 / len(areas))
    # Stratified along the area: no large hole by chance.
    where = (np.arange(count) + rng.random(count)) / count * cumulated[-1]
    face = np.minimum(np.searchsorted(cumulated, where), len(corners) - 1)
    u, v = rng.random((2, count, 1))
    folded = u + v > 1.0
    u, v = np.where(folded, 1.0 - u, u), np.where(folded, 1.0 - v, v)
    a, b, c = (corners[face, k] for k in range(3))
    return face, np.asarray(a + u * (b - a) + v * (c - a))


def _planes(vertices: FloatArray, faces: FaceArray) -> tuple[FloatArray, FloatArray]:
    """Outward unit normals (F, 3) and offsets (F,) of a convex part's faces."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    kept = length > 1e-9 * length.max()
    normals = normals[kept] / length[kept, None]
    return normals, np.einsum("ij,ij->i", normals, corners[kept, 0])


def _covered(
    points: FloatArray,
    owner: npt.NDArray[np.int64],
    parts: Sequence[Part],
    planes: list[tuple[FloatArray, FloatArray]],
    tolerance: float,
) -> npt.NDArray[np.bool_]:
    """Which points lie in a part that is not their owner."""
    covered = np.zeros(len(points), dtype=np.bool_)
    for number, ((vertices, _), (normals, offsets)) in enumerate(zip(parts, planes, strict=True)):
        low, high = vertices.min(axis=0) - tolerance, vertices.max(axis=0) + tolerance
        boxed = np.all((points >= low) & (points <= high), axis=1)
        near = np.flatnonzero((owner != number) & ~covered & boxed)
        if near.size:
            covered[near] = _inside(points[near], normals, offsets, tolerance)
    return covered


def _inside(
    points: FloatArray, normals: FloatArray, offsets: FloatArray, tolerance: float
) -> npt.NDArray[np.bool_]:
    inside = np.ones(len(points), dtype=np.bool_)
    for first in range(0, len(normals), 64):
        left = np.flatnonzero(inside)
        part = slice(first, first + 64)
        inside[left] = np.all(points[left] @ normals[part].T <= offsets[part] + tolerance, axis=1)
    return inside
