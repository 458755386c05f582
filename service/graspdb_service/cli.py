"""``graspdb-server``: serve, migrate, and what keeps a database in order."""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

NEEDS = "graspdb-server needs {}: pip install 'graspdb[service]'"

try:
    import typer

    from graspdb.processes import LIFELINE_HELP, ChildProcess, end_with_parent
    from graspdb_service import connections
    from graspdb_service.commands import access, upkeep
    from graspdb_service.commands.keys import keys
    from graspdb_service.commands.options import DatabaseUrl, database_of, fail, settings_from
    from graspdb_service.settings import Settings
    from graspdb_service.storage import schema
    from graspdb_service.storage.database import CANNOT_OPEN, UnsupportedDatabase, why
    from graspdb_service.telemetry import logs, traces
except ModuleNotFoundError as error:
    sys.exit(NEEDS.format(error.name))

if TYPE_CHECKING:
    from fastapi import FastAPI

log = logging.getLogger("graspdb")

#: Below whatever serves: compiling can wait.
_NICE = 10
_COLD = (
    "Compiled code is missing, so that first answers are slow: it is made now, once, which takes minutes."
    " `graspdb-server warm-up` does it ahead."
)

cli = typer.Typer(add_completion=False, no_args_is_help=True, help="The GraspDB service.")
cli.add_typer(keys, name="keys")


@cli.command(epilog=LIFELINE_HELP)
def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on; 0 takes a free one.")] = None,
    database_url: DatabaseUrl = None,
    auth: Annotated[
        str | None, typer.Option(help="keys, or off for everybody; off by default on loopback alone.")
    ] = None,
    root_path: Annotated[
        str | None, typer.Option(help="Path under which a proxy serves this, such as /graspdb.")
    ] = None,
    ssl_certfile: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="Speak TLS with this certificate.")
    ] = None,
    ssl_keyfile: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="The certificate's private key.")
    ] = None,
    log_level: Annotated[
        str | None, typer.Option(help="critical, error, warning, info (the default) or debug.")
    ] = None,
    log_format: Annotated[str | None, typer.Option(help="text (the default) or json.")] = None,
) -> None:
    """Serve the HTTP API. A SQLite database is created and migrated; PostgreSQL must be current."""
    given = {"log_level": log_level, "log_format": log_format, "root_path": root_path}
    files = {"ssl_certfile": ssl_certfile, "ssl_keyfile": ssl_keyfile}
    settings = settings_from(host=host, port=port, database_url=database_url, auth=auth, **given, **files)
    access.check_certificate(settings)
    # Looking through a million new objects that all stay is a fifth of a start; `settle` has it begin.
    gc.disable()
    # Before NumPy is imported: its BLAS would start a thread a core inside each compute thread.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    logs.configure(settings.log_format, settings.log_level)
    traces.start()
    with _opening(settings):
        app = _application(settings)
        access.check(settings, app.state.context.database)
    _warm_up(app)
    connections.serve(app, settings)


def _warm_up(app: Any) -> None:
    """Load what queries need while the server already answers."""
    from graspdb_service.usecases.runtime.warmup import (  # extra: service
        NotCompiled,
        keep_tidy,
        load,
        settle,
        warm_up,
    )

    settle()

    def behind() -> None:
        compute = app.state.context.compute
        try:
            load(compute)
        except NotCompiled:
            log.warning(_COLD)
            # Not in this process, whose answers would wait for the interpreter meanwhile.
            command = [sys.executable, "-c", "from graspdb_service.cli import main; main()", "warm-up"]
            child = ChildProcess(command, stdout=subprocess.DEVNULL)
            with contextlib.suppress(OSError, AttributeError):  # AttributeError: Windows
                os.setpriority(os.PRIO_PROCESS, child.pid, _NICE)
            child.wait()
            warm_up(compute)
        keep_tidy(lambda: app.state.admission.is_quiet)

    threading.Thread(target=behind, name="graspdb-behind", daemon=True).start()


@cli.command("warm-up")
def warm_up() -> None:
    """Compile ahead what answers need, once after an install, so that no start has to: it takes minutes.

    The compiled code is kept beside the package, or where that can't be written in the user's cache, or in
    the folder that NUMBA_CACHE_DIR names, for this version on this kind of processor.
    """
    from graspdb_service.commands.ahead import compile_ahead  # extra: service

    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for name in [name for name in os.environ if name.startswith("GRASPDB_")]:
        del os.environ[name]  # a limit of the real service may refuse what is asked here
    typer.echo(f"What answers need is compiled: it took {compile_ahead():.0f} s.")


@cli.command()
def migrate(database_url: DatabaseUrl = None) -> None:
    """Bring the database's schema to this version; safe to run from several places at once."""
    settings = settings_from(database_url=database_url)
    with _opening(settings):
        typer.echo(f"The schema is at {schema.upgrade(database_of(settings))}.")


@contextmanager
def _opening(settings: Settings) -> Iterator[None]:
    """End with a line, not a traceback, where the database can't be opened."""
    try:
        yield
    except (schema.StaleSchema, UnsupportedDatabase) as error:
        fail(str(error))
    except CANNOT_OPEN as error:
        url = database_of(settings).url.render_as_string(hide_password=True)
        fail(f"The database {url} cannot be opened: {why(error)}")


@cli.command()
def openapi() -> None:
    """Print the OpenAPI document; docs/openapi.json is this output."""
    with tempfile.TemporaryDirectory() as folder:
        app = _application(Settings(database_url=f"sqlite:///{folder}/empty.sqlite"))
        typer.echo(json.dumps(app.openapi(), indent=1, ensure_ascii=False))
        app.state.context.close()


@cli.command()
def scopes() -> None:
    """Print which scope each route takes; docs/scopes.md is this output."""
    from graspdb_service.api.routing.document import scope_matrix  # extra: service

    with tempfile.TemporaryDirectory() as folder:
        app = _application(Settings(database_url=f"sqlite:///{folder}/empty.sqlite"))
        typer.echo(scope_matrix(app.openapi()), nl=False)
        app.state.context.close()


for command in (upkeep.backup, upkeep.restore, upkeep.doctor):
    cli.command()(command)


def _application(settings: Settings) -> FastAPI:
    # Imported here: migrating needs none of the numerics, which take a second to load.
    try:
        from graspdb_service.app import create_app  # extra: service
    except ModuleNotFoundError as error:
        fail(NEEDS.format(error.name))
    return create_app(settings)


def main() -> None:
    """Entry point."""
    end_with_parent()
    cli()


if __name__ == "__main__":
    main()
