"""Grasps written in the formats of other projects, with a report of what the format cannot say."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Unpack

from graspdb.interop.frames import follow, frames_of, to_tool
from graspdb.interop.grasps import FileGrasps, Floats, Report
from graspdb.interop.writers import matrices, messages, rosbags, tables
from graspdb.interop.writers.content import Content
from graspdb.options import known_keywords
from graspdb.poses import Poses, as_poses
from graspdb.wire import OUTCOMES, GripperInfo, GripperProfile
from graspdb.wire.frames.gripper_frames import TOOL


@dataclass(frozen=True)
class Run:
    """Grasps that are written together: poses of the tool, outcomes by name (N,), qualities and further
    columns as in :class:`graspdb.interop.FileGrasps`.
    """

    poses: Poses
    outcomes: NDArray[np.str_] | None = None
    qualities: Mapping[str, Floats] = field(default_factory=dict)
    more: Mapping[str, list[Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class _Writer:
    """Who writes a format, what its poses are of where nobody says, and how its files' names end."""

    write: Callable[[Path, Iterator[Content], Report], None]
    frame: str
    convention: str
    suffixes: tuple[str, ...]
    folder: bool = False
    #: Whether a file says itself what its poses are of.
    states_frame: bool = False


_WRITERS = {
    "acronym": _Writer(matrices.acronym, "base", "acronym", (".h5", ".hdf5")),
    "graspgen": _Writer(matrices.graspgen, "base", "graspgen", (".json",)),
    "isaac": _Writer(messages.isaac, "base", "graspdb", (".yaml", ".yml")),
    "moveit": _Writer(messages.moveit, "flange", "graspdb", (".yaml", ".yml", ".json")),
    "rosbag": _Writer(rosbags.bag, "flange", "graspdb", (), folder=True, states_frame=True),
    "csv": _Writer(tables.csv_file, "tool", "graspdb", (".csv",), states_frame=True),
    "jsonl": _Writer(tables.json_lines, "tool", "graspdb", (".jsonl", ".ndjson"), states_frame=True),
    "parquet": _Writer(tables.parquet, "tool", "graspdb", (".parquet",), states_frame=True),
}

WRITTEN = tuple(_WRITERS)
"""The formats that are written, by name."""


class Written(TypedDict, total=False):
    """How grasps are written.

    ``format`` is one of :data:`WRITTEN`, by default as the name ends; ``frame`` and ``convention`` are what
    its poses are to be of, by default the format's own; ``gripper`` is needed for any frame but the tool;
    ``object`` names what is grasped. The file is replaced when it is whole.
    """

    format: str | None
    frame: str | None
    convention: str | None
    gripper: GripperProfile | GripperInfo | None
    object: str | None


def write(
    path: str | PathLike[str],
    grasps: ArrayLike | Any,
    *,
    outcomes: ArrayLike | None = None,
    qualities: Mapping[str, ArrayLike] | None = None,
    **how: Unpack[Written],
) -> Report:
    """Write grasps to a file (:class:`Written`); the report says what was mapped, assumed, and dropped.

    ``grasps`` are what :func:`graspdb.interop.read` gave, trials, samples or grasps, of whatever frame they
    say (for any but the tool ``gripper`` is needed), or poses of the tool in the object's frame, (N, 4, 4) or
    (N, 7). ``outcomes`` (N,) names and ``qualities`` (N,) numbers by name are
    those of the grasps where they have any, unless given.
    """
    poses = _of_tool(grasps, how.get("gripper"))
    count = len(poses.position)
    run = Run(poses, _outcomes(grasps, outcomes, count), _qualities(grasps, qualities, count), _more(grasps))
    return write_runs(path, [run], **how)


