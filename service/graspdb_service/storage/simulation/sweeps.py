"""Sweeps: their plan and snapshot, and their jobs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from sqlalchemy import ColumnElement, Select, and_, exists, func, insert, not_, select, update

from graspdb.wire.states import JobState, SweepState
from graspdb.wire.sweeps import FailedChunk
from graspdb_service import principal
from graspdb_service.storage.database import Tx, all_as, begins_with, first_as, unix_now, utc_now
from graspdb_service.storage.simulation.jobs import AFRESH, OPEN
from graspdb_service.storage.tables import batches, jobs, objects, provenances, sweeps
from graspdb_service.trial_columns import Floats

#: float64 values of a stored pose: position, quaternion xyzw, proposal density (NaN where it has none).
POSE_COLUMNS = 8
_POSE_BYTES = 8 * POSE_COLUMNS
_JOBS_PER_INSERT = 10_000
#: How far back the rate looks, seconds.
_WINDOW_S = 120.0


@dataclass(frozen=True)
class SweepRow:
    """A sweep as it is stored. ``batch`` is null once its batch was deleted; ``linked`` is the sweep of the
    other engine over the same plan.
    """

    id: str
    object_id: int
    provenance_id: int
    gripper: str
    gripper_version: int
    protocol: str
    fidelity: str
    purpose: str
    plan: str
    request: dict[str, Any]
    snapshot: dict[str, Any]
    pose_count: int
    chunk_poses: int
    chunks: int
    cancelled: bool
    made_by: str | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    linked: str | None
    object: str
    batch_id: int | None
    batch: str | None

    @property
    def collects(self) -> bool:
        """Whether it stores trials."""
        return self.purpose == "collect"

    @property
    def enters(self) -> bool:
        """Whether what it finds enters estimates: as trials, or beside those of its linked sweep."""
        compared: bool = self.purpose == "compare" and self.request["purpose"] == "collect"
        return self.collects or compared


@dataclass(frozen=True)
class Progress:
    """What a sweep's jobs add up to. ``recent_poses`` were finished within the last ``window_s``."""

    states: dict[str, int]
    poses_done: int
    counts: dict[str, int]
    failed: list[FailedChunk]
    recent_poses: int
    window_s: float


_STORED = [
    sweeps.c[name]
    for name in SweepRow.__dataclass_fields__
    if name in sweeps.c  # the poses of a plan may be many megabytes: they are read by slices only
]


def _query() -> Select[Any]:
    return (
        select(
            *_STORED,
            objects.c.slug.label("object"),
            batches.c.id.label("batch_id"),
            batches.c.key.label("batch"),
            provenances.c.gripper_version,
        )
        .join(objects, objects.c.id == sweeps.c.object_id)
        .join(provenances, provenances.c.id == sweeps.c.provenance_id)
        .outerjoin(batches, batches.c.sweep_id == sweeps.c.id)
    )


def lock_object(tx: Tx, object_id: int) -> int | None:
    """Take the object's row lock: its revision, which stays as it is; None where it is gone."""
    query = select(objects.c.revision).where(objects.c.id == object_id).with_for_update(key_share=True)
    revision: int | None = tx.scalar(query)
    return revision


def create(
    tx: Tx,
    sweep: Mapping[str, Any],
    *,
    poses: Floats | None,
    capability: str,
    job_ids: Sequence[str],
    waiting: bool = False,
) -> None:
    """Store a sweep and queue its jobs, one for every ``chunk_poses`` poses of the plan.

    ``sweep`` is what :class:`SweepRow` has but for chunks, times, batch, the gripper's version and the
    object's slug. ``poses`` of a plan that is no grid are rows (pose_count, 8): position, quaternion xyzw and
    proposal density (NaN: none). ``waiting`` for the object's convex parts, jobs can't be claimed.
    """
    chunk_poses, pose_count = sweep["chunk_poses"], sweep["pose_count"]
    values = {
        **sweep,
        "poses": None if poses is None else np.ascontiguousarray(poses, dtype="<f8").tobytes(),
        "chunks": len(job_ids),
        "cancelled": False,
        "made_by": principal.actor().key,
        "created_at": utc_now(),
    }
    tx.execute(insert(sweeps).values(values))
    for first in range(0, len(job_ids), _JOBS_PER_INSERT):
        tx.execute(
            insert(jobs),
            [
                {
                    "id": job_id,
                    "kind": "simulate",
                    "capability": capability,
                    "engine": sweep["request"].get("engine"),
                    "object_id": sweep["object_id"],
                    "sweep_id": sweep["id"],
                    "number": number,
                    "start": number * chunk_poses,
                    "stop": min((number + 1) * chunk_poses, pose_count),
                    "state": JobState.WAITING if waiting else JobState.QUEUED,
                    "attempts": 0,
                }
                for number, job_id in enumerate(job_ids[first : first + _JOBS_PER_INSERT], first)
            ],
        )


