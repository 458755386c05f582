"""Doubtful grasps are told, in whatever unit, order or axes they come, and good ones are left alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from graspdb_geometry.collision import Scene, Surface, box_part
from graspdb_geometry.grippers import GripperShape
from graspdb_geometry.plausibility import Doubt, Target, doubts
from graspdb_geometry.poses import ToolPoses
from known_jaws import PANDA

SIZE = np.array([0.04, 0.06, 0.1])
BOX = box_part(SIZE / 2, (0, 0, 0), (0, 0, 0, 1))
#: A plate that can be grasped at its rim alone, so that every other axis collides.
PLATE_SIZE = np.array([0.04, 0.3, 0.3])
PLATE = Target(
    -PLATE_SIZE / 2, PLATE_SIZE / 2, Scene([box_part(PLATE_SIZE / 2, (0, 0, 0), (0, 0, 0, 1))]), PANDA
)
SEEDS = st.integers(0, 2**32 - 1)
few = settings(max_examples=25)


def _rim_grasps(seed: int, count: int = 40) -> ToolPoses:
    """Grasps of the plate that hold: at its rim from four sides, closing across its thickness."""
    rng = np.random.default_rng(seed)
    approach = np.concatenate([np.eye(3)[1:], -np.eye(3)[1:]])[rng.integers(0, 4, count)]
    closing = np.array([[1.0, 0.0, 0.0]]) * np.where(rng.random(count) < 0.5, -1.0, 1.0)[:, None]
    turns = np.stack([np.cross(closing, approach), closing, approach], axis=2)
    along = np.cross(approach, [1.0, 0.0, 0.0]) * rng.uniform(-0.14, 0.14, count)[:, None]
    positions = along - approach * rng.uniform(0.12, 0.145, count)[:, None]
    return ToolPoses(positions, Rotation.from_matrix(turns).as_quat())


def _target(shape: GripperShape | None = PANDA, *, solid: Scene | Surface | None = None) -> Target:
    return Target(-SIZE / 2, SIZE / 2, None if shape is None else solid or Scene([BOX]), shape)


def _grasps(seed: int, count: int = 40) -> ToolPoses:
    """Grasps of the box that hold: from either end of it down along z, closing across x or y."""
    rng = np.random.default_rng(seed)
    along = np.where(rng.random(count) < 0.5, -1.0, 1.0)
    across = rng.integers(0, 2, count)
    approach = np.stack([np.zeros(count), np.zeros(count), -along], axis=1)
    closing = np.eye(3)[across] * np.where(rng.random(count) < 0.5, -1.0, 1.0)[:, None]
    turns = np.stack([np.cross(closing, approach), closing, approach], axis=2)
    depth = rng.uniform(0.005, 0.03, count)
    positions = rng.uniform(-0.005, 0.005, (count, 3))
    positions[:, 2] = along * (SIZE[2] / 2 - depth)
    return ToolPoses(positions, Rotation.from_matrix(turns).as_quat())


def _codes(found: list[Doubt]) -> set[str]:
    return {doubt.code for doubt in found}


def _all(poses: ToolPoses) -> np.ndarray:
    return np.ones(len(np.asarray(poses.positions)), dtype=np.bool_)


@few
@given(SEEDS)
def test_grasps_that_hold_raise_no_doubt(seed: int) -> None:
    poses = _grasps(seed)
    mesh = Surface(*BOX, watertight=True)
    for target in (_target(), _target(solid=mesh), _target(None), None):
        assert doubts(poses, _all(poses), target) == []


@few
@given(SEEDS, st.sampled_from([("millimetres", 1000.0), ("centimetres", 100.0)]))
def test_another_unit_is_named(seed: int, unit: tuple[str, float]) -> None:
    name, factor = unit
    poses = _grasps(seed)
    other = ToolPoses(np.asarray(poses.positions) * factor, poses.quaternions_xyzw)
    found = doubts(other, _all(poses), _target())
    assert found[0].code == f"looks-like-{name}"
    assert len(found[0].rows) > 30
    assert "another-approach-axis" not in _codes(found)


@few
@given(SEEDS)
def test_millimetres_are_seen_without_a_mesh(seed: int) -> None:
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-120, 120, (30, 3))
    turns = Rotation.random(30, rng=rng).as_quat()
    assert _codes(doubts(ToolPoses(positions, turns), np.ones(30), None)) == {"looks-like-millimetres"}
    assert doubts(ToolPoses(positions / 1000, turns), np.ones(30), None) == []


@few
@given(SEEDS, st.floats(0.5, 2.0))
def test_the_world_is_no_unit(seed: int, metres: float) -> None:
    """Poses of a robot's world lie out of reach, but are in metres."""
    poses = _grasps(seed)
    moved = ToolPoses(np.asarray(poses.positions) + np.array([metres, 0, 0]), poses.quaternions_xyzw)
    codes = _codes(doubts(moved, _all(poses), _target()))
    assert "out-of-reach" in codes
    assert not any(code.startswith("looks-like-") for code in codes)


