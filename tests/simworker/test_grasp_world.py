"""One closing at a time, in real physics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from graspdb.examples import example
from graspdb.wire import SimulatePayload
from graspdb_geometry import collision
from graspdb_geometry.poses import ToolPoses
from graspdb_simworker.simulation import grasp_world
from graspdb_simworker.simulation.bodies import Closing, End
from graspdb_simworker.simulation.chunks import Workpiece, prepare
from graspdb_simworker.simulation.grasp_world import GraspWorld
from graspdb_simworker.simulation.labels import RATED, Outcome, label_of

GetWorkpiece = Callable[..., Workpiece]
FindPoses = Callable[[str, int], list[tuple[Any, Any]]]


def travels(workpiece: Workpiece, poses: list[tuple[Any, Any]]) -> list[float]:
    positions, quaternions = (np.array([pose[k] for pose in poses]) for k in (0, 1))
    codes, first = workpiece.scene.classify(ToolPoses(positions, quaternions), workpiece.gripper)
    assert (codes == collision.CONTACT).all()
    return [float(t) for t in np.minimum(first.min(axis=1), 0.5 * workpiece.gripper.max_opening_m)]


def close_all(world: GraspWorld, poses: list[tuple[Any, Any]], travel: list[float]) -> list[Closing]:
    return [world.close(p, q, t) for (p, q), t in zip(poses, travel, strict=True)]


def same(a: Closing, b: Closing) -> bool:
    """Equal in every bit."""
    arrays = all(
        getattr(one, name).tobytes() == getattr(two, name).tobytes()
        for one, two in zip(a.contacts, b.contacts, strict=True)
        for name in ("normals", "forces", "fingers")
    )
    return arrays and all(
        getattr(a, name) == getattr(b, name)
        for name in ("end", "touched", "opening_m", "position", "quaternion_xyzw", "steps")
    )


@pytest.fixture(params=["pybullet", "mujoco"])
def engine(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.parametrize("fidelity", ["standard", "fine"])
def test_the_rim_of_a_mug_is_held(
    workpiece_of: GetWorkpiece, grasps: dict[str, tuple[Any, Any]], fidelity: str, engine: str
) -> None:
    workpiece = workpiece_of("mug", fidelity, engine)
    held = workpiece.world.close(*grasps["rim"])
    assert held.end is End.STALLED
    assert held.touched
    label = label_of(held)
    assert label.outcome is Outcome.SUCCESS
    # The wall is 4 mm; across a finger's width it bulges by 2 mm.
    assert 0.0045 < label.width_m < 0.0070
    # Both fingers press with the closing force, one against the other; what is out of all doubt is read while
    # it still swings a little.
    last = held.contacts[-1]
    for finger, sign in ((0, 1.0), (1, -1.0)):
        on = last.fingers == finger
        along = (last.forces[on, None] * last.normals[on])[:, 1].sum()
        assert sign * along == pytest.approx(workpiece.gripper.closing_force_n, rel=0.2)


def test_nothing_to_close_on_is_a_miss(
    workpiece_of: GetWorkpiece, grasps: dict[str, tuple[Any, Any]], engine: str
) -> None:
    workpiece = workpiece_of("mug", engine=engine)
    closing = workpiece.world.close(*grasps["above"])
    assert closing.end is End.EMPTY
    assert label_of(closing).outcome is Outcome.MISSED


def test_the_cone_is_as_wide_as_it_is(
    workpiece_of: GetWorkpiece, grasps: dict[str, tuple[Any, Any]], engine: str
) -> None:
    workpiece = workpiece_of("cone", engine=engine)
    position, quaternion = grasps["waist"]
    for z in (-0.1, 0.0, 0.1):
        closing = workpiece.world.close((*position[:2], z), quaternion)
        label = label_of(closing)
        assert label.outcome is Outcome.SUCCESS
        # The diameter there; flat fingers, 20 mm wide, ride on the thicker side of the taper.
        diameter = 2.0 * (0.025 - 0.075 * z)
        assert diameter - 2e-4 < label.width_m < diameter + 2.0 * 0.075 * 0.010 + 2e-4
        # Friction cones of two opposite 40 N contacts hold 2.4 kg at most.
        assert 2.0 < label.quality < 3.6


def test_starting_near_the_contact_changes_nothing_but_the_time(
    workpiece_of: GetWorkpiece, grasps: dict[str, tuple[Any, Any]], engine: str
) -> None:
    workpiece = workpiece_of("cone", engine=engine)
    (travel,) = travels(workpiece, [grasps["waist"]])
    assert 0.008 < travel < 0.0101
    slow, quick = (workpiece.world.close(*grasps["waist"], t) for t in (0.0, travel))
    assert quick.steps < slow.steps
    assert quick.end is slow.end is End.STALLED
    assert quick.opening_m == pytest.approx(slow.opening_m, abs=2e-4)


def test_an_off_centre_object_is_centred(
    workpiece_of: GetWorkpiece, grasps: dict[str, tuple[Any, Any]], engine: str
) -> None:
    workpiece = workpiece_of("cone", engine=engine)
    position, quaternion = grasps["waist"]
    closing = workpiece.world.close((position[0], 0.008, position[2]), quaternion)
    assert closing.end is End.STALLED
    # Fingers that close alike push it to the middle, nearly: it was 8 mm off.
    assert abs(closing.position[1]) < 0.0025


@pytest.mark.parametrize("name", ["mug", "elongated-d"])
def test_labels_do_not_depend_on_order_or_world(
    workpiece_of: GetWorkpiece,
    physical_poses: FindPoses,
    payload_of: Callable[..., SimulatePayload],
    name: str,
    engine: str,
) -> None:
    workpiece = workpiece_of(name, engine=engine)
    poses = physical_poses(name, 60)
    travel = travels(workpiece, poses)
    forward = close_all(workpiece.world, poses, travel)
    order = np.random.default_rng(3).permutation(len(poses)).tolist()
    shuffled = close_all(workpiece.world, [poses[k] for k in order], [travel[k] for k in order])
    assert all(same(forward[k], result) for k, result in zip(order, shuffled, strict=True))
    thing = example(name)
    other = prepare(payload_of(name, stop=1, engine=engine), thing.parts).world
    fresh = [other.close(*poses[k], travel[k]) for k in reversed(range(20))]
    other.close_world()
    assert all(same(a, b) for a, b in zip(forward[:20], reversed(fresh), strict=True))
    assert len({closing.end for closing in forward}) > 1, "the sample must hold more than one kind of end"


@pytest.mark.parametrize(
    ("doubt", "end"),
    [(("SUNK_M", -1.0), End.SUNK), (("contradictory", lambda ratings: True), End.STALLED)],
    ids=["sunk", "contradictory"],
)
def test_finer_steps_leave_no_trace(
    workpiece_of: GetWorkpiece,
    grasps: dict[str, tuple[Any, Any]],
    monkeypatch: pytest.MonkeyPatch,
    doubt: tuple[str, Any],
    end: End,
    engine: str,
) -> None:
    world = workpiece_of("mug", engine=engine).world
    before = world.close(*grasps["rim"])
    with monkeypatch.context() as doubted:
        doubted.setattr(grasp_world, *doubt)
        finer = world.close(*grasps["rim"])
        assert finer.end is end
        assert finer.steps > before.steps or end is End.SUNK
    assert same(before, world.close(*grasps["rim"]))


@given(st.lists(st.floats(0.0, 10.0), max_size=8))
def test_which_readings_count(ratings: list[float]) -> None:
    counted = list(grasp_world.counted(ratings))
    assert counted == ratings[len(ratings) - len(counted) :]
    assert len(counted) == min(max(len(ratings) - 1, min(len(ratings), 1)), RATED)
    contradict = any(a < 1.0 <= b for a in counted for b in counted)
    assert grasp_world.contradictory(ratings) == contradict
    if grasp_world.settled(ratings):
        assert 1.0 < min(ratings[-2:]) <= max(ratings[-2:]) < 1.05 * min(ratings[-2:])


def outcomes(workpiece: Workpiece, poses: list[tuple[Any, Any]]) -> np.ndarray:
    travel = travels(workpiece, poses)
    return np.array(
        [
            workpiece.simulate(np.array(p), np.array(q), t).outcome
            for (p, q), t in zip(poses, travel, strict=True)
        ]
    )


def test_mirrored_twins_agree(workpiece_of: GetWorkpiece, physical_poses: FindPoses, engine: str) -> None:
    workpiece = workpiece_of("mug", engine=engine)
    poses = physical_poses("mug", 150)
    half_turn = Rotation.from_quat([0.0, 0.0, 1.0, 0.0])
    twins = [(p, tuple((Rotation.from_quat(q) * half_turn).as_quat().tolist())) for p, q in poses]
    agree = outcomes(workpiece, poses) == outcomes(workpiece, twins)
    # Not a matter of course: solvers treat the fingers one after the other.
    assert agree.mean() >= 0.97


@pytest.mark.parametrize("name", ["mug", "cone"])
def test_standard_agrees_with_fine(workpiece_of: GetWorkpiece, physical_poses: FindPoses, name: str) -> None:
    poses = physical_poses(name, 120)
    standard = outcomes(workpiece_of(name), poses) == Outcome.SUCCESS
    fine = outcomes(workpiece_of(name, "fine"), poses) == Outcome.SUCCESS
    assert 0.05 < fine.mean() < 0.95
    assert (standard == fine).mean() >= 0.96


@pytest.mark.parametrize("name", ["mug", "cone", "elongated-d"])
def test_engines_agree(workpiece_of: GetWorkpiece, physical_poses: FindPoses, name: str) -> None:
    poses = physical_poses(name, 120)
    bullet = outcomes(workpiece_of(name), poses) == Outcome.SUCCESS
    mujoco = outcomes(workpiece_of(name, engine="mujoco"), poses) == Outcome.SUCCESS
    assert 0.05 < bullet.mean() < 0.95
    assert (bullet == mujoco).mean() >= 0.95
