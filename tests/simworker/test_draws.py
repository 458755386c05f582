"""What is drawn anew in each of several simulations of a pose, and what k of n come to."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from graspdb.examples import example
from graspdb.wire import SimulatePayload, SimulateResult
from graspdb.wire.sweeps import Engine, Protocol, Randomise
from graspdb_simworker.inspection import agreement
from graspdb_simworker.inspection.stored_outcomes import StoredOutcomes
from graspdb_simworker.simulation import chunks
from graspdb_simworker.simulation.bodies import mass_properties
from graspdb_simworker.simulation.draws import draws_of, noisy, philox
from graspdb_simworker.simulation.labels import Label, Outcome, majority

MakePayload = Callable[..., SimulatePayload]
FindPoses = Callable[[str, int], list[tuple[Any, Any]]]
ONLY: dict[str, float] = dict.fromkeys(
    ("friction", "mass", "centre_of_mass_m", "pose_noise_m", "pose_noise_deg"), 0.0
)


def _one(value: int) -> np.ndarray:
    return np.array([value], dtype=np.uint64)


@pytest.mark.parametrize(
    ("seed", "counter", "words"),
    [
        (0, (0, 0, 0, 0), "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        (2**64 - 1, (2**32 - 1,) * 4, "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        (
            0x299F31D0_A4093822,
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            "d16cfe09 94fdcceb 5001e420 24126ea1",
        ),
    ],
)
def test_numbers_are_those_of_philox(seed: int, counter: tuple[int, int, int, int], words: str) -> None:
    """Its authors' known answers."""
    found = philox(seed, (_one(counter[0]), _one(counter[1]), counter[2], counter[3]))
    assert [f"{word:08x}" for word in found[0].tolist()] == words.split()


# -- worlds ------------------------------------------------------------------------------------------------


def test_worlds_are_spread_evenly_about_what_is_known(payload_of: MakePayload) -> None:
    asked = Randomise(draws=40, friction=0.2, mass=0.1, centre_of_mass_m=1e-3, finger_compliance=0.5)
    payload, parts = payload_of("mug", stop=1, randomise=asked), example("mug").parts
    drawn = draws_of(payload, parts)
    shares = np.array(
        [
            [math.log(draw.friction / payload.friction) / 0.2 for draw in drawn],
            [math.log(draw.mass_kg / payload.mass_kg) / 0.1 for draw in drawn],
            *np.transpose([np.array(draw.offset_m) / 1e-3 for draw in drawn]),
            [math.log(draw.compliance) / 0.5 for draw in drawn],
        ]
    )
    # One in each of forty equally likely ranges, of every quantity, in orders that have nothing in common.
    for column in norm.cdf(shares):
        assert sorted((column * 40).astype(int)) == list(range(40))
    assert np.abs(np.corrcoef(shares) - np.eye(6)).max() < 0.5
    # The same whatever chunk asks; others for another seed.
    assert draws_of(payload_of("mug", start=7, stop=9, randomise=asked), parts) == drawn
    other = payload_of("mug", stop=1, randomise=asked.model_copy(update={"seed": 1}))
    assert draws_of(other, parts) != drawn


def test_a_centre_of_mass_stays_in_the_convex_hull(payload_of: MakePayload) -> None:
    asked = Randomise(draws=50, centre_of_mass_m=0.03)
    parts = example("mug").parts
    centre = np.array(mass_properties(parts, 1.0).centre)
    planes = ConvexHull(np.concatenate([vertices for vertices, _ in parts])).equations
    found = np.array([d.offset_m for d in draws_of(payload_of("mug", stop=1, randomise=asked), parts)])
    depth = (planes[:, :3] @ (centre + found).T + planes[:, 3:]).max(axis=0)
    assert depth.max() < 1e-9
    assert (depth > -1e-9).sum() > 10
    assert (depth < -1e-3).sum() > 5


