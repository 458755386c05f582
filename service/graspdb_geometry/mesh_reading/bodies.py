"""The solid that a closed surface encloses: its bodies told apart, turned outwards, counted once, united.

A surface from a modelling tool is often several: put together from bodies that overlap or touch, drawn twice
or both ways round, with cavities, or with one body inside out. A point belongs to the solid if bodies enclose
it more often than cavities do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import manifold3d
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from graspdb_geometry.mass import area, mass_properties
from graspdb_geometry.mesh_reading.content import FaceArray, FloatArray
from graspdb_geometry.mesh_reading.touching import bodies_of

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
Surface = tuple[FloatArray, FaceArray]

#: Bodies nearer than this share of the mesh's diagonal touch.
TOUCHING_SHARE = 1e-5
#: A union smaller than its bodies together by this share has bodies that overlap.
_OVERLAP_SHARE = 1e-6
#: A body with a thinner mean thickness, as a share of the mesh's diagonal, is a sheet without volume.
_SHEET_SHARE = 1e-7
_PROBES = 24
_OVERLAP = "its bodies overlap, so that {:.1%} of their volume counted twice, and were united"
_APART = "it has {} bodies that do not touch: they are weighed and moved as one rigid object"


class NotSolid(ValueError):
    """A closed surface that bounds no solid."""


@dataclass(frozen=True)
class Solid:
    """A closed surface made right.

    Attributes
    ----------
    vertices, faces : (V, 3), (F, 3)
        Every body outwards and once, overlapping ones united.
    bodies : tuple of (vertices, faces)
        Each body apart with its cavities, before overlapping ones were united; bodies inside others left out.
    notes : tuple of str
        What was done, for the user.
    pieces : int
        Pieces that do not touch one another.
    """

    vertices: FloatArray
    faces: FaceArray
    bodies: tuple[Surface, ...]
    notes: tuple[str, ...]
    pieces: int = 1


class _Body(NamedTuple):
    """A connected closed surface: its triangles among all, turned outwards or not, volume and box."""

    faces: FaceArray
    volume: float
    lower: FloatArray
    upper: FloatArray
    unsure: bool


def resolve(vertices: FloatArray, faces: FaceArray, wound: BoolArray | None = None) -> Solid:
    """Tell the bodies of a closed surface apart and put them together right.

    Parameters
    ----------
    vertices : (V, 3) float64
    faces : (F, 3) int
        Closed, see :func:`~graspdb_geometry.mesh_reading.touching.is_closed`.
    wound : (F,) bool, optional
        Triangles whose winding does not tell which side is out.

    Raises
    ------
    NotSolid
        A body's surface can't be oriented or united with others.
    """
    extent = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    number = bodies_of(vertices, faces)
    if int(number.max()) == 0:
        return _single(vertices, faces)
    notes: list[str] = []
    unsure = np.zeros(len(faces), dtype=np.bool_) if wound is None else wound
    order = np.argsort(number, kind="stable")
    starts = np.flatnonzero(np.diff(number[order], prepend=-1))
    found = [_body(vertices, faces[some], unsure[some]) for some in np.split(order, starts[1:])]
    thick = [body for body in found if _is_thick(vertices, body, extent)]
    if not thick:
        return Solid(vertices, faces, (), ())
    if len(thick) < len(found):
        notes.append(f"sheets without volume, which count in collisions only: {len(found) - len(thick)}")
    distinct = _distinct(thick)
    if len(distinct) < len(thick):
        again = len(thick) - len(distinct)
        notes.append(f"bodies that stood twice or both ways round, and count once: {again}")
    sheets = [body for body in found if not _is_thick(vertices, body, extent)]
    placed = _placed(vertices, distinct, notes)
    solid = _united(vertices, placed, [_surface(vertices, [sheet]) for sheet in sheets], extent)
    if not notes and not solid.notes:
        # Nothing was wrong: the triangles stay in their order.
        solid = replace(solid, vertices=vertices, faces=faces)
    apart = () if solid.pieces == 1 else (_APART.format(solid.pieces),)
    return replace(solid, notes=(*notes, *solid.notes, *apart))


def _single(vertices: FloatArray, faces: FaceArray) -> Solid:
    """The one body, turned outwards if it was not."""
    volume = mass_properties(vertices[faces]).volume
    notes: tuple[str, ...] = ()
    if volume < 0:
        faces = np.ascontiguousarray(faces[:, ::-1])
        notes = ("the surface was inside out and has been turned",)
    return Solid(vertices, faces, ((vertices, faces),) if volume else (), notes)


def _body(vertices: FloatArray, faces: FaceArray, unsure: BoolArray) -> _Body:
    corners = vertices[faces]
    points = corners.reshape(-1, 3)
    volume = mass_properties(corners).volume
    return _Body(faces, volume, points.min(axis=0), points.max(axis=0), bool(unsure.any()))


def _is_thick(vertices: FloatArray, body: _Body, extent: float) -> bool:
    return abs(body.volume) > _SHEET_SHARE * extent * area(vertices[body.faces])


def _distinct(bodies: list[_Body]) -> list[_Body]:
    """One of each set of bodies with the same triangles, whichever way round; both ways, it is unsure."""
    kept: dict[bytes, _Body] = {}
    for body in bodies:
        triangles = np.sort(body.faces, axis=1)
        key = triangles[np.lexsort(triangles.T)].tobytes()
        before = kept.setdefault(key, body)
        if before.volume * body.volume < 0:
            kept[key] = _facing(before, outwards=True)._replace(unsure=True)
    return list(kept.values())


# ---------------------------------------------------------------------------------- inside and outside


class _Placed(NamedTuple):
    """Bodies facing outwards, and the cavities, facing inwards, of each."""

    outer: list[_Body]
    cavities: list[list[_Body]]


def _placed(vertices: FloatArray, bodies: list[_Body], notes: list[str]) -> _Placed:
    """Tell bodies from cavities, from the outermost in, and leave out bodies wholly inside material.

    A body in the open faces outwards, or was inside out with all that is in it. In material, one that faces
    inwards is a cavity, and one that faces outwards adds nothing.
    """
    bodies = sorted(bodies, key=lambda body: -abs(body.volume))
    around = _around(vertices, bodies)
    sign = [1 if body.volume > 0 else -1 for body in bodies]
    weight = [0] * len(bodies)
    cavities: dict[int, list[int]] = {}
    turned = inside = 0
    for number, body in enumerate(bodies):
        material = sum(weight[other] for other in around[number])
        if material <= 0:
            if sign[number] < 0:
                turned += 1
                for other in range(len(bodies)):
                    if other == number or number in around[other]:
                        sign[other] = -sign[other]
            weight[number] = 1
            cavities[number] = []
        elif sign[number] < 0 or body.unsure:
            weight[number] = -1
            parents = [other for other in around[number] if other in cavities]
            cavities[parents[-1]].append(number)
        else:
            inside += 1
    if turned:
        notes.append(
            "the surface was inside out and has been turned"
            if len(cavities) == turned
            else f"bodies that were inside out, and have been turned: {turned}"
        )
    if inside:
        notes.append(
            f"bodies wholly inside another, which add nothing: {inside} (were they cavities, their triangles"
            " would face the cavity)"
        )
    outer = [_facing(bodies[number], outwards=True) for number in cavities]
    holes = [[_facing(bodies[hole], outwards=False) for hole in cavities[number]] for number in cavities]
    return _Placed(outer, holes)


def _facing(body: _Body, *, outwards: bool) -> _Body:
    if (body.volume > 0) == outwards:
        return body
    return body._replace(faces=np.ascontiguousarray(body.faces[:, ::-1]), volume=-body.volume)


def _around(vertices: FloatArray, bodies: list[_Body]) -> list[list[int]]:
    """For each body, those that it lies wholly inside of; bodies come with the largest first."""
    lower, upper = (np.array([getattr(body, side) for body in bodies]) for side in ("lower", "upper"))
    solids: dict[int, manifold3d.Manifold] = {}
    around: list[list[int]] = []
    for number, body in enumerate(bodies):
        boxed = np.all((lower[:number] <= lower[number]) & (upper[:number] >= upper[number]), axis=1)
        found = []
        for other in np.flatnonzero(boxed).tolist():
            if other not in solids:
                solids[other] = _manifold(vertices, [_facing(bodies[other], outwards=True)])
            if _lies_inside(vertices, body, bodies[other], solids[other]):
                found.append(other)
        around.append(found)
    return around


def _lies_inside(vertices: FloatArray, body: _Body, other: _Body, solid: manifold3d.Manifold) -> bool:
    """Whether points all over a body's surface are inside another, or on its surface but not all of them."""
    corners = vertices[body.faces[:: max(1, len(body.faces) // _PROBES)]]
    points = np.concatenate([corners[:, 0], corners.mean(axis=1)])
    far = other.upper + (other.upper - other.lower) * [0.217, 0.341, 0.293] + 1e-3
    inside = 0
    for point in points:
        start = point - TOUCHING_SHARE * (far - point)
        hits = solid.ray_cast(start.tolist(), far.tolist())
        # A hit's distance is a share of the ray, which is about as long as the body: the point is on it.
        if any(hit.distance <= 2.0 * TOUCHING_SHARE for hit in hits):
            continue
        if len(hits) % 2 == 0:
            return False
        inside += 1
    return inside > 0


# -------------------------------------------------------------------------------------------- union


def _united(vertices: FloatArray, placed: _Placed, sheets: list[Surface], extent: float) -> Solid:
    """Put bodies together; those whose boxes meet are united, and stay as they were if nothing overlaps."""
    groups = [[body, *holes] for body, holes in zip(placed.outer, placed.cavities, strict=True)]
    surfaces = [_surface(vertices, group) for group in groups]
    reach = TOUCHING_SHARE * extent
    pieces: list[Surface] = list(sheets)
    apart = 0
    total = united = 0.0
    for cluster in _clusters(placed.outer, reach):
        solids = [_manifold(vertices, groups[number]) for number in cluster]
        union = solids[0]
        if len(cluster) > 1:
            union = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
            _check(union)
        together = sum(body.volume for number in cluster for body in groups[number])
        total += together
        if len(cluster) > 1 and union.volume() < together * (1.0 - _OVERLAP_SHARE):
            united += together - union.volume()
            mesh = union.to_mesh64()
            pieces.append((mesh.vert_properties[:, :3].copy(), mesh.tri_verts.astype(np.int64)))
        else:
            pieces += [surfaces[number] for number in cluster]
        apart += _separate(union, solids, reach) if len(cluster) > 1 else 1
    notes = (_OVERLAP.format(united / total),) if united else ()
    offsets = np.cumsum([0] + [len(points) for points, _ in pieces[:-1]])
    return Solid(
        np.concatenate([points for points, _ in pieces]),
        np.concatenate([faces + offset for (_, faces), offset in zip(pieces, offsets, strict=True)]),
        tuple(surfaces),
        notes,
        apart,
    )


def _surface(vertices: FloatArray, group: list[_Body]) -> Surface:
    """Bodies with vertices of their own."""
    used, faces = np.unique(np.concatenate([body.faces for body in group]), return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _manifold(vertices: FloatArray, group: list[_Body]) -> manifold3d.Manifold:
    points, faces = _surface(vertices, group)
    made = manifold3d.Manifold(manifold3d.Mesh64(np.ascontiguousarray(points), faces.astype(np.uint64)))
    _check(made)
    return made


def _check(made: manifold3d.Manifold) -> None:
    if made.status() != manifold3d.Error.NoError:
        raise NotSolid(made.status().name)


def _clusters(bodies: list[_Body], reach: float) -> list[list[int]]:
    """Bodies whose boxes meet, directly or through others."""
    lower, upper = (np.array([getattr(body, side) for body in bodies]) for side in ("lower", "upper"))
    one, two = [], []
    for number in range(len(bodies)):
        meet = np.all((lower <= upper[number] + reach) & (upper >= lower[number] - reach), axis=1)
        others = np.flatnonzero(meet)
        one.append(np.full(len(others), number))
        two.append(others)
    rows, columns = np.concatenate(one), np.concatenate(two)
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(bodies),) * 2)
    count, cluster = connected_components(graph, directed=False)
    return [np.flatnonzero(cluster == number).tolist() for number in range(count)]


def _separate(union: manifold3d.Manifold, solids: list[manifold3d.Manifold], reach: float) -> int:
    """How many of the solids in a union, or groups of them, do not touch."""
    if sum(surface.volume() > 0 for surface in union.decompose()) == 1:
        return 1
    boxes = np.array([solid.bounding_box() for solid in solids])
    near = np.eye(len(solids), dtype=np.bool_)
    for one, two in zip(*np.triu_indices(len(solids), 1), strict=True):
        gap = np.maximum(boxes[one, :3] - boxes[two, 3:], boxes[two, :3] - boxes[one, 3:]).max()
        near[one, two] = gap <= reach and solids[one].min_gap(solids[two], 2.0 * reach) <= reach
    count, _ = connected_components(coo_matrix(near), directed=False)
    return int(count)
