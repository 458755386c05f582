"""INSERT ... ON CONFLICT, which both databases have and SQLAlchemy spells once for each."""

from __future__ import annotations

from sqlalchemy import Table
from sqlalchemy.dialects import postgresql, sqlite

from graspdb_service.storage.database import Tx


def insert(tx: Tx, table: Table) -> postgresql.Insert:
    """An INSERT with ``on_conflict_do_nothing`` and ``on_conflict_do_update`` for the database of ``tx``."""
    if tx.dialect.name == "sqlite":
        # The same methods under another type.
        return sqlite.insert(table)  # type: ignore[return-value]
    return postgresql.insert(table)