@few
@given(SEEDS)
def test_w_first_is_seen(seed: int) -> None:
    # Turned somehow: grasps along an object's axes may hold in both orders.
    turn = Rotation.random(rng=np.random.default_rng(seed))
    along = _rim_grasps(seed)
    quaternions = (turn * Rotation.from_quat(np.asarray(along.quaternions_xyzw))).as_quat()
    poses = ToolPoses(turn.apply(np.asarray(along.positions)), quaternions)
    vertices, faces = box_part(PLATE_SIZE / 2, (0, 0, 0), turn.as_quat())
    corners = np.asarray(vertices)
    plate = Target(corners.min(axis=0), corners.max(axis=0), Scene([(vertices, faces)]), PANDA)
    assert doubts(poses, _all(poses), plate) == []
    swapped = ToolPoses(poses.positions, np.roll(quaternions, 1, axis=1))
    assume(plate.solid.holds(swapped, PANDA).mean() < 0.2)
    found = doubts(swapped, _all(poses), plate)
    assert found[0].code == "looks-like-wxyz"


@few
@given(SEEDS, st.sampled_from(["-z", "x", "-x", "y", "-y"]))
def test_another_approach_axis_is_named(seed: int, axis: str) -> None:
    poses = _rim_grasps(seed)
    approach = np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis[0] == "-" else 1.0)
    closing = np.roll(np.abs(approach), 1)
    posted = np.stack([np.cross(closing, approach), closing, approach])
    turned = (Rotation.from_quat(np.asarray(poses.quaternions_xyzw)) * Rotation.from_matrix(posted)).as_quat()
    found = doubts(ToolPoses(poses.positions, turned), _all(poses), PLATE)
    assert (found[0].code, found[0].likeness) == ("another-approach-axis", axis)


@few
@given(SEEDS)
def test_closing_along_x_is_named(seed: int) -> None:
    poses = _rim_grasps(seed)
    quarter = Rotation.from_euler("z", 90, degrees=True)
    turned = (Rotation.from_quat(np.asarray(poses.quaternions_xyzw)) * quarter).as_quat()
    found = doubts(ToolPoses(poses.positions, turned), _all(poses), PLATE)
    assert (found[0].code, found[0].likeness) == ("another-closing-axis", "x")


@few
@given(SEEDS)
def test_few_grasps_across_a_bottle_tell_nothing_of_axes(seed: int) -> None:
    """Tools in an object's middle, at various heights: from one to the middle of all is any direction."""
    rng = np.random.default_rng(seed)
    for count in (10, 20, 200):
        angle = rng.uniform(-np.pi, np.pi, count)
        approach = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        closing = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
        turns = np.stack([np.cross(closing, approach), closing, approach], axis=2)
        height = np.array([0, 0, 1]) * rng.uniform(0.02, 0.115, (count, 1))
        positions = height - approach * rng.normal(0, 0.012, (count, 1))
        poses = ToolPoses(positions, Rotation.from_matrix(turns).as_quat())
        assert doubts(poses, np.ones(count), None) == []


def test_closing_across_is_likelier_than_from_behind() -> None:
    """Jaws about a slab's middle close on it from behind as well: the axis that is off is that of closing."""
    slab = np.array([0.04, 0.16, 0.02])
    solid = Scene([box_part(slab / 2, (0, 0, 0), (0, 0, 0, 1))])
    target = Target(-slab / 2, slab / 2, solid, PANDA)
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    # Approach about the slab's long axis, closing along that: across is right.
    approach = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    closing = np.tile([0.0, 1.0, 0.0], (40, 1))
    turns = np.stack([np.cross(closing, approach), closing, approach], axis=2)
    heights = np.array([0.0, 1.0, 0.0]) * np.linspace(-0.06, 0.06, 40)[:, None]
    found = doubts(ToolPoses(heights, Rotation.from_matrix(turns).as_quat()), np.ones(40), target)
    assert (found[0].code, found[0].likeness) == ("another-closing-axis", "x")


@few
@given(SEEDS)
def test_a_cloud_alone_tells_reversed_approaches_wherever_it_lies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    outward = rng.normal(size=(60, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    inward = _towards(-outward)
    move = Rotation.random(rng=rng)
    shift = rng.uniform(-1, 1, 3)
    for turns, expected in ((inward, set()), (_towards(outward), {"another-approach-axis"})):
        placed = ToolPoses(move.apply(0.1 * outward) + shift, (move * turns).as_quat())
        found = doubts(placed, np.ones(60), None)
        assert _codes(found) == expected
        assert all(doubt.likeness == "-z" for doubt in found)


def test_a_rim_tells_nothing_of_axes_without_a_gripper() -> None:
    """Grasps down on a ring close towards its middle, and approach along its axis."""
    angle = np.linspace(0, 2 * np.pi, 50, endpoint=False)
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(50)], axis=1)
    approach = np.tile([0.0, 0.0, -1.0], (50, 1))
    turns = np.stack([np.cross(-outward, approach), -outward, approach], axis=2)
    poses = ToolPoses(0.05 * outward, Rotation.from_matrix(turns).as_quat())
    assert doubts(poses, np.ones(50), None) == []


