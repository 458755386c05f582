"""Provenances, what some of an object's trials have in common, and the tallies of each by outcome."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sqlalchemy import and_, func, insert, select

from graspdb_service.storage.database import Tx, insert_or
from graspdb_service.storage.tables import provenances
from graspdb_service.storage.tables import tallies as tallied
from graspdb_service.trial_columns import Provenance, gripper_parts

#: Combinations that are looked up one by one; of more all of the object's are read.
_FEW = 8
_ROWS = 500


def ensure(tx: Tx, object_id: int, provenance: Provenance) -> int:
    """The id of this combination, made if it is new. Call it under the object's lock, its gripper one version
    that is held.
    """
    known = _find(tx, object_id, provenance)
    if known is not None:
        return known
    statement = insert(provenances).values(object_id=object_id, **_columns(provenance))
    return int(tx.execute(statement.returning(provenances.c.id)).scalar_one())


def _columns(provenance: Provenance) -> dict[str, str | int | None]:
    names: dict[str, str | int | None] = dict(provenance._asdict())
    if provenance.gripper is not None:
        names["gripper"], names["gripper_version"] = gripper_parts(provenance.gripper)
    return names


def _find(tx: Tx, object_id: int, provenance: Provenance) -> int | None:
    same = [provenances.c[name].is_not_distinct_from(value) for name, value in _columns(provenance).items()]
    known = tx.execute(
        select(provenances.c.id).where(provenances.c.object_id == object_id, and_(*same)).limit(1)
    ).scalar()
    return None if known is None else int(known)


def find(tx: Tx, object_id: int, items: Collection[Provenance]) -> dict[Provenance, int]:
    """The ids of those of these combinations that there are."""
    if len(items) > _FEW:
        wanted = set(items)
        return {item: number for number, item in of_object(tx, object_id).items() if item in wanted}
    found = {item: _find(tx, object_id, item) for item in items}
    return {item: number for item, number in found.items() if number is not None}


def make(tx: Tx, object_id: int, items: Sequence[Provenance]) -> dict[Provenance, int]:
    """Ids of new combinations. Call it under the object's lock, their grippers versions that are held."""
    rows = [{"object_id": object_id, "gripper_version": None, **_columns(item)} for item in items]
    # Many in one statement, but no more parameters than every database takes.
    for start in range(0, len(rows), _ROWS):
        tx.execute(insert(provenances).values(rows[start : start + _ROWS]))
    return find(tx, object_id, items)


def spread(tx: Tx, object_id: int) -> tuple[frozenset[str], int]:
    """The protocols of an object's trials, and how many combinations they are of."""
    query = select(provenances.c.protocol, func.count()).where(provenances.c.object_id == object_id)
    counts = {name: int(n) for name, n in tx.execute(query.group_by(provenances.c.protocol))}
    return frozenset(name for name in counts if name is not None), sum(counts.values())


def of_object(tx: Tx, object_id: int) -> dict[int, Provenance]:
    """Every combination the object's trials (or planned sweeps) have, by id."""
    columns = (provenances.c[name] for name in ("id", "gripper_version", *Provenance._fields))
    query = select(*columns).where(provenances.c.object_id == object_id).order_by(provenances.c.id)
    found = {}
    for number, version, *names in tx.execute(query):
        item = Provenance(*names)
        found[number] = item if item.gripper is None else item._replace(gripper=f"{item.gripper}@{version}")
    return found


def add_tally(tx: Tx, provenance_id: int, outcome: int, *, rows: int = 0, packed: int = 0) -> None:
    """Count trials of a provenance and an outcome code; negative numbers take them out."""
    statement = insert_or(tx, tallied).values(
        provenance_id=provenance_id, outcome=outcome, row_count=rows, packed_count=packed
    )
    tx.execute(
        statement.on_conflict_do_update(
            index_elements=[tallied.c.provenance_id, tallied.c.outcome],
            set_={
                "row_count": tallied.c.row_count + statement.excluded.row_count,
                "packed_count": tallied.c.packed_count + statement.excluded.packed_count,
            },
        )
    )


def add_packed(tx: Tx, provenance_id: int, counts: dict[int, int]) -> None:
    """Count packed outcomes by code; negative numbers take them out."""
    for outcome, number in sorted(counts.items()):
        if number:
            add_tally(tx, provenance_id, outcome, packed=number)


def tallies(tx: Tx, object_id: int) -> list[tuple[int, int, int, int]]:
    """``(provenance_id, outcome_code, rows, packed)`` for all the object's trials."""
    query = (
        select(tallied)
        .join(provenances, provenances.c.id == tallied.c.provenance_id)
        .where(provenances.c.object_id == object_id)
        .order_by(tallied.c.provenance_id, tallied.c.outcome)
    )
    return [(int(p), int(o), int(r), int(k)) for p, o, r, k in tx.execute(query)]


def outcome_counts(tx: Tx, object_ids: Sequence[int]) -> dict[int, dict[int, int]]:
    """Rows and packed outcomes together, by object and outcome code."""
    found: dict[int, dict[int, int]] = {object_id: {} for object_id in object_ids}
    total = func.sum(tallied.c.row_count + tallied.c.packed_count)
    query = (
        select(provenances.c.object_id, tallied.c.outcome, total)
        .join(tallied, provenances.c.id == tallied.c.provenance_id)
        .where(provenances.c.object_id.in_(object_ids))
        .group_by(provenances.c.object_id, tallied.c.outcome)
    )
    for object_id, outcome, number in tx.execute(query):
        if number:
            found[int(object_id)][int(outcome)] = int(number)
    return found
