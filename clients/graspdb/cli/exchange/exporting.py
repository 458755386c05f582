"""``graspdb export``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from graspdb.cli.common import ObjectId, State
from graspdb.interop import WRITTEN, write
from graspdb.interop.grasps import FileGrasps
from graspdb.resources.objects import GraspObject
from graspdb.resources.selection import Selection
from graspdb.resources.trials import TrialFilters
from graspdb.wire import OUTCOME_CODES, GripperInfo, TrialOut

_BEST, _SAMPLES = 20, 1_000
#: Columns of a trial that tables keep.
_MORE = ("width_m", "gripper", "source", "protocol", "proposal_density", "measured_at", "metadata")


def export(
    state: State,
    id: ObjectId,
    output: Annotated[Path, typer.Option("--output", "-o", help="The file to write.", show_default=False)],
    selection: Selection,
    filters: TrialFilters,
    format: Annotated[
        str | None, typer.Option(help=f"One of {', '.join(WRITTEN)} [as the file's name ends].")
    ] = None,
    what: Annotated[str, typer.Option(help="best, samples or trials.")] = "best",
    count: Annotated[
        int | None, typer.Option(min=1, help="At most so many [20 best, 1000 samples, all trials].")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of samples: the same seed, the same poses.")
    ] = None,
) -> None:
    """Write best grasps, samples of the density or trials in a format of the field.

    What the format cannot say is told. GraspDB's own tables (csv, jsonl, parquet) say all of a trial.
    """
    item = state.db.objects.get(id)
    # What is written is of this frame; what is asked for is the tool's.
    frame, convention = filters.pop("frame", None), filters.pop("convention", None)
    poses: Any
    if what == "best":
        best = item.best_grasps(count=count or _BEST, **selection)
        poses, told = list(best), _chances(item, list(best), selection)
    elif what == "samples":
        drawn = item.samples(count or _SAMPLES, seed=seed, **selection)
        poses, told = drawn, _chances(item, drawn, selection)
    elif what == "trials":
        filters.setdefault("withdrawn", False)
        listing = item.trials.list(**filters)
        poses, told = _trials(list(listing) if count is None else listing.first(count), id), None
    else:
        raise typer.BadParameter(f"{what!r}; expected best, samples or trials")
    gripper = _gripper(state, item, selection.get("gripper"))
    report = write(
        output,
        poses,
        format=format,
        frame=frame,
        convention=convention,
        gripper=gripper,
        qualities=told,
        object=id,
    )
    lines = [f"{report.grasps:,} grasps written to {output}: {report.format}, poses of {report.frame}"]
    for kind in ("assumed", "mapped", "dropped"):
        lines += [f"  {kind}: {line}" for line in getattr(report, kind)]
    state.show(report, "\n".join(lines))


def _chances(item: GraspObject, poses: Any, selection: Selection) -> dict[str, Any]:
    """Success probabilities of poses, NaN where the service tells none."""
    found = item.likelihood(poses, include=["success_probability"], **selection).success_probability
    return {} if found is None else {"success_probability": np.asarray(found)}


def _trials(trials: list[TrialOut], id: str) -> FileGrasps:
    if not trials:
        raise ValueError(f"{id} has no such trials")
    scores: list[Mapping[str, float | None]] = [
        {**(t.qualities or {}), **({} if t.quality is None else {"quality": t.quality})} for t in trials
    ]
    names = dict.fromkeys(name for score in scores for name in score)
    more = {name: [getattr(trial, name) for trial in trials] for name in _MORE}
    return FileGrasps(
        np.array([trial.position for trial in trials], dtype=np.float64),
        np.array([trial.quaternion_xyzw for trial in trials], dtype=np.float64),
        np.array([OUTCOME_CODES[trial.outcome] for trial in trials], dtype=np.uint8),
        {name: np.array([score.get(name, np.nan) for score in scores], dtype=np.float64) for name in names},
        {name: values for name, values in more.items() if any(value is not None for value in values)},
    )


def _gripper(state: State, item: GraspObject, named: str | None) -> GripperInfo | None:
    """The gripper whose frames are meant: the one that is named, or the only one that the trials name."""
    names = {name for batch in item.batches for name in batch.grippers} if named is None else {named}
    return state.db.grippers.get(names.pop()) if len(names) == 1 else None
