"""Jobs: hand them out under leases, and take results in, each once."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt

from graspdb.wire import (
    OUTCOME_CODES,
    OUTCOMES,
    ClaimedJob,
    ClaimRequest,
    ClaimResponse,
    DecomposePayload,
    FailureReport,
    GridPlan,
    LeaseRenewed,
    PosePlan,
    ResultAccepted,
    SimulatePayload,
    SimulateResult,
    WorkerInfo,
)
from graspdb.wire.jobs import FailureNoted
from graspdb.wire.states import JobState
from graspdb_service.problems import ProblemError, conflict, invalid, not_found
from graspdb_service.storage import objects
from graspdb_service.storage.database import Tx
from graspdb_service.storage.simulation import jobs, sweeps
from graspdb_service.storage.simulation import outcomes as packed
from graspdb_service.storage.simulation.jobs import JobRow
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.storage.trials import batches, provenances
from graspdb_service.storage.trials import rows as trial_rows
from graspdb_service.trial_columns import TrialColumns
from graspdb_service.usecases.geometry import decompositions, meshes
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime.runtime import Runtime
from graspdb_service.usecases.trials import sweep_plan
from graspdb_service.usecases.trials.sweep_plan import ChunkPoses

#: An idle worker that asks again and again is noted this often, so that asking takes no write lock.
WORKER_NOTED_EVERY_S = 10.0
#: Sweeps over the same grid that finish chunks at the same moment make one another look again.
_MAX_LOOKS = 50

_SUCCESS = OUTCOME_CODES["success"]
_COLLISION = OUTCOME_CODES["collision"]


class WrongResult(Exception):
    """A result of another kind than the job's."""

    def __init__(self, kind: str) -> None:
        super().__init__(kind)
        self.kind = kind


class _LostLease(Exception):
    """Leave the transaction: nothing of it may stay."""


class _Overtaken(Exception):
    """Another sweep over the same grid has finished a chunk since its chunks were read."""


def claim(ctx: Runtime, request: ClaimRequest) -> ClaimResponse:
    """Lease jobs to a worker and register it; 422 if it names no capability."""
    settings = ctx.settings
    capabilities = sorted(set(request.capabilities))
    if not capabilities:
        raise invalid("capabilities", "name at least one, such as simulate")
    with ctx.database.read() as tx:
        exhausted = jobs.exhausted(tx, settings.max_attempts)
        age = jobs.worker_age(tx, request.worker)
        work = jobs.any_claimable(tx, capabilities, settings.max_attempts)
    for job in exhausted:
        _end(ctx, job)
    if not work and age is not None and age < WORKER_NOTED_EVERY_S:
        return ClaimResponse(jobs=[], retry_after_s=settings.retry_after_s)
    with ctx.database.write() as tx:
        claimed = jobs.claim(
            tx,
            worker=request.worker,
            capabilities=capabilities,
            limit=request.limit,
            lease_s=settings.lease_s,
            max_attempts=settings.max_attempts,
        )
        ids = sorted({job.sweep_id for job in claimed if job.sweep_id is not None})
        if ids:
            sweeps.note_started(tx, ids)
        jobs.see_worker(tx, request.worker, capabilities)
        rows = sweeps.find_many(tx, ids)
        stored = {
            job.id: sweep_plan.chunk_poses(tx, rows[job.sweep_id], job.start, job.stop)
            for job in claimed
            if job.sweep_id is not None
        }
        payloads = {job.id: decompositions.payload(tx, job) for job in claimed if job.kind == "decompose"}
    answers = []
    for job in claimed:
        payload: SimulatePayload | DecomposePayload | None
        if job.sweep_id is None:
            payload = payloads[job.id]
        else:
            payload = _payload(rows[job.sweep_id], job, stored[job.id])
        if payload is not None:
            answer = ClaimedJob(
                id=job.id,
                kind="decompose" if job.sweep_id is None else "simulate",
                lease_id=job.lease_id or "",
                lease_expires_at=_time(job.lease_expires_at),
                lease_s=settings.lease_s,
                payload=payload,
            )
            answers.append(answer)
    return ClaimResponse(jobs=answers, retry_after_s=0.0 if answers else settings.retry_after_s)


