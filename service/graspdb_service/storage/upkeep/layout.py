"""What a database of some version of the schema consists of, and its rows as plain values, in and out.

The layout comes from the migrations themselves, applied to an empty file: a table that a later one adds is in
it without a word here. Rows pass on the drivers' fast paths, a million in some seconds and few at a time.
"""

from __future__ import annotations

import base64
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import orjson
from sqlalchemy import MetaData, types

from graspdb_service.storage import schema
from graspdb_service.storage.database import Database, Tx

#: Rows of a block, and about how many bytes of its wide columns.
_BLOCK_ROWS = 1_000
_BLOCK_BYTES = 1 << 20
#: The first that fits a column's type names its kind.
_KINDS: tuple[tuple[type[types.TypeEngine[Any]], str], ...] = (
    (types.LargeBinary, "bytes"),
    (types.DateTime, "time"),
    (types.JSON, "json"),
    (types.Boolean, "boolean"),
    (types.Integer, "integer"),
    (types.Float, "number"),
    (types.String, "text"),
)
#: How PostgreSQL is asked for what SQLite stores as plain values anyway.
_POSTGRES = {
    "time": "to_char({} AT TIME ZONE 'UTC', 'YYYY-MM-DD HH24:MI:SS.US')",
    "json": "{}::text",
    "boolean": "{}::int",
}


class UncopiableValue(ValueError):
    """A value or a column that no backup can hold."""


@dataclass(frozen=True)
class TableLayout:
    """A table: its columns and their kinds, and the column that numbers its rows, if one does."""

    name: str
    kinds: dict[str, str]
    numbered_by: str | None
    #: Columns whose values may be long, which bounds how many rows are held at a time.
    wide: tuple[str, ...]

    @property
    def columns(self) -> list[str]:
        return list(self.kinds)

    def place(self, kind: str) -> list[int]:
        return [place for place, name in enumerate(self.kinds.values()) if name == kind]


def layout_of(revision: str) -> list[TableLayout]:
    """The tables of a version of the schema, each after those that it refers to."""
    with tempfile.TemporaryDirectory() as folder:
        database = Database(f"sqlite:///{folder}/layout.sqlite")
        schema.upgrade(database, revision)
        found = MetaData()
        with database.read() as tx:
            found.reflect(tx)
        database.dispose()
    tables = []
    for table in found.sorted_tables:
        if table.name == "alembic_version":
            continue
        kinds = {column.name: _kind(table.name, column.name, column.type) for column in table.columns}
        (*others, key) = table.primary_key.columns
        numbered = key.name if not others and str(key.type) == "INTEGER" else None
        wide = tuple(
            column.name
            for column in table.columns
            if kinds[column.name] in ("bytes", "json") or isinstance(column.type, types.Text)
        )
        tables.append(TableLayout(table.name, kinds, numbered, wide))
    return tables


def _kind(table: str, column: str, type_: types.TypeEngine[Any]) -> str:
    for known, kind in _KINDS:
        if isinstance(type_, known):
            return kind
    raise UncopiableValue(f"the column {table}.{column} has the type {type_}, which a backup does not know")


# --- out ------------------------------------------------------------------------------------------------


def blocks(tx: Tx, table: TableLayout) -> Iterator[tuple[int, bytes]]:
    """The rows of a table as lines of JSON, each with the number of its rows."""
    encoded, wide = table.place("bytes"), [table.columns.index(name) for name in table.wide]
    block: list[Any] = []
    size = 0
    for row in _rows(tx, table):
        for place in wide:
            value = row[place]
            if value is not None:
                size += len(value)
        block.append(_with(row, encoded, _to_base64) if encoded else row)
        if len(block) == _BLOCK_ROWS or size > _BLOCK_BYTES:
            yield len(block), _line(table, block)
            block, size = [], 0
    if block:
        yield len(block), _line(table, block)


def _rows(tx: Tx, table: TableLayout) -> Iterator[tuple[Any, ...]]:
    if tx.dialect.name == "sqlite":
        with closing(tx.connection.cursor()) as cursor:
            cursor.execute(f"SELECT {_names(table.columns)} FROM {_quoted(table.name)}")
            yield from cursor  # type: ignore[misc]
        return
    asked = ", ".join(_POSTGRES.get(kind, "{}").format(_quoted(name)) for name, kind in table.kinds.items())
    # A cursor of the server's: the client's would hold the whole table.
    driver: Any = tx.connection.driver_connection
    with driver.cursor(name="graspdb_backup", binary=True) as cursor:
        cursor.itersize = 4 if table.place("bytes") else 50 if "text" in _wide_kinds(table) else _BLOCK_ROWS
        cursor.execute(f"SELECT {asked} FROM {_quoted(table.name)}")
        yield from cursor


