"""The command line ``graspdb-simworker``."""

from __future__ import annotations

import importlib.util
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable
from types import FrameType
from typing import Annotated

import typer

from graspdb.transport import Transport

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
    help="Simulates the grasps that a GraspDB service plans.",
)

MISSING = (
    "graspdb-simworker: {what}: install the extra, `pip install 'graspdb[sim]'`"
    " (pybullet has wheels for CPython 3.10 and 3.11 on x86-64 Linux;"
    " this is CPython {version} on {machine} {system})"
)


@app.callback()
def _root() -> None:
    """Simulates the grasps that a GraspDB service plans."""


def _require_pybullet() -> None:
    """Say in one line what is missing and leave with code 2."""
    missing = [
        name for name in ("pybullet", "numba", "scipy", "trimesh") if importlib.util.find_spec(name) is None
    ]
    if missing:
        import platform

        text = MISSING.format(
            what=f"{', '.join(missing)} is missing",
            version=platform.python_version(),
            machine=platform.machine(),
            system=platform.system(),
        )
        typer.echo(text, err=True)
        raise typer.Exit(2)


@app.command()
def run(
    url: Annotated[
        str | None,
        typer.Option(envvar="GRASPDB_URL", help="The service's address."),
    ] = None,
    processes: Annotated[int, typer.Option(min=1, max=256, help="Simulating processes, one a core.")] = 1,
    name: Annotated[str | None, typer.Option(help="As the service lists this worker.")] = None,
    exit_when_idle: Annotated[
        bool, typer.Option(help="Stop when there is nothing left to simulate.")
    ] = False,
    once: Annotated[bool, typer.Option(help="Stop after one job for each process.")] = False,
    api_key: Annotated[
        str | None, typer.Option(envvar="GRASPDB_API_KEY", help="With the scope jobs:work.")
    ] = None,
    verbose: Annotated[bool, typer.Option(help="Say what is going on.")] = False,
) -> None:
    """Claim jobs, simulate them, hand in the results; until stopped, or idle if so asked."""
    _require_pybullet()
    from graspdb_simworker.loop import Tally, Worker, WorkerFailed

    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(asctime)s %(levelname)s %(threadName)s %(message)s",
        stream=sys.stderr,
    )
    logging.getLogger("httpx").setLevel(logging.WARNING)
    log = logging.getLogger("graspdb.simworker")

    def report(tally: Tally) -> None:
        log.info("%d jobs, %d poses, %d grasps in physics", tally.jobs, tally.poses, tally.grasps)

    with Transport(
        url, api_key=api_key, user_agent="graspdb-simworker", retries=0, timeout_s=30.0
    ) as transport:
        worker = Worker(
            transport,
            name=name or f"{socket.gethostname()}-{os.getpid()}",
            processes=processes,
            exit_when_idle=exit_when_idle,
            once=once,
            report=report,
        )
        _stop_on_signals(worker.stop)
        try:
            worker.run()
        except WorkerFailed as error:
            typer.echo(f"graspdb-simworker: {error}", err=True)
            raise typer.Exit(2 if "pybullet" in str(error) else 1) from None
    tally = worker.tally
    typer.echo(
        f"{tally.jobs} jobs, {tally.poses} poses, {tally.grasps} grasps in physics;"
        f" {tally.failures} failed, {tally.lost} not wanted any more",
        err=True,
    )


def _stop_on_signals(stop: Callable[[], None]) -> None:
    def handle(number: int, frame: FrameType | None) -> None:
        # A second signal means it.
        signal.signal(number, signal.SIG_DFL)
        stop()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, handle)


def main() -> None:
    """Entry point."""
    app()


if __name__ == "__main__":
    main()
