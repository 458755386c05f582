"""Making a sweep: what it simulates, checked in every way that can be before a worker starts."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graspdb.wire import (
    GridPlan,
    GridSpec,
    GripperProfile,
    KernelInfo,
    SampleSpec,
    Selection,
    SweepCreate,
)
from graspdb.wire.sweeps import Engine
from graspdb_density.se3 import Poses
from graspdb_service.problems import ProblemError, conflict, invalid
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Tx, clock
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.simulation import jobs, sweeps
from graspdb_service.storage.trials import batches, provenances
from graspdb_service.trial_columns import Floats, Provenance
from graspdb_service.usecases import grippers
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.geometry import decompositions
from graspdb_service.usecases.grasps import samples
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime.idempotency import Created, Sent, replay_or, replayed
from graspdb_service.usecases.simulation import feasibility
from graspdb_service.usecases.simulation.sweeps import require_sweep, sweep_info
from graspdb_service.usecases.trials import sweep_plan
from graspdb_service.usecases.trials.pose_frames import pose_frame

#: Of two linked sweeps: the engine whose trials are stored, and the one whose outcomes are compared.
_STORING: Engine = "pybullet"
_COMPARING: Engine = "mujoco"
#: More chunks than this are bookkeeping without a use: no lab has so many workers.
MAX_CHUNKS = 100_000
#: A plan is cut into at least about this many chunks, so that several processes share a small one ...
WANTED_CHUNKS = 16
#: ... down to these many poses. Given and drawn poses lie at the object, where each needs physics.
MIN_GRID_CHUNK, MIN_POSES_CHUNK, MAX_POSES_CHUNK = 1_000, 10, 2_000


@dataclass(frozen=True)
class _World:
    """What a sweep's physics depends on, as it is when the sweep is made."""

    object: ObjectRow
    snapshot: dict[str, Any]
    profile: GripperProfile

    def still_holds(self, row: ObjectRow) -> bool:
        names = ("id", "mesh_sha256", "parts_sha256", "mass_kg", "density_kg_m3", "friction")
        return all(getattr(row, name) == getattr(self.object, name) for name in names)


@dataclass(frozen=True)
class Given:
    """Poses to simulate, and the density each was drawn with, (n,) or (): NaN where it is not known."""

    poses: Poses
    proposal_density: Floats


@dataclass(frozen=True)
class _Plan:
    """What to simulate: a grid, or poses (n, 8) as :func:`sweeps.create` takes them."""

    kind: str
    count: int
    grid: GridPlan | None = None
    full_count: int | None = None
    poses: Floats | None = None
    kernel: KernelInfo | None = None
    warnings: Sequence[str] = ()


def create(ctx: Estimators, slug: str, spec: SweepCreate, sent: Sent, given: Given | None) -> Created:
    """Check and queue a sweep: 409 while its object lacks its mesh, 422 for what can't be simulated.

    ``given`` are its poses where it has any, and a grid or draws otherwise.
    """
    scope = f"POST /objects/{slug}/sweeps"
    earlier = replayed(ctx.database, scope, sent)
    if earlier is not None:
        return earlier
    with ctx.database.read() as tx:
        created_ms = int(clock(tx).timestamp() * 1000)
        row = require(tx, slug)
        gripper = grippers.named(tx, spec.gripper)
        profile = GripperProfile.model_validate(gripper.profile)
        if row.mesh_info is not None and row.parts_sha256 is None:
            decompositions.check(tx, row)
    world = _world(row, profile)
    plan = _plan(ctx, slug, spec, world, given)
    chunk = _chunk_size(ctx, spec, plan)
    plan = replace(plan, warnings=[*plan.warnings, *decompositions.warnings(row)])
    planned = _planned(spec, plan, world, chunk, created_ms)

    def store(tx: Tx) -> Created:
        locked = require(tx, slug, lock=True)
        if not world.still_holds(locked):
            raise conflict("object-changed", f"Object {slug!r} was changed at the same moment: send it again")
        grippers.hold(tx, gripper.versioned)
        waiting = locked.parts_sha256 is None
        if waiting:
            decompositions.ask(tx, locked, created_ms)
        origin = Provenance(gripper.versioned, "simulation", spec.protocol)
        shared = {
            "object_id": locked.id,
            "provenance_id": provenances.ensure(tx, locked.id, origin),
            "gripper": gripper.id,
            **spec.model_dump(include={"protocol", "fidelity"}),
            "plan": plan.kind,
            "pose_count": plan.count,
            "chunk_poses": chunk,
        }
        # In the order of their making: who asked for two follows the last one.
        made = [_create(tx, locked, each, shared, plan, waiting=waiting) for each in planned]
        info = sweep_info(tx, require_sweep(tx, planned[-1].id))
        return Created(info.model_dump(mode="json"), f"/sweeps/{info.id}", status=202, batch_key=made[-1])

    return replay_or(ctx.database, scope, sent, store)


@dataclass(frozen=True)
class _Planned:
    """A sweep that is to be made, and the ids of its jobs; of two that are linked each names the other."""

    id: str
    linked: str | None
    purpose: str
    request: dict[str, Any]
    snapshot: dict[str, Any]
    job_ids: list[str]


