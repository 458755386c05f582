"""Batches: what one request, or one sweep, stored; deleting one undoes it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from graspdb.wire import OUTCOMES, BatchInfo
from graspdb_service.problems import busy, conflict, found
from graspdb_service.storage import objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.simulation import outcomes as packed
from graspdb_service.storage.simulation import sweeps
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.storage.trials import batches, findings, provenances
from graspdb_service.storage.trials.batches import BatchRow
from graspdb_service.storage.trials.qualities import names_of
from graspdb_service.trial_columns import gripper_parts
from graspdb_service.usecases.identifiers import is_uuid
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.trials import batch_removal
from graspdb_service.usecases.trials.findings import words
from graspdb_service.usecases.trials.selection import distinct

#: Sweeps over one grid that finish chunks meanwhile make a deletion look again.
_MAX_LOOKS = 20


def get(database: Database, slug: str, key: str) -> BatchInfo:
    """One batch, with everything it holds by outcome."""
    with database.read() as tx:
        row = require(tx, slug)
        return _infos(tx, row, [_require(tx, row.id, key)])[0]


def page(
    database: Database, slug: str, *, after: int, limit: int, licence: str | None = None
) -> tuple[list[BatchInfo], int | None]:
    """A page of batches, all or those under a licence, in the order of their making, and where the next one
    starts.
    """
    with database.read() as tx:
        row = require(tx, slug)
        rows = batches.page(tx, row.id, after=after, limit=limit + 1, licence=licence)
        items = _infos(tx, row, rows[:limit])
    return items, rows[limit - 1].id if len(rows) > limit else None


def remove(database: Database, slug: str, key: str) -> None:
    """Delete a batch with its trials and packed outcomes; 409 while its sweep runs, which would write on.

    What a linked sweep compares with these goes with them; deleted itself, it leaves them. Poses that another
    sweep over the same grid has simulated as well stay, as that sweep's.
    """
    for _ in range(_MAX_LOOKS):
        with database.read() as tx:
            left = batch_removal.of(tx, _require(tx, require(tx, slug).id, key))
        with database.write() as tx:
            row = require(tx, slug, lock=True)
            batch = _require(tx, row.id, key)
            sweep = None if batch.sweep_id is None else sweeps.find(tx, batch.sweep_id)
            going = [batch, *_compared(tx, sweep)]
            for each in going:
                _refuse_running(tx, row, each)
            if left is not None and not left.holds(tx):
                continue
            if sweep is None or sweep.enters:
                # The outcomes of a check never entered anything that a revision stands for.
                objects.advance(tx, row.id, append=False)
            if left is not None:
                left.hand_over(tx, batch)
            for each in going:
                batches.remove(tx, each)
                audit.record(tx, "batch.delete", object=slug, subject=each.key)
            return
    raise busy("Sweeps over the same grid keep finishing chunks meanwhile; send it again")


def _compared(tx: Tx, sweep: SweepRow | None) -> list[BatchRow]:
    """The batch of the linked sweep that compares with a sweep's outcomes, if it is still there."""
    if sweep is None or sweep.linked is None or sweep.purpose == "compare":
        return []
    batch = batches.of_sweep(tx, sweep.linked)
    return [] if batch is None else [batch]


def _refuse_running(tx: Tx, row: ObjectRow, batch: BatchRow) -> None:
    if batch.sweep_id is not None and objects.has_running_sweep(tx, row.id, sweep_id=batch.sweep_id):
        raise conflict(
            "sweep-running",
            f"The batch is being written by sweep {batch.sweep_id}:"
            f" cancel it (POST /sweeps/{batch.sweep_id}/cancel) or wait for its end",
        )


def _require(tx: Tx, object_id: int, key: str) -> BatchRow:
    batch = batches.find(tx, object_id, key) if is_uuid(key) else None
    return found(batch, "batch", key, "GET /objects/{id}/batches lists them")


def _engines(tx: Tx, batch: BatchRow) -> list[str]:
    """What simulated chunks of a sweep's batch."""
    return [] if batch.sweep_id is None else packed.engines(tx, batch.sweep_id)


def _infos(tx: Tx, row: ObjectRow, several: Sequence[BatchRow]) -> list[BatchInfo]:
    """Batches of one object, as the wire has them."""
    stored = findings.of_batches(tx, [batch.id for batch in several])
    keys = batches.keys(tx, words.earlier_batches(item for items in stored.values() for item in items))
    names = provenances.of_object(tx, row.id)
    infos = []
    for batch in several:
        counts = batches.outcome_counts(tx, batch)
        outcomes: Counter[int] = Counter()
        for (_, code), number in counts.items():
            outcomes[code] += number
        items = [names[number] for number in {number for number, _ in counts}]
        told = {
            "batch": batch.key,
            "object": row.slug,
            "sweep": batch.sweep_id,
            "key": batch.made_by,
            "withdrawn": batches.withdrawn_count(tx, batch),
            "outcomes": {OUTCOMES[code]: number for code, number in sorted(outcomes.items()) if number},
            "grippers": distinct(item.gripper and gripper_parts(item.gripper)[0] for item in items),
            "gripper_versions": distinct(item.gripper for item in items),
            "sources": distinct(item.source for item in items),
            "protocols": distinct(item.protocol for item in items),
            "engines": sorted({*distinct(item.engine for item in items), *_engines(tx, batch)}),
            "qualities": names_of(batch.quality_layout),
            "findings": words.of_batch(stored.get(batch.id, []), batch.inserted, keys),
        }
        infos.append(BatchInfo.model_validate({**vars(batch), **told}))
    return infos
