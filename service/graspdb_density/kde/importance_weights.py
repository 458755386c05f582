"""Weights that undo how trials were chosen (eq 1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..se3 import Floats

__all__ = [
    "LOW_EFFECTIVE_SHARE",
    "effective_sample_size",
    "importance_weights",
    "pooled_density",
]

#: Below this share of the rows, an effective sample size deserves a warning.
LOW_EFFECTIVE_SHARE = 0.1


def importance_weights(proposal_density: ArrayLike) -> Floats:
    """Weights ``1 / g(x_i)``, summing to 1, of trials each drawn with its own proposal density.

    A trial without a proposal density takes the mean weight of those that have one; where none has, all are
    equal.

    Parameters
    ----------
    proposal_density : (N,) 1/(m^3 rad^3), nan or None where unknown

    Raises
    ------
    ValueError
        For densities that are negative, zero or infinite.
    """
    g = np.array(proposal_density, dtype=np.float64)
    if g.ndim != 1:
        raise ValueError(f"proposal_density has shape (N,), not {g.shape}")
    known: NDArray[np.bool_] = ~np.isnan(g)
    values = g[known]
    if not (np.isfinite(values).all() and (values > 0.0).all()):
        raise ValueError("proposal densities must be positive and finite")
    weights = np.ones(len(g))
    if known.any():
        # Scaled by the smallest density first: reciprocals of tiny ones would overflow.
        weights[known] = values.min() / values
        weights[~known] = weights[known].mean()
    return np.asarray(weights / weights.sum(), dtype=np.float64)


def pooled_density(densities: ArrayLike, counts: ArrayLike) -> Floats:
    """What trials of several strategies were drawn with when seen as one: ``sum_k n_k g_k / sum_k n_k``.

    Its reciprocals ``1 / sum_k n_k g_k(x_i)`` are the balance heuristic, each strategy normalised to its own
    exposure: it never gives a trial the huge weight that ``1 / g_own`` gives one its own strategy nearly
    excluded but another covers. Their scale is that of ``1 / g``: so strategies that can be evaluated may be
    weighed, as one, beside trials that know their own density only.

    Parameters
    ----------
    densities : (N, K)
        g_k at every trial, 1/(m^3 rad^3), each integrating to 1; 0 where a strategy proposes nothing.
    counts : (K,)
        Trials each strategy drew, failures included; not all 0.

    Returns
    -------
    (N,) 1/(m^3 rad^3)

    Raises
    ------
    ValueError
        For wrong shapes, and values that are negative or not finite.
    """
    g = np.array(densities, dtype=np.float64)
    n = np.array(counts, dtype=np.float64)
    if g.ndim != 2 or n.shape != (g.shape[1],):
        raise ValueError(f"densities have shape (N, K) and counts (K,), not {g.shape} and {n.shape}")
    if not (np.isfinite(g).all() and (g >= 0.0).all() and np.isfinite(n).all() and (n >= 0.0).all()):
        raise ValueError("densities and counts must be finite and not negative")
    if not n.any():
        raise ValueError("at least one strategy must have drawn a trial")
    # Not a matrix product, whose rounding depends on how many rows there are.
    return np.asarray((g * (n / n.sum())).sum(axis=1), dtype=np.float64)


def effective_sample_size(weights: ArrayLike) -> float:
    """(sum w)^2 / sum w^2: the number of equal weights that would vary as much."""
    w = np.asarray(weights, dtype=np.float64)
    return float(w.sum() ** 2 / np.dot(w, w)) if w.size else 0.0
