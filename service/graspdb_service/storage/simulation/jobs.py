"""The queue that workers pull from: claiming under a lease, fencing, ending what keeps failing.

A job's lease id is fresh for every claim and is the only fence: a worker's name proves nothing, for a
stalled worker comes back under the same one. Whether a lease has run out is judged when somebody claims, by
the database's clock, so no replica sweeps up after the others.

Locks are taken in one order everywhere: object, jobs, sweep, batch, worker. Claiming skips locked jobs and
takes no object's lock, so workers never wait for one another.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Select, String, and_, exists, func, or_, select, update
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import GenericFunction

from graspdb.wire import WorkerInfo
from graspdb.wire.states import JobState
from graspdb_service.storage.database import Tx, all_as, begins_with, first_as, insert_or, unix_now
from graspdb_service.storage.tables import jobs, objects, workers

OPEN = (JobState.WAITING, JobState.QUEUED, JobState.LEASED)
"""States of a job that is still to be done."""

CLOCK_SLACK_S = 3600.0
"""Leases that end later than any granted now could, by more than this, are from before the database's clock
was set back: without their workers they would last until it has caught up."""

STALE_LEASE_ERROR = (
    "the lease ran out {attempts} times: the job stalls or kills its worker"
    " (out of memory, a crash of the physics engine)"
)


class fresh_id(GenericFunction[str]):
    """A random identifier for every row of a statement."""

    type = String()
    inherit_cache = True


@compiles(fresh_id, "sqlite")
def _sqlite_fresh_id(element: fresh_id, compiler: Any, **_: Any) -> str:
    return "lower(hex(randomblob(16)))"


@compiles(fresh_id, "postgresql")
def _postgres_fresh_id(element: fresh_id, compiler: Any, **_: Any) -> str:
    return "replace(gen_random_uuid()::text, '-', '')"


@dataclass(frozen=True)
class JobRow:
    """A job as stored; ``attempts`` counts its leases, times are seconds since 1970 by its clock."""

    id: str
    kind: str
    object_id: int
    sweep_id: str | None
    number: int
    start: int
    stop: int
    state: str
    attempts: int
    lease_id: str | None
    lease_expires_at: float | None
    worker: str | None
    result_sha256: str | None
    answer: dict[str, Any] | None
    progress: str | None
    error: str | None


COLUMNS = [jobs.c[name] for name in JobRow.__dataclass_fields__]
UNLEASED = {"lease_id": None, "lease_expires_at": None, "worker": None}
AFRESH = {**UNLEASED, "attempts": 0, "progress": None, "error": None, "completed_at": None}
"""A job to be done with all its attempts, whatever became of it before."""


def job_ids(created_ms: int, count: int, *, urgent: bool) -> list[str]:
    """Identifiers that sort in the order in which jobs are to be claimed: urgency, creation, number.

    UUIDs of version 8 (RFC 9562): one bit of urgency and 47 of the creation time in milliseconds, 12 random
    bits, 30 of the number, 32 random bits. Somebody waits for a check, so it goes before a running grid.
    """
    salt = uuid.uuid4().int
    head = ((0 if urgent else 1) << 47) | (created_ms & (2**47 - 1))
    start = (head << 80) | (8 << 76) | ((salt & 0xFFF) << 64) | (2 << 62)
    return [
        str(uuid.UUID(int=start | (number << 32) | (uuid.uuid4().int & 0xFFFFFFFF)))
        for number in range(count)
    ]


def find(tx: Tx, job_id: str) -> JobRow | None:
    """The job with this id."""
    return first_as(tx, select(*COLUMNS).where(jobs.c.id == job_id), JobRow)


def _held(job_id: str, lease_id: str | None) -> ColumnElement[bool]:
    """Whether the lease is still its job's, run out or not."""
    return and_(jobs.c.id == job_id, jobs.c.lease_id == lease_id, jobs.c.state == JobState.LEASED)


