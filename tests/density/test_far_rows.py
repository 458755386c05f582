"""A few rows far from all others, and no object's two ends."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from graspdb_density.statistics.far_rows import far_rows


@given(st.integers(3, 400), st.integers(0, 10_000), st.floats(5.0, 1e6))
@settings(max_examples=50, deadline=None)
def test_one_far_row_is_found_wherever_it_lies(count: int, seed: int, times: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (count, 3))
    row = int(rng.integers(count))
    points[row] = 0.0
    points[row, rng.integers(3)] = 2.0 * times * rng.choice([-1.0, 1.0])
    expected = np.arange(count) == row
    np.testing.assert_array_equal(far_rows(points, least=0.0), expected)
    # Moved and scaled it is the same; where all may be that far away there is none.
    np.testing.assert_array_equal(far_rows(1e-3 * points + [7.0, -2.0, 0.0], least=0.0), expected)
    assert not far_rows(points, least=times).any()


@given(st.integers(0, 300), st.integers(0, 10_000))
@settings(max_examples=50, deadline=None)
def test_what_is_spread_or_has_two_ends_is_not_far(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (count, 2))
    assert not far_rows(points, least=0.0).any() or count < 20
    assert not far_rows(np.zeros((count, 2)), least=0.0).any()
    ends = points + np.where(np.arange(count) % 20 == 0, 1e3, 0.0)[:, None]
    # One of twenty at the other end of something long.
    assert not far_rows(ends, least=0.0).any() or count < 60


def test_at_most_a_few_are() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 2))
    points[:10] = [[50.0, 0.0], [1e4, 3.0]] * 5
    assert far_rows(points, least=0.0).sum() == 10
    points[:11] = [1e3, 0.0]
    assert not far_rows(points, least=0.0).any()
