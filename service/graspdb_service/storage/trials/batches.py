"""Batches: the trials of one POST, or everything one sweep wrote."""

from __future__ import annotations

import uuid
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from sqlalchemy import Select, and_, case, delete, distinct, func, insert, or_, select, update

from graspdb.wire.trials import BatchDefaults
from graspdb_service import principal
from graspdb_service.storage import answers
from graspdb_service.storage.database import Tx, all_as, first_as, utc_now
from graspdb_service.storage.simulation import outcomes
from graspdb_service.storage.tables import (
    batches,
    idempotency_keys,
    packed_outcomes,
    sweeps,
    trial_changes,
    trials,
)
from graspdb_service.storage.trials import provenances
from graspdb_service.storage.trials.qualities import Layout, names_of
from graspdb_service.trial_columns import BatchFacts


@dataclass(frozen=True)
class BatchRow:
    """A batch as stored; ``key`` is what users see. A sweep's names its provenance and purpose."""

    id: int
    key: str
    object_id: int
    sweep_id: str | None
    revision: int
    first_seq: int | None
    last_seq: int | None
    inserted: int
    packed: int
    metadata: dict[str, Any] | None
    made_by: str | None
    created_at: datetime
    licence: str | None
    citation: str | None
    origin: dict[str, Any] | None
    quality_layout: Layout | None
    provenance_id: int | None
    purpose: str | None


def create(
    tx: Tx,
    object_id: int,
    *,
    revision: int,
    sweep_id: str | None = None,
    shared: BatchDefaults | None = None,
    quality_layout: Layout | None = None,
) -> tuple[int, str]:
    """An empty batch: its internal id and its key."""
    told = BatchDefaults() if shared is None else shared
    key = str(uuid.uuid4())
    statement = (
        insert(batches)
        .values(
            key=key,
            object_id=object_id,
            sweep_id=sweep_id,
            revision=revision,
            inserted=0,
            packed=0,
            metadata=told.metadata,
            licence=told.licence,
            citation=told.citation,
            origin=None if told.origin is None else told.origin.model_dump(exclude_none=True) or None,
            quality_layout=quality_layout,
            made_by=principal.actor().key,
            created_at=utc_now(),
        )
        .returning(batches.c.id)
    )
    return int(tx.execute(statement).scalar_one()), key


def grow(
    tx: Tx,
    batch_id: int,
    *,
    first_seq: int | None,
    last_seq: int | None,
    inserted: int,
    packed: int,
    revision: int | None = None,
) -> None:
    """Count rows, wherever they lie, and packed outcomes as the batch's; the range is None without rows."""
    values: dict[str, Any] = {"inserted": batches.c.inserted + inserted, "packed": batches.c.packed + packed}
    if first_seq is not None and last_seq is not None:
        first, last = batches.c.first_seq, batches.c.last_seq
        values["first_seq"] = case((or_(first.is_(None), first > first_seq), first_seq), else_=first)
        values["last_seq"] = case((or_(last.is_(None), last < last_seq), last_seq), else_=last)
    if revision is not None:
        values["revision"] = revision
    tx.execute(update(batches).where(batches.c.id == batch_id).values(values))


def find(tx: Tx, object_id: int, key: str) -> BatchRow | None:
    """The object's batch with this key."""
    return first_as(tx, _query().where(batches.c.object_id == object_id, batches.c.key == key), BatchRow)


def of_sweep(tx: Tx, sweep_id: str) -> BatchRow | None:
    """The batch a sweep writes; None once it was deleted."""
    return first_as(tx, _query().where(batches.c.sweep_id == sweep_id), BatchRow)


def page(tx: Tx, object_id: int, *, after: int, limit: int, licence: str | None = None) -> list[BatchRow]:
    """Up to ``limit`` batches, all or those under a licence, in the order of their making, from the one after
    the internal id ``after``.
    """
    query = _query().where(batches.c.object_id == object_id, batches.c.id > after)
    if licence is not None:
        query = query.where(batches.c.licence == licence)
    return all_as(tx, query.order_by(batches.c.id).limit(limit), BatchRow)


def under(tx: Tx, object_id: int, licence: str) -> list[int]:
    """Internal ids of an object's batches under a licence."""
    query = select(batches.c.id).where(batches.c.object_id == object_id, batches.c.licence == licence)
    return [int(number) for number in tx.scalars(query)]


def facts(tx: Tx, ids: Iterable[int]) -> dict[int, BatchFacts]:
    """Batches by internal id, as their trials name them."""
    columns = (batches.c[name] for name in ("id", "key", "sweep_id", "metadata", "quality_layout"))
    rows = tx.execute(select(*columns).where(batches.c.id.in_(sorted(set(ids)))))
    return {
        int(number): BatchFacts(key, sweep, told, names_of(layout))
        for number, key, sweep, told, layout in rows
    }