@pytest.mark.parametrize(
    ("protocol", "engine", "spread", "field"),
    [
        ("wrench", "pybullet", {"friction": 0.5}, "friction"),
        ("wrench", "mujoco", {"mass": 0.5}, "mass_kg"),
        ("lift", "pybullet", {"mass": 0.5}, "mass_kg"),
    ],
)
def test_a_draw_is_the_simulation_of_what_was_drawn(
    payload_of: MakePayload,
    physical_poses: FindPoses,
    protocol: Protocol,
    engine: Engine,
    spread: dict[str, float],
    field: str,
) -> None:
    poses, parts = physical_poses("mug", 6), example("mug").parts
    asked = Randomise.model_validate({**ONLY, **spread, "draws": 2, "seed": 3})
    payload = payload_of("mug", poses=poses, protocol=protocol, engine=engine, randomise=asked)
    drawn, labels = simulated(payload)
    for number, draw in enumerate(draws_of(payload, parts)):
        once = payload_of(
            "mug", poses=poses, protocol=protocol, engine=engine, **{field: getattr(draw, field)}
        )
        _, alone = simulated(once)
        # Each in its turn met the same physics, in all figures but NaN's.
        part = {row: repr(labels[number * len(poses) + row]) for row in alone}
        assert part == {row: repr(label) for row, label in alone.items()}
    assert drawn.successes is not None


def test_soft_pads_let_an_object_give_way(payload_of: MakePayload, grasps: dict[str, Any]) -> None:
    asked = Randomise.model_validate({**ONLY, "finger_compliance": 1.0, "draws": 6, "seed": 3})
    payload = payload_of("mug", poses=[grasps["rim"]], protocol="lift", randomise=asked)
    _, labels = simulated(payload)
    worlds = draws_of(payload, example("mug").parts)
    by_compliance = sorted(zip((w.compliance for w in worlds), labels.values(), strict=True))
    qualities = [label.quality for _, label in by_compliance]
    assert qualities == sorted(qualities, reverse=True)
    assert qualities[0] > qualities[-1]


# -- noise -------------------------------------------------------------------------------------------------


def test_noise_is_a_poses_own_whatever_comes_with_it() -> None:
    asked = Randomise(pose_noise_m=0.003, pose_noise_deg=5.0, seed=8)
    rng = np.random.default_rng(0)
    indices = rng.integers(0, 2**45, 4000)
    positions = rng.normal(size=(4000, 3))
    quaternions = Rotation.random(4000, random_state=rng).as_quat()
    where, turned = noisy(asked, 3, indices, positions, quaternions)
    some = rng.permutation(4000)[:37]
    for whole, part in zip(
        (where, turned), noisy(asked, 3, indices[some], positions[some], quaternions[some]), strict=True
    ):
        assert whole[some].tobytes() == part.tobytes()
    # Along and about the tool's own axes, as wide as asked.
    tool = Rotation.from_quat(quaternions)
    shift = tool.inv().apply(where - positions)
    turn = (tool.inv() * Rotation.from_quat(turned)).as_rotvec(degrees=True)
    assert shift.std(axis=0) == pytest.approx([0.003] * 3, rel=0.05)
    assert turn.std(axis=0) == pytest.approx([5.0] * 3, rel=0.05)
    assert np.abs(np.corrcoef(np.hstack([shift, turn]).T) - np.eye(6)).max() < 0.07
    again, _ = noisy(asked, 4, indices, positions, quaternions)
    assert np.abs(np.corrcoef((again - positions)[:, 0], (where - positions)[:, 0])[0, 1]) < 0.07


# -- chunks ------------------------------------------------------------------------------------------------


def simulated(payload: SimulatePayload) -> tuple[SimulateResult, dict[int, Label]]:
    """A chunk's result and its closings' labels, by number."""
    workpiece = chunks.prepare(payload, example(payload.object).parts)
    labels: dict[int, Label] = {}
    try:
        return chunks.simulate_chunk(payload, workpiece, after=labels.__setitem__), labels
    finally:
        workpiece.close()


