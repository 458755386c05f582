"""Which trials may pair with which: candidates found by sorting, as runs of consecutive rows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..se3 import Floats

__all__ = ["Candidates", "near_positions", "near_rotations", "same_key"]

Ints = NDArray[np.int64]
_BAND = math.radians(12.0)


@dataclass(frozen=True, eq=False, slots=True)
class Candidates:
    """Runs of sorted rows for a list of grasps.

    Attributes
    ----------
    order : (N,) int64
        Rows sorted.
    first : (A + 1,) int64
        Runs of grasp a are ``runs[first[a]:first[a + 1]]``.
    runs : (R, 2) int64
        Begin and end in ``order``.
    """

    order: Ints
    first: Ints
    runs: Ints

    def lengths(self) -> Ints:
        """Candidates of every grasp, (A,)."""
        total = np.concatenate([[0], np.cumsum(self.runs[:, 1] - self.runs[:, 0])])
        return np.asarray(total[self.first[1:]] - total[self.first[:-1]], dtype=np.int64)


def same_key(keys: Ints, grasps: Ints) -> Candidates:
    """Rows with the same key as each grasp."""
    order = np.argsort(keys, kind="stable").astype(np.int64)
    ordered = keys[order]
    begin = np.searchsorted(ordered, keys[grasps], side="left")
    end = np.searchsorted(ordered, keys[grasps], side="right")
    return Candidates(order, np.arange(len(grasps) + 1), np.stack([begin, end], axis=1).astype(np.int64))


def near_rotations(quaternions_xyzw: Floats, grasps: Ints, angle: float) -> Candidates:
    """At least the rows whose rotation, or its twin's, is within an angle of each grasp's.

    Sorted by the cell of the sphere that holds the approach direction, which the jaw's turn leaves alone;
    directions differ by no more than the rotations do.
    """
    z = se3.rotate(quaternions_xyzw, np.array([0.0, 0.0, 1.0]))
    polar = np.arccos(np.clip(z[:, 2], -1.0, 1.0))
    bands = max(1, round(math.pi / _BAND))
    band = np.minimum((polar / math.pi * bands).astype(np.int64), bands - 1)
    across = np.maximum(1, np.round(2.0 * bands * np.sin((np.arange(bands) + 0.5) * math.pi / bands)))
    start = np.concatenate([[0], np.cumsum(across)]).astype(np.int64)
    around = np.arctan2(z[:, 1], z[:, 0]) / (2.0 * math.pi) + 0.5
    cell = start[band] + np.minimum(around * across[band], across[band] - 1).astype(np.int64)
    order = np.argsort(cell, kind="stable").astype(np.int64)
    bounds = np.searchsorted(cell[order], np.arange(start[-1] + 1))
    filled = np.flatnonzero(np.diff(bounds))
    # Every cell by the mean of its directions and the widest angle from it.
    centres = np.add.reduceat(z[order], bounds[filled], axis=0)
    centres /= np.maximum(np.linalg.norm(centres, axis=1, keepdims=True), 1e-12)
    which = np.repeat(np.arange(len(filled)), np.diff(bounds)[filled])
    cosines = np.einsum("ni,ni->n", z[order], centres[which])
    widest = np.arccos(np.clip(np.minimum.reduceat(cosines, bounds[filled]), -1.0, 1.0))
    away = np.arccos(np.clip(z[grasps] @ centres.T, -1.0, 1.0))
    grasp, hit = np.nonzero(away <= widest + angle + 1e-6)
    first = np.searchsorted(grasp, np.arange(len(grasps) + 1))
    runs = np.stack([bounds[filled[hit]], bounds[filled[hit] + 1]], axis=1)
    return Candidates(order, first.astype(np.int64), runs.astype(np.int64))


def near_positions(positions: Floats, grasps: Ints, reach_m: float) -> Candidates:
    """At least the rows within a distance of each grasp's position: cubes with that edge, z contiguous."""
    # Larger cubes where the extent would overflow the key.
    edge = max(reach_m, float(np.ptp(positions, axis=0).max()) / 1e6)
    cell = np.floor((positions - positions.min(axis=0)) / edge).astype(np.int64) + 1
    size = cell.max(axis=0) + 2
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    order = np.argsort(key, kind="stable").astype(np.int64)
    ordered = key[order]
    steps = np.array([(dx * size[1] + dy) * size[2] for dx in (-1, 0, 1) for dy in (-1, 0, 1)])
    centre = key[grasps][:, None] + steps
    begin = np.searchsorted(ordered, centre - 1, side="left")
    end = np.searchsorted(ordered, centre + 1, side="right")
    runs = np.stack([begin.ravel(), end.ravel()], axis=1).astype(np.int64)
    return Candidates(order, np.arange(0, runs.shape[0] + 1, 9), runs)