def _ran_out(lease_s: float) -> ColumnElement[bool]:
    """Whether a job's lease has run out; one of a clock that has been set back has, too."""
    ends = jobs.c.lease_expires_at
    return and_(
        jobs.c.state == JobState.LEASED,
        or_(ends < unix_now(), ends > unix_now() + lease_s + CLOCK_SLACK_S),
    )


def _claimable(
    capabilities: Sequence[str], lease_s: float, max_attempts: int, prefix: str
) -> ColumnElement[bool]:
    # The states are named once more so that both databases search the index on (state, capability).
    ran_out = and_(_ran_out(lease_s), jobs.c.attempts < max_attempts)
    return and_(
        jobs.c.state.in_([JobState.QUEUED, JobState.LEASED]),
        jobs.c.capability.in_(capabilities),
        # Engines stand among what a worker can do.
        or_(jobs.c.engine.is_(None), jobs.c.engine.in_(capabilities)),
        or_(jobs.c.state == JobState.QUEUED, ran_out),
        *(_of_objects(prefix) if prefix else ()),
    )


def _of_objects(prefix: str) -> tuple[ColumnElement[bool]]:
    """Whether a job is of an object whose slug begins so."""
    own = select(objects.c.id).where(begins_with(objects.c.slug, prefix))
    return (jobs.c.object_id.in_(own),)


def any_claimable(
    tx: Tx, capabilities: Sequence[str], *, lease_s: float, max_attempts: int, prefix: str
) -> bool:
    """Whether a claim would get anything: lets an idle worker ask without a write lock."""
    query = select(exists().where(_claimable(capabilities, lease_s, max_attempts, prefix)))
    return bool(tx.scalar(query))


def claim(
    tx: Tx,
    *,
    worker: str,
    capabilities: Sequence[str],
    limit: int,
    lease_s: float,
    max_attempts: int,
    prefix: str = "",
) -> list[JobRow]:
    """Lease up to ``limit`` jobs to a worker, first those that sort first, of objects whose slugs begin so.

    One statement on both databases: PostgreSQL skips what others are just claiming, on SQLite the
    transaction is alone (BEGIN IMMEDIATE). PostgreSQL never inlines a CTE that locks rows, so the limit
    holds.
    """
    chosen: Select[tuple[str]] = (
        select(jobs.c.id)
        .where(_claimable(capabilities, lease_s, max_attempts, prefix))
        .order_by(jobs.c.id)
        .limit(limit)
        .with_for_update(skip_locked=True)
    )
    statement = (
        update(jobs)
        .where(jobs.c.id.in_(select(chosen.cte("chosen").c.id)))
        .values(
            state=JobState.LEASED,
            attempts=jobs.c.attempts + 1,
            lease_id=fresh_id(),
            lease_expires_at=unix_now() + lease_s,
            worker=worker,
            progress=None,
        )
        .returning(*COLUMNS)
    )
    return sorted(all_as(tx, statement, JobRow), key=lambda job: job.id)


def renew(tx: Tx, job_id: str, lease_id: str, lease_s: float, *, progress: str | None = None) -> float | None:
    """Extend a lease that is still its job's, even one that has run out; when it then ends, or None."""
    news = {} if progress is None else {"progress": progress}
    statement = (
        update(jobs)
        .where(_held(job_id, lease_id))
        .values(lease_expires_at=unix_now() + lease_s, **news)
        .returning(jobs.c.lease_expires_at)
    )
    ends: float | None = tx.scalar(statement)
    return ends


def release(tx: Tx, job_id: str, lease_id: str) -> bool:
    """Give a leased job back; a worker's orderly end counts as no lease. False if the lease is lost."""
    values = {**UNLEASED, "state": JobState.QUEUED, "attempts": jobs.c.attempts - 1}
    return tx.execute(update(jobs).where(_held(job_id, lease_id)).values(values)).rowcount == 1


def complete(
    tx: Tx, job_id: str, lease_id: str, *, sha256: str, answer: Mapping[str, Any], counts: Mapping[str, Any]
) -> bool:
    """Mark a job done if the lease is still its own, run out or not. False if it is lost."""
    statement = (
        update(jobs)
        .where(_held(job_id, lease_id))
        .values(
            state=JobState.DONE,
            result_sha256=sha256,
            answer=dict(answer),
            counts=dict(counts),
            error=None,
            completed_at=unix_now(),
        )
    )
    return tx.execute(statement).rowcount == 1


