"""Sweeps: follow them, stop them, try again what failed."""

from __future__ import annotations

from graspdb.wire import OUTCOMES, SweepInfo
from graspdb.wire.states import JobState, SweepState
from graspdb.wire.sweeps import stated_accelerations
from graspdb_service import principal
from graspdb_service.problems import conflict, found
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database, Tx, clock
from graspdb_service.storage.simulation import jobs, outcomes, sweeps
from graspdb_service.storage.simulation.sweeps import Progress, SweepRow
from graspdb_service.usecases.geometry import decompositions
from graspdb_service.usecases.identifiers import is_uuid
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.simulation import feasibility
from graspdb_service.usecases.trials import sweep_plan

_LATELY_S = 120.0


def require_sweep(tx: Tx, sweep_id: str) -> SweepRow:
    """The sweep, or a 404."""
    row = sweeps.find(tx, sweep_id) if is_uuid(sweep_id) else None
    # An id tells nothing of whose sweep it is: one of a hidden object is answered as none.
    row = row if row is not None and principal.sees(row.object) else None
    return found(row, "sweep", sweep_id, "GET /sweeps lists them")


def get(database: Database, sweep_id: str) -> SweepInfo:
    """A sweep and how far it has come."""
    with database.read() as tx:
        return sweep_info(tx, require_sweep(tx, sweep_id))


def listing(
    database: Database, *, slug: str | None, state: str | None, cursor: str | None, limit: int
) -> tuple[list[SweepInfo], str | None]:
    """A page of sweeps, the newest first, and the cursor of the next one."""
    with database.read() as tx:
        object_id = None if slug is None else require(tx, slug).id
        prefix = principal.object_prefix()
        rows = sweeps.listing(
            tx, object_id=object_id, prefix=prefix, state=state, before=cursor, limit=limit + 1
        )
        page = [sweep_info(tx, row) for row in rows[:limit]]
    return page, page[-1].id if len(rows) > limit else None


def cancel(database: Database, sweep_id: str) -> SweepInfo:
    """Stop what is not finished, of its linked sweep, too; what is stored stays. A finished sweep is left as
    it is.
    """
    with database.read() as tx:
        row = require_sweep(tx, sweep_id)
    with database.write() as tx:
        sweeps.lock_object(tx, row.object_id)
        for each in filter(None, (row.id, row.linked)):
            if sweeps.cancel(tx, each):
                audit.record(tx, "sweep.cancel", object=row.object, subject=each)
        decompositions.drop_unwanted(tx, row.object_id)
        return sweep_info(tx, require_sweep(tx, sweep_id))


def retry(database: Database, sweep_id: str) -> SweepInfo:
    """Queue failed and cancelled chunks again, of its linked sweep, too; without any it changes nothing.

    409 if the batch was deleted: what the sweep had found is gone, so the rest would mislead.
    """
    with database.read() as tx:
        row = require_sweep(tx, sweep_id)
    with database.write() as tx:
        sweeps.lock_object(tx, row.object_id)
        row = require_sweep(tx, sweep_id)
        if row.batch is None:
            raise conflict("batch-deleted", "This sweep's batch was deleted: make a new sweep")
        for each in filter(None, (row, _linked(tx, row))):
            # What the other had found may be gone: it stays so.
            if each.batch is not None:
                _retry(tx, each)
        return sweep_info(tx, require_sweep(tx, sweep_id))


def _retry(tx: Tx, row: SweepRow) -> None:
    waiting = False
    if row.finished_at is not None and decompositions.lacks_parts(row):
        waiting = decompositions.again(tx, require(tx, row.object), row, int(clock(tx).timestamp() * 1000))
    if sweeps.retry(tx, row.id, waiting=waiting):
        audit.record(tx, "sweep.retry", object=row.object, subject=row.id)


def _linked(tx: Tx, row: SweepRow) -> SweepRow | None:
    return None if row.linked is None else sweeps.find(tx, row.linked)


def sweep_info(tx: Tx, row: SweepRow) -> SweepInfo:
    """A sweep and how far it has come."""
    done = sweeps.progress(tx, row)
    failed = done.states.get(JobState.FAILED, 0)
    state = sweeps.state_of(row, failed)
    rate = _rate(row, done)
    left = row.pose_count - done.poses_done
    grid = row.request.get("grid")
    return SweepInfo.model_validate(
        {
            **vars(row),
            "batch": row.snapshot["batch"],
            "key": row.made_by,
            "engine": row.request.get("engine"),
            "engines": outcomes.engines(tx, row.id),
            "randomise": row.request.get("randomise"),
            "grid": grid,
            "seed": (grid or row.request.get("sample") or {}).get("seed"),
            "state": state,
            "chunks_done": done.states.get(JobState.DONE, 0),
            "chunks_failed": failed,
            "poses": row.pose_count,
            "poses_done": done.poses_done,
            "full_grid_poses": row.snapshot.get("full_count"),
            "waiting_for": decompositions.waiting_for(tx, row),
            "outcomes": {name: done.counts[name] for name in OUTCOMES if name in done.counts},
            "rate_poses_s": rate,
            "time_left_s": left / rate if rate and state == SweepState.RUNNING else None,
            "failed_chunks": done.failed,
            "warnings": [
                *feasibility.warnings(row.gripper, row.snapshot["world"]["gripper"]),
                *row.snapshot.get("warnings", []),
                *_without_engine(tx, row),
                *_outdated(tx, row),
                *_linked_without_engine(tx, row),
            ],
        }
    )


def _without_engine(tx: Tx, row: SweepRow) -> list[str]:
    """What a sweep waits for that asks for an engine which no worker has."""
    engine = row.request.get("engine")
    if engine is None or row.finished_at is not None or jobs.someone_has(tx, engine, within_s=_LATELY_S):
        return []
    extras = {"pybullet": "sim", "mujoco": "sim,mujoco"}[engine]
    return [
        f"no worker that has {engine} was here in the last {_LATELY_S / 60:.0f} minutes, and no other takes"
        f" what this sweep has left: pip install 'graspdb[{extras}]' on a worker, and start it again"
    ]


def _outdated(tx: Tx, row: SweepRow) -> list[str]:
    """What a sweep that draws, or states how hard to shake, waits for where workers are here, all of a
    version that can't.
    """
    drawn, stated = bool(row.request.get("randomise")), stated_accelerations(row.protocol) is not None
    if row.finished_at is not None or not (drawn or stated):
        return []
    plain = sweep_plan.capability_of("shake" if stated else row.protocol, False)
    needed = sweep_plan.capability_of(row.protocol, drawn)
    there, able = (jobs.someone_has(tx, name, within_s=_LATELY_S) for name in (plain, needed))
    if able or not there:
        return []
    what = "shake as hard as a protocol's name says" if stated else "simulate a pose under what is drawn"
    return [
        f"no worker that was here in the last {_LATELY_S / 60:.0f} minutes can {what}: they are of an older"
        " version, update and start them again"
    ]


def _linked_without_engine(tx: Tx, row: SweepRow) -> list[str]:
    """What the second of two linked sweeps waits for: who asked for both follows the first."""
    other = None if row.purpose == "compare" else _linked(tx, row)
    return [] if other is None else [f"its linked sweep: {told}" for told in _without_engine(tx, other)]


def _rate(row: SweepRow, done: Progress) -> float | None:
    """Poses a second: of late while it runs, over the whole run afterwards."""
    if row.finished_at is not None:
        if row.started_at is None or not done.poses_done:
            return None
        return done.poses_done / max((row.finished_at - row.started_at).total_seconds(), 1e-3)
    return done.recent_poses / done.window_s if done.recent_poses else None
