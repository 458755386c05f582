"""Whole chunks: an outcome for every pose, the same bytes however the work is cut."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from graspdb.examples import example
from graspdb.wire import SimulatePayload, SimulateResult
from graspdb_geometry import collision
from graspdb_geometry.poses import ToolPoses
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.labels import SIMULATION_ERROR, Label, Outcome

MakePayload = Callable[..., SimulatePayload]
GetWorkpiece = Callable[..., chunks.Workpiece]


def codes(result: SimulateResult) -> np.ndarray:
    return np.frombuffer(result.outcomes, dtype=np.uint8)


def test_every_pose_gets_an_outcome_and_physics_a_row(
    payload_of: MakePayload, workpiece_of: GetWorkpiece
) -> None:
    payload, workpiece = payload_of("mug", start=100, stop=5_100), workpiece_of("mug")
    result = chunks.simulate_chunk(payload, workpiece)
    found = codes(result)
    indices, positions, quaternions = chunks.poses_of(payload)
    assert len(found) == len(indices) == 5_000
    geometry, _ = workpiece.scene.classify(ToolPoses(positions, quaternions), workpiece.gripper)
    np.testing.assert_array_equal(found == Outcome.COLLISION, geometry == collision.COLLIDES)
    assert (found[geometry == collision.EMPTY] == Outcome.MISSED).all()
    assert result.rows.pose_index == indices[geometry == collision.CONTACT].tolist()
    assert result.rows.pose_index == sorted(result.rows.pose_index)
    assert {Outcome.COLLISION, Outcome.MISSED, Outcome.SLIPPED, Outcome.SUCCESS} <= set(found.tolist())
    assert Outcome.SIMULATION_ERROR not in found
    success = found[geometry == collision.CONTACT] == Outcome.SUCCESS
    quality = np.array([np.nan if q is None else q for q in result.rows.quality])
    assert (quality[success] >= 1.0).all()
    assert all(w is not None and 0.0 <= w <= 0.070 for w in result.rows.width_m)


def test_cutting_a_chunk_in_two_changes_nothing(payload_of: MakePayload, workpiece_of: GetWorkpiece) -> None:
    workpiece = workpiece_of("mug")
    grid = {"max_poses": None}  # ranges of a permutation are sorted each by itself
    start, stop = 1_200_000, 1_203_000
    whole, first, second = (
        chunks.simulate_chunk(payload_of("mug", grid=grid, start=a, stop=b), workpiece)
        for a, b in ((start, stop), (start, start + 1_100), (start + 1_100, stop))
    )
    assert whole.outcomes == first.outcomes + second.outcomes
    for name in ("pose_index", "width_m", "quality"):
        assert getattr(whole.rows, name) == getattr(first.rows, name) + getattr(second.rows, name)
    assert len(whole.rows.pose_index) > 50


def test_poses_given_one_by_one_get_what_the_grid_gets(
    payload_of: MakePayload, workpiece_of: GetWorkpiece
) -> None:
    workpiece = workpiece_of("mug")
    payload = payload_of("mug", stop=1_500)
    _, positions, quaternions = chunks.poses_of(payload)
    poses = [(tuple(p), tuple(q)) for p, q in zip(positions.tolist(), quaternions.tolist(), strict=True)]
    backwards = payload_of("mug", poses=poses[::-1], start=70)
    grid, listed = (chunks.simulate_chunk(p, workpiece) for p in (payload, backwards))
    assert grid.outcomes == listed.outcomes[::-1]
    assert grid.rows.width_m == listed.rows.width_m[::-1]
    assert grid.rows.quality == listed.rows.quality[::-1]
    assert min(listed.rows.pose_index) >= 70
    assert max(listed.rows.pose_index) < 1_570


def test_known_rows_are_not_simulated_again(payload_of: MakePayload, workpiece_of: GetWorkpiece) -> None:
    workpiece, payload = workpiece_of("mug"), payload_of("mug", stop=600)
    seen: list[int] = []
    labels: dict[int, Label] = {}
    whole = chunks.simulate_chunk(payload, workpiece, before=seen.append, after=labels.__setitem__)
    assert seen == list(labels)
    died = seen[3]
    del labels[seen[5]]
    labels[died] = SIMULATION_ERROR
    again: list[int] = []
    resumed = chunks.simulate_chunk(payload, workpiece, known=labels, before=again.append)
    assert again == [seen[5]]
    expected = codes(whole).copy()
    expected[died] = Outcome.SIMULATION_ERROR
    np.testing.assert_array_equal(codes(resumed), expected)
    assert (resumed.rows.width_m[3], resumed.rows.quality[3]) == (None, None)


def test_other_protocols_are_refused_by_name(payload_of: MakePayload) -> None:
    with pytest.raises(chunks.UnsupportedProtocol, match="tickle"):
        chunks.prepare(
            payload_of("cone", stop=1).model_copy(update={"protocol": "tickle"}), example("cone").parts
        )


@pytest.mark.parametrize(
    "change",
    [{"poses": None}, {"stop": 3}],
    ids=["neither grid nor poses", "fewer poses than it says"],
)
def test_a_payload_that_contradicts_itself_is_refused(
    payload_of: MakePayload, change: dict[str, Any]
) -> None:
    pose = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    payload = payload_of("cone", poses=[pose, pose]).model_copy(update=change)
    with pytest.raises(ValueError, match="poses"):
        chunks.poses_of(payload)


@pytest.mark.parametrize(("finger_kg", "object_kg", "simulated"), [(0.1, 1.6, 0.1), (0.015, 1.6, 0.1)])
def test_fingers_are_not_simulated_far_lighter_than_the_object(
    payload_of: MakePayload, finger_kg: float, object_kg: float, simulated: float
) -> None:
    pg70 = payload_of("mug", start=0, stop=1).gripper
    light = pg70.model_copy(update={"finger_mass_kg": finger_kg})
    assert chunks.gripper_of(light, object_kg).finger_mass_kg == pytest.approx(simulated)
    assert chunks.gripper_of(light, 0.05).finger_mass_kg == finger_kg
