"""A copy of everything that a database holds, taken while services write, and put back into either kind.

A backup is one snapshot: every row as it was at one moment, at whatever version the schema then had.
Restoring makes that schema, stores the rows under it, and migrates to this version's, all in one transaction
or in a file of its own, so that what was there stays until the last checksum has been seen.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from sqlalchemy import MetaData, func, inspect, select, text
from sqlalchemy.exc import DBAPIError

from graspdb_service import __version__
from graspdb_service.storage import schema
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database, Tx, is_locked
from graspdb_service.storage.tables import grippers, objects
from graspdb_service.storage.upkeep import layout
from graspdb_service.storage.upkeep.archive import ArchiveReader, ArchiveWriter, DamagedArchive, Manifest
from graspdb_service.storage.upkeep.layout import TableLayout, UncopiableValue

#: Tables that a service which has only just started has rows in.
_SEEDED = ("grippers", "gripper_versions")

Progress = Callable[[str, int], None]
"""Told each table and its rows once they are through."""


class RefusedRestore(RuntimeError):
    """The database must stay as it is; the message says why, and the way out."""


class NothingToCopy(RuntimeError):
    """There is no database at the URL, or none of graspdb's."""


@dataclass(frozen=True)
class Restored:
    """What a restore did. ``replaced`` is where a SQLite file that stood there is now; ``continued`` counts
    objects that had changed since the backup, whose revisions go on after what clients may have seen.
    """

    manifest: Manifest
    schema: str
    replaced: Path | None
    continued: int


def back_up(database: Database, path: Path, progress: Progress) -> Manifest:
    """Write a snapshot of the database to ``path``, which appears only once it is whole and has been read
    again. NothingToCopy, UncopiableValue; the file is replaced where there is one.
    """
    require_file(database)
    unfinished = path.with_name(path.name + ".unfinished")
    writer = ArchiveWriter(unfinished)
    try:
        with database.read() as tx:
            unhurried(tx)
            revision = _known_schema(tx)
            for table in layout.layout_of(revision):
                rows = writer.add(
                    table.name, table.columns, layout.blocks(tx, table), layout.last_id(tx, table)
                )
                progress(table.name, rows)
        manifest = writer.finish(
            schema=revision,
            graspdb=__version__,
            database=database.url.get_backend_name(),
            created_at=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        )
        reader = ArchiveReader(unfinished)
        try:
            reader.check(lambda *_: None)
        finally:
            reader.close()
        os.replace(unfinished, path)
        _sync_folder(path)
    finally:
        writer.abandon()
        with suppress(FileNotFoundError):
            unfinished.unlink()
    return manifest


def restore(database: Database, reader: ArchiveReader, *, overwrite: bool, progress: Progress) -> Restored:
    """Make the database what the backup holds, migrated to this version's schema.

    RefusedRestore where there is data already and not ``overwrite``, or where somebody uses the database;
    DamagedArchive; UncopiableValue for what this kind of database can't hold. Then nothing has changed.
    """
    tables = _expected_tables(reader)
    if database.is_sqlite:
        return _restore_file(database, reader, tables, overwrite=overwrite, progress=progress)
    with database.write() as tx:
        schema.lock(tx)
        schema.refuse_newer(tx)
        unhurried(tx)
        if _in_use(tx):
            raise RefusedRestore(
                "Others are connected to the database: stop every service (they would go on answering from"
                " what they remember), or restore into a new database and let GRASPDB_DATABASE_URL name it"
            )
        held = _held_already(tx)
        if held and not overwrite:
            raise _refused(held)
        seen = _seen_revisions(tx)
        _drop_all(tx)
        continued, revision = _fill(tx, reader, tables, seen, progress)
    return Restored(reader.manifest, revision, None, continued)


def require_file(database: Database) -> None:
    """NothingToCopy where a SQLite URL names no file: opening it would make one."""
    if database.is_sqlite and not Path(database.url.database or "").is_file():
        raise NothingToCopy(f"There is no database at {database.url.database}")


def unhurried(tx: Tx) -> None:
    """Lift the time limits on statements for this transaction: it reads everything there is."""
    if tx.dialect.name == "postgresql":
        tx.execute(text("SET LOCAL statement_timeout = 0"))
        tx.execute(text("SET LOCAL idle_in_transaction_session_timeout = 0"))


