"""How likely a grasp is to succeed: models of all attempts, kept and extended like the densities.

Every attempt counts, packed ones of sweeps included; ``simulation_error`` is none, and every other outcome
but ``success`` is a failure. Where the geometry is known, a pose at which the open gripper collides has the
probability 0 and attempts that collided tell nothing of the others; where it is not, they are failures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from graspdb.wire.queries import TrialSelection
from graspdb_density import DiagonalKernel, IsotropicKernel, SuccessEstimate, SuccessModel
from graspdb_density.se3 import Poses
from graspdb_density.success.kernel_regression import SuccessKernel
from graspdb_service.storage.database import Database, Tx
from graspdb_service.trial_columns import Bools
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.trials import attempts
from graspdb_service.usecases.trials.attempts import AllTrials, Stored
from graspdb_service.usecases.trials.selection import Selected, as_of

LEVEL = 0.9
#: Attempts of the random sample that searches feel their way by where a model has far more of them.
_SAMPLE, _LARGE = 100_000, 400_000


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


_NONE = _Attempts(0, 0, 0, frozenset(), {}, None, None)


@dataclass(frozen=True, eq=False)
class Model:
    """All attempts, and the ones to search by: a random sample where all would take too long."""

    whole: SuccessModel
    quick: SuccessModel


@dataclass(frozen=True)
class _Key:
    object_id: int
    filters: TrialSelection
    sigma_position_m: float
    sigma_rotation_deg: float
    collisions_known: bool
    success_kernel: DiagonalKernel | None


class Successes:
    """The success models of one service process; as fresh and as bounded as the densities."""

    def __init__(self, database: Database, compute: Compute, max_bytes: int) -> None:
        self._database = database
        self._compute = compute
        self.kept: SingleFlightCache[_Key, _Attempts] = SingleFlightCache(max_bytes, lambda a: a.nbytes)

    def model(self, built: Built, *, collisions_known: bool) -> Model | None:
        """The model of all attempts under the kernel of a density, at least as new; None before any attempt.

        With ``collisions_known``, by geometry and gripper, attempts that collided are left out.
        """
        key = _Key(
            built.selected.row.id,
            built.selected.filters,
            built.kernel.sigma_position_m,
            built.kernel.sigma_rotation_deg,
            collisions_known,
            built.success_kernel,
        )
        found = self.kept.get(
            key,
            lambda a: a.revision >= built.revision,
            lambda before: self._refresh(key, built.selected, before),
        )
        if found.model is None or not found.model.size:
            return None
        return Model(found.model, found.sample or found.model)

    def estimate(self, model: Model | None, poses: Poses, free: Bools | None) -> SuccessEstimate:
        """Success probability of poses (n,) under a model from :meth:`model`, NaN where nothing is known.

        ``free`` (n,) tells whether the open gripper is free of the object there; None where geometry or
        gripper is unknown.
        """
        nothing = np.full((3, len(poses)), np.nan)
        found = SuccessEstimate(nothing[0], nothing[1], nothing[2], np.zeros(len(poses)), LEVEL)
        if model is not None:
            work = partial(model.whole.evaluate, level=LEVEL, threads=self._compute.threads)
            parts = self._compute.blocks(poses, work)
            found = SuccessEstimate(
                np.concatenate([part.probability for part in parts]),
                np.concatenate([part.low for part in parts]),
                np.concatenate([part.high for part in parts]),
                np.concatenate([part.effective_trials for part in parts]),
                LEVEL,
            )
        if free is not None:
            for column in (found.probability, found.low, found.high):
                column[~free] = 0.0
        return found

    def _refresh(self, key: _Key, selected: Selected, before: _Attempts | None) -> _Attempts:
        without = [attempts.NO_ATTEMPT, *([attempts.COLLISION] if key.collisions_known else [])]
        with self._database.read() as tx:
            selected = as_of(tx, selected)
            row = selected.row
            # A source whose first failure has come counts from now on with all it has posted.
            if before is None or before.epoch != row.epoch or before.tried != selected.tried:
                before = _NONE
            stored = _fetch(tx, selected, without, before)
            names = {**before.sweeps, **stored.repeat_keys}
            if before.sweeps and len(set(names.values())) < len(names):
                # Two sweeps of one grid share poses, which count once: looked at together.
                before = _NONE
                stored = _fetch(tx, selected, without, before)
        isotropic = IsotropicKernel(key.sigma_position_m, math.radians(key.sigma_rotation_deg))
        kernel = key.success_kernel or isotropic
        old, sample = before.model, before.sample
        new = self._compute.run(lambda: attempts.joined(stored))
        size = len(new) + (0 if old is None else old.size)
        if old is not None and sample is None and size > _LARGE:
            # It has outgrown being searched itself: a sample needs what came before, too.
            return self._refresh(key, selected, None)
        every = np.ones(len(new), dtype=np.bool_)
        model = self._compute.run(lambda: _extended(old, new, every, kernel))
        if size > _LARGE:
            share = _SAMPLE / size if old is None or sample is None else sample.size / old.size
            chosen = np.random.default_rng(row.revision).random(len(new)) < share
            sample = self._compute.run(lambda: _extended(sample, new, chosen, kernel))
        return _Attempts(row.revision, row.epoch, row.last_seq, selected.tried, names, model, sample)


def _fetch(tx: Tx, selected: Selected, without: Sequence[int], before: _Attempts) -> Stored:
    since = {"after_seq": before.last_seq, "after_revision": before.revision}
    return attempts.fetch(tx, selected, without=without, **since)


def _extended(
    old: SuccessModel | None, new: AllTrials, rows: Bools, kernel: SuccessKernel
) -> SuccessModel | None:
    """A model with some attempts more."""
    if not rows.any():
        return old
    if old is None:
        return new.success_model(kernel, rows)
    return old.extend(new.poses[rows], new.success[rows], symmetric=new.symmetric[rows])
