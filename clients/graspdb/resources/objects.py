"""Objects: their properties, mesh and convex parts, and the sweeps that try to grasp them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Unpack

from graspdb import wire
from graspdb.errors import GraspDBError
from graspdb.files.meshes import GLB, MeshLike, read_mesh, scene_of
from graspdb.options import Option, known_keywords
from graspdb.poses import pose_documents
from graspdb.reports import Reports
from graspdb.resources.answers import Answers
from graspdb.resources.grasp_queries import GraspQueries
from graspdb.resources.pages import Listing, Resource, segment, validate
from graspdb.resources.pictures.asking import picture, with_picture
from graspdb.resources.results import table_html
from graspdb.resources.sweeps import Sweep, SweepOptions, Sweeps, create_sweep
from graspdb.resources.trials import Batches, Trials
from graspdb.transport import Model, Transport


class ObjectProperties(TypedDict, total=False):
    """``name``, ``mass_kg``, ``density_kg_m3``, ``friction`` and ``metadata`` of an object.

    ``frames``: poses in the frame of its mesh by name, each (4, 4) or ``x y z qx qy qz qw``.
    """

    name: Annotated[str | None, Option("A name for people.")]
    mass_kg: Annotated[float | None, Option("Mass in kg.")]
    density_kg_m3: Annotated[float | None, Option("Mass density, where the mass is not known.")]
    friction: Annotated[float | None, Option("Coefficient of friction.")]
    metadata: Mapping[str, Any] | None
    frames: Mapping[str, ArrayLike | Any] | None


class GraspObject(GraspQueries):
    """An object on the service; ``info`` is what the service said last, :meth:`refresh` asks again.

    ``trials`` and ``batches`` hold what has been tried, the questions ask what follows from it, and
    ``reports`` whether that was enough; both take the trials and kernel of a density (:class:`Selection`).
    """

    def __init__(self, transport: Transport, info: wire.ObjectInfo) -> None:
        super().__init__(transport, info)
        self.trials = Trials(transport, f"{self._path}/trials")
        self.batches = Batches(transport, f"{self._path}/batches")
        self.reports = Reports(transport, self._path)

    def refresh(self) -> GraspObject:
        """Ask the service for its present state."""
        return self._update(self._transport.json("GET", self._path))

    def patch(self, /, **changes: Unpack[ObjectProperties]) -> GraspObject:
        """Change ``name``, ``mass_kg``, ``density_kg_m3``, ``friction``, ``metadata`` or ``frames``, all
        frames at once; None clears.
        """
        fields = _plain(known_keywords(ObjectProperties, changes, "patch"))
        validate(wire.ObjectPatch, fields)
        # Nulls are meant in a patch.
        return self._update(self._transport.json("PATCH", self._path, body=fields))

    def copy(self, id: str, *, trials: bool = False) -> GraspObject:
        """Copy the object with mesh and convex parts, and with all its ``trials`` if asked.

        The copy takes one other mesh (:meth:`upload_mesh`) though it has trials. These, and what sweeps
        found, are of the mesh before then, as answers warn.
        """
        request = validate(wire.CopyRequest, {"id": id, "trials": trials})
        path = f"{self._path}/copies"
        info = self._transport.model(wire.ObjectInfo, "POST", path, body=request, idempotent=True)
        return GraspObject(self._transport, info)

    def delete(self) -> None:
        """Delete the object with everything that belongs to it."""
        self._transport.request("DELETE", self._path)

    def _update(self, answer: Any) -> GraspObject:
        self.info = wire.ObjectInfo.model_validate(answer)
        return self

    # Mesh and convex parts

    def upload_mesh(
        self, mesh: MeshLike, *, unit: str = "m", scale: float = 1.0, media_type: str | None = None
    ) -> wire.MeshInfo:
        """Store the object's mesh: a file (.stl, .obj, .ply, .glb), its bytes, or a trimesh object.

        Its coordinates are in ``unit``: ``m``, ``mm``, ``cm`` or ``in``; ``scale`` multiplies them beside
        that, as data sets have it that scale one mesh to several objects. ``media_type`` is needed for bytes
        whose format they do not tell themselves.
        """
        content, kind = read_mesh(mesh, media_type)
        return self._upload(wire.MeshInfo, "mesh", content, kind, params={"unit": unit, "scale": scale})

    def download_mesh(self) -> bytes:
        """The mesh as it was uploaded, in the unit and scale that ``info.mesh`` tells."""
        return self._transport.request("GET", f"{self._path}/mesh").content

    def mesh_triangles(self) -> NDArray[np.float64]:
        """The mesh as the service understood it, mended: corners (F, 3, 3) of its triangles, object frame, m.

        Needs no mesh library; NotFound without a mesh.
        """
        content = self._transport.request("GET", f"{self._path}/mesh", params={"triangles": True}).content
        record = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
        return np.frombuffer(content, dtype=record, offset=84)["corners"].astype(np.float64)

    def upload_convex_parts(
        self, parts: MeshLike | Sequence[Any], *, accept_deviation: bool = False
    ) -> wire.PartsInfo:
        """Store the convex parts the object is made of, in metres.

        A GLB file or its bytes with one geometry a part, a trimesh scene, or a sequence of meshes. Those that
        do not follow a closed mesh are refused, unless ``accept_deviation``.
        """
        if isinstance(parts, Sequence) and not isinstance(parts, (str, bytes)):
            parts = scene_of(parts)
        content, kind = read_mesh(parts, None, prefer="glb")
        if kind != GLB:
            raise ValueError(f"convex parts come as GLB, one geometry a part; this is {kind}")
        # Not told to a service that does not know it unless it is asked for.
        params = {"accept_deviation": accept_deviation or None}
        return self._upload(wire.PartsInfo, "convex-parts", content, GLB, params=params)

    def _upload(self, model: type[Model], what: str, content: bytes, kind: str, **options: Any) -> Model:
        headers = {"Content-Type": kind}
        path = f"{self._path}/{what}"
        info = self._transport.model(model, "PUT", path, content=content, headers=headers, **options)
        self.refresh()
        return info

    def download_convex_parts(self) -> bytes:
        """The convex parts as GLB."""
        return self._transport.request("GET", f"{self._path}/convex-parts").content

    def sweep(self, **options: Unpack[SweepOptions]) -> Sweep:
        """Have workers simulate grasps: over a grid, given poses, or draws, as :class:`SweepOptions` say."""
        known_keywords(SweepOptions, options, "sweep")
        return create_sweep(self._transport, self._path, options)

    def sweeps(self) -> Iterator[Sweep]:
        """The sweeps of this object."""
        return Sweeps(self._transport, "/sweeps").list(object=self.id)

    def answers(self, *, name: str | None = None, kind: str | None = None) -> Listing[wire.AnswerInfo]:
        """The answers about this object that are kept, the newest first: see :meth:`Answers.list`."""
        return Answers(self._transport, "/answers").list(self.id, name=name, kind=kind)

    def summary(self) -> dict[str, str]:
        """What a person wants to know of it, in words."""
        info = self.info
        rows = {"object": info.id}
        if info.name:
            rows["name"] = info.name
        for label, value, unit in (
            ("mass", info.mass_kg, "kg"),
            ("density", info.density_kg_m3, "kg/m³"),
            ("friction", info.friction, ""),
        ):
            if value is not None:
                rows[label] = f"{value:g} {unit}".rstrip()
        others = [name for name in info.frames if name != "mesh"]
        if others:
            rows["frames"] = ", ".join(["mesh", *others])
        if info.mesh is not None:
            size = np.subtract(info.mesh.bounding_box.upper, info.mesh.bounding_box.lower) * 1000
            rows["mesh"] = (
                f"{size[0]:.1f} x {size[1]:.1f} x {size[2]:.1f} mm, {info.mesh.faces:,} triangles, "
                + ("watertight" if info.mesh.watertight else "not watertight")
            )
            for number, warning in enumerate(info.mesh.warnings, start=1):
                rows[f"mesh warning {number}"] = warning
        if info.convex_parts is not None:
            rows["convex parts"] = f"{info.convex_parts.parts}"
            for number, warning in enumerate(info.convex_parts.warnings, start=1):
                rows[f"convex parts warning {number}"] = warning
        if info.copied_from is not None:
            origin = info.copied_from
            rows["copied from"] = f"{origin.object}, revision {origin.revision}" + (
                ", then given another mesh" if origin.other_mesh else ""
            )
        rows["trials"] = f"{info.trials:,}"
        if info.outcomes:
            rows["outcomes"] = ", ".join(f"{n:,} {name}" for name, n in info.outcomes.items())
        rows["revision"] = str(info.revision)
        return rows

    def __repr__(self) -> str:
        info = self.info
        return (
            f"GraspObject({info.id!r}, trials={info.trials}, successes={info.outcomes.get('success', 0)}, "
            f"mesh={'yes' if info.mesh else 'no'}, revision={info.revision})"
        )

    def _repr_html_(self) -> str:
        table = table_html(f"Object {self.info.name or self.info.id}", self.summary())
        drawn = self.info.mesh is not None
        return with_picture(table, partial(picture, self._transport, self.id) if drawn else None)


class Objects(Resource):
    """``db.objects``: create, find, list and delete objects."""

    def create(
        self,
        id: str,
        *,
        mesh: MeshLike | None = None,
        unit: str = "m",
        scale: float = 1.0,
        media_type: str | None = None,
        convex_parts: MeshLike | Sequence[Any] | None = None,
        accept_deviation: bool = False,
        **properties: Unpack[ObjectProperties],
    ) -> GraspObject:
        """Create an object, with its mesh and convex parts if given: all of it or nothing.

        ``id`` is a slug; ``mesh``, ``unit``, ``scale`` and ``media_type`` as in
        :meth:`GraspObject.upload_mesh`, ``convex_parts`` and ``accept_deviation`` as in
        :meth:`GraspObject.upload_convex_parts`, the rest :class:`ObjectProperties`.
        """
        fields = _plain(known_keywords(ObjectProperties, properties, "create"))
        request = validate(wire.ObjectCreate, {"id": id, **fields})
        loaded = None if mesh is None else read_mesh(mesh, media_type)
        info = self._transport.model(wire.ObjectInfo, "POST", self._path, body=request, idempotent=True)
        created = GraspObject(self._transport, info)
        try:
            if loaded is not None:
                created.upload_mesh(loaded[0], unit=unit, scale=scale, media_type=loaded[1])
            if convex_parts is not None:
                created.upload_convex_parts(convex_parts, accept_deviation=accept_deviation)
        except (GraspDBError, OSError, ValueError, TypeError, ImportError):
            created.delete()
            raise
        return created

    def get(self, id: str) -> GraspObject:
        """The object with this id."""
        info = self._transport.model(wire.ObjectInfo, "GET", f"{self._path}/{segment(id)}")
        return GraspObject(self._transport, info)

    def list(self) -> Iterator[GraspObject]:
        """All objects."""
        for info in Listing(self._transport, self._path, wire.ObjectInfo):
            yield GraspObject(self._transport, info)

    def __iter__(self) -> Iterator[GraspObject]:
        return self.list()

    def delete(self, id: str) -> None:
        """Delete an object with everything that belongs to it."""
        self._transport.request("DELETE", f"{self._path}/{segment(id)}")


def _plain(properties: dict[str, Any]) -> dict[str, Any]:
    """Properties as requests take them: frames as poses."""
    frames = properties.get("frames")
    return properties if frames is None else {**properties, "frames": pose_documents(frames)}
