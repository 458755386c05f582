"""Packed outcomes: one code for every pose of a finished chunk, and how much of each grid was tried.

Outcomes of a sweep that checks or compares are stored alike, and counted nowhere but in the reports that ask
for them; those that compare, in success probabilities, too
(:mod:`graspdb_service.storage.simulation.linked`). A sweep without its batch is one whose outcomes were
deleted.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, func, insert, select, update

from graspdb.wire.states import JobState
from graspdb_service.storage.database import Tx, all_as
from graspdb_service.storage.tables import batches, jobs, packed_outcomes, provenances, sweeps
from graspdb_service.trial_columns import gripper_parts


@dataclass(frozen=True)
class PackedChunk:
    """Outcome codes (uint8) of the places ``start`` to ``stop`` of a sweep's plan, and how often each pose
    succeeded (uint8) where each was simulated several times."""

    sweep_id: str
    number: int
    start: int
    stop: int
    outcomes: bytes
    successes: bytes | None


def store(
    tx: Tx,
    *,
    job_id: str,
    sweep_id: str,
    number: int,
    revision: int,
    outcomes: bytes,
    successes: bytes | None,
    engine: str | None,
    measured: bytes | None = None,
) -> None:
    """Keep a chunk's uint8 outcome codes, one for every pose of it, of several attempts how many succeeded,
    what simulated it, and of a linked sweep what it measured.
    """
    tx.execute(
        insert(packed_outcomes).values(
            job_id=job_id,
            sweep_id=sweep_id,
            number=number,
            revision=revision,
            outcomes=outcomes,
            successes=successes,
            engine=engine,
            measured=measured,
        )
    )


def engines(tx: Tx, sweep_id: str) -> list[str]:
    """The engines, with their versions, that simulated chunks of a sweep."""
    query = select(packed_outcomes.c.engine).where(
        packed_outcomes.c.sweep_id == sweep_id, packed_outcomes.c.engine.is_not(None)
    )
    return sorted(str(engine) for engine in tx.scalars(query.distinct()))


def page(tx: Tx, sweep_id: str, *, first_number: int, poses: int) -> list[PackedChunk]:
    """Finished chunks from ``first_number`` on, in order, until they hold at least ``poses`` poses."""
    size = jobs.c.stop - jobs.c.start
    before = func.sum(size).over(order_by=packed_outcomes.c.number) - size
    listed = (
        select(packed_outcomes.c.job_id, jobs.c.start, jobs.c.stop, before.label("before"))
        .join(jobs, jobs.c.id == packed_outcomes.c.job_id)
        .where(packed_outcomes.c.sweep_id == sweep_id, packed_outcomes.c.number >= first_number)
        .subquery()
    )
    query = (
        select(
            packed_outcomes.c.sweep_id,
            packed_outcomes.c.number,
            listed.c.start,
            listed.c.stop,
            packed_outcomes.c.outcomes,
            packed_outcomes.c.successes,
        )
        .join(listed, listed.c.job_id == packed_outcomes.c.job_id)
        .where(listed.c.before < poses)
        .order_by(packed_outcomes.c.number)
    )
    return all_as(tx, query, PackedChunk)


def collected(
    tx: Tx,
    object_id: int,
    *,
    provenance_ids: Collection[int],
    after_revision: int = 0,
    grids: bool = True,
) -> list[PackedChunk]:
    """Chunks of an object's collecting sweeps stored after a revision, in commit order; of those whose plan
    is no grid, or of all.
    """
    query = _of_object(object_id, "collect").where(
        sweeps.c.provenance_id.in_(sorted(provenance_ids)), packed_outcomes.c.revision > after_revision
    )
    if not grids:
        query = query.where(sweeps.c.plan != "grid")
    ordered = query.order_by(packed_outcomes.c.revision, packed_outcomes.c.number)
    return all_as(tx, ordered, PackedChunk)


def checked(tx: Tx, object_id: int, *, gripper: str | None, protocol: str | None) -> list[PackedChunk]:
    """Finished chunks of an object's checks with a gripper and protocol (None: any), in the plans' order."""
    query = _of_object(object_id, "check")
    if gripper is not None:
        gripper, version = gripper_parts(gripper)
        query = query.where(sweeps.c.gripper == gripper)
        if version is not None:
            query = query.join(provenances, provenances.c.id == sweeps.c.provenance_id)
            query = query.where(provenances.c.gripper_version == version)
    if protocol is not None:
        query = query.where(sweeps.c.protocol == protocol)
    return all_as(tx, query.order_by(sweeps.c.id, packed_outcomes.c.number), PackedChunk)


def _of_object(object_id: int, purpose: str) -> Select[Any]:
    return (
        select(
            packed_outcomes.c.sweep_id,
            packed_outcomes.c.number,
            jobs.c.start,
            jobs.c.stop,
            packed_outcomes.c.outcomes,
            packed_outcomes.c.successes,
        )
        .join(jobs, jobs.c.id == packed_outcomes.c.job_id)
        .join(sweeps, sweeps.c.id == packed_outcomes.c.sweep_id)
        .join(batches, batches.c.sweep_id == sweeps.c.id)
        .where(sweeps.c.object_id == object_id, sweeps.c.purpose == purpose)
    )


def checks_stamp(tx: Tx, object_id: int) -> str:
    """Another one whenever what an object's checks, and the sweeps that compare, have finished changes, which
    its revision does not tell.
    """
    query = (
        select(sweeps.c.id, func.count())
        .join(batches, batches.c.sweep_id == sweeps.c.id)
        .join(packed_outcomes, packed_outcomes.c.sweep_id == sweeps.c.id)
        .where(sweeps.c.object_id == object_id, sweeps.c.purpose != "collect")
        .group_by(sweeps.c.id)
        .order_by(sweeps.c.id)
    )
    digest = hashlib.sha256()
    for sweep_id, chunks in tx.execute(query):
        digest.update(f"{sweep_id}:{chunks};".encode())
    return digest.hexdigest()[:16]


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
        select(
            jobs.c.id.label("job_id"),
            jobs.c.sweep_id,
            jobs.c.start,
            jobs.c.stop,
            packed_outcomes.c.revision,
        )
        .join(packed_outcomes, packed_outcomes.c.job_id == jobs.c.id)
        .where(jobs.c.sweep_id.in_(sorted(sweep_ids)), jobs.c.state == JobState.DONE)
        .order_by(packed_outcomes.c.revision, packed_outcomes.c.number)
    )
    return all_as(tx, query, DoneChunk)


def outcomes_of(tx: Tx, job_id: str) -> bytes:
    """The outcome codes (uint8) of a finished chunk."""
    query = select(packed_outcomes.c.outcomes).where(packed_outcomes.c.job_id == job_id)
    return bytes(tx.execute(query).scalar_one())


def done_ranges(tx: Tx, sweep_ids: Sequence[str]) -> dict[str, list[tuple[int, int]]]:
    """Places (start, stop) in their plans of the finished chunks of these sweeps."""
    query = (
        select(jobs.c.sweep_id, jobs.c.start, jobs.c.stop)
        .where(jobs.c.sweep_id.in_(sweep_ids), jobs.c.state == JobState.DONE)
        .order_by(jobs.c.sweep_id, jobs.c.start)
    )
    found: dict[str, list[tuple[int, int]]] = {sweep_id: [] for sweep_id in sweep_ids}
    for sweep_id, start, stop in tx.execute(query):
        found[sweep_id].append((int(start), int(stop)))
    return found


def count_done(tx: Tx, sweep_ids: Sequence[str]) -> int:
    """Finished chunks of these sweeps that still have their batch."""
    query = (
        select(func.count())
        .select_from(jobs)
        .join(batches, batches.c.sweep_id == jobs.c.sweep_id)
        .where(jobs.c.sweep_id.in_(sweep_ids), jobs.c.state == JobState.DONE)
    )
    return int(tx.scalar(query) or 0)


def add_packed_counts(tx: Tx, job_id: str, counts: Mapping[int, int]) -> None:
    """Count further packed outcomes of a finished chunk as added to the tallies by it; under the object's
    lock."""
    stored = dict(tx.execute(select(jobs.c.counts).where(jobs.c.id == job_id)).scalar_one())
    packed = dict(stored["packed"])
    for code, number in counts.items():
        packed[str(code)] = packed.get(str(code), 0) + number
    tx.execute(update(jobs).where(jobs.c.id == job_id).values(counts={**stored, "packed": packed}))


def packed_counts(tx: Tx, sweep_id: str) -> dict[int, int]:
    """The packed outcomes by code that a sweep added to its tallies; none for a check, counted nowhere."""
    counts: Counter[int] = Counter()
    query = select(jobs.c.counts).where(jobs.c.sweep_id == sweep_id, jobs.c.state == JobState.DONE)
    for stored in tx.scalars(query):
        counts.update({int(code): count for code, count in stored["packed"].items()})
    return counts


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
