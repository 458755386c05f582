"""``graspdb-server backup``, ``restore`` and ``doctor``."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from sqlalchemy.exc import DBAPIError

from graspdb_service.commands.options import DatabaseUrl, fail, settings_from
from graspdb_service.storage import schema
from graspdb_service.storage.database import Database, UnsupportedDatabase
from graspdb_service.storage.upkeep import backup as copies
from graspdb_service.storage.upkeep.archive import ArchiveReader, DamagedArchive, Manifest
from graspdb_service.storage.upkeep.layout import UncopiableValue

AsJson = Annotated[bool, typer.Option("--json", help="Print what was done as JSON.")]
_FAILURES = (
    *(copies.NothingToCopy, copies.RefusedRestore, DamagedArchive, UncopiableValue),
    *(schema.StaleSchema, UnsupportedDatabase, OSError),
)


def backup(
    file: Annotated[Path, typer.Argument(help="Where to write the backup.")],
    database_url: DatabaseUrl = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE where it exists.")] = False,
    as_json: AsJson = False,
) -> None:
    """Copy everything in the database to a file, while the service goes on writing.

    The file is one moment of the database, checked when it is written; it can be restored to SQLite and to
    PostgreSQL, by this version of graspdb and by later ones.
    """
    if file.exists() and not overwrite:
        fail(f"{file} exists already: choose another name, or say --overwrite")
    with _database(database_url) as database:
        manifest = copies.back_up(database, file, _progress(as_json))
    _say(f"Wrote {file}", manifest, as_json, file=str(file), bytes=file.stat().st_size)


def restore(
    file: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="What backup wrote.")],
    database_url: DatabaseUrl = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace everything that the database holds.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Read and check FILE, and change nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Put a backup into a database, SQLite or PostgreSQL, and migrate it to this version's schema.

    Stop the service first. Nothing has changed where the file turns out to be damaged. A SQLite file that is
    replaced stays under another name.
    """
    with _failures():
        reader = ArchiveReader(file)
    try:
        if dry_run:
            with _failures():
                reader.check(_progress(as_json))
            _say(f"{file} is whole", reader.manifest, as_json)
            return
        with _database(database_url) as database:
            done = copies.restore(database, reader, overwrite=overwrite, progress=_progress(as_json))
    finally:
        reader.close()
    more = {"schema": done.schema, "replaced": done.replaced and str(done.replaced)}
    _say(f"Restored {file}", done.manifest, as_json, **more, continued_objects=done.continued)
    if as_json:
        return
    if done.schema != done.manifest.schema:
        typer.echo(f"The schema was {done.manifest.schema}, and has been migrated to {done.schema}.")
    if done.replaced is not None:
        typer.echo(f"What was there before is {done.replaced}: delete it when you need it no more.")
    if done.continued:
        typer.echo(f"{done.continued} objects had changed since: their revisions go on after those changes'.")


@contextmanager
def _database(url: str | None) -> Iterator[Database]:
    with _failures():
        database = Database(settings_from(database_url=url).database_url)
        try:
            yield database
        finally:
            database.dispose()


@contextmanager
def _failures() -> Iterator[None]:
    """End with one line where a person has to do something."""
    try:
        yield
    except DBAPIError as error:
        fail(f"The database does not answer or refuses: {' '.join(str(error.orig).split())}")
    except _FAILURES as error:
        fail(str(error))


def _progress(quiet: bool) -> Callable[[str, int], None]:
    def tell(table: str, rows: int) -> None:
        if rows and not quiet:
            typer.echo(f"  {table:<20} {rows:>12,}")

    return tell


def _say(what: str, manifest: Manifest, as_json: bool, **more: Any) -> None:
    about = {
        "schema": manifest.schema,
        "database": manifest.database,
        "graspdb": manifest.graspdb,
        "created_at": manifest.created_at,
        "rows": {table.name: table.rows for table in manifest.tables},
    }
    if as_json:
        typer.echo(json.dumps({**about, **more}))
        return
    typer.echo(
        f"{what}: {manifest.rows:,} rows in {len(manifest.tables)} tables, as of {manifest.created_at}"
        f" ({manifest.database}, schema {manifest.schema}, graspdb {manifest.graspdb})."
    )