def _payload(sweep: SweepRow, job: JobRow, stored: ChunkPoses | None) -> SimulatePayload:
    world = sweep.snapshot["world"]
    return SimulatePayload(
        sweep=sweep.id,
        object=sweep.object,
        convex_parts=f"/objects/{sweep.object}/convex-parts",
        parts_sha256=world["parts_sha256"],
        mass_kg=world["mass_kg"],
        friction=world["friction"],
        gripper=world["gripper"],
        protocol=sweep.protocol,
        fidelity=sweep.fidelity,
        grid=None if stored is not None else GridPlan.model_validate(sweep.snapshot["grid"]),
        poses=None
        if stored is None
        else PosePlan(position=stored.position.tolist(), quaternion_xyzw=stored.quaternion_xyzw.tolist()),
        start=job.start,
        stop=job.stop,
    )


def _time(seconds: float | None) -> datetime:
    return datetime.fromtimestamp(seconds or 0.0, UTC)


def _end(ctx: Runtime, job: JobRow) -> None:
    """Fail a job whose last attempt has run out."""
    with ctx.database.write() as tx:
        sweeps.lock_object(tx, job.object_id)
        if jobs.end_exhausted(tx, job):
            _failed(tx, _found(jobs.find(tx, job.id), job.id))


def _failed(tx: Tx, job: JobRow) -> None:
    """What follows from a job that has failed for good."""
    if job.sweep_id is not None:
        sweeps.note_finished(tx, job.sweep_id)
    else:
        decompositions.fail_waiting(tx, job, job.error or "no reason given")


def renew(ctx: Runtime, job_id: str, lease_id: str, progress: str | None = None) -> LeaseRenewed:
    """Extend a lease, or tell its holder that the job is no longer wanted."""
    with ctx.database.write() as tx:
        ends = jobs.renew(tx, job_id, lease_id, ctx.settings.lease_s, progress=progress)
        job = None if ends is not None else jobs.find(tx, job_id)
    if ends is not None:
        return LeaseRenewed(lease_expires_at=_time(ends), lease_s=ctx.settings.lease_s)
    job = _found(job, job_id)
    if job.state == JobState.CANCELLED and job.lease_id == lease_id:
        return LeaseRenewed(lease_expires_at=_time(job.lease_expires_at), lease_s=0.0, cancel=True)
    raise _lost(job)


def release(ctx: Runtime, job_id: str, lease_id: str) -> None:
    """Give a job back, unfinished."""
    with ctx.database.write() as tx:
        if jobs.release(tx, job_id, lease_id):
            return
        job = jobs.find(tx, job_id)
    raise _lost(_found(job, job_id))


def fail(ctx: Runtime, job_id: str, lease_id: str, report: FailureReport) -> FailureNoted:
    """Record a failed attempt; after the last one the job is failed for good."""
    with ctx.database.read() as tx:
        job = _found(jobs.find(tx, job_id), job_id)
    with ctx.database.write() as tx:
        sweeps.lock_object(tx, job.object_id)
        attempts = 0 if report.permanent else ctx.settings.max_attempts
        state = jobs.fail(tx, job_id, lease_id, error=report.error, max_attempts=attempts)
        job = _found(jobs.find(tx, job_id), job_id)
        if state == JobState.FAILED:
            _failed(tx, job)
    # The same report once more, its answer having been lost.
    repeated = state is None and job.lease_id == lease_id and job.state in (JobState.QUEUED, JobState.FAILED)
    if state is None and not repeated:
        raise _lost(job)
    return FailureNoted(job=job_id, state=job.state, attempts=job.attempts)


