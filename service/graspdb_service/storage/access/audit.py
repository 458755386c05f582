"""The audit: who changed what, written in the transaction that changes it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import insert, or_, select

from graspdb.wire.access.audit import AuditAction
from graspdb_service import principal
from graspdb_service.principal import Actor
from graspdb_service.storage.database import Tx, all_as, utc_now
from graspdb_service.storage.tables import audit


@dataclass(frozen=True)
class AuditRow:
    """One change as stored. ``object`` is the object's slug, ``subject`` what else was changed of it."""

    id: int
    at: datetime
    action: str
    key_id: str | None
    key: str | None
    object: str | None
    subject: str | None
    request_id: str | None


def record(
    tx: Tx,
    action: AuditAction,
    *,
    object: str | None = None,
    subject: str | None = None,
    by: Actor | None = None,
) -> None:
    """Write down a change, by who asks unless somebody else is named; it is kept if the change is."""
    values = {"action": action, "object": object, "subject": subject, "at": utc_now()}
    tx.execute(insert(audit).values(**values, **(by or principal.actor())._asdict()))


def page(
    tx: Tx,
    *,
    before: int | None,
    limit: int,
    object: str | None,
    key: str | None,
    action: str | None,
    since: datetime | None,
) -> list[AuditRow]:
    """Up to ``limit`` changes, the newest first, from the one before the id ``before``; of a key by id or
    name.
    """
    query = select(audit).order_by(audit.c.id.desc()).limit(limit)
    if before is not None:
        query = query.where(audit.c.id < before)
    if object is not None:
        query = query.where(audit.c.object == object)
    if key is not None:
        query = query.where(or_(audit.c.key == key, audit.c.key_id == key))
    if action is not None:
        query = query.where(audit.c.action == action)
    if since is not None:
        query = query.where(audit.c.at >= since)
    return all_as(tx, query, AuditRow)
