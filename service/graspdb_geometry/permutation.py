"""A seeded permutation of 0..n-1 with random access, made of integer arithmetic only.

A sweep's random subsample must mean the same poses for ever and in every process, so it can't rest on a
library's generator, whose stream may change.  A Feistel network with a keyed mixing function permutes
[0, 4^h) for the smallest h with 4^h >= n; values that fall outside [0, n) are mapped again until they fall
inside ("cycle walking", Black and Rogaway, "Ciphers with arbitrary finite domains", CT-RSA 2002), which
keeps it a bijection and takes fewer than four rounds on average.  The mixing function is the finaliser of
SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_MASK = (1 << 64) - 1
_GOLDEN = 0x9E3779B97F4A7C15
_MIX_1 = 0xBF58476D1CE4E5B9
_MIX_2 = 0x94D049BB133111EB
_ROUNDS = 8


class SeededPermutation:
    """The permutation of [0, size) that belongs to a seed.

    Parameters
    ----------
    size : int
        At least 1, at most 2^62.
    seed : int
        In [0, 2^63).
    """

    def __init__(self, size: int, seed: int) -> None:
        if not 1 <= size <= 2**62:
            raise ValueError("size must lie in [1, 2^62]")
        if not 0 <= seed < 2**63:
            raise ValueError("seed must lie in [0, 2^63)")
        self.size = size
        self.seed = seed
        self._half_bits = max(1, ((size - 1).bit_length() + 1) // 2)
        # Size enters the keys, so that two grids with one seed draw unrelated samples.
        state = _mix((seed * _GOLDEN + size) & _MASK)
        keys = []
        for _ in range(_ROUNDS):
            state = (state + _GOLDEN) & _MASK
            keys.append(_mix(state))
        self._keys = np.array(keys, dtype=np.uint64)

    def __call__(self, ranks: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Images of the given ranks.

        Parameters
        ----------
        ranks : (n,) int
            In [0, size).

        Returns
        -------
        (n,) int64
            Different for different ranks, in [0, size).
        """
        rank = np.asarray(ranks, dtype=np.int64)
        if rank.size and (int(rank.min()) < 0 or int(rank.max()) >= self.size):
            raise ValueError(f"ranks must lie in [0, {self.size})")
        image = self._feistel(rank.astype(np.uint64))
        limit = np.uint64(self.size)
        outside = np.flatnonzero(image >= limit)
        while outside.size:
            image[outside] = self._feistel(image[outside])
            outside = outside[image[outside] >= limit]
        return image.astype(np.int64)

    def _feistel(self, value: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
        bits = np.uint64(self._half_bits)
        mask = np.uint64((1 << self._half_bits) - 1)
        left, right = value >> bits, value & mask
        for key in self._keys:
            left, right = right, left ^ (_mix_array(right + key) & mask)
        result: npt.NDArray[np.uint64] = (left << bits) | right
        return result


def _mix(value: int) -> int:
    value = ((value ^ (value >> 30)) * _MIX_1) & _MASK
    value = ((value ^ (value >> 27)) * _MIX_2) & _MASK
    return value ^ (value >> 31)


def _mix_array(value: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    # Unsigned array arithmetic wraps modulo 2^64 by definition.
    value = (value ^ (value >> np.uint64(30))) * np.uint64(_MIX_1)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(_MIX_2)
    result: npt.NDArray[np.uint64] = value ^ (value >> np.uint64(31))
    return result
