"""Single trials withdrawn and corrected: the rows, and what they were before."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any, NamedTuple

from sqlalchemy import insert, select, update

from graspdb_service.storage.database import Tx, utc_now
from graspdb_service.storage.tables import trial_changes, trials


class TrialRow(NamedTuple):
    """What of a stored trial may change, and whose it is; ``pose_index`` is None where it is of no sweep."""

    provenance_id: int
    pose_index: int | None
    outcome: int
    withdrawn: bool | None
    metadata: dict[str, Any] | None
    attempts: int | None
    successes: int | None


class ChangeRow(NamedTuple):
    """A change of a trial: which revision of the object made it, and the values that it replaced."""

    revision: int
    before: dict[str, Any]
    reason: str | None
    changed_at: datetime


def find(tx: Tx, object_id: int, seq: int) -> TrialRow | None:
    """One trial of an object."""
    columns = (trials.c[name] for name in TrialRow._fields)
    row = tx.execute(select(*columns).where(trials.c.object_id == object_id, trials.c.seq == seq)).first()
    return None if row is None else TrialRow(*row)


def change(
    tx: Tx,
    object_id: int,
    seq: int,
    *,
    revision: int,
    values: Mapping[str, Any],
    before: dict[str, Any],
    reason: str | None,
) -> None:
    """Give a trial new values under a new revision, and keep what they were; under the object's lock."""
    place = trials.c.object_id == object_id, trials.c.seq == seq
    tx.execute(update(trials).where(*place).values({**values, "revision": revision}))
    tx.execute(
        insert(trial_changes).values(
            object_id=object_id,
            seq=seq,
            revision=revision,
            before=before,
            reason=reason,
            changed_at=utc_now(),
        )
    )


def of_trial(tx: Tx, object_id: int, seq: int) -> list[ChangeRow]:
    """A trial's changes, oldest first."""
    columns = (trial_changes.c[name] for name in ChangeRow._fields)
    query = select(*columns).where(trial_changes.c.object_id == object_id, trial_changes.c.seq == seq)
    return [ChangeRow(*row) for row in tx.execute(query.order_by(trial_changes.c.revision))]
