"""Sweeps: plan them with every check that can be made before a worker starts, follow, stop, repeat."""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from graspdb.wire import (
    OUTCOMES,
    GridPlan,
    GridSpec,
    GripperProfile,
    KernelInfo,
    PoseColumns,
    SampleSpec,
    Selection,
    SweepCreate,
    SweepInfo,
)
from graspdb.wire.states import JobState, SweepState
from graspdb.wire.sweeps import FailedChunk
from graspdb_service.formats import arrow
from graspdb_service.problems import conflict, invalid, not_found
from graspdb_service.storage import grippers
from graspdb_service.storage.database import Tx
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.simulation import jobs, sweeps
from graspdb_service.storage.simulation import outcomes as packed
from graspdb_service.storage.simulation.sweeps import POSE_COLUMNS, Progress, SweepRow
from graspdb_service.storage.trials import batches, provenances
from graspdb_service.trial_columns import Provenance
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.geometry import decompositions
from graspdb_service.usecases.grasps import likelihood
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime.idempotency import Created, replay_or, replayed
from graspdb_service.usecases.simulation import feasibility
from graspdb_service.usecases.trials import sweep_plan

#: More chunks than this are bookkeeping without a use: no lab has so many workers.
MAX_CHUNKS = 100_000
#: A plan is cut into at least about this many chunks, so that several processes share a small one ...
WANTED_CHUNKS = 16
#: ... down to these many poses. Given and drawn poses lie at the object, where each needs physics.
MIN_GRID_CHUNK, MIN_POSES_CHUNK, MAX_POSES_CHUNK = 1_000, 10, 2_000

#: Poses read at a time for a stream of outcomes.
STREAM_POSES = 100_000

_CURSOR = re.compile(r"(\d{1,9})\.(\d{1,9})")


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
class _Plan:
    """What to simulate: a grid, or poses (n, 8) as :func:`sweeps.create` takes them."""

    kind: str
    count: int
    grid: GridPlan | None = None
    full_count: int | None = None
    poses: npt.NDArray[np.float64] | None = None
    kernel: KernelInfo | None = None


