"""Robots: what was sent of each, and the arm that was read from it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import delete, insert, select, update

from graspdb_service.storage.database import Tx, all_as, first_as, utc_now
from graspdb_service.storage.tables import robots

_TOLD = ("id", "info", "gripper_mount", "sha256", "created_at", "updated_at")


@dataclass(frozen=True, kw_only=True)
class RobotRow:
    """A robot as stored, without its bytes; ``info`` is of :class:`graspdb.wire.RobotInfo` what the URDF
    says.
    """

    id: str
    info: dict[str, Any]
    gripper_mount: dict[str, Any] | None
    sha256: str
    created_at: datetime
    updated_at: datetime


def find(tx: Tx, id: str) -> RobotRow | None:
    """The robot with this id."""
    query = select(*(robots.c[name] for name in _TOLD)).where(robots.c.id == id)
    return first_as(tx, query, RobotRow)


def arm(tx: Tx, id: str, sha256: str) -> bytes | None:
    """The arm that was read from what was sent; None where that is not there any more."""
    content = tx.scalar(select(robots.c.arm).where(robots.c.id == id, robots.c.sha256 == sha256))
    return None if content is None else bytes(content)


def content(tx: Tx, id: str) -> tuple[bytes, str] | None:
    """What was sent, and its media type."""
    row = tx.execute(select(robots.c.content, robots.c.media_type).where(robots.c.id == id)).first()
    return None if row is None else (bytes(row.content), str(row.media_type))


def page(tx: Tx, *, after: str, limit: int) -> list[RobotRow]:
    """Up to ``limit`` robots in the order of their ids, from the one after ``after``."""
    query = select(*(robots.c[name] for name in _TOLD)).where(robots.c.id > after)
    return all_as(tx, query.order_by(robots.c.id).limit(limit), RobotRow)


def put(
    tx: Tx, id: str, *, info: dict[str, Any], sha256: str, media_type: str, content: bytes, arm: bytes
) -> None:
    """Store a robot, in place of one of the same id; its mount stays."""
    values = {"info": info, "sha256": sha256, "media_type": media_type, "content": content, "arm": arm}
    changed = update(robots).where(robots.c.id == id).values(**values, updated_at=utc_now())
    if not tx.execute(changed).rowcount:
        now = utc_now()
        tx.execute(insert(robots).values(id=id, **values, created_at=now, updated_at=now))


def change(tx: Tx, id: str, values: dict[str, Any]) -> bool:
    """Change columns of a robot; False where there is none."""
    changed = update(robots).where(robots.c.id == id).values(**values, updated_at=utc_now())
    return bool(tx.execute(changed).rowcount)


def remove(tx: Tx, id: str) -> bool:
    """Delete a robot; False where there is none."""
    return bool(tx.execute(delete(robots).where(robots.c.id == id)).rowcount)