def write_runs(path: str | PathLike[str], runs: Iterable[Run], **how: Unpack[Written]) -> Report:
    """Write grasps that come by runs, of which one at a time is held, as :func:`write` does."""
    known_keywords(Written, how, "write")
    target, gripper = Path(path), how.get("gripper")
    name, writer = _writer(target, how.get("format"))
    profile = gripper.profile if isinstance(gripper, GripperInfo) else gripper
    report = Report(str(path), name)
    chosen, axes = written_of(target, name, how.get("frame"), how.get("convention"))
    if how.get("frame") is None and chosen == "flange" and "flange" not in frames_of(profile):
        raise ValueError(
            "moveit_msgs/Grasp has poses of the end effector's parent link, and the gripper has no frame"
            " flange: say which of its frames that link is (--frame base, or another)"
        )
    report.frame, report.convention = chosen, axes
    if (chosen, axes) != (writer.frame, writer.convention) and not writer.states_frame:
        report.drop(f"what its poses are of: when it is read, say --frame {chosen} --convention {axes}")
    way = to_tool(chosen, axes, profile)
    fixed = np.asarray(np.linalg.inv(way), dtype=np.float64)
    if writer.folder and target.exists():
        raise ValueError(f"{target} exists already: a bag is a folder of its own")

    def contents() -> Iterator[Content]:
        for run in runs:
            if not len(run.poses.position):
                continue
            yield Content(
                follow(run.poses, fixed),
                chosen,
                axes,
                # The approach is z of ours: what that is in the axes that are written.
                way[:3, 2],
                run.outcomes,
                run.qualities,
                run.more,
                profile,
                gripper.id if isinstance(gripper, GripperInfo) else None,
                how.get("object"),
                report.grasps,
            )
            report.grasps += len(run.poses.position)

    with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
        # Under its own name, which some formats repeat inside.
        whole = Path(folder) / target.name
        first = next(found := contents(), None)
        if first is None:
            raise ValueError("there are no grasps to write")
        writer.write(whole, chain([first], found), report)
        os.replace(whole, target)
    return report


def written_of(
    path: str | PathLike[str], format: str | None, frame: str | None, convention: str | None
) -> tuple[str, str]:
    """The frame and the convention that a file's poses are written in: those given, else the format's own."""
    writer = _writer(Path(path), format)[1]
    return frame or writer.frame, convention or writer.convention


def _writer(path: Path, format: str | None) -> tuple[str, _Writer]:
    name = format or _by_name(path)
    if name not in _WRITERS:
        raise ValueError(f"format is {name!r}; expected one of {', '.join(WRITTEN)}")
    return name, _WRITERS[name]


def _of_tool(grasps: Any, gripper: GripperProfile | GripperInfo | None) -> Poses:
    """Poses of the tool, of grasps that may say themselves what they are of instead; or of a list of such."""
    several = isinstance(grasps, Sequence) and len(grasps) and hasattr(grasps[0], "quaternion_xyzw")
    poses = as_poses(list(grasps) if several else grasps)
    said = {
        (getattr(each, "frame", None) or TOOL, getattr(each, "convention", None) or "graspdb")
        for each in (grasps if several else [grasps])
    }
    if len(said) > 1:
        raise ValueError("these grasps are of several frames: write those of one at a time")
    frame, convention = said.pop()
    profile = gripper.profile if isinstance(gripper, GripperInfo) else gripper
    return (
        poses
        if frame == TOOL and convention == "graspdb"
        else follow(poses, to_tool(frame, convention, profile))
    )


def _by_name(path: Path) -> str:
    suffix = path.suffix.lower()
    fitting = [name for name, writer in _WRITERS.items() if suffix in writer.suffixes]
    if len(fitting) != 1:
        which = (
            f"{suffix or 'no suffix'} is {' or '.join(fitting)}"
            if fitting
            else f"no format ends in {suffix!r}"
        )
        raise ValueError(f"{path}: {which}; name it (--format), one of {', '.join(WRITTEN)}")
    return fitting[0]


def _outcomes(grasps: Any, given: ArrayLike | None, count: int) -> Any:
    found = getattr(grasps, "outcomes", getattr(grasps, "outcome", None)) if given is None else given
    if found is None or callable(found):
        return None
    array = np.asarray(found)
    if array.dtype == bool:
        array = np.where(array, "success", "failure")
    if array.shape != (count,):
        raise ValueError(f"outcomes have shape {array.shape}; expected {(count,)}")
    wrong = sorted(set(array.tolist()) - set(OUTCOMES))
    if wrong:
        raise ValueError(f"outcome {wrong[0]!r}; expected one of {', '.join(OUTCOMES)}")
    return array


def _qualities(grasps: Any, given: Mapping[str, ArrayLike] | None, count: int) -> dict[str, Any]:
    found = getattr(grasps, "qualities", {}) if given is None else given
    named = {name: np.asarray(values, dtype=np.float64) for name, values in dict(found).items()}
    for name, values in named.items():
        if values.shape != (count,):
            raise ValueError(f"quality {name!r} has shape {values.shape}; expected {(count,)}")
    return named


def _more(grasps: Any) -> dict[str, list[Any]]:
    if isinstance(grasps, FileGrasps):
        return dict(grasps.more)
    # Grasps of an answer know the object's width between the fingers.
    each = grasps if isinstance(grasps, (list, tuple)) else ()
    widths = [getattr(grasp, "width_m", None) for grasp in each]
    return {"width_m": widths} if any(width is not None for width in widths) else {}
