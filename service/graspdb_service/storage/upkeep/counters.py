"""What is counted beside the rows, and the rows themselves: do they agree, and counting anew where not.

Tallies, the numbers of batches and the counters of objects are kept in the transactions that change rows, so
in one snapshot they agree, whatever is being written. A count that does not is a fault, of ours or of a hand
in the database.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import and_, delete, func, insert, or_, select, update

from graspdb.wire import OUTCOMES
from graspdb.wire.states import JobState
from graspdb_service.storage import objects as object_rows
from graspdb_service.storage.database import Tx
from graspdb_service.storage.tables import (
    batches,
    jobs,
    objects,
    packed_outcomes,
    provenances,
    sweeps,
    tallies,
    trial_changes,
    trials,
)


@dataclass
class _Rows:
    """Trial rows of one batch or object: how many, and the ends of their numbers and revisions."""

    count: int = 0
    first: int | None = None
    last: int | None = None
    revision: int = 0

    def add(self, count: int, first: int, last: int, revision: int) -> None:
        self.count += count
        self.first = first if self.first is None else min(self.first, first)
        self.last = last if self.last is None else max(self.last, last)
        self.revision = max(self.revision, revision)


@dataclass
class Survey:
    """Everything that the rows of some objects say, read in one pass."""

    trials: int = 0
    tallies: dict[tuple[int, int], list[int]] = field(default_factory=lambda: defaultdict(lambda: [0, 0]))
    by_batch: dict[tuple[int, int], _Rows] = field(default_factory=lambda: defaultdict(_Rows))
    by_object: dict[int, _Rows] = field(default_factory=lambda: defaultdict(_Rows))
    by_provenance: dict[tuple[int, int], int] = field(default_factory=Counter)
    #: Packed outcomes that count, by sweep; of one that collects nothing all that it has.
    packed: dict[str, int] = field(default_factory=Counter)


@dataclass(frozen=True)
class Disagreement:
    """A count that is not what the rows say. ``object_id`` is None where no object has it."""

    object_id: int | None
    what: str


def survey(tx: Tx, object_id: int | None = None) -> Survey:
    """Read the rows and packed outcomes of an object, or of all."""
    found = Survey()
    key = (
        trials.c.object_id,
        trials.c.batch_id,
        trials.c.provenance_id,
        trials.c.outcome,
        trials.c.withdrawn,
    )
    ends = func.min(trials.c.seq), func.max(trials.c.seq), func.max(trials.c.revision)
    query = select(*key, func.count(), *ends).group_by(*key)
    for object_, batch, provenance, outcome, withdrawn, count, first, last, revision in tx.execute(
        query if object_id is None else query.where(trials.c.object_id == object_id)
    ):
        found.trials += count
        if withdrawn is None:
            found.tallies[provenance, outcome][0] += count
        found.by_batch[object_, batch].add(count, first, last, revision)
        found.by_object[object_].add(count, first, last, revision)
        found.by_provenance[object_, provenance] += count
    chunks = (
        select(
            sweeps.c.id, sweeps.c.provenance_id, sweeps.c.purpose, jobs.c.counts, jobs.c.stop - jobs.c.start
        )
        .join(sweeps, sweeps.c.id == jobs.c.sweep_id)
        # A sweep without its batch has lost its outcomes.
        .join(batches, batches.c.sweep_id == sweeps.c.id)
        .where(jobs.c.state == JobState.DONE)
    )
    for sweep, provenance, purpose, counts, size in tx.execute(
        chunks if object_id is None else chunks.where(sweeps.c.object_id == object_id)
    ):
        packed = {int(code): number for code, number in counts["packed"].items()}
        found.packed[sweep] += size if purpose != "collect" else sum(packed.values())
        for code, number in packed.items():
            found.tallies[provenance, code][1] += number
    return found


def tallies_that_differ(tx: Tx, found: Survey) -> list[Disagreement]:
    """Tallies that are not what rows and packed outcomes add up to."""
    known = tx.execute(select(provenances.c.id, provenances.c.object_id))
    owner = {int(provenance): int(object_id) for provenance, object_id in known}
    stored = {
        (int(row.provenance_id), int(row.outcome)): (int(row.row_count), int(row.packed_count))
        for row in tx.execute(select(tallies))
    }
    different = []
    for place in sorted({*stored, *found.tallies}):
        counted, kept = tuple(found.tallies.get(place, (0, 0))), stored.get(place, (0, 0))
        if counted != kept:
            provenance, outcome = place
            name = OUTCOMES[outcome] if 0 <= outcome < len(OUTCOMES) else f"outcome {outcome}"
            what = f"{name}: {_told(*kept)} are noted, {_told(*counted)} are there"
            different.append(Disagreement(owner.get(provenance), what))
    return different


def batches_that_differ(tx: Tx, found: Survey) -> list[Disagreement]:
    """Batches whose numbers are not those of their rows and packed outcomes."""
    different = []
    for batch in tx.execute(select(batches)):
        rows = found.by_batch.get((batch.object_id, batch.id), _Rows())
        packed = found.packed.get(batch.sweep_id, 0) if batch.sweep_id else 0
        outside = rows.first is not None and (
            batch.first_seq is None or batch.first_seq > rows.first or batch.last_seq < (rows.last or 0)
        )
        if (batch.inserted, batch.packed) != (rows.count, packed) or outside:
            noted = f"{_told(batch.inserted, batch.packed)}, seq {batch.first_seq} to {batch.last_seq},"
            there = f"{_told(rows.count, packed)}, seq {rows.first} to {rows.last},"
            what = f"batch {batch.key}: {noted} are noted, {there} are there"
            different.append(Disagreement(batch.object_id, what))
    return different


def _told(rows: int, packed: int) -> str:
    return f"{rows} rows and {packed} packed"


def counters_that_lag(tx: Tx, found: Survey) -> list[Disagreement]:
    """Objects whose revision, epoch or last sequence number is behind what their rows have."""
    newest = _newest_revisions(tx)
    late = []
    for row in tx.execute(select(objects.c.id, objects.c.revision, objects.c.epoch, objects.c.last_seq)):
        rows = found.by_object.get(row.id, _Rows())
        revision = max(newest.get(row.id, 0), rows.revision)
        if row.last_seq < (rows.last or 0):
            late.append(Disagreement(row.id, f"last_seq is {row.last_seq}, a trial has {rows.last}"))
        if row.revision < revision or row.epoch > row.revision:
            late.append(
                Disagreement(
                    row.id,
                    f"revision is {row.revision} with epoch {row.epoch}, a row has revision {revision}",
                )
            )
    return late


def chunks_that_differ(tx: Tx) -> list[Disagreement]:
    """Finished chunks whose packed outcomes are missing or not those that were counted when they came."""
    query = (
        select(sweeps.c.object_id, sweeps.c.id, jobs.c.number, jobs.c.counts, packed_outcomes.c.outcomes)
        .join(sweeps, sweeps.c.id == jobs.c.sweep_id)
        .join(batches, batches.c.sweep_id == sweeps.c.id)
        .outerjoin(packed_outcomes, packed_outcomes.c.job_id == jobs.c.id)
        .where(jobs.c.state == JobState.DONE)
        .execution_options(yield_per=16)
    )
    different = []
    for object_id, sweep, number, counts, content in tx.execute(query):
        where = f"chunk {number} of sweep {sweep}"
        if content is None:
            different.append(Disagreement(object_id, f"{where} has no outcomes"))
            continue
        # Without NumPy, whose threads a server must bound before it is imported.
        codes = Counter(bytes(content))
        if unknown := [code for code in codes if code >= len(OUTCOMES)]:
            different.append(Disagreement(object_id, f"{where} has the unknown outcome {unknown[0]}"))
            continue
        there = {OUTCOMES[code]: number for code, number in codes.items()}
        if there != counts["all"]:
            different.append(Disagreement(object_id, f"{where} has {there}, {counts['all']} were counted"))
    return different


def qualities_that_differ(tx: Tx) -> list[Disagreement]:
    """Batches whose trials' qualities are not as wide as their names and types say, or whose names their
    object does not list.
    """
    different = []
    layouts: dict[int, list[list[str]]] = {}
    query = select(batches.c.id, batches.c.key, batches.c.object_id, batches.c.quality_layout)
    listed = query.add_columns(objects.c.quality_names).join(objects, objects.c.id == batches.c.object_id)
    for number, key, object_id, layout, names in tx.execute(
        listed.where(batches.c.quality_layout.is_not(None))
    ):
        layouts[number] = layout
        if unlisted := {name for name, _ in layout} - set(names or ()):
            told = f"batch {key}: its object does not list the quality {min(unlisted)}"
            different.append(Disagreement(object_id, told))
    width = func.length(trials.c.qualities)
    widths = select(trials.c.object_id, trials.c.batch_id, width, func.count()).where(
        trials.c.qualities.is_not(None)
    )
    grouped = widths.group_by(trials.c.object_id, trials.c.batch_id, width)
    for object_id, batch, bytes_each, count in tx.execute(grouped):
        # The last character of a type is how many bytes a number of it has.
        wanted = sum(int(kind[-1]) for _, kind in layouts.get(batch, []))
        if bytes_each != wanted:
            told = f"{count} trials of batch {batch} have {bytes_each} bytes of qualities instead of {wanted}"
            different.append(Disagreement(object_id, told))
    return different


def recount(tx: Tx, object_id: int) -> None:
    """Make an object's tallies, batches and counters those of its rows, in a new epoch of it.

    Safe while services write: under the object's lock, from rows that this transaction alone may change.
    """
    object_rows.advance(tx, object_id, append=False)
    found = survey(tx, object_id)
    own = select(provenances.c.id).where(provenances.c.object_id == object_id)
    tx.execute(delete(tallies).where(tallies.c.provenance_id.in_(own)))
    known = set(tx.scalars(own))
    counted = [
        {"provenance_id": provenance, "outcome": outcome, "row_count": rows, "packed_count": packed}
        for (provenance, outcome), (rows, packed) in sorted(found.tallies.items())
        if provenance in known
    ]
    if counted:
        tx.execute(insert(tallies), counted)
    for batch in tx.execute(select(batches).where(batches.c.object_id == object_id)).all():
        rows = found.by_batch.get((object_id, batch.id), _Rows())
        values: dict[str, Any] = {
            "inserted": rows.count,
            "packed": found.packed.get(batch.sweep_id, 0) if batch.sweep_id else 0,
        }
        if rows.first is not None:
            values |= {"first_seq": rows.first, "last_seq": rows.last}
        tx.execute(update(batches).where(batches.c.id == batch.id).values(values))
    now = tx.execute(select(objects.c.revision, objects.c.last_seq).where(objects.c.id == object_id)).one()
    rows = found.by_object.get(object_id, _Rows())
    # Later than every revision that a row carries, and a new epoch, so that nothing remembered is answered.
    revision = max(now.revision, _newest_revisions(tx).get(object_id, 0) + 1, rows.revision + 1)
    values = {"revision": revision, "epoch": revision, "last_seq": max(now.last_seq, rows.last or 0)}
    tx.execute(update(objects).where(objects.c.id == object_id).values(values))


def slugs(tx: Tx, object_ids: set[int]) -> dict[int, str]:
    """What users call these objects."""
    rows = tx.execute(select(objects.c.id, objects.c.slug).where(objects.c.id.in_(sorted(object_ids))))
    return {int(id): str(slug) for id, slug in rows}


def _newest_revisions(tx: Tx) -> dict[int, int]:
    """The last revision that batches, packed outcomes or changes of an object's trials carry."""
    newest: dict[int, int] = defaultdict(int)
    packed = (
        select(sweeps.c.object_id, func.max(packed_outcomes.c.revision))
        .join(sweeps, sweeps.c.id == packed_outcomes.c.sweep_id)
        .group_by(sweeps.c.object_id)
    )
    for query in (
        packed,
        *(
            select(table.c.object_id, func.max(table.c.revision)).group_by(table.c.object_id)
            for table in (batches, trial_changes)
        ),
    ):
        for object_id, revision in tx.execute(query):
            newest[object_id] = max(newest[object_id], revision)
    return newest