def complete(ctx: Runtime, job_id: str, lease_id: str, body: bytes, result: SimulateResult) -> ResultAccepted:
    """Store a chunk's result in the transaction that completes its job.

    The same ``body`` under the same lease is answered the same again. 409 ``lease-lost``; 422 if the result
    does not fit the chunk: nothing is stored then.
    """
    sha256 = hashlib.sha256(body).hexdigest()
    for _ in range(_MAX_LOOKS):
        with ctx.database.read() as tx:
            job = _found(jobs.find(tx, job_id), job_id)
            if (earlier := _replay(job, lease_id, sha256)) is not None:
                return earlier
            if job.state != JobState.LEASED or job.lease_id != lease_id:
                raise _lost(job)
            if job.kind != "simulate":
                raise WrongResult(job.kind)
            sweep = sweeps.find(tx, job.sweep_id or "")
            if sweep is None:
                raise _lost(job)
            stored = sweep_plan.chunk_poses(tx, sweep, job.start, job.stop)
            twins = _twins(tx, sweep) if sweep.plan == "grid" and sweep.purpose == "collect" else {}
            ranges = packed.done_ranges(tx, list(twins))
            seen = packed.count_done(tx, list(twins))
        outcomes = _outcomes(result, job)
        if stored is None:
            grid = sweep_plan.grid_of(sweep)
            poses = sweep_plan.grid_poses(grid, job.start, job.stop)
            others = [(sweep_plan.grid_of(twin), ranges[twin.id]) for twin in twins.values()]
            fresh = sweep_plan.not_stored_yet(grid, job.start, job.stop, poses.pose_index, others)
        else:
            poses = stored
            fresh = np.ones(len(outcomes), dtype=np.bool_)
        chunk = _chunk(sweep, result, outcomes, poses, fresh)
        try:
            return _store(ctx, job, lease_id, sha256, sweep, chunk, list(twins), seen)
        except _Overtaken:
            continue
        except _LostLease:
            # By another claim, a cancellation, or this very request sent twice at once.
            with ctx.database.read() as tx:
                job = _found(jobs.find(tx, job_id), job_id)
            if (earlier := _replay(job, lease_id, sha256)) is not None:
                return earlier
            raise _lost(job) from None
    raise ProblemError(
        503,
        "busy",
        "Sweeps over the same grid keep overtaking this result; send it again",
        headers={"Retry-After": "1"},
    )


def complete_parts(ctx: Runtime, job_id: str, lease_id: str, body: bytes) -> ResultAccepted:
    """Store the convex parts that a worker made, in the transaction that completes its job.

    409 ``lease-lost``; 413 and 422 as for parts that a user sends: nothing is stored then.
    """
    sha256 = hashlib.sha256(body).hexdigest()
    with ctx.database.read() as tx:
        job = _found(jobs.find(tx, job_id), job_id)
        if (earlier := _replay(job, lease_id, sha256)) is not None:
            return earlier
        if job.kind != "decompose":
            raise WrongResult(job.kind)
        if job.state != JobState.LEASED or job.lease_id != lease_id:
            raise _lost(job)
        source = decompositions.source(tx, job)
        row = None if source is None else require(tx, source)
    if row is None:
        raise _lost(job)
    info = meshes.check_parts(ctx, row, body)
    try:
        with ctx.database.write() as tx:
            try:
                revision, _ = objects.advance(tx, row.id, append=False)
            except objects.ObjectGone:
                raise _LostLease from None
            locked = require(tx, row.slug)
            accepted = ResultAccepted(job=job.id, revision=revision, inserted=0)
            # The mesh can't have changed: it has sweeps.
            if locked.parts_sha256 is not None or not jobs.complete(
                tx, job.id, lease_id, sha256=sha256, answer=accepted.model_dump(), counts={}
            ):
                raise _LostLease
            meshes.store_parts(tx, locked, body, info)
            jobs.credit_worker(tx, job.worker, 0)
    except _LostLease:
        with ctx.database.read() as tx:
            job = _found(jobs.find(tx, job_id), job_id)
        if (earlier := _replay(job, lease_id, sha256)) is not None:
            return earlier
        raise _lost(job) from None
    return accepted


