"""Report runs: one row for an object, revision and parameters, leased to whoever computes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, and_, delete, not_, or_, select, update

from graspdb.wire.states import RunState
from graspdb_service.storage.database import Tx, first_as, insert_new, unix_now, utc_now
from graspdb_service.storage.tables import objects, report_runs

#: The option that stands for the checks there are: another one whenever they change.
CHECKS = "checks"
LEASE_S = 30.0


@dataclass(frozen=True)
class RunKey:
    """What a run computes, and which earlier one is the same."""

    object_id: int
    revision: int
    report: str
    parameters_key: str
    parameters: dict[str, Any]


@dataclass(frozen=True)
class RunRow(RunKey):
    """A run as stored. ``object`` is the object's slug, ``live`` whether somebody holds its lease.

    ``problem`` is a problem's members where a request was at fault; null in a failed run where the service
    was, or where its process died.
    """

    id: str
    object: str
    state: str
    progress: float
    result: str | None
    problem: dict[str, Any] | None
    created_at: datetime
    finished_at: datetime | None
    live: bool


def get(tx: Tx, id: str) -> RunRow | None:
    """The run with this id."""
    return _one(tx, report_runs.c.id == id)


def find(tx: Tx, key: RunKey) -> RunRow | None:
    """The run of a key, whatever became of it."""
    return _one(tx, _same(key))


def ask(tx: Tx, key: RunKey, *, id: str, lease_id: str) -> bool:
    """Take a key's run: make it, or start anew what was cancelled, failed through no fault of the
    request, or whose holder is gone. False where it is done or somebody else's.
    """
    lease = {"lease_id": lease_id, "lease_expires_at": unix_now() + LEASE_S}
    fresh = {"state": RunState.RUNNING, "progress": 0.0, "created_at": utc_now()}
    if not insert_new(tx, report_runs, id=id, **vars(key), **fresh, **lease):
        return _take(tx, _same(key), lease)
    _delete_superseded(tx, key)
    return True


def _delete_superseded(tx: Tx, key: RunKey) -> None:
    """Delete answers to the same question about a past state of the object or of its checks: they are asked
    for no more. Who computes one goes on.
    """
    runs = select(report_runs.c.id, report_runs.c.revision, report_runs.c.parameters).where(
        report_runs.c.object_id == key.object_id,
        report_runs.c.report == key.report,
        report_runs.c.revision <= key.revision,
        or_(report_runs.c.state != RunState.RUNNING, _ran_out()),
    )
    wanted = _without_checks(key.parameters)
    superseded = [
        run.id
        for run in tx.execute(runs)
        if _without_checks(run.parameters) == wanted
        and (run.revision < key.revision or run.parameters != key.parameters)
    ]
    tx.execute(delete(report_runs).where(report_runs.c.id.in_(superseded)))


def _without_checks(parameters: dict[str, Any]) -> dict[str, Any]:
    options = parameters.get("options", {})
    return {**parameters, "options": {k: v for k, v in options.items() if k != CHECKS}}


def take_over(tx: Tx, id: str, *, lease_id: str) -> bool:
    """Take a run whose holder is gone."""
    lease = {"lease_id": lease_id, "lease_expires_at": unix_now() + LEASE_S}
    return _take(tx, and_(report_runs.c.id == id, report_runs.c.state == RunState.RUNNING), lease)


def renew(tx: Tx, held: Mapping[str, tuple[str, float]]) -> set[str]:
    """Keep runs by ``{id: (lease_id, progress)}``; those that are still held."""
    kept = set()
    for id, (lease_id, progress) in sorted(held.items()):
        statement = (
            update(report_runs)
            .where(_held(id, lease_id))
            .values(progress=progress, lease_expires_at=unix_now() + LEASE_S)
        )
        if tx.execute(statement).rowcount:
            kept.add(id)
    return kept


def finish(
    tx: Tx,
    id: str,
    lease_id: str,
    *,
    result: str | None = None,
    problem: dict[str, Any] | None = None,
) -> bool:
    """Store how a run ended: done with its result, else failed; False where it is held no more."""
    values = {
        "state": RunState.FAILED if result is None else RunState.DONE,
        "progress": 1.0,
        "result": result,
        "problem": problem,
        "lease_id": None,
        "lease_expires_at": None,
        "finished_at": utc_now(),
    }
    return bool(tx.execute(update(report_runs).where(_held(id, lease_id)).values(**values)).rowcount)


def release(tx: Tx, id: str, lease_id: str) -> None:
    """Give a run up, for whoever comes next."""
    tx.execute(update(report_runs).where(_held(id, lease_id)).values(lease_expires_at=0.0))


def cancel(tx: Tx, id: str) -> None:
    """End a run if it is still under way."""
    tx.execute(
        update(report_runs)
        .where(report_runs.c.id == id, report_runs.c.state == RunState.RUNNING)
        .values(state=RunState.CANCELLED, lease_id=None, lease_expires_at=None, finished_at=utc_now())
    )


def remove(tx: Tx, id: str) -> None:
    """Delete a run, where there is one."""
    tx.execute(delete(report_runs).where(report_runs.c.id == id))


def _take(tx: Tx, which: ColumnElement[bool], lease: dict[str, Any]) -> bool:
    free = or_(
        report_runs.c.state == RunState.CANCELLED,
        and_(report_runs.c.state == RunState.FAILED, report_runs.c.problem.is_(None)),
        and_(report_runs.c.state == RunState.RUNNING, _ran_out()),
    )
    fresh = {"state": RunState.RUNNING, "progress": 0.0, "problem": None, "finished_at": None}
    return bool(tx.execute(update(report_runs).where(which, free).values(**fresh, **lease)).rowcount)


def _ran_out() -> ColumnElement[bool]:
    """Whether a lease is over; one that ends later than any granted now is of a clock that was set back."""
    ends = report_runs.c.lease_expires_at
    return or_(ends < unix_now(), ends > unix_now() + 2.0 * LEASE_S)


def _held(id: str, lease_id: str) -> ColumnElement[bool]:
    return and_(
        report_runs.c.id == id, report_runs.c.lease_id == lease_id, report_runs.c.state == RunState.RUNNING
    )


def _same(key: RunKey) -> ColumnElement[bool]:
    return and_(
        report_runs.c.object_id == key.object_id,
        report_runs.c.parameters_key == key.parameters_key,
        report_runs.c.revision == key.revision,
    )


def _one(tx: Tx, which: ColumnElement[bool]) -> RunRow | None:
    stored = [report_runs.c[name] for name in RunRow.__dataclass_fields__ if name in report_runs.c]
    live = and_(report_runs.c.lease_expires_at.is_not(None), not_(_ran_out()))
    query = (
        select(*stored, objects.c.slug.label("object"), live.label("live"))
        .join(objects, objects.c.id == report_runs.c.object_id)
        .where(which)
    )
    return first_as(tx, query, RunRow)
