"""``graspdb sweep``, ``sweeps``, ``workers`` and ``info``."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from graspdb.cli.common import ObjectId, Vector, out, show_rows, show_table, state_of, vector_option
from graspdb.files.trials import read_poses
from graspdb.resources.sweeps import Sweep

sweeps = typer.Typer(no_args_is_help=True, help="List, show, cancel and retry sweeps.")

SweepId = Annotated[str, typer.Argument(metavar="SWEEP", help="The sweep's id.", show_default=False)]


def _show(sweep: Sweep, as_json: bool) -> None:
    if as_json:
        out(sweep.info)
    else:
        show_rows(sweep.summary())


def sweep(
    context: typer.Context,
    id: ObjectId,
    max_poses: Annotated[int | None, typer.Option(min=1, help="A random part of the grid.")] = None,
    position_step_m: Annotated[float | None, typer.Option(help="Grid step, metres [0.01].")] = None,
    rotation_step_deg: Annotated[float | None, typer.Option(help="Grid step, degrees [15].")] = None,
    margin_m: Annotated[float | None, typer.Option(help="Margin about the bounding box [0.02].")] = None,
    region_min: Annotated[Vector | None, vector_option("Cut the grid to a box.", "--region-min")] = None,
    region_max: Annotated[Vector | None, vector_option("Its upper corner.", "--region-max")] = None,
    poses: Annotated[
        str | None, typer.Option(help="Simulate exactly the poses of this file (.csv, .npy, .json).")
    ] = None,
    sample: Annotated[
        int | None, typer.Option(min=1, help="Simulate so many draws from the density.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of --max-poses or --sample.")] = None,
    gripper: Annotated[str | None, typer.Option(help="Gripper profile [pg70].")] = None,
    protocol: Annotated[str | None, typer.Option(help="wrench or lift [wrench].")] = None,
    fidelity: Annotated[str | None, typer.Option(help="standard or fine [standard].")] = None,
    purpose: Annotated[str | None, typer.Option(help="collect or check [collect].")] = None,
    chunk_poses: Annotated[int | None, typer.Option(min=1, help="Poses a job.")] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Stay until it has finished.")] = False,
    timeout: Annotated[float | None, typer.Option(help="Seconds to --wait at most.")] = None,
) -> None:
    """Have workers simulate grasps of an object: the whole grid, or what the options say."""
    if (region_min is None) != (region_max is None):
        raise typer.BadParameter("--region-min and --region-max go together")
    state = state_of(context)
    with state.client() as db:
        made = db.objects.get(id).sweep(
            max_poses=max_poses,
            position_step_m=position_step_m,
            rotation_step_deg=rotation_step_deg,
            margin_m=margin_m,
            region=None if region_min is None or region_max is None else (region_min, region_max),
            seed=seed,
            poses=None if poses is None else read_poses(poses),
            sample=sample,
            gripper=gripper,
            protocol=protocol,
            fidelity=fidelity,
            purpose=purpose,
            chunk_poses=chunk_poses,
        )
        if wait:
            made.wait(progress=not state.json, timeout=timeout)
        _show(made, state.json)


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
    if options.json:
        out(found)
        return
    show_table(
        ("sweep", "object", "state", "poses", "done", "successes", "purpose", "created"),
        [
            (
                i.id,
                i.object,
                i.state,
                i.poses,
                f"{100 * i.poses_done / max(i.poses, 1):.0f} %",
                i.outcomes.get("success", 0),
                i.purpose,
                f"{i.created_at:%Y-%m-%d %H:%M}",
            )
            for i in found
        ],
        empty="No sweeps yet.",
    )


@sweeps.command("show")
def show_sweep(context: typer.Context, id: SweepId) -> None:
    """Show one sweep."""
    state = state_of(context)
    with state.client() as db:
        _show(db.sweeps.get(id), state.json)


@sweeps.command("wait")
def wait_for_sweep(
    context: typer.Context,
    id: SweepId,
    timeout: Annotated[float | None, typer.Option(help="Seconds to wait at most.")] = None,
) -> None:
    """Wait until a sweep has finished."""
    state = state_of(context)
    with state.client() as db:
        _show(db.sweeps.get(id).wait(progress=not state.json, timeout=timeout), state.json)


@sweeps.command("cancel")
def cancel_sweep(context: typer.Context, id: SweepId) -> None:
    """Stop a sweep; what is stored stays."""
    state = state_of(context)
    with state.client() as db:
        _show(db.sweeps.get(id).cancel(), state.json)


@sweeps.command("retry")
def retry_sweep(context: typer.Context, id: SweepId) -> None:
    """Queue a sweep's failed chunks again."""
    state = state_of(context)
    with state.client() as db:
        _show(db.sweeps.get(id).retry(), state.json)


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
    for row in range(len(found)):
        pose = (*found.position[row].tolist(), *found.quaternion_xyzw[row].tolist())
        cells = [str(found.pose_index[row]), *(repr(value) for value in pose), str(found.outcome[row])]
        typer.echo(",".join(cells))


def workers(context: typer.Context) -> None:
    """List the simulation workers."""
    state = state_of(context)
    with state.client() as db:
        found = db.workers()
        url = db.url
    if state.json:
        out(found)
        return
    show_table(
        ("worker", "can", "last seen", "jobs now", "jobs done", "poses done"),
        [
            (
                w.worker,
                ", ".join(w.capabilities),
                f"{w.last_seen:%Y-%m-%d %H:%M:%S}",
                w.jobs_leased,
                w.jobs_done,
                w.poses_done,
            )
            for w in found
        ],
        empty=f"No worker has come yet: graspdb-simworker run --url {url}",
    )


def info(context: typer.Context) -> None:
    """Show the service's versions and limits."""
    state = state_of(context)
    with state.client() as db:
        answer: dict[str, Any] = {"url": db.url, **db.info()}
    if state.json:
        out(answer)
        return
    rows: dict[str, Any] = {}
    for name, value in answer.items():
        for key, item in value.items() if isinstance(value, dict) else [("", value)]:
            rows[f"{name}.{key}".rstrip(".")] = item
    show_rows(rows)
