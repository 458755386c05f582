"""Convex parts of a mesh. Imported only in the child that runs it.

Bodies that are convex stay as they are; solids are cut (:mod:`.cutting`); what is no solid, an open or
crumpled surface, is remeshed and decomposed by CoACD (Wei et al., "Approximate convex decomposition for 3D
meshes with collision-aware concavity and tree search", ACM TOG 41, 2022). Not VHACD: it inflates volumes by
tens of percent, and a grasp is decided by millimetres.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import coacd
import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from graspdb_geometry import meshes
from graspdb_geometry.deviation import deviation, united_volume
from graspdb_geometry.mass import mass_properties
from graspdb_geometry.meshes import Mesh, MeshError, Part
from graspdb_simworker.decomposition import cutting
from graspdb_simworker.decomposition.cutting import Search

#: Parts are good enough when they are as near to the mesh as the larger of these.
TARGET_M, TARGET_SHARE = 5e-4, 0.01
#: Processor time that cutting may take, seconds, and its share of the limit where that is tighter: what is
#: left is for measuring the parts.
CUTTING_SECONDS, CUTTING_SHARE = 25.0, 0.6
#: When time is over, parts farther off than this share of the mesh's longest side are none.
_USABLE_SHARE = 0.05
#: Simplifying may move the surface by this share of what the parts may.
_SIMPLIFYING_SHARE = 0.2
#: How often a person is told, seconds.
_TOLD_EVERY_S = 1.0
#: Concavity that a part may keep, in CoACD's measure (the mesh's longest side is 2), from coarse to fine.
_THRESHOLDS = (0.1, 0.05)
#: How hard CoACD remeshes and searches for its cuts: little, so that there are parts within half a minute.
_QUICK = {
    "preprocess_resolution": 30,
    "mcts_nodes": 10,
    "mcts_iterations": 20,
    "mcts_max_depth": 1,
    "resolution": 500,
}
#: Parts with less than this share of the mesh's bounding box are crumbs of the cutting.
_CRUMB = 1e-7


class Undecomposable(Exception):
    """The mesh has no convex parts; the message says why."""


@dataclass(frozen=True)
class Candidate:
    """Parts that the service would accept, and how well they follow the mesh.

    ``glb`` holds ``parts`` of them; their surface lies up to ``deviation_m`` metres off the mesh's; their
    union has ``added_volume`` times the mesh's volume more than it, None where that is unknown.
    """

    glb: bytes
    parts: int
    deviation_m: float
    added_volume: float | None

    def __str__(self) -> str:
        volume = "" if self.added_volume is None else f", {self.added_volume:+.1%} volume"
        return f"{self.parts} parts, at most {1000 * self.deviation_m:.2g} mm off{volume}"


@dataclass(frozen=True)
class CuttingLimits:
    """What a decomposition may take: parts, and seconds of the processor's time from its start on."""

    max_parts: int
    seconds: float
    seed: int


def read(content: bytes, media_type: str, unit: str, scale: float) -> Mesh:
    """The mesh as the service reads it, repaired as there, or Undecomposable."""
    try:
        return meshes.load(content, media_type, unit, scale)
    except MeshError as error:
        raise Undecomposable(error.message) from None


def decompose(
    mesh: Mesh, limits: CuttingLimits, *, tell: Callable[[str], None], give: Callable[[Candidate], None]
) -> None:
    """Split a mesh into convex parts; the same input gives the same parts unless time runs out.

    ``tell`` hears how far it is, with an estimate and the limit; ``give`` gets candidates, each better than
    the one before. Undecomposable if there is none.
    """
    if mesh.sound and mesh.bodies:
        _cut(mesh, limits, tell, give)
    else:
        _remesh(mesh, limits, tell, give)


def target_m(mesh: Mesh) -> float:
    """How near the parts should be to the mesh, metres."""
    return max(TARGET_M, TARGET_SHARE * float(np.ptp(mesh.vertices, axis=0).max()))


# --------------------------------------------------------------------------------------------- solids


