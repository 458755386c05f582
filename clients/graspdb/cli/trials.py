"""``graspdb trials`` and ``graspdb batches``."""

from __future__ import annotations

import warnings
from typing import Annotated

import typer

from graspdb.cli.common import ObjectId, State, Yes, confirm, numbers, show_findings
from graspdb.cli.options import Commands
from graspdb.files.trials import as_stated, read_trials
from graspdb.resources.selection import AnswerFrame
from graspdb.resources.trials import DoubtfulTrials, TrialFilters, Upload
from graspdb.wire import TrialInfo, TrialOut

trials = Commands(no_args_is_help=True, help="Add and list grasp trials.")
batches = Commands(no_args_is_help=True, help="List and delete what arrived together.")

Seq = Annotated[int, typer.Argument(help="The trial's number: trials list shows it.", show_default=False)]
Reason = Annotated[str | None, typer.Option(help="Why, for the history.")]
BatchId = Annotated[str, typer.Argument(show_default=False)]


@trials.command("add")
def add_trials(
    state: State,
    id: ObjectId,
    file: Annotated[
        str, typer.Argument(help="JSON, NDJSON or CSV; - reads JSON from standard input.", show_default=False)
    ],
    upload: Upload,
    gripper: Annotated[str | None, typer.Option(help="Gripper of all trials that name none.")] = None,
    source: Annotated[str | None, typer.Option(help="simulation, robot, human or import.")] = None,
    protocol: Annotated[str | None, typer.Option(help="How the trials were judged.")] = None,
    engine: Annotated[
        str | None, typer.Option(help="Physics engine that simulated them, as 'pybullet 3.2.7'.")
    ] = None,
    answer: Annotated[
        str | None, typer.Option(help="Id or name of the answer that trials tried which name none.")
    ] = None,
    licence: Annotated[str | None, typer.Option(help="Licence of the data, as CC-BY-NC-4.0.")] = None,
    citation: Annotated[str | None, typer.Option(help="What to cite for the data.")] = None,
    unit: Annotated[str, typer.Option(help="What the file's positions are in: m, cm, mm or in.")] = "m",
    quaternion_order: Annotated[
        str, typer.Option(help="The order of the file's quaternions: xyzw, or wxyz whatever their names say.")
    ] = "xyzw",
) -> None:
    """Store the trials of a file, and say what looks doubtful about them.

    CSV has the columns x,y,z,qx,qy,qz,qw,outcome and optionally gripper, source, protocol,
    engine, proposal_density, attempts, successes, quality, width_m, measured_at, answer, achieved_x to
    achieved_qw for where the tool was after all, and qualities.NAME for any number of named scores.
    """
    records, shared = read_trials(file)
    try:
        records = as_stated(records, unit=unit, quaternion_order=quaternion_order)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    given = {"gripper": gripper, "source": source, "protocol": protocol, "answer": answer}
    given["engine"] = engine
    given |= {"licence": licence, "citation": citation}
    shared |= {name: value for name, value in given.items() if value is not None}
    upload["progress"] = not state.json and len(records) > 1_000
    with warnings.catch_warnings():
        # They are told below.
        warnings.simplefilter("ignore", DoubtfulTrials)
        receipt = state.db.objects.get(id).trials.add_records(records, **upload, **shared)
    stored = f"{receipt.inserted:,} trials stored in batch {', '.join(receipt.batches)}"
    state.show(receipt, f"{stored}; {id} is at revision {receipt.revision}.")
    if not state.json:
        show_findings(receipt.findings)


@trials.command("list")
def list_trials(
    state: State,
    id: ObjectId,
    filters: TrialFilters,
    limit: Annotated[int, typer.Option(min=1, help="At most so many.")] = 20,
) -> None:
    """List stored trials, oldest first."""
    state.show_list(
        state.db.objects.get(id).trials.list(**filters).first(limit),
        {
            "seq": lambda t: t.seq,
            "position [m]": lambda t: numbers(t.position),
            "quaternion xyzw": lambda t: numbers(t.quaternion_xyzw),
            "outcome": _outcome,
            "gripper": lambda t: t.gripper,
            "source": lambda t: t.source,
            "protocol": lambda t: t.protocol,
            "engine": lambda t: t.engine,
            "batch": lambda t: t.batch,
            "answer": lambda t: t.answer,
        },
        empty="No trials match.",
    )