def _known_schema(tx: Tx) -> str:
    revision = schema.current(tx)
    if revision is None:
        raise NothingToCopy("The database has no schema of graspdb: there is nothing to back up")
    schema.refuse_newer(tx)
    return revision


def _expected_tables(reader: ArchiveReader) -> list[TableLayout]:
    """The layout of the backup's schema, which its tables must be."""
    revision = reader.manifest.schema
    if revision not in schema.history():
        raise RefusedRestore(
            f"The backup is of schema {revision}, which this version of graspdb, {__version__}, does not"
            f" know: restore it with graspdb {reader.manifest.graspdb} or newer"
        )
    tables = layout.layout_of(revision)
    held = {table.name: table.columns for table in reader.manifest.tables}
    if held != {table.name: table.columns for table in tables}:
        raise DamagedArchive(f"its tables are not those of schema {revision}")
    return tables


def _fill(
    tx: Tx,
    reader: ArchiveReader,
    tables: list[TableLayout],
    seen: dict[int, tuple[int, int]],
    progress: Progress,
) -> tuple[int, str]:
    """Make the schema and store the rows: how many objects had moved on, and the schema's version."""
    schema.apply(tx, reader.manifest.schema)
    if tx.dialect.name == "sqlite":
        tx.exec_driver_sql("PRAGMA defer_foreign_keys = ON")
    # What migrations put in themselves is in the backup, as it was there.
    for table in reversed(tables):
        tx.exec_driver_sql(f'DELETE FROM "{table.name}"')
    entries = {entry.name: entry for entry in reader.manifest.tables}
    for table in tables:
        entry = entries[table.name]
        try:
            layout.load(tx, table, reader.blocks(entry))
        except tx.dialect.loaded_dbapi.Error as error:
            raise UncopiableValue(f"the table {table.name} can't be stored here: {error}") from error
        if layout.count_rows(tx, table) != entry.rows:
            raise DamagedArchive(f"the table {table.name} has other rows here than in the backup")
        if entry.last_id is not None:
            layout.set_last_id(tx, table, entry.last_id)
        progress(table.name, entry.rows)
    revision = schema.apply(tx)
    return _continue_revisions(tx, seen), revision


# --- SQLite ---------------------------------------------------------------------------------------------


def _restore_file(
    database: Database,
    reader: ArchiveReader,
    tables: list[TableLayout],
    *,
    overwrite: bool,
    progress: Progress,
) -> Restored:
    """Fill a new file beside the old one, and put it in its place when it is whole."""
    path = Path(database.url.database or "").absolute()
    seen: dict[int, tuple[int, int]] = {}
    if path.exists():
        seen = _look_at_file(database, overwrite=overwrite)
    fresh = path.with_name(path.name + ".restoring")
    _remove(fresh)
    new = Database(f"sqlite:///{fresh}")
    try:
        with new.write() as tx:
            continued, revision = _fill(tx, reader, tables, seen, progress)
    except BaseException:
        new.dispose()
        _remove(fresh)
        raise
    # The last connection moves the journal into the file and removes it.
    new.dispose()
    kept = _put_in_place(fresh, path) if path.exists() else None
    if kept is None:
        os.replace(fresh, path)
    _sync_folder(path)
    return Restored(reader.manifest, revision, kept, continued)


def _look_at_file(database: Database, *, overwrite: bool) -> dict[int, tuple[int, int]]:
    """Whether a SQLite file may be replaced; its objects' revisions, as far as it can still be read."""
    try:
        with database.read() as tx:
            held = _held_already(tx)
            seen = _seen_revisions(tx)
    except DBAPIError as error:
        if not overwrite:
            raise RefusedRestore(
                f"{database.url.database} can't be read ({error.orig}): to put the backup in its place, which"
                " keeps the file under another name, say --overwrite"
            ) from None
        return {}
    finally:
        database.dispose()
    if held and not overwrite:
        raise _refused(held)
    return seen


