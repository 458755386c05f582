"""``graspdb bundle``: objects with everything about them in one file, and back."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from graspdb.cli.common import ERRORS, State
from graspdb.files.bundles import loading, saving


def bundle(
    state: State,
    objects: Annotated[
        list[str] | None, typer.Argument(metavar="OBJECT", help="Objects to save.", show_default=False)
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Save to this file, a zip.")] = None,
    load: Annotated[Path | None, typer.Option(help="Take this file in instead.")] = None,
    renamed: Annotated[
        list[str] | None, typer.Option("--as", help="OLD=NEW: take an object in under another id.")
    ] = None,
    new_gripper_versions: Annotated[
        bool,
        typer.Option(
            "--new-gripper-versions",
            help="Where a gripper here has another profile, make the file's its newest version.",
        ),
    ] = False,
) -> None:
    """Save objects with mesh, parts, trials, grippers and kernels to one file, or take such a file in."""
    if load is None:
        if output is None or not objects or renamed or new_gripper_versions:
            raise typer.BadParameter("name objects and -o FILE to save them, or --load FILE to take one in")
        _save(state, objects, output)
        return
    if output is not None or objects:
        raise typer.BadParameter("--load takes a file in: name no objects and no -o beside it")
    names = dict(_pair(text) for text in renamed or ())
    with _bar("storing trials", quiet=state.json) as progress:
        made = loading.load(
            state.db, load, renamed=names, new_gripper_versions=new_gripper_versions, progress=progress
        )
    state.show(
        made,
        {
            "objects": ", ".join(made.objects.values()),
            "trials": f"{made.trials:,} in {made.batches:,} batches",
            "grippers": ", ".join(made.grippers.values()) or "none",
            "kernels": ", ".join(made.kernels.values()) or "none",
        },
    )


def _save(state: State, objects: list[str], output: Path) -> None:
    with _bar("reading trials", quiet=state.json) as progress:
        manifest = saving.save(state.db, objects, output, progress)
    rows = {
        item.id: f"{item.trials:,} trials, {item.withdrawn:,} of them withdrawn, in {item.batches:,} batches"
        for item in manifest.objects
    }
    rows["grippers"] = ", ".join(manifest.grippers) or "none"
    rows["kernels"] = str(manifest.kernels)
    rows["licences"] = ", ".join(manifest.licences) or "none is told"
    packed = sum(item.packed for item in manifest.objects)
    if packed:
        rows["left behind"] = f"{packed:,} outcomes of sweeps that are no trials: probabilities will differ"
    rows["file"] = f"{output} ({output.stat().st_size:,} bytes)"
    state.show(manifest, rows)


def _pair(text: str) -> tuple[str, str]:
    old, equals, new = text.partition("=")
    if not (old and equals and new):
        raise typer.BadParameter(f"--as {text}: say OLD=NEW")
    return old, new


@contextmanager
def _bar(title: str, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    bar = Progress(
        TextColumn(title), BarColumn(), MofNCompleteColumn(), TextColumn("trials"), TimeRemainingColumn(),
        console=ERRORS, transient=True, disable=quiet,
    )  # fmt: skip
    task = bar.add_task(title, total=None)
    with bar:
        yield lambda done, total: bar.update(task, completed=done, total=total)
