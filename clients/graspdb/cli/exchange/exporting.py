"""``graspdb export``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from graspdb.cli.common import ObjectId, State
from graspdb.interop import WRITTEN, write
from graspdb.interop.grasps import Report
from graspdb.interop.writing import Run, Written, write_runs, written_of
from graspdb.poses import Poses
from graspdb.resources.objects import GraspObject
from graspdb.resources.selection import AnswerFrame, PoseFrame, Selection
from graspdb.resources.trials import TrialFilters
from graspdb.wire import GripperInfo

_BEST, _SAMPLES = 20, 1_000
#: Columns of a trial that tables keep.
_MORE = (
    "attempts",
    "successes",
    "width_m",
    "gripper",
    "source",
    "protocol",
    "engine",
    "proposal_density",
    "measured_at",
    "metadata",
)
#: Fields of a trial that no file has.
_LEFT = ("achieved_pose", "pose_covariance", "answer")
_RUN = 20_000


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
    near = filters.pop("near", None)
    asked: AnswerFrame = {}
    if near is not None and what != "trials":
        # The twin is that nearer in the frame that is written.
        frame, convention = written_of(output, format, frame, convention)
        asked = {"frame": frame, "convention": convention, "near": near}
    poses: Any
    told: dict[str, Any] | None = None
    if what == "best":
        best = list(item.best_grasps(count=count or _BEST, **selection, **asked))
        poses, told = best, _chances(item, best, selection, asked)
    elif what == "samples":
        drawn = item.samples(count or _SAMPLES, seed=seed, **selection, **asked)
        poses, told = drawn, _chances(item, drawn, selection, asked)
    elif what != "trials":
        raise typer.BadParameter(f"{what!r}; expected best, samples or trials")
    elif near is not None:
        raise typer.BadParameter("trials are written as they were posted: leave it out", param_hint="--near")
    how: Written = {
        "format": format,
        "frame": frame,
        "convention": convention,
        "gripper": _gripper(state, item, selection.get("gripper")),
        "object": id,
    }
    if what == "trials":
        filters.setdefault("withdrawn", False)
        trials = _Trials(item, filters, count)
        report = write_runs(output, trials.runs(), **how)
        trials.tell(report)
    else:
        report = write(output, poses, qualities=told, **how)
    lines = [f"{report.grasps:,} grasps written to {output}: {report.format}, poses of {report.frame}"]
    for kind in ("assumed", "mapped", "dropped"):
        lines += [f"  {kind}: {line}" for line in getattr(report, kind)]
    state.show(report, "\n".join(lines))


def _chances(item: GraspObject, poses: Any, selection: Selection, asked: AnswerFrame) -> dict[str, Any]:
    """Success probabilities of poses, NaN where the service tells none."""
    of = PoseFrame(frame=asked.get("frame"), convention=asked.get("convention"))
    found = item.likelihood(poses, include=["success_probability"], **selection, **of).success_probability
    return {} if found is None else {"success_probability": np.asarray(found)}


class _Trials:
    """Trials on their way into a file, a run after the other, and what of them is in no file."""

    def __init__(self, item: GraspObject, filters: TrialFilters, count: int | None) -> None:
        self._item = item
        self._documents = islice(item.trials.list(**filters).documents(), count)
        self._left = dict.fromkeys(_LEFT, 0)

    def runs(self) -> Iterator[Run]:
        """Runs whose columns are alike; ValueError for none."""
        names: dict[str, None] = {}
        while run := list(islice(self._documents, _RUN)):
            scores = [_scores(trial) for trial in run]
            if not names:
                # Those that are there come first; later ones can only be the batches'.
                names = dict.fromkeys(name for score in scores for name in score)
                names |= dict.fromkeys(name for batch in self._item.batches for name in batch.qualities)
                names |= {"quality": None}
            for name in _LEFT:
                self._left[name] += sum(trial[name] is not None for trial in run)
            poses = Poses(
                np.array([trial["position"] for trial in run], dtype=np.float64),
                np.array([trial["quaternion_xyzw"] for trial in run], dtype=np.float64),
            )
            yield Run(
                poses,
                np.array([trial["outcome"] for trial in run]),
                {name: np.array([score.get(name, np.nan) for score in scores], float) for name in names},
                {name: [trial[name] for trial in run] for name in _MORE},
            )
        if not names:
            raise ValueError(f"{self._item.info.id} has no such trials")

    def tell(self, report: Report) -> None:
        """Say what of the trials is not in the file."""
        for name, number in self._left.items():
            if number:
                report.drop(f"{name} of {number:,} trials: a bundle keeps it")


def _scores(trial: Mapping[str, Any]) -> dict[str, float]:
    own = {} if trial["quality"] is None else {"quality": trial["quality"]}
    return {**(trial["qualities"] or {}), **own}


def _gripper(state: State, item: GraspObject, named: str | None) -> GripperInfo | None:
    """The gripper whose frames are meant: the one that is named, or the only one that the trials name."""
    names = {name for batch in item.batches for name in batch.grippers} if named is None else {named}
    return state.db.grippers.get(names.pop()) if len(names) == 1 else None
