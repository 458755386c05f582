"""One database, SQLite or PostgreSQL: transactions for readers and writers, and the clock they share."""

from __future__ import annotations

import os
import socket
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, TypeAlias, TypeVar
from weakref import WeakSet

from sqlalchemy import (
    ColumnElement,
    Connection,
    Delete,
    Double,
    Engine,
    Executable,
    Insert,
    String,
    Table,
    Update,
    create_engine,
    event,
    func,
    make_url,
    select,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import URL
from sqlalchemy.exc import ArgumentError, DBAPIError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolExhausted
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import GenericFunction

from graspdb_service.storage.tables import UtcDateTime
from graspdb_service.telemetry.record import timed

T = TypeVar("T")
Tx: TypeAlias = Connection
"""An open transaction, as the use cases pass it on."""

SQLITE_BUSY_MS = 30_000
CONNECT_S = 5
#: Seconds after which a connection whose other end is gone, without a word, is given up.
_SILENT_S = 30


class DatabaseDown(Exception):
    """The database can't be used, as is known already: nothing was asked of it."""


UNAVAILABLE = (OperationalError, PoolExhausted, DatabaseDown)
"""What a database raises that does not answer, is full, or has no connection free."""
#: Where a connection notes which tables its transaction has changed.
_CHANGED = "graspdb_changed"
CANNOT_OPEN = (DBAPIError, PoolExhausted, OSError)
"""What opening a database raises that is not there, or is none."""


def why(error: Exception) -> str:
    """What a database complains about, in a line."""
    told = str(getattr(error, "orig", None) or error).strip() or type(error).__name__
    return told.splitlines()[0]


def is_full(error: Exception) -> bool:
    """Whether an error says that the database's disk is full."""
    cause = getattr(error, "orig", None)
    if isinstance(cause, sqlite3.Error):
        # By SQLite's words, which are fixed: Python 3.10 has no codes of its errors.
        return str(cause) == "database or disk is full"
    return getattr(cause, "sqlstate", None) == "53100"


def is_locked(error: sqlite3.Error) -> bool:
    """Whether SQLite says that somebody else holds the file, or a table of it."""
    return str(error).endswith(" is locked")


class unix_now(GenericFunction[float]):
    """Seconds since 1970 by the database's own clock, which every replica shares."""

    type = Double()
    inherit_cache = True


@compiles(unix_now, "sqlite")
def _sqlite_now(element: unix_now, compiler: Any, **_: Any) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


@compiles(unix_now, "postgresql")
def _postgres_now(element: unix_now, compiler: Any, **_: Any) -> str:
    return "extract(epoch from clock_timestamp())::double precision"


class utc_now(GenericFunction[datetime]):
    """The time by the database's own clock, as rows keep it: replicas whose clocks differ agree on it."""

    type = UtcDateTime()
    inherit_cache = True


@compiles(utc_now, "sqlite")
def _sqlite_utc_now(element: utc_now, compiler: Any, **_: Any) -> str:
    # With microseconds, as SQLAlchemy reads it.
    return "(strftime('%Y-%m-%d %H:%M:%f', 'now') || '000')"


@compiles(utc_now, "postgresql")
def _postgres_utc_now(element: utc_now, compiler: Any, **_: Any) -> str:
    return "statement_timestamp()"


def clock(tx: Tx) -> datetime:
    """The time by the database's own clock, as a value to compare and to reckon with."""
    return datetime.fromtimestamp(tx.execute(select(unix_now())).scalar_one(), timezone.utc)


class new_uuid(GenericFunction[str]):
    """A random UUID (version 4) as text, another one for every row."""

    type = String(36)
    inherit_cache = True


@compiles(new_uuid, "sqlite")
def _sqlite_uuid(element: new_uuid, compiler: Any, **_: Any) -> str:
    digits = "lower(hex(randomblob({})))".format
    variant = "substr('89ab', 1 + (abs(random()) % 4), 1)"
    return (
        f"({digits(4)} || '-' || {digits(2)} || '-4' || substr({digits(2)}, 2) || '-' || {variant}"
        f" || substr({digits(2)}, 2) || '-' || {digits(6)})"
    )


@compiles(new_uuid, "postgresql")
def _postgres_uuid(element: new_uuid, compiler: Any, **_: Any) -> str:
    return "gen_random_uuid()::text"


def insert_or(tx: Tx, table: Table) -> postgresql.Insert:
    """An INSERT with ``on_conflict_do_nothing`` and ``on_conflict_do_update`` for the database of ``tx``."""
    if tx.dialect.name == "sqlite":
        # The same methods under another type.
        return sqlite.insert(table)  # type: ignore[return-value]
    return postgresql.insert(table)


def insert_new(tx: Tx, table: Table, **values: Any) -> bool:
    """Insert a row; False where one of the same key is there already."""
    statement = insert_or(tx, table).values(values).on_conflict_do_nothing()
    before = set(tx.info.get(_CHANGED, ()))
    inserted = tx.execute(statement.returning(*table.primary_key)).first() is not None
    if not inserted and _CHANGED in tx.info:
        tx.info[_CHANGED] = before
    return inserted


def first_as(tx: Tx, query: Executable, kind: Callable[..., T]) -> T | None:
    """The first row of a query as a value whose fields have its columns' names; None without any."""
    row = tx.execute(query).first()
    return None if row is None else kind(**row._mapping)


def all_as(tx: Tx, query: Executable, kind: Callable[..., T]) -> list[T]:
    """The rows of a query as values whose fields have its columns' names."""
    return [kind(**row._mapping) for row in tx.execute(query)]


def begins_with(text_: ColumnElement[str], prefix: str) -> ColumnElement[bool]:
    """Whether a text begins so, letter for letter: SQLite's LIKE would not tell A from a."""
    return func.substr(text_, 1, len(prefix)) == prefix


class UnauditedChange(RuntimeError):
    """A transaction changed what the audit is of and wrote no row of it: nothing was committed."""


class UnsupportedDatabase(ValueError):
    """The database URL names neither a SQLite file nor PostgreSQL."""


class CommitUnknown(Exception):
    """The database was told to commit, and the connection broke before it said that it had."""


@contextmanager
def _drivers_errors(tx: Tx) -> Iterator[None]:
    """Have what the driver's own cursors raise, which many rows go through, raised as SQLAlchemy's."""
    driver = tx.dialect.dbapi
    assert driver is not None
    try:
        yield
    except driver.Error as error:
        raise DBAPIError.instance(None, None, error, driver.Error, dialect=tx.dialect) from error


class Database:
    """Connections to one database, ``sqlite:///file`` or ``postgresql://...``; else UnsupportedDatabase.

    Writers on SQLite take ``BEGIN IMMEDIATE``, so that a read-modify-write can't lose another's update
    nor fail halfway with "database is locked"; readers have an engine of their own and never take a write
    lock. On PostgreSQL a reader sees one snapshot (REPEATABLE READ, read only). ``password_file`` has
    PostgreSQL's password, where the URL has none.
    """

    def __init__(
        self,
        url: str,
        *,
        pool_size: int = 40,
        statement_s: float | None = None,
        password_file: Path | None = None,
    ) -> None:
        self.url = _normalised(url)
        self._password_file = password_file
        self.is_sqlite = self.url.get_backend_name() == "sqlite"
        self.path = self.url.database if self.is_sqlite else None
        """The file of a SQLite database."""
        self.down: Callable[[], str | None] = lambda: None
        """Says why the database can't be used, where that is known without asking it."""
        self._may_create = True
        self._drivers: WeakSet[Any] = WeakSet()
        if self.is_sqlite:
            self._writer = _sqlite_engine(self.url, "BEGIN IMMEDIATE", pool_size=2, query_only=False)
            self._reader = _sqlite_engine(self.url, "BEGIN", pool_size=pool_size, query_only=True)
            for engine in (self._writer, self._reader):
                event.listen(engine, "do_connect", self._refuse_a_new_file)
        else:
            self._writer = self.postgres_engine(
                statement_s, pool_size=pool_size, max_overflow=0, pool_timeout=10, pool_pre_ping=True
            )
            self._reader = self._writer.execution_options(
                isolation_level="REPEATABLE READ", postgresql_readonly=True
            )
        event.listen(self._writer, "after_execute", _note_change)

    @contextmanager
    def read(self) -> Iterator[Tx]:
        """A read-only transaction: one snapshot of everything."""
        self._refuse_if_down()
        with timed("database"), self._reader.begin() as tx, _drivers_errors(tx):
            yield tx

    @contextmanager
    def write(self, *, audited: bool = True) -> Iterator[Tx]:
        """A writing transaction, committed when the block ends and rolled back if it raises.

        ``audited`` but for what the service brings itself. UnauditedChange where it changed an audited table
        and no row of the audit tells of it; CommitUnknown where the connection broke while it was committed.
        """
        self._refuse_if_down()
        with timed("database"), self._writer.connect() as tx:
            transaction = tx.begin()
            tx.info[_CHANGED] = set()
            with _drivers_errors(tx):
                yield tx
            changed = tx.info.pop(_CHANGED)
            if audited and changed and "audit" not in changed:
                raise UnauditedChange(
                    f"{', '.join(sorted(changed))} changed without a record: call storage.access.audit.record"
                )
            try:
                transaction.commit()
            except DBAPIError as error:
                if not error.connection_invalidated:
                    raise
                raise CommitUnknown(str(error.orig)) from error

    def _refuse_if_down(self) -> None:
        reason = self.down()
        if reason is not None:
            raise DatabaseDown(reason)

    def _refuse_a_new_file(self, _dialect: Any, _record: Any, arguments: Any, _options: Any) -> None:
        if not self._may_create and not os.path.exists(arguments[0]):
            raise sqlite3.OperationalError(f"{arguments[0]} is gone")

    def postgres_engine(self, statement_s: float | None, **pool: Any) -> Engine:
        """An engine whose connections notice that nobody is there; ``statement_s`` bounds every statement."""
        told: dict[str, Any] = {
            "connect_timeout": CONNECT_S,
            "keepalives": 1,
            "keepalives_idle": _SILENT_S,
            "keepalives_interval": 5,
            "keepalives_count": 3,
            "tcp_user_timeout": _SILENT_S * 1000,
        }
        if statement_s is not None:
            limit = round(1000 * statement_s)
            told["options"] = f"-c statement_timeout={limit} -c idle_in_transaction_session_timeout={limit}"
        # What the address itself says comes first.
        told = {name: value for name, value in told.items() if name not in self.url.query}
        engine = create_engine(self.url, connect_args=told, **pool)
        event.listen(engine, "connect", lambda connection, _: self._drivers.add(connection))
        event.listen(engine, "do_connect", self._show_password)
        return engine

    def _show_password(self, dialect: Any, _record: Any, _arguments: Any, options: Any) -> None:
        # Read for every connection, so that a password that is changed needs no restart.
        if self._password_file is None or self.url.password is not None:
            return
        try:
            # Whoever writes such a file with an editor ends its line; nothing else is cut off.
            options["password"] = self._password_file.read_text("utf-8").removesuffix("\n")
        except (OSError, UnicodeDecodeError) as error:
            told = f"GRASPDB_DATABASE_PASSWORD_FILE can't be read: {error}"
            raise dialect.dbapi.OperationalError(told) from error

    def cut(self) -> None:
        """Break every connection to a PostgreSQL that hangs: whoever waits for an answer gets an error."""
        for connection in list(self._drivers):
            with suppress(Exception), socket.socket(fileno=os.dup(connection.fileno())) as line:
                line.shutdown(socket.SHUT_RDWR)

    def keep_file(self) -> None:
        """From now on a SQLite file that is missing is an error: a new one must not take its place."""
        self._may_create = False

    def connections(self) -> tuple[int, int]:
        """Connections in use, and those open for the next."""
        # On PostgreSQL both engines are one.
        pools: Any = {engine.pool for engine in (self._writer, self._reader)}
        return sum(pool.checkedout() for pool in pools), sum(pool.checkedin() for pool in pools)

    def dispose(self) -> None:
        """Close every pooled connection."""
        self._reader.dispose()
        self._writer.dispose()


def _normalised(url: str) -> URL:
    try:
        parsed = make_url(url)
    except ArgumentError as error:
        raise UnsupportedDatabase(f"GRASPDB_DATABASE_URL is no database URL: {error}") from None
    backend = parsed.get_backend_name()
    if backend == "sqlite":
        if not parsed.database or parsed.database == ":memory:":
            raise UnsupportedDatabase("SQLite needs a file, as in sqlite:///graspdb.sqlite")
        return parsed.set(drivername="sqlite")
    if backend in ("postgresql", "postgres"):
        return parsed.set(drivername="postgresql+psycopg")
    raise UnsupportedDatabase(
        f"{backend} is not supported: use sqlite:///FILE or postgresql://USER@HOST/NAME"
    )


def _note_change(
    tx: Connection, statement: object, _several: object, _one: object, _options: object, result: Any
) -> None:
    """Note that a transaction changed a table of which every change is audited, or the audit itself."""
    if not isinstance(statement, (Insert, Update, Delete)) or _CHANGED not in tx.info:
        return
    if not result.returns_rows and result.rowcount == 0:
        return
    table = statement.table
    kind = statement.__visit_name__
    if isinstance(table, Table) and (table.name == "audit" or kind in table.info.get("audited", ())):
        tx.info[_CHANGED].add(table.name)


def _sqlite_engine(url: URL, begin: str, *, pool_size: int, query_only: bool) -> Engine:
    engine = create_engine(
        url,
        pool_size=pool_size,
        max_overflow=0,
        # pysqlite's own transaction handling would BEGIN late and commit behind our back.
        connect_args={"isolation_level": None, "check_same_thread": False, "timeout": SQLITE_BUSY_MS / 1000},
    )

    @event.listens_for(engine, "connect")
    def _configure(connection: Any, _record: Any) -> None:
        cursor = connection.cursor()
        cursor.execute(f"PRAGMA busy_timeout={SQLITE_BUSY_MS}")
        if not query_only:
            cursor.execute("PRAGMA journal_mode=WAL")
        # FULL: what was acknowledged survives a power cut, too.
        cursor.execute("PRAGMA synchronous=FULL")
        cursor.execute("PRAGMA foreign_keys=ON")
        # KiB a connection; there are many readers.
        cursor.execute(f"PRAGMA cache_size={-8_192 if query_only else -65_536}")
        if query_only:
            cursor.execute("PRAGMA query_only=ON")
        cursor.close()

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        connection.exec_driver_sql(begin)

    return engine
