"""Grasps of a file: as they stand there, as ours, and what is told of how the ones became the others."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.files.trials import FileProblem
from graspdb.poses import Poses, matrices
from graspdb.wire import OUTCOMES

Floats = NDArray[np.float64]
Codes = NDArray[np.uint8]

NO_OUTCOME = 255
"""The code of an outcome that is missing."""


@dataclass(frozen=True)
class Raw:
    """A run of a file's grasps as they stand in it: in its unit, its frame and its axes.

    ``first`` is the number of the first one in the file. A rotation is a ``quaternion`` xyzw (N, 4), read
    from numbers in this ``order`` where it might be the other (None: it can't), or a ``rotation`` (N, 3, 3).
    ``ahead_m`` (N,) is how far the fingertips lie ahead of the origin, in formats that say so instead of
    naming a frame of the gripper. ``object_position`` (N, 3) and ``object_quaternion`` xyzw (N, 4) are the
    object's pose at each grasp, in the frame that the poses are in, read from numbers in ``object_order``;
    None where that frame is the object's.
    ``outcome`` are codes of :data:`graspdb.wire.OUTCOMES`, :data:`NO_OUTCOME` where it is missing, None where
    the file has none. ``more`` are further columns of a trial.
    """

    first: int
    position: Floats
    quaternion: Floats | None = None
    rotation: Floats | None = None
    order: str | None = None
    outcome: Codes | None = None
    qualities: Mapping[str, Floats] = field(default_factory=dict)
    ahead_m: Floats | None = None
    more: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    object_position: Floats | None = None
    object_quaternion: Floats | None = None
    object_order: str | None = None

    def __len__(self) -> int:
        return len(self.position)

    def part(self, chosen: slice | NDArray[np.bool_]) -> Raw:
        """Those that a mask or a slice chooses."""
        places = np.arange(len(self))[chosen].tolist()

        def of(values: Any) -> Any:
            return None if values is None else values[chosen]

        return replace(
            self,
            position=self.position[chosen],
            quaternion=of(self.quaternion),
            rotation=of(self.rotation),
            outcome=of(self.outcome),
            qualities={name: values[chosen] for name, values in self.qualities.items()},
            ahead_m=of(self.ahead_m),
            more={name: [values[i] for i in places] for name, values in self.more.items()},
            object_position=of(self.object_position),
            object_quaternion=of(self.object_quaternion),
        )


@dataclass(frozen=True)
class FileGrasps:
    """N grasps of a file as GraspDB has them; goes where poses go: ``mug.trials.add(read, read.outcomes)``.

    ``position`` (N, 3) metres and unit ``quaternion_xyzw`` (N, 4): the tool frame in the object frame.
    ``outcomes`` (N,) names; ``qualities`` (N,) numbers by name, NaN where unknown; ``more`` further columns
    of a trial by their names on the wire, as ``width_m`` and ``measured_at``, None where unknown; ``report``
    tells how the file was read.
    """

    position: Floats
    quaternion_xyzw: Floats
    codes: Codes
    qualities: dict[str, Floats]
    more: dict[str, list[Any]]
    report: Report | None = None

    def __len__(self) -> int:
        return len(self.position)

    @property
    def poses(self) -> Poses:
        """Positions and quaternions of the tool frame in the object frame."""
        return Poses(self.position, self.quaternion_xyzw)

    @property
    def matrices(self) -> Floats:
        """(N, 4, 4) homogeneous matrices of the tool frame in the object frame."""
        return matrices(self.position, self.quaternion_xyzw)

    @property
    def outcomes(self) -> NDArray[np.str_]:
        """(N,) what became of each, by name."""
        return np.array(OUTCOMES)[self.codes]

    def part(self, chosen: slice | NDArray[np.bool_]) -> FileGrasps:
        """Those that a slice or a mask chooses."""
        places = np.arange(len(self))[chosen].tolist()
        return FileGrasps(
            self.position[chosen],
            self.quaternion_xyzw[chosen],
            self.codes[chosen],
            {name: values[chosen] for name, values in self.qualities.items()},
            {name: [values[i] for i in places] for name, values in self.more.items()},
        )


def joined(parts: Sequence[FileGrasps]) -> FileGrasps:
    """All of them, one after the other; a quality or column that some lack is unknown there."""
    if len(parts) == 1:
        return parts[0]
    names = list(dict.fromkeys(name for part in parts for name in part.qualities))
    more = list(dict.fromkeys(name for part in parts for name in part.more))
    return FileGrasps(
        np.concatenate([part.position for part in parts]) if parts else np.zeros((0, 3)),
        np.concatenate([part.quaternion_xyzw for part in parts]) if parts else np.zeros((0, 4)),
        np.concatenate([part.codes for part in parts]) if parts else np.zeros(0, np.uint8),
        {n: np.concatenate([p.qualities.get(n, np.full(len(p), np.nan)) for p in parts]) for n in names},
        {n: [x for p in parts for x in p.more.get(n, [None] * len(p))] for n in more},
    )


@dataclass
class Report:
    """What became of a file: its format, and in words what was recognised, assumed, mapped and dropped.

    ``grasps`` were taken, ``outcomes`` are theirs by name, ``rule`` says how an outcome was decided.
    ``left_out`` says of how many grasps why they were not taken, where that was asked for.
    ``references`` are names that the file gives to the frame its poses are in, where that may not be the
    object's. ``object_scale`` is the factor that the file's mesh goes with, ``object_volume_m3`` the volume
    that it then has; None where the file says nothing.
    """

    file: str
    format: str
    frame: str | None = None
    convention: str | None = None
    grasps: int = 0
    outcomes: dict[str, int] = field(default_factory=dict)
    rule: str | None = None
    recognised: list[str] = field(default_factory=list)
    assumed: list[str] = field(default_factory=list)
    mapped: list[str] = field(default_factory=list)
    dropped: list[str] = field(default_factory=list)
    object_scale: float | None = None
    object_volume_m3: float | None = None
    references: list[str] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)

    def recognise(self, told: str) -> None:
        """Say once what the file is or says."""
        _once(self.recognised, told)

    def assume(self, told: str) -> None:
        """Say once what the file leaves open and was taken for granted."""
        _once(self.assumed, told)

    def map(self, told: str) -> None:
        """Say once what of the file became what of a trial."""
        _once(self.mapped, told)

    def drop(self, told: str) -> None:
        """Say once what of the file is in no trial."""
        _once(self.dropped, told)

    def leave_out(self, why: str, number: int) -> None:
        """Count grasps that are not taken."""
        if number:
            self.left_out[why] = self.left_out.get(why, 0) + number

    def count(self, grasps: FileGrasps) -> None:
        """Count grasps that were taken."""
        self.grasps += len(grasps)
        for code, number in enumerate(np.bincount(grasps.codes, minlength=len(OUTCOMES)).tolist()):
            if number:
                name = OUTCOMES[code]
                self.outcomes[name] = self.outcomes.get(name, 0) + number


def _once(lines: list[str], told: str) -> None:
    if told not in lines:
        lines.append(told)


def together(reports: Sequence[Report]) -> Report:
    """One report of several files: what holds for many is said once."""
    if len(reports) == 1:
        return reports[0]
    first = reports[0]
    formats = dict.fromkeys(report.format for report in reports)
    whole = Report(f"{len(reports)} files", ", ".join(formats), first.frame, first.convention)
    for report in reports:
        whole.grasps += report.grasps
        whole.rule = whole.rule or report.rule
        for name, number in report.outcomes.items():
            whole.outcomes[name] = whole.outcomes.get(name, 0) + number
        for why, number in report.left_out.items():
            whole.leave_out(why, number)
        for kind in ("recognised", "assumed", "mapped", "dropped"):
            for told in getattr(report, kind):
                _once(getattr(whole, kind), told)
    scales = {report.object_scale for report in reports}
    whole.object_scale = first.object_scale if len(scales) == 1 else None
    volumes = {report.object_volume_m3 for report in reports}
    whole.object_volume_m3 = first.object_volume_m3 if len(volumes) == 1 else None
    return whole


def problem(file: str, told: str) -> FileProblem:
    """One line that names the file."""
    told = re.sub(r"^(grasp \d+)\b", r"\1 (the first is 0)", told)
    return FileProblem(f"{file}: {' '.join(told.split())[:1_000]}")
