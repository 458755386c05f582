"""Promises are judged an answer at a time, and their intervals hold what they say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspdb_density.success.promises import judge_promises


@given(
    st.lists(
        st.tuples(st.floats(0, 1), st.booleans(), st.integers(0, 5), st.floats(0, 0.3)),
        min_size=1,
        max_size=40,
    )
)
def test_what_always_holds(rows: list[tuple[float, bool, int, float]]) -> None:
    promised, happened, answer, errors = zip(*rows, strict=True)
    found = judge_promises(promised, happened, answer, errors)
    assert found.answers == len(set(answer))
    assert found.trials == len(rows) == sum(item.trials for item in found.bins)
    assert found.answers == sum(item.answers for item in found.bins)
    assert 0 <= found.low <= found.happened <= found.high <= 1
    assert 0 <= found.brier <= 1
    assert found.selection >= 0
    for item in found.bins:
        if item.answers:
            assert item.lower - 1e-9 <= item.promised <= item.upper + 1e-9
            assert item.low <= item.happened <= item.high
        else:
            assert np.isnan([item.promised, item.happened, item.low, item.high]).all()
    # The order of trials tells nothing, nor what answers are called.
    again = judge_promises(promised[::-1], happened[::-1], [7 - a for a in answer[::-1]], errors[::-1])
    assert (again.promised, again.happened) == pytest.approx((found.promised, found.happened))


def test_many_trials_of_one_answer_are_one() -> None:
    once = judge_promises([0.8, 0.6], [True, False], [0, 1], [0.1, 0.1])
    often = judge_promises([0.8] * 50 + [0.6], [True] * 50 + [False], [0] * 50 + [1], [0.1] * 51)
    assert (often.answers, often.trials) == (2, 51)
    assert (often.promised, often.happened, often.low, often.high, often.brier) == pytest.approx(
        (once.promised, once.happened, once.low, once.high, once.brier)
    )


def test_the_interval_covers_whatever_answers_share() -> None:
    """Of answers that hold or fail as a whole, and of such whose trials are independent."""
    rng = np.random.default_rng(0)
    for alike in (True, False):
        for count in (10, 40):
            covered = 0
            for _ in range(300):
                truth = rng.uniform(0.5, 0.95, count)
                repeats = rng.integers(1, 6, count)
                answer = np.repeat(np.arange(count), repeats)
                luck = rng.random(count)[answer] if alike else rng.random(len(answer))
                found = judge_promises(truth[answer], luck < truth[answer], answer, np.full(len(answer), 0.1))
                # The promise is right: no difference is found.
                covered += found.low - found.promised <= 0 <= found.high - found.promised
            assert covered >= 0.87 * 300


def test_the_highest_of_right_estimates_promises_too_much_and_no_more_than_is_told() -> None:
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.5, 0.8, (400, 30))
    estimate = np.clip(truth + 0.08 * rng.standard_normal(truth.shape), 0, 1)
    best = estimate.argmax(axis=1)
    rows = np.arange(400)
    held = rng.random(400) < truth[rows, best]
    found = judge_promises(estimate[rows, best], held, rows, np.full(400, 0.08))
    assert found.high < found.promised
    assert found.high >= found.promised - found.selection


def test_a_sharp_promise_has_skill_and_a_flat_one_none() -> None:
    rng = np.random.default_rng(2)
    truth = np.where(rng.random(300) < 0.5, 0.95, 0.1)
    held = rng.random(300) < truth
    sharp = judge_promises(truth, held, np.arange(300), np.full(300, np.nan))
    assert sharp.skill_low > 0.4
    assert sharp.selection == 0
    flat = judge_promises(np.full(300, 0.9), held, np.arange(300), np.full(300, 0.05))
    assert flat.skill_high < 0
    assert np.isnan(judge_promises([0.9], [True], [0], [0.1]).skill)


def test_what_is_no_promise_is_refused() -> None:
    for promised, happened in (([], []), ([1.2], [True]), ([np.nan], [True]), ([0.5, 0.5], [True])):
        with pytest.raises(ValueError, match="promise"):
            judge_promises(promised, happened, np.arange(len(promised)), np.zeros(len(promised)))
