"""Approximate convex decomposition by CoACD (Wei et al., "Approximate convex decomposition for 3D meshes with
collision-aware concavity and tree search", ACM TOG 41, 2022). Imported only in the child that runs it.

Not VHACD: it inflates volumes by tens of percent, and a grasp is decided by millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import coacd
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from graspdb_geometry import meshes
from graspdb_geometry.deviation import deviation
from graspdb_geometry.meshes import Mesh, MeshError, Part

#: Concavity that a part may keep, in CoACD's measure (the mesh's longest side is 2), from coarse to fine.
THRESHOLDS = (0.05, 0.02, 0.01)
#: How hard CoACD searches for its cuts at thresholds from here on: little, so that there are parts within
#: minutes (half a minute of one core for a mug of 884 triangles or a teddy of 2,432). Below it takes its own
#: defaults, several times as long.
QUICK_FROM = 0.02
_QUICK = {"mcts_iterations": 60, "mcts_max_depth": 2, "resolution": 1000}
#: Parts are good enough when they are as near to the mesh as the larger of these.
TARGET_M, TARGET_SHARE = 5e-4, 0.01
#: Vertices of one part at most: the physics engine gets slow beyond, and nothing is gained.
MAX_PART_VERTICES = 128
#: Parts with less than this share of the mesh's bounding box are crumbs of the cutting.
_CRUMB = 1e-7


class Undecomposable(Exception):
    """The mesh has no convex parts; the message says why."""


@dataclass(frozen=True)
class Candidate:
    """Parts that the service would accept: ``glb``, how many, and their distance from the mesh in metres."""

    glb: bytes
    parts: int
    deviation_m: float


def read(content: bytes, media_type: str, unit: str) -> Mesh:
    """The mesh as the service reads it, repaired as there, or Undecomposable."""
    try:
        return meshes.load(content, media_type, unit)
    except MeshError as error:
        raise Undecomposable(error.message) from None


def target_m(mesh: Mesh) -> float:
    """How near the parts should be to the mesh, metres."""
    return max(TARGET_M, TARGET_SHARE * float(np.ptp(mesh.vertices, axis=0).max()))


def decompose(mesh: Mesh, threshold: float, *, max_parts: int, seed: int) -> Candidate:
    """Split a mesh into convex parts; the same input gives the same bytes.

    A mesh that is no closed manifold is first remeshed by CoACD, which takes longer and rounds edges.
    Undecomposable if CoACD finds no solid in it.
    """
    coacd.set_log_level("off")
    # Near the origin and of size one: the library's tolerances are absolute.
    centre = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    scale = float(np.ptp(mesh.vertices, axis=0).max())
    try:
        found = coacd.run_coacd(
            coacd.Mesh((mesh.vertices - centre) / scale, mesh.faces),
            threshold=threshold,
            seed=seed,
            max_ch_vertex=MAX_PART_VERTICES,
            **(_QUICK if threshold >= QUICK_FROM else {}),
        )
    except RuntimeError as error:
        raise Undecomposable(f"CoACD fails: {error}") from None
    crumb = _CRUMB * float(np.prod(np.maximum(np.ptp(mesh.vertices, axis=0), 1e-9)))
    parts = [part for vertices, _ in found if (part := _part(vertices * scale + centre, crumb)) is not None]
    if not parts:
        raise Undecomposable("CoACD finds no solid in the mesh: is its surface closed?")
    if len(parts) > max_parts:
        raise Undecomposable(f"it needs {len(parts)} convex parts; at most {max_parts} are supported")
    glb = meshes.parts_to_glb(parts)
    try:
        parts = meshes.parts_from_glb(glb)
    except MeshError as error:
        raise Undecomposable(f"CoACD's parts are not usable: {error}") from None
    return Candidate(glb, len(parts), deviation(mesh, parts).largest_m)


def _part(vertices: np.ndarray[tuple[int, ...], np.dtype[np.float64]], crumb_m3: float) -> Part | None:
    """The convex hull of a part as the GLB will hold it (float32), facing outwards; None for a crumb."""
    points = np.unique(np.asarray(vertices, dtype=np.float32).astype(np.float64), axis=0)
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    if hull.volume < crumb_m3:
        return None
    used, faces = np.unique(hull.simplices, return_inverse=True)
    faces = faces.reshape(-1, 3)
    corners = points[used][faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    part: Part = points[used], faces
    try:
        (checked,) = meshes.check_parts([part])
    except MeshError:
        # Too thin for the physics and the collision test, so no loss to either.
        return None
    return checked
