"""The exact collision test of a gripper against an object, prepared once per geometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import GripperProfile
from graspdb.wire.queries import PreOpening
from graspdb_density.se3 import Poses
from graspdb_geometry import meshes, openings
from graspdb_geometry.closing import ClosingGeometry
from graspdb_geometry.collision import Scene, Surface
from graspdb_geometry.deviation import deviation
from graspdb_geometry.grippers import GripperShape, shape_of
from graspdb_geometry.mass import mass_properties, surface_centre
from graspdb_geometry.openings import Values
from graspdb_geometry.plausibility import Target
from graspdb_geometry.poses import PoseArrays
from graspdb_service.problems import ProblemError, conflict, invalid
from graspdb_service.storage import assets
from graspdb_service.storage.database import Database
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.usecases.geometry.features import Features
from graspdb_service.usecases.geometry.mesh_form import MeshForm, form_of
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.runtime.compute import Compute, breathe, by_steps
from graspdb_service.usecases.trials.selection import Selected

Floats = NDArray[np.float64]

#: Hash of a mesh or of parts, how it is read, hash of parts beside it.
_Content = tuple[str, MeshForm | str, str | None]
Solid = Scene | Surface
"""An object's mesh, exactly; its convex parts, from which they may differ, where it has no mesh."""

_SOLIDS_BYTES, _CLOSINGS_BYTES = 192 * 2**20, 64 * 2**20
#: How much wider than it needs the jaw is with ``auto``: half of that beside either finger.
CLEARANCE_M = 0.01
#: What reaches less far between the fingers is grazed: no gripper is placed more exactly.
_GRAZED_M = 1e-3
#: Poses tested between two breaths, with one jaw for all, or a jaw of each pose's own: that takes some ten
#: times as long.
_OF_ONE_JAW, _OF_OWN_JAWS = 16_384, 2_048


@dataclass(frozen=True, eq=False)
class CollisionTest:
    """The gripper of one profile against one object, wide open or as far as ``pre_opening_m`` says.

    ``pre_opening_m`` is an opening in metres, ``auto`` for each pose's own, or None for wide open.
    """

    solid: Solid
    shape: GripperShape
    pre_opening_m: PreOpening = None

    def preshaped(self, pre_opening_m: PreOpening) -> CollisionTest:
        """The same with the jaw as far open as that."""
        return self if pre_opening_m is None else replace(self, pre_opening_m=pre_opening_m)

    def openings(self, poses: Poses, threads: int = 1) -> Floats:
        """How far open the jaw is at each pose (n,), metres: the opening to command.

        With ``auto`` that is what :func:`graspdb_geometry.openings.needed` says and :data:`CLEARANCE_M`; wide
        open where nothing is needed.
        """
        if self.pre_opening_m == "auto":

            def own(some: Poses) -> Floats:
                needed = openings.needed(self.solid, some, self.shape, threads)
                return openings.commanded(needed, CLEARANCE_M, self.shape)

            return by_steps(own, poses, _OF_OWN_JAWS)
        opening = self.shape.max_opening_m if self.pre_opening_m is None else self.pre_opening_m
        return np.full(len(poses), opening)

    def free(self, poses: Poses, threads: int = 1) -> NDArray[np.bool_]:
        """Which poses (n,) the open gripper can take without overlapping the object."""
        return self.free_on_the_way(poses, 0.0, threads)

    def free_on_the_way(self, poses: Poses, distance_m: float, threads: int = 1) -> NDArray[np.bool_]:
        """As :meth:`free`, all along the straight approach that starts this far back."""

        def tested(shape: GripperShape, some: PoseArrays) -> NDArray[np.bool_]:
            return ~self.solid.collides(some, shape, threads=threads, retreat_m=distance_m)

        return self.with_jaw(poses, tested, threads)

    def holds(self, poses: Poses, threads: int = 1) -> NDArray[np.bool_]:
        """Which poses the open gripper can take with something between its fingers."""
        return self.with_jaw(
            poses, lambda shape, some: openings.holds(self.solid, some, shape, threads), threads
        )

    def widths(self, poses: Poses, threads: int = 1) -> Floats:
        """The jaw's opening (n,) once both fingers touch the object; NaN where it collides or misses, or only
        grazes the object with the rim of its pads.
        """

        def tested(shape: GripperShape, some: PoseArrays) -> Floats:
            widths = np.array(openings.widths(self.solid, some, shape, threads))
            widths[~openings.holds(self.solid, some, shape.slimmer(_GRAZED_M), threads)] = np.nan
            return widths

        return self.with_jaw(poses, tested, threads)

    def with_jaw(
        self,
        poses: Poses,
        tested: Callable[[GripperShape, PoseArrays], Values],
        threads: int = 1,
    ) -> Values:
        """What a test of some poses tells of each (n,), with the jaw as far open as it is there.

        It breathes between steps, as :meth:`openings` does: a computation ends there once nobody waits.
        """
        if self.pre_opening_m == "auto":

            def at_own(some: Poses) -> Values:
                return openings.at_each(self.openings(some, threads), some, self.shape, tested)

            return by_steps(at_own, poses, _OF_OWN_JAWS)
        shape = self.shape if self.pre_opening_m is None else self.shape.at(self.pre_opening_m)
        return by_steps(partial(tested, shape), poses, _OF_ONE_JAW)


class _Sized(Protocol):
    @property
    def nbytes(self) -> int: ...


S = TypeVar("S", bound=_Sized)


