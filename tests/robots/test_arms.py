"""Arms: kinematics against pybullet's, inverse kinematics by properties, collisions by hand."""

from __future__ import annotations

import functools

import numpy as np
import pybullet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import known_robots

pytest.importorskip("pinocchio")

from graspdb_geometry.mesh_reading.obj import read_obj
from graspdb_robots.arm import Arm
from graspdb_robots.collision import ArmCollisions, Obstacle, Surroundings, pin_model
from graspdb_robots.kinematics import Kinematics, Straight
from graspdb_robots.urdf import read_arm

Floats = NDArray[np.float64]
NONE = np.zeros(3)


def _points(name: str) -> Floats | None:
    path = known_robots.PANDA.parent / name.split("package://")[-1]
    return np.concatenate([item.vertices for item in read_obj(path.read_bytes(), 10**6).geometries])


@functools.cache
def panda() -> Arm:
    return read_arm(known_robots.PANDA.read_bytes(), "panda_link8", _points)[1]


@functools.cache
def kinematics() -> Kinematics:
    return Kinematics(panda())


def draw(count: int, seed: int = 0) -> Floats:
    lower, upper = panda().range_of()
    return np.random.default_rng(seed).uniform(lower, upper, (count, len(lower)))


@pytest.mark.parametrize(
    ("path", "flange", "joints"), [("PANDA", "panda_link8", 7), ("KUKA", "lbr_iiwa_link_7", 7)]
)
def test_forward_kinematics_are_those_of_pybullet(path: str, flange: str, joints: int) -> None:
    file = getattr(known_robots, path)
    arm = read_arm(file.read_bytes(), flange, lambda _: None)[1]
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(str(file), useFixedBase=True, physicsClientId=client)
        names = {
            info[1].decode(): (info[0], info[12].decode())
            for info in (
                pybullet.getJointInfo(body, i, physicsClientId=client)
                for i in range(pybullet.getNumJoints(body, physicsClientId=client))
            )
        }
        link = next(index for index, child in names.values() if child == flange)
        assert len(arm.joints) == joints
        lower, upper = arm.range_of()
        drawn = np.random.default_rng(1).uniform(lower, upper, (20, joints))
        poses = Kinematics(arm).forward(drawn)
        for q, pose in zip(drawn, poses, strict=True):
            for name, value in zip(arm.joints, q, strict=True):
                pybullet.resetJointState(body, names[name][0], value, physicsClientId=client)
            state = pybullet.getLinkState(body, link, computeForwardKinematics=True, physicsClientId=client)
            root = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
            inertia = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[3:5]
            base = pybullet.multiplyTransforms(*root, *pybullet.invertTransform(*inertia))
            at, turn = pybullet.multiplyTransforms(*pybullet.invertTransform(*base), *state[4:6])
            assert np.allclose(pose[:3, 3], at, atol=1e-5)
            turned = np.array(pybullet.getMatrixFromQuaternion(turn)).reshape(3, 3)
            assert np.allclose(pose[:3, :3], turned, atol=1e-5)
    finally:
        pybullet.disconnect(client)


def test_an_arm_comes_back_from_bytes() -> None:
    arm, again = panda(), Arm.from_bytes(panda().to_bytes())
    assert again.joints == arm.joints
    assert np.array_equal(again.placements, arm.placements)
    assert [solid.link for solid in again.solids] == [solid.link for solid in arm.solids]
    assert all(np.array_equal(a.points, b.points) for a, b in zip(arm.solids, again.solids, strict=True))


def test_the_jacobian_is_that_of_small_steps() -> None:
    for q in draw(5, seed=3):
        jacobian = kinematics().jacobian(q)
        for i in range(7):
            step = np.zeros(7)
            step[i] = 1e-6
            before, after = kinematics().forward(np.array([q - step, q + step]))
            assert np.allclose(jacobian[:3, i], (after - before)[:3, 3] / 2e-6, atol=1e-6)
            turn = (after[:3, :3] @ before[:3, :3].T - np.eye(3)) / 2e-6
            assert np.allclose(jacobian[3:, i], [turn[2, 1], turn[0, 2], turn[1, 0]], atol=1e-5)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_a_pose_that_joints_lead_to_is_found_again_within_limits(seed: int) -> None:
    flange = kinematics().forward(draw(1, seed))[0]
    found, off = kinematics().solutions(flange)
    assert len(found)
    assert off < 1e-5
    poses = kinematics().forward(found)
    assert np.allclose(poses, flange, atol=2e-6)
    assert (found >= panda().lower).all()
    assert (found <= panda().upper).all()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6))
def test_a_straight_way_is_straight_and_without_jumps(seed: int) -> None:
    flange = kinematics().forward(draw(1, seed))[0]
    ways = Straight(-0.1 * flange[:3, 2], np.array([0.0, 0.0, 0.05]))
    parts, lifts = ways.parts
    for joints in kinematics().solutions(flange)[0]:
        way = kinematics().way(joints, flange, ways)
        if way is None:
            continue
        assert way.shape == (parts + 1 + lifts, 7)
        assert np.abs(np.diff(way, axis=0)).max() <= 0.6
        poses = kinematics().forward(way)
        assert np.allclose(poses[:, :3, :3], flange[:3, :3], atol=1e-5)
        shares = np.concatenate([np.arange(parts, 0, -1) / parts, np.zeros(1 + lifts)])
        lifted = np.concatenate([np.zeros(parts), np.arange(lifts + 1) / lifts])
        wanted = flange[:3, 3] + shares[:, None] * ways.back + lifted[:, None] * ways.lift
        assert np.allclose(poses[:, :3, 3], wanted, atol=1e-5)


def test_out_of_reach_says_how_far() -> None:
    flange = kinematics().forward(panda().middle[None])[0]
    flange[:3, 3] = [3.0, 0.0, 0.3]
    found, off = kinematics().solutions(flange)
    assert not len(found)
    assert 1.5 < off < 3.0


def test_links_meet_boxes_points_and_each_other() -> None:
    joints = panda().middle
    hand = kinematics().forward(joints[None])[0]
    free = ArmCollisions(panda())
    assert not free.hits(joints)
    assert free.which(joints) is None
    box = Obstacle("box", hand, size_m=np.array([0.05, 0.05, 0.05]))
    boxed = ArmCollisions(panda(), (), Surroundings((box,)))
    assert boxed.hits(joints)
    assert boxed.which(joints) == ("panda_link7", "box")
    away = hand.copy()
    away[2, 3] += 1.5
    far = Surroundings((Obstacle("box", away, size_m=np.array([0.05, 0.05, 0.05])),), away[None, :3, 3], 0.01)
    assert not ArmCollisions(panda(), (), far).hits(joints)
    near = Surroundings((), hand[None, :3, 3] - 0.02 * hand[None, :3, 2], 0.005)
    assert ArmCollisions(panda(), (), near).which(joints) == ("panda_link7", "points")
    folded = np.array([0.0, 1.8, 0.0, -3.1, 0.0, 0.0, 0.0])
    assert free.hits(folded)
    assert pin_model(panda()).nq == 7


def test_what_is_held_is_tested_until_it_is_lifted() -> None:
    joints = panda().middle
    elbow = kinematics().forward(joints[None])[0]
    held = Obstacle("object", elbow, size_m=np.array([0.05, 0.05, 0.05]), held=True)
    test = ArmCollisions(panda(), (), Surroundings((held,)))
    assert test.hits(joints)
    assert not test.hits(joints, lifted=True)
