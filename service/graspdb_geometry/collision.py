"""Exact tests of a gripper's boxes against an object: does the gripper collide, what would it close on?

Solids that only touch, or that overlap by less than :data:`TOUCH_TOLERANCE_M`, do not collide: lattice poses
meet symmetric objects exactly face to face, and rounding must not decide those.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from graspdb_geometry._compiled import convex, surface, tree
from graspdb_geometry._compiled.widths import surface_extents
from graspdb_geometry.grippers import GripperShape
from graspdb_geometry.poses import PoseArrays, ToolPoses, checked

FloatArray = npt.NDArray[np.float64]
CodeArray = npt.NDArray[np.uint8]
Part = tuple[npt.ArrayLike, npt.ArrayLike]

#: The open gripper overlaps the object.
COLLIDES = 0
#: No collision, and nothing in the column that the closing fingers sweep.
EMPTY = 1
#: No collision, and the fingers will meet the object.
CONTACT = 2

#: Overlaps shallower than this count as touching, which is no collision.  Far above the rounding of meshes
#: stored as float32 (4e-9 m at 7 cm), far below what a simulator resolves.
TOUCH_TOLERANCE_M = 1e-7

MAX_RETREAT_M = 2.0

#: Poses handed to a thread at once: long enough to hide the hand-over, short enough to balance the load.
_BLOCK = 8192

#: A box that meets nothing: centre and half extents.
_NOWHERE = np.array([[1e9, 1e9, 1e9], [0.0, 0.0, 0.0]])


class Scene:
    """An object as a union of convex solids, prepared for many collision tests; immutable, thread-safe.

    Parameters
    ----------
    parts : sequence of (vertices (V, 3), faces (F, 3))
        Convex polyhedra, metres, object frame.  A part stands for the convex hull of its vertices.

    Raises
    ------
    ValueError
        Without parts, or if a part is flat, has fewer than four vertices or a coordinate that is not finite.
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        if not parts:
            raise ValueError("parts must hold at least one convex part")
        solids = [_Solid(number, np.asarray(part[0], dtype=np.float64)) for number, part in enumerate(parts)]
        self.part_count = len(solids)
        self._model = (
            np.concatenate([s.vertices for s in solids]),
            _starts([len(s.vertices) for s in solids]),
            np.concatenate([s.planes for s in solids]),
            _starts([len(s.planes) for s in solids]),
            np.concatenate([s.edges for s in solids]),
            _starts([len(s.edges) for s in solids]),
            np.stack([s.centre for s in solids]),
            np.array([s.radius for s in solids]),
        )

    @property
    def nbytes(self) -> int:
        """Bytes that it keeps."""
        return sum(array.nbytes for array in self._model)

    def classify(
        self, poses: PoseArrays, shape: GripperShape, threads: int = 1
    ) -> tuple[CodeArray, FloatArray]:
        """What the open gripper meets in each pose.

        Parameters
        ----------
        poses : (n)
        shape : GripperShape
            Tested at its full opening.
        threads : int
            Threads to share the work; the kernels run without the interpreter's lock.

        Returns
        -------
        codes : (n,) uint8
            :data:`COLLIDES`, :data:`EMPTY` or :data:`CONTACT`.
        first_contact : (n, 2) float64
            For CONTACT the distance in metres that the finger at +y, and the one at -y, can close alone
            before it meets the object; beyond the stroke if the object lies on one side only.  Otherwise NaN.
        """
        p, q = checked(poses)
        boxes = _gripper_boxes(shape, None, 0.0)
        codes = np.empty(len(p), dtype=np.uint8)
        extents = np.empty((len(p), 2))

        def run(block: slice) -> None:
            convex.classify(p[block], q[block], boxes, self._model, True, codes[block], extents[block])

        in_blocks(run, len(p), threads)
        half = shape.max_opening_m / 2.0
        travel = np.stack([half - extents[:, 1], half + extents[:, 0]], axis=-1)
        return codes, np.maximum(travel, 0.0)

    def collides(
        self,
        poses: PoseArrays,
        shape: GripperShape,
        opening_m: float | None = None,
        threads: int = 1,
        retreat_m: float = 0.0,
    ) -> npt.NDArray[np.bool_]:
        """Whether the gripper overlaps the object in each pose, or on its way there.

        Parameters
        ----------
        poses, shape, threads
            As in :meth:`classify`.
        opening_m : float, optional
            Gap between the fingers, its widest by default.
        retreat_m : float
            Test the whole straight approach along z that starts this far back; exact, as a box swept along
            one of its own axes is a box.

        Returns
        -------
        (n,) bool
        """
        p, q = checked(poses)
        boxes = _gripper_boxes(shape, opening_m, retreat_m)
        codes = np.empty(len(p), dtype=np.uint8)
        extents = np.empty((len(p), 2))

        def run(block: slice) -> None:
            convex.classify(p[block], q[block], boxes, self._model, False, codes[block], extents[block])

        in_blocks(run, len(p), threads)
        hits: npt.NDArray[np.bool_] = codes == COLLIDES
        return hits

    def holds(self, poses: PoseArrays, shape: GripperShape, threads: int = 1) -> npt.NDArray[np.bool_]:
        """Whether the open gripper is free and something lies between its fingers, (n,).

        Much quicker than asking how wide: one part between the fingers tells, and most poses have none near.
        """
        p, q = checked(poses)
        boxes = _gripper_boxes(shape, None, 0.0)
        # The column alone, as a gripper of one box: the others are farther than anything and have no size.
        column = np.stack([boxes[3], *(_NOWHERE for _ in range(3))])
        codes = np.full(len(p), COLLIDES, dtype=np.uint8)
        unused = np.empty((len(p), 2))

        def run(block: slice) -> None:
            convex.classify(p[block], q[block], column, self._model, False, codes[block], unused[block])

        in_blocks(run, len(p), threads)
        held: npt.NDArray[np.bool_] = codes == COLLIDES
        met = np.flatnonzero(held)
        if met.size:
            held[met] = ~self.collides(ToolPoses(p[met], q[met]), shape, threads=threads)
        return held

    def contains_centres(
        self, poses: PoseArrays, boxes: FloatArray, threads: int = 1
    ) -> npt.NDArray[np.bool_]:
        """Whether the object contains the centre of one of up to three boxes (B, 2, 3: centre, half extents;
        tool frame) at each pose, (n,).
        """
        p, q = checked(poses)
        points = np.stack([np.stack([box[0], np.zeros(3)]) for box in boxes])
        points = np.concatenate([points, np.broadcast_to(_NOWHERE, (4 - len(points), 2, 3))])
        codes = np.empty(len(p), dtype=np.uint8)
        unused = np.empty((len(p), 2))

        def run(block: slice) -> None:
            convex.classify(p[block], q[block], points, self._model, False, codes[block], unused[block])

        in_blocks(run, len(p), threads)
        held: npt.NDArray[np.bool_] = codes == COLLIDES
        return held

    def widths(self, poses: PoseArrays, shape: GripperShape, threads: int = 1) -> FloatArray:
        """How far apart the fingers are once both touch the object, metres, (n,).

        That is the object's extent along y between the fingers, for a free object is centred as they close.
        NaN where the open gripper collides or nothing is between the fingers.
        """
        _, travel = self.classify(poses, shape, threads)
        return np.asarray(shape.max_opening_m - travel.sum(axis=1), dtype=np.float64)

    def extents(self, poses: PoseArrays, box: tuple[FloatArray, FloatArray], threads: int = 1) -> FloatArray:
        """Least and greatest y of the object within a box of the tool frame (half extents, centre), metres,
        (n, 2); NaN where it is outside.
        """
        p, q = checked(poses)
        half, centre = box
        column = np.stack([*(_NOWHERE for _ in range(3)), np.stack([centre, half])])
        codes = np.empty(len(p), dtype=np.uint8)
        extents = np.empty((len(p), 2))

        def run(block: slice) -> None:
            convex.classify(p[block], q[block], column, self._model, True, codes[block], extents[block])

        in_blocks(run, len(p), threads)
        return extents