def test_a_chunk_of_draws_is_the_same_however_it_is_cut(
    payload_of: MakePayload, physical_poses: FindPoses, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, poses = Randomise(draws=3, seed=2), physical_poses("mug", 60)
    payloads = [
        payload_of("mug", poses=poses[a:b], start=1_000 + a, randomise=asked)
        for a, b in ((0, 60), (0, 23), (23, 60))
    ]
    whole, labels = simulated(payloads[0])
    # Worlds that are not kept are built again, and the second chunk is simulated before the first.
    monkeypatch.setattr(chunks, "KEPT_WORLDS", 2)
    workpiece = chunks.prepare(payloads[0], example("mug").parts)
    second, first = (chunks.simulate_chunk(payload, workpiece) for payload in payloads[:0:-1])
    workpiece.close()
    assert whole.outcomes == first.outcomes + second.outcomes
    assert whole.successes is not None
    assert whole.successes == (first.successes or b"") + (second.successes or b"")
    for name in ("pose_index", "width_m", "quality"):
        assert getattr(whole.rows, name) == getattr(first.rows, name) + getattr(second.rows, name)
    # Closings that an earlier process made are not made again.
    some = dict(list(labels.items())[::2])
    workpiece = chunks.prepare(payloads[0], example("mug").parts)
    again: list[int] = []
    assert chunks.simulate_chunk(payloads[0], workpiece, known=some, before=again.append) == whole
    workpiece.close()
    assert again == list(labels)[1::2]

    found, k = (np.frombuffer(packed, np.uint8) for packed in (whole.outcomes, whole.successes))
    np.testing.assert_array_equal(found == Outcome.SUCCESS, 2 * k >= 3)
    rows = np.isin(1_000 + np.arange(60), whole.rows.pose_index)
    assert rows[k > 0].all()
    assert not rows[(found == Outcome.COLLISION) & (k == 0)].any()
    assert set(k.tolist()) >= {0, 1, 3}
    assert len({closing // 60 for closing in labels}) == 3
    assert Outcome.COLLISION in found


@given(
    st.lists(st.lists(st.sampled_from([1, 2, 3, 4, 8]), min_size=4, max_size=4), min_size=1, max_size=7).map(
        lambda draws: np.array(draws, dtype=np.uint8)
    )
)
def test_what_draws_come_to(outcomes: np.ndarray) -> None:
    for came, found in zip(outcomes.T.tolist(), majority(outcomes).tolist(), strict=True):
        failures = [code for code in came if code not in (Outcome.SUCCESS, Outcome.SIMULATION_ERROR)]
        if set(came) == {Outcome.SIMULATION_ERROR}:
            assert found == Outcome.SIMULATION_ERROR
        elif 2 * came.count(Outcome.SUCCESS) >= len(came):
            assert found == Outcome.SUCCESS
        elif failures:
            assert found == min(failures, key=lambda code: (-failures.count(code), code))
        else:
            assert found == Outcome.FAILURE


# -- looking again -----------------------------------------------------------------------------------------


def test_successes_of_a_sweep_are_verified(payload_of: MakePayload) -> None:
    payload = payload_of("mug", stop=250, randomise=Randomise(draws=3))
    result, _ = simulated(payload)
    outcomes = np.frombuffer(result.outcomes, np.uint8)
    assert result.successes is not None
    kept = outcomes != Outcome.COLLISION
    counts = {int(kind): int((outcomes == kind).sum()) for kind in np.unique(outcomes[kept])}
    poses = [column[kept] for column in chunks.poses_of(payload)]
    k = np.frombuffer(result.successes, np.uint8)[kept].astype(float)
    seen: list[tuple[int, int]] = []
    parts = example("mug").parts
    stored = StoredOutcomes(poses[0], poses[1], poses[2], outcomes[kept], k, counts)
    found = agreement.verify_stored(
        payload, parts, stored, count=10, progress=lambda *told: seen.append(told)
    )
    assert seen[-1][0] == seen[-1][1] > found.checked
    assert found.agreement > 0.7
    assert found.successes_apart is not None
    assert found.successes_apart < 0.2
    assert "drawn again" in found.summary("mug")
    lie = StoredOutcomes(poses[0], poses[1], poses[2], outcomes[kept], 3.0 - k, counts)
    told = agreement.verify_stored(payload, parts, lie, count=10).successes_apart
    assert told is not None
    assert told > found.successes_apart
