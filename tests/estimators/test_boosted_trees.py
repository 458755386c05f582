"""Trees as arrays: what scikit-learn fitted, kept and evaluated without it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier

from graspdb_estimators import BoostedTrees

Floats = NDArray[np.float64]


def problem(count: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Features with unknown ones among them, and outcomes."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, 6))
    won = x[:, 0] + x[:, 1] ** 2 + rng.normal(0, 0.5, count) > 0.7
    x[rng.random(x.shape) < 0.1] = np.nan
    return x, won.astype(np.float64)


def test_they_say_what_scikit_learn_says() -> None:
    x, won = problem(800)
    fitted = HistGradientBoostingClassifier(max_iter=30, random_state=0).fit(x, won)
    asked = np.vstack([x, np.full((1, 6), np.nan)])
    np.testing.assert_allclose(BoostedTrees._of(fitted).logit(asked), fitted.decision_function(asked))


def test_they_are_all_in_their_arrays() -> None:
    x, won = problem(300)
    trees = BoostedTrees.fit(x, won)
    again = BoostedTrees.of_arrays({name: array.copy() for name, array in trees.arrays.items()})
    np.testing.assert_array_equal(again.logit(x), trees.logit(x))
    assert trees.nbytes == sum(array.nbytes for array in trees.arrays.values())


def test_they_never_fall_where_they_must_not() -> None:
    x, won = problem(2_000)
    trees = BoostedTrees.fit(x, won, monotonic=np.array([1, 0, 0, 0, 0, 0], dtype=np.int8))
    along = np.tile(x[:1], (50, 1))
    along[:, 0] = np.linspace(-3, 3, 50)
    assert (np.diff(trees.logit(along)) >= 0).all()


def test_k_of_n_are_as_many_rows() -> None:
    x, won = problem(200)
    share = np.where(won > 0, 0.75, 0.25)
    counted = BoostedTrees.fit(
        np.repeat(x, 4, axis=0),
        np.concatenate([[s >= q for q in (0.25, 0.5, 0.75, 1.0)] for s in share]).astype(float),
    )
    shares = BoostedTrees.fit(x, share)
    # Bins and leaves count rows otherwise; what is said is alike.
    assert np.corrcoef(counted.logit(x), shares.logit(x))[0, 1] > 0.9


def test_one_kind_of_outcome_is_said_everywhere() -> None:
    x, _ = problem(50)
    assert (BoostedTrees.fit(x, np.ones(50)).logit(x) > 5).all()
    assert (BoostedTrees.fit(x, np.zeros(50)).logit(x) < -5).all()


def test_weights_count_as_rows_do() -> None:
    x, won = problem(400)
    heavy = BoostedTrees.fit(x, won, np.where(won > 0, 3.0, 1.0))
    plain = BoostedTrees.fit(x, won)
    assert heavy.logit(x).mean() > plain.logit(x).mean()
