"""Trials looked at as they come: what about a batch is doubtful, and what can't be trials of its object."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from graspdb.wire import OUTCOME_CODES, GripperProfile
from graspdb_geometry.plausibility import TOLERANCE_M, Doubt, Target, doubts
from graspdb_geometry.poses import ToolPoses
from graspdb_service.storage import grippers
from graspdb_service.storage.database import Tx
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.trials import findings
from graspdb_service.storage.trials.findings import FindingRow
from graspdb_service.trial_columns import Ints, TrialBatch
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.trials.findings.fingerprints import fingerprints

#: Indices that a finding names.
FIRST = 10
#: More combinations of gripper, source, protocol and engine in one batch are looked at together, without a
#: gripper.
_MOST_PROVENANCES = 16
#: Earlier batches with the same rows that are named.
_MOST_BATCHES = 10

#: Outcomes that say themselves what would be doubtful otherwise.
_EXPECTED = {"collides": OUTCOME_CODES["collision"], "closes-on-nothing": OUTCOME_CODES["missed"]}


class Geometries(Protocol):
    """What is known of objects' geometry."""

    def target(self, row: ObjectRow, profile: GripperProfile | None) -> Target | None:
        """The object for a gripper to be tested against; None without mesh and parts."""


@dataclass(frozen=True, eq=False)
class Concern:
    """A finding before its batch is stored: ``rows`` ascending, ``provenance`` a place among the batch's."""

    provenance: int | None
    code: str
    detail: str
    rows: Ints
    examined: int

    def stored(self, ids: Ints, other_batch_id: int | None = None) -> FindingRow:
        """As storage has it, where ``ids`` are those of the batch's provenances."""
        provenance_id = None if self.provenance is None else int(ids[self.provenance])
        first = self.rows[:FIRST].tolist()
        return FindingRow(
            provenance_id, self.code, self.detail, len(self.rows), self.examined, first, other_batch_id
        )


def profiles_of(tx: Tx, batch: TrialBatch) -> dict[str, GripperProfile]:
    """The profiles of those grippers that trials name and that exist; of few, as only few are looked at."""
    found = {}
    for name in {item.gripper for item in batch.provenances[:_MOST_PROVENANCES]} - {None}:
        row = grippers.find(tx, str(name))
        if row is not None:
            found[str(name)] = GripperProfile.model_validate(row.profile)
    return found


def inspect(
    compute: Compute,
    geometries: Geometries,
    row: ObjectRow,
    profiles: Mapping[str, GripperProfile],
    batch: TrialBatch,
) -> list[Concern]:
    """What about the poses of a batch is doubtful, by its provenances. Never call it in a transaction."""
    columns = batch.columns
    held = columns.outcome == OUTCOME_CODES["success"]
    tried = columns.poses
    concerns = []
    for provenance, rows in _groups(batch):
        name = None if provenance is None else batch.provenances[provenance].gripper
        profile = None if name is None else profiles.get(name)
        concerns += _too_wide(batch, provenance, rows, profile)
        target = geometries.target(row, profile)
        poses = ToolPoses(*tried[rows])
        for doubt in compute.run(partial(doubts, poses, held[rows], target)):
            concern = _concern(batch, provenance, rows, doubt, target)
            if len(concern.rows):
                concerns.append(concern)
    return concerns


def turned_frames(batch: TrialBatch, places: Iterable[int], convention: str | None) -> list[Concern]:
    """What a convention may have meant otherwise: trials of these provenances came in a frame whose own axes
    are turned against the tool's and are not those of the convention.
    """
    found = []
    for place in places:
        rows = np.flatnonzero(batch.columns.provenance == place)
        found.append(Concern(place, "turned-frame", convention or "", rows, len(rows)))
    return found


def repeats(tx: Tx, object_id: int, batch_id: int, batch: TrialBatch, ids: Ints) -> list[FindingRow]:
    """Rows that stand twice in the batch, or in earlier ones; remembers those of this one."""
    rows, digests = fingerprints(batch.columns, object_id, batch.qualities)
    distinct, first = np.unique(digests, return_index=True)
    again = np.setdiff1d(rows, rows[first])
    seen = findings.seen_in(tx, distinct)
    findings.remember(tx, batch_id, distinct)
    whose = 0 if len(batch.provenances) == 1 else None
    found = []
    if len(again):
        found.append(Concern(whose, "repeated-rows", "", again, len(rows)).stored(ids))
    by_batch: dict[int, list[int]] = {}
    taken: set[int] = set()
    # A row that stands in several batches counts once, for the newest of them.
    for digest, other in sorted(seen, key=lambda pair: -pair[1]):
        if digest not in taken:
            taken.add(digest)
            by_batch.setdefault(other, []).append(digest)
    largest = sorted(by_batch.items(), key=lambda item: -len(item[1]))[:_MOST_BATCHES]
    for other, same in largest:
        repeated = rows[np.isin(digests, same)]
        found.append(Concern(whose, "posted-before", "", repeated, len(rows)).stored(ids, other))
    return found


def _too_wide(
    batch: TrialBatch, provenance: int | None, rows: Ints, profile: GripperProfile | None
) -> list[Concern]:
    """Trials that end with the fingers farther apart than their gripper opens."""
    if profile is None or not len(batch.columns.width_m):
        return []
    told = rows[~np.isnan(batch.columns.width_m[rows])]
    wide = told[batch.columns.width_m[told] > profile.max_opening_m + TOLERANCE_M]
    detail = f"{1e3 * profile.max_opening_m:.4g} mm"
    return [Concern(provenance, "wider-than-the-jaw", detail, wide, len(told))] if len(wide) else []


def _groups(batch: TrialBatch) -> Iterator[tuple[int | None, Ints]]:
    """Rows of each provenance, by its place; all together under None where they are many."""
    count = len(batch.provenances)
    if count == 1 or count > _MOST_PROVENANCES:
        yield (0 if count == 1 else None), np.arange(len(batch.columns))
        return
    for place in range(count):
        yield place, np.flatnonzero(batch.columns.provenance == place)


def _concern(
    batch: TrialBatch, provenance: int | None, rows: Ints, doubt: Doubt, target: Target | None
) -> Concern:
    where = rows[doubt.rows]
    expected = _EXPECTED.get(doubt.code)
    if expected is not None:
        where = where[batch.columns.outcome[where] != expected]
    detail = doubt.likeness
    if target is not None and doubt.code == "implausible-poses":
        detail = f"{target.limit_m:.2g} m"
    if target is not None and doubt.code == "out-of-reach":
        detail = f"{100 * target.reach_m:.0f} cm"
    return Concern(provenance, doubt.code, detail, where, doubt.examined)
