"""Scenes: what stands around, as JSON."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import delete, insert, select, update

from graspdb_service.storage.database import Tx, all_as, first_as, utc_now
from graspdb_service.storage.tables import scenes

_TOLD = ("id", "sha256", "summary", "created_at", "updated_at")


@dataclass(frozen=True, kw_only=True)
class SceneRow:
    """A scene as stored, without its content."""

    id: str
    sha256: str
    summary: dict[str, Any]
    created_at: datetime
    updated_at: datetime


def find(tx: Tx, id: str) -> SceneRow | None:
    """The scene with this id."""
    return first_as(tx, select(*(scenes.c[name] for name in _TOLD)).where(scenes.c.id == id), SceneRow)


def content(tx: Tx, id: str) -> bytes | None:
    """What stands in a scene, as JSON."""
    found = tx.scalar(select(scenes.c.content).where(scenes.c.id == id))
    return None if found is None else bytes(found)


def page(tx: Tx, *, after: str, limit: int) -> list[SceneRow]:
    """Up to ``limit`` scenes in the order of their ids, from the one after ``after``."""
    query = select(*(scenes.c[name] for name in _TOLD)).where(scenes.c.id > after)
    return all_as(tx, query.order_by(scenes.c.id).limit(limit), SceneRow)


def put(tx: Tx, id: str, *, sha256: str, content: bytes, summary: dict[str, Any]) -> None:
    """Store a scene, in place of one of the same id."""
    values = {"sha256": sha256, "content": content, "summary": summary}
    changed = update(scenes).where(scenes.c.id == id).values(**values, updated_at=utc_now())
    if not tx.execute(changed).rowcount:
        now = utc_now()
        tx.execute(insert(scenes).values(id=id, **values, created_at=now, updated_at=now))


def remove(tx: Tx, id: str) -> bool:
    """Delete a scene; False where there is none."""
    return bool(tx.execute(delete(scenes).where(scenes.c.id == id)).rowcount)
