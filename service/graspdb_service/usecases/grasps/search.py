"""Engines that find the best grasps: where a density or a score is highest, or by ranking candidates."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from graspdb_density import Maximum, ModeSearch, Region, Separation, se3
from graspdb_density.se3 import Poses
from graspdb_density.search.lazy_search import DearTest
from graspdb_density.search.scored_poses import (
    Admissible,
    Pull,
    Score,
    distinct_from,
    ranked_by_density_where_flat,
)
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.runtime.compute import breathing

#: Poses shown to the collision test at a time while looking for the nearest admissible one.
_BLOCK = 1_024
#: Candidates that the rough score ranks first are scored by the score itself, at least so many.
_FEW = 32


@dataclass(frozen=True, eq=False)
class Bounds:
    """What grasps must keep, how many there may be, and from which separation on two are distinct; ``dear``
    is what they must pass, too, and costs more than all else.
    """

    region: Region
    admissible: Admissible | None
    count: int
    separation: Separation
    dear: DearTest | None = None

    def whoever_takes(self, count: int) -> Bounds:
        """The same for so many grasps, without the dear test."""
        return replace(self, dear=None, count=count)

    def allowed(self, poses: Poses) -> NDArray[np.intp]:
        """Rows of the poses that everything but the region admits."""
        if self.admissible is None or not len(poses):
            return np.arange(len(poses))
        return np.flatnonzero(self.admissible(poses))


class Engine(Protocol):
    """How a question is answered."""

    def best(self, bounds: Bounds) -> list[Maximum]:
        """The best grasps, best first."""

    def scored(self, poses: Poses) -> tuple[Floats, Floats]:
        """Log densities and scores (n,) of poses."""


@dataclass(frozen=True, eq=False)
class ScoreSearch:
    """Where a score is highest, from the density's centres; without one the density's own modes, that of
    successes or a prior. ``rough`` is nearly the score and much faster. Differences of scores below
    ``resolution`` mean nothing: there the density decides. So many of the best by ``rough`` as are
    ``rescored`` are ranked by the score. ``mean``: the search in the density that the score is, where it is
    one, for a density is climbed many times faster than values are searched. ``leading``: see
    `EvolutionSearch`. ``alike`` names ``rough``, as in `ModeSearch.maxima`.
    """

    search: ModeSearch
    threads: int
    score: Score | None = None
    rough: Score | None = None
    pull: Pull | None = None
    resolution: float = 0.0
    rescored: int = 0
    mean: ModeSearch | None = None
    leading: Score | None = None
    alike: Hashable = None

    def with_breath(self) -> ScoreSearch:
        """The same, which lets other questions between its steps."""
        if self.score is None:
            return self
        score = breathing(self.score, "scoring poses")
        rough = (
            score
            if self.rough is self.score or self.rough is None
            else breathing(self.rough, "scoring poses")
        )
        leading = None if self.leading is None else breathing(self.leading, "scoring poses")
        return replace(self, score=score, rough=rough, leading=leading)

    def best(self, bounds: Bounds) -> list[Maximum]:
        if self.mean is not None:
            return self._best_mean(bounds, self.mean)
        return self.search.maxima(
            bounds.region,
            count=bounds.count,
            separation=bounds.separation,
            admissible=bounds.admissible,
            score=self.score,
            rough=self.rough,
            pull=self.pull,
            resolution=self.resolution,
            rescored=self.rescored,
            dear=bounds.dear,
            leading=self.leading,
            alike=self.alike,
            threads=self.threads,
        )

    def _best_mean(self, bounds: Bounds, mean: ModeSearch) -> list[Maximum]:
        found = mean.maxima(
            bounds.region,
            count=bounds.count,
            separation=bounds.separation,
            admissible=bounds.admissible,
            dear=bounds.dear,
            threads=self.threads,
        )
        if not found:
            return []
        at = Poses(np.array([m.position for m in found]), np.array([m.quaternion_xyzw for m in found]))
        logs = self.search.density.log_density(at, threads=self.threads)
        return [
            replace(grasp, log_density=float(log), score=math.exp(grasp.log_density))
            for grasp, log in zip(found, logs, strict=True)
        ]

    def scored(self, poses: Poses) -> tuple[Floats, Floats]:
        logs = self.search.density.log_density(poses, threads=self.threads)
        return logs, logs if self.score is None else self.score(poses)

    def shortlist(self, poses: Poses, most: int) -> Poses:
        """Only those that may be among the best are worth the score itself."""
        most = max(most, self.rescored)
        if self.rough is None or self.rough is self.score or len(poses) <= most:
            return poses
        return poses[np.argsort(-self.rough(poses), kind="stable")[:most]]


@dataclass(frozen=True, eq=False)
class CandidateRanking:
    """The best of given poses by what another engine maximises; ``separated``: only distinct ones."""

    candidates: Poses
    by: ScoreSearch
    separated: bool

    def best(self, bounds: Bounds) -> list[Maximum]:
        region = bounds.region
        poses = self.candidates
        poses = poses[region.contains(*poses)]
        poses = poses[bounds.allowed(poses)]
        if not len(poses):
            return []
        if bounds.dear is None:
            # Whatever may be refused, the last candidate may be the first that passes.
            poses = self.by.shortlist(poses, max(bounds.count, _FEW))
        logs, scores = self.scored(poses)
        twins = bool(self.by.search.centres.symmetric.all())
        chosen: list[int] = []
        highest = float(logs.max()) if np.isfinite(logs).any() else 0.0
        ranks = ranked_by_density_where_flat(scores, logs, highest, self.by.resolution)
        for i in self._ordered(poses, ranks, bounds):
            if len(chosen) == bounds.count:
                break
            if bounds.dear is not None and not bounds.dear.passes(poses[i : i + 1])[0]:
                continue
            if self.separated and chosen:
                apart = distinct_from(poses[np.array(chosen)], bounds.separation, twins=twins)
                if not apart(poses[i : i + 1])[0]:
                    continue
            chosen.append(int(i))
        p, q = poses.positions, poses.quaternions_xyzw
        return [
            Maximum(p[i], se3.canonical(q[i]), float(logs[i]), region.active(p[i], q[i]), float(scores[i]))
            for i in chosen
        ]

    def _ordered(self, poses: Poses, ranks: Floats, bounds: Bounds) -> NDArray[np.intp]:
        """Rows of the poses, best first; of equally good ones the one that costs least."""
        cost = None if bounds.dear is None else bounds.dear.cost
        if cost is None or len(np.unique(ranks)) == len(ranks):
            return np.argsort(-ranks, kind="stable")
        tied = np.flatnonzero(np.isin(ranks, [rank for rank, n in Counter(ranks.tolist()).items() if n > 1]))
        costs = np.zeros(len(poses))
        costs[tied] = cost(poses[tied])
        return np.lexsort((costs, -ranks))

    def scored(self, poses: Poses) -> tuple[Floats, Floats]:
        return self.by.scored(poses)


def closest(engine: Engine, bounds: Bounds, poses: Poses, widths: Separation) -> list[Maximum]:
    """The pose that violates the region least, in ``widths`` of a kernel, and is otherwise admissible; or
    none."""
    p, q, _ = bounds.region.project(*poses)
    shift = np.sum((p - poses.positions) ** 2, axis=1) / widths.metres**2
    turn = se3.angle_between(q, poses.quaternions_xyzw) ** 2 / widths.radians**2
    order = np.argsort(shift + turn, kind="stable")
    for start in range(0, len(order), _BLOCK):
        block = poses[order[start : start + _BLOCK]]
        rows = bounds.allowed(block)
        if rows.size:
            pose = block[rows[:1]]
            (log,), (score,) = engine.scored(pose)
            turned = se3.canonical(pose.quaternions_xyzw[0])
            return [Maximum(pose.positions[0], turned, float(log), (), float(score))]
    return []
