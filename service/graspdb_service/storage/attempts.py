"""Sweeps as attempts: their packed outcomes, and how much of each grid was tried."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select

from graspdb_service.storage.database import Tx
from graspdb_service.storage.tables import batches, jobs, packed_outcomes, sweeps


@dataclass(frozen=True)
class PackedChunk:
    """Outcome codes (uint8) of the places ``start`` to ``stop`` of a sweep's plan."""

    sweep_id: str
    start: int
    stop: int
    outcomes: bytes


def packed_chunks(
    tx: Tx, object_id: int, *, provenance_ids: Collection[int], after_revision: int = 0
) -> list[PackedChunk]:
    """Chunks of an object's collecting sweeps stored after a revision, in commit order."""
    query = (
        select(packed_outcomes.c.sweep_id, jobs.c.start, jobs.c.stop, packed_outcomes.c.outcomes)
        .join(jobs, jobs.c.id == packed_outcomes.c.job_id)
        .join(sweeps, sweeps.c.id == packed_outcomes.c.sweep_id)
        # A sweep without its batch is one whose outcomes were deleted.
        .join(batches, batches.c.sweep_id == sweeps.c.id)
        .where(
            sweeps.c.object_id == object_id,
            sweeps.c.purpose == "collect",
            sweeps.c.provenance_id.in_(sorted(provenance_ids)),
            packed_outcomes.c.revision > after_revision,
        )
        .order_by(packed_outcomes.c.revision, packed_outcomes.c.number)
    )
    return [PackedChunk(s, int(a), int(b), bytes(content)) for s, a, b, content in tx.execute(query)]


@dataclass(frozen=True)
class DoneChunk:
    """A finished chunk of a sweep: the places of its plan, and the revision that stored it."""

    job_id: str
    sweep_id: str
    start: int
    stop: int
    revision: int


def done_chunks(tx: Tx, sweep_ids: Collection[str]) -> list[DoneChunk]:
    """Finished chunks of these sweeps in commit order, their outcomes left unread."""
    query = (
        select(jobs.c.id, jobs.c.sweep_id, jobs.c.start, jobs.c.stop, packed_outcomes.c.revision)
        .join(packed_outcomes, packed_outcomes.c.job_id == jobs.c.id)
        .where(jobs.c.sweep_id.in_(sorted(sweep_ids)), jobs.c.state == "done")
        .order_by(packed_outcomes.c.revision, packed_outcomes.c.number)
    )
    return [DoneChunk(i, s, int(a), int(b), int(r)) for i, s, a, b, r in tx.execute(query)]


def outcomes_of(tx: Tx, job_id: str) -> bytes:
    """The outcome codes (uint8) of a finished chunk."""
    query = select(packed_outcomes.c.outcomes).where(packed_outcomes.c.job_id == job_id)
    return bytes(tx.execute(query).scalar_one())


@dataclass(frozen=True)
class TriedGrid:
    """A collecting grid sweep that has stored something.

    ``kept`` counts the distinct poses it tried that no other sweep had stored before; ``grid`` is the plan as
    :class:`graspdb.wire.GridPlan` has it.
    """

    sweep_id: str
    batch_id: int
    repeat_key: str
    grid: dict[str, Any]
    kept: int


def tried_grids(tx: Tx, object_id: int, *, provenance_ids: Collection[int]) -> list[TriedGrid]:
    """Grids of which something was tried, in the order the sweeps were made. Reads no job, however many."""
    kept = batches.c.inserted + batches.c.packed
    query = (
        select(sweeps.c.id, batches.c.id, sweeps.c.snapshot, kept)
        # A sweep without its batch is one whose outcomes were deleted.
        .join(batches, batches.c.sweep_id == sweeps.c.id)
        .where(
            sweeps.c.object_id == object_id,
            sweeps.c.purpose == "collect",
            sweeps.c.plan == "grid",
            sweeps.c.provenance_id.in_(sorted(provenance_ids)),
            kept > 0,
        )
        .order_by(sweeps.c.id)
    )
    return [
        TriedGrid(sweep, int(batch), snapshot["repeat_key"], snapshot["grid"], int(number))
        for sweep, batch, snapshot, number in tx.execute(query)
    ]
