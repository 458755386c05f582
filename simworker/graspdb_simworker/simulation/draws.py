"""What is not known exactly, drawn: worlds that all poses of a sweep are simulated in, and each pose's noise.

All is a function of the seed, of the draw and, for noise, of the pose's index: numbers come from a generator
that counts instead of remembering, so that workers, whatever libraries they have, simulate the same worlds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.special import ndtri

from graspdb.wire import SimulatePayload
from graspdb.wire.sweeps import Randomise
from graspdb_simworker.simulation.bodies import Part, Vector, mass_properties, multiply, rotate

_MULTIPLIERS = np.array([0xD2511F53, 0xCD9E8D57], dtype=np.uint64)
_KEY_STEPS = np.array([0x9E3779B9, 0xBB67AE85], dtype=np.uint64)
_LOW, _HALF = np.uint64(0xFFFFFFFF), np.uint64(32)
_ROUNDS = 10
_NOISE, _RANKS, _WITHIN = (0, 1), (2, 3), (4, 5)
"""Blocks of numbers that each draw has, by what they are for."""


class DrawnWorld(NamedTuple):
    """A world: friction coefficient, mass, how far the centre of mass is from that of a uniform solid (object
    frame), and how often the pads' give is the usual one."""

    friction: float
    mass_kg: float
    offset_m: Vector = (0.0, 0.0, 0.0)
    compliance: float = 1.0


def draws_of(payload: SimulatePayload, parts: Sequence[Part]) -> tuple[DrawnWorld, ...]:
    """The worlds that every pose of the payload's sweep is simulated in; one where nothing is drawn.

    Latin hypercube: of n draws, each of n equally likely ranges of every quantity holds one. No body's centre
    of mass is outside its convex hull: an offset that leads out of it ends on it.
    """
    asked = payload.randomise
    if asked is None:
        return (DrawnWorld(payload.friction, payload.mass_kg),)
    number = np.arange(asked.draws, dtype=np.uint64)
    ranks = np.argsort(_uniform(asked.seed, 0, number, _RANKS)[:, :6], axis=0, kind="stable")
    within = _uniform(asked.seed, 0, number, _WITHIN)[:, :6]
    room = _Room(parts) if asked.centre_of_mass_m else None
    worlds = []
    for f, m, x, y, z, c in ndtri((ranks + within) / asked.draws).tolist():
        spread = asked.centre_of_mass_m
        offset = (spread * x, spread * y, spread * z)
        worlds.append(
            DrawnWorld(
                payload.friction * math.exp(asked.friction * f),
                payload.mass_kg * math.exp(asked.mass * m),
                room.within(offset) if room else (0.0, 0.0, 0.0),
                math.exp(asked.finger_compliance * c),
            )
        )
    return tuple(worlds)


class _Room:
    """How far a centre of mass may be from that of a uniform solid."""

    def __init__(self, parts: Sequence[Part]) -> None:
        planes = ConvexHull(np.concatenate([vertices for vertices, _ in parts])).equations
        self._normals = planes[:, :3]
        self._room = -(planes[:, :3] @ np.array(mass_properties(parts, 1.0).centre) + planes[:, 3])

    def within(self, offset: Vector) -> Vector:
        """The offset, shortened to end on the convex hull if it leads out of it."""
        along = self._normals @ np.array(offset)
        out = along > 0.0
        share = min(1.0, float((self._room[out] / along[out]).min(initial=1.0)))
        return (share * offset[0], share * offset[1], share * offset[2])


def noisy(
    asked: Randomise | None,
    draw: int,
    indices: NDArray[np.int64],
    positions: NDArray[np.float64],
    quaternions: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Tool poses (n, 3), (n, 4) of a sweep as they are in a draw, each with noise of its own: a shift along
    the tool's axes, and a turn, whose rotation vector in the tool's axes is normal in each."""
    if asked is None or not (asked.pose_noise_m or asked.pose_noise_deg):
        return positions, quaternions
    normal = ndtri(_uniform(asked.seed, draw, indices.astype(np.uint64), _NOISE)[:, :6])
    where, turned = np.empty_like(positions), np.empty_like(quaternions)
    shifts, turns = asked.pose_noise_m * normal[:, :3], math.radians(asked.pose_noise_deg) * normal[:, 3:]
    _displace(positions, quaternions, shifts, turns, where, turned)
    return where, turned


_multiplied: Any = njit(multiply)
_rotated: Any = njit(rotate)


@njit(cache=True)
def _displace(positions, quaternions, shifts, turns, where, turned):  # type: ignore[no-untyped-def]
    """Poses displaced in their own axes. One by one: a vectorised function may round differently with the
    length of its batch, and labels must not."""
    for i in range(len(positions)):
        tool = (quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3])
        x, y, z = _rotated(tool, (shifts[i, 0], shifts[i, 1], shifts[i, 2]))
        where[i, 0], where[i, 1], where[i, 2] = positions[i, 0] + x, positions[i, 1] + y, positions[i, 2] + z
        angle = math.sqrt(turns[i, 0] ** 2 + turns[i, 1] ** 2 + turns[i, 2] ** 2)
        share = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.0
        turn = (share * turns[i, 0], share * turns[i, 1], share * turns[i, 2], math.cos(0.5 * angle))
        turned[i, 0], turned[i, 1], turned[i, 2], turned[i, 3] = _multiplied(tool, turn)


def _uniform(seed: int, draw: int, numbers: NDArray[np.uint64], blocks: Sequence[int]) -> NDArray[np.float64]:
    """Between 0 and 1, both left out: four for each block, (n, 4 blocks)."""
    words = [philox(seed, (numbers & _LOW, numbers >> _HALF, draw, block)) for block in blocks]
    return (np.concatenate(words, axis=1).astype(np.float64) + 0.5) / 2.0**32


def philox(seed: int, counter: tuple[NDArray[np.uint64], NDArray[np.uint64], int, int]) -> NDArray[np.uint64]:
    """Random words of 32 bits (n, 4) for a seed of 64 bits and four counters of 32.

    Philox4x32-10 of Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3" (SC 2011).
    """
    one, two = counter[0], counter[1]
    three, four = np.full_like(one, counter[2]), np.full_like(one, counter[3])
    key = np.array([seed, seed >> 32], dtype=np.uint64) & _LOW
    for _ in range(_ROUNDS):
        first, second = _MULTIPLIERS[0] * one, _MULTIPLIERS[1] * three
        one, two = (second >> _HALF) ^ two ^ key[0], second & _LOW
        three, four = (first >> _HALF) ^ four ^ key[1], first & _LOW
        key = (key + _KEY_STEPS) & _LOW
    return np.column_stack([one, two, three, four])
