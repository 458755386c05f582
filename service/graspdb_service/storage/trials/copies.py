"""Copies of objects, made in the database: however many trials there are, none passes through Python.

Rows keep their sequence numbers and revisions, and the copy has its original's: what counts on the order of
commits is as it was. Call everything here in one transaction, under the original's lock.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import (
    ColumnElement,
    FromClause,
    String,
    Table,
    and_,
    case,
    cast,
    exists,
    insert,
    literal,
    null,
    or_,
    select,
    update,
)
from sqlalchemy.sql.expression import Executable

from graspdb.wire.states import JobState
from graspdb_service.storage.database import Tx, new_uuid, utc_now
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.simulation import sweeps as sweep_rows
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.storage.tables import (
    batches,
    findings,
    jobs,
    objects,
    packed_outcomes,
    provenances,
    sweeps,
    tallies,
    trial_changes,
    trials,
)

_OWN = (
    "name",
    "mass_kg",
    "density_kg_m3",
    "friction",
    "metadata",
    "frames",
    "mesh_sha256",
    "mesh_info",
    "parts_sha256",
)


def create(tx: Tx, row: ObjectRow, slug: str, copied_from: Mapping[str, Any], *, trials: bool) -> int | None:
    """Insert an object with another's properties, mesh and parts: its internal id; None where the slug is
    taken. With ``trials`` it starts at the other's revision.
    """
    if tx.scalar(select(exists().where(objects.c.slug == slug))):
        return None
    now = utc_now()
    numbers = {name: getattr(row, name) if trials else 0 for name in ("revision", "epoch", "last_seq")}
    values = {name: getattr(row, name) for name in (*_OWN, "parts_info")}
    values["quality_names"] = row.quality_names if trials else None
    statement = insert(objects).values(
        slug=slug, **values, **numbers, copied_from=dict(copied_from), created_at=now, updated_at=now
    )
    return int(tx.execute(statement.returning(objects.c.id)).scalar_one())


def grippers_of(tx: Tx, object_id: int) -> list[str]:
    """The grippers that an object's trials name, or have named."""
    query = select(provenances.c.gripper).where(
        provenances.c.object_id == object_id, provenances.c.gripper.is_not(None)
    )
    return sorted(set(tx.scalars(query)))


def copy_trials(tx: Tx, original: int, copy: int) -> None:
    """Copy all trials, with their batches, history and findings, and what collecting sweeps, and those that
    compare with them, have finished.

    Checks stay behind: they judge estimates of the object that they were made of.
    """
    numbers = _provenances(tx, original, copy)
    if not numbers:
        return
    collected = select(sweeps.c.id).where(sweeps.c.object_id == original, sweeps.c.purpose == "collect")
    compared = and_(sweeps.c.purpose == "compare", sweeps.c.linked.in_(collected))
    of_sweeps = select(sweeps.c.id).where(
        sweeps.c.object_id == original, or_(sweeps.c.purpose == "collect", compared)
    )
    kept = or_(batches.c.sweep_id.is_(None), batches.c.sweep_id.in_(of_sweeps))
    # Until the rows are there, a batch's key tells which one it was.
    _insert(
        tx, batches, batches, [batches.c.object_id == original, kept],
        id=None, object_id=literal(copy), sweep_id=null(), key=_mark(copy, batches.c.id),
    )  # fmt: skip
    copied = batches.alias("copied")
    of_trial = trials.join(copied, copied.c.key == _mark(copy, trials.c.batch_id))
    _insert(
        tx, trials, of_trial, [trials.c.object_id == original],
        object_id=literal(copy), batch_id=copied.c.id,
        provenance_id=case(numbers, value=trials.c.provenance_id),
        # What they tried were answers about the original.
        answer_number=null(),
    )  # fmt: skip
    _insert(
        tx, trial_changes, trial_changes, [trial_changes.c.object_id == original], object_id=literal(copy)
    )
    other = batches.alias("other")
    of_finding = findings.join(copied, copied.c.key == _mark(copy, findings.c.batch_id)).outerjoin(
        other, other.c.key == _mark(copy, findings.c.other_batch_id)
    )
    _insert(
        tx, findings, of_finding, [],
        batch_id=copied.c.id, other_batch_id=other.c.id,
        provenance_id=case(numbers, value=findings.c.provenance_id),
    )  # fmt: skip
    _insert(
        tx, tallies, tallies, [tallies.c.provenance_id.in_(list(numbers))],
        provenance_id=case(numbers, value=tallies.c.provenance_id),
    )  # fmt: skip
    found = sweep_rows.find_many(tx, tx.scalars(of_sweeps).all())
    kept_sweeps = [sweep for sweep in found.values() if sweep.batch_id is not None]
    names = {sweep.id: str(uuid.uuid4()) for sweep in kept_sweeps}
    for sweep in kept_sweeps:
        linked = None if sweep.linked is None else names.get(sweep.linked)
        _sweep(tx, sweep, names[sweep.id], copy, numbers[sweep.provenance_id], linked)
    tx.execute(
        update(batches)
        .where(batches.c.object_id == copy, batches.c.sweep_id.is_(None))
        .values(key=new_uuid())
    )


