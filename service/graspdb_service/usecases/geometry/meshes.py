"""Meshes and convex parts: checked in a bounded child process, stored by their SHA-256."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Any

import numpy as np

from graspdb.wire import BoundingBox, MeshInfo, PartsInfo
from graspdb_geometry import meshes
from graspdb_geometry.deviation import Fit, fit
from graspdb_geometry.meshes import Inspection, Mesh, MeshError, Part
from graspdb_service.formats.negotiation import GLB
from graspdb_service.problems import ProblemError, conflict, not_found
from graspdb_service.storage import assets, objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Tx
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.trials import provenances
from graspdb_service.usecases.geometry import decompositions
from graspdb_service.usecases.geometry.mesh_child import inspect_in_child
from graspdb_service.usecases.geometry.mesh_form import MeshForm, form_of
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime.runtime import Runtime

MEDIA_TYPES = meshes.MEDIA_TYPES

# Parts come from the mesh, rounded or slightly inflated: within this they describe the same object.
_FIT_M = 1e-3
_FIT_SHARE = 0.02
#: More parts than these are simulated slowly, and seldom say more.
_MANY_PARTS = 256


def put_mesh(ctx: Runtime, slug: str, content: bytes, *, form: MeshForm) -> MeshInfo:
    """Check and store an object's mesh; one whose bodies are all convex brings its own convex parts.

    413 and 422 for what can't be used; 409 for another mesh once trials or sweeps exist.
    """
    sha256 = hashlib.sha256(content).hexdigest()
    with ctx.database.read() as tx:
        row = require(tx, slug)
        if _is_stored(row, sha256, form):
            return MeshInfo.model_validate(row.mesh_info)
        _refuse_another_mesh(tx, row)
    inspection = _inspect(ctx, content, form)
    info = _mesh_info(inspection, sha256, form, len(content))
    own = meshes.parts_to_glb(inspection.parts) if inspection.parts else None
    earlier = None if own is not None else _parts_before(ctx, row, content, form, info)
    with ctx.database.write() as tx:
        row = require(tx, slug, lock=True)
        if _is_stored(row, sha256, form):
            return MeshInfo.model_validate(row.mesh_info)
        _refuse_another_mesh(tx, row)
        objects.advance(tx, row.id, append=False)
        assets.put(tx, content, form.media_type)
        values: dict[str, Any] = {"mesh_sha256": sha256, "mesh_info": info.model_dump(mode="json")}
        if _is_used(tx, row):
            values["copied_from"] = {**(row.copied_from or {}), "takes_mesh": False, "other_mesh": True}
            decompositions.forget(tx, row)
        if own is not None:
            values |= _parts_values(tx, own, _parts_info(own, inspection.parts, info))
        elif row.mesh_sha256 is not None:
            # The parts were those of the mesh before.
            values |= {"parts_sha256": None, "parts_info": None}
        elif row.parts_sha256 is not None:
            if earlier is None or earlier.sha256 != row.parts_sha256:
                raise conflict(
                    "object-changed", f"The parts of {slug!r} were changed at the same moment: try again"
                )
            values["parts_info"] = earlier.model_dump(mode="json")
        objects.change(tx, row.id, values)
        audit.record(tx, "mesh.put", object=slug)
    _drop_unused(ctx, row)
    return info


def _parts_before(
    ctx: Runtime, row: ObjectRow, content: bytes, form: MeshForm, mesh: MeshInfo
) -> PartsInfo | None:
    """Parts that were there before their mesh, measured against it; None for none."""
    if row.mesh_sha256 is not None or row.parts_sha256 is None:
        return None
    with ctx.database.read() as tx:
        found = assets.get(tx, row.parts_sha256)
    if found is None:
        return None
    parts = meshes.parts_from_glb(found[0])
    return _measured(_parts_info(found[0], parts, mesh), _fit(ctx, parts, content, form, mesh))


def put_parts(ctx: Runtime, slug: str, content: bytes, *, accept_deviation: bool = False) -> PartsInfo:
    """Check and store an object's convex parts, a GLB in metres with one geometry a part.

    413 and 422 for what can't be used, or, unless ``accept_deviation``, does not follow a closed mesh; 409
    for other parts once a sweep exists.
    """
    sha256 = hashlib.sha256(content).hexdigest()
    with ctx.database.read() as tx:
        row = require(tx, slug)
        if row.parts_sha256 == sha256:
            return PartsInfo.model_validate(row.parts_info)
        _refuse_other_parts(tx, row)
    info = check_parts(ctx, row, content, accept_deviation=accept_deviation)
    with ctx.database.write() as tx:
        locked = require(tx, slug, lock=True)
        if locked.parts_sha256 == sha256:
            return PartsInfo.model_validate(locked.parts_info)
        if (locked.id, locked.mesh_sha256, locked.mesh_info) != (row.id, row.mesh_sha256, row.mesh_info):
            raise conflict(
                "object-changed", f"The mesh of {slug!r} was changed at the same moment: try again"
            )
        _refuse_other_parts(tx, locked)
        objects.advance(tx, locked.id, append=False)
        store_parts(tx, locked, content, info)
        audit.record(tx, "parts.put", object=slug)
    _drop_unused(ctx, locked)
    return info


def check_parts(ctx: Runtime, row: ObjectRow, content: bytes, *, accept_deviation: bool = False) -> PartsInfo:
    """Check convex parts, wherever they come from, and measure them against their object's mesh.

    422 for those that do not follow a closed mesh, unless ``accept_deviation``. What an open mesh leaves open
    they may fill: then the warnings tell how far they differ.
    """
    parts = _inspect(ctx, content, MeshForm(GLB), field="parts").parts
    mesh = None if row.mesh_info is None else MeshInfo.model_validate(row.mesh_info)
    info = _parts_info(content, parts, mesh)
    if mesh is None:
        return info
    with ctx.database.read() as tx:
        found = assets.get(tx, mesh.sha256)
    if found is None:
        raise conflict(
            "object-changed", f"The mesh of {row.slug!r} was changed at the same moment: try again"
        )
    told = _fit(ctx, parts, found[0], form_of(row), mesh)
    if not told.accepted and mesh.watertight and not accept_deviation:
        raise _deviate(told, info.warnings)
    return _measured(info, told)


def _deviate(told: Fit, doubts: list[str]) -> ProblemError:
    doubt = "".join(f" ({text})" for text in doubts)
    return ProblemError(
        422,
        "convex-parts-deviate",
        f"The parts' surface is {told}{doubt}: physics would tell of another object than the mesh. Decompose"
        " it finer; or leave it to a worker, for the first sweep of an object without parts has them made; or"
        " take them all the same, and every sweep says so: send them with ?accept_deviation=true"
        " (on the command line --accept-deviation)",
        errors=[("parts", "too far from the mesh")],
        extra={"deviation_m": told.deviation_m, "accepted_m": told.accepted_m, "volume_share": told.volume},
    )


def _fit(ctx: Runtime, parts: list[Part], content: bytes, form: MeshForm, mesh: MeshInfo) -> Fit:
    own = form.read(content)
    return ctx.compute.run(lambda: fit(own, parts, mesh.volume_m3))


def _measured(info: PartsInfo, told: Fit) -> PartsInfo:
    """What is known of parts, and how far they stand for their mesh."""
    warnings = list(info.warnings)
    if not told.same:
        warnings.append(f"the parts' surface is {told}")
    return info.model_copy(
        update={
            "deviation_m": told.deviation_m,
            "volume_share": told.volume,
            "deviates": not told.accepted,
            "warnings": warnings,
        }
    )


def store_parts(tx: Tx, row: ObjectRow, content: bytes, info: PartsInfo) -> None:
    """Keep checked parts, for the sweeps that waited for them too; under the object's lock, its revision
    advanced."""
    values = _parts_values(tx, content, info)
    objects.change(tx, row.id, values)
    decompositions.settle(tx, replace(row, **values))


def get_mesh(ctx: Runtime, slug: str) -> tuple[bytes, MeshForm, str]:
    """The mesh as it came: bytes, how they are read, SHA-256."""
    with ctx.database.read() as tx:
        row = require(tx, slug)
        found = None if row.mesh_sha256 is None else assets.get(tx, row.mesh_sha256)
    if found is None or row.mesh_info is None or row.mesh_sha256 is None:
        raise not_found("mesh of object", slug, f"PUT /objects/{slug}/mesh stores one")
    # By the object, for the same bytes may have come for another one under another media type.
    return found[0], form_of(row), row.mesh_sha256


def as_stl(ctx: Runtime, content: bytes, form: MeshForm) -> bytes:
    """A stored mesh as it was understood: its triangles in metres, object frame, as binary STL."""
    return ctx.compute.run(lambda: meshes.mesh_to_stl(form.read(content)))


def get_parts(ctx: Runtime, slug: str) -> tuple[bytes, str, str]:
    """The convex parts: GLB bytes, media type, SHA-256."""
    with ctx.database.read() as tx:
        row = require(tx, slug)
        found = None if row.parts_sha256 is None else assets.get(tx, row.parts_sha256)
    if found is None or row.parts_sha256 is None:
        raise not_found("set of convex parts of object", slug, f"PUT /objects/{slug}/convex-parts stores it")
    return found[0], GLB, row.parts_sha256


def _inspect(ctx: Runtime, content: bytes, form: MeshForm, *, field: str = "mesh") -> Inspection:
    limit = ctx.settings.max_mesh_bytes
    if len(content) > limit:
        raise ProblemError(
            413,
            "body-too-large",
            f"A mesh may have {limit:,} bytes and this one has {len(content):,}: simplify it first",
            extra={"limit": limit},
        )
    try:
        # Each child may take the memory limit, so few run at once.
        with ctx.mesh_children:
            return inspect_in_child(
                content,
                form,
                as_parts=field == "parts",
                memory_bytes=ctx.settings.max_mesh_memory_bytes,
                seconds=ctx.settings.max_mesh_seconds,
            )
    except MeshError as error:
        if error.field == "mesh":
            error.field = field
        raise _refused(error) from None


def _refused(error: MeshError) -> ProblemError:
    return ProblemError(
        422, "mesh-not-usable", f"Not usable: {error.message}", errors=[(error.field, error.message)]
    )


def _is_stored(row: ObjectRow, sha256: str, form: MeshForm) -> bool:
    return row.mesh_sha256 == sha256 and row.mesh_info is not None and form_of(row) == form


def _refuse_another_mesh(tx: Tx, row: ObjectRow) -> None:
    if not _is_used(tx, row):
        return
    if not (row.copied_from or {}).get("takes_mesh"):
        raise conflict(
            "mesh-in-use",
            f"{row.slug!r} has trials or sweeps made with its mesh: register another object for another mesh,"
            f" or take a copy, which takes one (POST /objects/{row.slug}/copies)",
        )
    if objects.has_running_sweep(tx, row.id):
        raise conflict(
            "sweep-running",
            f"A sweep of {row.slug!r} with its mesh is running: cancel it (POST /sweeps/{{id}}/cancel) or"
            " wait for its end",
        )


def _is_used(tx: Tx, row: ObjectRow) -> bool:
    """Whether trials or sweeps were made with the mesh that there is."""
    if row.mesh_sha256 is None:
        return False
    return objects.has_sweeps(tx, row.id) or any(provenances.outcome_counts(tx, [row.id])[row.id].values())


def _refuse_other_parts(tx: Tx, row: ObjectRow) -> None:
    if row.parts_sha256 is not None and objects.has_sweeps(tx, row.id):
        raise conflict(
            "convex-parts-in-use",
            f"{row.slug!r} has sweeps simulated with its convex parts: register another object for others",
        )


def _mesh_info(inspection: Inspection, sha256: str, form: MeshForm, size: int) -> MeshInfo:
    measured = inspection.properties
    return MeshInfo.model_validate(
        {
            "sha256": sha256,
            "media_type": form.media_type,
            "unit": form.unit,
            "scale": form.scale,
            "bytes": size,
            "vertices": len(inspection.mesh.vertices),
            "faces": len(inspection.mesh.faces),
            "bounding_box": {"lower": measured.lower, "upper": measured.upper},
            "volume_m3": measured.volume_m3,
            "watertight": measured.watertight,
            "convex": measured.convex,
            "centre_of_mass": measured.centre_of_mass,
            "inertia_m5": measured.inertia,
            "warnings": measured.warnings,
        }
    )


def _parts_info(content: bytes, parts: list[Part], mesh: MeshInfo | None) -> PartsInfo:
    measured = [meshes.properties(Mesh(vertices, faces)) for vertices, faces in parts]
    lower = np.min([part.lower for part in measured], axis=0)
    upper = np.max([part.upper for part in measured], axis=0)
    warnings = []
    if mesh is not None:
        box = mesh.bounding_box
        extent = np.subtract(box.upper, box.lower)
        off = np.maximum(np.abs(lower - box.lower), np.abs(upper - box.upper))
        if np.any(off > _FIT_M + _FIT_SHARE * extent):
            warnings.append(
                f"the parts' bounding box is up to {float(off.max()):.3g} m off the mesh's:"
                " are they of this mesh, and in metres?"
            )
    if len(parts) > _MANY_PARTS:
        warnings.append(
            f"{len(parts)} parts are simulated slowly: {_MANY_PARTS} or fewer tell as much of most objects"
        )
    return PartsInfo(
        sha256=hashlib.sha256(content).hexdigest(),
        parts=len(parts),
        volume_m3=sum(part.volume_m3 or 0.0 for part in measured),
        bounding_box=BoundingBox.model_validate({"lower": lower.tolist(), "upper": upper.tolist()}),
        warnings=warnings,
    )


def _parts_values(tx: Tx, content: bytes, info: PartsInfo) -> dict[str, Any]:
    assets.put(tx, content, GLB)
    return {"parts_sha256": info.sha256, "parts_info": info.model_dump(mode="json")}


def _drop_unused(ctx: Runtime, before: ObjectRow) -> None:
    old = {sha256 for sha256 in (before.mesh_sha256, before.parts_sha256) if sha256}
    if old:
        with ctx.database.write() as tx:
            assets.drop_unused(tx, old)