@few
@given(SEEDS)
def test_a_long_object_grasped_across_tells_nothing_of_axes_without_a_gripper(seed: int) -> None:
    """Side grasps of a bottle on its axis, most below its middle: that their x points up tells nothing."""
    rng = np.random.default_rng(seed)
    angle, height = rng.uniform(-0.9, 0.9, 200), rng.uniform(-0.06, 0.02, 200)
    approach = np.stack([-np.cos(angle), -np.sin(angle), np.zeros(200)], axis=1)
    closing = np.stack([np.sin(angle), -np.cos(angle), np.zeros(200)], axis=1)
    turns = np.stack([np.cross(closing, approach), closing, approach], axis=2)
    positions = np.stack([np.zeros(200), np.zeros(200), height], axis=1)
    poses = ToolPoses(positions, Rotation.from_matrix(turns).as_quat())
    extents = np.array([0.035, 0.035, 0.1])
    assert doubts(poses, np.ones(200), Target(-extents, extents, None, None)) == []


@few
@given(st.floats(0.0, 10.0), SEEDS)
def test_impossible_is_ten_times_object_and_gripper_away(metres: float, seed: int) -> None:
    target = _target()
    direction = np.random.default_rng(seed).normal(size=3)
    position = np.clip(direction, -SIZE / 2, SIZE / 2)
    away = direction / np.linalg.norm(direction)
    position = target.offsets((away * metres)[None])[0]
    found = doubts(ToolPoses((away * metres)[None], [[0, 0, 0, 1]]), [True], target)
    assert ("implausible-poses" in _codes(found)) == (np.linalg.norm(position) > target.limit_m)
    assert target.limit_m == pytest.approx(10 * (np.linalg.norm(SIZE) + target.gripper_size_m))


def test_what_the_gripper_meets_is_told_by_pose() -> None:
    down = [1.0, 0.0, 0.0, 0.0]
    poses = ToolPoses(
        [
            [0, 0, 0.045],  # holds the upper end
            [0, 0, 0.0],  # palm in the box
            [0, 0, SIZE[2] / 2 + PANDA.tip_offset_m + 0.001],  # 1 mm short: within what is measured
            [0, 0, SIZE[2] / 2 + PANDA.tip_offset_m + 0.004],  # closes on nothing
            [0, 0, 0.4],  # out of reach, towards it
            [0, 0, -0.4],  # out of reach, away from it
        ],
        [down] * 6,
    )
    found = {doubt.code: doubt.rows.tolist() for doubt in doubts(poses, [True] * 6, _target())}
    assert found == {
        "collides": [1],
        "closes-on-nothing": [3],
        "out-of-reach": [4, 5],
        "approaches-away": [5],
    }


def test_one_far_trial_among_many_is_told_without_a_mesh() -> None:
    poses = _grasps(0, 300)
    positions = np.asarray(poses.positions).copy()
    positions[7] = [20.0, 5.0, 3.0]
    found = doubts(ToolPoses(positions, poses.quaternions_xyzw), np.ones(300), None)
    assert [(doubt.code, doubt.rows.tolist()) for doubt in found] == [("far-from-the-rest", [7])]


@pytest.mark.parametrize("count", [0, 1, 2, 9, 10, 30])
@pytest.mark.parametrize("shape", [PANDA, None])
def test_identical_poses_and_few_are_no_error(count: int, shape: GripperShape | None) -> None:
    poses = ToolPoses(np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)))
    for target in (_target(shape), None):
        found = doubts(poses, np.ones(count, dtype=np.bool_), target)
        assert all(doubt.examined <= count for doubt in found)


def test_many_are_looked_at_by_a_sample() -> None:
    count = 20_000
    poses = ToolPoses(np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)))
    codes = {doubt.code: doubt for doubt in doubts(poses, np.zeros(count, dtype=np.bool_), _target())}
    found = codes["collides"]
    assert len(found.rows) == found.examined < count
    assert np.all(np.diff(found.rows) > 0)


def _towards(direction: np.ndarray) -> Rotation:
    """Rotations whose z axes have these directions (n, 3)."""
    side = np.cross(direction, np.roll(direction, 1, axis=1))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([side, np.cross(direction, side), direction], axis=2))
