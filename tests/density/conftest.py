"""Data the density tests share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import ellipsoid_shell
from graspdb_density import se3
from graspdb_density.se3 import Floats

Poses = tuple[Floats, Floats]


@pytest.fixture(scope="session")
def shell() -> Callable[[int, np.random.Generator], Poses]:
    """Grasps around an ellipsoid: within 10 mm of its surface, approaching along the normal, any roll."""
    return ellipsoid_shell.shell


@pytest.fixture(scope="session")
def moved() -> Callable[[Poses, int, float, float, np.random.Generator], Poses]:
    """Poses near random rows: displaced by Gaussian noise of the given deviations per axis."""

    def move(rows: Poses, count: int, metres: float, radians: float, rng: np.random.Generator) -> Poses:
        index = rng.integers(len(rows[0]), size=count)
        turns = se3.from_rotation_vector(rng.standard_normal((count, 3)) * radians)
        return rows[0][index] + rng.standard_normal((count, 3)) * metres, se3.multiply(rows[1][index], turns)

    return move
