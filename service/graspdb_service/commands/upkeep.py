"""``graspdb-server backup``, ``restore`` and ``doctor``."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from sqlalchemy.exc import DBAPIError

from graspdb_service.commands.options import DatabaseUrl, database_of, fail, settings_from
from graspdb_service.storage import schema
from graspdb_service.storage.database import Database, UnsupportedDatabase
from graspdb_service.storage.upkeep import backup as copies
from graspdb_service.storage.upkeep.archive import ArchiveReader, DamagedArchive, Manifest
from graspdb_service.storage.upkeep.layout import UncopiableValue
from graspdb_service.usecases.upkeep import doctor as examination
from graspdb_service.usecases.upkeep.doctor import Diagnosis

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
_LEVELS = ("ok", "warning", "error")
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


def doctor(
    database_url: DatabaseUrl = None,
    repair: Annotated[
        bool, typer.Option("--repair", help="Count anew what does not agree with the rows; nothing else.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Look whether the database and the settings are in order, while the service goes on.

    Ends with 0 where all is well, 1 with warnings, 2 with errors.
    """
    settings = settings_from(database_url=database_url)
    told: list[Diagnosis] = []
    mended: list[str] = []
    with _database(database_url, code=2) as database:
        copies.require_file(database)
        if repair:
            schema.check(database)
            mended = examination.repair(database)
        for diagnosis in examination.examine(database, settings, os.environ):
            told.append(diagnosis)
            if not as_json:
                _show(diagnosis)
    worst = max((_LEVELS.index(diagnosis.level) for diagnosis in told), default=0)
    if as_json:
        checks = [asdict(diagnosis) for diagnosis in told]
        typer.echo(json.dumps({"level": _LEVELS[worst], "repaired": mended, "checks": checks}))
    elif mended:
        typer.echo(f"Counted anew: {', '.join(mended)}.")
    raise SystemExit(worst)


def _show(diagnosis: Diagnosis) -> None:
    typer.echo(f"{diagnosis.level:<8} {diagnosis.check}: {diagnosis.found}")
    if diagnosis.level != "ok":
        typer.echo(f"         {diagnosis.meaning}\n         {diagnosis.remedy}")


@contextmanager
def _database(url: str | None, code: int = 1) -> Iterator[Database]:
    with _failures(code):
        database = database_of(settings_from(database_url=url))
        try:
            yield database
        finally:
            database.dispose()


@contextmanager
def _failures(code: int = 1) -> Iterator[None]:
    """End with one line where a person has to do something."""
    try:
        yield
    except DBAPIError as error:
        fail(f"The database does not answer or refuses: {' '.join(str(error.orig).split())}", code)
    except _FAILURES as error:
        fail(str(error), code)


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
