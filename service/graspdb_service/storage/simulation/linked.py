"""Linked sweeps: what two engines say of the same poses.

The second of two compares: its outcomes are no trials. A chunk of one and the chunk of the other with the
same number are the same poses in the same order. Of linked sweeps it is kept what physics measured, for each
pose that met it in that engine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy import exists, select

from graspdb_service.storage.database import Tx, all_as
from graspdb_service.storage.simulation.outcomes import PackedChunk
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.storage.tables import jobs, packed_outcomes, sweeps
from graspdb_service.trial_columns import Floats, Ints

_MEASURED = np.dtype([("place", "<u4"), ("quality", "<f4"), ("width_m", "<f4")])


@dataclass(frozen=True)
class ComparedChunk:
    """What the sweep that compares says of the poses of a chunk, in their order: as :class:`PackedChunk`."""

    sweep_id: str
    number: int
    outcomes: bytes
    successes: bytes | None


def measured(place: Ints, quality: Floats, width_m: Floats) -> bytes:
    """What was measured of poses at these places (n,) of a chunk, as it is stored."""
    table = np.empty(len(place), dtype=_MEASURED)
    table["place"], table["quality"], table["width_m"] = place, quality, width_m
    return table.tobytes()


def compared(
    tx: Tx, chunks: Sequence[PackedChunk], known: Mapping[str, SweepRow]
) -> dict[tuple[str, int], ComparedChunk]:
    """Of chunks of collecting sweeps, by sweep and number, what is there by now of the sweeps that
    compare."""
    of = {sweep.linked: sweep.id for sweep in known.values() if sweep.linked is not None}
    numbers = [chunk.number for chunk in chunks if known[chunk.sweep_id].linked is not None]
    if not numbers:
        return {}
    columns = (packed_outcomes.c[name] for name in ("sweep_id", "number", "outcomes", "successes"))
    query = select(*columns).where(
        packed_outcomes.c.sweep_id.in_(sorted(of)),
        packed_outcomes.c.number.between(min(numbers), max(numbers)),
    )
    return {(of[chunk.sweep_id], chunk.number): chunk for chunk in all_as(tx, query, ComparedChunk)}


def came_later(tx: Tx, object_id: int, *, after_revision: int) -> bool:
    """Whether chunks that compare were stored after a revision with chunks from before it."""
    own, first, job = packed_outcomes.alias("own"), packed_outcomes.alias("first"), jobs.alias("job")
    pairs = (
        sweeps.join(own, own.c.sweep_id == sweeps.c.id)
        .join(job, (job.c.sweep_id == sweeps.c.linked) & (job.c.number == own.c.number))
        .join(first, first.c.job_id == job.c.id)
    )
    query = (
        select(own.c.job_id)
        .select_from(pairs)
        .where(
            sweeps.c.object_id == object_id,
            sweeps.c.purpose == "compare",
            own.c.revision > after_revision,
            first.c.revision <= after_revision,
        )
    )
    return bool(tx.scalar(select(exists(query))))
