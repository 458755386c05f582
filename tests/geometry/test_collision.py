"""The collision prefilter against linear programming, against hand-made cases, and under symmetries."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from graspdb.examples import EXAMPLES, example
from graspdb_geometry import collision, grids, grippers
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70

SEEDS = st.integers(0, 2**32 - 1)
#: Overlaps within this of zero may be called either way by the two methods.
CLOSE = 1e-6


def box_part(half: Any, centre: Any = (0, 0, 0)) -> tuple[Any, Any]:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half + centre
    return corners, np.zeros((0, 3), dtype=int)


def identity(count: int = 1) -> np.ndarray:
    return np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))


def check_against(reference: Any, scene: Any, positions: Any, quaternions: Any, shape: Any) -> np.ndarray:
    codes, contact = scene.classify(ToolPoses(positions, quaternions), shape)
    hits = scene.collides(ToolPoses(positions, quaternions), shape)
    assert np.array_equal(hits, codes == collision.COLLIDES)
    half = shape.max_opening_m / 2
    for p, q, code, travel in zip(positions, quaternions, codes, contact, strict=True):
        rotation = Rotation.from_quat(q).as_matrix()
        depth = reference.collision_depth(p, rotation, shape)
        if abs(depth) > CLOSE:
            assert (depth > 0) == (code == collision.COLLIDES), (depth, p, q)
        if code == collision.COLLIDES:
            assert np.isnan(travel).all()
            continue
        low, high, overlap = reference.column_extent(p, rotation, shape)
        if abs(overlap) > CLOSE:
            assert (overlap > 0) == (code == collision.CONTACT), (overlap, p, q)
        if code == collision.CONTACT and overlap > CLOSE:
            np.testing.assert_allclose(travel, [half - high, half + low], atol=2e-6)
        if code == collision.EMPTY:
            assert np.isnan(travel).all()
    return codes


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=SEEDS)
def test_one_random_hull_agrees_with_linear_programming(
    seed: int, oracle: Any, random_hull: Any, random_poses: Any
) -> None:
    rng = np.random.default_rng(seed)
    points = random_hull(rng)
    shape = grippers.GripperShape(*rng.uniform(0.004, 0.1, size=4), 0.002, tuple(rng.uniform(0.01, 0.1, 3)))
    positions, quaternions = random_poses(rng, 6, 0.08)
    check_against(oracle([points]), collision.Scene([(points, [])]), positions, quaternions, shape)


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_agree_with_linear_programming_on_lattice_poses(name: str, oracle: Any) -> None:
    thing = example(name)
    scene = collision.Scene(thing.parts)
    grid = grids.PoseGrid(*(tuple(b) for b in thing.bounds), max_poses=4000, seed=3)
    positions, quaternions = grid.poses(grid.pose_indices(0, grid.total))
    codes, _ = scene.classify(ToolPoses(positions, quaternions), PG70)
    # A few of every kind, and the reference must see the same kinds.
    chosen = np.concatenate([np.flatnonzero(codes == code)[:8] for code in range(3)])
    seen = check_against(
        oracle([v for v, _ in thing.parts]), scene, positions[chosen], quaternions[chosen], PG70
    )
    assert set(seen) == {collision.COLLIDES, collision.EMPTY, collision.CONTACT}


def test_first_contact_by_hand() -> None:
    # A block from y = -10 to 20 mm between fingers 35 mm from the middle.
    scene = collision.Scene([box_part([0.005, 0.015, 0.01], [0, 0.005, 0.01])])
    codes, travel = scene.classify(ToolPoses([[0, 0, 0]], identity()), PG70)
    assert codes.tolist() == [collision.CONTACT]
    np.testing.assert_allclose(travel, [[0.015, 0.025]], atol=1e-12)


def test_part_reaching_into_the_column_through_its_face_only() -> None:
    # A sharp tip enters the column from +x; only the cut at the column's side bounds it in y.
    tip = np.array([[0.008, 0, 0], [0.03, 0.02, 0.02], [0.03, -0.02, 0.02], [0.03, 0, -0.02]])
    codes, travel = collision.Scene([(tip, [])]).classify(ToolPoses([[0, 0, 0]], identity()), PG70)
    assert codes.tolist() == [collision.CONTACT]
    # At x = 10 mm each edge has run 2/22 of its length.
    np.testing.assert_allclose(travel, [[0.035 - 0.02 / 11] * 2], atol=1e-7)


def test_object_on_one_side_lets_the_other_finger_travel_beyond_its_stroke() -> None:
    scene = collision.Scene([box_part([0.005, 0.004, 0.005], [0, 0.02, 0])])
    _, travel = scene.classify(ToolPoses([[0, 0, 0]], identity()), PG70)
    np.testing.assert_allclose(travel, [[0.011, 0.051]], atol=1e-12)


def test_solids_one_inside_the_other_collide() -> None:
    inside = collision.Scene([box_part(0.001, [0, 0.0425, 0])])  # a crumb within the +y finger
    around = collision.Scene([box_part(1.0)])
    assert inside.collides(ToolPoses([[0, 0, 0]], identity()), PG70).all()
    assert around.collides(ToolPoses([[0, 0, 0]], identity()), PG70).all()


@pytest.mark.parametrize(
    ("centre", "half"),
    [
        ((0, 0, 0), (0.005, 0.035, 0.005)),  # as wide as the opening: touches both fingers
        ((0, 0, -0.037), (0.005, 0.005, 0.010)),  # lies on the palm
        ((0, 0, 0.033), (0.05, 0.05, 0.010)),  # touches both fingertips
        ((0.02, 0, 0), (0.010, 0.1, 0.02)),  # slides along the fingers' sides
    ],
)
def test_touching_is_no_collision_but_a_micrometre_of_overlap_is(centre: Any, half: Any) -> None:
    half = np.array(half)
    assert not collision.Scene([box_part(half, centre)]).collides(ToolPoses([[0, 0, 0]], identity()), PG70)[0]
    assert collision.Scene([box_part(half + 1e-6, centre)]).collides(
        ToolPoses([[0, 0, 0]], identity()), PG70
    )[0]


def test_narrower_openings_collide_with_what_the_open_gripper_clears() -> None:
    scene = collision.Scene([box_part(0.01)])
    assert not scene.collides(ToolPoses([[0, 0, 0]], identity()), PG70)[0]
    assert not scene.collides(ToolPoses([[0, 0, 0]], identity()), PG70, opening_m=0.0201)[0]
    assert scene.collides(ToolPoses([[0, 0, 0]], identity()), PG70, opening_m=0.0199)[0]
    with pytest.raises(ValueError, match="opening_m"):
        scene.collides(ToolPoses([[0, 0, 0]], identity()), PG70, opening_m=0.0701)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=SEEDS)
def test_moving_object_and_tool_together_changes_nothing(
    seed: int, random_hull: Any, random_poses: Any
) -> None:
    rng = np.random.default_rng(seed)
    parts = [random_hull(rng) for _ in range(3)]
    positions, quaternions = random_poses(rng, 200, 0.15)
    shift, turn = rng.normal(size=3), Rotation.random(random_state=seed)
    codes, travel = collision.Scene([(p, []) for p in parts]).classify(
        ToolPoses(positions, quaternions), PG70
    )
    moved = collision.Scene([(turn.apply(p) + shift, []) for p in parts])
    moved_codes, moved_travel = moved.classify(
        ToolPoses(turn.apply(positions) + shift, (turn * Rotation.from_quat(quaternions)).as_quat()), PG70
    )
    assert np.array_equal(codes, moved_codes)
    np.testing.assert_allclose(travel, moved_travel, atol=1e-9)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=SEEDS)
def test_the_jaws_half_turn_swaps_the_fingers(seed: int, random_hull: Any, random_poses: Any) -> None:
    rng = np.random.default_rng(seed)
    scene = collision.Scene([(random_hull(rng), []) for _ in range(2)])
    positions, quaternions = random_poses(rng, 200, 0.12)
    half_turn = Rotation.from_euler("z", np.pi)
    codes, travel = scene.classify(ToolPoses(positions, quaternions), PG70)
    twin_codes, twin_travel = scene.classify(
        ToolPoses(positions, (Rotation.from_quat(quaternions) * half_turn).as_quat()), PG70
    )
    assert np.array_equal(codes, twin_codes)
    np.testing.assert_allclose(travel, twin_travel[:, ::-1], atol=1e-9)


def test_answers_do_not_depend_on_threads_order_or_sign_of_the_quaternion(random_poses: Any) -> None:
    scene = collision.Scene(example("mug").parts)
    positions, quaternions = random_poses(np.random.default_rng(5), 20_000, 0.12)
    codes, travel = scene.classify(ToolPoses(positions, quaternions), PG70)
    again, travel_again = scene.classify(ToolPoses(positions, -quaternions), PG70, threads=3)
    assert np.array_equal(codes, again)
    np.testing.assert_array_equal(travel, travel_again)
    backwards, travel_backwards = scene.classify(ToolPoses(positions[::-1], quaternions[::-1]), PG70)
    assert np.array_equal(codes, backwards[::-1])
    np.testing.assert_array_equal(travel, travel_backwards[::-1])


def test_no_poses_is_no_error() -> None:
    codes, travel = collision.Scene([box_part(0.01)]).classify(
        ToolPoses(np.zeros((0, 3)), np.zeros((0, 4))), PG70
    )
    assert codes.shape == (0,)
    assert travel.shape == (0, 2)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ([], "at least one"),
        ([(np.zeros((3, 3)), [])], "four"),
        ([(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]]), [])], "flat"),
        ([(np.full((4, 3), np.nan), [])], "finite"),
    ],
)
def test_bad_parts_are_refused(parts: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        collision.Scene(parts)


@pytest.mark.parametrize(
    ("positions", "quaternions", "message"),
    [
        ([[0, 0]], [[0, 0, 0, 1]], "positions"),
        ([[0, 0, 0]], [[0, 0, 1]], "quaternions"),
        ([[0, 0, np.inf]], [[0, 0, 0, 1]], "finite"),
        ([[0, 0, 0]], [[0, 0, 0, 2]], "unit"),
        ([[0, 0, 0]], [[0, 0, 0, 0]], "unit"),
    ],
)
def test_bad_poses_are_refused(positions: Any, quaternions: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        collision.Scene([box_part(0.01)]).classify(ToolPoses(positions, quaternions), PG70)
