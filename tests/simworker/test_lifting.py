"""The protocols ``lift`` and ``shake``: the motions, and what they do to grasps that only seem to hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pybullet
import pytest
import trimesh
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from graspdb.examples import example
from graspdb.wire import Finger, GripperProfile, SimulatePayload
from graspdb.wire.sweeps import PROTOCOLS, SHAKEN
from graspdb_simworker.loop import CAPABILITIES
from graspdb_simworker.simulation import chunks, lifting
from graspdb_simworker.simulation.bodies import Part, mass_properties
from graspdb_simworker.simulation.force_test import GRAVITY_M_S2
from graspdb_simworker.simulation.labels import Label, Outcome

MakePayload = Callable[..., SimulatePayload]
FindPoses = Callable[[str, int], list[tuple[Any, Any]]]

PANDA = GripperProfile(
    max_opening_m=0.080,
    finger=Finger(width_m=0.020, thickness_m=0.015, length_m=0.045),
    tip_offset_m=0.0076,
    palm_size_m=(0.063, 0.204, 0.066),
    finger_mass_kg=0.015,
    max_speed_m_s=0.05,
    force_n=70.0,
    friction=0.4,
)
DOWN = (1.0, 0.0, 0.0, 0.0)
"""Approach along -z of the object, closing along its -y."""


def bar(length: float) -> list[Part]:
    box = trimesh.creation.box((length, 0.02, 0.02))
    return [(np.asarray(box.vertices, dtype=np.float64), np.asarray(box.faces, dtype=np.int64))]


def grasp(
    payload_of: MakePayload, parts: list[Part], position: tuple[float, float, float], **fields: Any
) -> Label:
    """Label of one grasp from above on a bar."""
    payload = payload_of("cone", stop=1, **fields)
    workpiece = chunks.prepare(payload, parts)
    try:
        return workpiece.simulate(np.array(position), np.array(DOWN), 0.0)
    finally:
        workpiece.close()


# -- the motion --------------------------------------------------------------------------------------------


def test_the_jaw_ends_ten_centimetres_higher_and_at_rest() -> None:
    times = np.linspace(0.0, lifting.DURATION_S, 60_001)
    pushes = np.array([lifting.lift_at(float(t)).push for t in times])
    steps = np.diff(times, prepend=0.0)
    before = times <= lifting.ONSET_S + lifting.LIFT_S
    rising = np.where(before & (times > lifting.ONSET_S), pushes[:, 2] - GRAVITY_M_S2, 0.0)
    speed = np.cumsum(rising * steps)
    assert abs(speed[-1]) < 1e-4
    assert np.sum(speed * steps) == pytest.approx(lifting.LIFT_M, rel=1e-3)
    # The shakes come home, at rest; sideways only: along the approach lifting would be mixed in.
    shaking = (times > lifting.ONSET_S + lifting.LIFT_S) & (
        times < lifting.ONSET_S + lifting.LIFT_S + 2.0 * lifting.SHAKE_S
    )
    for axis in (0, 1):
        speed = np.cumsum(np.where(shaking, -pushes[:, axis], 0.0) * steps)
        way = np.cumsum(speed * steps)
        assert abs(speed[-1]) < 1e-4
        assert abs(way[-1]) < 1e-5
        assert way.max() == pytest.approx(lifting.SHAKE_M, rel=1e-2)
        assert way.min() == pytest.approx(-lifting.SHAKE_M, rel=1e-2)


@pytest.mark.parametrize(
    ("protocol", "along", "about"),
    [("shake", *SHAKEN), ("shake-5-100", 5.0, 100.0)],
)
def test_a_shake_has_the_stated_accelerations_and_comes_home(
    protocol: str, along: float, about: float
) -> None:
    motion = lifting.motion_of(protocol)
    assert motion is not None
    times = np.linspace(0.0, motion.duration_s, 60_001)
    rows = [motion.at(float(t)) for t in times]
    pushes, rates = np.array([f.push for f in rows]), np.array([f.spin_rate for f in rows])
    assert np.abs(pushes).max(axis=0) == pytest.approx([along] * 3, rel=1e-3)
    assert np.abs(rates).max(axis=0) == pytest.approx([about] * 3, rel=1e-3)
    for second, stroke in ((-pushes, lifting.ALONG_M), (rates, lifting.ABOUT_RAD)):
        first = np.cumsum(second, axis=0) * times[1]
        way = np.cumsum(first, axis=0) * times[1]
        assert np.abs(first[-1]).max() < 1e-2 * np.abs(first).max()
        assert np.abs(way[-1]).max() < 1e-2 * stroke
        assert way.max(axis=0) == pytest.approx([stroke] * 3, rel=1e-2)
        assert way.min(axis=0) == pytest.approx([-stroke] * 3, rel=1e-2)
    assert np.array([f.spin for f in rows]) == pytest.approx(np.cumsum(rates, axis=0) * times[1], abs=0.02)


@pytest.mark.parametrize("protocol", ["lift", "shake"])
def test_nothing_jumps(protocol: str) -> None:
    motion = lifting.MOTIONS[protocol]
    times = np.linspace(0.0, motion.duration_s, 33_001)
    values = np.array([np.concatenate([f.push, f.spin]) for f in map(motion.at, times.tolist())])
    assert np.abs(np.diff(values, axis=0)).max() < 0.1
    assert values[0] == pytest.approx(np.zeros(6))
    weight = GRAVITY_M_S2 if protocol == "lift" else 0.0
    assert values[-1] == pytest.approx([0.0, 0.0, weight, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_body_that_nothing_holds_falls_freely_however_the_jaw_turns(axis: int) -> None:
    thing = example("screwdriver")
    mass = mass_properties(thing.parts, 0.2)
    began = lifting.ONSET_S + lifting.LIFT_S + (3 + 0) * lifting.SHAKE_S + axis * lifting.TURN_S
    duration = 0.6 * lifting.TURN_S
    start = np.array([0.03, -0.05, 0.08])
    turned = Rotation.from_rotvec([0.3, -1.1, 0.7])
    inertia = np.array(mass.inertia)

    def rates(t: float, state: np.ndarray) -> np.ndarray:
        r, v, q, spin = state[:3], state[3:6], state[6:10] / np.linalg.norm(state[6:10]), state[10:]
        where = (tuple(r), tuple(q), tuple(v), tuple(spin))
        force, torque = lifting.load(lifting.lift_at(began + t), mass.mass_kg, mass.inertia, *where)
        rotation = Rotation.from_quat(q)
        own_spin, own_torque = rotation.inv().apply(spin), rotation.inv().apply(torque)
        own_rate = (own_torque - np.cross(own_spin, inertia * own_spin)) / inertia
        x, y, z, w = q
        sx, sy, sz = spin
        turning = 0.5 * np.array(
            [
                sx * w + sy * z - sz * y,
                sy * w + sz * x - sx * z,
                sz * w + sx * y - sy * x,
                -sx * x - sy * y - sz * z,
            ]
        )
        return np.concatenate([v, np.array(force) / mass.mass_kg, turning, rotation.apply(own_rate)])

    first = np.concatenate([start, np.zeros(3), turned.as_quat(), np.zeros(3)])
    end = solve_ivp(rates, (0.0, duration), first, rtol=1e-9, atol=1e-11).y[:, -1]
    # Seen from outside it drops from rest and keeps its orientation; the jaw has turned meanwhile.
    phase = 2.0 * math.pi * duration / lifting.TURN_S
    angle = lifting.SHAKE_RAD * (math.sin(phase) - 0.5 * math.sin(2.0 * phase)) / (0.75 * math.sqrt(3.0))
    jaw = Rotation.from_rotvec(angle * np.eye(3)[axis])
    assert abs(angle) > 0.1
    fallen = start + np.array([0.0, 0.0, 0.5 * GRAVITY_M_S2 * duration**2])
    assert end[:3] == pytest.approx(jaw.inv().apply(fallen), abs=1e-6)
    assert (Rotation.from_quat(end[6:10]).inv() * jaw.inv() * turned).magnitude() < 1e-6


# -- grasps ------------------------------------------------------------------------------------------------


def test_a_bar_held_at_its_middle_stays_and_at_its_end_swings(payload_of: MakePayload) -> None:
    """Two fingers hold the weight wherever they hold the bar: forces alone do not see it swing."""
    long, fields = bar(0.4), {"mass_kg": 0.5, "friction": 0.4}
    middle, end = (0.0, 0.0, 0.0), (0.19, 0.0, 0.0)
    assert grasp(payload_of, long, end, protocol="wrench", **fields).outcome is Outcome.SUCCESS
    firm = grasp(payload_of, long, middle, protocol="lift", **fields)
    assert firm.outcome is Outcome.SUCCESS
    assert firm.quality > 0.4
    swung = grasp(payload_of, long, end, protocol="lift", **fields)
    assert swung.outcome in (Outcome.SLIPPED, Outcome.DROPPED)
    assert swung.quality < -1.0, "it turned by more than twice what is allowed"


def test_what_is_too_slippery_is_dropped(payload_of: MakePayload) -> None:
    label = grasp(payload_of, bar(0.1), (0.0, 0.0, 0.0), protocol="lift", mass_kg=0.5, friction=0.02)
    assert label.outcome is Outcome.DROPPED
    # It fell out past the fingertips.
    assert label.quality < -1.0


def test_a_shake_asks_for_no_more_than_that_it_is_not_lost(payload_of: MakePayload) -> None:
    """A bar that turns between the fingers, where lift calls it lost, stays; a short slippery one is lost."""
    off = (0.05, 0.0, 0.0)
    lifted = grasp(payload_of, bar(0.4), off, protocol="lift", mass_kg=0.5, friction=0.4)
    assert lifted.outcome is not Outcome.SUCCESS
    swung = grasp(payload_of, bar(0.4), off, protocol="shake", mass_kg=0.5, friction=0.4)
    assert swung.outcome is Outcome.SUCCESS
    assert swung.quality < 0.9
    firm = grasp(payload_of, bar(0.06), (0.0, 0.0, 0.0), protocol="shake", mass_kg=0.5, friction=0.4)
    assert firm.outcome is Outcome.SUCCESS
    assert firm.quality > 0.99
    lost = grasp(payload_of, bar(0.06), (0.0, 0.0, 0.0), protocol="shake", mass_kg=0.5, friction=0.02)
    assert lost.outcome is Outcome.DROPPED
    assert lost.quality < 0.0


def test_a_heavier_bar_slips_where_a_lighter_one_stays(payload_of: MakePayload) -> None:
    """Two contacts of 40 N at friction 0.4 hold 3.3 kg at rest, and half of it at an acceleration of 1 g."""
    labels = [
        grasp(payload_of, bar(0.06), (0.0, 0.0, 0.0), protocol="lift", mass_kg=mass, friction=0.4)
        for mass in (0.4, 1.0, 1.5, 4.0)
    ]
    assert [label.outcome for label in labels] == [Outcome.SUCCESS] * 3 + [Outcome.DROPPED]
    # What holds does not creep: less than 0.05 mm and 0.025 degrees, even close to the limit.
    assert all(label.quality > 0.95 for label in labels[:3])


def test_light_objects_are_carried_with_the_full_force(payload_of: MakePayload) -> None:
    """Below 0.3 kg the jaw closes with a quarter of its force, but carries with all of it, so that just as
    slippery a bar slips on either side of that mass."""
    for friction, outcome in ((0.4, Outcome.SUCCESS), (0.025, Outcome.DROPPED)):
        for mass in (0.299, 0.301):
            label = grasp(
                payload_of, bar(0.06), (0.0, 0.0, 0.0), protocol="lift", mass_kg=mass, friction=friction
            )
            assert label.outcome is outcome, (friction, mass)


@pytest.mark.parametrize("protocol", ["lift", "shake"])
def test_what_is_beside_a_finger_does_not_touch_it(payload_of: MakePayload, protocol: str) -> None:
    """A rod that passes the corner of a fingertip, slanting: their bounding boxes overlap, they are 4 mm
    apart."""
    ends = [(0.040, 0.0), (0.0, -0.040)]
    corners = [
        (x + dx, -0.017 + dy, z + dz)
        for x, z in ends
        for dx in (-5e-4, 5e-4)
        for dy in (-5e-4, 5e-4)
        for dz in (-5e-4, 5e-4)
    ]
    rod = trimesh.convex.convex_hull(np.array(corners))
    part = (np.asarray(rod.vertices, dtype=np.float64), np.asarray(rod.faces, dtype=np.int64))
    fields = {"protocol": protocol, "mass_kg": 0.05, "friction": 0.4}
    label = grasp(payload_of, [*bar(0.06), part], (0.0, 0.0, 0.0), **fields)
    assert label.outcome is Outcome.SUCCESS
    assert label.quality > 0.9


@pytest.mark.parametrize("protocol", ["wrench", "lift", "shake"])
def test_the_panda_hand_grasps_a_bar(payload_of: MakePayload, protocol: str) -> None:
    fields = {"gripper": PANDA, "mass_kg": 0.4, "friction": 0.4, "protocol": protocol}
    label = grasp(payload_of, bar(0.2), (0.0, 0.0, 0.0), **fields)
    assert label.outcome is Outcome.SUCCESS
    assert label.width_m == pytest.approx(0.02, abs=5e-4)


def test_the_rim_of_a_mug_is_lifted(payload_of: MakePayload, grasps: dict[str, tuple[Any, Any]]) -> None:
    payload = payload_of("mug", poses=[grasps["rim"], grasps["above"]], protocol="lift")
    workpiece = chunks.prepare(payload, example("mug").parts)
    result = chunks.simulate_chunk(payload, workpiece)
    workpiece.close()
    assert list(result.outcomes) == [Outcome.SUCCESS, Outcome.MISSED]
    (quality,) = result.rows.quality
    assert quality is not None
    assert 0.8 < quality <= 1.0


def test_lifts_do_not_depend_on_order_or_world(payload_of: MakePayload, physical_poses: FindPoses) -> None:
    poses = physical_poses("mug", 24)
    payload = payload_of("mug", poses=poses, protocol="lift")
    one, two = (chunks.prepare(payload, example("mug").parts) for _ in range(2))
    order = np.random.default_rng(5).permutation(len(poses)).tolist()
    forward = [one.world.close(*pose) for pose in poses]
    shuffled = {k: two.world.close(*poses[k]) for k in order}
    for workpiece in (one, two):
        workpiece.close()
    assert [c.carried for c in forward] == [shuffled[k].carried for k in range(len(poses))]
    assert sum(c.carried is not None for c in forward) >= 2


def test_the_worker_says_what_it_can_do() -> None:
    drawn = {f"drawn-{protocol}" for protocol in PROTOCOLS}
    assert set(CAPABILITIES) == {"simulate", "stated-shake", *drawn, *PROTOCOLS} - {"wrench"}
    assert set(chunks.PROTOCOLS) == set(PROTOCOLS)


@pytest.mark.parametrize("friction", [0.1, 0.4, 0.9])
@pytest.mark.parametrize("protocol", ["wrench", "lift"])
def test_the_fingers_rub_as_they_were_told(payload_of: MakePayload, protocol: str, friction: float) -> None:
    """The engine's own figures: it has been known to ignore settings of links."""
    payload = payload_of("cone", stop=1, protocol=protocol, mass_kg=0.5, friction=friction)
    workpiece = chunks.prepare(payload, bar(0.06))
    try:
        world = workpiece.world._engine
        roots = [
            pybullet.getDynamicsInfo(body, link, physicsClientId=world._client)[1]
            for body, link in ((world._object, -1), (world._jaw, -1), (world._jaw, 0), (world._jaw, 1))
        ]
        assert [roots[0] * root for root in roots[1:]] == pytest.approx([friction] * 3)
    finally:
        workpiece.close()
