"""Reading trials back: a page, or all of them page by page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from graspdb.wire import OUTCOME_CODES
from graspdb_service.storage import answers
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.trials import batches, provenances, rows
from graspdb_service.trial_columns import Provenance, TrialColumns, TrialPage, is_gripper
from graspdb_service.usecases.identifiers import is_uuid
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.trials.frames import AskedFrame, frames_of, out_of_tool, warnings_of
from graspdb_service.usecases.trials.selection import outcome_counts

STREAM_ROWS = 5_000


@dataclass(frozen=True)
class TrialFilter:
    """Which rows to read: exact names, ``since_revision`` for what was stored or changed after it, and
    withdrawn ones or not (None: both).
    """

    outcome: str | None = None
    source: str | None = None
    gripper: str | None = None
    protocol: str | None = None
    batch: str | None = None
    since_revision: int | None = None
    withdrawn: bool | None = None
    licence: str | None = None


def page(
    database: Database, slug: str, chosen: TrialFilter, frame: AskedFrame, *, after: int, limit: int
) -> tuple[TrialPage, int | None]:
    """A page of trials in commit order, their poses of a frame, and the sequence number after which the next
    one starts.
    """
    with database.read() as tx:
        found = _read(tx, require(tx, slug), chosen, after, limit + 1)
        columns = found.columns[:limit]
        following = int(columns.seq[-1]) if len(found.columns) > limit else None
        return out_of_tool(tx, replace(found, columns=columns), frame), following


def pages(
    database: Database, slug: str, chosen: TrialFilter, frame: AskedFrame, *, after: int
) -> Iterator[TrialPage]:
    """Every trial there is now, as :func:`page`; no transaction outlasts a page, however slow the reader."""
    with database.read() as tx:
        row = require(tx, slug)
        names = provenances.of_object(tx, row.id)
        # What can't be told is refused before the first page is on its way.
        counts = outcome_counts(tx, row.id, names)
        wanted = counts.keys() & _passing(names, chosen)
        warned = warnings_of(frames_of(tx, names, wanted, frame).values())

    def read(after: int) -> Iterator[TrialPage]:
        while True:
            with database.read() as tx:
                found = _read(tx, row, chosen, after, STREAM_ROWS, row.last_seq)
                told = out_of_tool(tx, found, frame)
            yield replace(told, warnings=warned)
            if len(found.columns) < STREAM_ROWS:
                return
            after = int(found.columns.seq[-1])

    return read(after)


def page_of(tx: Tx, row: ObjectRow, columns: TrialColumns, names: Mapping[int, Provenance]) -> TrialPage:
    """Stored trials of an object with their batches and answers."""
    tried = {number for number in columns.answer.tolist() if number >= 0}
    facts = batches.facts(tx, columns.batch.tolist())
    return TrialPage(columns, names, facts, answers.ids(tx, tried), row.quality_names or ())


def _passing(names: Mapping[int, Provenance], chosen: TrialFilter) -> set[int]:
    """The provenances whose trials may be wanted."""
    return {
        number
        for number, name in names.items()
        if chosen.gripper is None or (name.gripper is not None and is_gripper(name.gripper, chosen.gripper))
        if chosen.source in (None, name.source) and chosen.protocol in (None, name.protocol)
    }


def _read(
    tx: Tx, row: ObjectRow, chosen: TrialFilter, after: int, limit: int, up_to: int | None = None
) -> TrialPage:
    names = provenances.of_object(tx, row.id)
    wanted = [chosen.gripper, chosen.source, chosen.protocol]
    batch_ids = None if chosen.licence is None else batches.under(tx, row.id, chosen.licence)
    if chosen.batch is not None:
        batch = batches.find(tx, row.id, chosen.batch) if is_uuid(chosen.batch) else None
        if batch is None or batch.first_seq is None or batch.last_seq is None:
            limit = 0
        else:
            after = max(after, batch.first_seq - 1)
            batch_ids = [batch.id] if batch_ids is None or batch.id in batch_ids else []
            up_to = batch.last_seq if up_to is None else min(up_to, batch.last_seq)
    columns = rows.page(
        tx,
        row.id,
        after_seq=after,
        limit=limit,
        up_to_seq=up_to,
        outcome=None if chosen.outcome is None else OUTCOME_CODES[chosen.outcome],
        provenance_ids=sorted(_passing(names, chosen)) if any(wanted) else None,
        batch_ids=batch_ids,
        since_revision=chosen.since_revision,
        withdrawn=chosen.withdrawn,
    )
    return page_of(tx, row, columns, names)
