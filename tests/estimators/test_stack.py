"""What is learned of attempts: right where it says so, gated where it can't be, kept as it was."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import expit

from graspdb_density import IsotropicKernel, SuccessModel, se3, validate_reach
from graspdb_density.se3 import Poses
from graspdb_density.success.calibration import brier_skill, expected_calibration_error
from graspdb_estimators import GraspFeatures, Stack, StackedModel, fit_stack
from graspdb_geometry.closing import ClosingGeometry
from graspdb_geometry.collision import box_part
from known_jaws import PG70

Floats = NDArray[np.float64]
KERNEL = IsotropicKernel(0.01, math.radians(15))


def bar() -> ClosingGeometry:
    """A bar along x, 20 mm wide and high and 140 mm long."""
    vertices, faces = box_part((0.07, 0.01, 0.01), (0, 0, 0), (0, 0, 0, 1))
    return ClosingGeometry(np.asarray(vertices)[np.asarray(faces)], np.zeros(3))


def attempts(count: int, seed: int) -> tuple[Poses, NDArray[np.bool_]]:
    """Grasps of the bar from above, that hold the likelier the nearer to its middle and the less turned."""
    rng = np.random.default_rng(seed)
    p = np.stack(
        [rng.uniform(-0.06, 0.06, count), rng.normal(0, 0.006, count), rng.uniform(0.002, 0.02, count)],
        axis=1,
    )
    turn = rng.normal(0, 0.4, count)
    down = np.array([1.0, 0, 0, 0])
    q = se3.multiply(
        np.stack([np.zeros(count), np.zeros(count), np.sin(turn / 2), np.cos(turn / 2)], axis=1), down
    )
    return Poses(p, se3.normalise(q)), rng.random(count) < truth(Poses(p, q))


def truth(poses: Poses) -> Floats:
    turned = np.abs(se3.to_matrix(poses.quaternions_xyzw)[:, 1, 1])
    x, _, z = poses.positions.T
    return np.asarray(expit(8.0 * (0.035 - np.abs(x)) / 0.01 - 60.0 * (1.0 - turned) - 250.0 * (z - 0.012)))


@pytest.fixture(scope="module")
def learned() -> tuple[SuccessModel, Stack, GraspFeatures]:
    poses, won = attempts(1_500, 0)
    model = SuccessModel.build(poses, won, kernel=KERNEL)
    features = GraspFeatures(bar(), PG70)
    stack = fit_stack(model, features, reach=validate_reach(model))
    assert stack is not None
    return model, stack, features


def test_it_predicts_what_it_has_not_seen_better_and_says_so(
    learned: tuple[SuccessModel, Stack, GraspFeatures],
) -> None:
    model, stack, features = learned
    poses, won = attempts(3_000, 1)
    stacked = StackedModel(model, stack, features)
    found = stacked.evaluate(poses)
    kernel = brier_skill(model.probability(poses), won)
    assert brier_skill(found.probability, won) > kernel + 0.05
    assert stack.left_out.verdict == "better"
    # What it says of itself is what it does, on harder questions: whole blocks are left out.
    assert stack.left_out.skills[0] == pytest.approx(brier_skill(found.probability, won), abs=0.08)
    assert expected_calibration_error(found.probability, won) < 0.05
    assert np.mean(np.abs(found.probability - truth(poses))) < 0.08


def test_intervals_hold_what_is_true(learned: tuple[SuccessModel, Stack, GraspFeatures]) -> None:
    model, stack, features = learned
    poses, _ = attempts(2_000, 2)
    found, p = StackedModel(model, stack, features).evaluate(poses, level=0.9), truth(poses)
    uncertain = (found.probability > 0.05) & (found.probability < 0.95)
    inside = (found.low <= p) & (p <= found.high)
    assert inside[uncertain].mean() > 0.8
    wider = StackedModel(model, stack, features).evaluate(poses, level=0.99)
    assert (wider.low <= found.low).all()
    assert (wider.high >= found.high).all()


def test_every_way_to_ask_says_the_same(learned: tuple[SuccessModel, Stack, GraspFeatures]) -> None:
    stacked = StackedModel(*learned)
    poses, _ = attempts(50, 3)
    found, nearest = stacked.evaluate_near(poses)
    probability, trials, again = stacked.without_interval(poses, everywhere=True)
    np.testing.assert_allclose(stacked.probability(poses), found.probability)
    np.testing.assert_allclose(probability, found.probability)
    np.testing.assert_allclose(trials, found.effective_trials)
    np.testing.assert_allclose(again.widths, nearest.widths)
    np.testing.assert_allclose(stacked.lower_end(poses), found.low)
    twins = Poses(poses.positions, se3.jaw_twin(poses.quaternions_xyzw))
    np.testing.assert_allclose(stacked.probability(twins), found.probability, atol=1e-6)
    # Where nothing near was tried, no more than what nothing tells.
    low = stacked.lower_end(poses, near=lambda nearest: np.zeros(len(nearest.position_m), dtype=np.bool_))
    assert (low <= stacked.untried_low(0.9)).all()


def test_it_is_kept_as_it_is(learned: tuple[SuccessModel, Stack, GraspFeatures]) -> None:
    model, stack, features = learned
    again = Stack.of_bytes(stack.to_bytes())
    poses, _ = attempts(100, 4)
    one, other = (StackedModel(model, each, features).evaluate(poses) for each in (stack, again))
    np.testing.assert_array_equal(one.probability, other.probability)
    np.testing.assert_array_equal(one.low, other.low)
    assert again.attempts == stack.attempts
    assert again.left_out.skills == stack.left_out.skills
    assert again.nbytes == stack.nbytes


def test_spoilt_bytes_are_refused(learned: tuple[SuccessModel, Stack, GraspFeatures]) -> None:
    content = learned[1].to_bytes()
    for spoilt in (b"", b"no archive", content[: len(content) // 2]):
        with pytest.raises(ValueError, match="stack"):
            Stack.of_bytes(spoilt)


def test_without_shapes_the_kernel_estimate_is_set_right() -> None:
    poses, won = attempts(3_000, 5)
    model = SuccessModel.build(poses, won, kernel=IsotropicKernel(0.015, math.radians(20)))
    stack = fit_stack(model, None, reach=validate_reach(model))
    assert stack is not None
    assert stack.trees is None
    asked, then = attempts(3_000, 6)
    plain, right = model.probability(asked), StackedModel(model, stack, None).probability(asked)
    assert brier_skill(right, then) > brier_skill(plain, then)
    assert expected_calibration_error(right, then) < expected_calibration_error(plain, then)
    # No order is turned round.
    assert (np.diff(right[np.argsort(plain)]) >= -1e-12).all()


@pytest.mark.parametrize("kind", ["few", "one outcome", "one place"])
def test_too_little_teaches_nothing(kind: str) -> None:
    poses, won = attempts(40 if kind == "few" else 300, 7)
    if kind == "one outcome":
        won = np.ones(300, dtype=np.bool_)
    if kind == "one place":
        poses = Poses(np.zeros((300, 3)), poses.quaternions_xyzw)
    model = SuccessModel.build(poses, won, kernel=KERNEL)
    assert fit_stack(model, GraspFeatures(bar(), PG70), reach=validate_reach(model)) is None


def test_noise_is_no_better() -> None:
    """Outcomes that nothing explains: what was learned is not used."""
    poses, _ = attempts(600, 8)
    won = np.random.default_rng(9).random(600) < 0.4
    model = SuccessModel.build(poses, won, kernel=KERNEL)
    stack = fit_stack(model, GraspFeatures(bar(), PG70), reach=validate_reach(model))
    assert stack is not None
    assert stack.left_out.skills[0] < 0.05
    # Of what the kernel estimate makes of noise it may be the better; it must not say that it knows.
    found = StackedModel(model, stack, GraspFeatures(bar(), PG70)).probability(attempts(500, 10)[0])
    assert np.abs(found - 0.4).mean() < 0.12


def test_shares_and_weights_count() -> None:
    """k of n and weights below 1 are learned from, by what they are worth."""
    poses, _ = attempts(800, 11)
    share = np.round(truth(poses) * 4) / 4
    weights = np.where(np.arange(800) % 2, 1.0, 0.5)
    model = SuccessModel.build(poses, share, kernel=KERNEL, weights=weights)
    stack = fit_stack(model, GraspFeatures(bar(), PG70), reach=validate_reach(model))
    assert stack is not None
    asked, _ = attempts(500, 12)
    found = StackedModel(model, stack, GraspFeatures(bar(), PG70)).probability(asked)
    assert np.abs(found - truth(asked)).mean() < 0.08


def test_no_pose_is_surer_than_the_surest_turn_out() -> None:
    """A robot drops a fifth of whatever it holds: no grasp is told to succeed much more often."""
    poses, won = attempts(1_500, 13)
    won &= np.random.default_rng(14).random(1_500) < 0.8
    model = SuccessModel.build(poses, won, kernel=KERNEL)
    features = GraspFeatures(bar(), PG70)
    stack = fit_stack(model, features, reach=validate_reach(model))
    assert stack is not None
    asked, _ = attempts(1_000, 15)
    found = StackedModel(model, stack, features).evaluate(asked)
    assert found.probability.max() < 0.9
    sure = truth(asked) > 0.99
    assert found.probability[sure].mean() == pytest.approx(0.8, abs=0.05)
    assert ((found.low < 0.8) & (found.high > 0.8))[sure].mean() > 0.9
