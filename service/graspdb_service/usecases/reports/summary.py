"""What was tried on every object, and what share succeeded by each way of counting: the summary (table I)."""

from __future__ import annotations

from graspdb.wire.reports import SummaryRate, SummaryReport, SummaryRow
from graspdb_service import principal
from graspdb_service.storage import grippers, objects
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.trials import provenances
from graspdb_service.trial_columns import Provenance, gripper_parts
from graspdb_service.usecases.reports.common import LEVEL, share
from graspdb_service.usecases.trials.selection import outcome_counts, total

#: What each way of counting leaves out, by its name.
_LEFT_OUT: dict[str, tuple[str, ...]] = {
    "attempts": (),
    "free": ("collision",),
    "met": ("collision", "missed"),
}
RULES = {
    "attempts": "all attempts; a collision or a miss is a failure",
    "free": "attempts whose open gripper did not collide",
    "met": "attempts that neither collided nor missed the object",
}
#: Tells neither success nor failure.
_NO_ATTEMPT = "simulation_error"
_PAGE = 500


def summary(database: Database) -> SummaryReport:
    """Every object's trials by gripper, protocol and source."""
    rows: list[SummaryRow] = []
    empty: list[str] = []
    after = ""
    while True:
        with database.read() as tx:
            page = objects.page(tx, after=after, limit=_PAGE, prefix=principal.object_prefix())
            for item in page:
                found = _rows(tx, item)
                rows += found
                if not found:
                    empty.append(item.slug)
        if len(page) < _PAGE:
            break
        after = page[-1].slug
    warnings = [f"no trials yet: {', '.join(empty)}"] if empty else []
    return SummaryReport(text=_text(rows), level=LEVEL, rules=RULES, rows=rows, warnings=warnings)


def _rows(tx: Tx, item: ObjectRow) -> list[SummaryRow]:
    known = provenances.of_object(tx, item.id)
    counts = outcome_counts(tx, item.id, known)
    # Trials that differ by the engine alone are one row.
    alike: dict[Provenance, list[dict[str, int]]] = {}
    for number, origin in known.items():
        if number in counts:
            alike.setdefault(origin.kin, []).append(counts[number])
    symmetric: dict[str | None, bool] = {None: True}
    rows = []
    for origin, counted in alike.items():
        if origin.gripper not in symmetric:
            assert origin.gripper is not None
            gripper = grippers.find(tx, origin.gripper)
            symmetric[origin.gripper] = gripper is None or bool(gripper.profile.get("symmetric", True))
        outcomes = total(counted)
        tried = sum(outcomes.values()) - outcomes.get(_NO_ATTEMPT, 0)
        won = outcomes.get("success", 0)
        twins = 2 if symmetric[origin.gripper] else 1
        rows.append(
            SummaryRow(
                object=item.slug,
                revision=item.revision,
                gripper=None if origin.gripper is None else gripper_parts(origin.gripper)[0],
                gripper_version=None if origin.gripper is None else gripper_parts(origin.gripper)[1],
                source=origin.source,
                protocol=origin.protocol,
                outcomes=outcomes,
                trials=tried,
                successes=won,
                rates=[_rate(rule, outcomes, tried, won) for rule in RULES],
                doubled_successes=twins * won,
                doubled_failures=twins * (tried - won),
            )
        )
    return rows


def _rate(rule: str, outcomes: dict[str, int], tried: int, won: int) -> SummaryRate:
    counted = tried - sum(outcomes.get(name, 0) for name in _LEFT_OUT[rule])
    return SummaryRate(rule=rule, trials=counted, rate=share(won, counted))


def _text(rows: list[SummaryRow]) -> str:
    if not rows:
        return "No object has trials yet."
    tried, won = sum(row.trials for row in rows), sum(row.successes for row in rows)
    names = {row.object for row in rows}
    many = f"{len(names):,} objects" if len(names) > 1 else f"1 object ({next(iter(names))})"
    return f"{tried:,} trials of {many}, {won:,} of them successes."
