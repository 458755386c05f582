"""Numba kernel: a tree of bounding boxes over triangles, built without the interpreter."""

from __future__ import annotations

import numba as nb
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

#: Halving 2**60 triangles leaves two jobs a level.
_STACK = 64


@nb.njit(cache=True, nogil=True)
def _select(order: IntArray, keys: FloatArray, begin: int, end: int, place: int) -> None:
    """Permute order[begin:end] so that no key before ``place`` is greater than one from there on (Hoare,
    "Algorithm 65: find", CACM 4, 1961)."""
    first = begin
    last = end - 1
    while first < last:
        pivot = keys[order[(first + last) // 2]]
        i = first
        j = last
        while i <= j:
            while keys[order[i]] < pivot:
                i += 1
            while keys[order[j]] > pivot:
                j -= 1
            if i <= j:
                kept = order[i]
                order[i] = order[j]
                order[j] = kept
                i += 1
                j -= 1
        if place <= j:
            last = j
        elif place >= i:
            first = i
        else:
            return


@nb.njit(cache=True, nogil=True)
def build(corners: FloatArray, leaf: int) -> tuple[FloatArray, IntArray, IntArray]:
    """Halve triangles (F, 3, 3) at the median of the longest side of their boxes' centres, down to leaves of
    ``leaf`` at most: nodes and links as :data:`~graspdb_geometry._compiled.surface.Tree` has them, and the
    triangles' order (F,).
    """
    count = corners.shape[0]
    middles = np.empty((3, count))
    for f in range(count):
        for a in range(3):
            x, y, z = corners[f, 0, a], corners[f, 1, a], corners[f, 2, a]
            middles[a, f] = (min(x, y, z) + max(x, y, z)) / 2
    order = np.arange(count)
    nodes = np.empty((count, 2, 3))  # a leaf has two triangles or more, where there are several
    links = np.empty((count, 2), dtype=np.int64)
    pending = np.empty((_STACK, 4), dtype=np.int64)  # begin, end, parent, which child
    # Spelled out: an array assigned to a row takes Numba 2.5 s more to compile.
    pending[0, 0], pending[0, 1], pending[0, 2], pending[0, 3] = 0, count, -1, 0
    waiting = 1
    made = 0
    while waiting > 0:
        waiting -= 1
        begin, end = pending[waiting, 0], pending[waiting, 1]
        parent, side = pending[waiting, 2], pending[waiting, 3]
        number = made
        made += 1
        if parent >= 0:
            links[parent, side] = number
        axis = 0
        longest = -1.0
        for a in range(3):
            lower, upper = np.inf, -np.inf
            least, most = np.inf, -np.inf
            for k in range(begin, end):
                f = order[k]
                for v in range(3):
                    lower = min(lower, corners[f, v, a])
                    upper = max(upper, corners[f, v, a])
                least = min(least, middles[a, f])
                most = max(most, middles[a, f])
            nodes[number, 0, a] = (lower + upper) / 2
            nodes[number, 1, a] = (upper - lower) / 2 * (1 + 1e-12) + 1e-15
            if most - least > longest:
                longest = most - least
                axis = a
        if end - begin <= leaf:
            links[number, 0] = -1 - begin
            links[number, 1] = end
            continue
        half = begin + (end - begin) // 2
        _select(order, middles[axis], begin, end, half)
        for child in range(2):  # the first is taken first
            pending[waiting, 0] = begin if child == 1 else half
            pending[waiting, 1] = half if child == 1 else end
            pending[waiting, 2], pending[waiting, 3] = number, 1 - child
            waiting += 1
    return nodes[:made].copy(), links[:made].copy(), order
