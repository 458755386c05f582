"""Meshes from users: read, checked, measured, and split into convex parts.

Reading foreign files takes memory and time that only a process of its own can bound: a service calls
:func:`inspect` in one. Lengths are metres in the object frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from graspdb_geometry.mesh_reading.formats import (
    READERS,
    FaceArray,
    FloatArray,
    FormatError,
    Geometry,
    read_glb,
    write_glb,
)
from graspdb_geometry.mesh_reading.repair import repair

#: Metres per unit.
UNITS: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
MEDIA_TYPES: tuple[str, ...] = tuple(READERS)

MAX_TRIANGLES = 1_000_000
MAX_EXTENT_M = 10.0
MIN_EXTENT_M = 1e-4
MAX_COORDINATE_M = 100.0
MAX_PARTS = 1024
MAX_PART_TRIANGLES = 20_000
#: A part may fall short of its convex hull by this share of the volume: rounding to float32, no real dent.
CONVEX_TOLERANCE = 1e-3
#: Volume over area of a part; a plate thinner than twice this can't be simulated.
_MIN_THICKNESS_M = 1e-6

#: A convex part: vertices (V, 3) in metres and outward triangles (F, 3).
Part = tuple[FloatArray, FaceArray]


class MeshError(ValueError):
    """A mesh that can't be used.

    Attributes
    ----------
    field : str
        What is wrong: ``content_type``, ``unit``, ``mesh`` or ``parts[i]``.
    message : str
        A sentence for the person who sent it.
    """

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field
        self.message = message


@dataclass(frozen=True)
class Mesh:
    """A checked triangle mesh: vertices (V, 3) in metres, faces (F, 3), and what was mended in reading it."""

    vertices: FloatArray
    faces: FaceArray
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class MeshProperties:
    """Measures of a mesh, object frame.

    Attributes
    ----------
    lower, upper : list of 3 floats
        Bounding box, metres.
    watertight : bool
        At every edge as many triangles run one way as the other, and the volume is positive: a closed
        surface, or several, which may touch or overlap.
    convex : bool
        Watertight and equal to its convex hull, so that it is its own convex part.
    volume_m3, centre_of_mass, inertia : float, list, 3x3 list, or None
        Of the enclosed solid; inertia about the centre of mass at unit density (m^5), to be multiplied by the
        density in kg/m^3.  None unless watertight.
    area_m2 : float
    triangles : int
    warnings : list of str
    """

    lower: list[float]
    upper: list[float]
    watertight: bool
    convex: bool
    volume_m3: float | None
    centre_of_mass: list[float] | None
    inertia: list[list[float]] | None
    area_m2: float
    triangles: int
    warnings: list[str]


def load(data: bytes, media_type: str, unit: str = "m", *, max_triangles: int = MAX_TRIANGLES) -> Mesh:
    """Read a mesh from memory and check it.

    Vertices at the same place are merged (STL repeats each of them), triangles that repeat a vertex are
    dropped with a warning, a solid that is inside out is turned. A surface that is not closed is mended
    where that is no guess: seams sewn, triangles wound alike, small holes filled; the warnings say what was
    done, or why it could not be closed.

    Parameters
    ----------
    data : bytes
        The file.
    media_type : str
        One of :data:`MEDIA_TYPES`; parameters after a semicolon are ignored.
    unit : str
        One of :data:`UNITS`.
    max_triangles : int
        Refuse more.

    Raises
    ------
    MeshError
        Foreign or broken content, no triangles, coordinates that are not finite, indices out of range, a
        bounding box larger than 10 m or smaller than 0.1 mm.
    """
    reader = READERS.get(media_type.split(";", 1)[0].strip().lower())
    if reader is None:
        raise MeshError("content_type", f"must be one of {', '.join(MEDIA_TYPES)}")
    if unit not in UNITS:
        raise MeshError("unit", f"must be one of {', '.join(UNITS)}")
    if not data:
        raise MeshError("mesh", "the body is empty")
    try:
        geometries = reader(data, max_triangles)
    except FormatError as error:
        raise MeshError("mesh", str(error)) from None
    geometries = [g for g in geometries if len(g.faces)]
    if not geometries:
        raise MeshError("mesh", "it has no triangles")
    for geometry in geometries:
        _check_values("mesh", geometry)
    offsets = np.cumsum([0] + [len(g.vertices) for g in geometries[:-1]])
    vertices = np.concatenate([g.vertices for g in geometries]) * UNITS[unit]
    faces = np.concatenate([g.faces + offset for g, offset in zip(geometries, offsets, strict=True)])
    _check_size(vertices[np.unique(faces)], unit)
    mesh = _canonical(vertices, faces)
    return mesh if _closed(mesh.faces) else _mended(mesh)


def properties(mesh: Mesh, unit: str = "m") -> MeshProperties:
    """Measure a mesh; ``unit`` is the one it was sent in and serves the warnings only."""
    lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    corners = mesh.vertices[mesh.faces]
    area = 0.5 * float(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    )
    volume, centre, inertia = _mass_properties(corners)
    watertight = _closed(mesh.faces) and volume > 0
    convex = watertight and _is_hull(mesh.vertices, mesh.faces, volume)
    largest = float((upper - lower).max())
    warnings = list(mesh.warnings)
    if not watertight:
        warnings.append(
            "the mesh is not watertight: volume and inertia are unknown, and poses wholly inside the object "
            "can't be told from free ones until it has convex parts"
        )
    if unit == "m" and largest > 1.0:
        warnings.append(f"the largest extent is {largest:.3g} m: if the file is in millimetres, send unit=mm")
    if unit != "m" and largest < 0.005:
        warnings.append(
            f"the largest extent is {largest * 1000:.3g} mm: if the file is in metres, send unit=m"
        )
    if float((upper - lower).min()) < 1e-6:
        warnings.append("the mesh is flat")
    if np.any(lower > 0.5) or np.any(upper < -0.5):
        warnings.append("the mesh lies more than 0.5 m from the object frame's origin")
    return MeshProperties(
        lower=lower.tolist(),
        upper=upper.tolist(),
        watertight=watertight,
        convex=convex,
        volume_m3=volume if watertight else None,
        centre_of_mass=centre.tolist() if watertight else None,
        inertia=inertia.tolist() if watertight else None,
        area_m2=area,
        triangles=len(mesh.faces),
        warnings=warnings,
    )


# ------------------------------------------------------------------------------------- convex parts


def parts_from_glb(data: bytes) -> list[Part]:
    """Read convex parts, one for each geometry of a GLB in metres, and check every one.

    Raises
    ------
    MeshError
        With field ``parts`` for the file, ``parts[i]`` for a part that is not closed, not convex, flat or not
        finite.
    """
    try:
        geometries = read_glb(data, MAX_TRIANGLES)
    except FormatError as error:
        raise MeshError("parts", str(error)) from None
    if not geometries:
        raise MeshError("parts", "the GLB has no geometry")
    return check_parts([(g.vertices, g.faces) for g in geometries])


def parts_to_glb(parts: Sequence[Part]) -> bytes:
    """Write convex parts as GLB, one geometry a part; coordinates are rounded to float32."""
    return write_glb([Geometry(np.asarray(v, dtype=np.float64), np.asarray(f)) for v, f in parts])


def check_parts(parts: Sequence[Part]) -> list[Part]:
    """Check that each part is a closed convex solid; returns them merged and facing outwards.

    Raises
    ------
    MeshError
        As in :func:`parts_from_glb`.
    """
    if len(parts) > MAX_PARTS:
        raise MeshError("parts", f"there are {len(parts)} parts; at most {MAX_PARTS} are supported")
    checked: list[Part] = []
    for number, (vertices, faces) in enumerate(parts):
        field = f"parts[{number}]"
        if not len(faces):
            raise MeshError(field, "it has no triangles")
        if len(faces) > MAX_PART_TRIANGLES:
            raise MeshError(field, f"it has more than {MAX_PART_TRIANGLES:,} triangles")
        _check_values(field, Geometry(vertices, faces))
        if float(np.max(np.abs(vertices))) > MAX_COORDINATE_M:
            raise MeshError(field, f"it lies more than {MAX_COORDINATE_M:g} m from the origin")
        part = _canonical(vertices, faces)
        corners = part.vertices[part.faces]
        volume, _, _ = _mass_properties(corners)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * float(np.linalg.norm(normals, axis=1).sum())
        if len(part.faces) < 4 or volume < _MIN_THICKNESS_M * area:
            raise MeshError(field, "it is flat or not closed: a convex part must enclose a volume")
        if not _closed(part.faces):
            raise MeshError(field, "it is not closed: an edge does not belong to exactly two triangles")
        if not _is_hull(part.vertices, part.faces, volume):
            raise MeshError(field, "it is not convex")
        checked.append((part.vertices, part.faces))
    return checked


# --------------------------------------------------------------------------------- in a child process


@dataclass(frozen=True)
class Inspection:
    """A checked mesh and its measures."""

    mesh: Mesh
    properties: MeshProperties


def inspect(
    data: bytes, media_type: str, unit: str = "m", *, max_triangles: int = MAX_TRIANGLES
) -> Inspection:
    """Load and measure in this process; for content that is trusted."""
    mesh = load(data, media_type, unit, max_triangles=max_triangles)
    return Inspection(mesh, properties(mesh, unit))


def readable(media_type: str, unit: str) -> bool:
    """Whether meshes of this media type and unit are read at all."""
    return media_type.split(";", 1)[0].strip().lower() in READERS and unit in UNITS


# -------------------------------------------------------------------------------------------- checks


def _check_values(field: str, geometry: Geometry) -> None:
    vertices, faces = geometry
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(field, "it is not made of triangles with three coordinates a vertex")
    if int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        raise MeshError(field, "a triangle refers to a vertex that does not exist")
    if not np.all(np.isfinite(vertices)):
        raise MeshError(field, "a coordinate is not finite")


def _check_size(used: FloatArray, unit: str) -> None:
    low, high = used.min(axis=0), used.max(axis=0)
    with np.errstate(over="ignore"):
        largest = float((high - low).max())
    if largest > MAX_EXTENT_M:
        hint = ": is the file in millimetres (unit=mm)?" if unit != "mm" else ""
        raise MeshError("mesh", f"its largest extent is {largest:.3g} m, more than {MAX_EXTENT_M:g} m{hint}")
    if largest < MIN_EXTENT_M:
        hint = ": is the file in metres (unit=m)?" if unit != "m" else ""
        raise MeshError("mesh", f"its largest extent is {largest:.3g} m, less than 0.1 mm{hint}")
    if max(abs(float(low.min())), abs(float(high.max()))) > MAX_COORDINATE_M:
        raise MeshError("mesh", f"it lies more than {MAX_COORDINATE_M:g} m from the origin")


def _canonical(vertices: FloatArray, faces: FaceArray) -> Mesh:
    """Merge equal vertices, drop unused ones and collapsed triangles, turn an inside-out solid."""
    used, faces_used = np.unique(faces, return_inverse=True)
    points = vertices[used] + 0.0  # -0 and 0 are one place
    order = np.lexsort(points.T[::-1])
    ranked = points[order]
    new = np.concatenate([[True], np.any(ranked[1:] != ranked[:-1], axis=1)])
    number = np.empty(len(points), dtype=np.int64)
    number[order] = np.cumsum(new) - 1
    merged = ranked[new]
    triangles = number[faces_used.reshape(-1, 3)]
    collapsed = (
        (triangles[:, 0] == triangles[:, 1])
        | (triangles[:, 1] == triangles[:, 2])
        | (triangles[:, 2] == triangles[:, 0])
    )
    warnings: list[str] = []
    if np.any(collapsed):
        triangles = triangles[~collapsed]
        warnings.append(f"{int(collapsed.sum())} triangles without area were left out")
    if not len(triangles):
        raise MeshError("mesh", "it has no triangle with an area")
    if _closed(triangles) and _mass_properties(merged[triangles])[0] < 0:
        triangles = np.ascontiguousarray(triangles[:, ::-1])
        warnings.append("the surface was inside out and has been turned")
    return Mesh(np.ascontiguousarray(merged), np.ascontiguousarray(triangles), tuple(warnings))


def _mended(mesh: Mesh) -> Mesh:
    """The mesh closed, or as it was with the reasons why it can't be."""
    mended = repair(mesh.vertices, mesh.faces)
    if len(mended.faces) and _closed(mended.faces):
        closed = _canonical(mended.vertices, mended.faces)
        note = f"the mesh was not watertight and has been mended: {', '.join(mended.done)}"
        return Mesh(closed.vertices, closed.faces, (*mesh.warnings, note, *closed.warnings))
    reasons = mended.left or ["its triangles can't be wound alike"]
    return Mesh(mesh.vertices, mesh.faces, (*mesh.warnings, f"it can't be closed: {', '.join(reasons)}"))


