"""The paper's four objects, built from convex parts: cone, elongated D, screwdriver, mug.

Collision tests and physics need convex parts; building the objects from them avoids a decomposition, which
would change their shape.  Each object also has a surface mesh without the seams between the parts.  Lengths
are metres, the object frame's origin is the object's centre (for the mug, the middle of its axis).  Only
trimesh objects and GLB need trimesh, and import it when asked; NumPy is enough for the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from graspdb.files.meshes import scene_of

if TYPE_CHECKING:
    import trimesh

FloatArray = npt.NDArray[np.float64]
FaceArray = npt.NDArray[np.int64]
#: Vertices (V, 3) in metres and triangles (F, 3), counterclockwise seen from outside.
Polyhedron = tuple[FloatArray, FaceArray]

#: Plastic, as solid parts.
DENSITY_KG_M3 = 1000.0
FRICTION = 0.4


@dataclass(frozen=True)
class ExampleObject:
    """An object of the paper; ``name`` is a slug, for example ``elongated-d``.

    ``parts`` are convex polyhedra, vertices (V, 3) in the object frame, metres, and faces (F, 3), whose union
    is the object; ``surface`` closed surfaces with the same union. Where the object needs two of them (the
    mug's handle in its wall) they overlap a little, so an enclosed volume counts the overlap twice.
    """

    name: str
    title: str
    parts: tuple[Polyhedron, ...]
    surface: tuple[Polyhedron, ...]
    density_kg_m3: float = DENSITY_KG_M3
    friction: float = FRICTION

    @property
    def mass_kg(self) -> float:
        """Mass of the solid parts."""
        return self.density_kg_m3 * sum(volume(part) for part in self.parts)

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of the bounding box, metres."""
        points = np.concatenate([vertices for vertices, _ in self.parts])
        return points.min(axis=0), points.max(axis=0)

    @property
    def triangles(self) -> Polyhedron:
        """The surface as one indexed mesh."""
        return concatenate(self.surface)

    def stl(self) -> bytes:
        """The surface as binary STL in metres."""
        vertices, faces = self.triangles
        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        record = np.zeros(
            len(faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")]
        )
        record["normal"], record["corners"] = normals, corners
        header = f"GraspDB example {self.name}, metres".encode().ljust(80, b" ")
        return header + len(faces).to_bytes(4, "little") + record.tobytes()

    def mesh(self) -> trimesh.Trimesh:
        """The surface as a trimesh object."""
        import trimesh

        vertices, faces = self.triangles
        return trimesh.Trimesh(vertices=vertices, faces=faces, process=False)

    def parts_glb(self) -> bytes:
        """The convex parts as GLB, one geometry a part."""
        import trimesh

        parts = [trimesh.Trimesh(vertices=v, faces=f, process=False) for v, f in self.parts]
        data = scene_of(parts).export(file_type="glb")
        if not isinstance(data, bytes):
            raise TypeError("trimesh did not export GLB as bytes")
        return data


def volume(part: Polyhedron) -> float:
    """Volume enclosed by a closed surface, m^3 (divergence theorem)."""
    vertices, faces = part
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def concatenate(solids: tuple[Polyhedron, ...]) -> Polyhedron:
    """Put several polyhedra into one indexed mesh."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in solids[:-1]])
    vertices = np.concatenate([v for v, _ in solids])
    faces = np.concatenate([f + offset for (_, f), offset in zip(solids, offsets, strict=True)])
    return vertices, faces


def _polygon(count: int, radius: float, z: float) -> FloatArray:
    """Regular polygon about the z axis, counterclockwise from above, its first corner on the x axis."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], axis=-1)


def _band(lower: FaceArray, upper: FaceArray) -> FaceArray:
    """Triangles between two closed rings of equally many vertices, facing away from their axis."""
    lower_next, upper_next = np.roll(lower, -1), np.roll(upper, -1)
    return np.concatenate(
        [np.stack([lower, lower_next, upper_next], axis=-1), np.stack([lower, upper_next, upper], axis=-1)]
    )


def _fan(ring: FaceArray) -> FaceArray:
    """Triangles of a convex ring."""
    return np.stack([np.full(len(ring) - 2, ring[0]), ring[1:-1], ring[2:]], axis=-1)


def _stack(rings: list[FloatArray]) -> Polyhedron:
    """Solid between rings of equally many corners, capped at both ends; rings run around the growing axis."""
    count = len(rings[0])
    index = np.arange(len(rings) * count).reshape(len(rings), count)
    faces = [_band(lower, upper) for lower, upper in pairwise(index)]
    faces += [_fan(index[0])[:, ::-1], _fan(index[-1])]
    return np.concatenate(rings), np.concatenate(faces)


def _prism(polygon: npt.ArrayLike, low: float, high: float) -> Polyhedron:
    """Convex polygon (n, 2), counterclockwise, extruded along z."""
    flat = np.asarray(polygon, dtype=np.float64)
    return _stack([np.column_stack([flat, np.full(len(flat), z)]) for z in (low, high)])


def _tube(outer: FloatArray, inner: FloatArray, low: float, high: float) -> Polyhedron:
    """Ring between two polygons (n, 2), corner by corner, extruded along z."""
    count = len(outer)
    loops = [np.column_stack([loop, np.full(count, z)]) for loop in (outer, inner) for z in (low, high)]
    outer_low, outer_high, inner_low, inner_high = np.arange(4 * count).reshape(4, count)
    faces = [
        _band(outer_low, outer_high),
        _band(inner_low, inner_high)[:, ::-1],
        _band(inner_low, outer_low),
        _band(outer_high, inner_high),
    ]
    return np.concatenate(loops), np.concatenate(faces)


def _zip_rings(inner: FaceArray, outer: FaceArray) -> FaceArray:
    """Triangles, facing +z, between two concentric regular polygons that both start on the x axis."""
    faces = []
    i = j = 0
    while i < len(inner) or j < len(outer):
        a, b = inner[i % len(inner)], outer[j % len(outer)]
        # Advance on the ring whose next corner comes first, compared as integers.
        if i >= len(inner) or (j < len(outer) and (j + 1) * len(inner) <= (i + 1) * len(outer)):
            j += 1
            faces.append([a, b, outer[j % len(outer)]])
        else:
            i += 1
            faces.append([a, b, inner[i % len(inner)]])
    return np.array(faces, dtype=np.int64)


def _cone() -> ExampleObject:
    solid = _stack([_polygon(32, 0.040, -0.200), _polygon(32, 0.010, 0.200)])
    return ExampleObject("cone", "Cone", (solid,), (solid,))


def _elongated_d() -> ExampleObject:
    half = 0.175

    def outline(radius: float, flat_x: float) -> FloatArray:
        angle = np.linspace(-np.pi / 2, np.pi / 2, 13)
        arc = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        arc[[0, -1], 0] = 0.0  # the cosine of a quarter turn is 6e-17
        return np.concatenate([arc, [[flat_x, radius], [flat_x, -radius]]])

    outer, inner = outline(0.070, -0.070), outline(0.060, -0.060)
    parts = [
        _prism([inner[k], outer[k], outer[k + 1], inner[k + 1]], -half, half) for k in range(12)
    ]  # the half circle
    parts += [
        _prism([[-0.070, 0.060], [0.0, 0.060], [0.0, 0.070], [-0.070, 0.070]], -half, half),
        _prism([[-0.070, -0.070], [0.0, -0.070], [0.0, -0.060], [-0.070, -0.060]], -half, half),
        _prism([[-0.070, -0.060], [-0.060, -0.060], [-0.060, 0.060], [-0.070, 0.060]], -half, half),
    ]
    surface = _tube(outer, inner, -half, half)
    return ExampleObject("elongated-d", "Elongated D", tuple(parts), (surface,))


def _screwdriver() -> ExampleObject:
    # From the end cap up: cap 10 mm and grip 85 mm make the 95 mm handle, then neck, shaft and blade.
    profile = [(0.011, -0.140), (0.015, -0.130), (0.015, -0.045), (0.009, -0.030)]
    rings = [_polygon(20, radius, z) for radius, z in profile]
    shaft = [_polygon(12, 0.004, z) for z in (-0.030, 0.125)]
    blade = _prism([[-0.005, -0.0006], [0.005, -0.0006], [0.005, 0.0006], [-0.005, 0.0006]], 0.125, 0.140)
    parts = (_stack(rings[:3]), _stack(rings[2:]), _stack(shaft), blade)

    # One closed surface of handle, neck and shaft: the shaft stands on the neck's end as a ring of triangles.
    count = 20 * len(rings)
    ring_index = np.arange(count).reshape(len(rings), 20)
    foot, top = np.arange(count, count + 12), np.arange(count + 12, count + 24)
    faces = [_band(lower, upper) for lower, upper in pairwise(ring_index)]
    faces += [
        _fan(ring_index[0])[:, ::-1],
        _zip_rings(foot, ring_index[-1]),
        _band(foot, top),
        _fan(top),
    ]
    body = (np.concatenate([*rings, *shaft]), np.concatenate(faces))
    return ExampleObject("screwdriver", "Screwdriver", parts, (body, blade))


def _mug() -> ExampleObject:
    low, high, floor = -0.040, 0.040, -0.035
    outer, inner = _polygon(24, 0.030, 0.0)[:, :2], _polygon(24, 0.026, 0.0)[:, :2]
    parts = [
        _prism([inner[k - 1], outer[k - 1], outer[k], inner[k]], low, high) for k in range(24)
    ]  # the wall
    parts.append(_prism(inner, low, floor))

    # Handle: half a ring in the x-z plane about x = 28 mm, whose ends lie inside the wall.
    angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
    sections = []
    for a in angle:
        radial = np.array([np.cos(a), 0.0, np.sin(a)])
        centre = np.array([0.028, 0.0, 0.0]) + 0.026 * radial
        corners = [(-0.003, -0.005), (0.003, -0.005), (0.003, 0.005), (-0.003, 0.005)]
        sections.append(np.array([centre + r * radial + [0.0, y, 0.0] for r, y in corners]))
    parts += [_stack([sections[k], sections[k + 1]]) for k in range(8)]
    handle = _stack(sections)

    # Body: outside, rim, inside wall down to the floor, floor, underside.
    loops = [
        np.column_stack([loop, np.full(24, z)])
        for loop, z in ((outer, low), (outer, high), (inner, high), (inner, floor))
    ]
    return ExampleObject("mug", "Mug", tuple(parts), (_stack(loops), handle))


_BUILDERS: dict[str, Callable[[], ExampleObject]] = {
    "cone": _cone,
    "elongated-d": _elongated_d,
    "screwdriver": _screwdriver,
    "mug": _mug,
}

#: Names of the examples.
EXAMPLES: tuple[str, ...] = tuple(_BUILDERS)


def example(name: str) -> ExampleObject:
    """Build one of the paper's objects, :data:`EXAMPLES`; ``elongated_d`` is accepted for ``elongated-d``."""
    builder = _BUILDERS.get(name.replace("_", "-"))
    if builder is None:
        raise ValueError(f"no example named {name!r}; there are {', '.join(EXAMPLES)}")
    return builder()
