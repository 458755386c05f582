"""Results: what a worker hands in, stored once in the transaction that completes its job."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from graspdb.wire import OUTCOME_CODES, OUTCOMES, ResultAccepted
from graspdb.wire.states import JobState
from graspdb_service.formats.sweep_outcomes import ChunkResult
from graspdb_service.problems import busy, invalid
from graspdb_service.storage import objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Tx
from graspdb_service.storage.simulation import jobs, linked, sweeps
from graspdb_service.storage.simulation import outcomes as packed
from graspdb_service.storage.simulation.jobs import JobRow
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.storage.trials import batches, provenances
from graspdb_service.storage.trials import rows as trial_rows
from graspdb_service.trial_columns import Bools, Provenance, TrialColumns
from graspdb_service.usecases.geometry import decompositions, meshes
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime.runtime import Runtime
from graspdb_service.usecases.simulation import leases
from graspdb_service.usecases.simulation.leases import lost_lease
from graspdb_service.usecases.trials import sweep_plan

#: Sweeps over the same grid that finish chunks at the same moment make one another look again.
_MAX_LOOKS = 50

_SUCCESS = OUTCOME_CODES["success"]
_COLLISION = OUTCOME_CODES["collision"]


class WrongResult(Exception):
    """A result of another kind than the job's."""

    def __init__(self, kind: str) -> None:
        super().__init__(kind)
        self.kind = kind


class _LostLease(Exception):
    """Leave the transaction: nothing of it may stay."""


class _Overtaken(Exception):
    """Another sweep over the same grid has finished a chunk since its chunks were read."""


def complete(ctx: Runtime, job_id: str, lease_id: str, body: bytes, result: ChunkResult) -> ResultAccepted:
    """Store a chunk's result in the transaction that completes its job.

    The same ``body`` under the same lease is answered the same again. 409 ``lease-lost``; 422 if the result
    does not fit the chunk: nothing is stored then.
    """
    sha256 = hashlib.sha256(body).hexdigest()
    for _ in range(_MAX_LOOKS):
        with ctx.database.read() as tx:
            job = _held(tx, job_id, lease_id, sha256, "simulate")
            if isinstance(job, ResultAccepted):
                return job
            sweep = sweeps.find(tx, job.sweep_id or "")
            if sweep is None:
                raise lost_lease(job)
            stored = sweep_plan.chunk_poses(tx, sweep, job.start, job.stop)
            twins = sweeps.siblings(tx, sweep) if sweep.plan == "grid" and sweep.collects else {}
            ranges = packed.done_ranges(tx, list(twins))
            seen = packed.count_done(tx, list(twins))
        outcomes = _outcomes(result, job)
        if stored is None:
            grid = sweep_plan.grid_of(sweep)
            poses = sweep_plan.grid_poses(grid, grid.pose_indices(job.start, job.stop))
            others = [(sweep_plan.grid_of(twin), ranges[twin.id]) for twin in twins.values()]
            fresh = sweep_plan.not_stored_yet(grid, job.start, job.stop, poses.pose_index, others)
        else:
            poses = stored
            fresh = np.ones(len(outcomes), dtype=np.bool_)
        successes = _successes(result, outcomes, sweep_plan.draws(sweep))
        chunk = _chunk(sweep, result, outcomes, successes, poses, fresh)
        try:
            return _store(ctx, job, lease_id, sha256, sweep, chunk, list(twins), seen)
        except _Overtaken:
            continue
        except (_LostLease, objects.ObjectGone):
            return _replayed(ctx, job_id, lease_id, sha256, "simulate")
    raise busy("Sweeps over the same grid keep overtaking this result; send it again")


def complete_parts(ctx: Runtime, job_id: str, lease_id: str, body: bytes) -> ResultAccepted:
    """Store the convex parts that a worker made, in the transaction that completes its job.

    409 ``lease-lost``; 413 and 422 as for parts that a user sends: nothing is stored then.
    """
    sha256 = hashlib.sha256(body).hexdigest()
    with ctx.database.read() as tx:
        job = _held(tx, job_id, lease_id, sha256, "decompose")
        if isinstance(job, ResultAccepted):
            return job
        source = decompositions.source(tx, job)
        row = None if source is None else require(tx, source)
    if row is None:
        raise lost_lease(job)
    info = meshes.check_parts(ctx, row, body)
    try:
        with ctx.database.write() as tx:
            revision, _ = objects.advance(tx, row.id, append=False)
            locked = require(tx, row.slug)
            accepted = ResultAccepted(job=job.id, revision=revision, inserted=0)
            # The mesh can't have changed: it has sweeps.
            if locked.parts_sha256 is not None or not jobs.complete(
                tx, job.id, lease_id, sha256=sha256, answer=accepted.model_dump(), counts={}
            ):
                raise _LostLease
            meshes.store_parts(tx, locked, body, info)
            audit.record(tx, "job.result", object=row.slug, subject=job.id)
            jobs.credit_worker(tx, job.worker, 0)
    except (_LostLease, objects.ObjectGone):
        return _replayed(ctx, job_id, lease_id, sha256, "decompose")
    return accepted


