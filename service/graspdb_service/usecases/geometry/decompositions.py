"""Convex parts made by a worker: asked for once an object, waited for by its sweeps, had or missed by all.

A sweep of an object without parts is complete but for them: its chunks wait, and what depends on the parts
(their hash, a mass by density where the mesh encloses no volume, the key of repeats) joins its snapshot when
they exist, whoever brings them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from graspdb.wire import DecomposePayload, GridPlan, MeshInfo, PartsInfo
from graspdb.wire.states import JobState, SweepState
from graspdb.wire.sweeps import WaitingFor
from graspdb_geometry import meshes
from graspdb_geometry.deviation import accepted_m
from graspdb_service.problems import ProblemError, conflict
from graspdb_service.storage.database import Tx
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.simulation import decompositions, sweeps
from graspdb_service.storage.simulation.jobs import OPEN, JobRow, job_ids
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.usecases.trials import sweep_plan

#: A bounding box thinner than this share of its longest side holds a sheet, and no solid.
MIN_FLATNESS = 1e-3
MIN_SIDE_M = 2e-4

_WAYS_OUT = (
    "PUT /objects/{slug}/convex-parts (a GLB with one geometry a part), or mend the mesh and register it as"
    " another object"
)


def check(tx: Tx, row: ObjectRow) -> None:
    """Refuse a sweep whose object no worker will find parts for: 422 for a flat mesh, 409 after a failure."""
    box = (row.mesh_info or {})["bounding_box"]
    sides = [high - low for low, high in zip(box["lower"], box["upper"], strict=True)]
    if min(sides) < max(MIN_SIDE_M, MIN_FLATNESS * max(sides)):
        raise ProblemError(
            422,
            "mesh-flat",
            f"The mesh of {row.slug!r} is flat ({min(sides):g} m thick): it has no convex parts to simulate."
            f" {_WAYS_OUT.format(slug=row.slug)}",
            errors=[("mesh", "flat")],
        )
    job = decompositions.find(tx, row.id)
    if job is not None and job.state == JobState.FAILED:
        raise conflict(
            "convex-parts-missing",
            f"The mesh of {row.slug!r} is not convex, and its decomposition into convex parts failed:"
            f" {job.error}. {_WAYS_OUT.format(slug=row.slug)}; POST /sweeps/{{id}}/retry of a sweep that"
            " waited for it tries once more",
        )


def ask(tx: Tx, row: ObjectRow, created_ms: int) -> None:
    """Have the object's mesh decomposed, unless that is under way; under the object's lock."""
    (job_id,) = job_ids(created_ms, 1, urgent=True)
    decompositions.ask(tx, row.id, job_id)


def forget(tx: Tx, row: ObjectRow) -> None:
    """The object (locked) gets another mesh: what was asked for the one before is of no use."""
    decompositions.forget(tx, row.id)


def settle(tx: Tx, row: ObjectRow) -> None:
    """The object (locked) has parts: complete the snapshots of sweeps that waited, release their chunks."""
    for sweep_id in decompositions.waiting_sweeps(tx, row.id):
        sweep = sweeps.find(tx, sweep_id)
        if sweep is not None:
            take_parts(tx, row, sweep)
    decompositions.release(tx, row.id)
    decompositions.cancel(tx, row.id)


def warnings(row: ObjectRow) -> list[str]:
    """What a sweep with the object's parts has to say of them."""
    if row.parts_info is None or row.mesh_info is None:
        return []
    parts, box = PartsInfo.model_validate(row.parts_info), row.mesh_info["bounding_box"]
    off = parts.deviation_m
    # Parts that were stored before this was looked at have their distance alone.
    far = off is not None and off > accepted_m(max(np.subtract(box["upper"], box["lower"])))
    if off is None or not (parts.deviates or far):
        return []
    volume = "" if parts.volume_share is None else f" and have {parts.volume_share:.1%} of its volume"
    return [
        f"it simulates convex parts that are up to {1000 * off:.3g} mm off the mesh{volume}: outcomes there"
        " may not hold for the object, collisions above all"
    ]


