"""Data the density tests share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from graspdb_density import se3
from graspdb_density.se3 import Floats

Poses = tuple[Floats, Floats]


def _shell(count: int, rng: np.random.Generator) -> Poses:
    axes = np.array([0.2, 0.1, 0.1])
    unit = rng.standard_normal((count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    normal = unit / axes
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    positions = unit * axes + normal * rng.uniform(-0.01, 0.01, (count, 1))
    z = -normal + 0.4 * rng.standard_normal((count, 3))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    helper = np.where(np.abs(z[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    frames = se3.from_matrix(np.stack([x, np.cross(z, x), z], axis=-1))
    roll = np.zeros((count, 3))
    roll[:, 2] = rng.uniform(-np.pi, np.pi, count)
    return positions, se3.multiply(frames, se3.from_rotation_vector(roll))


@pytest.fixture(scope="session")
def shell() -> Callable[[int, np.random.Generator], Poses]:
    """Grasps around an ellipsoid: within 10 mm of its surface, approaching along the normal, any roll."""
    return _shell


@pytest.fixture(scope="session")
def moved() -> Callable[[Poses, int, float, float, np.random.Generator], Poses]:
    """Poses near random rows: displaced by Gaussian noise of the given deviations per axis."""

    def move(rows: Poses, count: int, metres: float, radians: float, rng: np.random.Generator) -> Poses:
        index = rng.integers(len(rows[0]), size=count)
        turns = se3.from_rotation_vector(rng.standard_normal((count, 3)) * radians)
        return rows[0][index] + rng.standard_normal((count, 3)) * metres, se3.multiply(rows[1][index], turns)

    return move