def keep_snapshot(tx: Tx, sweep_id: str, snapshot: Mapping[str, Any]) -> None:
    """Complete the snapshot with what was not known when the sweep was stored."""
    tx.execute(update(sweeps).where(sweeps.c.id == sweep_id).values(snapshot=dict(snapshot)))


def find(tx: Tx, sweep_id: str) -> SweepRow | None:
    """The sweep with this id."""
    return first_as(tx, _query().where(sweeps.c.id == sweep_id), SweepRow)


def find_many(tx: Tx, sweep_ids: Sequence[str]) -> dict[str, SweepRow]:
    """The sweeps with these ids."""
    return {row.id: row for row in all_as(tx, _query().where(sweeps.c.id.in_(sweep_ids)), SweepRow)}


def state_of(sweep: SweepRow, failed_chunks: int) -> SweepState:
    """Where a sweep is."""
    if sweep.cancelled:
        return SweepState.CANCELLED
    if sweep.finished_at is not None:
        return SweepState.FAILED if failed_chunks else SweepState.DONE
    return SweepState.QUEUED if sweep.started_at is None else SweepState.RUNNING


def _in_state(state: str) -> ColumnElement[bool]:
    ended = and_(not_(sweeps.c.cancelled), sweeps.c.finished_at.is_not(None))
    going = and_(not_(sweeps.c.cancelled), sweeps.c.finished_at.is_(None))
    any_failed = exists().where(jobs.c.sweep_id == sweeps.c.id, jobs.c.state == JobState.FAILED)
    return {
        SweepState.CANCELLED: sweeps.c.cancelled,
        SweepState.FAILED: and_(ended, any_failed),
        SweepState.DONE: and_(ended, not_(any_failed)),
        SweepState.QUEUED: and_(going, sweeps.c.started_at.is_(None)),
        SweepState.RUNNING: and_(going, sweeps.c.started_at.is_not(None)),
    }[SweepState(state)]


def listing(
    tx: Tx, *, object_id: int | None, prefix: str, state: str | None, before: str | None, limit: int
) -> list[SweepRow]:
    """Sweeps of objects whose slugs begin so, the newest first; ``before`` is the id of the last one of the
    page before.
    """
    query = _query().order_by(sweeps.c.id.desc()).limit(limit)
    if prefix:
        query = query.where(begins_with(objects.c.slug, prefix))
    if object_id is not None:
        query = query.where(sweeps.c.object_id == object_id)
    if state is not None:
        query = query.where(_in_state(state))
    if before is not None:
        query = query.where(sweeps.c.id < before)
    return all_as(tx, query, SweepRow)


def progress(tx: Tx, sweep: SweepRow) -> Progress:
    """Chunks by state, outcomes of every finished one, and how fast the last ones went."""
    if sweep.started_at is None and sweep.finished_at is None:
        # Its chunks, maybe a hundred thousand, have nothing to tell.
        return Progress({}, 0, {}, [], 0, _WINDOW_S)
    totals = (
        select(jobs.c.state, func.count(), func.sum(jobs.c.stop - jobs.c.start))
        .where(jobs.c.sweep_id == sweep.id)
        .group_by(jobs.c.state)
    )
    found = {state: (int(count), int(poses)) for state, count, poses in tx.execute(totals)}
    counts: Counter[str] = Counter()
    done = select(jobs.c.counts).where(jobs.c.sweep_id == sweep.id, jobs.c.state == JobState.DONE)
    for stored in tx.scalars(done):
        counts.update(stored["all"])
    failed: list[FailedChunk] = []
    if JobState.FAILED in found:
        ended = (
            select(
                jobs.c.number.label("chunk"), jobs.c.attempts, func.coalesce(jobs.c.error, "").label("error")
            )
            .where(jobs.c.sweep_id == sweep.id, jobs.c.state == JobState.FAILED)
            .order_by(jobs.c.number)
            .limit(100)
        )
        failed = all_as(tx, ended, FailedChunk)
    recent = select(func.sum(jobs.c.stop - jobs.c.start), unix_now()).where(
        jobs.c.sweep_id == sweep.id,
        jobs.c.state == JobState.DONE,
        jobs.c.completed_at > unix_now() - _WINDOW_S,
    )
    recent_poses, now = tx.execute(recent).one()
    window_s = _WINDOW_S
    if sweep.started_at is not None:
        window_s = min(window_s, max(now - sweep.started_at.timestamp(), 1e-3))
    states = {state: count for state, (count, _) in found.items()}
    _, poses_done = found.get(JobState.DONE, (0, 0))
    return Progress(states, poses_done, counts, failed, int(recent_poses or 0), window_s)