def _put_in_place(fresh: Path, path: Path) -> Path:
    """Replace a file that nobody has open, and keep it under another name."""
    if not _close_file(path):
        _remove(fresh)
        raise RefusedRestore(
            f"{path} is in use: stop the service, which would go on answering from what it remembers"
        )
    kept = path.with_name(f"{path.name}.replaced-{datetime.now(timezone.utc):%Y%m%dT%H%M%S%f}")
    os.link(path, kept)
    for suffix in ("-wal", "-shm"):
        # Of a file too damaged to be closed in order: beside another file it would damage that one.
        journal = path.with_name(path.name + suffix)
        if journal.exists():
            os.replace(journal, kept.with_name(kept.name + suffix))
    os.replace(fresh, path)
    return kept


def _close_file(path: Path) -> bool:
    """Fold a SQLite file's journal into it; False where somebody has it open. A damaged one stays."""
    with closing(sqlite3.connect(path, isolation_level=None, timeout=0)) as connection:
        try:
            # Whoever has the file open in WAL mode keeps a lock on it that this one does not agree with.
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")
            connection.execute("BEGIN EXCLUSIVE")
            connection.execute("COMMIT")
            connection.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.DatabaseError as error:
            return not is_locked(error)
    return True


def _remove(path: Path) -> None:
    for suffix in ("", "-wal", "-shm", "-journal"):
        with suppress(FileNotFoundError):
            path.with_name(path.name + suffix).unlink()


def _sync_folder(path: Path) -> None:
    """See that a name survives a power cut."""
    folder = os.open(path.absolute().parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


# --- what is there already ------------------------------------------------------------------------------


def _refused(held: list[str]) -> RefusedRestore:
    return RefusedRestore(
        f"The database holds data already ({', '.join(held)}): restore into a new one, or replace everything"
        " in it by saying --overwrite"
    )


def _held_already(tx: Tx) -> list[str]:
    """Tables with rows that nobody but a user can have put there."""
    revision, found = schema.current(tx), inspect(tx).get_table_names()
    if revision is None or revision not in schema.history():
        # Of a newer version, or of another program, whose file it is.
        return found if tx.dialect.name == "sqlite" else []
    held = []
    for table in layout.layout_of(revision):
        if table.name not in found or table.name in _SEEDED:
            continue
        if layout.count_rows(tx, table):
            held.append(table.name)
    if tx.scalar(select(func.count()).select_from(grippers).where(grippers.c.builtin.is_(False))):
        held.append(grippers.name)
    return held


def _seen_revisions(tx: Tx) -> dict[int, tuple[int, int]]:
    """Revision and last sequence number of every object, by internal id."""
    if not inspect(tx).has_table(objects.name):
        return {}
    rows = tx.execute(select(objects.c.id, objects.c.revision, objects.c.last_seq))
    return {int(id): (int(revision), int(seq)) for id, revision, seq in rows}


def _continue_revisions(tx: Tx, seen: dict[int, tuple[int, int]]) -> int:
    """Number on from where the replaced database was: an ETag, a cursor or a trial's number that a client
    got from it must not come to mean something else.
    """
    continued = 0
    for id, revision, last_seq in tx.execute(
        select(objects.c.id, objects.c.revision, objects.c.last_seq)
    ).all():
        seen_revision, seen_seq = seen.get(int(id), (0, 0))
        if seen_revision > revision:
            values = {
                "revision": seen_revision + 1,
                "epoch": seen_revision + 1,
                "last_seq": max(last_seq, seen_seq),
            }
            tx.execute(objects.update().where(objects.c.id == id).values(values))
            continued += 1
    if continued:
        audit.record(tx, "database.restore")
    return continued


def _in_use(tx: Tx) -> bool:
    others = text(
        "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database()"
        " AND pid <> pg_backend_pid() AND backend_type = 'client backend'"
    )
    return bool(tx.scalar(others))


def _drop_all(tx: Tx) -> None:
    """Drop what the schema consists of, and nothing else that may stand beside it."""
    revision = schema.current(tx)
    if revision is None:
        return
    ours = {table.name for table in layout.layout_of(revision)} | {"alembic_version"}
    found = MetaData()
    found.reflect(tx, only=lambda name, _: name in ours)
    found.drop_all(tx)