def create(ctx: Estimators, slug: str, spec: SweepCreate, *, key: str | None, request: bytes) -> Created:
    """Check and queue a sweep: 404 for the object, 409 without a mesh, 422 for what can't be simulated."""
    scope = f"POST /objects/{slug}/sweeps"
    earlier = replayed(ctx.database, scope=scope, key=key, request=request)
    if earlier is not None:
        return earlier
    with ctx.database.read() as tx:
        row = require(tx, slug)
        gripper = grippers.find(tx, spec.gripper)
        if row.mesh_info is not None and row.parts_sha256 is None:
            decompositions.check(tx, row)
    if gripper is None:
        raise invalid("gripper", f"there is no gripper {spec.gripper!r}: GET /grippers lists them")
    world = _world(row, GripperProfile.model_validate(gripper.profile))
    plan = _plan(ctx, slug, spec, world)
    chunk = _chunk_size(ctx, spec, plan)
    # In memory and in one go, before the transaction, that it may be short.
    created_ms = time.time_ns() // 1_000_000
    numbers = jobs.job_ids(created_ms, -(-plan.count // chunk), urgent=spec.purpose == "check")
    snapshot: dict[str, Any] = {"world": world.snapshot, "full_count": plan.full_count}
    if plan.grid is not None:
        snapshot["grid"] = plan.grid.model_dump(mode="json")
        snapshot["repeat_key"] = sweep_plan.repeat_key(
            world.snapshot, spec.protocol, spec.fidelity, plan.grid
        )
    if plan.kernel is not None:
        # A sample may name no widths, and those of a density change as it grows.
        snapshot["drawn_with"] = plan.kernel.model_dump(mode="json")
    wish = spec.model_dump(mode="json", exclude={"poses"}, exclude_none=True)
    if plan.grid is not None:
        wish["grid"] = (spec.grid or GridSpec()).model_dump(mode="json", exclude_none=True)

    def store(tx: Tx) -> Created:
        locked = require(tx, slug, lock=True)
        if not world.still_holds(locked):
            raise conflict("object-changed", f"Object {slug!r} was changed at the same moment: send it again")
        waiting = locked.parts_sha256 is None
        if waiting:
            decompositions.ask(tx, locked, created_ms)
        sweep_id = _new_id(created_ms)
        provenance_id = provenances.ensure(
            tx, locked.id, Provenance(spec.gripper, "simulation", spec.protocol)
        )
        sweeps.create(
            tx,
            sweep_id=sweep_id,
            object_id=locked.id,
            provenance_id=provenance_id,
            gripper=spec.gripper,
            protocol=spec.protocol,
            fidelity=spec.fidelity,
            purpose=spec.purpose,
            plan=plan.kind,
            request=wish,
            snapshot=snapshot,
            poses=plan.poses,
            pose_count=plan.count,
            chunk_poses=chunk,
            capability="simulate" if spec.protocol == "wrench" else spec.protocol,
            job_ids=numbers,
            waiting=waiting,
        )
        if waiting:
            # Until there are parts, it repeats no other's poses.
            snapshot["repeat_key"] = sweep_id
        _, batch = batches.create(tx, locked.id, revision=locked.revision, sweep_id=sweep_id)
        sweeps.keep_snapshot(tx, sweep_id, {**snapshot, "batch": batch})
        info = _info(tx, _require(tx, sweep_id))
        return Created(info.model_dump(mode="json"), f"/sweeps/{sweep_id}", status=202, batch_key=batch)

    return replay_or(ctx.database, scope=scope, key=key, request=request, create=store)


def _new_id(created_ms: int) -> str:
    """A UUID of version 7 (RFC 9562): sweeps sort by their creation."""
    random = uuid.uuid4().int
    return str(
        uuid.UUID(int=(created_ms << 80) | (7 << 76) | (random & ((1 << 76) - 1) & ~(3 << 62)) | (2 << 62))
    )


# --- checks before anything is simulated ----------------------------------------------------------------


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
        "gripper": profile.model_dump(mode="json"),
        "lower": lower.tolist(),
        "upper": upper.tolist(),
    }
    if snapshot["mass_kg"] is None:
        snapshot["density_kg_m3"] = row.density_kg_m3
    return _World(row, snapshot, profile)


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


def _plan(ctx: Estimators, slug: str, spec: SweepCreate, world: _World) -> _Plan:
    if spec.poses is not None:
        return _given(ctx, spec.poses)
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


def _given(ctx: Estimators, poses: Any) -> _Plan:
    if isinstance(poses, PoseColumns):
        position, quaternion = poses.position, poses.quaternion_xyzw
    else:
        position = [pose.position for pose in poses]
        quaternion = [pose.quaternion_xyzw for pose in poses]
    limit = min(ctx.settings.max_samples, ctx.settings.max_sweep_poses)
    if len(position) > limit:
        raise invalid("poses", f"{len(position)} are more than {limit}: make several sweeps of them")
    table = np.full((len(position), POSE_COLUMNS), np.nan)
    table[:, :3] = position
    table[:, 3:7] = quaternion
    return _Plan("poses", len(table), poses=table)


def _drawn(ctx: Estimators, slug: str, spec: SweepCreate, sample: SampleSpec) -> _Plan:
    limit = min(ctx.settings.max_samples, ctx.settings.max_sweep_poses)
    if sample.count > limit:
        raise invalid("sample.count", f"at most {limit}")
    selection = Selection(gripper=spec.gripper, protocol=sample.protocol, kernel=sample.kernel)
    drawn = likelihood.draw(ctx, slug, selection, sample.count, sample.seed)
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
    if plan.count > size * MAX_CHUNKS:
        raise invalid(
            "chunk_poses",
            f"{plan.count} poses in chunks of {size} are more than {MAX_CHUNKS} chunks:"
            f" take at least {-(-plan.count // MAX_CHUNKS)}",
        )
    return size


# --- following, stopping, repeating ---------------------------------------------------------------------


def _require(tx: Tx, sweep_id: str) -> SweepRow:
    row = sweeps.find(tx, sweep_id) if len(sweep_id) == 36 and sweep_id.isascii() else None
    if row is None:
        raise not_found("sweep", sweep_id[:80], "GET /sweeps lists them")
    return row


def get(ctx: Estimators, sweep_id: str) -> SweepInfo:
    """A sweep and how far it has come."""
    with ctx.database.read() as tx:
        return _info(tx, _require(tx, sweep_id))


def listing(
    ctx: Estimators, *, slug: str | None, state: str | None, cursor: str | None, limit: int
) -> tuple[list[SweepInfo], str | None]:
    """A page of sweeps, the newest first, and the cursor of the next one."""
    with ctx.database.read() as tx:
        object_id = None if slug is None else require(tx, slug).id
        rows = sweeps.listing(tx, object_id=object_id, state=state, before=cursor, limit=limit + 1)
        page = [_info(tx, row) for row in rows[:limit]]
    return page, page[-1].id if len(rows) > limit else None


def cancel(ctx: Estimators, sweep_id: str) -> SweepInfo:
    """Stop what is not finished; what is stored stays. A finished sweep is left as it is."""
    with ctx.database.read() as tx:
        row = _require(tx, sweep_id)
    with ctx.database.write() as tx:
        sweeps.lock_object(tx, row.object_id)
        sweeps.cancel(tx, sweep_id)
        decompositions.drop_unwanted(tx, row.object_id)
        return _info(tx, _require(tx, sweep_id))


def retry(ctx: Estimators, sweep_id: str) -> SweepInfo:
    """Queue failed and cancelled chunks again; without any it changes nothing.

    409 if the batch was deleted: what the sweep had found is gone, so the rest would mislead.
    """
    with ctx.database.read() as tx:
        row = _require(tx, sweep_id)
    with ctx.database.write() as tx:
        sweeps.lock_object(tx, row.object_id)
        row = _require(tx, sweep_id)
        if row.batch is None:
            raise conflict("batch-deleted", "This sweep's batch was deleted: make a new sweep")
        waiting = False
        if row.finished_at is not None and decompositions.lacks_parts(row):
            waiting = decompositions.again(tx, require(tx, row.object), row, time.time_ns() // 1_000_000)
        sweeps.retry(tx, sweep_id, waiting=waiting)
        return _info(tx, _require(tx, sweep_id))


def _info(tx: Tx, row: SweepRow) -> SweepInfo:
    done = sweeps.progress(tx, row)
    state = sweeps.state_of(row, done.states.get(JobState.FAILED, 0))
    rate = _rate(row, done)
    left = row.pose_count - done.poses_done
    grid = row.request.get("grid")
    sample = row.request.get("sample")
    return SweepInfo(
        id=row.id,
        object=row.object,
        batch=row.snapshot["batch"],
        gripper=row.gripper,
        protocol=row.protocol,
        fidelity=row.fidelity,
        purpose=row.purpose,
        plan=row.plan,
        grid=None if grid is None else GridSpec.model_validate(grid),
        seed=(grid or sample or {}).get("seed"),
        state=state,
        chunks=row.chunks,
        chunks_done=done.states.get(JobState.DONE, 0),
        chunks_failed=done.states.get(JobState.FAILED, 0),
        poses=row.pose_count,
        poses_done=done.poses_done,
        full_grid_poses=row.snapshot.get("full_count"),
        waiting_for=decompositions.waiting_for(tx, row),
        outcomes={name: done.counts[name] for name in OUTCOMES if name in done.counts},
        rate_poses_s=rate,
        time_left_s=left / rate if rate and state == SweepState.RUNNING else None,
        failed_chunks=[
            FailedChunk(chunk=number, attempts=attempts, error=error)
            for number, attempts, error in done.failed
        ],
        created_at=row.created_at,
        started_at=row.started_at,
        finished_at=row.finished_at,
    )


def _rate(row: SweepRow, done: Progress) -> float | None:
    """Poses a second: of late while it runs, over the whole run afterwards."""
    if row.finished_at is not None:
        if row.started_at is None or not done.poses_done:
            return None
        return done.poses_done / max((row.finished_at - row.started_at).total_seconds(), 1e-3)
    return done.recent_poses / done.window_s if done.recent_poses else None


@dataclass(frozen=True, eq=False)
class OutcomePage:
    """Poses (n,) of a sweep's plan with their outcome codes (uint8), and where the next page starts."""

    sweep: str
    pose_index: npt.NDArray[np.int64]
    position: npt.NDArray[np.float64]
    quaternion_xyzw: npt.NDArray[np.float64]
    codes: npt.NDArray[np.uint8]
    next: str | None


def outcomes(ctx: Estimators, sweep_id: str, *, limit: int, cursor: str | None) -> OutcomePage:
    """Every pose of finished chunks, in the plan's order.

    While a sweep runs, a page has the chunks that are finished by then: read it again at the end.
    """
    number, skip = 0, 0
    if cursor is not None:
        match = _CURSOR.fullmatch(cursor)
        if match is None:
            raise invalid("cursor", "take it from `next` of the page before")
        number, skip = int(match[1]), int(match[2])
    with ctx.database.read() as tx:
        row = _require(tx, sweep_id)
        # One pose more than asked for tells whether there is another page.
        chunks = packed.page(tx, sweep_id, first_number=number, poses=limit + skip + 1)
        stored = {chunk.number: sweep_plan.chunk_poses(tx, row, chunk.start, chunk.stop) for chunk in chunks}
    grid = sweep_plan.grid_of(row) if row.plan == "grid" else None
    index, position = [np.empty(0, dtype=np.int64)], [np.empty((0, 3))]
    quaternion, codes = [np.empty((0, 4))], [np.empty(0, dtype=np.uint8)]
    following = None
    for chunk in chunks:
        first = skip if chunk.number == number else 0
        last = min(chunk.stop - chunk.start, first + limit)
        if limit == 0:
            following = f"{chunk.number}.{first}"
            break
        if first >= last:
            continue
        poses = stored[chunk.number]
        if poses is None:
            assert grid is not None
            poses = sweep_plan.grid_poses(grid, chunk.start, chunk.stop)
        part = slice(first, last)
        index.append(poses.pose_index[part])
        position.append(poses.position[part])
        quaternion.append(poses.quaternion_xyzw[part])
        codes.append(np.frombuffer(chunk.outcomes, dtype=np.uint8)[part])
        limit -= last - first
        if last < chunk.stop - chunk.start:
            following = f"{chunk.number}.{last}"
            break
    return OutcomePage(
        sweep_id,
        np.concatenate(index),
        np.concatenate(position),
        np.concatenate(quaternion),
        np.concatenate(codes),
        following,
    )


def stream_outcomes(ctx: Estimators, sweep_id: str, *, cursor: str | None) -> Iterator[bytes]:
    """All poses of finished chunks from a cursor on, as an Arrow IPC stream."""
    page = outcomes(ctx, sweep_id, limit=STREAM_POSES, cursor=cursor)

    def batches(page: OutcomePage) -> Iterator[Any]:
        while True:
            if len(page.codes):
                yield _arrow_batch(page)
            if page.next is None:
                return
            page = outcomes(ctx, sweep_id, limit=STREAM_POSES, cursor=page.next)

    return arrow.stream(_arrow_schema({"sweep": sweep_id, "next": None}), batches(page))


def arrow_page(page: OutcomePage, following: str | None) -> Iterator[bytes]:
    """One page as an Arrow IPC stream; its cursor is in the schema's metadata."""
    schema = _arrow_schema({"sweep": page.sweep, "next": following})
    return arrow.stream(schema, [_arrow_batch(page)])


def _arrow_schema(told: dict[str, Any]) -> Any:
    pa = arrow.library()
    return arrow.schema_of(
        [
            ("pose_index", pa.int64()),
            ("position", arrow.vector_type(3)),
            ("quaternion_xyzw", arrow.vector_type(4)),
            ("outcome", arrow.outcome_type()),
        ],
        told,
    )


def _arrow_batch(page: OutcomePage) -> Any:
    """A page as a record batch."""
    pa = arrow.library()
    return pa.record_batch(
        [
            pa.array(page.pose_index),
            arrow.vectors(page.position, 3),
            arrow.vectors(page.quaternion_xyzw, 4),
            arrow.outcome_names(page.codes),
        ],
        schema=_arrow_schema({}),
    )