def _held(tx: Tx, job_id: str, lease_id: str, sha256: str, kind: str) -> JobRow | ResultAccepted:
    """The job under this lease, or what the same result was answered before; 409 ``lease-lost``."""
    job = leases.require(jobs.find(tx, job_id), job_id)
    if job.state == JobState.DONE and job.lease_id == lease_id and job.result_sha256 == sha256:
        return ResultAccepted.model_validate(job.answer)
    if job.state != JobState.LEASED or job.lease_id != lease_id:
        raise lost_lease(job)
    if job.kind != kind:
        raise WrongResult(job.kind)
    return job


def _replayed(ctx: Runtime, job_id: str, lease_id: str, sha256: str, kind: str) -> ResultAccepted:
    """For a lease lost meanwhile: to another claim, a cancellation, or this very request sent twice."""
    with ctx.database.read() as tx:
        job = _held(tx, job_id, lease_id, sha256, kind)
    if isinstance(job, ResultAccepted):
        return job
    raise lost_lease(job)


@dataclass(frozen=True)
class _Chunk:
    """A checked result: every outcome, and what of it is new to the object."""

    outcomes: npt.NDArray[np.uint8]
    successes: npt.NDArray[np.uint8] | None
    rows: TrialColumns
    engine: str | None
    packed: dict[int, int]
    counts: dict[str, dict[str, int]]
    measured: bytes | None


def _outcomes(result: ChunkResult, job: JobRow) -> npt.NDArray[np.uint8]:
    outcomes = result.outcomes
    expected = job.stop - job.start
    if len(outcomes) != expected:
        raise invalid("outcomes", f"{expected} codes, one for every pose of the chunk, not {len(outcomes)}")
    unknown = np.flatnonzero(outcomes >= len(OUTCOMES))
    if unknown.size:
        at = int(unknown[0])
        raise invalid(
            "outcomes", f"{int(outcomes[at])} at place {at} is no outcome code (0 to {len(OUTCOMES) - 1})"
        )
    return outcomes


def _successes(
    result: ChunkResult, outcomes: npt.NDArray[np.uint8], draws: int
) -> npt.NDArray[np.uint8] | None:
    """How many draws of each pose succeeded; None where each is simulated once."""
    won = result.successes
    if (won is None) != (draws == 1):
        told = "each pose is simulated once: leave it out" if draws == 1 else f"of {draws} draws of each pose"
        raise invalid("successes", told)
    if won is None:
        return None
    if len(won) != len(outcomes):
        raise invalid(
            "successes", f"{len(outcomes)} numbers, one for every pose of the chunk, not {len(won)}"
        )
    many = np.flatnonzero(won > draws)
    if many.size:
        raise invalid("successes", f"{int(won[many[0]])} at place {int(many[0])} is more than {draws} draws")
    odd = np.flatnonzero((2 * won.astype(np.int64) >= draws) != (outcomes == _SUCCESS))
    if odd.size:
        at = int(odd[0])
        raise invalid(
            "outcomes",
            f"{OUTCOMES[outcomes[at]]} at place {at}, and {int(won[at])} of {draws} draws succeeded: success"
            " is half of them",
        )
    return won


