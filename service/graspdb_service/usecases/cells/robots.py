"""Robots: stored as they came, with the arm that was read from them; prepared once for questions."""

from __future__ import annotations

import hashlib
import importlib.util
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from graspdb.wire import RobotInfo, RobotShape, RobotUpdate
from graspdb.wire.cells.robots import ZIP, ChainJoint, RobotSolid
from graspdb_robots.arm import Arm
from graspdb_robots.drawing import triangles_of
from graspdb_service import principal
from graspdb_service.problems import ProblemError, conflict, found, invalid
from graspdb_service.storage.access import audit
from graspdb_service.storage.cells import robots
from graspdb_service.storage.cells.robots import RobotRow
from graspdb_service.storage.database import Database
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.usecases.cells.robot_child import RobotRefused, read_robot
from graspdb_service.usecases.cells.standing import pose_of
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.identifiers import is_slug
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.runtime.runtime import Runtime

if TYPE_CHECKING:
    from graspdb_robots.collision import LinkShapes
    from graspdb_robots.kinematics import Kinematics

_MICROMETRES = 6
_CACHED_BYTES = 192 * 2**20
_LIST = "GET /robots lists them, PUT /robots/{id} stores one"


def require_extra() -> None:
    """501 where the service runs without what computes an arm's motions."""
    missing = [name for name in ("pinocchio", "coal") if importlib.util.find_spec(name) is None]
    if missing:
        raise ProblemError(
            501,
            "robots-not-installed",
            "This service runs without robots' kinematics: install the extra `robot`"
            " (pip install 'graspdb[service,robot]') and start it again",
        )


def put(ctx: Runtime, id: str, content: bytes, media_type: str, flange: str | None) -> tuple[RobotInfo, bool]:
    """Store a robot in place of the one before of its id; whether it is a new one. 422 for what is none."""
    principal.refuse_limited("Robots")
    _check_id(id)
    require_extra()
    limits = ctx.settings
    if len(content) > limits.max_mesh_bytes:
        raise ProblemError(
            413,
            "body-too-large",
            f"A robot may have {limits.max_mesh_bytes:,} bytes and this one has {len(content):,}: leave its"
            " visual meshes out",
            extra={"limit": limits.max_mesh_bytes},
        )
    try:
        with ctx.mesh_children:
            name, arm = read_robot(
                content,
                media_type == ZIP,
                flange,
                max_bytes=4 * limits.max_mesh_bytes,
                memory_bytes=limits.max_mesh_memory_bytes,
                seconds=limits.max_mesh_seconds,
            )
    except RobotRefused as error:
        title = "Not a robot that can be used"
        raise ProblemError(
            422, "robot-not-usable", title, errors=[(error.field, error.message)], detail=error.message
        ) from None
    assert flange is not None
    stamp = hashlib.sha256(flange.encode() + b"\0" + media_type.encode() + b"\0" + content).hexdigest()
    info = {"name": name, "flange": flange, **_told(arm)}
    with ctx.database.write() as tx:
        new = robots.find(tx, id) is None
        robots.put(
            tx, id, info=info, sha256=stamp, media_type=media_type, content=content, arm=arm.to_bytes()
        )
        audit.record(tx, "robot.put", subject=id)
        row = robots.find(tx, id)
    assert row is not None
    return _info(row), new


def get(database: Database, id: str) -> RobotInfo:
    """One robot."""
    with database.read() as tx:
        return _info(found(robots.find(tx, id) if is_slug(id) else None, "robot", id, _LIST))


def content(database: Database, id: str) -> tuple[bytes, str]:
    """What was sent, and its media type."""
    with database.read() as tx:
        return found(robots.content(tx, id) if is_slug(id) else None, "robot", id, _LIST)


def shape(database: Database, id: str) -> RobotShape:
    """The arm's chain, and its solids as triangles."""
    with database.read() as tx:
        row = found(robots.find(tx, id) if is_slug(id) else None, "robot", id, _LIST)
        stored = robots.arm(tx, id, row.sha256)
    if stored is None:
        raise conflict("robot-changed", f"Robot {id!r} was replaced just now: ask again")
    arm = Arm.from_bytes(stored)
    joints = [
        ChainJoint(name=name, placement=pose_of(place), axis=tuple(axis), sliding=slides)
        for name, place, axis, slides in zip(
            arm.joints, arm.placements, arm.axes.tolist(), arm.sliding.tolist(), strict=True
        )
    ]
    solids = []
    for solid in arm.solids:
        vertices, faces = triangles_of(solid)
        listed = vertices.round(_MICROMETRES).tolist()
        solids.append(RobotSolid(link=solid.link, joint=solid.joint, vertices=listed, faces=faces.tolist()))
    return RobotShape(joints=joints, flange=pose_of(arm.flange), solids=solids)