def fail(tx: Tx, job_id: str, lease_id: str, *, error: str, max_attempts: int) -> JobState | None:
    """Record a failure: queued again, or failed for good after the last lease; None if the lease is lost.

    The job keeps the lease id, so that the same report sent again is recognised.
    """
    held = _held(job_id, lease_id)
    ended = tx.execute(
        update(jobs)
        .where(held, jobs.c.attempts >= max_attempts)
        .values(state=JobState.FAILED, error=error, completed_at=unix_now())
    )
    if ended.rowcount == 1:
        return JobState.FAILED
    again = tx.execute(
        update(jobs).where(held).values(state=JobState.QUEUED, error=error, lease_expires_at=None)
    )
    return JobState.QUEUED if again.rowcount == 1 else None


def exhausted(tx: Tx, *, lease_s: float, max_attempts: int) -> list[JobRow]:
    """Jobs whose last allowed lease has run out."""
    query = select(*COLUMNS).where(_ran_out(lease_s), jobs.c.attempts >= max_attempts)
    return all_as(tx, query, JobRow)


def expire(tx: Tx, job: JobRow, *, lease_s: float) -> bool:
    """Fail a job found by :func:`exhausted`, unless its worker came back meanwhile."""
    statement = (
        update(jobs)
        .where(_held(job.id, job.lease_id), _ran_out(lease_s))
        .values(
            state=JobState.FAILED,
            error=job.error or STALE_LEASE_ERROR.format(attempts=job.attempts),
            completed_at=unix_now(),
        )
    )
    return tx.execute(statement).rowcount == 1


def see_worker(tx: Tx, name: str, capabilities: Sequence[str]) -> None:
    """Register a worker, or note that it is still there."""
    statement = insert_or(tx, workers).values(
        name=name, capabilities=list(capabilities), last_seen=unix_now(), jobs_done=0, poses_done=0
    )
    news = {"capabilities": statement.excluded.capabilities, "last_seen": statement.excluded.last_seen}
    tx.execute(statement.on_conflict_do_update(index_elements=[workers.c.name], set_=news))


def credit_worker(tx: Tx, name: str | None, poses: int) -> None:
    """Count a finished job for its worker."""
    tx.execute(
        update(workers)
        .where(workers.c.name == name)
        .values(
            jobs_done=workers.c.jobs_done + 1, poses_done=workers.c.poses_done + poses, last_seen=unix_now()
        )
    )


def worker_age(tx: Tx, name: str) -> float | None:
    """Seconds since a worker was last seen; None for an unknown one."""
    return tx.scalar(select(unix_now() - workers.c.last_seen).where(workers.c.name == name))


def someone_has(tx: Tx, capability: str, *, within_s: float) -> bool:
    """Whether a worker that has this capability asked for jobs lately, or is at one."""
    at_work = exists().where(jobs.c.state == JobState.LEASED, jobs.c.worker == workers.c.name)
    query = select(workers.c.capabilities).where(or_(workers.c.last_seen > unix_now() - within_s, at_work))
    return any(capability in capabilities for capabilities in tx.scalars(query))


def list_workers(tx: Tx, *, skip: int, limit: int) -> list[WorkerInfo]:
    """Workers by name."""
    leased = (
        select(func.count())
        .select_from(jobs)
        .where(jobs.c.state == JobState.LEASED, jobs.c.worker == workers.c.name)
        .scalar_subquery()
    )
    query = (
        select(
            workers.c.name.label("worker"),
            workers.c.capabilities,
            workers.c.last_seen,
            leased.label("jobs_leased"),
            workers.c.jobs_done,
            workers.c.poses_done,
        )
        .order_by(workers.c.name)
        .limit(limit)
        .offset(skip)
    )
    return all_as(tx, query, WorkerInfo)
