"""Made-up grasps around an ellipsoid: the data that this package is tested and measured with.

Smooth, of any size, and as hard as real ones: a surface in position, all rolls in rotation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from graspdb_density import se3
from graspdb_density.se3 import Floats

__all__ = ["SEMI_AXES_M", "shell"]

SEMI_AXES_M = (0.2, 0.1, 0.1)
#: Noise of the approach about the inward normal, per component before it is normalised.
_NOISE = 0.4


def shell(
    count: int, rng: np.random.Generator, *, semi_axes_m: ArrayLike = SEMI_AXES_M, depth_m: float = 0.01
) -> tuple[Floats, Floats]:
    """Grasps on the shell of an ellipsoid.

    Positions are directions uniform on the sphere, stretched to the ellipsoid and moved along its normal
    uniformly within ``depth_m`` either way; the approach is the inward normal plus noise, the roll uniform.

    Returns
    -------
    positions : (count, 3) metres
    quaternions_xyzw : (count, 4)
    """
    axes = np.asarray(semi_axes_m, dtype=np.float64)
    unit = rng.standard_normal((count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    normal = unit / axes
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    positions = unit * axes + normal * rng.uniform(-depth_m, depth_m, (count, 1))
    z = -normal + _NOISE * rng.standard_normal((count, 3))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    helper = np.where(np.abs(z[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    frames = se3.from_matrix(np.stack([x, np.cross(z, x), z], axis=-1))
    roll = np.zeros((count, 3))
    roll[:, 2] = rng.uniform(-np.pi, np.pi, count)
    return positions, se3.multiply(frames, se3.from_rotation_vector(roll))