def _chunk(
    sweep: SweepRow,
    result: ChunkResult,
    outcomes: npt.NDArray[np.uint8],
    successes: npt.NDArray[np.uint8] | None,
    poses: TrialColumns,
    fresh: Bools,
) -> _Chunk:
    index = result.pose_index
    for name in ("width_m", "quality"):
        if len(getattr(result, name)) != len(index):
            raise invalid(f"rows.{name}", f"as many values as pose_index has: {len(index)}")
    if len(index) and index.max() > poses.pose_index[-1]:
        raise invalid("rows.pose_index", f"{index.max()} is no pose of this chunk")
    if np.any(np.diff(index) <= 0):
        raise invalid("rows.pose_index", "must be ascending, each pose once")
    place = np.searchsorted(poses.pose_index, index)
    strange = np.flatnonzero(poses.pose_index[place] != index)
    if strange.size:
        raise invalid("rows.pose_index", f"{int(index[strange[0]])} is no pose of this chunk")
    held = outcomes == _SUCCESS if successes is None else successes > 0
    if np.any((outcomes[place] == _COLLISION) & ~held[place]):
        raise invalid("rows.pose_index", "a pose that collides meets no physics: it must have no row")
    is_row = np.zeros(len(outcomes), dtype=np.bool_)
    is_row[place] = True
    if np.any(held & ~is_row):
        missing = int(poses.pose_index[np.flatnonzero(held & ~is_row)[0]])
        raise invalid("rows.pose_index", f"pose {missing} succeeded, so it must have a row")
    kept = place[fresh[place]]
    new = fresh[place]
    columns = replace(
        poses[kept],
        outcome=outcomes[kept],
        provenance=np.full(len(kept), sweep.provenance_id, dtype=np.int64),
        quality=result.quality[new],
        width_m=result.width_m[new],
    )
    drawn = None if successes is None else successes.tobytes()
    columns = sweep_plan.with_draws(columns, sweep, drawn, kept)
    packed = _count(outcomes[fresh & ~is_row]) if sweep.collects else {}
    counts: dict[str, dict[str, int]] = {
        "all": {OUTCOMES[code]: number for code, number in _count(outcomes).items()},
        "packed": {str(code): number for code, number in packed.items()},
    }
    measured = None if sweep.linked is None else linked.measured(place, result.quality, result.width_m)
    return _Chunk(outcomes, successes, columns, result.engine, packed, counts, measured)


def _count(codes: npt.NDArray[np.uint8]) -> dict[int, int]:
    found, numbers = np.unique(codes, return_counts=True)
    return dict(zip(found.tolist(), numbers.tolist(), strict=True))


def _of_engine(tx: Tx, sweep: SweepRow, chunk: _Chunk) -> TrialColumns:
    """A chunk's rows, of the provenance that names its engine; under the object's lock."""
    if chunk.engine is None or not len(chunk.rows):
        return chunk.rows
    gripper = f"{sweep.gripper}@{sweep.gripper_version}"
    origin = Provenance(gripper, "simulation", sweep.protocol, chunk.engine)
    number = provenances.ensure(tx, sweep.object_id, origin)
    return replace(chunk.rows, provenance=np.full(len(chunk.rows), number, dtype=np.int64))


def _store(
    ctx: Runtime,
    job: JobRow,
    lease_id: str,
    sha256: str,
    sweep: SweepRow,
    chunk: _Chunk,
    twins: list[str],
    seen: int,
) -> ResultAccepted:
    collects = sweep.collects
    with ctx.database.write() as tx:
        rows = len(chunk.rows) if collects else 0
        if sweep.enters:
            revision, first_seq = objects.advance(tx, sweep.object_id, rows=rows, append=True)
        else:
            unchanged, first_seq = sweeps.lock_object(tx, sweep.object_id), 0
            if unchanged is None:
                raise _LostLease
            revision = unchanged
        if twins and packed.count_done(tx, twins) != seen:
            raise _Overtaken
        accepted = ResultAccepted(job=job.id, revision=revision, inserted=rows)
        if not jobs.complete(
            tx, job.id, lease_id, sha256=sha256, answer=accepted.model_dump(), counts=chunk.counts
        ):
            raise _LostLease
        packed.store(
            tx,
            job_id=job.id,
            sweep_id=sweep.id,
            number=job.number,
            revision=revision,
            outcomes=chunk.outcomes.tobytes(),
            successes=None if chunk.successes is None else chunk.successes.tobytes(),
            engine=chunk.engine,
            measured=chunk.measured,
        )
        sweeps.note_finished(tx, sweep.id)
        batch = batches.of_sweep(tx, sweep.id)
        if batch is None:
            raise _LostLease
        if collects:
            columns = _of_engine(tx, sweep, chunk)
            trial_rows.insert(tx, sweep.object_id, batch.id, columns, revision=revision, first_seq=first_seq)
            provenances.add_packed(tx, sweep.provenance_id, chunk.packed)
        batches.grow(
            tx,
            batch.id,
            first_seq=first_seq if rows else None,
            last_seq=first_seq + rows - 1 if rows else None,
            inserted=rows,
            packed=sum(chunk.packed.values()) if collects else len(chunk.outcomes),
            revision=revision if sweep.enters else None,
        )
        audit.record(tx, "job.result", object=sweep.object, subject=job.id)
        jobs.credit_worker(tx, job.worker, job.stop - job.start)
    return accepted
