"""How far success probabilities reach: nearest attempts by brute force, reach on truths that are known."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from graspdb_density import DiagonalKernel, IsotropicKernel, Reach, SuccessModel, se3, validate_reach
from graspdb_density.se3 import Poses
from graspdb_density.success.kernel_regression import NearestAttempts, SuccessKernel

Truth = Callable[[Poses], se3.Floats]

ISOTROPIC = IsotropicKernel(0.015, math.radians(15.0))
DIAGONAL = DiagonalKernel.of([0.006, 0.028, 0.007, 0.2, 0.3, 0.15])
ALONG = DiagonalKernel.of(
    [0.006, 0.028, 0.007, 0.2, 0.3, 0.15], se3.to_matrix(se3.from_rotation_vector([0.3, -0.5, 0.9]))
)


def scattered(count: int, rng: np.random.Generator, size: float = 0.06, turn: float = 0.8) -> Poses:
    """Poses uniform in a cube, and in rotation vectors of a cube."""
    positions = rng.uniform(-size, size, (count, 3))
    return Poses(positions, se3.from_rotation_vector(rng.uniform(-turn, turn, (count, 3))))


def by_definition(kernel: SuccessKernel, rows: Poses, twins: NDArray[np.bool_], poses: Poses) -> se3.Floats:
    """Distances (M, N, 2) of position and rotation in widths, of the nearer twin."""
    shift = poses.positions[:, None] - rows.positions
    turns = [
        se3.to_rotation_vector(se3.multiply(se3.conjugate(q), poses.quaternions_xyzw[:, None]))
        for q in (rows.quaternions_xyzw, se3.jaw_twin(rows.quaternions_xyzw))
    ]
    if isinstance(kernel, IsotropicKernel):
        position = np.linalg.norm(shift, axis=2) / kernel.sigma_position_m
        both = [np.linalg.norm(turn, axis=2) / kernel.sigma_rotation for turn in turns]
    else:
        if kernel.axes is None:
            shift = se3.rotate(se3.conjugate(rows.quaternions_xyzw)[None], shift)
        else:
            shift = shift @ np.reshape(kernel.axes, (3, 3))
        position = np.linalg.norm(shift / np.array(kernel.sigmas[:3]), axis=2)
        both = [np.linalg.norm(turn / np.array(kernel.sigmas[3:]), axis=2) for turn in turns]
    rotation = np.where(twins, np.minimum(*both), both[0])
    return np.stack([position, rotation], axis=2)


@pytest.mark.parametrize("kernel", [ISOTROPIC, DIAGONAL, ALONG], ids=["isotropic", "diagonal", "along axes"])
@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 60), turn=st.sampled_from([0.1, 0.8, 1.8]))
def test_the_nearest_attempt_is_that_of_brute_force(
    kernel: SuccessKernel, seed: int, count: int, turn: float
) -> None:
    """Near, at the fringes, beyond every cut-off, and turned away from everything."""
    rng = np.random.default_rng(seed)
    rows, won, twins = scattered(count, rng), rng.random(count) < 0.4, rng.random(count) < 0.5
    near, fringe = scattered(20, rng, turn=turn), scattered(20, rng, size=0.3, turn=turn)
    far = Poses(fringe.positions[:5] + np.array([3.0, -40.0, 900.0]), fringe.quaternions_xyzw[:5])
    poses = Poses.concatenate([near, fringe, far, rows[:5]])
    found = SuccessModel.build(rows, won, kernel=kernel, symmetric=twins).evaluate_near(poses)[1]
    apart = by_definition(kernel, rows, twins, poses)
    together = np.linalg.norm(apart, axis=2)
    # The isotropic kernel measures large angles a little shorter than they are.
    np.testing.assert_allclose(found.widths, together.min(axis=1), rtol=0.11, atol=2e-3)
    chosen = np.argmin(np.abs(together - found.widths[:, None]), axis=1)
    rows_of = np.arange(len(poses))
    np.testing.assert_allclose(found.position_widths, apart[rows_of, chosen, 0], rtol=1e-3, atol=2e-3)
    np.testing.assert_allclose(found.rotation_widths, apart[rows_of, chosen, 1], rtol=1e-3, atol=2e-3)
    if isinstance(kernel, IsotropicKernel):
        metres, radians = found.position_m, found.rotation
        np.testing.assert_allclose(metres, found.position_widths * kernel.sigma_position_m)
        np.testing.assert_allclose(radians, found.rotation_widths * kernel.sigma_rotation)


def test_an_extended_model_finds_the_same_as_a_built_one() -> None:
    rng = np.random.default_rng(4)
    rows, won = scattered(3_000, rng), rng.random(3_000) < 0.3
    poses = scattered(2_000, rng, size=0.2)
    built = SuccessModel.build(rows, won, kernel=ISOTROPIC)
    grown = SuccessModel.build(rows[:100], won[:100], kernel=ISOTROPIC)
    for part in (slice(100, 150), slice(150, 3_000)):
        grown = grown.extend(rows[part], won[part])
    one, other = (model.evaluate_near(poses, threads=2)[1] for model in (built, grown))
    np.testing.assert_allclose(one.widths, other.widths, atol=1e-3)
    # Among the attempts no farther one is looked for, unless asked.
    trials, near = built.evaluate(poses).effective_trials, built.without_interval(poses)[2]
    assert np.isinf(near.widths[trials == 0.0]).all()
    np.testing.assert_allclose(near.widths[trials > 0.0], one.widths[trials > 0.0])
    first, second = validate_reach(built), validate_reach(grown)
    assert (first.position, first.rotation) == pytest.approx((second.position, second.rotation), abs=1e-3)


def wave(scale_m: float) -> Truth:
    """A truth that changes along x over so many metres, and not with rotation."""
    return lambda poses: 0.5 + 0.5 * np.sin(poses.positions[:, 0] / scale_m)


def tilted(scale: float) -> Truth:
    """A truth that changes with the turn about x over so many radians, and not with position."""
    return lambda poses: 0.5 + 0.5 * np.sin(se3.to_rotation_vector(poses.quaternions_xyzw)[:, 0] / scale)


def reach_of(truth: Truth, count: int, seed: int, turn: float = 0.8, **more: float) -> Reach:
    rng = np.random.default_rng(seed)
    rows = scattered(count, rng, turn=turn, **more)
    won = rng.random(count) < truth(rows)
    return validate_reach(SuccessModel.build(rows, won, kernel=ISOTROPIC))


def test_random_labels_have_no_reach() -> None:
    """No distance is validated but by the chance that the test allows."""
    found = [reach_of(lambda poses: np.full(len(poses), 0.4), 1_500, seed) for seed in range(20)]
    validated = [max(item.validated_position or 0.0, item.validated_rotation or 0.0) for item in found]
    assert sum(value > 0.0 for value in validated) <= 4
    assert all(item.position <= 1.0 and item.rotation <= 1.0 for item in found if not item.validated_position)


def test_a_smooth_truth_reaches_farther_than_a_rough_one() -> None:
    smooth, rough = (
        np.mean([reach_of(wave(scale), 4_000, seed).position for seed in range(3)]) for scale in (0.04, 0.012)
    )
    assert smooth >= rough + 0.5
    assert smooth >= 2.0


def test_position_and_rotation_are_judged_apart() -> None:
    """What changes fast with rotation and not with position is told far along the one and not the other."""
    found = reach_of(tilted(0.5), 4_000, 0)
    assert found.validated_position is not None
    assert found.validated_rotation is not None
    assert found.position >= found.rotation + 1.0


def test_within_reach_predictions_of_fresh_poses_beat_the_share() -> None:
    """Poses beside what was tried: up to the reach they are predicted better than by the share alone."""
    truth, gains = wave(0.03), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        rows = scattered(3_000, rng)
        rows = rows[rows.positions[:, 1] < 0.0]
        model = SuccessModel.build(rows, rng.random(len(rows)) < truth(rows), kernel=ISOTROPIC)
        reach = validate_reach(model)
        beside = scattered(4_000, rng)
        beside = beside[beside.positions[:, 1] > 0.0]
        found, told = model.evaluate(beside), reach.covers(model.evaluate_near(beside)[1])
        assert 0.02 < told.mean() < 0.98
        likely = truth(beside)[told]
        gains.append(np.mean((model.prior_share - likely) ** 2 - (found.probability[told] - likely) ** 2))
    assert np.mean(gains) > 0.0


def test_few_attempts_reach_as_far_as_they_lie_apart() -> None:
    rng = np.random.default_rng(0)
    few = scattered(6, rng)
    found = validate_reach(SuccessModel.build(few, np.arange(6) < 3, kernel=ISOTROPIC))
    assert (found.validated_position, found.validated_rotation) == (None, None)
    assert 0.2 <= found.position <= 1.0
    assert 0.2 <= found.rotation <= 1.0
    # One pose tried again and again, and one that stands alone.
    same = Poses(np.zeros((25, 3)), np.tile(se3.IDENTITY, (25, 1)))
    for count in (25, 1):
        taught = SuccessModel.build(same[:count], np.arange(count) < 20, kernel=ISOTROPIC)
        found = validate_reach(taught)
        assert found.validated_position is None
        near = taught.evaluate_near(same[:1])[1]
        assert found.covers(near).all()
        away = Poses(np.array([[0.02, 0.0, 0.0]]), se3.IDENTITY[None])
        beyond = taught.evaluate_near(away)[1]
        assert not found.covers(beyond).any()


def test_what_was_tried_in_one_orientation_tells_of_no_other() -> None:
    rng = np.random.default_rng(1)
    rows = Poses(rng.uniform(-0.06, 0.06, (2_000, 3)), np.tile(se3.IDENTITY, (2_000, 1)))
    model = SuccessModel.build(rows, rng.random(2_000) < wave(0.03)(rows), kernel=ISOTROPIC)
    found = validate_reach(model)
    assert found.position >= 1.0
    assert found.rotation <= 1.0
    turned = Poses(rows.positions[:5], np.tile(se3.from_rotation_vector([0.0, 0.5, 0.0]), (5, 1)))
    near = model.evaluate_near(turned)[1]
    assert not found.covers(near).any()


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("kernel", [ISOTROPIC, DIAGONAL, ALONG], ids=["isotropic", "diagonal", "along axes"])
def test_turns_about_one_axis_tell_nothing_of_the_others(kernel: SuccessKernel, axis: int) -> None:
    """A jaw that went round a bottle, at many heights, and was never tilted."""
    rng = np.random.default_rng(7)
    unit = np.eye(3)[axis]
    angle, height = rng.uniform(-1.2, 1.2, 2_000), rng.uniform(-0.3, 0.3, 2_000)
    rows = Poses(height[:, None] * unit, se3.from_rotation_vector(angle[:, None] * unit))
    won = np.sin(height / 0.06) > 0.0
    model = SuccessModel.build(rows, won, kernel=kernel, symmetric=False)
    found = validate_reach(model)

    def told(turn: list[float], shift: float = 0.0) -> bool:
        at = Poses(0.1 * unit[None] + shift * np.roll(unit, 1), se3.from_rotation_vector(np.array([turn])))
        return bool(found.covers(model.evaluate_near(at)[1])[0])

    width = math.radians(15.0) if kernel is ISOTROPIC else kernel.sigmas[3 + axis]
    assert told((1.2 * unit).tolist())
    assert told(((1.2 + 1.5 * width) * unit).tolist())
    assert not told((0.6 * np.roll(unit, 1)).tolist())
    assert not told((0.6 * np.roll(unit, 2)).tolist())
    assert not told([0.0, 0.0, 0.0], shift=0.04)


def test_where_all_was_tried_no_axis_stands_out() -> None:
    found = reach_of(wave(0.04), 4_000, 0, turn=1.5)
    assert min(found.along[:3]) >= found.position * ISOTROPIC.sigma_position_m
    assert min(found.along[3:]) >= 0.6 * found.rotation * ISOTROPIC.sigma_rotation


def test_all_alike_or_nothing() -> None:
    rng = np.random.default_rng(2)
    rows = scattered(500, rng)
    for won in (np.ones(500, dtype=bool), np.zeros(500, dtype=bool)):
        found = validate_reach(SuccessModel.build(rows, won, kernel=ISOTROPIC))
        assert not found.validated_position
        assert found.attempts == 500
    with pytest.raises(ValueError, match="at least one attempt"):
        validate_reach(SuccessModel(ISOTROPIC))


def test_both_limits_hold() -> None:
    reach = Reach(2.0, 1.0, 2.0, 1.0, 100)
    position, rotation = np.array([1.9, 2.1, 0.0, np.inf]), np.array([0.9, 0.0, 1.1, np.inf])
    near = NearestAttempts(position, rotation, position, rotation)
    assert reach.covers(near).tolist() == [True, False, False, False]
