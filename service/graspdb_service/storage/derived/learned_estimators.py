"""What estimators learned of objects' attempts, known by what they learned it from."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import delete, select

from graspdb_service.storage.database import Tx, first_as, insert_or
from graspdb_service.storage.tables import learned_estimators, objects

#: Kept of an object, the newest.
_MOST = 8


@dataclass(frozen=True, eq=False)
class LearnedRow:
    """Of how many attempts, and of which epoch of the object; no content where they taught nothing."""

    epoch: int
    attempts: int
    content: bytes | None


def find(tx: Tx, object_id: int, digest: str) -> LearnedRow | None:
    """What was learned last under this SHA-256."""
    query = select(*(learned_estimators.c[name] for name in ("epoch", "attempts", "content"))).where(
        learned_estimators.c.object_id == object_id, learned_estimators.c.digest == digest
    )
    return first_as(tx, query, LearnedRow)


def put(tx: Tx, object_id: int, digest: str, row: LearnedRow) -> None:
    """Keep it in place of what was learned before, unless its object is gone; and the object's newest."""
    # The object first, as who deletes it does: else each would wait for the other.
    object_row = select(objects.c.id).where(objects.c.id == object_id)
    if tx.execute(object_row.with_for_update(read=True, key_share=True)).first() is None:
        return
    of_object = learned_estimators.c.object_id == object_id
    tx.execute(delete(learned_estimators).where(of_object, learned_estimators.c.digest == digest))
    values = {"object_id": object_id, "digest": digest, **vars(row)}
    tx.execute(insert_or(tx, learned_estimators).values(values).on_conflict_do_nothing())
    newest = select(learned_estimators.c.number).where(of_object)
    last = newest.order_by(learned_estimators.c.number.desc()).offset(_MOST).limit(1).scalar_subquery()
    tx.execute(delete(learned_estimators).where(of_object, learned_estimators.c.number <= last))