def note_started(tx: Tx, sweep_ids: Sequence[str]) -> None:
    """Set the start of sweeps whose first job was just claimed."""
    tx.execute(
        update(sweeps)
        .where(sweeps.c.id.in_(sweep_ids), sweeps.c.started_at.is_(None))
        .values(started_at=utc_now())
    )


def note_finished(tx: Tx, sweep_id: str) -> None:
    """Set the end of a sweep if none of its jobs is open; call it under the object's lock."""
    # From the last chunk backwards: while a sweep runs, that is where the open ones are.
    still_open = (
        select(jobs.c.id)
        .where(jobs.c.sweep_id == sweep_id, jobs.c.state.in_(OPEN))
        .order_by(jobs.c.number.desc())
        .limit(1)
    )
    if tx.scalar(still_open) is None:
        tx.execute(
            update(sweeps)
            .where(sweeps.c.id == sweep_id, sweeps.c.finished_at.is_(None))
            .values(finished_at=utc_now())
        )


def cancel(tx: Tx, sweep_id: str) -> bool:
    """Cancel what is not finished, under the object's lock; False where all is."""
    # The lease stays, so that its holder is told to stop rather than that the lease is lost.
    stopped = tx.execute(
        update(jobs)
        .where(jobs.c.sweep_id == sweep_id, jobs.c.state.in_(OPEN))
        .values(state=JobState.CANCELLED, completed_at=unix_now())
    )
    if stopped.rowcount:
        ended = {"cancelled": True, "finished_at": utc_now()}
        tx.execute(update(sweeps).where(sweeps.c.id == sweep_id).values(ended))
    return bool(stopped.rowcount)


def retry(tx: Tx, sweep_id: str, *, waiting: bool = False) -> bool:
    """Queue failed and cancelled chunks again, with all their attempts, under the object's lock; False where
    there are none.
    """
    again = tx.execute(
        update(jobs)
        .where(jobs.c.sweep_id == sweep_id, jobs.c.state.in_([JobState.FAILED, JobState.CANCELLED]))
        .values(**AFRESH, state=JobState.WAITING if waiting else JobState.QUEUED)
    )
    if again.rowcount:
        tx.execute(update(sweeps).where(sweeps.c.id == sweep_id).values(cancelled=False, finished_at=None))
    return bool(again.rowcount)


def poses(tx: Tx, sweep_id: str, start: int, stop: int) -> Floats:
    """Poses ``start`` to ``stop`` of a plan that is no grid: (n, 8) float64, see :data:`POSE_COLUMNS`."""
    part = func.substr(sweeps.c.poses, start * _POSE_BYTES + 1, (stop - start) * _POSE_BYTES)
    content = tx.scalar(select(part).where(sweeps.c.id == sweep_id))
    return np.frombuffer(content or b"", dtype="<f8").reshape(-1, POSE_COLUMNS)


def siblings(tx: Tx, sweep: SweepRow) -> dict[str, SweepRow]:
    """Other collecting grid sweeps, with their batch, in which a pose index is the same simulation."""
    query = _query().where(
        sweeps.c.object_id == sweep.object_id,
        sweeps.c.provenance_id == sweep.provenance_id,
        sweeps.c.fidelity == sweep.fidelity,
        sweeps.c.purpose == "collect",
        sweeps.c.plan == "grid",
        sweeps.c.id != sweep.id,
        batches.c.id.is_not(None),
    )
    found = all_as(tx, query.order_by(sweeps.c.id), SweepRow)
    return {row.id: row for row in found if row.snapshot["repeat_key"] == sweep.snapshot["repeat_key"]}
