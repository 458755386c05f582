"""What other sweeps keep of a sweep whose batch is deleted.

Sweeps over one grid share poses, and a pose is stored once: by the sweep that finished it first. When that
sweep's batch goes, what another has simulated as well stays, and becomes the other's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graspdb_service.storage.database import Tx
from graspdb_service.storage.simulation import outcomes, sweeps
from graspdb_service.storage.simulation.outcomes import DoneChunk
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.storage.trials import batches, provenances
from graspdb_service.storage.trials import rows as trial_rows
from graspdb_service.storage.trials.batches import BatchRow
from graspdb_service.trial_columns import Ints
from graspdb_service.usecases.trials import sweep_plan


@dataclass(frozen=True, eq=False)
class _Share:
    """What one finished chunk of another sweep inherits."""

    chunk: DoneChunk
    heir: SweepRow
    rows: list[tuple[int, int]]
    row_count: int
    packed: dict[int, int]


@dataclass(frozen=True, eq=False)
class Inheritance:
    """Who gets what, as it was when it was worked out; :meth:`holds` tells whether it still is so."""

    sweep_id: str
    seen: tuple[str, ...]
    shares: list[_Share]

    def holds(self, tx: Tx) -> bool:
        """Whether no sweep over the grid has finished another chunk, or lost its batch; under the lock."""
        sweep = sweeps.find(tx, self.sweep_id)
        return sweep is not None and self.seen == _seen(_chunks(tx, sweep)[1])

    def hand_over(self, tx: Tx, batch: BatchRow) -> None:
        """Move rows to the batches of their heirs, and count packed outcomes as theirs."""
        for share in self.shares:
            heir = batches.of_sweep(tx, share.heir.id)
            assert heir is not None
            assert heir.provenance_id is not None
            if share.rows:
                trial_rows.move(tx, batch.object_id, from_batch=batch.id, to_batch=heir.id, ranges=share.rows)
            if share.packed:
                outcomes.add_packed_counts(tx, share.chunk.job_id, share.packed)
                provenances.add_packed(tx, heir.provenance_id, share.packed)
            batches.grow(
                tx,
                heir.id,
                first_seq=share.rows[0][0] if share.rows else None,
                last_seq=share.rows[-1][1] if share.rows else None,
                inserted=share.row_count,
                packed=sum(share.packed.values()),
            )


def of(tx: Tx, batch: BatchRow) -> Inheritance | None:
    """What would be left of a batch; None where no other sweep holds a pose of it."""
    sweep = None if batch.sweep_id is None else sweeps.find(tx, batch.sweep_id)
    if sweep is None or sweep.plan != "grid" or not sweep.collects:
        return None
    heirs, chunks = _chunks(tx, sweep)
    if not heirs:
        return None
    grid = sweep_plan.grid_of(sweep)
    own = [chunk for chunk in chunks if chunk.sweep_id == sweep.id]
    if not own:
        return None
    index = np.concatenate([grid.pose_indices(chunk.start, chunk.stop) for chunk in own])
    revision = np.repeat([chunk.revision for chunk in own], [chunk.stop - chunk.start for chunk in own])
    order = np.argsort(index)
    index, revision = index[order], revision[order]
    seq = np.empty(0, dtype=np.int64)
    place = seq
    if batch.first_seq is not None and batch.last_seq is not None:
        seq, posed = trial_rows.read_swept(tx, batch.object_id, batch.id, batch.first_seq, batch.last_seq)
        place = np.searchsorted(index, posed)
    row_of = np.full(len(index), -1, dtype=np.int64)
    row_of[place] = np.arange(len(seq))
    # Poses that this batch has stored and nobody has inherited yet.
    left = np.ones(len(index), dtype=np.bool_)
    shares = []
    # In commit order, so that who finished a pose first has it.
    for chunk in chunks:
        if chunk.sweep_id == sweep.id:
            continue
        heir = heirs[chunk.sweep_id]
        theirs = sweep_plan.grid_of(heir).pose_indices(chunk.start, chunk.stop)
        at = np.minimum(np.searchsorted(index, theirs), len(index) - 1)
        both = index[at] == theirs
        stored_here = chunk.revision < revision[at]
        left[at[both & stored_here]] = False
        gets = both & ~stored_here & left[at]
        if not gets.any():
            continue
        left[at[gets]] = False
        rows = row_of[at[gets]]
        codes = np.frombuffer(outcomes.outcomes_of(tx, chunk.job_id), dtype=np.uint8)[gets][rows < 0]
        numbers = np.bincount(codes, minlength=1)
        shares.append(
            _Share(
                chunk,
                heir,
                _ranges(np.sort(rows[rows >= 0]), seq),
                int((rows >= 0).sum()),
                {int(code): int(numbers[code]) for code in np.flatnonzero(numbers)},
            )
        )
    return Inheritance(sweep.id, _seen(chunks), shares)


def _chunks(tx: Tx, sweep: SweepRow) -> tuple[dict[str, SweepRow], list[DoneChunk]]:
    """The other sweeps over the grid, and the finished chunks of all of them in commit order."""
    heirs = sweeps.siblings(tx, sweep)
    return heirs, outcomes.done_chunks(tx, [sweep.id, *heirs]) if heirs else []


def _seen(chunks: list[DoneChunk]) -> tuple[str, ...]:
    return tuple(chunk.job_id for chunk in chunks)


def _ranges(rows: Ints, seq: Ints) -> list[tuple[int, int]]:
    """Runs of rows that follow one another among a batch's, as first and last sequence numbers."""
    if not len(rows):
        return []
    breaks = np.flatnonzero(np.diff(rows) != 1)
    first, last = np.r_[0, breaks + 1], np.r_[breaks, len(rows) - 1]
    return list(zip(seq[rows[first]].tolist(), seq[rows[last]].tolist(), strict=True))