def keys(tx: Tx, ids: Collection[int]) -> dict[int, str]:
    """Keys of batches by internal id."""
    if not ids:
        return {}
    rows = tx.execute(select(batches.c.id, batches.c.key).where(batches.c.id.in_(sorted(set(ids)))))
    return {int(number): str(key) for number, key in rows}


def withdrawn_count(tx: Tx, batch: BatchRow) -> int:
    """Trials of a batch that count no more."""
    if batch.first_seq is None:
        return 0
    changed = trial_changes.join(
        trials, and_(trials.c.object_id == trial_changes.c.object_id, trials.c.seq == trial_changes.c.seq)
    )
    # Only what was changed can be withdrawn, and few are.
    query = (
        select(func.count(distinct(trials.c.seq)))
        .select_from(changed)
        .where(*_rows(batch), *_changes(batch), trials.c.withdrawn.is_(True))
    )
    return int(tx.execute(query).scalar_one())


def row_counts(tx: Tx, batch: BatchRow) -> dict[tuple[int, int], int]:
    """Trial rows of a batch by (provenance, outcome code), withdrawn ones apart."""
    if batch.first_seq is None:
        return {}
    query = (
        select(trials.c.provenance_id, trials.c.outcome, func.count())
        .where(*_rows(batch), trials.c.withdrawn.is_(None))
        .group_by(trials.c.provenance_id, trials.c.outcome)
    )
    return {(int(p), int(outcome)): int(n) for p, outcome, n in tx.execute(query)}


def outcome_counts(tx: Tx, batch: BatchRow) -> dict[tuple[int, int], int]:
    """Everything a batch holds by (provenance, outcome code): rows, and the packed outcomes of its sweep."""
    counts = row_counts(tx, batch)
    if batch.sweep_id is not None and batch.provenance_id is not None:
        # Not every code of the packed outcomes: poses that another sweep had stored before count there.
        own = batch.purpose != "collect"
        packed = _packed_codes(tx, batch.sweep_id) if own else outcomes.packed_counts(tx, batch.sweep_id)
        for outcome, number in packed.items():
            place = batch.provenance_id, outcome
            counts[place] = counts.get(place, 0) + number
    return counts


def remove(tx: Tx, batch: BatchRow) -> None:
    """Delete a batch, its rows and packed outcomes, and take both out of the tallies.

    Call it under the object's lock, with :func:`graspdb_service.storage.objects.advance` in the same
    transaction where the batch was collected.
    """
    rows = row_counts(tx, batch)
    if batch.sweep_id is not None:
        if batch.purpose == "collect" and batch.provenance_id is not None:
            packed = outcomes.packed_counts(tx, batch.sweep_id)
            provenances.add_packed(tx, batch.provenance_id, {code: -n for code, n in packed.items()})
        tx.execute(delete(packed_outcomes).where(packed_outcomes.c.sweep_id == batch.sweep_id))
    if batch.first_seq is not None:
        answers.count_trials(tx, {number: -n for number, n in _tried(tx, batch).items()})
        changed = select(trials.c.seq).where(*_rows(batch))
        tx.execute(delete(trial_changes).where(*_changes(batch), trial_changes.c.seq.in_(changed)))
        tx.execute(delete(trials).where(*_rows(batch)))
    for (provenance_id, outcome), number in rows.items():
        provenances.add_tally(tx, provenance_id, outcome, rows=-number)
    tx.execute(update(idempotency_keys).where(idempotency_keys.c.batch_key == batch.key).values(revoked=True))
    tx.execute(delete(batches).where(batches.c.id == batch.id))


def _rows(batch: BatchRow) -> tuple[Any, ...]:
    return (
        trials.c.object_id == batch.object_id,
        trials.c.seq.between(batch.first_seq, batch.last_seq),
        trials.c.batch_id == batch.id,
    )


def _tried(tx: Tx, batch: BatchRow) -> dict[int, int]:
    """How many trials of a batch name each answer."""
    query = select(trials.c.answer_number, func.count()).where(
        *_rows(batch), trials.c.answer_number.is_not(None)
    )
    return {int(number): int(n) for number, n in tx.execute(query.group_by(trials.c.answer_number))}


def _changes(batch: BatchRow) -> tuple[Any, ...]:
    return (
        trial_changes.c.object_id == batch.object_id,
        trial_changes.c.seq.between(batch.first_seq, batch.last_seq),
    )


def _packed_codes(tx: Tx, sweep_id: str) -> dict[int, int]:
    total = np.zeros(256, dtype=np.int64)
    query = select(packed_outcomes.c.outcomes).where(packed_outcomes.c.sweep_id == sweep_id)
    for (content,) in tx.execute(query):
        total += np.bincount(np.frombuffer(content, dtype=np.uint8), minlength=256)
    return {int(code): int(total[code]) for code in np.flatnonzero(total)}


def _query() -> Select[Any]:
    return select(batches, sweeps.c.provenance_id, sweeps.c.purpose).select_from(
        batches.outerjoin(sweeps, sweeps.c.id == batches.c.sweep_id)
    )
