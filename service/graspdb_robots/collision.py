"""Whether an arm collides: its links with each other, and links and gripper with what stands around.

Pinocchio and coal test convex solids against solids and meshes; points of a sensor are tested here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import coal  # extra: robot
import numpy as np
import pinocchio as pin  # extra: robot
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from ._compiled.points import meets_points
from .arm import Arm, Floats, LinkSolid

#: What the gripper is called where it collides.
GRIPPER = "gripper"


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Something that must not be touched: a box, by its edges (3,), metres, or the shape of a mesh.

    ``pose`` (4, 4) is that of its frame in the root's. ``held`` marks what the gripper lifts: links only are
    tested against it, and only until then.
    """

    name: str
    pose: Floats
    size_m: Floats | None = None
    shape: Any = None
    held: bool = False


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What stands around an arm, in the root's frame: obstacles, and points (K, 3) with a radius, metres."""

    obstacles: tuple[Obstacle, ...] = ()
    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    point_radius_m: float = 0.0


class LinkShapes:
    """What an arm's solids are tested by, made once."""

    def __init__(self, arm: Arm) -> None:
        self.of_links = [_shape_of(solid) for solid in arm.solids]
        self.planes = [_planes(solid) for solid in arm.solids]


class ArmCollisions:
    """Tests of one arm, with a gripper, in one place. Not thread-safe: each question makes its own.

    ``gripper`` are convex solids (V, 3) in the flange's frame, metres; ``shapes`` the arm's, kept between
    questions.
    """

    def __init__(
        self,
        arm: Arm,
        gripper: Sequence[Floats] = (),
        around: Surroundings | None = None,
        shapes: LinkShapes | None = None,
    ) -> None:
        around, shapes = around or Surroundings(), shapes or LinkShapes(arm)
        self._model, count = pin_model(arm), len(arm.joints)
        rotation, place = arm.flange[:3, :3], arm.flange[:3, 3]
        held = [LinkSolid(GRIPPER, count, points @ rotation.T + place) for points in gripper]
        self.solids = (*arm.solids, *held)
        self._names = [solid.link for solid in self.solids] + [o.name for o in around.obstacles]
        self._geometry = pin.GeometryModel()
        for i, solid in enumerate(self.solids):
            shape = shapes.of_links[i] if i < len(arm.solids) else _shape_of(solid)
            self._geometry.addGeometryObject(
                pin.GeometryObject(f"solid{i}", solid.joint, pin.SE3.Identity(), shape)
            )
        for i, obstacle in enumerate(around.obstacles):
            placed = pin.SE3(obstacle.pose)
            made = _obstacle_shape(obstacle)
            self._geometry.addGeometryObject(pin.GeometryObject(f"obstacle{i}", 0, placed, made))
        pairs = [(int(i), int(j)) for i, j in arm.pairs]
        first, own = len(arm.solids), len(self.solids)
        # The links next to the flange are where the gripper is mounted.
        pairs += [(g, i) for g in range(first, own) for i in range(first) if self.solids[i].joint < count - 1]
        against_held = []
        for k, obstacle in enumerate(around.obstacles):
            for i, solid in enumerate(self.solids):
                # What stands with the root does not move: it may stand on a table.
                if solid.joint == 0 or (obstacle.held and i >= first):
                    continue
                if obstacle.held:
                    against_held.append(len(pairs))
                pairs.append((i, own + k))
        for pair in pairs:
            self._geometry.addCollisionPair(pin.CollisionPair(*pair))
        self._pairs = pairs
        self._data, self._before = self._model.createData(), self._geometry.createData()
        self._after = self._geometry.createData()
        for index in against_held:
            self._after.deactivateCollisionPair(index)
        alone = self._geometry.createData()
        for k, (i, j) in enumerate(pairs):
            if not first <= i < own <= j:
                alone.deactivateCollisionPair(k)
        # A tree of boxes sorts out most pairs: some five times as fast as all of them.
        tree = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager
        self._trees = [tree(self._model, self._geometry, data) for data in (self._before, self._after, alone)]
        self._points = np.ascontiguousarray(around.points, dtype=np.float64)
        self._radius = around.point_radius_m
        own_planes = [_planes(solid) for solid in held]
        self._planes = [*shapes.planes, *own_planes]

    def hits(self, joints: Floats, *, lifted: bool = False) -> bool:
        """Whether anything collides at joints (n,); ``lifted``: without what is held then."""
        q = np.ascontiguousarray(joints)
        if pin.computeCollisions(self._model, self._data, self._trees[lifted], q, True):
            return True
        return self._meeting_points() is not None

    def gripper_hits(self, joints: Floats) -> bool:
        """Whether the gripper meets an obstacle at joints (n,), points apart: then it does at any joints that
        take it there.
        """
        q = np.ascontiguousarray(joints)
        return bool(pin.computeCollisions(self._model, self._data, self._trees[2], q, True))

    def which(self, joints: Floats, *, lifted: bool = False) -> tuple[str, str] | None:
        """A link that collides at joints (n,), and with what; None where none does."""
        return next(self._colliding(joints, lifted), None)

    def all_hits(self, joints: Floats, *, lifted: bool = False) -> list[tuple[str, str]]:
        """All that collide at joints (n,): links, each with what it meets."""
        return list(dict.fromkeys(self._colliding(joints, lifted)))

    def _colliding(self, joints: Floats, lifted: bool) -> Iterator[tuple[str, str]]:
        data = self._after if lifted else self._before
        pin.computeCollisions(
            self._model, self._data, self._geometry, data, np.ascontiguousarray(joints), False
        )
        for k, pair in enumerate(self._pairs):
            if data.activeCollisionPairs[k] and data.collisionResults[k].isCollision():
                yield self._names[pair[0]], self._names[pair[1]]
        met = self._meeting_points()
        if met is not None:
            yield met, "points"

    def self_hits(self, joints: Floats) -> NDArray[np.bool_]:
        """Of each tested pair, whether it collides at joints (n,)."""
        pin.computeCollisions(
            self._model, self._data, self._geometry, self._before, np.ascontiguousarray(joints), False
        )
        return np.array([result.isCollision() for result in self._before.collisionResults], dtype=np.bool_)

    def _meeting_points(self) -> str | None:
        """The link that points meet where forward kinematics put it last."""
        if not len(self._points):
            return None
        for solid, (planes, middle, reach) in zip(self.solids, self._planes, strict=True):
            if solid.joint == 0:
                continue
            place = self._data.oMi[solid.joint].homogeneous
            if meets_points(place, planes, middle, reach, self._points, self._radius + solid.radius_m):
                return solid.link
        return None


