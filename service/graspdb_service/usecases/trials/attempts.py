"""Every attempt at an object in arrays, with what tells which of them share a rotation or a position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graspdb.wire import OUTCOME_CODES
from graspdb_density import GraspDensity, IsotropicKernel, SuccessModel
from graspdb_density.se3 import Poses
from graspdb_density.success.kernel_regression import SuccessKernel
from graspdb_geometry.grids import PoseGrid
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.simulation import linked, outcomes, sweeps
from graspdb_service.storage.simulation.linked import ComparedChunk
from graspdb_service.storage.simulation.outcomes import PackedChunk
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.storage.trials import rows as trial_rows
from graspdb_service.trial_columns import Bools, Floats, Ints, TrialColumns
from graspdb_service.usecases.trials import sweep_plan
from graspdb_service.usecases.trials.selection import Selected

COLLISION, NO_ATTEMPT = OUTCOME_CODES["collision"], OUTCOME_CODES["simulation_error"]
_SUCCESS = OUTCOME_CODES["success"]
#: Shares of success are told apart to so many'ths: of whatever n, models sort attempts by few different ones.
_SHARES = 60
#: Where two engines tried a pose several times, to fewer: shares and what they differ by make many pairs.
_COMPARED_SHARES = 20


@dataclass(frozen=True, eq=False)
class AllTrials:
    """Attempts (n,): the rows posted first, then those of sweeps; each pose of a grid once.

    ``success`` is an outcome; ``share`` by how much each succeeded, k of n, to within a 120th, None where
    nothing was tried several times. ``provenance`` are internal ids, ``weight`` how much each counts by its
    source; ``proposal`` is in 1/(m^3 rad^3), NaN where not known. ``keys`` (rotation, position) are equal
    where two poses of the one grid share them; None unless all are of one grid. ``left_out`` attempts that
    collided are not here, where fewer were asked for: those that are stand for all, each as much.

    A pose that both of two linked sweeps have simulated is one attempt: ``share`` is the mean of what they
    say, and ``spread`` half of what they differ by, None where no two have; both to within a 40th, and the
    spread not less, where they tried it several times.
    """

    poses: Poses
    success: Bools
    collided: Bools
    symmetric: Bools
    provenance: Ints
    weight: Floats
    proposal: Floats
    keys: tuple[Ints, Ints] | None
    left_out: int = 0
    share: Floats | None = None
    spread: Floats | None = None

    def __len__(self) -> int:
        return len(self.success)

    @property
    def attempts(self) -> int:
        """All of them, those left out too."""
        return len(self) + self.left_out

    @property
    def shares(self) -> Floats:
        """By how much each succeeded (n,), from 0 to 1."""
        return self.success.astype(np.float64) if self.share is None else self.share

    def some(self, most: int) -> Ints:
        """Rows of all of them, or of so many drawn at random."""
        if len(self) <= most:
            return np.arange(len(self))
        return np.sort(np.random.default_rng(0).choice(len(self), size=most, replace=False))

    def success_model(self, kernel: SuccessKernel, rows: Bools | Ints) -> SuccessModel:
        """How likely success is by some of them."""
        return self.added_to(SuccessModel(kernel), rows)

    def added_to(self, model: SuccessModel, rows: Bools | Ints) -> SuccessModel:
        """A model with some of them more."""
        won = self.success if self.share is None else self.share
        spread = None if self.spread is None else self.spread[rows]
        return model.extend(self.poses[rows], won[rows], self.symmetric[rows], self.weight[rows], spread)

    def density(
        self, kernel: IsotropicKernel, rows: Bools | Ints, weights: ArrayLike | None = None
    ) -> GraspDensity:
        """The density of some of them."""
        return GraspDensity.build(
            self.poses[rows], kernel=kernel, weights=weights, symmetric=self.symmetric[rows]
        )


@dataclass(frozen=True, eq=False)
class Swept:
    """A finished chunk of a sweep; ``poses`` of a plan that is no grid, whose poses are computed; what the
    linked sweep says of it, if that has come.
    """

    sweep: SweepRow
    chunk: PackedChunk
    poses: TrialColumns | None
    compared: ComparedChunk | None = None


@dataclass(frozen=True, eq=False)
class Stored:
    """Attempts as a transaction read them; :func:`joined` makes arrays of them outside it."""

    rows: TrialColumns
    swept: list[Swept]
    selected: Selected
    without: Sequence[int]

    @property
    def empty(self) -> bool:
        return not len(self.rows) and not self.swept

    @property
    def repeat_keys(self) -> dict[str, str]:
        """What tells whether two sweeps are of one grid, by sweep."""
        return {
            item.sweep.id: item.sweep.snapshot["repeat_key"] if item.sweep.plan == "grid" else item.sweep.id
            for item in self.swept
        }


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
    grids: bool = True,
) -> Stored:
    """Attempts stored since, those with the outcome codes ``without`` left out, and those of ``grids``.

    Sweeps that share poses with chunks from before count them again: who extends what there was compares
    :attr:`Stored.repeat_keys`, and reads all of it where two sweeps are of one grid.
    """
    chunks = outcomes.collected(
        tx, selected.row.id, provenance_ids=selected.tried, after_revision=after_revision, grids=grids
    )
    known = sweeps.find_many(tx, sorted({chunk.sweep_id for chunk in chunks}))
    compared = linked.compared(tx, chunks, known)
    swept = []
    for chunk in chunks:
        sweep = known[chunk.sweep_id]
        poses = sweep_plan.chunk_poses(tx, sweep, chunk.start, chunk.stop)
        swept.append(Swept(sweep, chunk, poses, compared.get((sweep.id, chunk.number))))
    rows = trial_rows.posted(
        tx, selected.row.id, sorted(selected.tried), after_seq=after_seq, without=without
    )
    return Stored(rows, swept, selected, without)


def joined(stored: Stored, *, most_collided: int | None = None) -> AllTrials:
    """Attempts in arrays, each pose of a grid once; ``most_collided`` as :func:`read` takes it."""
    rows, swept = stored.rows, stored.swept
    grids = {item.sweep.id: sweep_plan.grid_of(item.sweep) for item in swept if item.poses is None}
    codes = [rows.outcome, *(np.frombuffer(item.chunk.outcomes, dtype=np.uint8) for item in swept)]
    kept = [np.ones(len(rows), dtype=bool), *(~np.isin(c, stored.without) for c in codes[1:])]
    indices = [
        grids[item.sweep.id].pose_indices(item.chunk.start, item.chunk.stop) if item.poses is None else None
        for item in swept
    ]
    _drop_repeated(swept, indices, kept[1:])
    left_out = 0 if most_collided is None else _drop_collided(codes, kept, most_collided)
    parts = [rows[kept[0]]]
    for item, code, keep, index in zip(swept, codes[1:], kept[1:], indices, strict=True):
        if item.poses is not None:
            chunk = item.poses[keep]
        else:
            assert index is not None
            chunk = sweep_plan.grid_poses(grids[item.sweep.id], index[keep])
        provenance = np.full(len(chunk), item.sweep.provenance_id)
        chunk = replace(chunk, outcome=code[keep], provenance=provenance)
        parts.append(sweep_plan.with_draws(chunk, item.sweep, item.chunk.successes, keep))

    def column(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(part, name) for part in parts])

    code, provenance = column("outcome"), column("provenance")
    share, spread = _shares(swept, parts, kept[1:])
    return AllTrials(
        poses=Poses(column("position"), column("quaternion_xyzw")),
        success=code == _SUCCESS,
        collided=code == COLLISION,
        symmetric=stored.selected.symmetric(provenance),
        provenance=provenance,
        weight=stored.selected.weights(provenance),
        proposal=column("proposal_density"),
        keys=_keys(stored, parts, grids),
        left_out=left_out,
        share=share,
        spread=spread,
    )


def _shares(
    swept: list[Swept], parts: list[TrialColumns], kept: list[Bools]
) -> tuple[Floats | None, Floats | None]:
    """By how much attempts of all ``parts`` succeeded, and half of what two engines differ by, each (n,);
    None where that is known without. The first part is of no sweep; ``kept`` are those of each other's chunk.
    """
    compared = any(item.compared is not None for item in swept)
    if not compared and not any(len(part.attempts) for part in parts):
        return None, None
    shares = [np.round(part.share * _SHARES) / _SHARES for part in parts]
    spreads = [np.zeros(len(part)) for part in parts]
    for place, (item, keep) in enumerate(zip(swept, kept, strict=True), 1):
        if item.compared is not None:
            shares[place], spreads[place] = mean_of_both(parts[place], item.compared, item.sweep, keep)
    return np.concatenate(shares), np.concatenate(spreads) if compared else None


def mean_of_both(
    part: TrialColumns, compared: ComparedChunk, sweep: SweepRow, keep: Bools
) -> tuple[Floats, Floats]:
    """The mean of what two engines say of attempts, and half of what they differ by; the first alone says it
    where the other broke off.
    """
    code = np.frombuffer(compared.outcomes, dtype=np.uint8)[keep]
    other = sweep_plan.with_draws(replace(part, outcome=code), sweep, compared.successes, keep).share
    other = np.where(code == NO_ATTEMPT, part.share, other)
    mean, half = 0.5 * (part.share + other), 0.5 * np.abs(part.share - other)
    share = np.round(mean * _COMPARED_SHARES) / _COMPARED_SHARES
    # Rounded up: what either says lies within, whatever was rounded.
    spread = np.ceil((half + np.abs(share - mean)) * _COMPARED_SHARES - 1e-6) / _COMPARED_SHARES
    return share, spread


def _drop_repeated(swept: list[Swept], indices: list[Ints | None], kept: list[Bools]) -> None:
    """Two sweeps of one grid share poses, which count once: of those that were compared with another engine's
    the first one stored, else of all.
    """
    together: dict[str, list[int]] = {}
    for place, item in enumerate(swept):
        if item.poses is None:
            together.setdefault(item.sweep.snapshot["repeat_key"], []).append(place)
    for places in together.values():
        # Chunks of one sweep share nothing.
        if len({swept[place].sweep.id for place in places}) < 2:
            continue
        places.sort(key=lambda place: swept[place].compared is None)
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


def _keys(stored: Stored, parts: list[TrialColumns], grids: dict[str, PoseGrid]) -> tuple[Ints, Ints] | None:
    of_grids = [part for part, item in zip(parts[1:], stored.swept, strict=True) if item.poses is None]
    keys = {stored.repeat_keys[sweep] for sweep in grids}
    if len(keys) != 1 or sum(map(len, of_grids)) < sum(map(len, parts)):
        return None
    index = np.concatenate([part.pose_index for part in of_grids])
    position, rotation = np.divmod(index, next(iter(grids.values())).rotation_count)
    return rotation, position
