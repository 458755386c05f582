"""Pictures of objects and grasps, drawn once and kept as long as there is room."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import partial

import numpy as np

from graspdb.wire.queries import PictureQuery
from graspdb_density.se3 import Poses, to_matrix
from graspdb_geometry.grippers import shape_of
from graspdb_geometry.picturing import scenes
from graspdb_geometry.picturing.scenes import Held
from graspdb_service import principal
from graspdb_service.problems import conflict, invalid
from graspdb_service.storage import assets
from graspdb_service.storage.database import Database
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.geometry.mesh_form import form_of
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.runtime.compute import Compute, breathe
from graspdb_service.usecases.trials.pose_frames import frame_of
from graspdb_service.usecases.trials.selection import Selected, Selections

_MAX_BYTES = 32 * 2**20


@dataclass(frozen=True)
class AskedPicture:
    """A picture that is asked for: of which object, of which gripper, and ``tag``, all that it depends on."""

    row: ObjectRow
    selected: Selected | None
    query: PictureQuery
    tag: tuple[object, ...]


class Pictures:
    """The pictures of one service process."""

    def __init__(self, database: Database, compute: Compute, scenes: Scenes, selections: Selections) -> None:
        self._database, self._compute = database, compute
        self._scenes, self._selections = scenes, selections
        self._cache: SingleFlightCache[tuple[object, ...], bytes] = SingleFlightCache(_MAX_BYTES, len)

    def asked(self, slug: str, query: PictureQuery) -> AskedPicture:
        """What a picture is to be of.

        409 ``mesh-missing``, and for a grasp as for any question about poses ``ambiguous-selection`` and
        ``gripper-unknown``.
        """
        selected = None
        if query.position is None:
            principal.refuse_hidden(slug)
            with self._database.read() as tx:
                row = require(tx, slug)
        else:
            selected = self._selections.resolve(slug, query)
            row = selected.row
            if selected.profile is None:
                raise conflict(
                    "gripper-unknown",
                    "No trial names its gripper, so there is none to draw: name one (gripper=)",
                )
            most = selected.profile.max_opening_m
            if query.opening_m is not None and query.opening_m > most:
                told = f"is {query.opening_m:g}, and {selected.gripper} opens {most:g} m at most"
                raise invalid("opening_m", told)
        if row.mesh_sha256 is None or row.mesh_info is None:
            raise conflict(
                "mesh-missing",
                f"Object {slug!r} has no mesh to draw a picture of: PUT /objects/{slug}/mesh stores one",
            )
        # Parts tell what is inside of an open mesh, and so whether the jaw closes at all.
        depends = (
            row.mesh_sha256,
            form_of(row),
            row.parts_sha256,
            query.model_dump_json(exclude={"timeout_s"}),
        )
        digest = hashlib.sha256(repr(depends).encode()).hexdigest()[:32]
        tag = (row.id, None if selected is None else selected.stamp, digest)
        return AskedPicture(row, selected, query, tag)

    def png(self, asked: AskedPicture) -> bytes:
        """The picture as a file."""
        with self._compute.within(asked.query):
            return self._cache.get(asked.tag, lambda _: True, lambda _: self._draw(asked))

    def _draw(self, asked: AskedPicture) -> bytes:
        row, query = asked.row, asked.query
        assert row.mesh_sha256 is not None
        with self._database.read() as tx:
            found = assets.get(tx, row.mesh_sha256)
        if found is None:
            raise conflict("object-changed", "The object's geometry was replaced just now: ask again")
        held = None if asked.selected is None else self._held(asked.selected, query)

        def work() -> bytes:
            mesh = form_of(row).read(found[0])
            breathe()
            return scenes.png(
                mesh.vertices,
                mesh.faces,
                held,
                width=query.width,
                height=query.height,
                azimuth_deg=query.azimuth_deg,
                elevation_deg=query.elevation_deg,
                breathe=breathe,
            )

        return self._compute.run(work)

    def _held(self, selected: Selected, query: PictureQuery) -> Held:
        """The gripper at the pose of a question, closed on the object unless that says how far."""
        assert selected.profile is not None
        frame = frame_of(selected, query.frame, query.convention)
        pose = frame.to_tool(Poses(np.array([query.position]), np.array([query.quaternion_xyzw])))
        shape, opening = shape_of(selected.profile), query.opening_m
        if opening is None:
            test = self._scenes.test(selected)
            closed = np.nan if test is None else self._compute.run(partial(test.widths, pose))[0]
            opening = shape.max_opening_m if np.isnan(closed) else float(closed)
        matrix = np.eye(4)
        matrix[:3, :3] = to_matrix(pose.quaternions_xyzw)[0]
        matrix[:3, 3] = pose.positions[0]
        return Held(shape, matrix, opening)
