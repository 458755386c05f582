"""Trials as labs post them that fill no volume: all from above, at one pose, one of them in millimetres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graspdb_density import se3
from graspdb_density.se3 import Floats, Poses

__all__ = ["KINDS", "Trials"]

_DOWN = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Trials:
    """Poses (N) and whether they held (N,)."""

    poses: Poses
    won: NDArray[np.bool_]


Make = Callable[[int, np.random.Generator], Trials]


def _trials(p: Floats, q: Floats, rng: np.random.Generator, share: float = 0.7) -> Trials:
    won = rng.random(len(p)) < share
    return Trials(Poses.of(p, q), won)


def _cloud(count: int, rng: np.random.Generator, scale: float = 0.01) -> Floats:
    return np.asarray(rng.normal(scale=scale, size=(count, 3)))


def _tilted(count: int, rng: np.random.Generator, scale: float = 0.3) -> Floats:
    turns = se3.from_rotation_vector(rng.normal(scale=scale, size=(count, 3)))
    return se3.normalise(se3.multiply(_DOWN, turns))


def _same(count: int) -> Floats:
    return np.tile(_DOWN, (count, 1))


def _planar(count: int, rng: np.random.Generator) -> Trials:
    """From above at one height, the yaw free."""
    yaw = rng.uniform(-np.pi, np.pi, count)
    p = np.column_stack([_cloud(count, rng)[:, :2], np.full(count, 0.02)])
    q = np.column_stack([np.cos(0.5 * yaw), np.sin(0.5 * yaw), np.zeros((count, 2))])
    return _trials(p, q, rng)


def _one_rotation(count: int, rng: np.random.Generator) -> Trials:
    return _trials(_cloud(count, rng), _same(count), rng)


def _one_position(count: int, rng: np.random.Generator) -> Trials:
    return _trials(np.tile([0.01, 0.02, 0.03], (count, 1)), _tilted(count, rng), rng)


def _identical(count: int, rng: np.random.Generator) -> Trials:
    return _trials(np.tile([0.0, 0.0, 0.05], (count, 1)), _same(count), rng)


def _two_poses(count: int, rng: np.random.Generator) -> Trials:
    """Each tried again and again."""
    second = np.arange(count) % 2 == 1
    p = np.where(second[:, None], [0.03, 0.0, 0.0], [0.0, 0.0, 0.0])
    return _trials(p, np.where(second[:, None], se3.IDENTITY, _DOWN), rng)


def _two(_: int, rng: np.random.Generator) -> Trials:
    return _trials(_cloud(2, rng), _tilted(2, rng), rng, share=1.0)


def _collinear(count: int, rng: np.random.Generator) -> Trials:
    p = np.outer(rng.uniform(-0.05, 0.05, count), [1.0, 2.0, -1.0])
    return _trials(p, _same(count), rng)


def _far_one(count: int, rng: np.random.Generator) -> Trials:
    """One posted in millimetres."""
    p = _cloud(count, rng)
    p[0] = [20.0, 5.0, 3.0]
    trials = _trials(p, _tilted(count, rng), rng)
    trials.won[0] = True
    return trials


def _all_successes(count: int, rng: np.random.Generator) -> Trials:
    return _trials(_cloud(count, rng), _tilted(count, rng), rng, share=1.0)


def _all_failures(count: int, rng: np.random.Generator) -> Trials:
    return _trials(_cloud(count, rng), _tilted(count, rng), rng, share=0.0)


def _tiny(count: int, rng: np.random.Generator) -> Trials:
    return _trials(_cloud(count, rng, 1e-9), _tilted(count, rng, 1e-9), rng)


def _huge(count: int, rng: np.random.Generator) -> Trials:
    """As far apart as positions may be."""
    return _trials(rng.uniform(-999.0, 999.0, (count, 3)), se3.random_quaternions(count, rng), rng)


def _twins(count: int, rng: np.random.Generator) -> Trials:
    """Each with the jaw turned half, and written with the other sign."""
    half = (count + 1) // 2
    p, q = np.repeat(_cloud(half, rng), 2, axis=0), _tilted(half, rng)
    return _trials(p, np.stack([q, -se3.jaw_twin(q)], axis=1).reshape(-1, 4), rng)


def _turned_over(count: int, rng: np.random.Generator) -> Trials:
    """At half turns from each other about all axes, where a rotation vector has two signs."""
    halves = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
    return _trials(np.zeros((count, 3)), halves[np.arange(count) % 4], rng)


KINDS: dict[str, Make] = {
    "planar": _planar,
    "one rotation": _one_rotation,
    "one position": _one_position,
    "identical": _identical,
    "two poses": _two_poses,
    "two trials": _two,
    "collinear": _collinear,
    "one far away": _far_one,
    "all successes": _all_successes,
    "all failures": _all_failures,
    "tiny": _tiny,
    "huge": _huge,
    "antipodal twins": _twins,
    "half turns": _turned_over,
}
"""``KINDS[name](count, rng)`` makes trials."""
