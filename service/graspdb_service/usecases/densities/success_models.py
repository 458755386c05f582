"""How likely a grasp is to succeed: models of all attempts, kept and extended like the densities.

Every attempt counts, packed ones of sweeps included; ``simulation_error`` is none, and every other outcome
but ``success`` is a failure; what was tried several times is one attempt that succeeded by its share, and so
is what two linked sweeps have simulated, whose disagreement widens the intervals. Where the geometry is
known, a pose at which the open gripper collides has the probability 0 and attempts that collided tell nothing
of the others; where it is not, they are failures.

A probability is told only as far from the attempts as the model's own validated reach
(:mod:`graspdb_density.success.reach`); it is validated with the model, and held with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import EstimatorInfo
from graspdb.wire.queries import TrialSelection
from graspdb_density import (
    DiagonalKernel,
    IsotropicKernel,
    NearestAttempts,
    Reach,
    SuccessEstimate,
    SuccessModel,
    validate_reach,
)
from graspdb_density.se3 import Poses
from graspdb_density.success.kernel_regression import SuccessKernel
from graspdb_estimators import Stack
from graspdb_service.storage.database import Database, Tx
from graspdb_service.storage.simulation import linked
from graspdb_service.trial_columns import Bools, Floats, Ints
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.learned.learning import Learning, Lookup, Model
from graspdb_service.usecases.densities.untried import UntriedChance
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.trials import attempts
from graspdb_service.usecases.trials.attempts import AllTrials, Stored
from graspdb_service.usecases.trials.selection import Selected, as_of

LEVEL = 0.9
#: Attempts of the random sample that searches feel their way by where a model has far more of them.
_SAMPLE, _LARGE = 100_000, 400_000
#: How often a model is looked for again where attempts choose another kernel meanwhile.
_TRIES = 3
#: A reach is validated anew once so large a share of the attempts are others; of few ones, every time.
_CHANGED, _FEW = 0.25, 2_000


@dataclass(frozen=True, eq=False)
class Estimates:
    """Columns (n,); NaN where nothing is known.

    ``enough``: the nearest attempt is within the reach of the predictions, or the open gripper collides,
    which needs no attempt. Elsewhere the probability and its interval are NaN; ``prior`` is what geometry
    alone tells there, where it was asked.
    """

    probability: Floats
    low: Floats
    high: Floats
    effective_trials: Floats
    nearest: NearestAttempts
    enough: Bools
    prior: Floats

    @classmethod
    def unknown(cls, count: int) -> Estimates:
        """Before any attempt."""
        probability, low, high, prior, *distances = (np.full(count, np.nan) for _ in range(8))
        nearest = NearestAttempts(*distances)
        enough = np.zeros(count, dtype=np.bool_)
        return cls(probability, low, high, np.zeros(count), nearest, enough, prior)

    def put_support(self, rows: Ints, trials: Floats, nearest: NearestAttempts, reach: Reach) -> None:
        """Fill in how far some of the poses are from the attempts of a model."""
        self.effective_trials[rows] = trials
        self.enough[rows] = reach.covers(nearest)
        for name in ("position_m", "rotation", "position_widths", "rotation_widths"):
            getattr(self.nearest, name)[rows] = getattr(nearest, name)

    def put(self, rows: Ints, answer: SuccessEstimate, nearest: NearestAttempts, reach: Reach) -> None:
        """Fill in what a model answers for some of the poses."""
        self.put_support(rows, answer.effective_trials, nearest, reach)
        enough = self.enough[rows]
        for column, values in zip(self._chances, (answer.probability, answer.low, answer.high), strict=True):
            column[rows] = np.where(enough, values, np.nan)

    def without_collisions(self, free: Bools) -> None:
        """No chance where the open gripper collides."""
        for column in self._chances:
            column[~free] = 0.0
        self.enough[~free] = True

    @property
    def _chances(self) -> tuple[Floats, Floats, Floats]:
        return self.probability, self.low, self.high


@dataclass(frozen=True, eq=False)
class _Members:
    """Which attempts there are: posted rows (N,) by sequence number, ascending, with their outcome codes, and
    how many are of each chunk of a sweep, by its sweep, number and whether it was compared with another
    engine's.
    """

    seq: Ints
    outcome: NDArray[np.uint8]
    chunks: Mapping[tuple[str, int, bool], int]

    @classmethod
    def of(cls, stored: Stored) -> _Members:
        chunks = {}
        for each in stored.swept:
            codes = np.frombuffer(each.chunk.outcomes, dtype=np.uint8)
            counted = len(codes) - int(np.isin(codes, stored.without).sum())
            chunks[each.chunk.sweep_id, each.chunk.number, each.compared is not None] = counted
        return cls(stored.rows.seq, stored.rows.outcome, chunks)

    @property
    def count(self) -> int:
        return len(self.seq) + sum(self.chunks.values())

    def followed_by(self, later: _Members) -> _Members:
        return _Members(
            np.concatenate([self.seq, later.seq]),
            np.concatenate([self.outcome, later.outcome]),
            {**self.chunks, **later.chunks},
        )

    def others(self, than: _Members) -> int:
        """How many attempts only one of both has, or has with another outcome."""
        _, mine, theirs = np.intersect1d(self.seq, than.seq, assume_unique=True, return_indices=True)
        alike = int((self.outcome[mine] == than.outcome[theirs]).sum())
        chunks = dict(self.chunks.items() ^ than.chunks.items())
        return len(self.seq) + len(than.seq) - 2 * alike + sum(chunks.values())

    @property
    def nbytes(self) -> int:
        return self.seq.nbytes + self.outcome.nbytes + 200 * len(self.chunks)


@dataclass(frozen=True, eq=False)
class _Attempts:
    """A model as of a revision, and the repeat key of every sweep in it; ``sample`` of a large one. Its
    ``reach`` was validated when the attempts were ``judged``; so many are ``others`` now.
    """

    selected: Selected | None
    revision: int
    epoch: int
    last_seq: int
    tried: frozenset[int]
    sweeps: Mapping[str, str]
    model: SuccessModel | None
    sample: SuccessModel | None
    members: _Members
    reach: Reach | None
    judged: _Members | None
    others: int

    @property
    def nbytes(self) -> int:
        parts = (self.model, self.sample, self.members, self.judged)
        return 4_096 + sum(part.nbytes for part in parts if part is not None)


_NOBODY = _Members(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.uint8), {})
_NONE = _Attempts(None, 0, 0, 0, frozenset(), {}, None, None, _NOBODY, None, None, 0)


@dataclass(frozen=True)
class _Key:
    selection: tuple[int, TrialSelection, int | None]
    sigma_position_m: float
    sigma_rotation_deg: float
    collisions_known: bool
    success_kernel: DiagonalKernel | None
    by_default: bool

    def under(self, own: DiagonalKernel | None) -> _Key:
        """The same under a kernel that the attempts chose; None: as asked for."""
        return self if own is None else replace(self, success_kernel=own)

    def lookup(self, selected: Selected) -> Lookup:
        """By what is known what was learned: the kernel in words, equal where kernels are, and for whichever
        widths the default rule chose, for what was learned under them is nearly right under the next ones,
        until it is learned again.
        """
        own, default = self.success_kernel, None
        if own is not None:
            axes = None if own.axes is None else np.asarray(own.axes).tolist()
            told = f"{own.sigmas!r} {axes}"
        elif self.by_default:
            told = "default"
            default = IsotropicKernel(self.sigma_position_m, math.radians(self.sigma_rotation_deg))
        else:
            told = f"{self.sigma_position_m!r} {self.sigma_rotation_deg!r}"
        return Lookup(selected, told, default, self.collisions_known)


def _key(built: Built, collisions_known: bool) -> _Key:
    return _Key(
        built.selected.key,
        built.kernel.sigma_position_m,
        built.kernel.sigma_rotation_deg,
        collisions_known,
        built.success_kernel,
        built.kernel.rule.startswith("default:"),
    )


class Successes:
    """The success models of one service process; as fresh and as bounded as the densities."""

    def __init__(self, database: Database, compute: Compute, learning: Learning, max_bytes: int) -> None:
        self._database = database
        self._compute = compute
        self.learning = learning
        self.kept: SingleFlightCache[_Key, _Attempts] = SingleFlightCache(max_bytes, lambda a: a.nbytes)

    def model(self, built: Built, *, collisions_known: bool) -> Model | None:
        """The model of all attempts under the kernel of a density, or the one that they chose themselves, at
        least as new; None before any attempt.

        With ``collisions_known``, by geometry and gripper, attempts that collided are left out.
        """
        asked = _key(built, collisions_known)
        plain = None
        for _ in range(_TRIES):
            own = self.learning.own_kernel(asked.lookup(built.selected))
            found = self._attempts(asked.under(own), built)
            if found.model is None or found.reach is None or found.selected is None:
                return None
            plain = Model(found.model, found.sample or found.model, found.reach, EstimatorInfo())
            improved = self.learning.improved(
                asked.lookup(found.selected), plain, lambda kernel: self._prepare(asked.under(kernel), built)
            )
            if improved is not None:
                return improved
        return plain

    def _attempts(self, key: _Key, built: Built) -> _Attempts:
        return self.kept.get(
            key,
            lambda a: a.revision >= built.revision,
            lambda before: self._refresh(key, built.selected, before),
        )

    def _prepare(self, key: _Key, built: Built) -> None:
        """Sort the attempts for a kernel before anybody asks for them under it."""
        self._attempts(key, built)

    def learned(
        self, built: Built, *, collisions_known: bool, within_s: float
    ) -> tuple[Stack | None, EstimatorInfo]:
        """What was learned of a density's attempts and answers in their place, waited for; None where nothing
        does, or it takes longer.
        """
        model = self.model(built, collisions_known=collisions_known)
        of = _key(built, collisions_known).lookup(built.selected)
        if model is not None and model.estimator.state == "fitting":
            self.learning.wait(of, within_s)
        return self.learning.held(of)

    def estimator(self, built: Built, *, collisions_known: bool) -> EstimatorInfo:
        """Who estimates success probabilities, without a look at any attempt."""
        return self.learning.estimator(_key(built, collisions_known).lookup(built.selected))

    def untried(self, selected: Selected, test: CollisionTest | None) -> UntriedChance | None:
        """How likely grasps succeed where no attempt is near; None without a collision test to believe."""
        if test is None:
            return None
        return UntriedChance(self._compute, test, self.learning.untried(selected))

    def estimate(self, model: Model | None, poses: Poses, free: Bools | None) -> Estimates:
        """Success probability of poses (n,) under a model from :meth:`model`.

        ``free`` (n,) tells whether the open gripper is free of the object there; None where geometry or
        gripper is unknown.
        """
        estimates = Estimates.unknown(len(poses))
        rows = np.arange(len(poses)) if free is None else np.flatnonzero(free)
        if model is not None:
            work = partial(model.whole.evaluate_near, level=LEVEL, threads=self._compute.threads)
            start = 0
            for answer, nearest in self._compute.blocks(poses[rows], work):
                stop = start + len(answer.probability)
                estimates.put(rows[start:stop], answer, nearest, model.reach)
                start = stop
        if free is not None:
            if model is not None:
                self._put_support(estimates, model, poses, np.flatnonzero(~free))
            estimates.without_collisions(free)
        return estimates

    def support(self, model: Model, poses: Poses) -> Estimates:
        """As :meth:`estimate`, how far poses are from the attempts alone."""
        estimates = Estimates.unknown(len(poses))
        self._put_support(estimates, model, poses, np.arange(len(poses)))
        return estimates

    def _put_support(self, estimates: Estimates, model: Model, poses: Poses, rows: Ints) -> None:
        """Fill in how far some poses are from the attempts."""
        work = partial(model.whole.support, threads=self._compute.threads)
        start = 0
        for trials, nearest in self._compute.blocks(poses[rows], work):
            stop = start + len(trials)
            estimates.put_support(rows[start:stop], trials, nearest, model.reach)
            start = stop

    def _refresh(
        self, key: _Key, selected: Selected, known: _Attempts | None, *, anew: bool = False
    ) -> _Attempts:
        """What there is now, beside what was ``known``: an extension of it, unless the past has changed."""
        known = known or _NONE
        before = _NONE if anew else known
        without = [attempts.NO_ATTEMPT, *([attempts.COLLISION] if key.collisions_known else [])]
        with self._database.read() as tx:
            selected = as_of(tx, selected)
            row = selected.row
            # A source whose first failure has come counts from now on with all it has posted.
            if before.epoch != row.epoch or before.tried != selected.tried:
                before = _NONE
            # Another engine may have spoken of attempts that are in the model.
            if before.sweeps and linked.came_later(tx, row.id, after_revision=before.revision):
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
            return self._refresh(key, selected, known, anew=True)
        every = np.ones(len(new), dtype=np.bool_)
        model = self._compute.run(lambda: _extended(old, new, every, kernel))
        if size > _LARGE:
            share = _SAMPLE / size if old is None or sample is None else sample.size / old.size
            chosen = np.random.default_rng(row.revision).random(len(new)) < share
            sample = self._compute.run(lambda: _extended(sample, new, chosen, kernel))
        came = _Members.of(stored)
        members = before.members.followed_by(came)
        reach, judged, others = known.reach, known.judged, known.others + came.count
        if before is _NONE and judged is not None:
            others = members.others(judged)
        if model is None:
            reach = None
        elif reach is None or (others and (model.size <= _FEW or others >= _CHANGED * reach.attempts)):
            reach = self._compute.run(lambda: validate_reach(model, threads=self._compute.threads))
            judged, others = members, 0
        return _Attempts(
            selected=selected,
            revision=row.revision,
            epoch=row.epoch,
            last_seq=row.last_seq,
            tried=selected.tried,
            sweeps=names,
            model=model,
            sample=sample,
            members=members,
            reach=reach,
            judged=judged,
            others=others,
        )


def _fetch(tx: Tx, selected: Selected, without: Sequence[int], before: _Attempts) -> Stored:
    return attempts.fetch(
        tx, selected, without=without, after_seq=before.last_seq, after_revision=before.revision
    )


def _extended(
    old: SuccessModel | None, new: AllTrials, rows: Bools, kernel: SuccessKernel
) -> SuccessModel | None:
    """A model with some attempts more."""
    if not rows.any():
        return old
    return new.success_model(kernel, rows) if old is None else new.added_to(old, rows)
