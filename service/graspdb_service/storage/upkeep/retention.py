"""Deleting what is kept no longer, a few rows a transaction, and what there is in numbers."""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import timedelta

from sqlalchemy import Double, Table, delete, func, select, tuple_

from graspdb_service.storage.database import Database, Tx, clock
from graspdb_service.storage.tables import (
    batches,
    idempotency_keys,
    jobs,
    metadata,
    objects,
    tallies,
    workers,
)

#: Rows that one transaction deletes: others write between two.
_ROWS = 500
_PAUSE_S = 0.02
_OPEN_OR_FAILED = ("waiting", "queued", "leased", "failed")


def purge_idempotency_keys(database: Database, days: float) -> int:
    """Delete keys older than this; how many."""
    return _purge(database, idempotency_keys, "created_at", timedelta(days=days))


def purge_audit(database: Database, days: float) -> int:
    """Delete entries of the audit older than this; how many."""
    audit = metadata.tables.get("audit")
    return 0 if audit is None else _purge(database, audit, "at", timedelta(days=days))


def purge_workers(database: Database, days: float) -> int:
    """Forget workers that were not seen for so long; how many."""
    return _purge(database, workers, "last_seen", timedelta(days=days))


def old_batches(tx: Tx, days: float, *, after: int, limit: int) -> list[tuple[int, str, str]]:
    """Batches older than this in the order of their making: internal id, object's slug and key."""
    query = (
        select(batches.c.id, objects.c.slug, batches.c.key)
        .join(objects, objects.c.id == batches.c.object_id)
        .where(batches.c.created_at < clock(tx) - timedelta(days=days), batches.c.id > after)
        .order_by(batches.c.id)
        .limit(limit)
    )
    return [(int(id), str(slug), str(key)) for id, slug, key in tx.execute(query)]


def _purge(database: Database, table: Table, column: str, age: timedelta) -> int:
    with database.read() as tx:
        before = clock(tx) - age
    in_seconds = isinstance(table.c[column].type, Double)
    key = list(table.primary_key.columns)
    old = select(*key).where(table.c[column] < (before.timestamp() if in_seconds else before)).limit(_ROWS)
    deleted = 0
    while True:
        # Looked for without the write lock, so that nothing waits where nothing is old.
        with database.read() as tx:
            found = tx.execute(old).all()
        if found:
            with database.write() as tx:
                rows = [tuple(row) for row in found]
                deleted += tx.execute(delete(table).where(tuple_(*key).in_(rows))).rowcount
        if len(found) < _ROWS:
            return deleted
        time.sleep(_PAUSE_S)


@dataclass(frozen=True)
class Figures:
    """How much there is: objects, trials as rows and packed, jobs by kind and state that are not done."""

    objects: int
    rows: int
    packed: int
    jobs: dict[tuple[str, str], int]


def figures(tx: Tx) -> Figures:
    """Count, reading no trial and no job that is done."""
    states = (
        select(jobs.c.kind, jobs.c.state, func.count())
        .where(jobs.c.state.in_(_OPEN_OR_FAILED))
        .group_by(jobs.c.kind, jobs.c.state)
    )
    counted = {(kind, state): 0 for kind in ("simulate", "decompose") for state in _OPEN_OR_FAILED}
    counted |= {(str(kind), str(state)): int(number) for kind, state, number in tx.execute(states)}
    rows, packed = tx.execute(select(func.sum(tallies.c.row_count), func.sum(tallies.c.packed_count))).one()
    number = tx.scalar(select(func.count()).select_from(objects))
    return Figures(int(number or 0), int(rows or 0), int(packed or 0), counted)
