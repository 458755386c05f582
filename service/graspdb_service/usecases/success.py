"""How likely a grasp is to succeed: models of all attempts, kept and extended like the densities.

Every attempt counts, packed ones of sweeps included; ``simulation_error`` is none, and every other outcome
but ``success`` is a failure. Where the geometry is known, a pose at which the open gripper collides has the
probability 0 and attempts that collided tell nothing of the others; where it is not, they are failures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES
from graspdb_density import IsotropicKernel, SuccessModel
from graspdb_service.storage import attempts, sweeps, trials
from graspdb_service.storage.attempts import PackedChunk
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.sweeps import SweepRow
from graspdb_service.usecases import plans
from graspdb_service.usecases.cache import SingleFlightCache
from graspdb_service.usecases.compute import Compute
from graspdb_service.usecases.densities import Built, require_object
from graspdb_service.usecases.plans import ChunkPoses
from graspdb_service.usecases.selection import Filters, Selected, resolve

Floats = NDArray[np.float64]

LEVEL = 0.9
#: Attempts of the random sample that searches feel their way by where a model has far more of them.
_SAMPLE, _LARGE = 100_000, 400_000
_SUCCESS, _COLLISION = OUTCOME_CODES["success"], OUTCOME_CODES["collision"]
_NO_ATTEMPT = OUTCOME_CODES["simulation_error"]


@dataclass(frozen=True, eq=False)
class Estimates:
    """Columns (n,); NaN where nothing is known."""

    probability: Floats
    low: Floats
    high: Floats
    effective_trials: Floats

    @classmethod
    def unknown(cls, count: int) -> Estimates:
        """Before any attempt."""
        nothing = np.full(count, np.nan)
        return cls(nothing, nothing.copy(), nothing.copy(), np.zeros(count))


@dataclass(frozen=True, eq=False)
class _Attempts:
    """A model as of a revision, and the repeat key of every sweep in it; ``sample`` of a large one."""

    revision: int
    epoch: int
    last_seq: int
    tried: frozenset[int]
    sweeps: Mapping[str, str]
    model: SuccessModel | None
    sample: SuccessModel | None

    @property
    def nbytes(self) -> int:
        return 4_096 + sum(part.nbytes for part in (self.model, self.sample) if part is not None)


@dataclass(frozen=True, eq=False)
class Model:
    """All attempts, and the ones to search by: a random sample where all would take too long."""

    whole: SuccessModel
    quick: SuccessModel


@dataclass(frozen=True)
class _Key:
    object_id: int
    filters: Filters
    sigma_position_m: float
    sigma_rotation_deg: float
    collisions_known: bool


@dataclass(frozen=True, eq=False)
class _Swept:
    """A chunk with what tells its poses."""

    sweep: SweepRow
    chunk: PackedChunk
    poses: ChunkPoses | None


class Successes:
    """The success models of one service process; as fresh and as bounded as the densities."""

    def __init__(self, database: Database, compute: Compute, max_bytes: int) -> None:
        self._database = database
        self._compute = compute
        self._cache: SingleFlightCache[_Key, _Attempts] = SingleFlightCache(max_bytes, lambda a: a.nbytes)

    def model(self, slug: str, built: Built, *, collisions_known: bool) -> Model | None:
        """The model of all attempts under the kernel of a density, at least as new; None before any attempt.

        Parameters
        ----------
        collisions_known
            Whether geometry and gripper are known: then attempts that collided are left out.
        """
        key = _Key(
            built.object_row.id,
            built.selected.filters,
            built.kernel.sigma_position_m,
            built.kernel.sigma_rotation_deg,
            collisions_known,
        )
        found = self._cache.get(
            key, lambda a: a.revision >= built.revision, lambda before: self._refresh(key, slug, before)
        )
        if found.model is None or not found.model.size:
            return None
        return Model(found.model, found.sample or found.model)

    def estimate(
        self, slug: str, built: Built, positions: Floats, quaternions: Floats, free: NDArray[np.bool_] | None
    ) -> Estimates:
        """Success probability of poses (n, 3), (n, 4) under the kernel of a density.

        Parameters
        ----------
        free : (n,) bool or None
            Whether the open gripper is free of the object there; None where geometry or gripper is unknown.
        """
        model = self.model(slug, built, collisions_known=free is not None)
        return self.under(model, positions, quaternions, free)

    def under(
        self,
        model: Model | None,
        positions: Floats,
        quaternions: Floats,
        free: NDArray[np.bool_] | None,
    ) -> Estimates:
        """As :meth:`estimate`, under a model from :meth:`model`."""
        estimates = Estimates.unknown(len(positions))
        if model is not None:

            def work(part: slice) -> None:
                answer = model.whole.evaluate(
                    positions[part], quaternions[part], level=LEVEL, threads=self._compute.threads
                )
                estimates.probability[part] = answer.probability
                estimates.low[part], estimates.high[part] = answer.low, answer.high
                estimates.effective_trials[part] = answer.effective_trials

            self._compute.blocks(len(positions), 16_384, work)
        if free is not None:
            for column in (estimates.probability, estimates.low, estimates.high):
                column[~free] = 0.0
        return estimates

    def _refresh(self, key: _Key, slug: str, before: _Attempts | None) -> _Attempts:
        without = [_NO_ATTEMPT, *([_COLLISION] if key.collisions_known else [])]
        with self._database.read() as tx:
            row = require_object(tx, slug, key.object_id)
            selected = resolve(tx, row.id, key.filters)
            # A source whose first failure has come counts from now on with all it has posted.
            if before is not None and (before.epoch != row.epoch or before.tried != selected.tried):
                before = None
            swept = _read_swept(tx, row.id, selected, before)
            names = _repeat_keys(swept, before)
            if before is not None and len(set(names.values())) < len(names):
                # Two sweeps of one grid share poses, which count once: looked at together.
                before = None
                swept = _read_swept(tx, row.id, selected, None)
            rows = trials.read(
                tx,
                row.id,
                provenance_ids=sorted(selected.tried),
                successes_only=False,
                after_seq=0 if before is None else before.last_seq,
                swept=False,
                without=without,
            )
        kernel = IsotropicKernel(key.sigma_position_m, math.radians(key.sigma_rotation_deg))
        old, sample = (None, None) if before is None else (before.model, before.sample)
        new = self._compute.run(lambda: _joined(rows, swept, selected, without))
        size = len(new.success) + (0 if old is None else old.size)
        if old is not None and sample is None and size > _LARGE:
            # It has outgrown being searched itself: a sample needs what came before, too.
            return self._refresh(key, slug, None)
        model = self._compute.run(lambda: _extended(old, new, kernel))
        if size > _LARGE:
            share = _SAMPLE / size if old is None or sample is None else sample.size / old.size
            chosen = np.random.default_rng(row.revision).random(len(new.success)) < share
            sample = self._compute.run(lambda: _extended(sample, new.take(chosen), kernel))
        return _Attempts(row.revision, row.epoch, row.last_seq, selected.tried, names, model, sample)


def _extended(old: SuccessModel | None, new: _Columns, kernel: IsotropicKernel) -> SuccessModel | None:
    if not len(new.success):
        return old
    columns = new.position, new.quaternion, new.success
    if old is not None:
        return old.extend(*columns, symmetric=new.symmetric)
    return SuccessModel.build(*columns, kernel=kernel, symmetric=new.symmetric)


def _read_swept(tx: Tx, object_id: int, selected: Selected, before: _Attempts | None) -> list[_Swept]:
    """Chunks of sweeps since, with the poses of those that are no grid's."""
    chunks = attempts.packed_chunks(
        tx,
        object_id,
        provenance_ids=selected.tried,
        after_revision=0 if before is None else before.revision,
    )
    rows = sweeps.find_many(tx, sorted({chunk.sweep_id for chunk in chunks}))
    return [
        _Swept(
            rows[chunk.sweep_id],
            chunk,
            plans.chunk_poses(tx, rows[chunk.sweep_id], chunk.start, chunk.stop),
        )
        for chunk in chunks
    ]