def take_parts(tx: Tx, row: ObjectRow, sweep: SweepRow) -> None:
    """Complete a sweep's snapshot with the parts of its object."""
    world: dict[str, Any] = {**sweep.snapshot["world"], "parts_sha256": row.parts_sha256}
    density = world.pop("density_kg_m3", None)
    if world["mass_kg"] is None:
        world["mass_kg"] = density * (row.parts_info or {})["volume_m3"]
    told = [*sweep.snapshot.get("warnings", []), *warnings(row)]
    snapshot = {**sweep.snapshot, "world": world, **({"warnings": told} if told else {})}
    if sweep.plan == "grid":
        grid = GridPlan.model_validate(sweep.snapshot["grid"])
        engine, drawn = (sweep.request.get(name) for name in ("engine", "randomise"))
        snapshot["repeat_key"] = sweep_plan.repeat_key(
            world, sweep.protocol, sweep.fidelity, grid, engine, drawn
        )
    sweeps.keep_snapshot(tx, sweep.id, snapshot)


def lacks_parts(sweep: SweepRow) -> bool:
    """Whether the sweep was made before its object had parts, and has got none since."""
    return sweep.snapshot["world"]["parts_sha256"] is None


def again(tx: Tx, row: ObjectRow, sweep: SweepRow, created_ms: int) -> bool:
    """Before a sweep without parts is retried: give it those there are, or have them made (True: wait)."""
    if row.parts_sha256 is not None:
        take_parts(tx, row, sweep)
        return False
    ask(tx, row, created_ms)
    return True


def fail_waiting(tx: Tx, job: JobRow, reason: str) -> None:
    """The decomposition has failed for good: so have the sweeps that waited for it."""
    waiting = decompositions.waiting_sweeps(tx, job.object_id)
    source = decompositions.source_of(tx, job.object_id)
    slug = "{id}" if source is None else source.slug
    error = (
        f"no convex parts: {reason}. {_WAYS_OUT.format(slug=slug)}; with parts there,"
        " POST /sweeps/{id}/retry goes on"
    )
    decompositions.fail_waiting(tx, job.object_id, error)
    for sweep_id in waiting:
        sweeps.note_finished(tx, sweep_id)


def drop_unwanted(tx: Tx, object_id: int) -> None:
    """Stop a decomposition that no sweep waits for any more."""
    job = decompositions.find(tx, object_id)
    is_open = job is not None and job.state in OPEN
    if is_open and not decompositions.waiting_sweeps(tx, object_id):
        decompositions.cancel(tx, object_id)


def waiting_for(tx: Tx, sweep: SweepRow) -> WaitingFor | None:
    """What a sweep without parts waits for."""
    if sweep.cancelled or not lacks_parts(sweep):
        return None
    job = decompositions.find(tx, sweep.object_id)
    if job is None:
        return None
    return WaitingFor.model_validate(
        {
            "kind": "decompose",
            "job": job.id,
            "state": SweepState.RUNNING if job.state == JobState.LEASED else job.state,
            "attempts": job.attempts,
            "worker": job.worker,
            "progress": job.progress,
            "error": job.error,
        }
    )


def source(tx: Tx, job: JobRow) -> str | None:
    """The id of the object that a decomposition is for; None once it is gone."""
    found = decompositions.source_of(tx, job.object_id)
    return None if found is None else found.slug


def payload(tx: Tx, job: JobRow) -> DecomposePayload | None:
    """What a worker is told; None once the object is gone."""
    source = decompositions.source_of(tx, job.object_id)
    if source is None or source.mesh_info is None:
        return None
    mesh = MeshInfo.model_validate(source.mesh_info)
    return DecomposePayload(
        object=source.slug,
        mesh=f"/objects/{source.slug}/mesh",
        mesh_sha256=mesh.sha256,
        media_type=mesh.media_type,
        unit=mesh.unit,
        scale=mesh.scale,
        max_parts=meshes.MAX_PARTS,
    )
