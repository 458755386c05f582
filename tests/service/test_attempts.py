"""All attempts in arrays: poses of overlapping grids once, and fewer of what collided where asked for."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES, GridPlan
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.simulation.linked import ComparedChunk
from graspdb_service.storage.simulation.outcomes import PackedChunk
from graspdb_service.storage.simulation.sweeps import SweepRow
from graspdb_service.trial_columns import TrialColumns
from graspdb_service.usecases.trials import sweep_plan
from graspdb_service.usecases.trials.attempts import NO_ATTEMPT, Stored, Swept, joined, mean_of_both
from graspdb_service.usecases.trials.selection import Selected

SUCCESS, MISSED, COLLISION = (OUTCOME_CODES[name] for name in ("success", "missed", "collision"))
CODES = np.array([SUCCESS, MISSED, COLLISION, NO_ATTEMPT], dtype=np.uint8)


def sweep_of(name: str, **options: Any) -> SweepRow:
    plan = GridPlan(
        lower=(0.0, 0.0, 0.0), upper=(0.05, 0.04, 0.03), position_step_m=0.01, rotation_step_deg=60.0,
        margin_m=0.0, **options,
    )  # fmt: skip
    now = datetime(2026, 1, 1, tzinfo=UTC)
    poses = sweep_plan.pose_grid(plan).total
    return SweepRow(
        id=name, object_id=1, provenance_id=7, gripper="pg70", gripper_version=1, protocol="wrench",
        fidelity="standard", purpose="collect", plan="grid", request={},
        snapshot={"grid": plan.model_dump(), "repeat_key": "one grid"},
        pose_count=poses, chunk_poses=100, chunks=1, cancelled=False, made_by=None,
        created_at=now, started_at=now, finished_at=now, linked=None, object="thing", batch_id=1, batch="b",
    )  # fmt: skip


def outcome_of(index: NDArray[np.int64], seed: int) -> NDArray[np.uint8]:
    """What a pose of the grid came to: three in four collide."""
    rng = np.random.default_rng(seed)
    return np.asarray(CODES[rng.choice(4, size=100_000, p=[0.1, 0.1, 0.75, 0.05])[index]])


def stored(*sweeps: tuple[SweepRow, int], rows: int = 0) -> Stored:
    """Sweeps in chunks of 100 poses, taking turns, as two that run at a time store them."""
    chunks: list[list[Swept]] = []
    for row, seed in sweeps:
        grid = sweep_plan.grid_of(row)
        chunks.append([])
        for start in range(0, grid.total, 100):
            stop = min(start + 100, grid.total)
            codes = outcome_of(grid.pose_indices(start, stop), seed)
            chunks[-1].append(
                Swept(row, PackedChunk(row.id, start // 100, start, stop, codes.tobytes(), None), None)
            )
    turns = [part[i] for i in range(max(map(len, chunks))) for part in chunks if i < len(part)]
    rng = np.random.default_rng(1)
    columns = TrialColumns(
        seq=np.arange(rows), position=rng.normal(size=(rows, 3)),
        quaternion_xyzw=np.tile([0.0, 0, 0, 1], (rows, 1)), outcome=np.full(rows, COLLISION, dtype=np.uint8),
        proposal_density=np.full(rows, np.nan), provenance=np.full(rows, 7),
    )  # fmt: skip
    now = datetime.now(UTC)
    nothing = [None] * 5
    thing = ObjectRow(1, "thing", *nothing, 1, 0, rows, *nothing[:4], now, now, *nothing[:3])
    selected = Selected(
        row=thing, gripper="pg70", protocol="wrench", source=None, source_weight=None, profile=None,
        provenances={7: True}, sources={7: "simulation"}, outcomes={},
        by_source={"simulation": {}}, tried=frozenset({7}),
        versions=(1,), stamp=None, warnings=(),
    )  # fmt: skip
    return Stored(columns, turns, selected, (NO_ATTEMPT,))


def test_poses_of_two_grids_of_one_lattice_count_once_the_first_that_was_stored() -> None:
    whole = sweep_of("a")
    part = sweep_of("b", region=((0.02, 0.0, 0.0), (0.05, 0.04, 0.03)))
    alone = joined(stored((whole, 0)))
    both = joined(stored((whole, 0), (part, 5)))
    grid = sweep_plan.grid_of(whole)
    planned = np.isin(np.arange(grid.full_total), grid.pose_indices(0, grid.total))
    expected = np.where(planned, outcome_of(np.arange(grid.full_total), 0), NO_ATTEMPT)
    assert len(alone) == int((expected != NO_ATTEMPT).sum())
    assert alone.keys is not None
    assert both.keys is not None
    keys = both.keys[1] * grid.rotation_count + both.keys[0]
    assert len(np.unique(keys)) == len(keys)
    # A pose that broke off in one sweep is known from the other.
    cut = sweep_plan.grid_of(part)
    inside = np.isin(np.arange(grid.full_total), cut.pose_indices(0, cut.total))
    other = np.where(inside, outcome_of(np.arange(grid.full_total), 5), NO_ATTEMPT)
    assert set(keys) == set(np.flatnonzero((expected != NO_ATTEMPT) | (other != NO_ATTEMPT)))
    position, quaternion = grid.poses(keys)
    np.testing.assert_allclose(both.poses.positions, position)
    np.testing.assert_allclose(both.poses.quaternions_xyzw, quaternion)
    first = np.where(expected[keys] == NO_ATTEMPT, other[keys], expected[keys])
    # Chunks took turns: where both tried, either came first, and each pose has the outcome of one of them.
    told = np.where(both.success, SUCCESS, np.where(both.collided, COLLISION, MISSED))
    assert np.all((told == first) | (inside[keys] & (told == other[keys])))
    early = keys < 100
    assert np.all(told[early] == first[early])


def test_fewer_that_collided_stand_for_all() -> None:
    given = stored((sweep_of("a"), 0), rows=400)
    whole, few = joined(given), joined(given, most_collided=200)
    assert whole.left_out == 0
    assert few.attempts == whole.attempts == len(whole)
    assert int(few.success.sum()) == int(whole.success.sum())
    assert int((~few.collided).sum()) == int((~whole.collided).sum())
    left = int(few.collided.sum())
    assert left == pytest.approx(200, abs=5 * 200**0.5)
    assert left + few.left_out == int(whole.collided.sum())
    # Posted ones and packed ones alike.
    posted = np.isnan(few.proposal).sum() / np.isnan(whole.proposal).sum()
    assert posted == pytest.approx(200 / whole.collided.sum(), abs=0.1)
    again = joined(given, most_collided=10**6)
    np.testing.assert_array_equal(again.poses.positions, whole.poses.positions)
    assert again.left_out == 0


def _drawn(outcomes: np.ndarray, won: np.ndarray | None) -> ComparedChunk:
    successes = None if won is None else won.astype(np.uint8).tobytes()
    return ComparedChunk("other", 0, outcomes.astype(np.uint8).tobytes(), successes)


@given(
    st.integers(1, 100),
    st.lists(st.tuples(st.integers(0, 100), st.integers(0, 100)), min_size=1, max_size=30),
)
def test_what_either_engine_says_lies_within_the_spread_of_both(
    draws: int, counts: list[tuple[int, int]]
) -> None:
    """Whatever is rounded; where each tried a pose once, nothing is."""
    first, second = np.minimum(np.array(counts).T, draws)
    poses = TrialColumns(np.zeros((len(counts), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(counts), 1)))
    sweep = cast(SweepRow, SimpleNamespace(request={"randomise": {"draws": draws}} if draws > 1 else {}))
    every = np.ones(len(counts), dtype=np.bool_)
    labels = [np.where(2 * won >= draws, 1, 2) for won in (first, second)]
    part = replace(poses, outcome=labels[0].astype(np.uint8))
    if draws > 1:
        part = sweep_plan.with_draws(part, sweep, first.astype(np.uint8).tobytes(), every)
    compared = _drawn(labels[1], second if draws > 1 else None)
    share, spread = mean_of_both(part, compared, sweep, every)
    for won in (first, second):
        assert (np.abs(won / draws - share) <= spread + 1e-6).all()
    if draws == 1:
        assert (share == (first + second) / 2).all()
        assert (spread == np.abs(first - second) / 2).all()
    assert (np.abs(share - (first + second) / (2 * draws)) <= 1 / 40 + 1e-9).all()


def test_where_one_engine_broke_off_the_other_stands_alone() -> None:
    poses = TrialColumns(
        np.zeros((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)), outcome=np.array([1, 3], "u1")
    )
    sweep = cast(SweepRow, SimpleNamespace(request={}))
    compared = _drawn(np.array([NO_ATTEMPT, NO_ATTEMPT]), None)
    share, spread = mean_of_both(poses, compared, sweep, np.ones(2, dtype=np.bool_))
    assert (share.tolist(), spread.tolist()) == ([1.0, 0.0], [0.0, 0.0])
