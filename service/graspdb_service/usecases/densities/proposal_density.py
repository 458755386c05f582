"""How densely grids have tried poses: what undoes the choice where several sweeps overlap (eq 1).

A grid proposes uniformly from its region. Of several grids a success has the weight ``1 / sum n_k g_k(x)``,
with n_k the distinct poses tried and g_k the grid's density there: where two overlap, poses were tried twice
as densely, and each success counts half. Sweeps of one lattice (the same poses, simulated alike) count each
pose once however many of them hold it, so they are one strategy: at a position it has tried the share
``1 - prod (1 - f)`` of the poses, f being the done share of every plan that reaches there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from graspdb.wire import GridPlan
from graspdb_density import HAAR_VOLUME
from graspdb_density.kde.importance_weights import pooled_density
from graspdb_service.storage.database import Tx
from graspdb_service.storage.simulation import outcomes
from graspdb_service.storage.simulation.outcomes import TriedGrid
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.trials import sweep_plan
from graspdb_service.usecases.trials.selection import Selected

Corner = tuple[float, float, float]

#: A trial this share of a step from the face of a region lies on it: half of its surroundings are inside.
_ON_FACE = 1e-6


@dataclass(frozen=True)
class _Plan:
    """The done share of the plans that reach over one box of positions in one order."""

    lower: Corner
    upper: Corner
    share: float


@dataclass(frozen=True)
class _Lattice:
    """Grids in which a pose is one and the same simulation.

    ``density`` is that of all of its poses, 1/(m^3 rad^3); ``tried`` how many of them were tried.
    """

    density: float
    step_m: float
    tried: int
    plans: tuple[_Plan, ...]

    def proposal(self, positions: Floats) -> Floats:
        """(n,) 1/(m^3 rad^3), integrating to 1 over all that was tried."""
        left = np.ones(len(positions))
        for plan in self.plans:
            left *= 1.0 - plan.share * _inside(positions, plan, self.step_m)
        return np.asarray(self.density * (1.0 - left) / self.tried, dtype=np.float64)


@dataclass(frozen=True)
class Exposure:
    """The grids of a selection, as far as they are done; equal where they weigh alike.

    ``batches`` are internal ids of those that they write; ``tried`` counts distinct poses, collided ones,
    too.
    """

    lattices: tuple[_Lattice, ...] = ()
    batches: frozenset[int] = frozenset()

    @property
    def tried(self) -> int:
        return sum(lattice.tried for lattice in self.lattices)

    @property
    def several(self) -> bool:
        """Whether the density differs from place to place."""
        boxes = {(plan.lower, plan.upper) for lattice in self.lattices for plan in lattice.plans}
        return len(boxes) > 1

    @property
    def uniform(self) -> float:
        """The density where it is the same everywhere."""
        plan = self.lattices[0].plans[0]
        centre = 0.5 * (np.array([plan.lower]) + np.array([plan.upper]))
        return float(self.density(centre)[0])

    def per_volume(self, positions: Floats) -> Floats:
        """How many poses the grids tried per m^3 rad^3 at positions (n, 3): 0 where none did."""
        return self.tried * self.density(positions) if self.lattices else np.zeros(len(positions))

    def density(self, positions: Floats) -> Floats:
        """What trials (n, 3) of these grids were drawn with, all grids seen as one: 1/(m^3 rad^3)."""
        columns = np.stack([lattice.proposal(positions) for lattice in self.lattices], axis=1)
        return pooled_density(columns, [lattice.tried for lattice in self.lattices])


def read(tx: Tx, selected: Selected) -> Exposure:
    """The exposure of a selection as the transaction sees it."""
    grids = outcomes.tried_grids(tx, selected.row.id, provenance_ids=selected.provenances)
    lattices: dict[str, dict[tuple[object, ...], list[TriedGrid]]] = {}
    for grid in grids:
        same = (grid.grid["region"] and str(grid.grid["region"]), _order(grid))
        lattices.setdefault(grid.repeat_key, {}).setdefault(same, []).append(grid)
    # A sweep alone on its lattice has tried what it stored; those that share one have repeated each other.
    keys = [grid.repeat_key for grid in grids]
    shared = [grid.sweep_id for grid in grids if keys.count(grid.repeat_key) > 1]
    ranges = outcomes.done_ranges(tx, shared) if shared else {}
    found = (_lattice(alike.values(), ranges) for alike in lattices.values())
    return Exposure(
        tuple(lattice for lattice in found if lattice is not None), frozenset(g.batch_id for g in grids)
    )


def _order(grid: TriedGrid) -> int | None:
    """Equal for plans of one box that take its poses in one order: the seed, None where it is the index."""
    seed: int = grid.grid["seed"]
    return None if grid.grid["max_poses"] is None else seed


def _lattice(
    alike: Iterable[list[TriedGrid]], ranges: Mapping[str, list[tuple[int, int]]]
) -> _Lattice | None:
    parts: list[_Plan] = []
    tried = 0
    density = step = 0.0
    for grids in alike:
        plan = GridPlan.model_validate({**grids[0].grid, "max_poses": None})
        box = _box(plan.model_dump_json())
        density, step = box.density, plan.position_step_m
        places = grids[0].kept
        if grids[0].sweep_id in ranges:
            # Plans of one order share places.
            places = _union([part for grid in grids for part in ranges[grid.sweep_id]])
        parts.append(_Plan(box.lower, box.upper, places / box.count))
        tried += sum(grid.kept for grid in grids)
    return _Lattice(density, step, tried, tuple(parts)) if tried else None


@dataclass(frozen=True)
class _Box:
    lower: Corner
    upper: Corner
    count: int
    density: float


@lru_cache(maxsize=256)
def _box(plan: str) -> _Box:
    """The cubes of one step about a grid's positions, and its poses without ``max_poses``."""
    grid = sweep_plan.pose_grid(GridPlan.model_validate_json(plan))
    ends = np.array([grid.pose_indices(0, 1)[0], grid.pose_indices(grid.total - 1, grid.total)[0]])
    corners, _ = grid.poses(ends)
    half = 0.5 * grid.position_step_m
    return _Box(
        tuple((corners[0] - half).tolist()),
        tuple((corners[1] + half).tolist()),
        grid.total,
        grid.total / (HAAR_VOLUME * grid.volume_m3),
    )


def _union(ranges: list[tuple[int, int]]) -> int:
    """Places that at least one of the ranges holds."""
    total = reached = 0
    for start, stop in sorted(ranges):
        total += max(0, stop - max(start, reached))
        reached = max(reached, stop)
    return total


def _inside(positions: Floats, plan: _Plan, step_m: float) -> Floats:
    """1 inside the box, 0 outside, and between on its faces, for a trial stands for what surrounds it."""
    depth = np.minimum(positions - np.array(plan.lower), np.array(plan.upper) - positions) / step_m
    share = 0.5 + 0.25 * (np.sign(depth + _ON_FACE) + np.sign(depth - _ON_FACE))
    return np.asarray(np.prod(share, axis=1), dtype=np.float64)
