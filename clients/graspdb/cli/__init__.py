"""The command line for users: ``graspdb``.

Data goes to standard output, progress and messages to standard error. Errors are one message and exit
code 1; a wrong command line is exit code 2.
"""

from __future__ import annotations

import sys
from typing import Annotated

import typer
from rich.markup import escape

from graspdb import __version__
from graspdb.agents.command import mcp
from graspdb.cli import access, answers, kernels, objects, queries, reports, sweeps, trials
from graspdb.cli.common import ERRORS, State
from graspdb.cli.drawing.frames import frames
from graspdb.cli.drawing.view import view
from graspdb.cli.exchange import bundle
from graspdb.cli.exchange.exporting import export
from graspdb.cli.exchange.importing import import_files
from graspdb.cli.grippers import making
from graspdb.cli.options import Commands
from graspdb.cli.wording import in_commands
from graspdb.demo import demo
from graspdb.errors import GraspDBError
from graspdb.processes import LIFELINE_HELP

__all__ = ["app", "main"]

app = Commands(
    name="graspdb",
    help="GraspDB: grasp trials in; densities, best grasps and their likelihood out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"graspdb {__version__}")
        raise typer.Exit


@app.callback()
def settings(
    context: typer.Context,
    url: Annotated[
        str | None,
        typer.Option(
            envvar="GRASPDB_URL", help="Address of the service [http://127.0.0.1:8000].", show_default=False
        ),
    ] = None,
    api_key: Annotated[
        str | None,
        typer.Option("--api-key", envvar="GRASPDB_API_KEY", help="Your key, where the service wants one."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="JSON for machines instead of tables.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """GraspDB: grasp trials in; densities, best grasps and their likelihood out."""
    context.obj = State(context, url, api_key, json)


app.add_typer(objects.objects, name="objects")
app.command("add-example")(objects.add_example)
objects.grippers.command("from-urdf")(making.from_urdf)
objects.grippers.command("explain")(making.explain)
app.add_typer(objects.grippers, name="grippers")
app.command("frames")(frames)
app.add_typer(trials.trials, name="trials")
app.add_typer(trials.batches, name="batches")
app.command("import")(import_files)
app.command("export")(export)
app.add_typer(access.keys, name="keys")
app.command("audit")(access.audit)
app.command("density")(queries.density)
app.command("best-grasp")(queries.best_grasp)
app.command("likelihood")(queries.likelihood)
app.command("samples")(queries.samples)
app.command("proposals")(queries.proposals)
app.add_typer(answers.answers, name="answers")
app.command("report")(reports.report)
app.add_typer(kernels.kernels, name="kernels")
app.command("sweep")(sweeps.sweep)
app.add_typer(sweeps.sweeps, name="sweeps")
app.command("workers")(sweeps.workers)
app.command("info")(sweeps.info)
app.command("bundle")(bundle.bundle)
app.command("mcp")(mcp)
app.command("view", epilog=LIFELINE_HELP)(view)
app.command("demo")(demo)


def main() -> None:
    """Entry point of the ``graspdb`` command."""
    try:
        app(prog_name="graspdb")
    except (GraspDBError, ValueError, ImportError, OSError) as error:
        # TimeoutError is an OSError. Anything else is a bug, and a traceback is what helps then.
        notes = getattr(error, "__notes__", [])
        message = in_commands(str(error))
        ERRORS.print(f"[bold red]Error:[/] {escape(message)}", highlight=False, soft_wrap=True)
        for note in notes:
            ERRORS.print(escape(in_commands(note)), highlight=False, soft_wrap=True)
        sys.exit(1)