def page(database: Database, *, after: str, limit: int) -> tuple[list[RobotInfo], str | None]:
    """A page of robots by id, and where the next one starts."""
    with database.read() as tx:
        rows = robots.page(tx, after=after, limit=limit + 1)
    return [_info(row) for row in rows[:limit]], rows[limit - 1].id if len(rows) > limit else None


def change(database: Database, id: str, request: RobotUpdate) -> RobotInfo:
    """Change where the gripper is mounted, or the name; what is not given stays."""
    principal.refuse_limited("Robots")
    with database.write() as tx:
        row = found(robots.find(tx, id) if is_slug(id) else None, "robot", id, _LIST)
        values: dict[str, Any] = {}
        if "gripper_mount" in request.model_fields_set:
            mount = request.gripper_mount
            values["gripper_mount"] = None if mount is None else mount.model_dump(mode="json")
        if request.name is not None:
            values["info"] = {**row.info, "name": request.name}
        if values:
            robots.change(tx, id, values)
            audit.record(tx, "robot.change", subject=id)
        return _info(found(robots.find(tx, id), "robot", id, _LIST))


def remove(database: Database, id: str) -> None:
    """Delete a robot; questions that name it are answered 404 from then on."""
    principal.refuse_limited("Robots")
    with database.write() as tx:
        if not (is_slug(id) and robots.remove(tx, id)):
            found(None, "robot", id, _LIST)
        audit.record(tx, "robot.delete", subject=id)


def _check_id(id: str) -> None:
    if not is_slug(id):
        raise invalid("id", "letters, digits, '.', '_' and '-', at most 64, the first a letter or digit")


def _told(arm: Arm) -> dict[str, Any]:
    def limit(value: float) -> float | None:
        return value if np.isfinite(value) else None

    rows = zip(arm.joints, arm.lower.tolist(), arm.upper.tolist(), arm.sliding.tolist(), strict=True)
    return {
        "joints": [
            {"name": name, "lower": limit(low), "upper": limit(high), "sliding": slides}
            for name, low, high, slides in rows
        ],
        "links": list(arm.links),
        "tested": list(dict.fromkeys(solid.link for solid in arm.solids)),
        "untested": list(arm.untested),
    }


def _info(row: RobotRow) -> RobotInfo:
    return RobotInfo.model_validate({**vars(row), **row.info})


@dataclass(frozen=True, eq=False)
class PreparedRobot:
    """A stored robot, its arm ready for questions."""

    info: RobotInfo
    kinematics: Kinematics
    shapes: LinkShapes

    @property
    def nbytes(self) -> int:
        return 3 * self.kinematics.nbytes


class Robots:
    """Robots prepared for questions, once for each content."""

    def __init__(self, database: Database, compute: Compute) -> None:
        self._database = database
        self._compute = compute
        self._cache: SingleFlightCache[str, PreparedRobot] = SingleFlightCache(
            _CACHED_BYTES, lambda made: made.nbytes
        )
        self._meshes: SingleFlightCache[tuple[str, str, str], tuple[Any, int]] = SingleFlightCache(
            _CACHED_BYTES, lambda made: 4 * made[1]
        )

    def mesh_shape(self, row: ObjectRow, scenes: Scenes) -> Any:
        """The shape of an object's mesh, or else its parts, as an obstacle of links; None without either."""
        geometry = scenes.closing(row)
        if geometry is None:
            return None
        from graspdb_robots.collision import mesh_shape  # extra: robot

        key = str(row.mesh_sha256 if row.mesh_sha256 is not None else row.parts_sha256)
        form = str((row.mesh_info or {}).get("unit")), str((row.mesh_info or {}).get("scale"))
        return self._meshes.get(
            (key, *form),
            lambda _: True,
            lambda _: self._compute.run(lambda: (mesh_shape(geometry.corners), geometry.nbytes)),
        )[0]

    def prepared(self, id: str) -> PreparedRobot:
        """A robot by its id, 404 where there is none, 501 without the extra."""
        require_extra()
        with self._database.read() as tx:
            row = found(robots.find(tx, id) if is_slug(id) else None, "robot", id, _LIST)

        def make(_: PreparedRobot | None) -> PreparedRobot:
            # Heavy, and only of a service that has robots.
            from graspdb_robots.collision import LinkShapes  # extra: robot
            from graspdb_robots.kinematics import Kinematics  # extra: robot

            with self._database.read() as tx:
                content = robots.arm(tx, id, row.sha256)
            if content is None:
                raise conflict("robot-changed", f"Robot {id!r} was replaced just now: ask again")
            arm = Arm.from_bytes(content)
            return self._compute.run(lambda: PreparedRobot(_info(row), Kinematics(arm), LinkShapes(arm)))

        made = self._cache.get(row.sha256, lambda _: True, make)
        return PreparedRobot(_info(row), made.kinematics, made.shapes)