# --- rows that belong to nobody -------------------------------------------------------------------------


def rows_without_owners(tx: Tx, found: Survey) -> list[str]:
    """Trials whose batch or provenance is not there or another object's, and what else has lost its owner."""
    own_batches = {(int(o), int(b)) for o, b in tx.execute(select(batches.c.object_id, batches.c.id))}
    own_kinds = {(int(o), int(p)) for o, p in tx.execute(select(provenances.c.object_id, provenances.c.id))}
    lost_batch = sum(rows.count for place, rows in found.by_batch.items() if place not in own_batches)
    lost_kind = sum(count for place, count in found.by_provenance.items() if place not in own_kinds)
    counted = {
        "trials whose batch is not there": lost_batch,
        "trials whose provenance is not there": lost_kind,
        "simulation jobs without a sweep": _count(
            tx, select(jobs.c.id).where(jobs.c.kind == "simulate", jobs.c.sweep_id.is_(None))
        ),
        "packed outcomes of jobs that are not done, or of another sweep": _count(
            tx,
            select(packed_outcomes.c.job_id)
            .join(jobs, jobs.c.id == packed_outcomes.c.job_id)
            .where(or_(jobs.c.state != JobState.DONE, jobs.c.sweep_id != packed_outcomes.c.sweep_id)),
        ),
        "packed outcomes of sweeps without a batch": _count(
            tx,
            select(packed_outcomes.c.job_id)
            .outerjoin(batches, batches.c.sweep_id == packed_outcomes.c.sweep_id)
            .where(batches.c.id.is_(None)),
        ),
        "changes of trials that are not there": _count(
            tx,
            select(trial_changes.c.seq)
            .outerjoin(
                trials,
                and_(trials.c.object_id == trial_changes.c.object_id, trials.c.seq == trial_changes.c.seq),
            )
            .where(trials.c.seq.is_(None)),
        ),
    }
    return [f"{number} {what}" for what, number in counted.items() if number]


def _count(tx: Tx, query: Any) -> int:
    return int(tx.scalar(select(func.count()).select_from(query.subquery())) or 0)
