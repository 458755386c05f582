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
from graspdb_service.storage.tables import batches, jobs, packed_outcomes, sweeps
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


@dataclass(frozen=True)
class BothChunks:
    """What two linked sweeps say of the places ``start`` to ``stop`` of their plan: outcome codes (uint8),
    of several draws how many succeeded (uint8), and what each measured (:func:`read_measured`).
    """

    start: int
    stop: int
    outcomes: bytes
    successes: bytes | None
    measured: bytes | None
    other_outcomes: bytes
    other_successes: bytes | None
    other_measured: bytes | None


def read_measured(content: bytes | None) -> tuple[Ints, Floats, Floats]:
    """Places in their chunk, qualities and widths (n,) of the poses that met physics, as they were stored."""
    table = np.frombuffer(content or b"", dtype=_MEASURED)
    return (
        table["place"].astype(np.int64),
        table["quality"].astype(np.float64),
        table["width_m"].astype(np.float64),
    )


def comparing(tx: Tx, object_id: int) -> list[str]:
    """Ids of an object's sweeps that compare, in the order of their making; their batches are still there."""
    query = (
        select(sweeps.c.id)
        .join(batches, batches.c.sweep_id == sweeps.c.id)
        .where(sweeps.c.object_id == object_id, sweeps.c.purpose == "compare")
    )
    return [str(name) for name in tx.scalars(query.order_by(sweeps.c.id))]


def both(tx: Tx, first: str, other: str) -> list[BothChunks]:
    """The chunks that two linked sweeps have finished, in the plan's order."""
    one, two = packed_outcomes.alias("one"), packed_outcomes.alias("two")
    query = (
        select(
            jobs.c.start,
            jobs.c.stop,
            one.c.outcomes,
            one.c.successes,
            one.c.measured,
            two.c.outcomes.label("other_outcomes"),
            two.c.successes.label("other_successes"),
            two.c.measured.label("other_measured"),
        )
        .select_from(
            one.join(jobs, jobs.c.id == one.c.job_id).join(
                two, (two.c.sweep_id == other) & (two.c.number == one.c.number)
            )
        )
        .where(one.c.sweep_id == first)
        .order_by(one.c.number)
    )
    return all_as(tx, query, BothChunks)


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
