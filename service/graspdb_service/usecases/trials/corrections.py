"""Single trials withdrawn, corrected and looked up: what was wrong is kept, and counts no more."""

from __future__ import annotations

from typing import Any

from graspdb.wire import OUTCOME_CODES, OUTCOMES, TrialInfo, TrialPatch
from graspdb_service.formats.trial_json import documents
from graspdb_service.problems import conflict, found, invalid
from graspdb_service.storage import objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.trials import changes, findings, provenances, rows
from graspdb_service.storage.trials.changes import TrialRow
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.trials.frames import AskedFrame, out_of_tool
from graspdb_service.usecases.trials.listing import page_of


def get(database: Database, slug: str, seq: int, frame: AskedFrame) -> TrialInfo:
    """One trial, its pose of a frame, and what it was before (404)."""
    with database.read() as tx:
        return _read(tx, require(tx, slug), seq, frame)


def withdraw(database: Database, slug: str, seq: int, *, reason: str | None) -> None:
    """Take a trial out of every estimate and keep it, marked; nothing where it is withdrawn already."""
    correct(database, slug, seq, TrialPatch(withdrawn=True, reason=reason))


def correct(
    database: Database, slug: str, seq: int, patch: TrialPatch, frame: AskedFrame | None = None
) -> TrialInfo:
    """Change what a patch gives of a trial, in a new epoch of its object, and keep what it was; it is told
    in a frame, by default the tool's.

    409 ``trial-of-a-sweep`` for what was simulated: its outcome is what came of the simulation.
    """
    with database.write() as tx:
        row = require(tx, slug, lock=True)
        before = _require(tx, row, seq)
        patched = patch.model_dump(exclude_unset=True, exclude={"reason"})
        given = {name: value for name, value in patched.items() if value is not None or name == "metadata"}
        after = _changed(before, given)
        different = {name for name in given if getattr(after, name) != getattr(before, name)}
        if different:
            if before.pose_index is not None:
                raise conflict(
                    "trial-of-a-sweep",
                    f"Trial {seq} was simulated in a sweep: delete the sweep's batch instead"
                    f" (DELETE /objects/{slug}/batches/{{batch}}), or sweep again",
                )
            _check_several(seq, slug, before, after)
            revision, _ = objects.advance(tx, row.id, append=False)
            changes.change(
                tx,
                row.id,
                seq,
                revision=revision,
                values={name: getattr(after, name) for name in different},
                before={name: _worded(name, getattr(before, name)) for name in sorted(different)},
                reason=patch.reason,
            )
            withdrawn = bool(after.withdrawn and not before.withdrawn)
            audit.record(
                tx, "trial.withdraw" if withdrawn else "trial.correct", object=slug, subject=str(seq)
            )
            _count(tx, before, after)
            if withdrawn:
                findings.drop_trial(tx, row.id, seq)
        return _read(tx, row, seq, frame or AskedFrame())


def _changed(before: TrialRow, given: dict[str, Any]) -> TrialRow:
    values = dict(given)
    if "outcome" in values:
        values["outcome"] = OUTCOME_CODES[values["outcome"]]
    if "withdrawn" in values:
        # As rows that were never withdrawn have it.
        values["withdrawn"] = values["withdrawn"] or None
    return before._replace(**values)


def _check_several(seq: int, slug: str, before: TrialRow, after: TrialRow) -> None:
    """422 for an outcome that contradicts how many of a trial's attempts succeeded."""
    won, tried = before.successes, before.attempts
    if won is None or tried is None or (2 * won >= tried) == (after.outcome == OUTCOME_CODES["success"]):
        return
    raise invalid(
        "outcome",
        f"trial {seq} succeeded in {won} of {tried} attempts: withdraw it (DELETE"
        f" /objects/{slug}/trials/{seq}) and post it again as it was",
    )


def _worded(name: str, value: Any) -> Any:
    if name == "outcome":
        return OUTCOMES[value]
    return bool(value) if name == "withdrawn" else value


def _count(tx: Tx, before: TrialRow, after: TrialRow) -> None:
    """Move the trial in the tallies."""
    if not before.withdrawn:
        provenances.add_tally(tx, before.provenance_id, before.outcome, rows=-1)
    if not after.withdrawn:
        provenances.add_tally(tx, after.provenance_id, after.outcome, rows=1)


def _require(tx: Tx, row: ObjectRow, seq: int) -> TrialRow:
    stored = changes.find(tx, row.id, seq)
    return found(stored, "trial", str(seq), f"GET /objects/{row.slug}/trials lists them by seq")


def _read(tx: Tx, row: ObjectRow, seq: int, frame: AskedFrame) -> TrialInfo:
    _require(tx, row, seq)
    columns = rows.page(tx, row.id, after_seq=seq - 1, up_to_seq=seq, limit=1)
    names = provenances.of_object(tx, row.id)
    page = out_of_tool(tx, page_of(tx, row, columns, names), frame)
    history = [change._asdict() for change in changes.of_trial(tx, row.id, seq)]
    told = {**frame.told(), "warnings": list(page.warnings)}
    return TrialInfo.model_validate({**documents(page)[0], "history": history, **told})
