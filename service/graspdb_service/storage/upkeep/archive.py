"""The file of a backup: a ZIP archive of one stream a table and a manifest that says what they must be.

``tables/NAME.ndjson`` has blocks of rows, one JSON array of arrays a line, their values in the order of the
manifest's columns: integers, numbers and text as they are, booleans as 0 and 1, JSON as its text, bytes as
base64, times as ``YYYY-MM-DD HH:MM:SS.ffffff`` in UTC. ``manifest.json`` comes last and has the schema's
version and for every table its columns, rows, bytes and SHA-256, so that a file cut short or changed anywhere
is known by itself. Any program that reads ZIP and JSON reads it.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import orjson

FORMAT = "graspdb-backup"
FORMAT_VERSION = 1
_MANIFEST = "manifest.json"
_PIECE = 1 << 20
#: What reading a file that is no archive, or a damaged one, may raise besides ours.
_UNREADABLE = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, KeyError, ValueError, TypeError),
    *(NotImplementedError, RuntimeError, OverflowError, MemoryError, AssertionError, OSError),
)

Rows = list[tuple[Any, ...]]


class DamagedArchive(ValueError):
    """The file is no backup, or no more what was written; the message says where."""


@dataclass(frozen=True)
class TableEntry:
    """A table in the manifest. ``last_id`` is the last number that its counter gave out; null without one."""

    name: str
    columns: list[str]
    rows: int
    bytes: int
    sha256: str
    last_id: int | None


@dataclass(frozen=True)
class Manifest:
    """What a backup holds: the schema's version, who wrote it when from what, and the tables."""

    schema: str
    graspdb: str
    database: str
    created_at: str
    tables: list[TableEntry]

    @property
    def rows(self) -> int:
        return sum(table.rows for table in self.tables)


class ArchiveWriter:
    """Writes tables one after the other; what is not finished by :meth:`finish` is no archive."""

    def __init__(self, path: Path) -> None:
        # Keys' hashes and everything that was measured are in it: for its owner alone.
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        self._file = os.fdopen(descriptor, "wb")
        self._zip = zipfile.ZipFile(self._file, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
        self._tables: list[TableEntry] = []

    def add(
        self, name: str, columns: list[str], blocks: Iterable[tuple[int, bytes]], last_id: int | None
    ) -> int:
        """Write a table's lines, each with the number of its rows; how many rows it has."""
        digest, rows, size = hashlib.sha256(), 0, 0
        with self._zip.open(f"tables/{name}.ndjson", "w", force_zip64=True) as stream:
            for count, line in blocks:
                rows += count
                for piece in (line, b"\n"):
                    digest.update(piece)
                    size += stream.write(piece)
        self._tables.append(TableEntry(name, columns, rows, size, digest.hexdigest(), last_id))
        return rows

    def finish(self, **about: str) -> Manifest:
        """Write the manifest and see that all of it is on the disk."""
        manifest = Manifest(tables=self._tables, **about)
        document = {"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(manifest)}
        self._zip.writestr(_MANIFEST, json.dumps(document, indent=1))
        self._zip.close()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        return manifest

    def abandon(self) -> None:
        """Close the file as it is."""
        with suppress(OSError, ValueError):
            self._zip.close()
        self._file.close()


class ArchiveReader:
    """Reads a backup; DamagedArchive wherever it is not what the manifest says."""

    def __init__(self, path: Path) -> None:
        with _damage("it is no backup of graspdb, or only the beginning of one"):
            self._zip = zipfile.ZipFile(path)
            try:
                self.manifest = _manifest(json.loads(self._zip.read(_MANIFEST)))
            except BaseException:
                self._zip.close()
                raise
        names = sorted(self._zip.namelist())
        if names != sorted([_MANIFEST, *(f"tables/{table.name}.ndjson" for table in self.manifest.tables)]):
            self._zip.close()
            raise DamagedArchive("its tables are not those of its manifest")

    def blocks(self, table: TableEntry) -> Iterator[Rows]:
        """The rows of a table, block by block; judged when the last one has been read."""
        digest, rows, size = hashlib.sha256(), 0, 0
        with (
            _damage(f"the table {table.name} is damaged"),
            self._zip.open(f"tables/{table.name}.ndjson") as stream,
        ):
            rest: list[bytes] = []
            while piece := stream.read(_PIECE):
                digest.update(piece)
                size += len(piece)
                *lines, last = piece.split(b"\n")
                for line in lines:
                    block = orjson.loads(b"".join([*rest, line]))
                    rest = []
                    rows += len(block)
                    yield block
                rest.append(last)
            if any(rest) or (rows, size, digest.hexdigest()) != (table.rows, table.bytes, table.sha256):
                raise DamagedArchive(f"the table {table.name} is not what was written: its SHA-256 differs")

    def check(self, progress: Callable[[str, int], None]) -> None:
        """Read everything and keep nothing."""
        for table in self.manifest.tables:
            for _ in self.blocks(table):
                pass
            progress(table.name, table.rows)

    def close(self) -> None:
        self._zip.close()


def _manifest(document: dict[str, Any]) -> Manifest:
    if document.pop("format") != FORMAT:
        raise DamagedArchive("it is no backup of graspdb")
    version = document.pop("format_version")
    if version != FORMAT_VERSION:
        raise DamagedArchive(f"it has the format {version}, this version reads {FORMAT_VERSION}")
    tables = [TableEntry(**table) for table in document.pop("tables")]
    return Manifest(tables=tables, **document)


@contextmanager
def _damage(what: str) -> Iterator[None]:
    """Name what could not be read in place of the library's own error."""
    try:
        yield
    except DamagedArchive:
        raise
    except _UNREADABLE as error:
        raise DamagedArchive(f"{what} ({error or type(error).__name__})") from error