@dataclass(frozen=True)
class _Chunk:
    """A checked result: every outcome, and what of it is new to the object."""

    outcomes: npt.NDArray[np.uint8]
    rows: TrialColumns
    packed: dict[int, int]
    counts: dict[str, dict[str, int]]


def _twins(tx: Tx, sweep: SweepRow) -> dict[str, SweepRow]:
    key = sweep.snapshot["repeat_key"]
    return {other.id: other for other in sweeps.siblings(tx, sweep) if other.snapshot["repeat_key"] == key}


def _outcomes(result: SimulateResult, job: JobRow) -> npt.NDArray[np.uint8]:
    outcomes = np.frombuffer(result.outcomes, dtype=np.uint8)
    expected = job.stop - job.start
    if len(outcomes) != expected:
        raise invalid("outcomes", f"{expected} codes, one for every pose of the chunk, not {len(outcomes)}")
    unknown = np.flatnonzero(outcomes >= len(OUTCOMES))
    if unknown.size:
        at = int(unknown[0])
        raise invalid(
            "outcomes", f"{int(outcomes[at])} at place {at} is no outcome code (0 to {len(OUTCOMES) - 1})"
        )
    return outcomes


def _chunk(
    sweep: SweepRow,
    result: SimulateResult,
    outcomes: npt.NDArray[np.uint8],
    poses: ChunkPoses,
    fresh: npt.NDArray[np.bool_],
) -> _Chunk:
    rows = result.rows
    for name in ("width_m", "quality"):
        if len(getattr(rows, name)) != len(rows.pose_index):
            raise invalid(f"rows.{name}", f"as many values as pose_index has: {len(rows.pose_index)}")
    if rows.pose_index and max(rows.pose_index) > poses.pose_index[-1]:
        raise invalid("rows.pose_index", f"{max(rows.pose_index)} is no pose of this chunk")
    index = np.array(rows.pose_index, dtype=np.int64)
    if np.any(np.diff(index) <= 0):
        raise invalid("rows.pose_index", "must be ascending, each pose once")
    place = np.searchsorted(poses.pose_index, index)
    strange = np.flatnonzero(poses.pose_index[place] != index)
    if strange.size:
        raise invalid("rows.pose_index", f"{int(index[strange[0]])} is no pose of this chunk")
    if np.any(outcomes[place] == _COLLISION):
        raise invalid("rows.pose_index", "a pose that collides meets no physics: it must have no row")
    is_row = np.zeros(len(outcomes), dtype=np.bool_)
    is_row[place] = True
    if np.any((outcomes == _SUCCESS) & ~is_row):
        missing = int(poses.pose_index[np.flatnonzero((outcomes == _SUCCESS) & ~is_row)[0]])
        raise invalid("rows.pose_index", f"pose {missing} succeeded, so it must have a row")
    kept = place[fresh[place]]
    new = fresh[place]
    columns = TrialColumns(
        position=poses.position[kept],
        quaternion_xyzw=poses.quaternion_xyzw[kept],
        outcome=outcomes[kept],
        provenance=np.full(len(kept), sweep.provenance_id, dtype=np.int64),
        proposal_density=poses.proposal_density[kept],
        quality=_floats(rows.quality)[new],
        width_m=_floats(rows.width_m)[new],
        pose_index=index[new],
    )
    packed = {} if sweep.purpose == "check" else _count(outcomes[fresh & ~is_row])
    counts: dict[str, dict[str, int]] = {
        "all": {OUTCOMES[code]: number for code, number in _count(outcomes).items()},
        "packed": {str(code): number for code, number in packed.items()},
    }
    return _Chunk(outcomes, columns, packed, counts)


