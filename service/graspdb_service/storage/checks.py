"""Outcomes of sweeps that check: stored, and counted nowhere but in the reports that ask for them."""

from __future__ import annotations

import hashlib

from sqlalchemy import func, select

from graspdb_service.storage.attempts import PackedChunk
from graspdb_service.storage.database import Tx
from graspdb_service.storage.tables import batches, jobs, packed_outcomes, sweeps


def stamp(tx: Tx, object_id: int) -> str:
    """Another one whenever an object's finished checks change, which its revision does not tell."""
    query = (
        select(sweeps.c.id, func.count())
        .join(batches, batches.c.sweep_id == sweeps.c.id)
        .join(packed_outcomes, packed_outcomes.c.sweep_id == sweeps.c.id)
        .where(sweeps.c.object_id == object_id, sweeps.c.purpose == "check")
        .group_by(sweeps.c.id)
        .order_by(sweeps.c.id)
    )
    digest = hashlib.sha256()
    for sweep_id, chunks in tx.execute(query):
        digest.update(f"{sweep_id}:{chunks};".encode())
    return digest.hexdigest()[:16]


def chunks(tx: Tx, object_id: int, *, gripper: str | None, protocol: str | None) -> list[PackedChunk]:
    """Finished chunks of an object's checks with a gripper and protocol (None: any), in the plans' order."""
    query = (
        select(packed_outcomes.c.sweep_id, jobs.c.start, jobs.c.stop, packed_outcomes.c.outcomes)
        .join(jobs, jobs.c.id == packed_outcomes.c.job_id)
        .join(sweeps, sweeps.c.id == packed_outcomes.c.sweep_id)
        # A sweep without its batch is one whose outcomes were deleted.
        .join(batches, batches.c.sweep_id == sweeps.c.id)
        .where(sweeps.c.object_id == object_id, sweeps.c.purpose == "check")
        .order_by(sweeps.c.id, packed_outcomes.c.number)
    )
    if gripper is not None:
        query = query.where(sweeps.c.gripper == gripper)
    if protocol is not None:
        query = query.where(sweeps.c.protocol == protocol)
    return [PackedChunk(s, int(a), int(b), bytes(content)) for s, a, b, content in tx.execute(query)]
