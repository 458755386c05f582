"""Every attempt at an object in arrays, with what tells which of them share a rotation or a position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES
from graspdb_density import HAAR_VOLUME
from graspdb_geometry.grids import PoseGrid
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.simulation import outcomes, sweeps
from graspdb_service.storage.simulation.outcomes import PackedChunk
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.storage.trials import rows as trial_rows
from graspdb_service.trial_columns import TrialColumns
from graspdb_service.usecases.trials import sweep_plan
from graspdb_service.usecases.trials.selection import Selected
from graspdb_service.usecases.trials.sweep_plan import ChunkPoses

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

COLLISION, NO_ATTEMPT = OUTCOME_CODES["collision"], OUTCOME_CODES["simulation_error"]
_SUCCESS = OUTCOME_CODES["success"]


@dataclass(frozen=True, eq=False)
class AllTrials:
    """Attempts (n,): the rows posted first, then those of sweeps; each pose of a grid once.

    ``proposal`` is in 1/(m^3 rad^3), NaN where not known. ``keys`` (rotation, position) are equal where two
    poses of the one grid share them; None unless all are of one grid. ``left_out`` attempts that collided are
    not here, where fewer were asked for: those that are stand for all, each as much as the other.
    """

    position: Floats
    quaternion: Floats
    success: Bools
    collided: Bools
    symmetric: Bools
    proposal: Floats
    keys: tuple[Ints, Ints] | None
    left_out: int = 0

    def __len__(self) -> int:
        return len(self.success)

    @property
    def attempts(self) -> int:
        """All of them, those left out too."""
        return len(self) + self.left_out


@dataclass(frozen=True, eq=False)
class Swept:
    """A finished chunk of a sweep; ``poses`` of a plan that is no grid, whose poses are computed."""

    sweep: SweepRow
    chunk: PackedChunk
    poses: ChunkPoses | None


@dataclass(frozen=True, eq=False)
class Stored:
    """Attempts as a transaction read them; :func:`joined` makes arrays of them outside it."""

    rows: TrialColumns
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


def read(database: Database, selected: Selected, *, most_collided: int | None = None) -> AllTrials:
    """Every attempt of a selection, packed outcomes included, of sources that post failures, too.

    About ``most_collided`` of those that collided are drawn at random (None: all): nearly all poses of a
    large grid collide, and arrays of them would fill the memory.
    """
    with database.read() as tx:
        stored = fetch(tx, selected)
    return joined(stored, most_collided=most_collided)


def fetch(
    tx: Tx,
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
    chunks = outcomes.collected(
        tx, selected.row.id, provenance_ids=selected.tried, after_revision=after_revision
    )
    known = sweeps.find_many(tx, sorted({chunk.sweep_id for chunk in chunks}))
    swept = []
    for chunk in chunks:
        sweep = known[chunk.sweep_id]
        swept.append(Swept(sweep, chunk, sweep_plan.chunk_poses(tx, sweep, chunk.start, chunk.stop)))
    rows = trial_rows.read(
        tx,
        selected.row.id,
        provenance_ids=sorted(selected.tried),
        successes_only=False,
        after_seq=after_seq,
        swept=False,
        without=without,
    )
    return Stored(rows, swept, selected, without)


def joined(stored: Stored, *, most_collided: int | None = None) -> AllTrials:
    """Attempts in arrays, each pose of a grid once; ``most_collided`` as :func:`read` takes it."""
    rows, provenances, swept = stored.rows, stored.selected.provenances, stored.swept
    grids = {item.sweep.id: sweep_plan.grid_of(item.sweep) for item in swept if item.poses is None}
    codes = [rows.outcome, *(np.frombuffer(item.chunk.outcomes, dtype=np.uint8) for item in swept)]
    kept = [np.ones(len(rows.outcome), dtype=bool), *(~np.isin(c, stored.without) for c in codes[1:])]
    indices: list[Ints | None] = [None]
    for item in swept:
        grid = grids.get(item.sweep.id)
        indices.append(None if grid is None else grid.pose_indices(item.chunk.start, item.chunk.stop))
    _drop_repeated(stored, indices, kept)
    left_out = 0 if most_collided is None else _drop_collided(codes, kept, most_collided)
    flags = np.array([provenances[int(p)] for p in rows.provenance], dtype=bool)
    first = kept[0]
    parts = [
        _Part(
            rows.position[first],
            rows.quaternion_xyzw[first],
            rows.outcome[first],
            flags[first],
            rows.proposal_density[first],
        )
    ]
    for item, code, keep, index in zip(swept, codes[1:], kept[1:], indices[1:], strict=True):
        known = None if index is None else index[keep]
        symmetric = provenances[item.sweep.provenance_id]
        parts.append(_chunk(item, grids.get(item.sweep.id), symmetric, code, keep, known))
    code = np.concatenate([part.codes for part in parts])
    return AllTrials(
        position=np.concatenate([part.position for part in parts]),
        quaternion=np.concatenate([part.quaternion for part in parts]),
        success=code == _SUCCESS,
        collided=code == COLLISION,
        symmetric=np.concatenate([part.symmetric for part in parts]),
        proposal=np.concatenate([part.proposal for part in parts]),
        keys=_keys(parts, stored, grids),
        left_out=left_out,
    )


def _drop_repeated(stored: Stored, indices: list[Ints | None], kept: list[Bools]) -> None:
    """Two sweeps of one grid share poses, which count once: the first one stored."""
    together: dict[str, list[int]] = {}
    sweeps_of: dict[str, set[str]] = {}
    for place, item in enumerate(stored.swept, start=1):
        if indices[place] is not None:
            key = item.sweep.snapshot["repeat_key"]
            together.setdefault(key, []).append(place)
            sweeps_of.setdefault(key, set()).add(item.sweep.id)
    for key, places in together.items():
        # Chunks of one sweep share nothing.
        if len(sweeps_of[key]) < 2:
            continue
        chosen = [np.flatnonzero(kept[place]) for place in places]
        index = np.concatenate(
            [
                part[rows]
                for place, rows in zip(places, chosen, strict=True)
                if (part := indices[place]) is not None
            ]
        )
        first = np.zeros(len(index), dtype=bool)
        first[np.unique(index, return_index=True)[1]] = True
        ends = np.cumsum([len(rows) for rows in chosen])[:-1]
        for place, rows, new in zip(places, chosen, np.split(first, ends), strict=True):
            kept[place][rows[~new]] = False


def _drop_collided(codes: list[NDArray[np.uint8]], kept: list[Bools], most: int) -> int:
    """Keep about ``most`` of what collided, drawn at random; the number of those left out."""
    hits = [np.flatnonzero(keep & (code == COLLISION)) for code, keep in zip(codes, kept, strict=True)]
    total = sum(map(len, hits))
    if total <= most:
        return 0
    rng = np.random.default_rng(0)
    left_out = 0
    for keep, rows in zip(kept, hits, strict=True):
        dropped = rows[rng.random(len(rows)) >= most / total]
        keep[dropped] = False
        left_out += len(dropped)
    return left_out


def _chunk(
    item: Swept,
    grid: PoseGrid | None,
    symmetric: bool,
    codes: NDArray[np.uint8],
    kept: Bools,
    index: Ints | None,
) -> _Part:
    count = int(kept.sum())
    flags, poses = np.full(count, symmetric), item.poses
    if poses is not None:
        at, to, proposal = poses.position[kept], poses.quaternion_xyzw[kept], poses.proposal_density[kept]
        return _Part(at, to, codes[kept], flags, proposal)
    assert grid is not None
    assert index is not None
    position, quaternion = grid.poses(index)
    proposal = np.full(count, 1.0 / (HAAR_VOLUME * grid.volume_m3))
    return _Part(position, quaternion, codes[kept], flags, proposal, index)


def _keys(parts: list[_Part], stored: Stored, grids: dict[str, PoseGrid]) -> tuple[Ints, Ints] | None:
    of_grids = [part.index for part in parts if part.index is not None]
    elsewhere = sum(len(part.codes) for part in parts if part.index is None)
    keys = {stored.repeat_keys[sweep] for sweep in grids}
    if len(keys) != 1 or elsewhere:
        return None
    position, rotation = np.divmod(np.concatenate(of_grids), next(iter(grids.values())).rotation_count)
    return rotation, position
