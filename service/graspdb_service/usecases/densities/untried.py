"""How likely grasps succeed where no attempt at the object is near: by other objects, else by geometry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from graspdb.wire import PriorEstimator
from graspdb_density.se3 import Poses
from graspdb_service.trial_columns import Bools, Floats
from graspdb_service.usecases.densities.learned.learning import Model
from graspdb_service.usecases.densities.learned.transfers import Untried
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.runtime.compute import Compute

#: Attempts of either outcome by which geometry is judged.
_HELD = 256


@dataclass(frozen=True, eq=False)
class UntriedChance:
    """What tells of one object without its attempts: ``others`` where objects that were left out show that
    they predict better than edges do, who know only whether the jaw closes on anything.
    """

    compute: Compute
    test: CollisionTest
    others: Untried | None

    @property
    def by_others(self) -> bool:
        return self.others is not None and self.others.transfer.better_untried

    @property
    def info(self) -> PriorEstimator:
        """Who it is that tells."""
        if self.others is None or not self.by_others:
            return PriorEstimator(name="edges")
        transfer = self.others.transfer
        return PriorEstimator(
            name="transfer",
            objects=transfer.objects,
            attempts=transfer.stack.attempts,
            skill=round(transfer.untried.skills[0], 3),
        )

    def score(self, poses: Poses, threads: int) -> Floats:
        """What others tell of poses (n,): 0 where the gripper collides or the jaw closes on nothing."""
        assert self.others is not None
        values = np.zeros(len(poses))
        rows = np.flatnonzero(self.test.free(poses, threads=threads))
        if rows.size:
            rows = rows[self.test.holds(poses[rows], threads=threads)]
        if rows.size:
            others = self.others
            values[rows] = others.transfer.prior(others.shape, others.features, poses[rows], threads)
        return values

    def told(self, poses: Poses, far: Bools, free: Bools | None, model: Model | None) -> Floats:
        """How likely those of poses (n,) that are ``far`` from every attempt of a model succeed; NaN for the
        others. ``free`` (n,) tells where the open gripper collides with nothing; None: it is not known.
        """
        found = np.where(far, 0.0, np.nan)
        if free is None:
            return np.full(len(poses), np.nan)
        # What collides holds nothing: only the others are worth closing the jaw on.
        rows = np.flatnonzero(far & free)
        if not rows.size:
            return found
        threads = self.compute.threads
        held = np.concatenate(self.compute.blocks(poses[rows], partial(self.test.holds, threads=threads)))
        rows = rows[held]
        if not rows.size:
            return found
        if self.others is None or not self.by_others:
            found[rows] = self.compute.run(lambda: _share_of_held(model, self.test, threads))
            return found
        others = self.others
        work = partial(others.transfer.prior, others.shape, others.features, threads=threads)
        found[rows] = np.concatenate(self.compute.blocks(poses[rows], work))
        return found


def _share_of_held(model: Model | None, test: CollisionTest, threads: int) -> float:
    """The share of successes among attempts that hold something by geometry, with half a success in one more.

    Of a few hundred of either outcome, drawn at random, each weighing what it stands for.
    """
    if model is None:
        return 0.5
    held = [
        size * float(test.holds(poses, threads).mean()) if len(poses) else 0.0
        for size, poses in model.whole.drawn(_HELD, np.random.default_rng(0))
    ]
    return (held[0] + 0.5) / (sum(held) + 1.0)
