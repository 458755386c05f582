"""Leases: jobs handed out to workers, kept, given back and failed."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Any

from graspdb.wire import (
    ClaimedJob,
    ClaimRequest,
    ClaimResponse,
    FailureReport,
    LeaseRenewed,
    SimulatePayload,
    WorkerInfo,
)
from graspdb.wire.jobs import FailureNoted
from graspdb.wire.states import JobState
from graspdb_service import principal
from graspdb_service.problems import ProblemError, conflict, found
from graspdb_service.storage.database import Tx
from graspdb_service.storage.simulation import jobs, sweeps
from graspdb_service.storage.simulation.jobs import JobRow
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.usecases.geometry import decompositions
from graspdb_service.usecases.runtime.runtime import Runtime
from graspdb_service.usecases.trials import sweep_plan

#: An idle worker that asks again and again is noted this often, so that asking takes no write lock.
WORKER_NOTED_EVERY_S = 10.0


def claim(ctx: Runtime, request: ClaimRequest) -> ClaimResponse:
    """Lease jobs to a worker and register it."""
    settings, prefix = ctx.settings, principal.object_prefix()
    capabilities = sorted(set(request.capabilities))
    with ctx.database.read() as tx:
        exhausted = jobs.exhausted(tx, lease_s=settings.lease_s, max_attempts=settings.max_attempts)
        age = jobs.worker_age(tx, request.worker)
        work = jobs.any_claimable(
            tx,
            capabilities,
            lease_s=settings.lease_s,
            max_attempts=settings.max_attempts,
            prefix=prefix,
        )
    for job in exhausted:
        _expire(ctx, job)
    if not work and age is not None and 0.0 <= age < WORKER_NOTED_EVERY_S:
        return ClaimResponse(jobs=[], retry_after_s=settings.retry_after_s)
    with ctx.database.write() as tx:
        claimed = jobs.claim(
            tx,
            worker=request.worker,
            capabilities=capabilities,
            limit=request.limit,
            lease_s=settings.lease_s,
            max_attempts=settings.max_attempts,
            prefix=prefix,
        )
        ids = sorted({job.sweep_id for job in claimed if job.sweep_id is not None})
        if ids:
            sweeps.note_started(tx, ids)
        jobs.see_worker(tx, request.worker, capabilities)
        rows = sweeps.find_many(tx, ids)
        payloads = [
            decompositions.payload(tx, job) if job.sweep_id is None else _payload(tx, rows[job.sweep_id], job)
            for job in claimed
        ]
    answers = [
        ClaimedJob(
            id=job.id,
            kind="decompose" if job.sweep_id is None else "simulate",
            lease_id=job.lease_id or "",
            lease_expires_at=_time(job.lease_expires_at),
            lease_s=settings.lease_s,
            payload=payload,
        )
        for job, payload in zip(claimed, payloads, strict=True)
        if payload is not None
    ]
    return ClaimResponse(jobs=answers, retry_after_s=0.0 if answers else settings.retry_after_s)


def _payload(tx: Tx, sweep: SweepRow, job: JobRow) -> SimulatePayload:
    stored = sweep_plan.chunk_poses(tx, sweep, job.start, job.stop)
    plan: dict[str, Any] = {"grid": sweep.snapshot.get("grid")}
    if stored is not None:
        columns = {"position": stored.position.tolist(), "quaternion_xyzw": stored.quaternion_xyzw.tolist()}
        plan = {"poses": columns}
    return SimulatePayload.model_validate(
        {
            **sweep.snapshot["world"],
            **plan,
            "sweep": sweep.id,
            "object": sweep.object,
            "convex_parts": f"/objects/{sweep.object}/convex-parts",
            "protocol": sweep.protocol,
            "fidelity": sweep.fidelity,
            "engine": sweep.request.get("engine"),
            "randomise": sweep.request.get("randomise"),
            "start": job.start,
            "stop": job.stop,
        }
    )


def _time(seconds: float | None) -> datetime:
    return datetime.fromtimestamp(seconds or 0.0, timezone.utc)


def _expire(ctx: Runtime, job: JobRow) -> None:
    """Fail a job whose last lease has run out."""
    with ctx.database.write() as tx:
        sweeps.lock_object(tx, job.object_id)
        if jobs.expire(tx, job, lease_s=ctx.settings.lease_s):
            _failed(tx, require(jobs.find(tx, job.id), job.id))


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
    job = require(job, job_id)
    if job.state == JobState.CANCELLED and job.lease_id == lease_id:
        return LeaseRenewed(lease_expires_at=_time(job.lease_expires_at), lease_s=0.0, cancel=True)
    raise lost_lease(job)


def release(ctx: Runtime, job_id: str, lease_id: str) -> None:
    """Give a job back, unfinished."""
    with ctx.database.write() as tx:
        if jobs.release(tx, job_id, lease_id):
            return
        job = jobs.find(tx, job_id)
    raise lost_lease(require(job, job_id))


def fail(ctx: Runtime, job_id: str, lease_id: str, report: FailureReport) -> FailureNoted:
    """Record a failure; after the last lease the job is failed for good."""
    with ctx.database.read() as tx:
        job = require(jobs.find(tx, job_id), job_id)
    with ctx.database.write() as tx:
        sweeps.lock_object(tx, job.object_id)
        most = 0 if report.permanent else ctx.settings.max_attempts
        state = jobs.fail(tx, job_id, lease_id, error=report.error, max_attempts=most)
        job = require(jobs.find(tx, job_id), job_id)
        if state == JobState.FAILED:
            _failed(tx, job)
    # The same report once more, its answer having been lost.
    repeated = state is None and job.lease_id == lease_id and job.state in (JobState.QUEUED, JobState.FAILED)
    if state is None and not repeated:
        raise lost_lease(job)
    return FailureNoted(job=job_id, state=job.state, attempts=job.attempts)


def refuse_hidden(ctx: Runtime, job_id: str) -> None:
    """404 for a job of an object that who asks may not see."""
    if principal.object_prefix():
        with ctx.database.read() as tx:
            job = require(jobs.find(tx, job_id), job_id)
            source = decompositions.source(tx, job)
        require(job if principal.sees(source) else None, job_id)


def require(job: JobRow | None, job_id: str) -> JobRow:
    """The job, or a 404."""
    return found(job, "job", job_id, "its object may have been deleted")


def lost_lease(job: JobRow) -> ProblemError:
    """409 for whoever comes with a lease that is not the job's any more."""
    reason = {
        JobState.DONE: "it is done",
        JobState.CANCELLED: "its sweep was cancelled",
        JobState.FAILED: "it has failed for good",
        JobState.WAITING: "it waits for convex parts",
        JobState.QUEUED: "it was given back or failed, and waits for another claim",
        JobState.LEASED: "another claim has it",
    }[JobState(job.state)]
    return conflict("lease-lost", f"This lease is no longer the job's: {reason}. Drop it and claim again")


def workers(ctx: Runtime, *, skip: int, limit: int) -> tuple[list[WorkerInfo], int | None]:
    """Every worker that ever asked for jobs, by name, and where the next page starts."""
    with ctx.database.read() as tx:
        rows = jobs.list_workers(tx, skip=skip, limit=limit + 1)
    return rows[:limit], skip + limit if len(rows) > limit else None
