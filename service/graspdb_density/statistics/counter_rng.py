"""Random numbers that stay with the row or point they belong to, however many there come to be.

What is drawn is a function of a seed, a group and the number of the row or point, made in blocks: so what
was computed with them holds when rows are added, in another process, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels.gaussian_mixture import Kernel
from ..se3 import Poses

__all__ = ["CounterRng"]

#: Rows and points whose random numbers are made together.
_ROW_BLOCK, _POINT_BLOCK = 1_024, 256


def _poisson_table() -> NDArray[np.uint8]:
    """Counts of a Poisson distribution of mean 1 for every 16-bit number, probabilities within 2^-17."""
    terms = [math.exp(-1.0) / math.factorial(k) for k in range(9)]
    edges = np.round(np.cumsum(terms) * 65_536.0)
    return np.searchsorted(edges, np.arange(65_536), side="right").astype(np.uint8)


_POISSON = _poisson_table()


@dataclass(frozen=True, slots=True)
class CounterRng:
    """Draws of a seed; groups are independent of each other."""

    seed: int

    def offset(self, group: int) -> float:
        """Where a group's systematic draws begin, in steps: in [0, 1)."""
        return float(np.random.default_rng((self.seed, group)).random())

    def counts(self, group: int, begin: int, end: int, replicates: int) -> NDArray[np.uint8]:
        """Bootstrap counts (end - begin, replicates) of rows, Poisson of mean 1."""
        (key,) = np.random.SeedSequence(self.seed).generate_state(1, np.uint64)
        lanes = -(-replicates // 4)
        first = begin // _ROW_BLOCK
        parts = []
        for block in range(first, -(-end // _ROW_BLOCK)):
            stream = np.random.Philox(key=np.array([key, group << 40 | block], dtype=np.uint64))
            raw = np.asarray(stream.random_raw(_ROW_BLOCK * lanes), dtype=np.uint64)
            parts.append(_POISSON[raw.view(np.uint16).reshape(_ROW_BLOCK, -1)[:, :replicates]])
        skipped = first * _ROW_BLOCK
        return np.concatenate(parts)[begin - skipped : end - skipped]

    def displacements(
        self, kernel: Kernel, group: int, begin: int, end: int
    ) -> tuple[NDArray[np.bool_], Poses]:
        """Of points ``begin .. end``: whether from a row's twin, and displacements, as
        `KernelRows.displaced` takes them.
        """
        first = begin // _POINT_BLOCK
        twins, moves = [], []
        for block in range(first, -(-end // _POINT_BLOCK)):
            rng = np.random.default_rng((self.seed, group, block))
            twins.append(rng.random(_POINT_BLOCK) < 0.5)
            moves.append(kernel.sample_displacements(_POINT_BLOCK, rng))
        chosen = slice(begin - first * _POINT_BLOCK, end - first * _POINT_BLOCK)
        return np.concatenate(twins)[chosen], Poses.concatenate(moves)[chosen]
