"""Findings, what is doubtful about a batch's trials, and the fingerprints that tell rows posted twice."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from sqlalchemy import (
    BindParameter,
    ColumnElement,
    Join,
    bindparam,
    delete,
    func,
    insert,
    or_,
    select,
    update,
)

from graspdb_service.storage.database import Tx
from graspdb_service.storage.tables import batches, findings, fingerprints
from graspdb_service.trial_columns import Ints


class FindingRow(NamedTuple):
    """A finding of a batch as stored.

    ``provenance_id`` is whose trials it is about, None any of the batch; ``detail`` what the code leaves
    open; ``trial_count`` of the ``examined`` trials are concerned, the first at ``first_indices`` from 0.
    Rows that stand in an earlier batch, too, name it by its internal id.
    """

    provenance_id: int | None
    code: str
    detail: str
    trial_count: int
    examined: int
    first_indices: list[int]
    other_batch_id: int | None = None


class FindingTotal(NamedTuple):
    """A finding over several batches: how many trials in how many, and the first of them by ``seq``."""

    code: str
    detail: str
    trial_count: int
    examined: int
    first_seqs: list[int]


def add(tx: Tx, batch_id: int, rows: Iterable[FindingRow]) -> None:
    """Store a new batch's findings."""
    values = [{"batch_id": batch_id, "number": i, **row._asdict()} for i, row in enumerate(rows)]
    if values:
        tx.execute(insert(findings), values)


def of_batches(tx: Tx, ids: Iterable[int]) -> dict[int, list[FindingRow]]:
    """Findings by internal id of their batch, in the order they were stored; none for a batch without."""
    columns = [findings.c[name] for name in FindingRow._fields]
    query = select(findings.c.batch_id, *columns).where(findings.c.batch_id.in_(sorted(set(ids))))
    found: dict[int, list[FindingRow]] = {}
    for batch_id, *row in tx.execute(query.order_by(findings.c.batch_id, findings.c.number)):
        found.setdefault(int(batch_id), []).append(FindingRow(*row))
    return found


def totals(tx: Tx, object_id: int, provenance_ids: Sequence[int]) -> list[FindingTotal]:
    """Findings about trials of these provenances, over all of an object's batches."""
    # Written out: an object may have more provenances than a statement has parameters.
    ids: BindParameter[int] = bindparam("ids", provenance_ids, expanding=True, literal_execute=True)
    concerned: tuple[ColumnElement[bool], ...] = (
        batches.c.object_id == object_id,
        or_(findings.c.provenance_id.is_(None), findings.c.provenance_id.in_(ids)),
    )
    joined = findings.join(batches, batches.c.id == findings.c.batch_id)
    # What names several earlier batches looked at the same rows for each.
    parts = (
        select(
            findings.c.code,
            findings.c.detail,
            func.sum(findings.c.trial_count).label("trial_count"),
            func.max(findings.c.examined).label("examined"),
        )
        .select_from(joined)
        .where(*concerned)
        .group_by(findings.c.code, findings.c.detail, findings.c.batch_id, findings.c.provenance_id)
        .subquery()
    )
    query = select(
        parts.c.code, parts.c.detail, func.sum(parts.c.trial_count), func.sum(parts.c.examined)
    ).group_by(parts.c.code, parts.c.detail)
    found = []
    for code, detail, number, examined in tx.execute(query).all():
        alike = (*concerned, findings.c.code == code, findings.c.detail == detail)
        found.append(FindingTotal(code, detail, int(number), int(examined), _first_seqs(tx, joined, alike)))
    return found


def _first_seqs(tx: Tx, joined: Join, concerned: tuple[ColumnElement[bool], ...]) -> list[int]:
    """Sequence numbers of trials that the first batch with such a finding names."""
    query = (
        select(batches.c.first_seq, findings.c.first_indices)
        .select_from(joined)
        .where(*concerned)
        .order_by(findings.c.batch_id, findings.c.number)
        .limit(1)
    )
    first_seq, indices = tx.execute(query).one()
    return [int(first_seq) + index for index in indices]


def drop_trial(tx: Tx, object_id: int, seq: int) -> None:
    """Count a trial no more in the findings that name it, and drop those that were about it alone."""
    query = (
        select(batches.c.first_seq, *findings.c)
        .select_from(findings.join(batches, batches.c.id == findings.c.batch_id))
        .where(batches.c.object_id == object_id, batches.c.first_seq <= seq, batches.c.last_seq >= seq)
    )
    for row in tx.execute(query).all():
        index = seq - row.first_seq
        if index not in row.first_indices:
            continue
        place = findings.c.batch_id == row.batch_id, findings.c.number == row.number
        if row.trial_count == 1:
            tx.execute(delete(findings).where(*place))
            continue
        left = [other for other in row.first_indices if other != index]
        tx.execute(update(findings).where(*place).values(trial_count=row.trial_count - 1, first_indices=left))


def seen_in(tx: Tx, digests: Ints) -> list[tuple[int, int]]:
    """Which of these digests were posted before: (digest, internal id of the batch)."""
    query = select(fingerprints.c.digest, fingerprints.c.batch_id)
    rows = tx.execute(query.where(fingerprints.c.digest.in_(digests.tolist())))
    return [(int(digest), int(batch_id)) for digest, batch_id in rows]


def remember(tx: Tx, batch_id: int, digests: Ints) -> None:
    """Keep the digests, each once, of a new batch's rows."""
    tx.execute(
        insert(fingerprints), [{"digest": digest, "batch_id": batch_id} for digest in digests.tolist()]
    )
