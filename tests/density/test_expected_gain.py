"""What a trial is worth to the best grasp: against integrals and decisions, and what must hold of any."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import beta

from graspdb_density import IsotropicKernel, SuccessModel, se3
from graspdb_density.se3 import Poses
from graspdb_density.success.expected_gain import Beliefs, expected_excess

KERNEL = IsotropicKernel(0.015, math.radians(15))
SHARES = st.floats(0.02, 0.98)


def line(*metres: float) -> Poses:
    """Grasps along x, turned alike."""
    p = np.zeros((len(metres), 3))
    p[:, 0] = metres
    return Poses(p, np.tile(se3.IDENTITY, (len(metres), 1)))


def beliefs(mean: list[float], trials: list[float], metres: list[float], comes: float = 1.0) -> Beliefs:
    count = len(mean)
    return Beliefs(line(*metres), np.array(mean), np.array(trials), np.full(count, comes))


@settings(deadline=None)
@given(mean=SHARES, trials=st.floats(0.0, 200.0), threshold=st.floats(0.0, 1.0))
def test_the_excess_is_the_integral_of_what_lies_above(mean: float, trials: float, threshold: float) -> None:
    found = expected_excess(np.array([mean]), np.array([trials]), np.array([threshold]))[0]
    told = beta(mean * (1 + trials), (1 - mean) * (1 + trials))
    # E max(theta - t, 0) is the integral of P(theta > x) from t on.
    assert found == pytest.approx(quad(told.sf, threshold, 1.0, limit=200)[0], abs=2e-6)


@settings(deadline=None)
@given(mean=SHARES, trials=st.floats(0.0, 100.0), threshold=SHARES, more=st.floats(0.1, 100.0))
def test_knowledge_is_worth_less_where_more_is_known(
    mean: float, trials: float, threshold: float, more: float
) -> None:
    few, many = expected_excess(np.full(2, mean), np.array([trials, trials + more]), np.full(2, threshold))
    assert few >= many - 1e-9
    assert many >= max(mean - threshold, 0.0) - 1e-9
    assert few <= mean + 1e-9


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_gain_is_what_the_better_choice_is_worth(seed: int) -> None:
    """Draws of all that may be true, each known in turn, against the best of what is believed."""
    rng = np.random.default_rng(seed)
    mean, trials, comes = rng.uniform(0.05, 0.95, 4), rng.uniform(0.0, 20.0, 4), rng.uniform(0.3, 1.0, 4)
    known = Beliefs(line(0.0, 0.1, 0.2, 0.3), mean, trials, comes)
    theta = rng.beta(mean * (1 + trials), (1 - mean) * (1 + trials), (20_000, 4)) * comes
    best = (mean * comes).max()
    np.testing.assert_allclose(known.gains(), np.maximum(theta - best, 0.0).mean(axis=0), atol=0.015)
    for answer in range(4):
        gains = known.gains(answer)
        taken = np.maximum(theta[:, answer], best).mean() - mean[answer] * comes[answer]
        assert gains[answer] == pytest.approx(taken, abs=0.015)
        np.testing.assert_array_equal(np.delete(gains, answer), np.delete(known.gains(), answer))


def test_what_is_told_to_be_the_best_is_tried_before_it_is_relied_on() -> None:
    known = beliefs([0.9, 0.4, 0.8], [10.0, 0.5, 3.0], [0.0, 0.2, 0.4])
    chosen = known.choose(3, SuccessModel(KERNEL), answer=1)
    assert chosen.rows[0] == 1
    assert chosen.gains[0] > 0.5
    # Once tried it is one grasp among others.
    assert chosen.gains[1] < 0.1
    assert 1 not in known.choose(1, SuccessModel(KERNEL)).rows


def test_a_batch_is_not_all_at_one_spot() -> None:
    """Ten equal neighbours and one far off that is a little less promising."""
    metres = [0.001 * i for i in range(10)] + [0.2]
    known = beliefs([0.8] * 10 + [0.79], [2.0] * 11, metres)
    chosen = known.choose(2, SuccessModel(KERNEL))
    assert chosen.rows[0] < 10
    assert chosen.rows[1] == 10
    # What is tried elsewhere is no reason against either.
    assert chosen.gains[1] == pytest.approx(known.gains()[10])


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 30))
def test_any_batch_is_worth_less_and_less(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    size = 20
    known = Beliefs(
        Poses(rng.normal(size=(size, 3)) * 0.03, se3.random_quaternions(size, rng)),
        rng.random(size),
        rng.random(size) * 5,
        rng.random(size),
    )
    chosen = known.choose(count, SuccessModel(KERNEL))
    assert (np.diff(chosen.gains) <= 1e-9).all()
    assert (chosen.gains >= 0.0).all()
    assert chosen.rows[0] == np.argmax(known.gains())


def test_grasps_that_collide_when_executed_are_worth_what_comes_to_them() -> None:
    known = Beliefs(line(0.0, 0.2), np.array([0.9, 0.9]), np.array([3.0, 3.0]), np.array([1.0, 0.5]))
    gains = known.gains()
    assert gains[0] > 10 * gains[1]
    assert known.expected[1] == pytest.approx(0.45)


@pytest.mark.parametrize(
    ("name", "value"), [("mean", 1.2), ("mean", -0.1), ("trials", math.nan), ("comes", 2.0)]
)
def test_beliefs_are_checked(name: str, value: float) -> None:
    columns = {"mean": np.full(2, 0.5), "trials": np.ones(2), "comes": np.ones(2)}
    columns[name] = np.full(2, value)
    with pytest.raises(ValueError, match=name):
        Beliefs(line(0.0, 0.1), **columns)


def test_attempts_count_by_their_kernels_and_fall_off_with_distance() -> None:
    tried = line(0.0, 0.0, 0.2)
    model = SuccessModel.build(tried, np.array([True, False, True]), kernel=KERNEL)
    won, total = model.counted(line(0.0, 0.015, 0.04, 0.1))
    at = np.exp(-0.5 * (np.array([0.0, 0.015, 0.04]) / 0.015) ** 2)
    np.testing.assert_allclose(total[:3], 2 * at, rtol=1e-4)
    np.testing.assert_allclose(won[:3], at, rtol=1e-4)
    assert total[3] < 1e-6
    np.testing.assert_allclose(model.nearness(line(0.0), line(0.0, 0.015)), [1.0, math.exp(-0.5)], rtol=1e-4)
    twin = Poses(np.zeros((1, 3)), se3.jaw_twin(se3.IDENTITY)[None])
    assert model.nearness(twin, line(0.0))[0] == pytest.approx(1.0, rel=1e-4)
    lopsided = SuccessModel.build(tried, np.array([True, False, True]), kernel=KERNEL, symmetric=False)
    assert lopsided.nearness(twin, line(0.0))[0] < 1e-6
    np.testing.assert_allclose(lopsided.counted(line(0.0))[1], [2.0], rtol=1e-4)
