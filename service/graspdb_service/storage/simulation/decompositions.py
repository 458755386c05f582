"""Decompositions: the one job of an object that makes its convex parts, and the chunks that wait for it.

All of them are called under the object's lock, :func:`find` and :func:`source_of` excepted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import and_, delete, insert, select, update

from graspdb.wire.states import JobState
from graspdb_service.storage.database import Tx, first_as, unix_now
from graspdb_service.storage.simulation.jobs import AFRESH, COLUMNS, JobRow
from graspdb_service.storage.tables import jobs, objects


@dataclass(frozen=True)
class Source:
    """The object of a decomposition, and its mesh as :class:`graspdb.wire.MeshInfo` has it."""

    slug: str
    mesh_info: dict[str, Any] | None


def find(tx: Tx, object_id: int) -> JobRow | None:
    """The object's decomposition, whatever became of it."""
    query = select(*COLUMNS).where(jobs.c.object_id == object_id, jobs.c.kind == "decompose")
    return first_as(tx, query, JobRow)


def source_of(tx: Tx, object_id: int) -> Source | None:
    """What a decomposition is made from."""
    return first_as(tx, select(objects.c.slug, objects.c.mesh_info).where(objects.c.id == object_id), Source)


def ask(tx: Tx, object_id: int, job_id: str) -> None:
    """Queue the object's decomposition, anew where it failed or was cancelled; an open one is left alone."""
    found = find(tx, object_id)
    fresh = {**AFRESH, "state": JobState.QUEUED}
    if found is None:
        fixed = {"kind": "decompose", "capability": "decompose", "number": 0, "start": 0, "stop": 0}
        tx.execute(insert(jobs).values(id=job_id, object_id=object_id, **fixed, **fresh))
    elif found.state in (JobState.FAILED, JobState.CANCELLED):
        tx.execute(update(jobs).where(jobs.c.id == found.id).values(**fresh))


def waiting_sweeps(tx: Tx, object_id: int) -> list[str]:
    """Sweeps with chunks that wait for the object's parts."""
    query = (
        select(jobs.c.sweep_id)
        .where(jobs.c.object_id == object_id, jobs.c.state == JobState.WAITING)
        .distinct()
    )
    return sorted(tx.scalars(query))


def release(tx: Tx, object_id: int) -> None:
    """Let workers claim the chunks that have waited."""
    tx.execute(_waiting(object_id).values(state=JobState.QUEUED))


def fail_waiting(tx: Tx, object_id: int, error: str) -> None:
    """Fail the chunks that have waited."""
    tx.execute(_waiting(object_id).values(state=JobState.FAILED, error=error, completed_at=unix_now()))


def _waiting(object_id: int) -> Any:
    return update(jobs).where(and_(jobs.c.object_id == object_id, jobs.c.state == JobState.WAITING))


def cancel(tx: Tx, object_id: int) -> None:
    """End the object's decomposition if it is open."""
    # The lease stays, so that its holder is told to stop rather than that the lease is lost.
    tx.execute(
        update(jobs)
        .where(
            jobs.c.object_id == object_id,
            jobs.c.kind == "decompose",
            jobs.c.state.in_((JobState.QUEUED, JobState.LEASED)),
        )
        .values(state=JobState.CANCELLED, completed_at=unix_now())
    )


def forget(tx: Tx, object_id: int) -> None:
    """Delete the object's decomposition, whatever became of it: its mesh is another."""
    tx.execute(delete(jobs).where(jobs.c.object_id == object_id, jobs.c.kind == "decompose"))
