"""Getting a server ready: compiled functions loaded before the first query needs them."""

from __future__ import annotations

import gc
import math

import numpy as np

from graspdb_density import (
    GraspDensity,
    IsotropicKernel,
    ModeSearch,
    Region,
    SuccessModel,
    choose_widths,
    se3,
)
from graspdb_density.se3 import Poses
from graspdb_geometry.collision import Scene, Surface
from graspdb_geometry.grippers import PG70
from graspdb_geometry.poses import ToolPoses
from graspdb_service.usecases.runtime.compute import Compute


def warm_up(compute: Compute) -> None:
    """Load what queries call, and take what is loaded out of the garbage collector's sight.

    A full collection looks at every object there is, a few hundred thousand once everything is imported, and
    holds the interpreter meanwhile: 0.2 s in which not even ``/livez`` answers.
    """
    compute.run(_exercise)
    gc.collect()
    gc.freeze()


def _exercise() -> None:
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(300, 3)) * 0.01
    quaternions = se3.random_quaternions(300, rng)
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]) * 0.02
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7]])
    scene = Scene([(corners, faces)])
    Surface(corners, faces, watertight=False).collides(ToolPoses(positions, quaternions), PG70)
    kernel = IsotropicKernel(0.015, math.radians(15.0))
    region = Region([[0.0, 0.0, 1.0, 0.0]], approach=(0.0, 0.0, 1.0), approach_angle=1.0)

    def free(p: se3.Floats, q: se3.Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        return ~scene.collides(ToolPoses(p, q), PG70)

    choose_widths(Poses.of(positions, quaternions))
    success = rng.random(300) < 0.5
    model = SuccessModel.build(Poses.of(positions, quaternions), success, kernel=kernel)
    model.extend(Poses.of(positions, quaternions), success).evaluate(Poses.of(positions[:5], quaternions[:5]))
    density = GraspDensity.build(se3.Poses.of(positions, quaternions), kernel=kernel)
    density = density.extend(density.sample(10, rng))
    density.log_density(se3.Poses.of(positions, quaternions))
    density.log_density(se3.Poses.of(positions[:3] + 1.0, quaternions[:3]), cutoff=None)
    search = ModeSearch(density)
    search.maxima(region, count=2, admissible=free)
    top = search.global_maximum()

    def elsewhere(p: se3.Floats, q: se3.Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        return np.asarray(np.linalg.norm(p - top.position, axis=1) > 0.005)

    search.maxima(admissible=elsewhere)
    density.nearest_rows(se3.Poses(positions[0], quaternions[0]), 5)
    density.nearest_each(se3.Poses(positions[:5], quaternions[:5]), within=2.0)
    model.lower_end(Poses.of(positions[:5], quaternions[:5]))