def _provenances(tx: Tx, original: int, copy: int) -> dict[int, int]:
    """The provenances of a copy, by those that they are of."""
    used = or_(
        exists().where(tallies.c.provenance_id == provenances.c.id),
        exists().where(sweeps.c.provenance_id == provenances.c.id),
    )
    found = tx.execute(select(provenances).where(provenances.c.object_id == original, used)).mappings().all()
    numbers = {}
    for item in found:
        values = {**item, "object_id": copy}
        number = int(values.pop("id"))
        made = insert(provenances).values(values).returning(provenances.c.id)
        numbers[number] = int(tx.execute(made).scalar_one())
    return numbers


def _sweep(tx: Tx, sweep: SweepRow, number: str, copy: int, provenance_id: int, linked: str | None) -> None:
    """Copy a sweep as far as it has come: its finished chunks, which are all that a copy can have of it."""
    key = str(uuid.uuid4())
    unfinished = exists().where(jobs.c.sweep_id == sweep.id, jobs.c.state != JobState.DONE)
    _insert(
        tx, sweeps, sweeps, [sweeps.c.id == sweep.id],
        id=literal(number), object_id=literal(copy), provenance_id=literal(provenance_id),
        cancelled=or_(sweeps.c.cancelled, unfinished), linked=literal(linked, String),
    )  # fmt: skip
    sweep_rows.keep_snapshot(tx, number, {**sweep.snapshot, "batch": key})
    marked = batches.c.key == f"{copy}-{sweep.batch_id}"
    tx.execute(update(batches).where(marked).values(sweep_id=number, key=key))
    _insert(
        tx, jobs, jobs, [jobs.c.sweep_id == sweep.id, jobs.c.state == JobState.DONE],
        id=new_uuid(), object_id=literal(copy), sweep_id=literal(number), lease_id=null(),
    )  # fmt: skip
    copied = jobs.alias("copied")
    same_chunk = and_(copied.c.sweep_id == number, copied.c.number == packed_outcomes.c.number)
    _insert(
        tx, packed_outcomes, packed_outcomes.join(copied, same_chunk),
        [packed_outcomes.c.sweep_id == sweep.id],
        job_id=copied.c.id, sweep_id=literal(number),
    )  # fmt: skip


def has_copied(tx: Tx, object_id: int, *, last_seq: int, revision: int) -> bool:
    """Whether an object still has trials, or packed outcomes, of those that came with it."""
    query = select(
        or_(
            exists().where(trials.c.object_id == object_id, trials.c.seq <= last_seq),
            exists().where(
                batches.c.object_id == object_id, batches.c.revision <= revision, batches.c.packed > 0
            ),
        )
    )
    return bool(tx.scalar(query))


def _mark(copy: int, number: ColumnElement[Any]) -> ColumnElement[str]:
    return literal(f"{copy}-", String) + cast(number, String)


def _insert(
    tx: Tx, table: Table, source: FromClause, where: Sequence[ColumnElement[bool]], **other: Any
) -> None:
    """Copy rows of a table; columns that are ``other`` than there by their names, None for none."""
    chosen = {column.name: other.get(column.name, column) for column in table.c}
    columns = {name: column for name, column in chosen.items() if column is not None}
    rows = select(*(column.label(name) for name, column in columns.items())).select_from(source).where(*where)
    if table is batches:
        # Numbered in the order in which they were made.
        rows = rows.order_by(batches.c.id)
    statement: Executable = insert(table).from_select(list(columns), rows)
    tx.execute(statement)
