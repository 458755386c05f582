"""Trials in columns: one value from a request's body to the database, and from there to the maths."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES
from graspdb.wire.trials import BatchDefaults
from graspdb_density.se3 import Poses

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def json_text(value: Any) -> str:
    """A document (or the text that it is already) as both databases keep it."""
    return (
        value
        if isinstance(value, str)
        else json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    )


def _floats() -> Floats:
    return np.empty(0)


def _flags() -> NDArray[np.bool_]:
    return np.empty(0, dtype=np.bool_)


def _ints() -> Ints:
    return np.empty(0, dtype=np.int64)


def _codes() -> NDArray[np.uint8]:
    return np.empty(0, dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class TrialColumns:
    """Trials (n,). A column that no trial has, or that was not read, is empty.

    ``position`` (n, 3) m and unit ``quaternion_xyzw`` (n, 4) are the tool in the object frame; ``outcome``
    codes as :data:`graspdb.wire.OUTCOME_CODES`. ``provenance`` is which :class:`Provenance`: its place in a
    list that comes with the columns, once stored its id. ``proposal_density`` 1/(m^3 rad^3), ``quality`` and
    ``width_m`` are NaN where a trial has none, ``pose_index`` -1 where it is of no sweep. ``measured_at``
    (aware), ``pose_covariance`` (6x6 nested lists) and ``metadata`` are a value or None a trial, the latter
    two as JSON text where they came in a request: many objects of Python's take long to free. ``seq`` is
    ascending, ``batch`` internal, ``withdrawn`` (n,) whether it counts no more. ``answer`` is which answer
    was tried, -1 for none: its place in a list that comes with the columns, once stored its number.
    ``achieved`` (n, 7) is where the tool was after all, position and quaternion, NaN where that is unknown.
    ``attempts`` and ``successes`` (n,) say how often a pose was tried and succeeded, NaN where it was tried
    once.
    ``qualities`` (n, k) are named scores, NaN for none; the names come with the columns, of stored ones with
    the batch, whose first name is in column 0.
    """

    position: Floats
    quaternion_xyzw: Floats
    outcome: NDArray[np.uint8] = field(default_factory=_codes)
    provenance: Ints = field(default_factory=_ints)
    proposal_density: Floats = field(default_factory=_floats)
    quality: Floats = field(default_factory=_floats)
    width_m: Floats = field(default_factory=_floats)
    pose_index: Ints = field(default_factory=_ints)
    measured_at: Sequence[datetime | None] = ()
    pose_covariance: Sequence[list[list[float]] | str | None] = ()
    metadata: Sequence[dict[str, Any] | str | None] = ()
    seq: Ints = field(default_factory=_ints)
    revision: Ints = field(default_factory=_ints)
    batch: Ints = field(default_factory=_ints)
    answer: Ints = field(default_factory=_ints)
    achieved: Floats = field(default_factory=_floats)
    attempts: Floats = field(default_factory=_floats)
    successes: Floats = field(default_factory=_floats)
    qualities: Floats = field(default_factory=_floats)
    withdrawn: NDArray[np.bool_] = field(default_factory=_flags)

    def __len__(self) -> int:
        return len(self.position)

    @classmethod
    def joined(cls, parts: Sequence[TrialColumns]) -> TrialColumns:
        """Trials of several parts in order; a column that only some have is NaN, -1 or None in others."""
        if len(parts) == 1:
            return parts[0]
        columns: dict[str, Any] = {}
        for name, blank in vars(parts[0]).items():
            pieces = [getattr(part, name) for part in parts]
            if not any(len(piece) for piece in pieces):
                columns[name] = blank
            elif isinstance(blank, np.ndarray):
                some = next(piece for piece in pieces if len(piece))
                missing = -1 if some.dtype.kind == "i" else np.nan
                columns[name] = np.concatenate(
                    [
                        piece if len(piece) else np.full((len(part), *some.shape[1:]), missing, some.dtype)
                        for part, piece in zip(parts, pieces, strict=True)
                    ]
                )
            else:
                lengths = zip(parts, pieces, strict=True)
                columns[name] = [x for part, piece in lengths for x in piece or [None] * len(part)]
        return cls(**columns)

    @property
    def poses(self) -> Poses:
        """Where the tool was, as the maths takes it: the achieved pose where it is known."""
        if not len(self.achieved):
            return Poses(self.position, self.quaternion_xyzw)
        known = ~np.isnan(self.achieved[:, :1])
        position = np.where(known, self.achieved[:, :3], self.position)
        return Poses(position, np.where(known, self.achieved[:, 3:], self.quaternion_xyzw))

    @property
    def share(self) -> Floats:
        """By how much each succeeded (n,): k of n, else 1 or 0."""
        won: Floats = (self.outcome == OUTCOME_CODES["success"]).astype(np.float64)
        if not len(self.attempts):
            return won
        return np.asarray(np.where(np.isnan(self.attempts), won, self.successes / self.attempts))

    def __getitem__(self, rows: slice | Bools | Ints) -> TrialColumns:
        """Some of the trials: a slice of any, else of those whose columns are all arrays."""
        columns = vars(self).items()
        return TrialColumns(**{name: column[rows] if len(column) else column for name, column in columns})


class Provenance(NamedTuple):
    """What some of an object's trials have in common.

    ``gripper`` is one version, as in ``panda@1``; of a request perhaps an id alone, which means the newest.
    ``engine`` is what simulated them, as in ``pybullet 3.2.7``.
    """

    gripper: str | None
    source: str | None
    protocol: str | None
    engine: str | None = None

    @property
    def kin(self) -> Provenance:
        """What it has in common with trials of other engines: questions are about all of them."""
        return self._replace(engine=None)


def gripper_parts(name: str) -> tuple[str, int | None]:
    """A gripper's id and its version, None where the name tells none: ``panda@1`` or ``panda``."""
    gripper, _, version = name.partition("@")
    return gripper, int(version) if version else None


def is_gripper(name: str, asked: str) -> bool:
    """Whether the gripper of a trial is the one asked for: of any version, where that tells none."""
    return name == asked or ("@" not in asked and gripper_parts(name)[0] == asked)


class BatchFacts(NamedTuple):
    """What trials have from their batch: its key, the sweep that wrote it, the metadata beside it, and what
    the columns of ``qualities`` are called.
    """

    key: str
    sweep: str | None
    metadata: dict[str, Any] | None
    qualities: Sequence[str]


@dataclass(frozen=True, eq=False)
class TrialBatch:
    """Checked trials of one request, ready to store.

    ``field_of_gripper`` names the field that a gripper came in, ``field_of`` that of a trial's place and
    name, for what only the database can tell. ``shared`` stood once for all, ``answers`` are ids or names of
    those that trials tried, ``qualities`` names of the columns of scores.
    """

    columns: TrialColumns
    provenances: Sequence[Provenance]
    shared: BatchDefaults
    field_of_gripper: Callable[[str], str]
    field_of: Callable[[int, str], str]
    answers: Sequence[str] = ()
    qualities: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class TrialPage:
    """Stored trials with what their internal ids stand for, and names of all qualities of their object."""

    columns: TrialColumns
    provenances: Mapping[int, Provenance]
    batches: Mapping[int, BatchFacts]
    answers: Mapping[int, str]
    qualities: Sequence[str]
    warnings: Sequence[str] = ()