class Surface:
    """An object as triangles, the exact geometry of its mesh; immutable, thread-safe.

    Parameters
    ----------
    vertices : (V, 3) float
        Metres, object frame.
    faces : (F, 3) int
        Triangles, counterclockwise seen from outside.
    watertight : bool
        The triangles close a solid: then a gripper wholly inside of it collides too.
    inside : Scene, optional
        Convex parts of the object, which tell what lies inside where the triangles do not: a box of the
        gripper that meets none of them collides if its centre is in a part.
    inside_off_m : float
        How far the parts' surface and the triangles lie apart at most. Parts are not believed about boxes
        thinner than twice that, which may be in a room that the parts fill.

    Raises
    ------
    ValueError
        Without triangles, for indices out of range or coordinates that are not finite.
    """

    #: Triangles in a leaf of the tree.
    _LEAF = 4

    def __init__(
        self,
        vertices: npt.ArrayLike,
        faces: npt.ArrayLike,
        *,
        watertight: bool,
        inside: Scene | None = None,
        inside_off_m: float = 0.0,
    ) -> None:
        points = np.asarray(vertices, dtype=np.float64)
        index = np.asarray(faces, dtype=np.int64)
        if points.ndim != 2 or points.shape[1] != 3 or not np.all(np.isfinite(points)):
            raise ValueError("vertices must be (V, 3) and finite")
        if index.ndim != 2 or index.shape[1] != 3 or not len(index):
            raise ValueError("faces must be (F, 3) with at least one row")
        if int(index.min()) < 0 or int(index.max()) >= len(points):
            raise ValueError("faces must refer to existing vertices")
        self.watertight = watertight
        self.triangle_count = len(index)
        corners = points[index]
        nodes, links, order = tree.build(corners, self._LEAF)
        self._tree: surface.Tree = (nodes, links, corners[order])
        self._inside = inside
        self._inside_off_m = inside_off_m

    @property
    def nbytes(self) -> int:
        """Bytes that it keeps."""
        own = sum(array.nbytes for array in self._tree)
        return own if self._inside is None else own + self._inside.nbytes

    def collides(
        self,
        poses: PoseArrays,
        shape: GripperShape,
        opening_m: float | None = None,
        threads: int = 1,
        retreat_m: float = 0.0,
    ) -> npt.NDArray[np.bool_]:
        """Whether the gripper overlaps the object in each pose; as :meth:`Scene.collides`."""
        p, q = checked(poses)
        boxes = np.ascontiguousarray(_gripper_boxes(shape, opening_m, retreat_m)[:3])
        hits = np.empty(len(p), dtype=np.bool_)

        def run(block: slice) -> None:
            surface.collides(p[block], q[block], boxes, self._tree, self.watertight, hits[block])

        in_blocks(run, len(p), threads)
        if self._inside is not None and not self.watertight:
            # What meets no triangle is wholly inside or outside, its centre half as far off as it is thick.
            known = boxes[boxes[:, 1].min(axis=1) > self._inside_off_m]
            rows = np.flatnonzero(~hits)
            if len(known) and rows.size:
                hits[rows] = self._inside.contains_centres(ToolPoses(p[rows], q[rows]), known, threads)
        return hits

    def holds(self, poses: PoseArrays, shape: GripperShape, threads: int = 1) -> npt.NDArray[np.bool_]:
        """As :meth:`Scene.holds`; much quicker than asking how wide."""
        p, q = checked(poses)
        column = np.ascontiguousarray(_gripper_boxes(shape, None, 0.0)[3:])
        met = np.empty(len(p), dtype=np.bool_)

        def run(block: slice) -> None:
            surface.collides(p[block], q[block], column, self._tree, False, met[block])

        in_blocks(run, len(p), threads)
        return met & ~self.collides(poses, shape, threads=threads)

    def widths(self, poses: PoseArrays, shape: GripperShape, threads: int = 1) -> FloatArray:
        """As :meth:`Scene.widths`."""
        centre, half = _gripper_boxes(shape, None, 0.0)[3]
        extents = self.extents(poses, (half, centre), threads)
        width: FloatArray = extents[:, 1] - extents[:, 0]
        width[self.collides(poses, shape, threads=threads)] = np.nan
        return width

    def extents(self, poses: PoseArrays, box: tuple[FloatArray, FloatArray], threads: int = 1) -> FloatArray:
        """As :meth:`Scene.extents`, of the surface alone."""
        p, q = checked(poses)
        half, centre = box
        column = np.ascontiguousarray(np.stack([centre, half]))
        extents = np.empty((len(p), 2))

        def run(block: slice) -> None:
            surface_extents(p[block], q[block], column, self._tree, extents[block])

        in_blocks(run, len(p), threads)
        return extents

    def contains(self, points: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether points (n, 3) lie in the solid; in the union, where several closed pieces overlap."""
        x = np.ascontiguousarray(points, dtype=np.float64)
        found = np.empty(len(x), dtype=np.bool_)
        surface.contains(x, self._tree, found)
        return found


class PointCloud:
    """Obstacles as points of a sensor, each a ball; immutable, thread-safe.

    Parameters
    ----------
    points : (K, 3) float
        Metres, in the frame of the poses that will be asked for.
    radius_m : float
        How much room around each point counts as occupied.
    """

    def __init__(self, points: npt.ArrayLike, radius_m: float = 0.0) -> None:
        self.points = np.ascontiguousarray(points, dtype=np.float64)
        if self.points.ndim != 2 or self.points.shape[1] != 3 or not np.all(np.isfinite(self.points)):
            raise ValueError("points must be (K, 3) and finite")
        if not (np.isfinite(radius_m) and 0.0 <= radius_m <= 1.0):
            raise ValueError("radius_m must lie between 0 and 1 m")
        self.radius_m = float(radius_m)

    def collides(
        self,
        poses: PoseArrays,
        shape: GripperShape,
        opening_m: float | None = None,
        threads: int = 1,
        retreat_m: float = 0.0,
    ) -> npt.NDArray[np.bool_]:
        """Whether the gripper overlaps a ball in each pose; as :meth:`Scene.collides`."""
        p, q = checked(poses)
        boxes = np.ascontiguousarray(_gripper_boxes(shape, opening_m, retreat_m)[:3])
        hits = np.empty(len(p), dtype=np.bool_)

        def run(block: slice) -> None:
            surface.points_collide(p[block], q[block], boxes, self.points, self.radius_m, hits[block])

        in_blocks(run, len(p), threads)
        return hits


def box_part(half_extents: npt.ArrayLike, position: npt.ArrayLike, quaternion: npt.ArrayLike) -> Part:
    """A box as a convex part, for obstacles.

    Parameters
    ----------
    half_extents, position : (3,) float
        Metres.
    quaternion : (4,) float
        Orientation xyzw.
    """
    half = np.asarray(half_extents, dtype=np.float64)
    if half.shape != (3,) or not np.all(half > 0) or not np.all(np.isfinite(half)):
        raise ValueError("half_extents must be three positive numbers")
    signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    p, q = checked(ToolPoses(np.reshape(position, (1, -1)), np.reshape(quaternion, (1, -1))))
    vertices: FloatArray = Rotation.from_quat(q[0]).apply(signs * half) + p[0]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([(a, b, c) for quad in quads for a, b, c in (quad[:3], (quad[0], *quad[2:]))])
    return vertices, faces


class _Solid:
    """Vertices, supporting planes and edges of the convex hull of some points."""

    #: Facets whose normals differ by less than this (radians) are one face; treating it as flat displaces it
    #: by at most this share of its size, less than the touch tolerance for a part of 10 cm.
    _COPLANAR = 1e-6

    def __init__(self, number: int, points: FloatArray) -> None:
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 4:
            raise ValueError(f"part {number}: vertices must be (V, 3) with at least four rows")
        if not np.all(np.isfinite(points)):
            raise ValueError(f"part {number}: vertices must be finite")
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        try:
            hull = ConvexHull(points - middle)
        except QhullError:
            raise ValueError(f"part {number} is flat: its vertices lie in one plane") from None
        corners = np.asarray(hull.vertices)
        self.vertices: FloatArray = points[corners]
        renumber = np.full(len(points), -1)
        renumber[corners] = np.arange(len(corners))

        normals = np.asarray(hull.equations)[:, :3]
        simplices, neighbours = np.asarray(hull.simplices), np.asarray(hull.neighbors)
        face = np.full(len(normals), -1)
        planes: list[FloatArray] = []
        for seed in range(len(normals)):
            if face[seed] >= 0:
                continue
            # One face: everything connected to the seed whose normal agrees with the seed's.
            face[seed] = len(planes)
            pending = [seed]
            while pending:
                for other in neighbours[pending.pop()]:
                    if face[other] < 0 and np.linalg.norm(normals[other] - normals[seed]) < self._COPLANAR:
                        face[other] = face[seed]
                        pending.append(int(other))
            offset = float(np.max(self.vertices @ normals[seed]))  # a plane that supports every vertex
            planes.append(np.append(normals[seed], offset))
        self.planes: FloatArray = np.stack(planes)

        edges = set()
        for simplex in range(len(simplices)):
            for opposite, other in enumerate(neighbours[simplex]):
                if face[simplex] < face[other]:
                    a, b = np.delete(renumber[simplices[simplex]], opposite)
                    edges.add((min(a, b), max(a, b)))
        self.edges = np.array(sorted(edges), dtype=np.int64)
        self.centre: FloatArray = (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2
        self.radius = float(np.max(np.linalg.norm(self.vertices - self.centre, axis=1))) * (1 + 1e-12)


def _starts(counts: list[int]) -> npt.NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _gripper_boxes(shape: GripperShape, opening_m: float | None, retreat_m: float) -> FloatArray:
    """Centres and half extents, less the touch tolerance, of both fingers, palm and column: (4, 2, 3)."""
    if not 0.0 <= retreat_m <= MAX_RETREAT_M:
        raise ValueError(f"retreat_m must lie between 0 and {MAX_RETREAT_M:g} m")
    half_extents, centres = shape.boxes(opening_m)
    half_extents[:, 2] += retreat_m / 2
    centres[:, 2] -= retreat_m / 2
    column_half, column_centre = shape.column(opening_m)
    shrunk = np.maximum(half_extents - TOUCH_TOLERANCE_M, 0.0)
    # The column keeps its full height in y, so that contact starts at the fingers' faces.
    column_half = np.maximum(column_half - np.array([1.0, 0.0, 1.0]) * TOUCH_TOLERANCE_M, 0.0)
    boxes: FloatArray = np.stack(
        [np.concatenate([centres, [column_centre]]), np.concatenate([shrunk, [column_half]])], axis=1
    )
    return np.ascontiguousarray(boxes)


def in_blocks(run: Callable[[slice], Any], count: int, threads: int) -> None:
    if threads < 1:
        raise ValueError("threads must be at least 1")
    blocks = [slice(start, min(start + _BLOCK, count)) for start in range(0, count, _BLOCK)]
    if threads == 1 or len(blocks) < 2:
        for block in blocks:
            run(block)
        return
    with ThreadPoolExecutor(min(threads, len(blocks))) as pool:
        for _ in pool.map(run, blocks):
            pass
