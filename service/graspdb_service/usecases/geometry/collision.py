"""The exact collision test of a gripper against an object, prepared once per geometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import GripperProfile
from graspdb_density.se3 import Poses
from graspdb_geometry import meshes
from graspdb_geometry.collision import Scene, Surface
from graspdb_geometry.grippers import GripperShape
from graspdb_geometry.plausibility import Target
from graspdb_service.problems import conflict
from graspdb_service.storage import assets
from graspdb_service.storage.database import Database
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.usecases.geometry.features import Features
from graspdb_service.usecases.geometry.mesh_form import MeshForm, form_of
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.trials.selection import Selected

Floats = NDArray[np.float64]

Solid = Scene | Surface
"""An object's convex parts once they exist, and its mesh's own triangles before."""

_MAX_BYTES = 256 * 2**20
#: Hulls, planes, edges and trees take about this many times the bytes of the file.
_GROWTH = 10
#: What reaches less far between the fingers is grazed: no gripper is placed more exactly.
_GRAZED_M = 1e-3


@dataclass(frozen=True)
class _Prepared:
    solid: Solid
    nbytes: int


@dataclass(frozen=True, eq=False)
class CollisionTest:
    """The open gripper of one profile against one object."""

    solid: Solid
    shape: GripperShape

    def free(self, poses: Poses, threads: int = 1) -> NDArray[np.bool_]:
        """Which poses (n,) the open gripper can take without overlapping the object."""
        return ~self.solid.collides(poses, self.shape, threads=threads)

    def free_on_the_way(self, poses: Poses, distance_m: float, threads: int = 1) -> NDArray[np.bool_]:
        """As :meth:`free`, all along the straight approach that starts this far back."""
        return ~self.solid.collides(poses, self.shape, threads=threads, retreat_m=distance_m)

    def holds(self, poses: Poses, threads: int = 1) -> NDArray[np.bool_]:
        """Which poses the open gripper can take with something between its fingers."""
        return self.solid.holds(poses, self.shape, threads=threads)

    def widths(self, poses: Poses, threads: int = 1) -> Floats:
        """The jaw's opening (n,) once both fingers touch the object; NaN where it collides or misses, or only
        grazes the object with the rim of its pads.
        """
        widths = np.array(self.solid.widths(poses, self.shape, threads=threads))
        widths[~self.solid.holds(poses, self.shape.slimmer(_GRAZED_M), threads=threads)] = np.nan
        return widths


class Scenes:
    """Prepared geometry, by content: the same parts are prepared once, whichever object they belong to."""

    def __init__(self, database: Database, compute: Compute, features: Features) -> None:
        self._database = database
        self._compute = compute
        self.features = features
        self._cache: SingleFlightCache[tuple[str, MeshForm | str], _Prepared] = SingleFlightCache(
            _MAX_BYTES, lambda p: p.nbytes
        )

    def test(self, selected: Selected) -> CollisionTest | None:
        """The collision test of a selection; None where geometry or gripper is not known."""
        if selected.profile is None:
            return None
        solid = self._solid(selected.row)
        return None if solid is None else CollisionTest(solid, shape_of(selected.profile))

    def require(self, selected: Selected) -> CollisionTest:
        """As :meth:`test`, or 409 saying what is missing and how to give it."""
        test, row = self.test(selected), selected.row
        if test is not None:
            return test
        reasons = []
        if row.mesh_sha256 is None and row.parts_sha256 is None:
            reasons.append(f"the object has no mesh (PUT /objects/{row.slug}/mesh)")
        if selected.profile is None:
            reasons.append("no trial names its gripper (name one: gripper=)")
        raise conflict("collision-unknown", "Collisions can't be tested: " + "; ".join(reasons))

    def target(self, row: ObjectRow, profile: GripperProfile | None) -> Target | None:
        """The object for posted trials to be looked at against; None without mesh and parts. Its geometry is
        prepared where there is a gripper to test against it.
        """
        info = row.mesh_info or row.parts_info
        if info is None:
            return None
        box = info["bounding_box"]
        lower, upper = np.array(box["lower"], dtype=np.float64), np.array(box["upper"], dtype=np.float64)
        if profile is None:
            return Target(lower, upper)
        return Target(lower, upper, self._solid(row), shape_of(profile))

    def _solid(self, row: ObjectRow) -> Solid | None:
        if row.parts_sha256 is not None:
            return self._prepared(
                row.parts_sha256, "parts", lambda content, _: Scene(meshes.parts_from_glb(content))
            )
        info = row.mesh_info
        if row.mesh_sha256 is None or info is None:
            return None
        form = form_of(row)

        def own(content: bytes, _: str) -> Solid:
            mesh = form.read(content)
            if info["convex"]:
                return Scene([(mesh.vertices, mesh.faces)])
            return Surface(mesh.vertices, mesh.faces, watertight=info["watertight"])

        return self._prepared(row.mesh_sha256, form, own)

    def _prepared(
        self, sha256: str, reading: MeshForm | str, prepare: Callable[[bytes, str], Solid]
    ) -> Solid:
        def make(_: _Prepared | None) -> _Prepared:
            with self._database.read() as tx:
                found = assets.get(tx, sha256)
            if found is None:
                raise conflict("object-changed", "The object's geometry was replaced just now: ask again")
            return _Prepared(self._compute.run(lambda: prepare(*found)), _GROWTH * len(found[0]))

        return self._cache.get((sha256, reading), lambda _: True, make).solid


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