def _closed(faces: FaceArray) -> bool:
    """Every directed edge has exactly one opposite: closed, oriented, two triangles an edge.

    Where several sheets share an edge (parts that touch) each must still be balanced, so a solid put together
    from closed pieces passes.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = int(faces.max()) + 1
    forward = np.sort(edges[:, 0] * count + edges[:, 1])
    backward = np.sort(edges[:, 1] * count + edges[:, 0])
    return bool(np.array_equal(forward, backward))


def _mass_properties(corners: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Volume, centre of mass and inertia about it at unit density of the solid within triangles (F, 3, 3).

    Sums over signed tetrahedra from a point near the mesh (Tonon, "Explicit exact formulas for the 3-D
    tetrahedron inertia tensor", J. Math. Stat. 1, 2005, in covariance form).
    """
    origin = corners.reshape(-1, 3).mean(axis=0)  # near the mesh, or distant meshes would cancel badly
    tetrahedra = corners - origin
    signed = np.einsum("ij,ij->i", tetrahedra[:, 0], np.cross(tetrahedra[:, 1], tetrahedra[:, 2])) / 6.0
    volume = float(signed.sum())
    if volume == 0.0:
        return 0.0, origin, np.zeros((3, 3))
    total = tetrahedra.sum(axis=1)
    centre = np.einsum("i,ij->j", signed, total) / (4.0 * volume)
    # Integral of x x^T over a tetrahedron with a corner at 0: V / 20 (sum of a a^T over corners + s s^T).
    second = np.einsum("i,ikj,ikl->jl", signed, tetrahedra, tetrahedra)
    second += np.einsum("i,ij,il->jl", signed, total, total)
    covariance = second / 20.0 - volume * np.outer(centre, centre)
    inertia = np.trace(covariance) * np.eye(3) - covariance
    return volume, origin + centre, inertia


def _is_hull(vertices: FloatArray, faces: FaceArray, volume: float) -> bool:
    """Whether a closed surface of this volume fills its convex hull and has its area."""
    try:
        hull = ConvexHull(vertices - vertices.mean(axis=0))
    except QhullError:
        return False
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * float(np.linalg.norm(normals, axis=1).sum())
    # The volume alone would let pass a surface that also folds inside the hull.
    same_volume = abs(float(hull.volume) - volume) <= CONVEX_TOLERANCE * float(hull.volume)
    return bool(same_volume and abs(float(hull.area) - area) <= CONVEX_TOLERANCE * float(hull.area))
