"""Boosted trees of the logit of success, as plain arrays: fitted by scikit-learn, evaluated without it.

Plain arrays can be stored without trust in what unpickles them, are the same under every later version of
scikit-learn, and are evaluated beside other threads, a few poses as quickly as a search asks them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from graspdb_density.se3 import Floats

__all__ = ["BoostedTrees"]

#: Steps and the trees of many rows; few rows have fewer trees, of smaller leaves.
_RATE, _MOST_TREES, _LEAST_TREES, _LARGEST_LEAF, _SMALLEST_LEAF = 0.08, 200, 40, 20, 3
_LEAVES, _RIDGE = 31, 1.0
#: Share of the features that a split chooses from, and values of a feature that are told apart: no worse than
#: all, on the paper's objects, and faster.
_FEATURES_A_SPLIT, _BINS = 0.3, 63
_ARRAYS = ("feature", "threshold", "missing_left", "left", "right", "value", "roots", "baseline")


@dataclass(frozen=True, eq=False, slots=True)
class BoostedTrees:
    """Trees over F features.

    Attributes
    ----------
    feature : (N,) int32
        Which feature a node asks; -1 for a leaf.
    threshold : (N,)
        Values up to it go left.
    missing_left : (N,) bool
        Whether NaN goes left.
    left, right : (N,) int32
        Nodes that follow.
    value : (N,)
        What a leaf adds to the logit.
    roots : (T,) int32
    baseline : ()
        Logit without any tree.
    """

    feature: NDArray[np.int32]
    threshold: Floats
    missing_left: NDArray[np.bool_]
    left: NDArray[np.int32]
    right: NDArray[np.int32]
    value: Floats
    roots: NDArray[np.int32]
    baseline: Floats

    @classmethod
    def fit(
        cls,
        features: NDArray[np.floating],
        share: Floats,
        weight: Floats | None = None,
        *,
        monotonic: NDArray[np.int8] | None = None,
        seed: int = 0,
    ) -> BoostedTrees:
        """Trees for attempts, by the log loss.

        Parameters
        ----------
        features : (N, F)
            NaN where not known.
        share : (N,)
            By how much each succeeded: k of n count as k / n of a success and the rest of a failure.
        weight : (N,) or None
            As how much of an attempt each counts, positive; None: all alike, which takes a fifth of the time.
        monotonic : (F,) or None
            1 where the logit never falls with a feature, -1 where it never rises, else 0.
        """
        # Loading it takes a second, which a service that only answers does not need.
        from sklearn.ensemble import HistGradientBoostingClassifier

        won, lost = np.flatnonzero(share > 0.0), np.flatnonzero(share < 1.0)
        if not won.size or not lost.size:
            prior = np.average(share, weights=weight)
            return cls._constant(float(logit(np.clip(prior, 1e-3, 1.0 - 1e-3))))
        rows, worth = np.concatenate([won, lost]), None
        count = len(share)
        if weight is not None or len(rows) > count:
            each = np.ones(count) if weight is None else weight
            worth = np.concatenate([(each * share)[won], (each * (1.0 - share))[lost]])
            worth /= worth.mean()
        outcome = np.repeat([1, 0], [won.size, lost.size])
        fitted = HistGradientBoostingClassifier(
            max_iter=int(np.clip(count / 10, _LEAST_TREES, _MOST_TREES)),
            learning_rate=_RATE,
            max_leaf_nodes=_LEAVES,
            max_features=_FEATURES_A_SPLIT,
            max_bins=_BINS,
            min_samples_leaf=int(np.clip(count / 100, _SMALLEST_LEAF, _LARGEST_LEAF)),
            l2_regularization=_RIDGE,
            monotonic_cst=None if monotonic is None else monotonic.tolist(),
            early_stopping=False,
            random_state=seed,
        )
        with _one_thread():
            fitted.fit(features[rows], outcome, sample_weight=worth)
        return cls._of(fitted)

    @classmethod
    def _of(cls, fitted: Any) -> BoostedTrees:
        """The arrays of a fitted classifier of two classes."""
        trees = [stage[0].nodes for stage in fitted._predictors]
        sizes = np.array([len(nodes) for nodes in trees])
        roots = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        first = np.repeat(roots, sizes)
        nodes = np.concatenate(trees)
        leaf = nodes["is_leaf"].astype(np.bool_)
        return cls(
            np.where(leaf, -1, nodes["feature_idx"]).astype(np.int32),
            nodes["num_threshold"].astype(np.float64),
            nodes["missing_go_to_left"].astype(np.bool_),
            np.where(leaf, 0, nodes["left"] + first).astype(np.int32),
            np.where(leaf, 0, nodes["right"] + first).astype(np.int32),
            nodes["value"].astype(np.float64),
            roots.astype(np.int32),
            np.asarray(fitted._baseline_prediction, dtype=np.float64).reshape(()),
        )

    @classmethod
    def _constant(cls, value: float) -> BoostedTrees:
        empty = np.empty(0)
        whole = empty.astype(np.int32)
        return cls(whole, empty, empty.astype(np.bool_), whole, whole, empty, whole, np.array(value))

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, Any]) -> BoostedTrees:
        """The trees that :attr:`arrays` are of."""
        return cls(*(np.asarray(arrays[name]) for name in _ARRAYS))

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """All there is of them, by name."""
        return {name: getattr(self, name) for name in _ARRAYS}

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays held."""
        return sum(array.nbytes for array in self.arrays.values())

    def logit(self, features: NDArray[np.floating]) -> Floats:
        """Logit of success (n,) of features (n, F)."""
        out = np.full(len(features), float(self.baseline))
        _add_leaves(
            np.ascontiguousarray(features, dtype=np.float64),
            self.feature, self.threshold, self.missing_left, self.left, self.right, self.value, self.roots,
            out,
        )  # fmt: skip
        return out


def _one_thread() -> Any:
    """One thread of OpenMP's: the service's threads share the processors themselves, and OpenMP's would spin
    while they wait for each other.
    """
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1, user_api="openmp")


@nb.njit(cache=True, nogil=True)
def _add_leaves(
    features: Floats,
    feature: NDArray[np.int32],
    threshold: Floats,
    missing_left: NDArray[np.bool_],
    left: NDArray[np.int32],
    right: NDArray[np.int32],
    value: Floats,
    roots: NDArray[np.int32],
    out: Floats,
) -> None:
    """Add to out (n,) what every tree says of features (n, F)."""
    # Tree by tree: its nodes stay in the processor's cache for all rows.
    for root in roots:
        for i in range(features.shape[0]):
            node = root
            asked = feature[node]
            while asked >= 0:
                x = features[i, asked]
                goes_left = missing_left[node] if np.isnan(x) else x <= threshold[node]
                node = left[node] if goes_left else right[node]
                asked = feature[node]
            out[i] += value[node]
