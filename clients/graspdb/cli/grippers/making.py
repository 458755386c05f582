"""``graspdb grippers from-urdf`` and ``explain``."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Annotated

import typer

from graspdb.cli.common import ERRORS, State, out, show_rows
from graspdb.cli.objects import grippers, profile_in
from graspdb.figures import FILE_FORMATS
from graspdb.figures.grippers.explained import render_explained
from graspdb.files.urdf import FoundGripper, read_gripper
from graspdb.wire import GripperProfile
from graspdb.wire.presets.grippers import PRESETS

#: What is explained where no gripper is named: it has a value in every field.
_EXAMPLE = "robotiq-2f-85"


@grippers.command("from-urdf")
def from_urdf(
    state: State,
    file: Annotated[Path, typer.Argument(help="The gripper's URDF, with its meshes beside it.", exists=True)],
    id: Annotated[
        str | None, typer.Option("--id", help="Id of the gripper; by default the robot's name in the file.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the profile as `grippers create` takes it, and stop.")
    ] = False,
) -> None:
    """Make a gripper of a URDF: its two fingers, opening, boxes, frames and joints. Needs the extra urdf.

    Says what it found and what it assumed. Only files in the folder of the URDF are opened.
    """
    found = read_gripper(file)
    name = id or re.sub(r"[^A-Za-z0-9._-]+", "-", found.name).strip("-._") or "gripper"
    profile = found.profile.model_dump(mode="json", exclude_none=True)
    if dry_run:
        _show(state, found)
        if not state.json:
            typer.echo(json.dumps({"name": found.name, **profile}, indent=2, ensure_ascii=False))
        return
    created = state.db.grippers.create(name, name=found.name, **profile)
    if state.json:
        out({"gripper": created, "found": found.found, "assumed": found.assumed})
        return
    _show(state, found)
    typer.echo(f"Gripper {created.id} is created; `graspdb grippers explain {created.id} -o FILE` draws it.")


def _show(state: State, found: FoundGripper) -> None:
    if state.json:
        out({"profile": found.profile, "found": found.found, "assumed": found.assumed})
        return
    show_rows(found.found)
    for assumed in found.assumed:
        ERRORS.print(f"Assumed: {assumed}", highlight=False, markup=False, soft_wrap=True)


@grippers.command("explain")
def explain(
    state: State,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The .png or .svg file to write.", dir_okay=False)
    ],
    gripper: Annotated[
        str | None,
        typer.Argument(
            metavar="GRIPPER",
            help="A gripper, or a file as `grippers show` prints it; by default an example.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Draw every field of a gripper's profile on its boxes: the form to fill from a data sheet."""
    suffix = output.suffix.lower()
    if suffix not in FILE_FORMATS:
        raise typer.BadParameter("figures are .png or .svg files", param_hint="--output")
    name, profile = _profile(state, gripper)
    output.write_bytes(render_explained(profile, name, FILE_FORMATS[suffix]))
    state.show({"file": output}, f"{output} explains the fields of {name}.")


def _profile(state: State, gripper: str | None) -> tuple[str, GripperProfile]:
    if gripper is None:
        preset = PRESETS[_EXAMPLE]
        return preset.name, preset.profile
    if gripper.endswith(".json"):
        fields = profile_in(Path(gripper))
        name = fields.pop("name", None) or Path(gripper).stem
        return name, GripperProfile.model_validate({k: v for k, v in fields.items() if k != "id"})
    found = state.db.grippers.get(gripper)
    return found.name or found.id, found.profile
