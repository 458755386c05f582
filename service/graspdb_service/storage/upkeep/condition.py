"""The state of a database as a whole: its schema, its file or server, its clock, references, space."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sqlalchemy import and_, exists, func, or_, select, text
from sqlalchemy.exc import DBAPIError

from graspdb_service.storage.database import Database, Tx, unix_now
from graspdb_service.storage.tables import UtcDateTime, assets, batches, idempotency_keys, metadata, objects

#: Columns that say when something was done, by the database's clock.
_STAMPS = ("created_at", "updated_at", "changed_at", "started_at", "finished_at", "at")


def schema_differences(tx: Tx) -> list[str]:
    """Tables, columns, indexes and constraints that are not those of this version's tables."""
    from alembic.autogenerate import compare_metadata  # late: 0.4 s, which a start has no use for
    from alembic.migration import MigrationContext  # late: as above

    def ours(_: object, name: str | None, kind: str, reflected: bool, compared: object) -> bool:
        # Somebody's own tables beside ours are nothing that is wrong.
        return not (kind == "table" and reflected and compared is None)

    options = {"compare_type": True, "render_as_batch": True, "include_object": ours}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = compare_metadata(MigrationContext.configure(tx, opts=options), metadata)
    return [_worded(difference) for difference in found]


def _worded(difference: object) -> str:
    kind, *parts = difference[0] if isinstance(difference, list) else difference  # type: ignore[misc]
    names = [
        str(getattr(part, "name", part)) for part in parts if part is not None and not isinstance(part, dict)
    ]
    return f"{kind.replace('_', ' ')} {' '.join(names[:3])}"


def invalid_indexes(tx: Tx) -> list[str]:
    """Indexes and constraints that PostgreSQL keeps but does not trust."""
    if tx.dialect.name != "postgresql":
        return []
    indexes = text("SELECT indexrelid::regclass::text FROM pg_index WHERE NOT indisvalid OR NOT indisready")
    constraints = text(
        "SELECT conname::text FROM pg_constraint WHERE NOT convalidated"
        " AND connamespace = current_schema()::regnamespace"
    )
    return [*tx.scalars(indexes), *tx.scalars(constraints)]


def broken_references(tx: Tx) -> list[str]:
    """Rows that refer to rows which are not there, by column; of every table that the code knows."""
    broken = []
    for child in metadata.sorted_tables:
        for constraint in child.foreign_key_constraints:
            parent = constraint.referred_table.alias("parent")
            pairs = [(element.parent, parent.c[element.column.name]) for element in constraint.elements]
            there = exists().where(and_(*(parent_column == column for column, parent_column in pairs)))
            query = (
                select(func.count())
                .select_from(child)
                .where(and_(*(column.is_not(None) for column, _ in pairs)), ~there)
            )
            if number := tx.scalar(query):
                names = ", ".join(column.name for column, _ in pairs)
                broken.append(
                    f"{number} rows of {child.name} name a {constraint.referred_table.name} in {names}"
                )
    return broken


def damage(database: Database) -> list[str]:
    """What SQLite's own check of pages, indexes and rows finds; nothing on PostgreSQL."""
    if not database.is_sqlite:
        return []
    try:
        with database.read() as tx:
            found = [str(line) for line in tx.exec_driver_sql("PRAGMA integrity_check(20)").scalars()]
    except DBAPIError as error:
        found = [str(error.orig)]
    return [] if found == ["ok"] else found


@dataclass(frozen=True)
class SqliteFile:
    """A SQLite database on the disk. ``free_pages`` of ``pages`` hold nothing; sizes in bytes."""

    path: Path
    journal_mode: str
    journal_bytes: int
    bytes: int
    pages: int
    free_pages: int


def sqlite_file(database: Database) -> SqliteFile | None:
    """The file of a SQLite database and its journal; None on PostgreSQL."""
    if not database.is_sqlite:
        return None
    path = Path(database.url.database or "").absolute()
    with database.read() as tx:
        mode, pages, free = (
            tx.exec_driver_sql(f"PRAGMA {name}").scalar_one()
            for name in ("journal_mode", "page_count", "freelist_count")
        )
    journal = path.with_name(path.name + "-wal")
    size = journal.stat().st_size if journal.exists() else 0
    return SqliteFile(path, str(mode), size, path.stat().st_size, int(pages), int(free))


def clock_offset_s(tx: Tx) -> float:
    """How far the database's clock is ahead of this machine's, seconds."""
    before = time.time()
    theirs = float(tx.execute(select(unix_now())).scalar_one())
    return theirs - (before + time.time()) / 2


def newest_stamp(tx: Tx) -> datetime | None:
    """The latest time at which something in the database was done."""
    newest: datetime | None = None
    for table in metadata.sorted_tables:
        for column in table.columns:
            if column.name in _STAMPS and isinstance(column.type, UtcDateTime):
                found = tx.scalar(select(func.max(column)))
                if found is not None and (newest is None or found > newest):
                    newest = found
    return newest


def unused_assets(tx: Tx) -> tuple[int, int]:
    """Meshes and parts that no object refers to: how many, and their bytes."""
    used = exists().where(
        or_(objects.c.mesh_sha256 == assets.c.sha256, objects.c.parts_sha256 == assets.c.sha256)
    )
    query = select(func.count(), func.coalesce(func.sum(func.length(assets.c.content)), 0)).where(~used)
    number, size = tx.execute(query).one()
    return int(number), int(size)


def keys_of_lost_batches(tx: Tx) -> int:
    """Idempotency keys that would answer that a batch is there which is not."""
    query = (
        select(func.count())
        .select_from(idempotency_keys.outerjoin(batches, batches.c.key == idempotency_keys.c.batch_key))
        .where(
            idempotency_keys.c.batch_key.is_not(None),
            idempotency_keys.c.revoked.is_(False),
            batches.c.id.is_(None),
        )
    )
    return int(tx.scalar(query) or 0)
