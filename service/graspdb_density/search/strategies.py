"""Evolution strategies that learn along which directions a score falls off slowly, many at once.

CMA-ES with weighted recombination, rank-one and rank-mu updates and cumulative step-size adaptation, with the
constants of Hansen, The CMA Evolution Strategy: A Tutorial (2016), table 1, positive weights only.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..se3 import Floats

__all__ = ["Strategies"]

Indices = NDArray[np.intp]


class Strategies:
    """K strategies in a space of six dimensions, each about the origin of its own, drawn from a fixed seed.

    Parameters
    ----------
    step : float
        The first standard deviation along every axis.
    population : int
        Poses that each tries in a generation.
    """

    def __init__(self, count: int, step: float, population: int) -> None:
        n, parents = 6, population // 2
        self.population = population
        self._rng = np.random.default_rng(0)
        weights = math.log(0.5 * (population + 1)) - np.log(np.arange(1, parents + 1))
        self._weights = weights / weights.sum()
        self._worth = worth = float(1.0 / np.sum(self._weights**2))
        self._path_rate = (4.0 + worth / n) / (n + 4.0 + 2.0 * worth / n)
        self._step_rate = (worth + 2.0) / (n + worth + 5.0)
        self._one_rate = 2.0 / ((n + 1.3) ** 2 + worth)
        rate = 2.0 * (worth - 2.0 + 1.0 / worth) / ((n + 2.0) ** 2 + worth)
        self._several_rate = min(1.0 - self._one_rate, rate)
        self._damping = 1.0 + 2.0 * max(0.0, math.sqrt((worth - 1.0) / (n + 1.0)) - 1.0) + self._step_rate
        self._length = math.sqrt(n) * (1.0 - 1.0 / (4.0 * n) + 1.0 / (21.0 * n * n))
        self._mean, self._path, self._step_path = np.zeros((3, count, n))
        self._covariance = np.tile(np.eye(n), (count, 1, 1))
        self._step = np.full(count, step)
        self._age = 0

    def ask(self, which: Indices) -> Floats:
        """What some of the strategies try next, (k, population, 6)."""
        values, axes = np.linalg.eigh(self._covariance[which])
        root = axes * np.sqrt(np.maximum(values, 1e-12))[:, None]
        drawn = self._rng.standard_normal((len(which), self.population, 6)) @ np.swapaxes(root, 1, 2)
        return np.asarray(self._mean[which, None] + self._step[which, None, None] * drawn)

    def tell(self, which: Indices, tried: Floats) -> None:
        """What they tried, each strategy's best first, (k, population, 6)."""
        step = self._step[which, None]
        moves = (tried[:, : len(self._weights)] - self._mean[which, None]) / step[:, None]
        move = np.einsum("m,kmi->ki", self._weights, moves)
        self._mean[which] += step * move
        values, axes = np.linalg.eigh(self._covariance[which])
        along = np.einsum("kji,kj->ki", axes, move) / np.sqrt(np.maximum(values, 1e-12))
        rate = self._step_rate
        path = (1.0 - rate) * self._step_path[which]
        path += math.sqrt(rate * (2.0 - rate) * self._worth) * np.einsum("kij,kj->ki", axes, along)
        self._step_path[which] = path
        length = np.linalg.norm(path, axis=1)
        self._age += 1
        usual = math.sqrt(1.0 - (1.0 - rate) ** (2 * self._age)) * (1.4 + 2.0 / 7.0) * self._length
        steady = (length < usual)[:, None]
        slow = self._path_rate
        self._path[which] *= 1.0 - slow
        self._path[which] += np.where(steady, math.sqrt(slow * (2.0 - slow) * self._worth), 0.0) * move
        one = np.einsum("ki,kj->kij", self._path[which], self._path[which])
        several = np.einsum("m,kmi,kmj->kij", self._weights, moves, moves)
        lost = np.where(steady, 0.0, slow * (2.0 - slow))[..., None]
        kept = 1.0 - self._one_rate * (1.0 - lost) - self._several_rate
        self._covariance[which] = (
            kept * self._covariance[which] + self._one_rate * one + self._several_rate * several
        )
        self._step[which] *= np.exp(np.minimum(1.0, rate / self._damping * (length / self._length - 1.0)))
