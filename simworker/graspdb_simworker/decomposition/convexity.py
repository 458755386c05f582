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
from graspdb_geometry.deviation import ACCEPTED_VOLUME, Fit, fit, of_bodies
from graspdb_geometry.mass import mass_properties
from graspdb_geometry.meshes import Mesh, MeshError, Part
from graspdb_simworker.decomposition import cutting
from graspdb_simworker.decomposition.cutting import Goal, Search

#: Parts are good enough when they are as near to the mesh as the larger of these.
TARGET_M, TARGET_SHARE = 5e-4, 0.01
#: The share of the time allowed that cutting may take: what is left is for measuring the parts.
CUTTING_SHARE = 0.6
#: Simplifying may move the surface by this share of what the parts may, and by this of a body's thickness.
_SIMPLIFYING_SHARE, _OF_THICKNESS = 0.2, 0.04
#: The search gives up where pieces as shallow as this share of the target still do not do.
_SHALLOWEST = 1 / 64
#: The pieces' hulls may add this share of the volume that parts may add or lack.
_EXCESS_SHARE = 0.8
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
    """Parts of the mesh, ``glb`` with ``parts`` of them, and how far they stand for it."""

    glb: bytes
    parts: int
    fit: Fit

    def __str__(self) -> str:
        volume = "" if self.fit.volume is None else f", {self.fit.volume - 1.0:+.1%} volume"
        return f"{self.parts} parts, at most {1000 * self.fit.deviation_m:.2g} mm off{volume}"

    def better_than(self, other: Candidate | None) -> bool:
        """Whether they stand for it sooner than the others."""
        if other is None or self.fit.accepted != other.fit.accepted:
            return other is None or self.fit.accepted
        return self.fit.deviation_m < other.fit.deviation_m


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
    the one before. Those of solids stand for the mesh; what an open surface is taken for may be farther off.
    Undecomposable if there is none.
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
    mesh = of_bodies(mesh)
    target = target_m(mesh)
    began = time.process_time()
    search = Search(deadline=began + CUTTING_SHARE * limits.seconds)
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
        thickness = 2.0 * made.volume() / made.surface_area()
        solid = cutting.simplified(made, min(_SIMPLIFYING_SHARE * target, _OF_THICKNESS * thickness))
        faces += solid.num_tri()
        cutting.add(search, solid)
    bodies = "a body" if len(mesh.bodies) == 1 else f"{len(mesh.bodies)} bodies, {len(whole)} convex"
    about = f"{len(mesh.faces):,} faces in {bodies}"
    if faces and faces < len(mesh.faces):
        about += f", simplified to {faces:,}"
    report = _Report(about, began, limits.seconds, tell)
    goal = Goal(target, _EXCESS_SHARE * ACCEPTED_VOLUME * volume)
    best: Candidate | None = None
    while True:
        report(search, goal.depth_m)
        cutting.refine(search, goal, limits.max_parts - len(whole), report)
        cutting.merge(search, goal)
        parts = whole + [part for hull in cutting.hulls(search, target) if (part := _part(hull)) is not None]
        found = _candidate(mesh, parts, limits.max_parts, volume)
        if found.better_than(best):
            best = found
            if found.fit.accepted:
                give(found)
            tell(f"{about}: {found}")
        done = found.fit.accepted and found.fit.deviation_m <= target
        if done or search.over() or goal.depth_m < _SHALLOWEST * target:
            break
        goal = _nearer(goal, found.fit, target)
    assert best is not None
    if not best.fit.accepted:
        late = f"it takes more than {limits.seconds:g} s (the worker's --decompose-seconds)"
        why = late if search.over() else "finer cuts bring them no nearer"
        raise Undecomposable(f"{why}: the surface of the best {best.parts} parts is {best.fit}")


def _nearer(goal: Goal, found: Fit, target_m: float) -> Goal:
    """What to aim at where what was found for a goal is too far off, in distance, volume or both."""
    depth, excess = goal.depth_m, goal.excess_m3
    if found.deviation_m > target_m:
        depth *= min(0.8, max(0.5, target_m / found.deviation_m))
    swelled = abs((found.volume or 1.0) - 1.0)
    if swelled > ACCEPTED_VOLUME:
        excess *= min(0.8, max(0.5, ACCEPTED_VOLUME / swelled))
        # It need not be an excess: simplified, a thin wall may have lost as much.
        depth *= 0.9
    return Goal(depth, excess)


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
    best: Candidate | None = None
    for threshold in _THRESHOLDS:
        tell(
            f"{len(mesh.faces):,} faces that enclose no solid: CoACD remeshes them, threshold {threshold:g};"
            f" {time.process_time() - began:.0f} s, at most {limits.seconds:.0f} s"
        )
        found = _candidate(mesh, _by_coacd(mesh, threshold, limits.seed), limits.max_parts, None)
        if found.better_than(best):
            best = found
            give(found)
        tell(str(found))
        # A finer one takes longer; what there is by now is worth more than nothing at the end.
        if found.fit.deviation_m <= target_m(mesh) or time.process_time() - began > limits.seconds / 3:
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
    return Candidate(glb, len(parts), fit(mesh, parts, volume))


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
