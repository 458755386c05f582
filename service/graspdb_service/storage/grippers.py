"""Gripper profiles: the built-in ones and the user's."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import and_, delete, exists, or_, select

from graspdb_service.storage.database import Tx, all_as, first_as, insert_new
from graspdb_service.storage.tables import grippers, kernels, provenances, sweeps, trials


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
    return first_as(tx, select(grippers).where(grippers.c.id == gripper), GripperRow)


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
    return all_as(tx, query, GripperRow)


def create(tx: Tx, gripper: str, name: str | None, profile: dict[str, Any], *, builtin: bool = False) -> bool:
    """Insert a gripper; False where the id is taken."""
    now = datetime.now(UTC)
    return insert_new(tx, grippers, id=gripper, name=name, profile=profile, builtin=builtin, created_at=now)


def is_used(tx: Tx, gripper: str) -> bool:
    """Whether trials, sweeps or kernels name the gripper."""
    own = and_(trials.c.object_id == provenances.c.object_id, trials.c.provenance_id == provenances.c.id)
    query = select(
        or_(
            exists().where(sweeps.c.gripper == gripper),
            exists().where(kernels.c.gripper == gripper),
            exists().where(provenances.c.gripper == gripper, own),
        )
    )
    return bool(tx.scalar(query))


def remove(tx: Tx, gripper: str) -> None:
    """Delete a gripper that is not used, and what is left of those that used it."""
    tx.execute(delete(provenances).where(provenances.c.gripper == gripper))
    tx.execute(delete(grippers).where(grippers.c.id == gripper))
