"""What the geometry tests share: random poses, and an independent answer by linear programming."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from graspdb_geometry import collision, grippers

FloatArray = npt.NDArray[np.float64]

#: Programmes are solved in millimetres: the solver's feasibility tolerance of 1e-7 then means 0.1 nm.
MM = 1000.0


class Oracle:
    """The gripper against convex parts, each question a linear programme over half-spaces (object frame)."""

    def __init__(self, parts: Sequence[FloatArray]) -> None:
        self.parts = [np.asarray(p, dtype=np.float64) for p in parts]
        self.spaces = [ConvexHull(p).equations for p in self.parts]

    @staticmethod
    def box(centre: FloatArray, half: FloatArray, position: FloatArray, rotation: FloatArray) -> FloatArray:
        """Half-spaces n.x + d <= 0 of a tool-frame box placed in the object frame."""
        normals = np.concatenate([rotation.T, -rotation.T])
        offsets = np.concatenate([centre + half, half - centre]) + normals @ position
        return np.column_stack([normals, -offsets])

    @staticmethod
    def depth(a: FloatArray, b: FloatArray) -> float:
        """Radius of the greatest ball inside both, negative (if bounded) when they are apart."""
        rows = np.concatenate([a, b])
        matrix = np.column_stack([rows[:, :3], np.ones(len(rows))])
        answer = linprog([0, 0, 0, -1], A_ub=matrix, b_ub=-rows[:, 3] * MM, bounds=[(None, None)] * 4)
        assert answer.status == 0, answer.message
        return float(answer.x[3]) / MM

    def collision_depth(
        self,
        position: FloatArray,
        rotation: FloatArray,
        shape: grippers.GripperShape,
        opening: float | None = None,
    ) -> float:
        """Greatest depth over the gripper's boxes and the parts; 1 m apart or more counts as -1."""
        half_extents, centres = shape.boxes(opening)
        deepest = -1.0
        for half, centre in zip(half_extents, centres, strict=True):
            box = self.box(centre, half, position, rotation)
            for points, spaces in zip(self.parts, self.spaces, strict=True):
                if self._far(points, position + rotation @ centre, float(np.linalg.norm(half))):
                    continue
                deepest = max(deepest, self.depth(spaces, box))
        return deepest

    def column_extent(
        self, position: FloatArray, rotation: FloatArray, shape: grippers.GripperShape
    ) -> tuple[float, float, float]:
        """Least and greatest y (tool frame) of the object between the fingers, and the overlap's depth.

        Like the finger boxes the column is narrower by the touch tolerance: on a sliver that grazes its side
        the extent is that sensitive.
        """
        half, centre = shape.column()
        half = half - np.array([1, 0, 1]) * collision.TOUCH_TOLERANCE_M
        box = self.box(centre, half, position, rotation)
        low, high, deepest = np.inf, -np.inf, -1.0
        axis = rotation[:, 1]
        for points, spaces in zip(self.parts, self.spaces, strict=True):
            if self._far(points, position + rotation @ centre, float(np.linalg.norm(half))):
                continue
            deepest = max(deepest, self.depth(spaces, box))
            rows = np.concatenate([spaces, box])
            for sign in (1.0, -1.0):
                answer = linprog(
                    sign * axis, A_ub=rows[:, :3], b_ub=-rows[:, 3] * MM, bounds=[(None, None)] * 3
                )
                if answer.status == 0:
                    y = float(axis @ (answer.x / MM - position))
                    low, high = min(low, y), max(high, y)
        return low, high, deepest

    @staticmethod
    def _far(points: FloatArray, centre: FloatArray, radius: float) -> bool:
        """Bounding spheres apart by a millimetre: spares most of the programmes."""
        middle = points.mean(axis=0)
        reach = float(np.linalg.norm(points - middle, axis=1).max())
        return bool(np.linalg.norm(middle - centre) > radius + reach + 1e-3)


@pytest.fixture(scope="session")
def oracle() -> type[Oracle]:
    """The linear-programming reference."""
    return Oracle


@pytest.fixture(scope="session")
def random_hull() -> Callable[[np.random.Generator], FloatArray]:
    """Corners of a random convex polyhedron, from slivers to lumps, 5 to 200 mm across."""

    def make(rng: np.random.Generator) -> FloatArray:
        size = np.exp(rng.uniform(np.log(0.005), np.log(0.2), size=3))
        points = rng.normal(size=(int(rng.integers(4, 30)), 3)) * size / 2
        points = Rotation.random(random_state=int(rng.integers(2**31))).apply(points)
        return np.asarray(points + rng.normal(size=3) * 0.02)

    return make


@pytest.fixture(scope="session")
def random_poses() -> Callable[[np.random.Generator, int, float], tuple[FloatArray, FloatArray]]:
    """Positions in a cube of the given half width and uniform rotations (xyzw)."""

    def make(rng: np.random.Generator, count: int, reach: float) -> tuple[FloatArray, FloatArray]:
        quaternions = rng.normal(size=(count, 4))
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        return rng.uniform(-reach, reach, size=(count, 3)), quaternions

    return make
