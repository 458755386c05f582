"""``graspdb sweep``, ``sweeps``, ``workers`` and ``info``."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from graspdb.cli.common import ERRORS, ObjectId, State, flat, out, out_csv
from graspdb.cli.options import Commands
from graspdb.errors import SweepFailed, add_note
from graspdb.resources.selection import AnswerFrame
from graspdb.resources.sweeps import Sweep, SweepOptions, convex_parts_told
from graspdb.wire import SweepInfo

sweeps = Commands(no_args_is_help=True, help="List, show, cancel and retry sweeps.")

SweepId = Annotated[str, typer.Argument(metavar="SWEEP", help="The sweep's id.", show_default=False)]


def sweep(
    state: State,
    id: ObjectId,
    options: SweepOptions,
    wait: Annotated[bool, typer.Option("--wait", help="Stay until it has finished.")] = False,
    timeout: Annotated[float | None, typer.Option(help="Seconds to --wait at most.")] = None,
) -> None:
    """Have workers simulate grasps of an object: the whole grid, or what the options say.

    With --engine both these are two sweeps; shown is that which stores trials, --wait is for both.
    """
    made = state.db.objects.get(id).sweep(**options)
    if wait:
        _wait(state, made, timeout)
        other = made.linked()
        if other is not None:
            _wait(state, other, timeout)
    _show(state, made)


@sweeps.command("list")
def list_sweeps(
    options: State,
    object: Annotated[str | None, typer.Option(help="Only this object's.")] = None,
    state: Annotated[str | None, typer.Option(help="Only in this state.")] = None,
) -> None:
    """List sweeps."""
    found = list(options.db.sweeps.list(object=object, state=state))
    options.show_list(
        [item.info for item in found],
        {
            "sweep": lambda i: i.id,
            "object": lambda i: i.object,
            "state": _state,
            "poses": lambda i: i.poses,
            "done": lambda i: f"{100 * i.poses_done / max(i.poses, 1):.0f} %",
            "successes": lambda i: i.outcomes.get("success", 0),
            "engine": lambda i: ", ".join(i.engines) or i.engine,
            "purpose": lambda i: i.purpose,
            "created": lambda i: f"{i.created_at:%Y-%m-%d %H:%M}",
        },
        empty="No sweeps yet.",
    )
    queued = [item for item in found if item.state == "queued"]
    hint = queued[0].hint() if queued and not options.json else None
    if hint is not None:
        ERRORS.print(f"Mind: {hint}")


@sweeps.command("show")
def show_sweep(state: State, id: SweepId) -> None:
    """Show one sweep."""
    _show(state, state.db.sweeps.get(id))


@sweeps.command("wait")
def wait_for_sweep(
    state: State,
    id: SweepId,
    timeout: Annotated[float | None, typer.Option(help="Seconds to wait at most.")] = None,
) -> None:
    """Wait until a sweep has finished."""
    found = state.db.sweeps.get(id)
    _wait(state, found, timeout)
    _show(state, found)


@sweeps.command("cancel")
def cancel_sweep(state: State, id: SweepId) -> None:
    """Stop a sweep, and the one linked with it; what is stored stays."""
    _show(state, state.db.sweeps.get(id).cancel())


@sweeps.command("retry")
def retry_sweep(state: State, id: SweepId) -> None:
    """Queue a sweep's failed chunks again, and those of the one linked with it."""
    _show(state, state.db.sweeps.get(id).retry())


@sweeps.command("outcomes")
def sweep_outcomes(state: State, id: SweepId, pose_frame: AnswerFrame) -> None:
    """Every simulated pose and its outcome: CSV, or JSON columns with --json."""
    found = state.db.sweeps.get(id).outcomes(**pose_frame)
    if state.json:
        out(found)
        return
    out_csv(found.columns())


def workers(state: State) -> None:
    """List the simulation workers."""
    state.show_list(
        state.db.workers(),
        {
            "worker": lambda w: w.worker,
            "can": lambda w: ", ".join(w.capabilities),
            "last seen": lambda w: f"{w.last_seen:%Y-%m-%d %H:%M:%S}",
            "jobs now": lambda w: w.jobs_leased,
            "jobs done": lambda w: w.jobs_done,
            "poses done": lambda w: w.poses_done,
        },
        empty=f"No worker has come yet: graspdb-simworker run --url {state.db.url}",
    )


def info(state: State) -> None:
    """Show the service's versions and limits."""
    answer: dict[str, Any] = {"url": state.db.url, **state.db.info()}
    state.show(answer, flat(answer))


def _wait(state: State, found: Sweep, timeout: float | None) -> None:
    try:
        found.wait(progress=not state.json, timeout=timeout)
    except SweepFailed as error:
        add_note(error, f"`graspdb sweeps retry {found.id}` queues its failed chunks again.")
        raise
    except TimeoutError as error:
        add_note(
            error, f"`graspdb sweeps wait {found.id}` waits on; `graspdb sweeps cancel {found.id}` stops it."
        )
        raise


def _state(info: SweepInfo) -> str:
    waits = info.waiting_for if info.state == "queued" else None
    return info.state if waits is None else f"{info.state}, {convex_parts_told(waits)}"


def _show(state: State, found: Sweep) -> None:
    rows = found.summary()
    waits_for = None if state.json else found.waits_for()
    if waits_for is not None:
        rows["waits for"] = waits_for
    state.show(found.info, rows)
