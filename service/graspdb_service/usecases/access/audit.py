"""The audit read back."""

from __future__ import annotations

from datetime import datetime

from graspdb.wire.access.audit import AuditEntry
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database


def page(
    database: Database,
    *,
    before: int | None,
    limit: int,
    object: str | None,
    key: str | None,
    action: str | None,
    since: datetime | None,
) -> tuple[list[AuditEntry], int | None]:
    """A page of changes, the newest first, and before which the next one starts."""
    with database.read() as tx:
        rows = audit.page(
            tx, before=before, limit=limit + 1, object=object, key=key, action=action, since=since
        )
    items = [AuditEntry.model_validate(vars(row)) for row in rows[:limit]]
    return items, items[-1].id if len(rows) > limit else None
