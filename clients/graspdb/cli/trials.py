"""``graspdb trials`` and ``graspdb batches``."""

from __future__ import annotations

from typing import Annotated

import typer

from graspdb.cli.common import ObjectId, Yes, numbers, state_of
from graspdb.cli.options import takes_options
from graspdb.files.trials import read_trials
from graspdb.resources.trials import TrialFilters, Upload

trials = typer.Typer(no_args_is_help=True, help="Add and list grasp trials.")
batches = typer.Typer(no_args_is_help=True, help="List and delete what arrived together.")

BatchId = Annotated[str, typer.Argument(show_default=False)]


@trials.command("add")
@takes_options
def add_trials(
    context: typer.Context,
    id: ObjectId,
    file: Annotated[
        str, typer.Argument(help="JSON, NDJSON or CSV; - reads JSON from standard input.", show_default=False)
    ],
    upload: Upload,
    gripper: Annotated[str | None, typer.Option(help="Gripper of all trials that name none.")] = None,
    source: Annotated[str | None, typer.Option(help="simulation, robot, human or import.")] = None,
    protocol: Annotated[str | None, typer.Option(help="How the trials were judged.")] = None,
) -> None:
    """Store the trials of a file.

    CSV has the columns x,y,z,qx,qy,qz,qw,outcome and optionally gripper, source, protocol,
    proposal_density, quality, width_m, measured_at.
    """
    state = state_of(context)
    records, shared = read_trials(file)
    given = {"gripper": gripper, "source": source, "protocol": protocol}
    shared |= {name: value for name, value in given.items() if value is not None}
    upload["progress"] = not state.json and len(records) > 1_000
    with state.client() as db:
        receipt = db.objects.get(id).trials.add_records(records, **upload, **shared)
    stored = f"{receipt.inserted:,} trials stored in batch {', '.join(receipt.batches)}"
    state.show(receipt, f"{stored}; {id} is at revision {receipt.revision}.")


@trials.command("list")
@takes_options
def list_trials(
    context: typer.Context,
    id: ObjectId,
    filters: TrialFilters,
    limit: Annotated[int, typer.Option(min=1, help="At most so many.")] = 20,
) -> None:
    """List stored trials, oldest first."""
    state = state_of(context)
    with state.client() as db:
        found = db.objects.get(id).trials.list(**filters).first(limit)
    state.show_list(
        found,
        {
            "seq": lambda t: t.seq,
            "position [m]": lambda t: numbers(t.position),
            "quaternion xyzw": lambda t: numbers(t.quaternion_xyzw),
            "outcome": lambda t: t.outcome,
            "gripper": lambda t: t.gripper,
            "source": lambda t: t.source,
            "protocol": lambda t: t.protocol,
            "batch": lambda t: t.batch,
        },
        empty="No trials match.",
    )


@batches.command("list")
def list_batches(context: typer.Context, id: ObjectId) -> None:
    """List an object's batches."""
    state = state_of(context)
    with state.client() as db:
        found = list(db.objects.get(id).batches.list())
    state.show_list(
        found,
        {
            "batch": lambda b: b.batch,
            "revision": lambda b: b.revision,
            "rows": lambda b: b.inserted,
            "packed": lambda b: b.packed,
            "sweep": lambda b: b.sweep,
            "created": lambda b: f"{b.created_at:%Y-%m-%d %H:%M}",
        },
        empty="No batches yet.",
    )


@batches.command("show")
def show_batch(context: typer.Context, id: ObjectId, batch: BatchId) -> None:
    """Show one batch."""
    state = state_of(context)
    with state.client() as db:
        found = db.objects.get(id).batches.get(batch)
    state.show(found, {k: v for k, v in found.model_dump(mode="json").items() if v is not None})


@batches.command("delete")
def delete_batch(context: typer.Context, id: ObjectId, batch: BatchId, yes: Yes = False) -> None:
    """Delete a batch with all its trials."""
    state = state_of(context)
    with state.client() as db:
        item = db.objects.get(id)
        if not yes:
            found = item.batches.get(batch)
            typer.confirm(f"Delete the {found.inserted:,} trials of {batch}?", abort=True, err=True)
        item.batches.delete(batch)
    state.show({"deleted": batch}, f"{batch} is deleted.")
