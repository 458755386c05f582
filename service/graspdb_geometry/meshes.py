"""Meshes from users: read, checked, measured, and split into convex parts.

Reading foreign files takes memory and time that only a process of its own can bound: a service calls
:func:`inspect` in one. Lengths are metres in the object frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from graspdb_geometry.mass import area, mass_properties, share_counted_wrong
from graspdb_geometry.mesh_reading.bodies import NotSolid, resolve
from graspdb_geometry.mesh_reading.content import FaceArray, FloatArray, FormatError, Geometry
from graspdb_geometry.mesh_reading.formats import READERS
from graspdb_geometry.mesh_reading.gltf.reading import read_glb
from graspdb_geometry.mesh_reading.gltf.writing import write_glb
from graspdb_geometry.mesh_reading.repair import repair
from graspdb_geometry.mesh_reading.touching import is_closed

#: Metres per unit.
UNITS: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
MEDIA_TYPES: tuple[str, ...] = tuple(READERS)

MAX_SCALE = 1e6
MAX_TRIANGLES = 1_000_000
MAX_EXTENT_M = 10.0
MIN_EXTENT_M = 1e-4
MAX_COORDINATE_M = 100.0
MAX_PARTS = 1024
MAX_PART_TRIANGLES = 20_000
#: A part may fall short of its convex hull by this share of the volume: rounding to float32, no real dent.
CONVEX_TOLERANCE = 1e-3
#: A surface that encloses more than this share of its volume twice or inside out has no volume to trust.
MAX_WRONG_SHARE = 2e-3
#: Volume over area of a surface, as a share of its extent, that is rounding and no thickness.
_SHEET_SHARE = 1e-9
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
    """A checked triangle mesh: vertices (V, 3) in metres, faces (F, 3), and what was mended in reading it.

    ``bodies`` are the solids that a closed mesh is made of, apart, each with its cavities; they may touch and
    overlap. ``sound`` is false where a closed surface runs through itself and so encloses no solid.
    """

    vertices: FloatArray
    faces: FaceArray
    warnings: tuple[str, ...] = ()
    bodies: tuple[Part, ...] = ()
    sound: bool = True


@dataclass(frozen=True)
class MeshProperties:
    """Measures of a mesh, object frame.

    Attributes
    ----------
    lower, upper : list of 3 floats
        Bounding box, metres.
    watertight : bool
        At every edge as many triangles run one way as the other, the volume is positive and enclosed once: a
        closed surface, or several, which may touch.
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


