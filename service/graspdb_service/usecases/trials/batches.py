"""Batches: what one request, or one sweep, stored; deleting one undoes it."""

from __future__ import annotations

from graspdb.wire import OUTCOMES, BatchInfo
from graspdb_service.problems import busy, conflict, found
from graspdb_service.storage import objects
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.trials import batches
from graspdb_service.storage.trials.batches import BatchRow
from graspdb_service.usecases.identifiers import is_uuid
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.trials import batch_removal

#: Sweeps over one grid that finish chunks meanwhile make a deletion look again.
_MAX_LOOKS = 20


def get(database: Database, slug: str, key: str) -> BatchInfo:
    """One batch, with everything it holds by outcome."""
    with database.read() as tx:
        row = require(tx, slug)
        return _info(tx, slug, _require(tx, row.id, key))


def page(database: Database, slug: str, *, after: int, limit: int) -> tuple[list[BatchInfo], int | None]:
    """A page of batches in the order of their making, and where the next one starts."""
    with database.read() as tx:
        row = require(tx, slug)
        rows = batches.page(tx, row.id, after=after, limit=limit + 1)
        items = [_info(tx, slug, batch) for batch in rows[:limit]]
    return items, rows[limit - 1].id if len(rows) > limit else None


def remove(database: Database, slug: str, key: str) -> None:
    """Delete a batch with its trials and packed outcomes; 409 while its sweep runs, which would write on.

    Poses that another sweep over the same grid has simulated as well stay, as that sweep's.
    """
    for _ in range(_MAX_LOOKS):
        with database.read() as tx:
            left = batch_removal.of(tx, _require(tx, require(tx, slug).id, key))
        with database.write() as tx:
            row = require(tx, slug, lock=True)
            batch = _require(tx, row.id, key)
            if batch.sweep_id is not None and objects.has_running_sweep(tx, row.id, sweep_id=batch.sweep_id):
                raise conflict(
                    "sweep-running",
                    f"The batch is being written by sweep {batch.sweep_id}:"
                    f" cancel it (POST /sweeps/{batch.sweep_id}/cancel) or wait for its end",
                )
            if left is not None and not left.holds(tx):
                continue
            if batch.purpose != "check":
                # The outcomes of a check never entered anything that a revision stands for.
                objects.advance(tx, row.id, append=False)
            if left is not None:
                left.hand_over(tx, batch)
            batches.remove(tx, batch)
            return
    raise busy("Sweeps over the same grid keep finishing chunks meanwhile; send it again")


def _require(tx: Tx, object_id: int, key: str) -> BatchRow:
    batch = batches.find(tx, object_id, key) if is_uuid(key) else None
    return found(batch, "batch", key, "GET /objects/{id}/batches lists them")


def _info(tx: Tx, slug: str, batch: BatchRow) -> BatchInfo:
    counts = batches.outcome_counts(tx, batch)
    outcomes = {OUTCOMES[code]: number for code, number in sorted(counts.items()) if number}
    told = {"batch": batch.key, "object": slug, "sweep": batch.sweep_id, "outcomes": outcomes}
    return BatchInfo.model_validate({**vars(batch), **told})
