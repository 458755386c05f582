"""What an object's geometry offers a gripper: ridges, pairs of surfaces and edges, and opposed points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb_geometry import meshes
from graspdb_geometry.collision import Surface
from graspdb_geometry.features.antipodal import opposed_points
from graspdb_geometry.features.jaw_pairs import JawPairs, pairs_of_mesh, pairs_of_parts
from graspdb_geometry.features.ridges import Ridges, parts_solid, ridges_of_mesh, ridges_of_parts
from graspdb_geometry.poses import ToolPoses
from graspdb_service.problems import ProblemError, conflict
from graspdb_service.storage import assets
from graspdb_service.storage.database import Database
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.usecases.geometry.mesh_form import MeshForm, form_of
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.runtime.compute import Compute, breathe
from graspdb_service.usecases.trials.selection import Selected

Floats = NDArray[np.float64]
#: Axes (n, 3, 3) of grasps at positions (n, 3) and rotations (n, 4); NaN where a grasp has the gripper's own.
FramesOf = Callable[[Floats, Floats], Floats]
#: Axes that translations are along: one set (3, 3) for all grasps, each grasp's own, or None: its gripper's.
Axes = Floats | FramesOf | None

_MAX_BYTES = 32 * 2**20
#: Hash of the geometry, how it is read, the jaw's opening (0: ridges only), whether with opposed points.
_Key = tuple[str, MeshForm | str, float, bool]


@dataclass(frozen=True, eq=False)
class _Prepared:
    ridges: Ridges
    pairs: JawPairs | None = None
    points: JawPairs | None = None

    @property
    def nbytes(self) -> int:
        return 4_096 + sum(p.nbytes for p in (self.ridges, self.pairs, self.points) if p is not None)


class Features:
    """The features of objects, by the content of their geometry: a closed mesh before its convex parts, those
    before a mesh that is open.
    """

    def __init__(self, database: Database, compute: Compute) -> None:
        self._database = database
        self._compute = compute
        self._cache: SingleFlightCache[_Key, _Prepared] = SingleFlightCache(_MAX_BYTES, lambda p: p.nbytes)

    def ridges(self, row: ObjectRow) -> Ridges:
        """An object's ridges; 409 ``mesh-missing`` without geometry, ``no-edges`` where nothing bends."""
        found = self._prepared(row, 0.0).ridges
        if not len(found):
            raise conflict(
                "no-edges",
                f"Nothing on object {row.slug!r} bends by more than 30 degrees, so it has no edges to align"
                " with: use alignment=gripper",
            )
        return found

    def pairs(self, selected: Selected) -> JawPairs:
        """The pairs of surfaces and edges that the selection's gripper can close on.

        409 ``mesh-missing`` without geometry, ``gripper-unknown`` where no opening is known,
        ``no-surface-pairs``.
        """
        opening = _opening(selected)
        found = self._prepared(selected.row, opening).pairs
        if found is None or not len(found):
            raise conflict(
                "no-surface-pairs",
                f"Object {selected.row.slug!r} has no two opposed surfaces or edges within"
                f" {1e3 * opening:.0f} mm, as far as the jaw opens: name a wider gripper, or go without"
                " (alignment=gripper or edge)",
            )
        return found

    def opposed(self, selected: Selected) -> list[JawPairs]:
        """What the selection's gripper can close on: pairs of surfaces and edges, and opposed points of the
        surface, which tell of curved objects, too; none that is empty. 409 as :meth:`pairs`.
        """
        found = self._prepared(selected.row, _opening(selected), points=True)
        return [pairs for pairs in (found.pairs, found.points) if pairs is not None and len(pairs)]

    def known_pairs(self, selected: Selected) -> JawPairs | None:
        """As :meth:`pairs`, None where there are none or they can't be known."""
        try:
            return self.pairs(selected)
        except ProblemError:
            return None

    def frames(self, alignment: str, selected: Selected) -> FramesOf:
        """The axes of grasps by ``edge`` or ``surface-pair``; 409 as :meth:`ridges` and :meth:`pairs`."""
        if alignment == "edge":
            ridges = self.ridges(selected.row)
            return lambda positions, _: ridges.frames(positions)
        pairs = self.pairs(selected)
        return lambda positions, quaternions: pairs.frames(ToolPoses(positions, quaternions))

    def _prepared(self, row: ObjectRow, opening_m: float, *, points: bool = False) -> _Prepared:
        """Ridges, for an opening the pairs, and, if asked for, opposed points."""
        info = row.mesh_info
        closed = info is not None and bool(info["watertight"])
        if info is not None and row.mesh_sha256 is not None and (closed or row.parts_sha256 is None):
            form, sha256 = form_of(row), row.mesh_sha256

            def read(content: bytes, _: str) -> _Prepared:
                mesh = form.read(content)
                ridges = ridges_of_mesh(mesh.vertices, mesh.faces)
                if not opening_m:
                    return _Prepared(ridges)
                breathe()
                pairs = pairs_of_mesh(
                    mesh.vertices, mesh.faces, ridges, watertight=closed, opening_m=opening_m
                )
                if not points:
                    return _Prepared(ridges, pairs)
                breathe()
                solid = Surface(mesh.vertices, mesh.faces, watertight=True).contains if closed else None
                corners = mesh.vertices[mesh.faces]
                return _Prepared(ridges, pairs, opposed_points(corners, solid, opening_m=opening_m))

            return self._read((sha256, form, opening_m, points), read)
        if row.parts_sha256 is None:
            raise conflict(
                "mesh-missing",
                f"Object {row.slug!r} has no mesh, so its edges and surfaces are not known:"
                f" PUT /objects/{row.slug}/mesh, or go without them (alignment=gripper)",
            )

        def read_parts(content: bytes, _: str) -> _Prepared:
            parts = meshes.parts_from_glb(content)
            ridges = ridges_of_parts(parts)
            if not opening_m:
                return _Prepared(ridges)
            breathe()
            pairs = pairs_of_parts(parts, ridges, opening_m=opening_m)
            if not points:
                return _Prepared(ridges, pairs)
            breathe()
            corners = np.concatenate([v[f] for v, f in parts])
            solid = parts_solid([v for v, _ in parts])
            return _Prepared(ridges, pairs, opposed_points(corners, solid, opening_m=opening_m))

        return self._read((row.parts_sha256, "parts", opening_m, points), read_parts)

    def _read(self, key: _Key, read: Callable[[bytes, str], _Prepared]) -> _Prepared:
        def make(_: _Prepared | None) -> _Prepared:
            with self._database.read() as tx:
                found = assets.get(tx, key[0])
            if found is None:
                raise conflict("object-changed", "The object's geometry was replaced just now: ask again")
            return self._compute.run(lambda: read(*found))

        return self._cache.get(key, lambda _: True, make)


def _opening(selected: Selected) -> float:
    """How wide the jaw opens, metres; 409 ``gripper-unknown``."""
    if selected.profile is None:
        raise conflict(
            "gripper-unknown",
            "How wide the jaw opens is not known, for no trial names its gripper: name one (gripper)",
        )
    return selected.profile.max_opening_m
