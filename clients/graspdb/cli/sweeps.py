"""``graspdb sweep``, ``sweeps``, ``workers`` and ``info``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer

from graspdb.cli.common import ObjectId, flat, out, state_of
from graspdb.cli.options import takes_options
from graspdb.resources.sweeps import Sweep, SweepOptions

sweeps = typer.Typer(no_args_is_help=True, help="List, show, cancel and retry sweeps.")

SweepId = Annotated[str, typer.Argument(metavar="SWEEP", help="The sweep's id.", show_default=False)]


@takes_options
def sweep(
    context: typer.Context,
    id: ObjectId,
    options: SweepOptions,
    wait: Annotated[bool, typer.Option("--wait", help="Stay until it has finished.")] = False,
    timeout: Annotated[float | None, typer.Option(help="Seconds to --wait at most.")] = None,
) -> None:
    """Have workers simulate grasps of an object: the whole grid, or what the options say."""
    state = state_of(context)
    with state.client() as db:
        made = db.objects.get(id).sweep(**options)
        if wait:
            made.wait(progress=not state.json, timeout=timeout)
        state.show(made.info, made.summary())


@sweeps.command("list")
def list_sweeps(
    context: typer.Context,
    object: Annotated[str | None, typer.Option(help="Only this object's.")] = None,
    state: Annotated[str | None, typer.Option(help="Only in this state.")] = None,
) -> None:
    """List sweeps."""
    options = state_of(context)
    with options.client() as db:
        found = [item.info for item in db.sweeps.list(object=object, state=state)]
    options.show_list(
        found,
        {
            "sweep": lambda i: i.id,
            "object": lambda i: i.object,
            "state": lambda i: i.state,
            "poses": lambda i: i.poses,
            "done": lambda i: f"{100 * i.poses_done / max(i.poses, 1):.0f} %",
            "successes": lambda i: i.outcomes.get("success", 0),
            "purpose": lambda i: i.purpose,
            "created": lambda i: f"{i.created_at:%Y-%m-%d %H:%M}",
        },
        empty="No sweeps yet.",
    )


def _show(context: typer.Context, id: str, act: Callable[[Sweep], Sweep] = lambda found: found) -> None:
    """A sweep, after something was done with it."""
    state = state_of(context)
    with state.client() as db:
        found = act(db.sweeps.get(id))
    state.show(found.info, found.summary())


@sweeps.command("show")
def show_sweep(context: typer.Context, id: SweepId) -> None:
    """Show one sweep."""
    _show(context, id)


@sweeps.command("wait")
def wait_for_sweep(
    context: typer.Context,
    id: SweepId,
    timeout: Annotated[float | None, typer.Option(help="Seconds to wait at most.")] = None,
) -> None:
    """Wait until a sweep has finished."""
    progress = not state_of(context).json
    _show(context, id, lambda found: found.wait(progress=progress, timeout=timeout))


@sweeps.command("cancel")
def cancel_sweep(context: typer.Context, id: SweepId) -> None:
    """Stop a sweep; what is stored stays."""
    _show(context, id, Sweep.cancel)


@sweeps.command("retry")
def retry_sweep(context: typer.Context, id: SweepId) -> None:
    """Queue a sweep's failed chunks again."""
    _show(context, id, Sweep.retry)


@sweeps.command("outcomes")
def sweep_outcomes(context: typer.Context, id: SweepId) -> None:
    """Every simulated pose and its outcome: CSV, or JSON columns with --json."""
    state = state_of(context)
    with state.client() as db:
        found = db.sweeps.get(id).outcomes()
    if state.json:
        out(found)
        return
    typer.echo("pose_index,x,y,z,qx,qy,qz,qw,outcome")
    for index, pose, outcome in zip(found.pose_index, found.poses.tolist(), found.outcome, strict=True):
        typer.echo(",".join((str(index), *(repr(value) for value in pose), str(outcome))))


def workers(context: typer.Context) -> None:
    """List the simulation workers."""
    state = state_of(context)
    with state.client() as db:
        found = db.workers()
        url = db.url
    state.show_list(
        found,
        {
            "worker": lambda w: w.worker,
            "can": lambda w: ", ".join(w.capabilities),
            "last seen": lambda w: f"{w.last_seen:%Y-%m-%d %H:%M:%S}",
            "jobs now": lambda w: w.jobs_leased,
            "jobs done": lambda w: w.jobs_done,
            "poses done": lambda w: w.poses_done,
        },
        empty=f"No worker has come yet: graspdb-simworker run --url {url}",
    )


def info(context: typer.Context) -> None:
    """Show the service's versions and limits."""
    state = state_of(context)
    with state.client() as db:
        answer: dict[str, Any] = {"url": db.url, **db.info()}
    state.show(answer, flat(answer))