def _planned(spec: SweepCreate, plan: _Plan, world: _World, chunk: int, created_ms: int) -> list[_Planned]:
    """The sweep that was asked for, with two engines the last of two; in memory and in one go, before the
    transaction, that this may be short.
    """
    halves: list[tuple[Engine | None, str]] = [(None, spec.purpose)]
    if spec.engine == "both":
        halves = [(_COMPARING, "compare"), (_STORING, spec.purpose)]
    elif spec.engine is not None:
        halves = [(spec.engine, spec.purpose)]
    ids = [_new_id(created_ms + place) for place in range(len(halves))]
    planned = []
    for (engine, purpose), own, other in zip(halves, ids, reversed(ids), strict=True):
        # What stores comes first to workers that have both.
        jobs_ms = created_ms + (purpose == "compare")
        count = -(-plan.count // chunk)
        planned.append(
            _Planned(
                own,
                other if len(halves) > 1 else None,
                purpose,
                _request(spec, plan, engine),
                _snapshot(world, plan, spec, engine),
                jobs.job_ids(jobs_ms, count, urgent=spec.purpose == "check"),
            )
        )
    return planned


def _create(
    tx: Tx, row: ObjectRow, planned: _Planned, shared: dict[str, Any], plan: _Plan, *, waiting: bool
) -> str:
    """Store a sweep of an object (locked) with its batch, whose key is answered, and queue its jobs."""
    snapshot = dict(planned.snapshot)
    sweep = {**shared, **{name: getattr(planned, name) for name in ("id", "linked", "purpose", "request")}}
    capability = sweep_plan.capability_of(sweep["protocol"], "randomise" in planned.request)
    sweeps.create(
        tx,
        {**sweep, "snapshot": snapshot},
        poses=plan.poses,
        job_ids=planned.job_ids,
        capability=capability,
        waiting=waiting,
    )
    if waiting:
        # Until there are parts, it repeats no other's poses.
        snapshot["repeat_key"] = planned.id
    audit.record(tx, "sweep.create", object=row.slug, subject=planned.id)
    _, batch = batches.create(tx, row.id, revision=row.revision, sweep_id=planned.id)
    sweeps.keep_snapshot(tx, planned.id, {**snapshot, "batch": batch})
    return batch


def _request(spec: SweepCreate, plan: _Plan, engine: Engine | None) -> dict[str, Any]:
    """What was asked for of this engine, defaults filled in; given poses are stored as the plan's."""
    apart = {"poses", "proposal_density", "frame", "convention"}
    asked = spec.model_dump(mode="json", exclude=apart, exclude_none=True)
    if engine is not None:
        asked["engine"] = engine
    if plan.grid is not None:
        asked["grid"] = (spec.grid or GridSpec()).model_dump(mode="json", exclude_none=True)
    return asked


def _snapshot(world: _World, plan: _Plan, spec: SweepCreate, engine: Engine | None) -> dict[str, Any]:
    """All that a sweep's results depend on, for good."""
    snapshot: dict[str, Any] = {"world": world.snapshot, "full_count": plan.full_count}
    if plan.grid is not None:
        snapshot["grid"] = plan.grid.model_dump(mode="json")
        drawn = None if spec.randomise is None else spec.randomise.model_dump(mode="json")
        snapshot["repeat_key"] = sweep_plan.repeat_key(
            world.snapshot, spec.protocol, spec.fidelity, plan.grid, engine, drawn
        )
    if plan.warnings:
        snapshot["warnings"] = list(plan.warnings)
    if plan.kernel is not None:
        # A sample may name no widths, and those of a density change as it grows.
        snapshot["drawn_with"] = plan.kernel.model_dump(mode="json")
    return snapshot


def _new_id(created_ms: int) -> str:
    """A UUID of version 7 (RFC 9562): sweeps sort by their creation."""
    random = uuid.uuid4().int
    return str(
        uuid.UUID(int=(created_ms << 80) | (7 << 76) | (random & ((1 << 76) - 1) & ~(3 << 62)) | (2 << 62))
    )


def _world(row: ObjectRow, profile: GripperProfile) -> _World:
    if row.mesh_info is None or row.mesh_sha256 is None:
        raise conflict("mesh-missing", f"Object {row.slug!r} has no mesh: PUT /objects/{row.slug}/mesh first")
    feasibility.check_gripper(profile)
    box = row.mesh_info["bounding_box"]
    lower, upper = np.array(box["lower"]), np.array(box["upper"])
    feasibility.check_size(row, float(np.max(upper - lower)), profile)
    mass_kg = _mass(row)
    feasibility.check_mass(row, mass_kg, (upper - lower).tolist())
    snapshot = {
        "mesh_sha256": row.mesh_sha256,
        "parts_sha256": row.parts_sha256,
        "mass_kg": mass_kg,
        "friction": row.friction if row.friction is not None else profile.friction,
        "gripper": _simulated(profile),
        "lower": lower.tolist(),
        "upper": upper.tolist(),
    }
    if snapshot["mass_kg"] is None:
        snapshot["density_kg_m3"] = row.density_kg_m3
    return _World(row, snapshot, profile)


def _simulated(profile: GripperProfile) -> dict[str, Any]:
    """A profile without what no simulation depends on: two sweeps of one grid then stay two of one grid, and
    a worker of an older version knows all fields.
    """
    told = profile.model_dump(mode="json", exclude={"frames", "joints", "source", "unverified"})
    return told if told["tip_offsets"] else {k: v for k, v in told.items() if k != "tip_offsets"}


def _mass(row: ObjectRow) -> float | None:
    """The mass, by density where it is not given; None where that has to wait for the parts' volume."""
    if row.mass_kg is not None:
        return row.mass_kg
    if row.density_kg_m3 is not None:
        # The mesh's own volume where it has one: parts may overlap, and differ from decomposer to decomposer.
        volume = (row.mesh_info or {}).get("volume_m3") or (row.parts_info or {}).get("volume_m3")
        return row.density_kg_m3 * volume if volume else None
    raise invalid(
        "mass_kg",
        f"unknown: PATCH /objects/{row.slug} with mass_kg, or with density_kg_m3",
        "The object's mass is needed: a grasp must hold its weight",
    )


def _plan(ctx: Estimators, slug: str, spec: SweepCreate, world: _World, given: Given | None) -> _Plan:
    if given is not None:
        frame = pose_frame(spec.frame, spec.convention, world.profile, spec.gripper)
        told = _given(ctx, Given(frame.to_tool(given.poses), given.proposal_density))
        return replace(told, warnings=frame.warnings)
    if spec.sample is not None:
        return _drawn(ctx, slug, spec, spec.sample)
    wish = spec.grid or GridSpec()
    region = None if wish.region is None else (wish.region.lower, wish.region.upper)
    plan = GridPlan(
        **wish.model_dump(exclude={"region"}),
        lower=world.snapshot["lower"],
        upper=world.snapshot["upper"],
        region=region,
        symmetric=world.profile.symmetric,
    )
    try:
        grid = sweep_plan.pose_grid(plan)
        count, full = grid.total, grid.full_total
    except ValueError as error:
        text = str(error)
        fields = ("region", "position_step_m", "rotation_step_deg", "margin_m", "max_poses", "seed")
        field = next((name for name in fields if name in text), "position_step_m")
        raise invalid(f"grid.{field}", text) from None
    if count > ctx.settings.max_sweep_poses:
        raise feasibility.too_many_poses(world.object, plan, world.profile, ctx.settings.max_sweep_poses)
    return _Plan("grid", count, grid=plan, full_count=full)


def _check_count(ctx: Estimators, field: str, count: int) -> None:
    """422 for more given or drawn poses, which are stored one by one, than a sweep may have."""
    limit = min(ctx.settings.max_samples, ctx.settings.max_sweep_poses)
    if count > limit:
        raise ProblemError(
            422,
            "too-many-poses",
            f"{count} poses that are no grid are over a sweep's limit of {limit}: make several sweeps",
            errors=[(field, f"at most {limit}")],
            extra={"limit": limit, "poses": count},
        )


def _given(ctx: Estimators, given: Given) -> _Plan:
    poses, densities = given.poses, given.proposal_density
    _check_count(ctx, "poses", len(poses))
    if densities.shape not in ((), (len(poses),)):
        raise invalid("proposal_density", f"{len(densities)} values for {len(poses)} poses")
    table = np.column_stack([*poses, np.broadcast_to(densities, len(poses))])
    return _Plan("poses", len(table), poses=table)


def _drawn(ctx: Estimators, slug: str, spec: SweepCreate, sample: SampleSpec) -> _Plan:
    _check_count(ctx, "sample.count", sample.count)
    selection = Selection(gripper=spec.gripper, protocol=sample.protocol, kernel=sample.kernel)
    drawn = samples.draw(ctx, slug, selection, sample.count, sample.seed, support=False)
    table = np.column_stack([drawn.position, drawn.quaternion_xyzw, drawn.proposal_density])
    return _Plan("sample", len(table), poses=table, kernel=drawn.kernel)


def _chunk_size(ctx: Estimators, spec: SweepCreate, plan: _Plan) -> int:
    if spec.chunk_poses is not None:
        size = spec.chunk_poses
    else:
        most, least = ctx.settings.chunk_poses, MIN_GRID_CHUNK
        if plan.kind != "grid":
            most, least = min(most, MAX_POSES_CHUNK), MIN_POSES_CHUNK
        size = min(most, max(least, -(-plan.count // WANTED_CHUNKS)))
        if spec.randomise is not None:
            # A chunk that takes as long, as far as there may be so many.
            size = max(min(least, size), size // spec.randomise.draws, -(-plan.count // MAX_CHUNKS))
    if plan.count > size * MAX_CHUNKS:
        raise invalid(
            "chunk_poses",
            f"{plan.count} poses in chunks of {size} are more than {MAX_CHUNKS} chunks:"
            f" take at least {-(-plan.count // MAX_CHUNKS)}",
        )
    return size
