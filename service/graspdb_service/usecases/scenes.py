"""The exact collision test of the gripper against an object, prepared once per mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import GripperProfile
from graspdb_geometry import meshes
from graspdb_geometry.collision import Scene
from graspdb_geometry.grippers import GripperShape
from graspdb_service.problems import conflict
from graspdb_service.storage import assets
from graspdb_service.storage.database import Database
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.usecases.cache import SingleFlightCache
from graspdb_service.usecases.compute import Compute
from graspdb_service.usecases.selection import Selected

Floats = NDArray[np.float64]

_MAX_BYTES = 256 * 2**20
#: Hulls, planes and edges of a prepared part take about this many times its bytes as a file.
_GROWTH = 10


@dataclass(frozen=True)
class _Prepared:
    scene: Scene
    nbytes: int


@dataclass(frozen=True, eq=False)
class CollisionTest:
    """The open gripper of one profile against one object."""

    scene: Scene
    shape: GripperShape

    def free(self, positions: Floats, quaternions: Floats, threads: int = 1) -> NDArray[np.bool_]:
        """Which poses (n, 3), (n, 4) the open gripper can take without overlapping the object."""
        return ~self.scene.collides(positions, quaternions, self.shape, threads=threads)


class Scenes:
    """Prepared objects, by what they are made of: the same parts are the same scene for every object."""

    def __init__(self, database: Database, compute: Compute) -> None:
        self._database = database
        self._compute = compute
        self._cache: SingleFlightCache[str, _Prepared] = SingleFlightCache(_MAX_BYTES, lambda p: p.nbytes)

    def test(self, row: ObjectRow, selected: Selected) -> CollisionTest | None:
        """The collision test of a selection; None where geometry or gripper is not known."""
        if selected.profile is None:
            return None
        scene = self._scene(row)
        return None if scene is None else CollisionTest(scene, shape_of(selected.profile))

    def require(self, row: ObjectRow, selected: Selected) -> CollisionTest:
        """As :meth:`test`.

        Raises
        ------
        ProblemError
            409 saying what is missing and how to give it.
        """
        test = self.test(row, selected)
        if test is not None:
            return test
        reasons = []
        if row.mesh_sha256 is None and row.parts_sha256 is None:
            reasons.append(f"the object has no mesh (PUT /objects/{row.slug}/mesh)")
        elif self._scene(row) is None:
            reasons.append(
                "the object's convex parts are not known yet: a worker makes them for its first sweep,"
                f" or PUT /objects/{row.slug}/convex-parts"
            )
        if selected.profile is None:
            reasons.append("no trial names its gripper (name one: gripper=)")
        raise conflict("collision-unknown", "Collisions can't be tested: " + "; ".join(reasons))

    def _scene(self, row: ObjectRow) -> Scene | None:
        if row.parts_sha256 is not None:
            return self._prepared(row.parts_sha256, lambda content, _: meshes.parts_from_glb(content))
        info = row.mesh_info
        if row.mesh_sha256 is None or info is None or not info["convex"]:
            return None

        def own_part(content: bytes, media_type: str) -> list[meshes.Part]:
            mesh = meshes.load(content, media_type, info["unit"])
            return [(mesh.vertices, mesh.faces)]

        return self._prepared(row.mesh_sha256, own_part)

    def _prepared(self, sha256: str, parts: Callable[[bytes, str], list[meshes.Part]]) -> Scene:
        def make(_: _Prepared | None) -> _Prepared:
            with self._database.read() as tx:
                found = assets.get(tx, sha256)
            if found is None:
                raise conflict("object-changed", "The object's geometry was replaced just now: ask again")
            scene = self._compute.run(lambda: Scene(parts(*found)))
            return _Prepared(scene, _GROWTH * len(found[0]))

        return self._cache.get(sha256, lambda _: True, make).scene


def shape_of(profile: GripperProfile) -> GripperShape:
    """The boxes that the collision test needs of a gripper."""
    return GripperShape(
        max_opening_m=profile.max_opening_m,
        finger_width_m=profile.finger.width_m,
        finger_thickness_m=profile.finger.thickness_m,
        finger_length_m=profile.finger.length_m,
        tip_offset_m=profile.tip_offset_m,
        palm_size_m=profile.palm_size_m,
    )