def _repeat_keys(swept: list[_Swept], before: _Attempts | None) -> dict[str, str]:
    """What tells whether two sweeps are of one grid, by sweep."""
    found = {} if before is None else dict(before.sweeps)
    for item in swept:
        sweep = item.sweep
        found[sweep.id] = sweep.snapshot["repeat_key"] if sweep.plan == "grid" else sweep.id
    return found


@dataclass(frozen=True, eq=False)
class _Columns:
    """Attempts (n,): pose, whether it succeeded, whether its jaw is symmetric."""

    position: Floats
    quaternion: Floats
    success: NDArray[np.bool_]
    symmetric: NDArray[np.bool_]

    def take(self, chosen: NDArray[np.bool_]) -> _Columns:
        return _Columns(
            self.position[chosen], self.quaternion[chosen], self.success[chosen], self.symmetric[chosen]
        )


def _joined(rows: trials.Columns, swept: list[_Swept], selected: Selected, without: list[int]) -> _Columns:
    flags = np.array([selected.provenances[int(p)] for p in rows.provenance], dtype=bool)
    parts = [_Columns(rows.position, rows.quaternion_xyzw, rows.outcome == _SUCCESS, flags)]
    seen: dict[str, list[NDArray[np.int64]]] = {}
    for item in swept:
        sweep, chunk = item.sweep, item.chunk
        codes = np.frombuffer(chunk.outcomes, dtype=np.uint8)
        kept = ~np.isin(codes, without)
        if sweep.plan == "grid":
            grid = plans.grid_of(sweep)
            index = grid.pose_indices(chunk.start, chunk.stop)
            earlier = seen.setdefault(sweep.snapshot["repeat_key"], [])
            for known in earlier:
                kept &= ~np.isin(index, known)
            earlier.append(index[kept])
            position, quaternion = grid.poses(index[kept])
        else:
            assert item.poses is not None
            position, quaternion = item.poses.position[kept], item.poses.quaternion_xyzw[kept]
        symmetric = selected.provenances[sweep.provenance_id]
        parts.append(
            _Columns(position, quaternion, codes[kept] == _SUCCESS, np.full(len(position), symmetric))
        )
    return _Columns(
        np.concatenate([part.position for part in parts]),
        np.concatenate([part.quaternion for part in parts]),
        np.concatenate([part.success for part in parts]),
        np.concatenate([part.symmetric for part in parts]),
    )
