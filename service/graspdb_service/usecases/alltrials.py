"""Every attempt at an object in arrays, with what tells which of them share a rotation or a position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES
from graspdb_density import HAAR_VOLUME
from graspdb_service.storage import attempts, sweeps, trials
from graspdb_service.storage.attempts import PackedChunk
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.sweeps import SweepRow
from graspdb_service.usecases import plans
from graspdb_service.usecases.plans import ChunkPoses
from graspdb_service.usecases.selection import Selected

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

COLLISION, NO_ATTEMPT = OUTCOME_CODES["collision"], OUTCOME_CODES["simulation_error"]
_SUCCESS = OUTCOME_CODES["success"]


@dataclass(frozen=True, eq=False)
class AllTrials:
    """Attempts (n,): the rows posted first, then those of sweeps; each pose of a grid once.

    Attributes
    ----------
    proposal : 1/(m^3 rad^3), NaN where not known
    keys : (rotation, position) or None
        Equal where two poses of the one grid share them; None unless all attempts are of one grid.
    """

    position: Floats
    quaternion: Floats
    success: Bools
    collided: Bools
    symmetric: Bools
    proposal: Floats
    keys: tuple[Ints, Ints] | None

    def __len__(self) -> int:
        return len(self.success)


@dataclass(frozen=True, eq=False)
class Swept:
    """A finished chunk of a sweep; ``poses`` of a plan that is no grid, whose poses are computed."""

    sweep: SweepRow
    chunk: PackedChunk
    poses: ChunkPoses | None


@dataclass(frozen=True, eq=False)
class Stored:
    """Attempts as a transaction read them; :func:`joined` makes arrays of them outside it."""

    rows: trials.Columns
    swept: list[Swept]
    selected: Selected
    without: Sequence[int]

    @property
    def repeat_keys(self) -> dict[str, str]:
        """What tells whether two sweeps are of one grid, by sweep."""
        return {
            item.sweep.id: item.sweep.snapshot["repeat_key"] if item.sweep.plan == "grid" else item.sweep.id
            for item in self.swept
        }


@dataclass(frozen=True, eq=False)
class _Part:
    position: Floats
    quaternion: Floats
    codes: NDArray[np.uint8]
    symmetric: Bools
    proposal: Floats
    index: Ints | None = None


def read(database: Database, row: ObjectRow, selected: Selected) -> AllTrials:
    """Every attempt of a selection, packed outcomes included, of sources that post failures, too."""
    with database.read() as tx:
        stored = fetch(tx, row.id, selected)
    return joined(stored)


def fetch(
    tx: Tx,
    object_id: int,
    selected: Selected,
    *,
    without: Sequence[int] = (NO_ATTEMPT,),
    after_seq: int = 0,
    after_revision: int = 0,
) -> Stored:
    """Attempts stored since, those with the outcome codes ``without`` left out.

    Sweeps that share poses with chunks from before count them again: who extends what there was compares
    :attr:`Stored.repeat_keys`, and reads all of it where two sweeps are of one grid.
    """
    chunks = attempts.packed_chunks(
        tx, object_id, provenance_ids=selected.tried, after_revision=after_revision
    )
    plan = sweeps.find_many(tx, sorted({chunk.sweep_id for chunk in chunks}))
    swept = [
        Swept(
            plan[chunk.sweep_id], chunk, plans.chunk_poses(tx, plan[chunk.sweep_id], chunk.start, chunk.stop)
        )
        for chunk in chunks
    ]
    rows = trials.read(
        tx,
        object_id,
        provenance_ids=sorted(selected.tried),
        successes_only=False,
        after_seq=after_seq,
        swept=False,
        without=without,
    )
    return Stored(rows, swept, selected, without)


def joined(stored: Stored) -> AllTrials:
    """Attempts in arrays, each pose of a grid once."""
    rows, provenances = stored.rows, stored.selected.provenances
    flags = np.array([provenances[int(p)] for p in rows.provenance], dtype=bool)
    parts = [_Part(rows.position, rows.quaternion_xyzw, rows.outcome, flags, rows.proposal_density)]
    seen: dict[str, list[Ints]] = {}
    for item in stored.swept:
        parts.append(_chunk(item, provenances[item.sweep.provenance_id], stored.without, seen))
    codes = np.concatenate([part.codes for part in parts])
    return AllTrials(
        position=np.concatenate([part.position for part in parts]),
        quaternion=np.concatenate([part.quaternion for part in parts]),
        success=codes == _SUCCESS,
        collided=codes == COLLISION,
        symmetric=np.concatenate([part.symmetric for part in parts]),
        proposal=np.concatenate([part.proposal for part in parts]),
        keys=_keys(parts, stored.swept, seen),
    )


def _chunk(item: Swept, symmetric: bool, without: Sequence[int], seen: dict[str, list[Ints]]) -> _Part:
    sweep, chunk, poses = item.sweep, item.chunk, item.poses
    codes = np.frombuffer(chunk.outcomes, dtype=np.uint8)
    kept = ~np.isin(codes, without)
    if poses is not None:
        count = int(kept.sum())
        return _Part(
            poses.position[kept],
            poses.quaternion_xyzw[kept],
            codes[kept],
            np.full(count, symmetric),
            poses.proposal_density[kept],
        )
    grid = plans.grid_of(sweep)
    index = grid.pose_indices(chunk.start, chunk.stop)
    earlier = seen.setdefault(sweep.snapshot["repeat_key"], [])
    # Two sweeps of one grid share poses, which count once.
    for known in earlier:
        kept &= ~np.isin(index, known)
    index = index[kept]
    earlier.append(index)
    position, quaternion = grid.poses(index)
    proposal = np.full(len(index), 1.0 / (HAAR_VOLUME * grid.volume_m3))
    return _Part(position, quaternion, codes[kept], np.full(len(index), symmetric), proposal, index)


def _keys(parts: list[_Part], swept: list[Swept], seen: dict[str, list[Ints]]) -> tuple[Ints, Ints] | None:
    of_grids = [part.index for part in parts if part.index is not None]
    elsewhere = sum(len(part.codes) for part in parts if part.index is None)
    if len(seen) != 1 or elsewhere:
        return None
    grid = plans.grid_of(next(item.sweep for item in swept if item.sweep.plan == "grid"))
    position, rotation = np.divmod(np.concatenate(of_grids), grid.rotation_count)
    return rotation, position