def self_collisions(arm: Arm, joints: Floats) -> NDArray[np.bool_]:
    """Which of an arm's pairs (P) collide at joints (N, n): (N, P)."""
    test = ArmCollisions(arm)
    return np.array([test.self_hits(q) for q in joints]).reshape(len(joints), -1)


def pin_model(arm: Arm) -> Any:
    """The arm's joints as a model of pinocchio's."""
    model, parent = pin.Model(), 0
    for i, name in enumerate(arm.joints):
        kind = pin.JointModelPrismaticUnaligned if arm.sliding[i] else pin.JointModelRevoluteUnaligned
        parent = model.addJoint(parent, kind(arm.axes[i]), pin.SE3(arm.placements[i]), name)
    return model


def _shape_of(solid: LinkSolid) -> Any:
    if len(solid.points) == 1:
        # Coal has no point: a ball that shrinks to one.
        return coal.Convex.convexHull(_vectors(_ball(solid.points[0], solid.radius_m)), True, "Qt")
    if len(solid.points) == 2:
        ends = [_ball(end, solid.radius_m) for end in solid.points]
        return coal.Convex.convexHull(_vectors(np.concatenate(ends)), True, "Qt")
    return coal.Convex.convexHull(_vectors(solid.points), True, "Qt")


def _ball(centre: Floats, radius: float) -> Floats:
    """Corners of a solid about a ball: a cube cut at edges and corners, 10 % larger at most."""
    signs = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z])
    directions = signs / np.linalg.norm(signs, axis=1)[:, None]
    return np.asarray(centre + 1.15 * max(radius, 1e-6) * directions)


def _obstacle_shape(obstacle: Obstacle) -> Any:
    if obstacle.size_m is not None:
        return coal.Box(np.asarray(obstacle.size_m, dtype=np.float64))
    return obstacle.shape


def mesh_shape(triangles: Floats) -> Any:
    """The shape of a mesh, of triangles (F, 3, 3), metres, to be kept and placed as an obstacle."""
    made, count = coal.BVHModelOBBRSS(), len(triangles)
    made.beginModel(count, 3 * count)
    made.addVertices(np.ascontiguousarray(triangles.reshape(-1, 3)))
    made.addTriangles(np.arange(3 * count, dtype=np.int64).reshape(-1, 3))
    made.endModel()
    return made


def _planes(solid: LinkSolid) -> tuple[Floats, Floats, float]:
    """Planes (P, 4) of a solid's hull, outwards, and the ball about it; none of a ball or a capsule."""
    points = solid.points if len(solid.points) > 3 else np.concatenate([_ball(p, 1e-3) for p in solid.points])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    planes = np.unique(np.round(np.asarray(ConvexHull(points).equations), 9), axis=0)
    return np.ascontiguousarray(planes), middle, float(np.linalg.norm(points - middle, axis=1).max())


def _vectors(points: Floats) -> Any:
    made = coal.StdVec_Vec3s()
    for point in points:
        made.append(np.asarray(point, dtype=np.float64))
    return made
