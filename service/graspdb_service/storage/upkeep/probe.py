"""Looking whether the database can be worked with: its schema, its file, the disk under it, and a write."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from typing import Any
from urllib.parse import quote

from sqlalchemy import text
from sqlalchemy.pool import NullPool

from graspdb_service.storage.database import Database, is_locked
from graspdb_service.storage.schema import history

_BUSY_S = 0.5
_SECONDS = 3


class Trouble(RuntimeError):
    """What is wrong with the database, and the way out, in words; ``blocks``: nothing may be asked of it."""

    def __init__(self, told: str, *, blocks: bool = False) -> None:
        super().__init__(told)
        self.blocks = blocks


class Probe:
    """Looks at a database over a connection of its own, as a new replica would."""

    def __init__(self, database: Database, *, min_free_bytes: int) -> None:
        self._min_free_bytes = min_free_bytes
        self._head = history()[-1]
        self._path = database.path
        self._file = None if self._path is None else _identity(self._path)
        self._engine = None
        if not database.is_sqlite:
            self._engine = database.postgres_engine(_SECONDS, poolclass=NullPool)

    def look(self) -> list[str]:
        """What was looked at and is well; Trouble for the first that is not, or what the driver raises."""
        if self._path is not None:
            return self._look_at_file(self._path)
        assert self._engine is not None
        with self._engine.begin() as tx:
            self._check_schema(tx.scalar(text("SELECT version_num FROM alembic_version")))
            # A record in the log that nobody reads: committed, it is a write that reaches the disk.
            tx.execute(text("SELECT pg_logical_emit_message(true, 'graspdb', 'probe')"))
        return ["schema", "write"]

    def _look_at_file(self, path: str) -> list[str]:
        if _identity(path) != self._file:
            raise Trouble(
                f"The database's file {path} was moved or replaced while the service runs: put it back, or"
                " restart the service",
                blocks=True,
            )
        disk = os.statvfs(os.path.dirname(os.path.abspath(path)))
        free = disk.f_bavail * disk.f_frsize
        if free < self._min_free_bytes:
            raise Trouble(
                f"The disk under the database has only {free:,} bytes free: make room, for nothing more"
                " can be stored"
            )
        with closing(
            sqlite3.connect(_uri(path), uri=True, timeout=_BUSY_S, isolation_level=None)
        ) as database:
            self._check_schema(database.execute("SELECT version_num FROM alembic_version").fetchone()[0])
            with suppress(_Busy), _unless_busy():
                database.execute("BEGIN IMMEDIATE")
                (number,) = database.execute("PRAGMA user_version").fetchone()
                # A number in the file's head that nothing else uses.
                database.execute(f"PRAGMA user_version = {(number + 1) % 2**31}")
                database.execute("COMMIT")
        return ["file", "disk", "schema", "write"]

    def _check_schema(self, version: Any) -> None:
        if version != self._head:
            raise Trouble(
                f"The database is at schema {version}, this service needs {self._head}: run graspdb-server"
                " migrate of this version, or restart with the version that migrated it"
            )


class _Busy(Exception):
    """Somebody else writes just now, so that writing works."""


@contextmanager
def _unless_busy() -> Iterator[None]:
    try:
        yield
    except sqlite3.OperationalError as error:
        if is_locked(error):
            raise _Busy from None
        raise


def _identity(path: str) -> tuple[int, int] | None:
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _uri(path: str) -> str:
    return f"file:{quote(os.path.abspath(path))}?mode=rw"