def _floats(values: list[float | None]) -> npt.NDArray[np.float64]:
    # None becomes NaN, which stands for "none" in the columns.
    return np.array(values, dtype=np.float64)


def _count(codes: npt.NDArray[np.uint8]) -> dict[int, int]:
    found, numbers = np.unique(codes, return_counts=True)
    return dict(zip(found.tolist(), numbers.tolist(), strict=True))


def _store(
    ctx: Runtime,
    job: JobRow,
    lease_id: str,
    sha256: str,
    sweep: SweepRow,
    chunk: _Chunk,
    twins: list[str],
    seen: int,
) -> ResultAccepted:
    collects = sweep.purpose == "collect"
    with ctx.database.write() as tx:
        rows = len(chunk.rows) if collects else 0
        try:
            if collects:
                revision, first_seq = objects.advance(tx, sweep.object_id, rows=rows, append=True)
            else:
                revision, first_seq = sweeps.lock_and_read_revision(tx, sweep.object_id), 0
        except objects.ObjectGone:
            raise _LostLease from None
        if twins and packed.count_done(tx, twins) != seen:
            raise _Overtaken
        accepted = ResultAccepted(job=job.id, revision=revision, inserted=rows)
        if not jobs.complete(
            tx, job.id, lease_id, sha256=sha256, answer=accepted.model_dump(), counts=chunk.counts
        ):
            raise _LostLease
        packed.store(
            tx,
            job_id=job.id,
            sweep_id=sweep.id,
            number=job.number,
            revision=revision,
            outcomes=chunk.outcomes.tobytes(),
        )
        sweeps.note_finished(tx, sweep.id)
        batch = batches.of_sweep(tx, sweep.id)
        if batch is None:
            raise _LostLease
        if collects:
            trial_rows.insert(
                tx, sweep.object_id, batch.id, chunk.rows, revision=revision, first_seq=first_seq
            )
            provenances.add_packed(tx, sweep.provenance_id, chunk.packed)
        batches.grow(
            tx,
            batch.id,
            first_seq=first_seq if rows else None,
            last_seq=first_seq + rows - 1 if rows else None,
            inserted=rows,
            packed=sum(chunk.packed.values()) if collects else len(chunk.outcomes),
            revision=revision if collects else None,
        )
        jobs.credit_worker(tx, job.worker, job.stop - job.start)
    return accepted


def _found(job: JobRow | None, job_id: str) -> JobRow:
    if job is None:
        raise not_found("job", job_id[:80], "its object may have been deleted")
    return job


def _replay(job: JobRow, lease_id: str, sha256: str) -> ResultAccepted | None:
    if job.state == JobState.DONE and job.lease_id == lease_id and job.result_sha256 == sha256:
        return ResultAccepted.model_validate(job.answer)
    return None


def _lost(job: JobRow) -> ProblemError:
    reason = {
        JobState.DONE: "it is done",
        JobState.CANCELLED: "its sweep was cancelled",
        JobState.FAILED: "it has failed for good",
        JobState.WAITING: "it waits for convex parts",
        JobState.QUEUED: "it was given back or failed, and waits for another claim",
        JobState.LEASED: "another claim has it",
    }[job.state]
    return conflict("lease-lost", f"This lease is no longer the job's: {reason}. Drop it and claim again")


def workers(ctx: Runtime, *, skip: int, limit: int) -> tuple[list[WorkerInfo], int | None]:
    """Every worker that ever asked for jobs, by name, and where the next page starts."""
    with ctx.database.read() as tx:
        rows = jobs.list_workers(tx, skip=skip, limit=limit + 1)
    items = [
        WorkerInfo(
            worker=row.name,
            capabilities=row.capabilities,
            last_seen=_time(row.last_seen),
            jobs_leased=row.jobs_leased,
            jobs_done=row.jobs_done,
            poses_done=row.poses_done,
        )
        for row in rows[:limit]
    ]
    return items, skip + limit if len(rows) > limit else None
