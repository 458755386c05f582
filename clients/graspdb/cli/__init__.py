"""The command line for users: ``graspdb``.

Data goes to standard output, progress and messages to standard error. Errors are one message and exit
code 1; a wrong command line is exit code 2.

Commands are in a table by the names of their modules, which are imported when a command is wanted: most of
what a run of one command costs would otherwise be the import of all the others.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import signal
import sys
import threading
from collections.abc import Iterator, MutableMapping
from dataclasses import dataclass
from typing import Annotated, Any

import typer
import typer.core

from graspdb import __version__

__all__ = ["TABLE", "Entry", "app", "main"]


@dataclass(frozen=True)
class Entry:
    """A command, or a group of them: what the help of all says of it, and where it is (``module:name``);
    ``epilog`` is where the text is that ends its own help.
    """

    help: str
    place: str
    epilog: str | None = None


#: By the words on the command line, in the order of the help.
TABLE = {
    "objects": Entry("Create, list, show and delete objects.", "graspdb.cli.objects:objects"),
    "add-example": Entry(
        "Add the paper's objects, with mesh and convex parts.", "graspdb.cli.objects:add_example"
    ),
    "robots": Entry(
        "Store, list, show and delete robots: arms by their URDFs.", "graspdb.cli.cells.robots:robots"
    ),
    "scenes": Entry(
        "Store, list, show and delete scenes: what stands around the gripper.",
        "graspdb.cli.cells.scenes:scenes",
    ),
    "grippers": Entry(
        "Create, list, show and delete gripper profiles.", "graspdb.cli.grippers.making:grippers"
    ),
    "frames": Entry(
        "Draw a gripper and its frames, and where a grasp of --frame in the object's frame puts it.",
        "graspdb.cli.drawing.frames:frames",
    ),
    "trials": Entry("Add and list grasp trials.", "graspdb.cli.trials:trials"),
    "batches": Entry("List and delete what arrived together.", "graspdb.cli.trials:batches"),
    "import": Entry(
        "Store the grasps of files in the formats of other projects, after a first look at them.",
        "graspdb.cli.exchange.importing:import_files",
    ),
    "export": Entry(
        "Write best grasps, samples of the density or trials in a format of the field.",
        "graspdb.cli.exchange.exporting:export",
    ),
    "bundle": Entry(
        "Save objects with mesh, parts, trials, grippers and kernels to one file, or take such a file in.",
        "graspdb.cli.exchange.bundle:bundle",
    ),
    "keys": Entry("Make, list, rotate and revoke API keys.", "graspdb.cli.access:keys"),
    "audit": Entry(
        "Show what was changed and which key did it, the newest first.", "graspdb.cli.access:audit"
    ),
    "density": Entry(
        "Show an object's grasp density: kernel, widths, counts, effective sample size.",
        "graspdb.cli.queries:density",
    ),
    "best-grasp": Entry("Find the best grasp within constraints.", "graspdb.cli.queries:best_grasp"),
    "likelihood": Entry("Say how likely grasps are.", "graspdb.cli.queries:likelihood"),
    "samples": Entry("Draw grasps from an object's density.", "graspdb.cli.queries:samples"),
    "proposals": Entry(
        "Draw grasps to try next; their proposal_density goes back with the trials.",
        "graspdb.cli.queries:proposals",
    ),
    "answers": Entry("Answers that the service keeps, by id or name.", "graspdb.cli.answers:answers"),
    "report": Entry(
        "Report on an object's trials: where grasps succeed, tolerances, enough of them, calibration,"
        " sources.",
        "graspdb.cli.reports:report",
    ),
    "kernels": Entry("Stored kernels.", "graspdb.cli.kernels:kernels"),
    "sweep": Entry(
        "Have workers simulate grasps of an object: the whole grid, or what the options say.",
        "graspdb.cli.sweeps:sweep",
    ),
    "sweeps": Entry("List, show, cancel and retry sweeps.", "graspdb.cli.sweeps:sweeps"),
    "workers": Entry("List the simulation workers.", "graspdb.cli.sweeps:workers"),
    "info": Entry("Show the service's versions and limits.", "graspdb.cli.sweeps:info"),
    "mcp": Entry(
        "Let an agent ask: a server of the Model Context Protocol, with the key of --api-key.",
        "graspdb.agents.command:mcp",
    ),
    "view": Entry(
        "Look at an object, its grasps and trials in a browser, and drag constraints about (extra `view`).",
        "graspdb.cli.drawing.view:view",
        "graspdb.processes:LIFELINE_HELP",
    ),
    "demo": Entry(
        "From nothing to a best grasp: service, worker, real physics, density, queries and a check of them.",
        "graspdb.demo:demo",
    ),
}


def _loaded(place: str) -> Any:
    """What a module has under a name, ``module:name``."""
    module, _, name = place.partition(":")
    with _interrupted_afterwards():
        return getattr(importlib.import_module(module), name)


@contextlib.contextmanager
def _interrupted_afterwards() -> Iterator[None]:
    """Have Ctrl-C wait for the end of an import: raised in its midst it may be swallowed there."""
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    came: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if came:
        raise KeyboardInterrupt


class _Loading(MutableMapping[str, Any]):
    """The table's commands by name, each made when it is asked for."""

    def __init__(self) -> None:
        self._made: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._made:
            self._made[name] = _made(name, TABLE[name])
        return self._made[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._made[name] = command

    def __delitem__(self, name: str) -> None:
        del self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(TABLE)

    def __len__(self) -> int:
        return len(TABLE)


def _made(name: str, entry: Entry) -> Any:
    commands = _loaded("graspdb.cli.options:Commands")(rich_markup_mode=None, pretty_exceptions_enable=False)
    found = _loaded(entry.place)
    if isinstance(found, typer.Typer):
        commands.add_typer(found, name=name)
    else:
        commands.command(name, epilog=entry.epilog and _loaded(entry.epilog))(found)
    return typer.main.get_group(commands).commands[name]


class _Commands(typer.core.TyperGroup):
    """The program: its help needs no command."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = _Loading()

    def invoke(self, ctx: Any) -> Any:
        """Run a command; one that is interrupted tells what it left, and how to go on."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as stopped:
            if hasattr(stopped, "__notes__") and _loaded("graspdb.cli.wording:tell_notes")(stopped):
                raise typer.Exit(130) from None
            raise

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the table's words of each."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.help) for name, entry in TABLE.items()])


app = typer.Typer(
    name="graspdb",
    cls=_Commands,
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
    context.obj = _loaded("graspdb.cli.common:State")(context, url, api_key, json)


def main() -> None:
    """Entry point of the ``graspdb`` command."""
    # A start makes tens of thousands of objects that stay: to look through them for garbage, again and again,
    # took a tenth of a short command.
    gc.set_threshold(100_000)
    try:
        app(prog_name="graspdb")
    except Exception as error:
        if not _loaded("graspdb.cli.wording:told")(error):
            # A bug: a traceback is what helps.
            raise
        sys.exit(1)
