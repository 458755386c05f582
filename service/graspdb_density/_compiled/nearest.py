"""Kernels nearest to a pose, in the kernel's own measure: those of the highest exponents."""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from . import isotropic
from .options import fast

F32 = np.float32
__all__ = ["GATHERED", "exponents", "nearest_each", "nearest_rows"]

#: Exponents taken at a time.
GATHERED = 512


@fast
def exponents(data, begin, end, px, py, pz, qx, qy, qz, qw, kappa, twin, out):
    """Exponents of a run's nearest ends."""
    for k in range(np.uint64(end - begin)):
        i = np.uint64(begin) + k
        dx = data[0, i] - px
        dy = data[1, i] - py
        dz = data[2, i] - pz
        a = data[3, i] * qx + data[4, i] * qy + data[5, i] * qz + data[6, i] * qw
        b = (data[3, i] * qy - data[4, i] * qx + data[5, i] * qw - data[6, i] * qz) * twin
        out[k] = max(abs(a), abs(b)) - kappa - (dx * dx + dy * dy + dz * dz)


@fast
def _insert(value, index, best, rows):
    """Put a value into a descending list that is full, where it belongs."""
    k = best.shape[0] - 1
    while k > 0 and best[k - 1] < value:
        best[k], rows[k] = best[k - 1], rows[k - 1]
        k -= 1
    best[k], rows[k] = value, index


@fast
def nearest_rows(data, start, table, centre, scale, position, q, kappa, radius, best, rows):
    """The kernels within ``radius`` with the highest exponents at a pose: ``best`` (C,), descending, and
    their places among the sorted kernels, ``rows`` (C,); -1e30 and -1 where there are no more.
    """
    runs = np.empty((isotropic.MAX_RUNS, 2), dtype=np.int64)
    buffer = np.empty(GATHERED, dtype=np.float32)
    px, py = (position[0] - centre[0]) * scale, (position[1] - centre[1]) * scale
    pz = (position[2] - centre[2]) * scale
    q0, q1, q2, q3 = F32(q[0] * kappa), F32(q[1] * kappa), F32(q[2] * kappa), F32(q[3] * kappa)
    best[:] = -1e30
    rows[:] = -1
    last = best.shape[0] - 1
    for s in range(table.shape[0]):
        twin = F32(table[s, isotropic.TWIN])
        for r in range(isotropic.runs_within(start, table, s, px, py, pz, radius, runs)):
            begin = runs[r, 0]
            while begin < runs[r, 1]:
                stop = min(begin + GATHERED, runs[r, 1])
                exponents(
                    data, begin, stop, F32(px), F32(py), F32(pz), q0, q1, q2, q3, F32(kappa), twin, buffer
                )
                for i in range(stop - begin):
                    if buffer[i] > best[last]:
                        _insert(buffer[i], begin + i, best, rows)
                begin = stop


@fast
def nearest_each(data, start, table, centre, scale, positions, quaternions, kappa, radius, best, rows):
    """Of every pose, the highest exponent (M,) within ``radius`` and whose it is, as `nearest_rows`."""
    for j in range(positions.shape[0]):
        nearest_rows(
            data, start, table, centre, scale, positions[j], quaternions[j], kappa, radius, best[j : j + 1],
            rows[j : j + 1],
        )  # fmt: skip