@trials.command("show")
def show_trial(state: State, id: ObjectId, seq: Seq, pose_frame: AnswerFrame) -> None:
    """Show one trial and what it was before."""
    _show_trial(state, state.db.objects.get(id).trials.get(seq, **pose_frame))


@trials.command("withdraw")
def withdraw_trial(state: State, id: ObjectId, seq: Seq, reason: Reason = None) -> None:
    """Take a trial out of every count and estimate; it is kept, marked."""
    state.db.objects.get(id).trials.withdraw(seq, reason=reason)
    state.show({"withdrawn": seq}, f"Trial {seq} is withdrawn; graspdb trials correct --reinstate undoes it.")


@trials.command("correct")
def correct_trial(
    state: State,
    id: ObjectId,
    seq: Seq,
    pose_frame: AnswerFrame,
    outcome: Annotated[str | None, typer.Option(help="What became of it after all.")] = None,
    reinstate: Annotated[bool, typer.Option("--reinstate", help="Take it back in where withdrawn.")] = False,
    reason: Reason = None,
) -> None:
    """Correct a trial; what it was stays in its history."""
    if outcome is None and not reinstate:
        raise typer.BadParameter("give --outcome or --reinstate")
    found = state.db.objects.get(id).trials.correct(
        seq, outcome=outcome, withdrawn=False if reinstate else None, reason=reason, **pose_frame
    )
    _show_trial(state, found)


def _outcome(trial: TrialOut) -> str:
    told: str = trial.outcome
    if trial.attempts is not None:
        told += f", {trial.successes} of {trial.attempts}"
    return f"{told} (withdrawn)" if trial.withdrawn else told


def _show_trial(state: State, found: TrialInfo) -> None:
    rows = found.model_dump(mode="json", exclude={"history"}, exclude_none=True)
    for change in found.history:
        before = ", ".join(f"{name} {value}" for name, value in change.before.items())
        why = f" ({change.reason})" if change.reason else ""
        when = f"until {change.changed_at:%Y-%m-%d %H:%M}"
        rows[f"before revision {change.revision}"] = f"{before}, {when}{why}"
    state.show(found, rows)


@batches.command("list")
def list_batches(
    state: State,
    id: ObjectId,
    licence: Annotated[str | None, typer.Option(help="Only batches under this licence.")] = None,
) -> None:
    """List an object's batches."""
    state.show_list(
        list(state.db.objects.get(id).batches.list(licence=licence)),
        {
            "batch": lambda b: b.batch,
            "revision": lambda b: b.revision,
            "rows": lambda b: b.inserted,
            "packed": lambda b: b.packed,
            "withdrawn": lambda b: b.withdrawn,
            "gripper": lambda b: ", ".join(b.grippers),
            "source": lambda b: ", ".join(b.sources),
            "protocol": lambda b: ", ".join(b.protocols),
            "outcomes": lambda b: ", ".join(f"{number:,} {name}" for name, number in b.outcomes.items()),
            "licence": lambda b: b.licence,
            "sweep": lambda b: b.sweep,
            "doubtful": lambda b: ", ".join(finding.code for finding in b.findings),
            "created": lambda b: f"{b.created_at:%Y-%m-%d %H:%M}",
        },
        empty="No batches yet.",
    )


@batches.command("show")
def show_batch(state: State, id: ObjectId, batch: BatchId) -> None:
    """Show one batch."""
    found = state.db.objects.get(id).batches.get(batch)
    rows = found.model_dump(mode="json", exclude={"findings"}, exclude_none=True)
    state.show(found, {name: ", ".join(v) if isinstance(v, list) else v for name, v in rows.items()})
    if not state.json:
        show_findings(found.findings)


@batches.command("delete")
def delete_batch(state: State, id: ObjectId, batch: BatchId, yes: Yes = False) -> None:
    """Delete a batch with all its trials."""
    batches = state.db.objects.get(id).batches
    if not yes:
        found = batches.get(batch)
        confirm(f"Delete the {found.inserted:,} trials of {batch}?")
    batches.delete(batch)
    state.show({"deleted": batch}, f"{batch} is deleted.")
