"""``graspdb import``."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from graspdb.cli.common import State, show_findings
from graspdb.interop import ReadOptions
from graspdb.interop.first_look import FirstLook
from graspdb.interop.grasps import Report
from graspdb.interop.importing import Import
from graspdb.resources.trials import DoubtfulTrials, Sending
from graspdb.wire import Finding

_AXES = "with the --convention whose axes the file's poses have"
#: By a finding's code, how a file is imported where the finding is right.
_FLAGS = {
    "looks-like-millimetres": "with --unit mm",
    "looks-like-centimetres": "with --unit cm",
    "looks-like-wxyz": "with --quaternion-order wxyz",
    "another-approach-axis": _AXES,
    "another-closing-axis": _AXES,
    "approaches-away": _AXES,
    "out-of-reach": "with the --frame that the file's poses are of (base, flange)",
    "turned-frame": "without --convention",
}


# long: most of it declares options.
def import_files(
    state: State,
    files: Annotated[
        list[str], typer.Argument(metavar="FILE...", help="Files of one format.", show_default=False)
    ],
    object: Annotated[str, typer.Option("--object", help="The object that was grasped.", show_default=False)],
    gripper: Annotated[
        str, typer.Option("--gripper", help="The gripper that grasped: grippers list.", show_default=False)
    ],
    reading: ReadOptions,
    upload: Sending,
    source: Annotated[str, typer.Option(help="simulation, robot, human or import.")] = "import",
    protocol: Annotated[str | None, typer.Option(help="How the trials were judged.")] = None,
    licence: Annotated[str | None, typer.Option(help="Licence of the data, as in CC-BY-NC-4.0.")] = None,
    citation: Annotated[str | None, typer.Option(help="What to cite for the data.")] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Look at the files and say what would be stored.")
    ] = False,
    again: Annotated[
        bool, typer.Option("--again", help="Store anew what the same import stored before.")
    ] = False,
) -> None:
    """Store the grasps of files in the formats of other projects, after a first look at them.

    ACRONYM (.h5, .json), GraspGen (.json), isaac_grasp (.yaml), GraspNet (.npy, .npz), VGN (.csv),
    MultiGripperGrasp (.json), moveit_msgs/Grasp (.yaml, .json), GraspIt! and UIBK (.xml), and tables with any
    columns (.csv, .jsonl, .parquet). Nothing is stored where a file can't be read or can't be right. The same
    import once more stores nothing twice: one that broke off goes on so.
    """
    item, chosen = state.db.objects.get(object), state.db.grippers.get(gripper)
    found = Import(item, chosen, files, **reading)
    accepted = upload.get("accept_implausible", False)
    refused = found.look.refusals if not accepted else []
    told = {
        "report": found.report,
        "first_look": found.look,
        "batches": [],
        "inserted": 0,
        "dry_run": dry_run,
    }
    if not state.json:
        for line in _lines(found.report, found.look):
            typer.echo(line)
    if refused:
        if state.json:
            state.show(told, {})
        raise ValueError(
            f"{'; '.join(refused)}. Nothing was stored; --accept-implausible stores it all the same"
        )
    if dry_run:
        state.show(told, f"{found.report.grasps:,} trials would be stored; nothing was.")
        return
    upload["progress"] = not state.json and found.report.grasps > 1_000
    with warnings.catch_warnings():
        # They are told below.
        warnings.simplefilter("ignore", DoubtfulTrials)
        receipt = found.send(
            source=source, protocol=protocol, licence=licence, citation=citation, again=again, **upload
        )
    told |= {"batches": receipt.batches, "inserted": receipt.inserted, "revision": receipt.revision}
    many = len(receipt.batches)
    kept, new = receipt.already_stored, receipt.inserted - receipt.already_stored
    told["already_stored"] = kept
    stored = f"{new:,} trials stored" + (f", {kept:,} were already stored" if kept else "")
    stored += f", in {many} batches" if many > 3 else f", in batch {', '.join(receipt.batches)}"
    state.show(
        told | {"findings": receipt.findings}, f"{stored}; {object} is at revision {receipt.revision}."
    )
    if not state.json:
        show_findings(_in_flags(each, object, receipt.batches) for each in receipt.findings)


def _in_flags(finding: Finding, object: str, batches: Sequence[str]) -> Finding:
    """A finding whose remedy is what to type, where the service speaks of the poses that are sent."""
    if finding.code not in _FLAGS:
        return finding
    several = f" for each of the {len(batches)} batches" if len(batches) > 1 else ""
    gone = f"graspdb batches delete {object} {batches[0]}{several}"
    told = f"If so, {gone}, and import again {_FLAGS[finding.code]}"
    return finding.model_copy(update={"remedy": told})


def _lines(report: Report, look: FirstLook) -> Any:
    yield f"{report.file}: {report.format}, {report.grasps:,} grasps"
    for kind in ("recognised", "assumed", "mapped", "dropped"):
        for line in getattr(report, kind):
            yield f"  {kind}: {line}"
    for why, number in report.left_out.items():
        yield f"  left out: {number:,} grasps: {why}"
    outcomes = ", ".join(f"{number:,} {name}" for name, number in report.outcomes.items())
    yield f"  outcomes: {outcomes} ({report.rule})"
    for line in look.lines():
        yield f"  first look: {line}"
    for doubt in look.doubts:
        yield f"  doubtful: {doubt}"
    if look.fingertips_in_box is None and report.object_scale is not None:
        yield f"  the file's mesh goes with: graspdb objects set-mesh ... --scale {report.object_scale:.9g}"
