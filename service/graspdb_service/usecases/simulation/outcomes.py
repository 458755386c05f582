"""Outcomes: what became of every pose of a sweep."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from graspdb_density.se3 import Poses
from graspdb_service.problems import invalid
from graspdb_service.storage.database import Database
from graspdb_service.storage.simulation import outcomes as packed
from graspdb_service.storage.trials import provenances
from graspdb_service.trial_columns import TrialColumns
from graspdb_service.usecases.simulation.sweeps import require_sweep
from graspdb_service.usecases.trials import sweep_plan
from graspdb_service.usecases.trials.frames import AskedFrame, frames_of
from graspdb_service.usecases.trials.pose_frames import PoseFrame

#: Poses read at a time where all are asked for.
STREAM_POSES = 100_000

_CURSOR = re.compile(r"(\d{1,9})\.(\d{1,9})")


def frame_of_sweep(database: Database, sweep_id: str, asked: AskedFrame) -> PoseFrame:
    """The frame that is asked for, of the gripper that a sweep is simulated with."""
    with database.read() as tx:
        row = require_sweep(tx, sweep_id)
        names = provenances.of_object(tx, row.object_id)
        return frames_of(tx, names, [row.provenance_id], asked).get(row.provenance_id, PoseFrame())


def page(
    database: Database, sweep_id: str, frame: PoseFrame, *, limit: int, cursor: str | None
) -> tuple[TrialColumns, str | None]:
    """Poses of finished chunks with outcome and pose index, in the plan's order, of a frame of the sweep's
    gripper; where the next page starts.

    While a sweep runs, a page has the chunks that are finished by then: read it again at the end.
    """
    number, skip = 0, 0
    if cursor is not None:
        match = _CURSOR.fullmatch(cursor)
        if match is None:
            raise invalid("cursor", "take it from `next` of the page before")
        number, skip = int(match[1]), int(match[2])
    with database.read() as tx:
        row = require_sweep(tx, sweep_id)
        # One pose more than asked for tells whether there is another page.
        chunks = packed.page(tx, sweep_id, first_number=number, poses=limit + skip + 1)
        stored = {chunk.number: sweep_plan.chunk_poses(tx, row, chunk.start, chunk.stop) for chunk in chunks}
    grid = sweep_plan.grid_of(row) if row.plan == "grid" else None
    parts = [TrialColumns(np.empty((0, 3)), np.empty((0, 4)))]
    following = None
    for chunk in chunks:
        first = skip if chunk.number == number else 0
        last = min(chunk.stop - chunk.start, first + limit)
        if limit == 0:
            following = f"{chunk.number}.{first}"
            break
        if first >= last:
            continue
        poses = stored[chunk.number]
        if poses is None:
            assert grid is not None
            poses = sweep_plan.grid_poses(grid, grid.pose_indices(chunk.start, chunk.stop))
        outcome = np.frombuffer(chunk.outcomes, dtype=np.uint8)
        told = sweep_plan.with_draws(replace(poses, outcome=outcome), row, chunk.successes, slice(None))
        parts.append(told[first:last])
        limit -= last - first
        if last < chunk.stop - chunk.start:
            following = f"{chunk.number}.{last}"
            break
    poses_found = frame.from_tool(Poses.concatenate([part.poses for part in parts]))
    columns = TrialColumns(
        position=poses_found.positions,
        quaternion_xyzw=poses_found.quaternions_xyzw,
        outcome=np.concatenate([part.outcome for part in parts]),
        pose_index=np.concatenate([part.pose_index for part in parts]),
        attempts=np.concatenate([part.attempts for part in parts]),
        successes=np.concatenate([part.successes for part in parts]),
    )
    return columns, following


def pages(
    database: Database, sweep_id: str, frame: PoseFrame, *, cursor: str | None
) -> Iterator[TrialColumns]:
    """All poses of finished chunks from a cursor on."""
    columns, following = page(database, sweep_id, frame, limit=STREAM_POSES, cursor=cursor)

    def rest(columns: TrialColumns, following: str | None) -> Iterator[TrialColumns]:
        yield columns
        while following is not None:
            columns, following = page(database, sweep_id, frame, limit=STREAM_POSES, cursor=following)
            yield columns

    return rest(columns, following)
