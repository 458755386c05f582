"""Gripper profiles: the built-in ones and the user's."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Row, select

from graspdb_service.storage.database import Tx, insert_or
from graspdb_service.storage.tables import grippers


@dataclass(frozen=True)
class GripperRow:
    """A gripper as stored; ``profile`` is a :class:`graspdb.wire.GripperProfile` as JSON."""

    id: str
    name: str | None
    profile: dict[str, Any]
    builtin: bool
    created_at: datetime


def find(tx: Tx, gripper: str) -> GripperRow | None:
    """The gripper with this id."""
    row = tx.execute(select(grippers).where(grippers.c.id == gripper)).first()
    return None if row is None else _gripper(row)


def missing(tx: Tx, names: Iterable[str]) -> list[str]:
    """Those of the ids that name no gripper, sorted."""
    wanted = set(names)
    if not wanted:
        return []
    known = tx.execute(select(grippers.c.id).where(grippers.c.id.in_(sorted(wanted)))).scalars()
    return sorted(wanted - set(known))


def page(tx: Tx, *, after: str, limit: int) -> list[GripperRow]:
    """Up to ``limit`` grippers in the order of their ids, from the one after ``after``."""
    query = select(grippers).where(grippers.c.id > after).order_by(grippers.c.id).limit(limit)
    return [_gripper(row) for row in tx.execute(query)]


def create(tx: Tx, gripper: str, name: str | None, profile: dict[str, Any], *, builtin: bool = False) -> bool:
    """Insert a gripper; False where the id is taken."""
    statement = (
        insert_or(tx, grippers)
        .values(id=gripper, name=name, profile=profile, builtin=builtin, created_at=datetime.now(UTC))
        .on_conflict_do_nothing()
        .returning(grippers.c.id)
    )
    return tx.execute(statement).first() is not None


def _gripper(row: Row[Any]) -> GripperRow:
    return GripperRow(**row._mapping)