def _cut(
    mesh: Mesh, limits: CuttingLimits, tell: Callable[[str], None], give: Callable[[Candidate], None]
) -> None:
    volume = mass_properties(mesh.vertices[mesh.faces]).volume
    # Without sheets, which no part can follow.
    mesh = _of_bodies(mesh)
    target = target_m(mesh)
    usable = max(target, _USABLE_SHARE * float(np.ptp(mesh.vertices, axis=0).max()))
    began = time.process_time()
    search = Search(deadline=began + min(CUTTING_SECONDS, CUTTING_SHARE * limits.seconds))
    whole: list[Part] = []
    faces = 0
    for vertices, triangles in _largest(mesh.bodies, limits.max_parts // 2):
        part = _part(vertices) if meshes.is_convex(vertices, triangles) else None
        if part is not None:
            whole.append(part)
            continue
        made = cutting.solid_of((vertices, triangles))
        if made is None:
            _remesh(mesh, limits, tell, give)
            return
        solid = cutting.simplified(made, _SIMPLIFYING_SHARE * target)
        faces += solid.num_tri()
        cutting.add(search, solid)
    bodies = "a body" if len(mesh.bodies) == 1 else f"{len(mesh.bodies)} bodies, {len(whole)} convex"
    about = f"{len(mesh.faces):,} faces in {bodies}"
    if faces and faces < len(mesh.faces):
        about += f", simplified to {faces:,}"
    report = _Report(about, began, limits.seconds, tell)
    goal = target
    best: Candidate | None = None
    while True:
        report(search, goal)
        cutting.refine(search, goal, limits.max_parts - len(whole), report)
        cutting.merge(search, goal)
        parts = whole + [part for hull in cutting.hulls(search, target) if (part := _part(hull)) is not None]
        found = _candidate(mesh, parts, limits.max_parts, volume)
        if best is None or found.deviation_m < best.deviation_m:
            best = found
            if found.deviation_m <= usable:
                give(found)
            tell(f"{about}: {found}")
        if found.deviation_m <= target or search.over() or goal < target / 8:
            break
        goal *= min(0.8, max(0.5, target / found.deviation_m))
    if best.deviation_m > usable:
        raise Undecomposable(
            f"it takes more than {limits.seconds:g} s (the worker's --decompose-seconds): its parts are still"
            f" {1000 * best.deviation_m:.2g} mm off"
        )


def _of_bodies(mesh: Mesh) -> Mesh:
    """The mesh of its bodies alone."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in mesh.bodies[:-1]])
    return Mesh(
        np.concatenate([vertices for vertices, _ in mesh.bodies]),
        np.concatenate([faces + offset for (_, faces), offset in zip(mesh.bodies, offsets, strict=True)]),
        bodies=mesh.bodies,
    )


def _largest(bodies: Sequence[Part], most: int) -> list[Part]:
    """The bodies, or of more than can be parts those with the most volume."""
    if len(bodies) <= most:
        return list(bodies)
    volumes = [mass_properties(vertices[faces]).volume for vertices, faces in bodies]
    return [bodies[k] for k in sorted(np.argsort(volumes)[-most:].tolist())]


class _Report:
    """Tells a person about once a second how far the cutting is."""

    def __init__(self, about: str, began: float, limit_s: float, tell: Callable[[str], None]) -> None:
        self._about = about
        self._began = began
        self._limit_s = limit_s
        self._tell = tell
        self._told = -float("inf")

    def __call__(self, search: Search, target_m: float) -> None:
        now = time.process_time()
        if now < self._told + _TOLD_EVERY_S:
            return
        self._told = now
        deepest = max((piece.depth_m for piece in search.pieces), default=0.0)
        spent, left = now - self._began, search.left_s(target_m)
        self._tell(
            f"{self._about}: {len(search.pieces)} pieces, {1000 * deepest:.2g} mm deep;"
            f" {spent:.0f} s, about {left:.0f} s left, at most {self._limit_s:.0f} s"
        )


# ------------------------------------------------------------------------------- what is no solid


def _remesh(
    mesh: Mesh, limits: CuttingLimits, tell: Callable[[str], None], give: Callable[[Candidate], None]
) -> None:
    began = time.process_time()
    best = float("inf")
    for threshold in _THRESHOLDS:
        tell(
            f"{len(mesh.faces):,} faces that enclose no solid: CoACD remeshes them, threshold {threshold:g};"
            f" {time.process_time() - began:.0f} s, at most {limits.seconds:.0f} s"
        )
        found = _candidate(mesh, _by_coacd(mesh, threshold, limits.seed), limits.max_parts, None)
        if found.deviation_m < best:
            best = found.deviation_m
            give(found)
        tell(str(found))
        # A finer one takes longer; what there is by now is worth more than nothing at the end.
        if found.deviation_m <= target_m(mesh) or time.process_time() - began > limits.seconds / 3:
            return


def _by_coacd(mesh: Mesh, threshold: float, seed: int) -> list[Part]:
    coacd.set_log_level("off")
    # Near the origin and of size one: the library's tolerances are absolute.
    centre = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    scale = float(np.ptp(mesh.vertices, axis=0).max())
    try:
        found = coacd.run_coacd(
            coacd.Mesh((mesh.vertices - centre) / scale, mesh.faces),
            threshold=threshold,
            seed=seed,
            max_ch_vertex=cutting.MAX_PART_VERTICES,
            **_QUICK,
        )
    except RuntimeError as error:
        raise Undecomposable(f"CoACD fails: {error}") from None
    crumb = _CRUMB * float(np.prod(np.maximum(np.ptp(mesh.vertices, axis=0), 1e-9)))
    hulls = (_part(vertices * scale + centre, crumb) for vertices, _ in found)
    parts = [part for part in hulls if part is not None]
    if not parts:
        raise Undecomposable("CoACD finds no solid in the mesh: is its surface closed?")
    return parts


# ---------------------------------------------------------------------------------------------- parts


def _candidate(mesh: Mesh, parts: list[Part], max_parts: int, volume: float | None) -> Candidate:
    if not parts:
        raise Undecomposable("its bodies are too thin for convex parts")
    if len(parts) > max_parts:
        raise Undecomposable(f"it needs {len(parts)} convex parts; at most {max_parts} are supported")
    glb = meshes.parts_to_glb(parts)
    try:
        parts = meshes.parts_from_glb(glb)
    except MeshError as error:
        raise Undecomposable(f"its parts are not usable: {error}") from None
    added = None if volume is None else united_volume(parts) / volume - 1.0
    return Candidate(glb, len(parts), deviation(mesh, parts).largest_m, added)


def _part(vertices: npt.NDArray[np.float64], crumb_m3: float = 0.0) -> Part | None:
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
