"""Alembic's environment: runs on the transaction that graspdb_service.storage.schema opened."""

from __future__ import annotations

from typing import Any, Literal

from alembic import context

from graspdb_service.storage.tables import UtcDateTime, metadata


def render_item(kind: str, item: Any, _: Any) -> str | Literal[False]:
    """A migration stands alone: it names SQLAlchemy's types, not ours, which may change under it."""
    if kind == "type" and isinstance(item, UtcDateTime):
        return "sa.DateTime(timezone=True)"
    return False


context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=metadata,
    # SQLite can't ALTER most things: Alembic copies the table instead.
    render_as_batch=True,
    render_item=render_item,
    compare_type=True,
    transactional_ddl=True,
)
context.run_migrations()
