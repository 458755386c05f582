"""What was learned of all objects that a gripper tried, known by the gripper and which trials count."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import case, delete, func, select

from graspdb.wire import OUTCOME_CODES
from graspdb_service.storage.database import Tx, begins_with, first_as, insert_or
from graspdb_service.storage.tables import learned_transfers, objects, provenances
from graspdb_service.storage.tables import tallies as tallied

#: Kept, the newest.
_MOST = 64


@dataclass(frozen=True, eq=False)
class TransferRow:
    """``objects`` that it was learned of: epoch and attempts of each, by its id in words; no content where
    they taught nothing.
    """

    number: int
    objects: dict[str, list[int]]
    content: bytes | None


@dataclass(frozen=True)
class Teacher:
    """An object with a shape and attempts with a gripper, simulated collisions not counted."""

    id: int
    slug: str
    epoch: int
    attempts: int


def newest(tx: Tx, digest: str) -> int | None:
    """What tells whether what was learned last under this SHA-256 is known already."""
    found = tx.execute(
        select(learned_transfers.c.number).where(learned_transfers.c.digest == digest)
    ).scalar()
    return None if found is None else int(found)


def find(tx: Tx, digest: str) -> TransferRow | None:
    """What was learned last under this SHA-256."""
    columns = (learned_transfers.c[name] for name in ("number", "objects", "content"))
    return first_as(tx, select(*columns).where(learned_transfers.c.digest == digest), TransferRow)


def put(tx: Tx, digest: str, taught_by: dict[str, list[int]], content: bytes | None) -> None:
    """Keep it in place of what was learned before; the newest of all stay."""
    tx.execute(delete(learned_transfers).where(learned_transfers.c.digest == digest))
    values: dict[str, Any] = {"digest": digest, "objects": taught_by, "content": content}
    tx.execute(insert_or(tx, learned_transfers).values(values).on_conflict_do_nothing())
    order = select(learned_transfers.c.number).order_by(learned_transfers.c.number.desc())
    last = order.offset(_MOST).limit(1).scalar_subquery()
    tx.execute(delete(learned_transfers).where(learned_transfers.c.number <= last))


def teachers(
    tx: Tx, gripper: str, *, prefix: str, least: int, least_of_each: int, most: int
) -> list[Teacher]:
    """Objects, their ids beginning so, with a shape and at least so many attempts with any version of a
    gripper, and of either outcome; those with most of the rarer outcome, in the order of their ids.
    """
    codes = OUTCOME_CODES
    count = tallied.c.row_count + tallied.c.packed_count
    won = func.sum(case((tallied.c.outcome == codes["success"], count), else_=0))
    every = func.sum(count)
    rarer = case((won < every - won, won), else_=every - won)
    query = (
        select(objects.c.id, objects.c.slug, objects.c.epoch, every.label("attempts"))
        .join(provenances, provenances.c.object_id == objects.c.id)
        .join(tallied, tallied.c.provenance_id == provenances.c.id)
        .where(provenances.c.gripper == gripper)
        .where((objects.c.mesh_sha256.is_not(None)) | (objects.c.parts_sha256.is_not(None)))
        .where(tallied.c.outcome.not_in([codes["collision"], codes["simulation_error"]]))
        .group_by(objects.c.id, objects.c.slug, objects.c.epoch)
        .having(every >= least, rarer >= least_of_each)
        .order_by(rarer.desc(), objects.c.id)
        .limit(most)
    )
    if prefix:
        query = query.where(begins_with(objects.c.slug, prefix))
    # PostgreSQL's sums are decimals.
    found = [Teacher(int(each), slug, int(epoch), int(n)) for each, slug, epoch, n in tx.execute(query)]
    return sorted(found, key=lambda each: each.id)
