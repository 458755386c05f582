"""A sweep's plan: which poses it simulates, in which order, and which of them are stored already.

A grid is never stored: its poses follow from the snapshot. Poses that were given or drawn are, as float64.
A pose of a plan has a *place* (0 to the number of poses), by which chunks are cut, and a *pose index*, which
results name: for a grid the index in the full grid, otherwise the place itself.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from graspdb.wire import GridPlan
from graspdb.wire.sweeps import stated_accelerations
from graspdb_density import HAAR_VOLUME
from graspdb_geometry.grids import PoseGrid
from graspdb_service.storage.database import Tx
from graspdb_service.storage.simulation import sweeps
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.trial_columns import Bools, Ints, TrialColumns

_MADE_ANEW = {"lift": 3}
"""Protocols whose simulation became another one, and its number: what an earlier one said of a pose
is no repeat of what this one says."""


def grid_of(sweep: SweepRow) -> PoseGrid:
    """The grid of a sweep that has one."""
    return pose_grid(GridPlan.model_validate(sweep.snapshot["grid"]))


def pose_grid(plan: GridPlan) -> PoseGrid:
    """The grid as the worker makes it from the same plan; ValueError names the field that is out of range."""
    return PoseGrid(**{name: getattr(plan, name) for name in GridPlan.model_fields})


def repeat_key(
    world: dict[str, Any],
    protocol: str,
    fidelity: str,
    grid: GridPlan,
    engine: str | None,
    randomise: dict[str, Any] | None,
) -> str:
    """Equal for sweeps in which one pose index means one and the same simulation.

    ``region``, ``max_poses`` and ``seed`` choose among the indices of a grid and change none of them.
    """
    lattice = grid.model_dump(exclude={"region", "max_poses", "seed"})
    document: dict[str, Any] = {
        "world": world,
        "protocol": protocol,
        "fidelity": fidelity,
        "grid": lattice,
    }
    if engine is not None:
        document["engine"] = engine
    if randomise is not None:
        document["randomise"] = randomise
    if protocol in _MADE_ANEW:
        document["simulation"] = _MADE_ANEW[protocol]
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def capability_of(protocol: str, drawn: bool) -> str:
    """What a worker must be able to do for a sweep by this protocol, ``drawn``: under what is drawn."""
    if stated_accelerations(protocol) is not None:
        return "stated-shake"
    if drawn:
        return f"drawn-{protocol}"
    return "simulate" if protocol == "wrench" else protocol


def draws(sweep: SweepRow) -> int:
    """How often each pose of a sweep is simulated."""
    return int((sweep.request.get("randomise") or {}).get("draws", 1))


def with_draws(
    poses: TrialColumns, sweep: SweepRow, successes: bytes | None, kept: Bools | Ints | slice
) -> TrialColumns:
    """Poses (those ``kept`` of a chunk) with how often each was simulated and succeeded; as they are, where
    each was once.
    """
    if successes is None:
        return poses
    won = np.frombuffer(successes, dtype=np.uint8)[kept].astype(np.float64)
    return replace(poses, attempts=np.full(len(won), float(draws(sweep))), successes=won)


def chunk_poses(tx: Tx, sweep: SweepRow, start: int, stop: int) -> TrialColumns | None:
    """The stored poses of a chunk, in the order of its outcomes, with what each was drawn with; None for a
    grid, whose poses :func:`grid_poses` computes.
    """
    if sweep.plan == "grid":
        return None
    stored = sweeps.poses(tx, sweep.id, start, stop)
    return TrialColumns(
        stored[:, :3],
        stored[:, 3:7],
        proposal_density=stored[:, 7],
        pose_index=np.arange(start, stop, dtype=np.int64),
    )


def grid_poses(grid: PoseGrid, index: Ints) -> TrialColumns:
    """Poses of a grid, each drawn uniformly from the grid's volume times all rotations."""
    density = np.full(len(index), 1.0 / (HAAR_VOLUME * grid.volume_m3))
    return TrialColumns(*grid.poses(index), proposal_density=density, pose_index=index)


def not_stored_yet(
    grid: PoseGrid,
    start: int,
    stop: int,
    pose_index: Ints,
    others: Sequence[tuple[PoseGrid, Sequence[tuple[int, int]]]],
) -> Bools:
    """Which poses (stop - start,) of a chunk no other sweep of the same repeat key has: each counts once.

    ``pose_index`` is ``grid.pose_indices(start, stop)``; ``others`` are their grids and
    the places of their finished chunks.
    """
    fresh = np.ones(len(pose_index), dtype=np.bool_)
    for other, ranges in others:
        in_order = other.max_poses is None
        # Two plans of one order share places, so that only the overlap has to be looked at.
        same_order = other.region == grid.region and (
            (in_order and grid.max_poses is None)
            or (not in_order and grid.max_poses is not None and other.seed == grid.seed)
        )
        for first, last in ranges:
            low, high = (max(first, start), min(last, stop)) if same_order else (first, last)
            if low >= high:
                continue
            if in_order and (
                other.pose_indices(low, low + 1)[0] > pose_index[-1]
                or other.pose_indices(high - 1, high)[0] < pose_index[0]
            ):
                continue
            fresh &= ~np.isin(pose_index, other.pose_indices(low, high), assume_unique=True)
    return fresh