class _Prepared(Generic[S]):
    """What is made of stored geometry, once for each content, form and content beside it."""

    def __init__(self, database: Database, compute: Compute, max_bytes: int) -> None:
        self._database = database
        self._compute = compute
        self._cache: SingleFlightCache[_Content, S] = SingleFlightCache(max_bytes, lambda made: made.nbytes)

    def made(self, key: _Content, prepare: Callable[[list[bytes]], S]) -> S:
        """What is made of the contents that a key names."""

        def make(_: S | None) -> S:
            with self._database.read() as tx:
                found = [assets.get(tx, sha256) for sha256 in (key[0], key[2]) if sha256 is not None]
            contents = [content for content, _ in filter(None, found)]
            if len(contents) < len(found):
                raise conflict("object-changed", "The object's geometry was replaced just now: ask again")
            return self._compute.run(lambda: prepare(contents))

        return self._cache.get(key, lambda _: True, make)


class Scenes:
    """Prepared geometry, by content: the same mesh is prepared once, whichever object it belongs to.

    Questions are tested against the mesh itself: convex parts swell it where it is not convex, and would call
    collisions what a robot can do. Parts tell only what an open mesh does not, what lies inside of it.
    """

    def __init__(self, database: Database, compute: Compute, features: Features) -> None:
        self.features = features
        self._solids: _Prepared[Solid] = _Prepared(database, compute, _SOLIDS_BYTES)
        self._closings: _Prepared[ClosingGeometry] = _Prepared(database, compute, _CLOSINGS_BYTES)

    def test(self, selected: Selected, pre_opening_m: PreOpening = None) -> CollisionTest | None:
        """The collision test of a selection; None where geometry or gripper is not known.

        With a pre-opening 422 where the jaw opens less, 409 ``gripper-unknown``, and as :meth:`require` where
        it depends on geometry.
        """
        if pre_opening_m is not None:
            _check_pre_opening(selected, pre_opening_m)
        if selected.profile is None:
            return None
        solid = self._solid(selected.row)
        if solid is None:
            if pre_opening_m == "auto":
                raise _unknown(selected)
            return None
        return CollisionTest(solid, shape_of(selected.profile), pre_opening_m)

    def require(self, selected: Selected, pre_opening_m: PreOpening = None) -> CollisionTest:
        """As :meth:`test`, or 409 saying what is missing and how to give it."""
        test = self.test(selected, pre_opening_m)
        if test is None:
            raise _unknown(selected)
        return test

    def solid(self, row: ObjectRow) -> Solid | None:
        """An object's geometry for collision tests; None without mesh and parts."""
        return self._solid(row)

    def closing(self, row: ObjectRow) -> ClosingGeometry | None:
        """What a jaw closes on, of the mesh or else the convex parts; None without either."""
        parts, info = row.parts_sha256, row.mesh_info
        if row.mesh_sha256 is not None and info is not None:
            form, measured = form_of(row), info.get("centre_of_mass")

            def of_mesh(found: list[bytes]) -> ClosingGeometry:
                mesh = form.read(found[0])
                corners = mesh.vertices[mesh.faces]
                # An open mesh encloses no mass: the middle of its surface is nearest to it.
                return ClosingGeometry(corners, surface_centre(corners) if measured is None else measured)

            return self._closings.made((row.mesh_sha256, form, None), of_mesh)
        if parts is None:
            return None

        def of_parts(found: list[bytes]) -> ClosingGeometry:
            corners = np.concatenate([v[f] for v, f in meshes.parts_from_glb(found[0])])
            return ClosingGeometry(corners, mass_properties(corners).centre)

        return self._closings.made((parts, "parts", None), of_parts)

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
        parts, info = row.parts_sha256, row.mesh_info
        if row.mesh_sha256 is None or info is None:
            if parts is None:
                return None
            return self._solids.made(
                (parts, "parts", None), lambda found: Scene(meshes.parts_from_glb(found[0]))
            )
        form, closed = form_of(row), bool(info["watertight"])
        inside = None if closed else parts
        off_m = (row.parts_info or {}).get("deviation_m")

        def prepare(found: list[bytes]) -> Solid:
            mesh = form.read(found[0])
            breathe()
            if info["convex"]:
                return Scene([(mesh.vertices, mesh.faces)])
            if inside is None:
                return Surface(mesh.vertices, mesh.faces, watertight=closed)
            known = meshes.parts_from_glb(found[1])
            off = deviation(mesh, known).largest_m if off_m is None else float(off_m)
            return Surface(mesh.vertices, mesh.faces, watertight=False, inside=Scene(known), inside_off_m=off)

        return self._solids.made((row.mesh_sha256, form, inside), prepare)


def _check_pre_opening(selected: Selected, pre_opening_m: PreOpening) -> None:
    profile = selected.profile
    if profile is None:
        raise conflict("gripper-unknown", "A pre-opening is of a jaw: name the gripper (gripper=)")
    if isinstance(pre_opening_m, float) and pre_opening_m > profile.max_opening_m:
        told = f"is {pre_opening_m:g}, and {selected.gripper} opens {profile.max_opening_m:g} m at most"
        raise invalid("pre_opening_m", told)


def _unknown(selected: Selected) -> ProblemError:
    """409 saying what is missing for a collision test, and how to give it."""
    row, reasons = selected.row, []
    if row.mesh_sha256 is None and row.parts_sha256 is None:
        reasons.append(f"the object has no mesh (PUT /objects/{row.slug}/mesh)")
    if selected.profile is None:
        reasons.append("no trial names its gripper (name one: gripper=)")
    return conflict("collision-unknown", "Collisions can't be tested: " + "; ".join(reasons))
