"""``graspdb trials`` and ``graspdb batches``."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from graspdb.cli.common import ObjectId, numbers, out, show_rows, show_table, state_of
from graspdb.files.trials import read_trials
from graspdb.resources.trials import CHUNK_TRIALS

trials = typer.Typer(no_args_is_help=True, help="Add and list grasp trials.")
batches = typer.Typer(no_args_is_help=True, help="List and delete what arrived together.")


@trials.command("add")
def add_trials(
    context: typer.Context,
    id: ObjectId,
    file: Annotated[
        str, typer.Argument(help="JSON, NDJSON or CSV; - reads JSON from standard input.", show_default=False)
    ],
    gripper: Annotated[str | None, typer.Option(help="Gripper of all trials that name none.")] = None,
    source: Annotated[str | None, typer.Option(help="simulation, robot, human or import.")] = None,
    protocol: Annotated[str | None, typer.Option(help="How the trials were judged.")] = None,
    idempotency_key: Annotated[
        str | None, typer.Option(help="Repeat a failed upload with the same key: nothing is stored twice.")
    ] = None,
    chunk: Annotated[int, typer.Option(min=1, help="Trials a request, each a batch.")] = CHUNK_TRIALS,
) -> None:
    """Store the trials of a file.

    CSV has the columns x,y,z,qx,qy,qz,qw,outcome and optionally gripper, source, protocol,
    proposal_density, quality, width_m, measured_at.
    """
    state = state_of(context)
    records, shared = read_trials(file)
    given = {"gripper": gripper, "source": source, "protocol": protocol}
    shared |= {name: value for name, value in given.items() if value is not None}
    with state.client() as db:
        receipt = db.objects.get(id).trials.add_records(
            records,
            chunk=chunk,
            idempotency_key=idempotency_key,
            progress=not state.json and len(records) > 1_000,
            **shared,
        )
    if state.json:
        out(receipt)
    else:
        typer.echo(
            f"{receipt.inserted:,} trials stored in batch {', '.join(receipt.batches)};"
            f" {id} is at revision {receipt.revision}."
        )


@trials.command("list")
def list_trials(
    context: typer.Context,
    id: ObjectId,
    outcome: Annotated[str | None, typer.Option(help="Only this outcome.")] = None,
    source: Annotated[str | None, typer.Option(help="Only this source.")] = None,
    gripper: Annotated[str | None, typer.Option(help="Only this gripper.")] = None,
    protocol: Annotated[str | None, typer.Option(help="Only this protocol.")] = None,
    batch: Annotated[str | None, typer.Option(help="Only this batch.")] = None,
    since_revision: Annotated[int | None, typer.Option(help="Only what came after this revision.")] = None,
    limit: Annotated[int, typer.Option(min=1, help="At most so many.")] = 20,
) -> None:
    """List stored trials, oldest first."""
    state = state_of(context)
    filters: dict[str, Any] = {"outcome": outcome, "source": source, "gripper": gripper}
    filters |= {"protocol": protocol, "batch": batch, "since_revision": since_revision}
    with state.client() as db:
        found = db.objects.get(id).trials.list(**filters).first(limit)
    if state.json:
        out(found)
        return
    show_table(
        ("seq", "position [m]", "quaternion xyzw", "outcome", "gripper", "source", "protocol", "batch"),
        [
            (
                t.seq,
                numbers(t.position),
                numbers(t.quaternion_xyzw),
                t.outcome,
                t.gripper,
                t.source,
                t.protocol,
                t.batch,
            )
            for t in found
        ],
        empty="No trials match.",
    )


@batches.command("list")
def list_batches(context: typer.Context, id: ObjectId) -> None:
    """List an object's batches."""
    state = state_of(context)
    with state.client() as db:
        found = list(db.objects.get(id).batches.list())
    if state.json:
        out(found)
        return
    show_table(
        ("batch", "revision", "rows", "packed", "sweep", "created"),
        [
            (b.batch, b.revision, b.inserted, b.packed, b.sweep, f"{b.created_at:%Y-%m-%d %H:%M}")
            for b in found
        ],
        empty="No batches yet.",
    )


@batches.command("show")
def show_batch(
    context: typer.Context, id: ObjectId, batch: Annotated[str, typer.Argument(show_default=False)]
) -> None:
    """Show one batch."""
    state = state_of(context)
    with state.client() as db:
        found = db.objects.get(id).batches.get(batch)
    if state.json:
        out(found)
    else:
        show_rows({k: v for k, v in found.model_dump(mode="json").items() if v is not None})


@batches.command("delete")
def delete_batch(
    context: typer.Context,
    id: ObjectId,
    batch: Annotated[str, typer.Argument(show_default=False)],
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
) -> None:
    """Delete a batch with all its trials."""
    state = state_of(context)
    with state.client() as db:
        item = db.objects.get(id)
        if not yes:
            found = item.batches.get(batch)
            typer.confirm(f"Delete the {found.inserted:,} trials of {batch}?", abort=True, err=True)
        item.batches.delete(batch)
    if state.json:
        out({"deleted": batch})
    else:
        typer.echo(f"{batch} is deleted.")
