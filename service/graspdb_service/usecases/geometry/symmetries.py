"""The symmetries of objects, found in their meshes."""

from __future__ import annotations

from graspdb_geometry.symmetry import Symmetry, find_symmetry
from graspdb_service.problems import conflict
from graspdb_service.storage import assets
from graspdb_service.storage.database import Database
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.usecases.geometry.mesh_form import MeshForm, form_of
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.runtime.compute import Compute

#: A symmetry takes about so many bytes, and so many of them are kept.
_BYTES, _KEPT = 16_384, 1_024


class ShapeSymmetries:
    """The symmetries of one service process, by the content of the mesh."""

    def __init__(self, database: Database, compute: Compute) -> None:
        self._database = database
        self._compute = compute
        self._cache: SingleFlightCache[tuple[str, MeshForm], Symmetry] = SingleFlightCache(
            _BYTES * _KEPT, lambda _: _BYTES
        )

    def of(self, row: ObjectRow) -> Symmetry:
        """Those of an object's mesh, closed or not; 409 ``mesh-missing`` without one."""
        if row.mesh_sha256 is None or row.mesh_info is None:
            raise conflict(
                "mesh-missing",
                f"Object {row.slug!r} has no mesh, so its symmetries are not known:"
                f" PUT /objects/{row.slug}/mesh, or leave symmetry out",
            )
        sha256, form = row.mesh_sha256, form_of(row)

        def make(_: Symmetry | None) -> Symmetry:
            with self._database.read() as tx:
                found = assets.get(tx, sha256)
            if found is None:
                raise conflict("object-changed", "The object's geometry was replaced just now: ask again")

            def look() -> Symmetry:
                mesh = form.read(found[0])
                return find_symmetry(mesh.vertices[mesh.faces])

            return self._compute.run(look)

        return self._cache.get((sha256, form), lambda _: True, make)