def load(
    data: bytes,
    media_type: str,
    unit: str = "m",
    scale: float = 1.0,
    *,
    max_triangles: int = MAX_TRIANGLES,
) -> Mesh:
    """Read a mesh from memory and check it.

    Vertices at the same place are merged (STL repeats each of them), triangles that repeat a vertex are
    dropped with a warning. A surface that is not closed is mended where that is no guess: seams sewn,
    triangles wound alike, small holes filled. Bodies that are inside out are turned, those that stand twice
    count once, overlapping ones are united; cavities stay. The warnings say what was done, or why the mesh
    could not be closed.

    Parameters
    ----------
    data : bytes
        The file.
    media_type : str
        One of :data:`MEDIA_TYPES`; parameters after a semicolon are ignored.
    unit : str
        One of :data:`UNITS`.
    scale : float
        Factor to the file's coordinates, beside its unit: above 0, :data:`MAX_SCALE` at most.
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
    if not 0.0 < scale <= MAX_SCALE:
        raise MeshError("scale", f"must be above 0 and at most {MAX_SCALE:g}")
    if not data:
        raise MeshError("mesh", "the body is empty")
    try:
        content = reader(data, max_triangles)
    except FormatError as error:
        raise MeshError("mesh", str(error)) from None
    geometries = [g for g in content.geometries if len(g.faces)]
    if not geometries:
        raise MeshError("mesh", "it has no triangles")
    for geometry in geometries:
        _check_values("mesh", geometry)
    offsets = np.cumsum([0] + [len(g.vertices) for g in geometries[:-1]])
    vertices = np.concatenate([g.vertices for g in geometries]) * (UNITS[unit] * scale)
    faces = np.concatenate([g.faces + offset for g, offset in zip(geometries, offsets, strict=True)])
    _check_size(vertices[np.unique(faces)], unit, scale)
    mesh = _canonical(vertices, faces)
    return _made_solid(replace(mesh, warnings=(*content.notes, *mesh.warnings)))


def properties(mesh: Mesh, unit: str = "m", scale: float = 1.0) -> MeshProperties:
    """Measure a mesh; ``unit`` and ``scale`` are what it was sent with and serve the warnings only."""
    lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    corners = mesh.vertices[mesh.faces]
    solid = mass_properties(corners)
    closed = is_closed(mesh.faces)
    largest = float((upper - lower).max())
    watertight = closed and mesh.sound and solid.volume > _SHEET_SHARE * largest * area(corners)
    convex = watertight and _is_hull(mesh.vertices, mesh.faces, solid.volume)
    warnings = list(mesh.warnings)
    if not closed:
        warnings.append(
            "the mesh is not watertight: volume and inertia are unknown, and poses wholly inside the object "
            "can't be told from free ones until it has convex parts"
        )
    elif not watertight:
        warnings.append(
            "volume and inertia are unknown: mend the mesh where it was made (a boolean union of its bodies),"
            " or give the object's mass_kg and convex parts"
        )
    if scale != 1.0 and not 0.005 <= largest <= 1.0:
        warnings.append(f"the largest extent is {largest:.3g} m: are unit={unit} and scale={scale:g} right?")
    elif unit == "m" and largest > 1.0:
        warnings.append(f"the largest extent is {largest:.3g} m: if the file is in millimetres, send unit=mm")
    elif unit != "m" and largest < 0.005:
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
        volume_m3=solid.volume if watertight else None,
        centre_of_mass=solid.centre.tolist() if watertight else None,
        inertia=solid.inertia.tolist() if watertight else None,
        area_m2=area(corners),
        triangles=len(mesh.faces),
        warnings=warnings,
    )


# ------------------------------------------------------------------------------------- convex parts


def convex_bodies(mesh: Mesh) -> list[Part]:
    """The bodies of a mesh if they are all convex, and so its convex parts as they are; else none."""
    if not 1 <= len(mesh.bodies) <= MAX_PARTS or not mesh.sound:
        return []
    if not all(is_convex(vertices, faces) for vertices, faces in mesh.bodies):
        return []
    try:
        return check_parts(mesh.bodies)
    except MeshError:  # too fine or too thin for a part
        return []


def is_convex(vertices: FloatArray, faces: FaceArray) -> bool:
    """Whether a closed surface is that of its convex hull."""
    return _is_hull(vertices, faces, mass_properties(vertices[faces]).volume)


def parts_from_glb(data: bytes) -> list[Part]:
    """Read convex parts, one for each geometry of a GLB in metres, and check every one.

    Raises
    ------
    MeshError
        With field ``parts`` for the file, ``parts[i]`` for a part that is not closed, not convex, flat or not
        finite.
    """
    try:
        geometries = read_glb(data, MAX_TRIANGLES).geometries
    except FormatError as error:
        raise MeshError("parts", str(error)) from None
    if not geometries:
        raise MeshError("parts", "the GLB has no geometry")
    return check_parts([(g.vertices, g.faces) for g in geometries])


def parts_to_glb(parts: Sequence[Part]) -> bytes:
    """Write convex parts as GLB, one geometry a part; coordinates are rounded to float32."""
    return write_glb([Geometry(np.asarray(v, dtype=np.float64), np.asarray(f)) for v, f in parts])


def mesh_to_stl(mesh: Mesh) -> bytes:
    """Write a mesh as binary STL in metres, rounded to float32, the normals left to the reader."""
    records = np.zeros(
        len(mesh.faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )
    records["corners"] = mesh.vertices[mesh.faces]
    return bytes(80) + len(records).to_bytes(4, "little") + records.tobytes()


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
        volume = mass_properties(corners).volume
        closed = is_closed(part.faces)
        if closed and volume < 0:
            part, volume = replace(part, faces=np.ascontiguousarray(part.faces[:, ::-1])), -volume
        if len(part.faces) < 4 or volume < _MIN_THICKNESS_M * area(corners):
            raise MeshError(field, "it is flat or not closed: a convex part must enclose a volume")
        if not closed:
            raise MeshError(field, "it is not closed: an edge does not belong to exactly two triangles")
        if not _is_hull(part.vertices, part.faces, volume):
            raise MeshError(field, "it is not convex")
        checked.append((part.vertices, part.faces))
    return checked


# --------------------------------------------------------------------------------- in a child process


@dataclass(frozen=True)
class Inspection:
    """A checked mesh, its measures, and its bodies if they are all convex."""

    mesh: Mesh
    properties: MeshProperties
    parts: list[Part]


def inspect(
    data: bytes,
    media_type: str,
    unit: str = "m",
    scale: float = 1.0,
    *,
    max_triangles: int = MAX_TRIANGLES,
) -> Inspection:
    """Load and measure in this process; for content that is trusted."""
    mesh = load(data, media_type, unit, scale, max_triangles=max_triangles)
    return Inspection(mesh, properties(mesh, unit, scale), convex_bodies(mesh))


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


def _check_size(used: FloatArray, unit: str, scale: float) -> None:
    low, high = used.min(axis=0), used.max(axis=0)
    with np.errstate(over="ignore"):
        largest = float((high - low).max())
    if largest > MAX_EXTENT_M:
        hint = ": is the file in millimetres (unit=mm)?" if unit != "mm" else ""
        if scale != 1.0:
            hint = f": is scale={scale:g} right?"
        raise MeshError("mesh", f"its largest extent is {largest:.3g} m, more than {MAX_EXTENT_M:g} m{hint}")
    if largest < MIN_EXTENT_M:
        hint = ": is the file in metres (unit=m)?" if unit != "m" else ""
        if scale != 1.0:
            hint = f": is scale={scale:g} right?"
        raise MeshError("mesh", f"its largest extent is {largest:.3g} m, less than 0.1 mm{hint}")
    if max(abs(float(low.min())), abs(float(high.max()))) > MAX_COORDINATE_M:
        raise MeshError("mesh", f"it lies more than {MAX_COORDINATE_M:g} m from the origin")


def _canonical(vertices: FloatArray, faces: FaceArray) -> Mesh:
    """Merge equal vertices, drop unused ones and collapsed triangles."""
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
    return Mesh(np.ascontiguousarray(merged), np.ascontiguousarray(triangles), tuple(warnings))


def _made_solid(mesh: Mesh) -> Mesh:
    """The mesh closed and its bodies put right, or as it was with the reasons why that can't be done."""
    vertices, faces, warnings = mesh.vertices, mesh.faces, list(mesh.warnings)
    wound = None
    if not is_closed(faces):
        mended = repair(vertices, faces)
        if not len(mended.faces) or not is_closed(mended.faces):
            reasons = mended.left or ["its triangles can't be wound alike"]
            return replace(mesh, warnings=(*warnings, f"it can't be closed: {', '.join(reasons)}"))
        vertices, faces, wound = mended.vertices, mended.faces, mended.wound
        warnings.append(f"the mesh was not watertight and has been mended: {', '.join(mended.done)}")
    try:
        solid = resolve(vertices, faces, wound)
    except NotSolid as error:
        warnings.append(f"its surface encloses no solid ({error})")
        return Mesh(vertices, faces, tuple(warnings), sound=False)
    warnings += solid.notes
    wrong = share_counted_wrong(solid.vertices[solid.faces])
    if wrong > MAX_WRONG_SHARE:
        warnings.append(
            f"its surface runs through itself: about {wrong:.1%} of its volume is enclosed twice or"
            " inside out"
        )
    return Mesh(solid.vertices, solid.faces, tuple(warnings), solid.bodies, sound=wrong <= MAX_WRONG_SHARE)


def _is_hull(vertices: FloatArray, faces: FaceArray, volume: float) -> bool:
    """Whether a closed surface of this volume fills its convex hull and has its area."""
    try:
        hull = ConvexHull(vertices - vertices.mean(axis=0))
    except QhullError:
        return False
    own = area(vertices[faces])
    # The volume alone would let pass a surface that also folds inside the hull.
    same_volume = abs(float(hull.volume) - volume) <= CONVEX_TOLERANCE * float(hull.volume)
    return bool(same_volume and abs(float(hull.area) - own) <= CONVEX_TOLERANCE * float(hull.area))
