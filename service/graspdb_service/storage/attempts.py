"""The packed outcomes of sweeps, read as attempts."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from sqlalchemy import select

from graspdb_service.storage.database import Tx
from graspdb_service.storage.tables import batches, jobs, packed_outcomes, sweeps


@dataclass(frozen=True)
class PackedChunk:
    """Outcome codes (uint8) of the places ``start`` to ``stop`` of a sweep's plan."""

    sweep_id: str
    start: int
    stop: int
    outcomes: bytes


def packed_chunks(
    tx: Tx, object_id: int, *, provenance_ids: Collection[int], after_revision: int = 0
) -> list[PackedChunk]:
    """Chunks of an object's collecting sweeps stored after a revision, in commit order."""
    query = (
        select(packed_outcomes.c.sweep_id, jobs.c.start, jobs.c.stop, packed_outcomes.c.outcomes)
        .join(jobs, jobs.c.id == packed_outcomes.c.job_id)
        .join(sweeps, sweeps.c.id == packed_outcomes.c.sweep_id)
        # A sweep without its batch is one whose outcomes were deleted.
        .join(batches, batches.c.sweep_id == sweeps.c.id)
        .where(
            sweeps.c.object_id == object_id,
            sweeps.c.purpose == "collect",
            sweeps.c.provenance_id.in_(sorted(provenance_ids)),
            packed_outcomes.c.revision > after_revision,
        )
        .order_by(packed_outcomes.c.revision, packed_outcomes.c.number)
    )
    return [PackedChunk(s, int(a), int(b), bytes(content)) for s, a, b, content in tx.execute(query)]