def _wide_kinds(table: TableLayout) -> set[str]:
    return {table.kinds[name] for name in table.wide}


def _line(table: TableLayout, block: list[tuple[Any, ...]]) -> bytes:
    line = orjson.dumps(block)
    # What is not finite would be null in JSON: another value.
    if line.count(b"null") != sum(row.count(None) for row in block):
        for row in block:
            for name, value in zip(table.columns, row, strict=True):
                if isinstance(value, float) and not math.isfinite(value):
                    raise UncopiableValue(f"{table.name}.{name} holds {value}, which is no number")
    return line


# --- in -------------------------------------------------------------------------------------------------


def load(tx: Tx, table: TableLayout, rows: Iterable[Sequence[Sequence[Any]]]) -> None:
    """Store blocks of rows as :func:`blocks` made them."""
    encoded = table.place("bytes")
    flat = ((_with(row, encoded, _from_base64) if encoded else row) for block in rows for row in block)
    names = _names(table.columns)
    with closing(tx.connection.cursor()) as cursor:
        if tx.dialect.name == "sqlite":
            places = ", ".join("?" * len(table.columns))
            cursor.executemany(f"INSERT INTO {_quoted(table.name)} ({names}) VALUES ({places})", flat)  # type: ignore[arg-type]
            return
        # Times carry no zone in a backup: they are in UTC.
        cursor.execute("SET LOCAL TimeZone = 'UTC'")
        with cursor.copy(f"COPY {_quoted(table.name)} ({names}) FROM STDIN") as copy:
            for row in flat:
                copy.write_row(row)


def last_id(tx: Tx, table: TableLayout) -> int | None:
    """The last number that a table's counter gave out, also to rows deleted since; None without one."""
    if table.numbered_by is None:
        return None
    given = [_number(tx, f"SELECT max({_quoted(table.numbered_by)}) FROM {_quoted(table.name)}")]
    if tx.dialect.name == "sqlite":
        if _number(tx, "SELECT count(*) FROM sqlite_master WHERE name = 'sqlite_sequence'"):
            given.append(_number(tx, f"SELECT seq FROM sqlite_sequence WHERE name = '{table.name}'"))
    elif sequence := _sequence(tx, table):
        given.append(_number(tx, f"SELECT CASE WHEN is_called THEN last_value ELSE 0 END FROM {sequence}"))
    return max(given)


def set_last_id(tx: Tx, table: TableLayout, number: int) -> None:
    """Let a table's counter go on after a number, so that none that it gave out ever means something else."""
    if tx.dialect.name == "sqlite":
        # Tables without a counter of their own go on after their greatest row.
        if "AUTOINCREMENT" in str(
            tx.exec_driver_sql(f"SELECT sql FROM sqlite_master WHERE name = '{table.name}'").scalar()
        ):
            tx.exec_driver_sql(f"DELETE FROM sqlite_sequence WHERE name = '{table.name}'")
            tx.exec_driver_sql(f"INSERT INTO sqlite_sequence (name, seq) VALUES ('{table.name}', {number:d})")
    elif sequence := _sequence(tx, table):
        tx.exec_driver_sql(f"SELECT setval('{sequence}', {max(number, 1):d}, {number > 0})")


def count_rows(tx: Tx, table: TableLayout) -> int:
    """How many rows a table has."""
    return _number(tx, f"SELECT count(*) FROM {_quoted(table.name)}")


def _sequence(tx: Tx, table: TableLayout) -> str | None:
    found = tx.exec_driver_sql(f"SELECT pg_get_serial_sequence('{table.name}', '{table.numbered_by}')")
    name: str | None = found.scalar()
    return name


def _number(tx: Tx, query: str) -> int:
    return int(tx.exec_driver_sql(query).scalar() or 0)


def _names(columns: Sequence[str]) -> str:
    return ", ".join(map(_quoted, columns))


def _quoted(name: str) -> str:
    return f'"{name}"'


def _with(row: Sequence[Any], places: Sequence[int], change: Callable[[Any], Any]) -> tuple[Any, ...]:
    values = list(row)
    for place in places:
        if values[place] is not None:
            values[place] = change(values[place])
    return tuple(values)


def _to_base64(value: bytes) -> str:
    return base64.b64encode(value).decode()


def _from_base64(value: str) -> bytes:
    return base64.b64decode(value)
