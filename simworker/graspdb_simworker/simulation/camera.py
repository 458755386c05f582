"""From where to look at a grasp, and how what was drawn becomes a picture. No pybullet here.

Two views: the whole of object and gripper, and the fingers close by from another side. The jaw points down.
Which side shows the fingers best depends on the object, so several are tried in small.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from graspdb_geometry.picturing import views
from graspdb_geometry.picturing.views import FIELD_OF_VIEW_DEG as FIELD_OF_VIEW_DEG
from graspdb_geometry.picturing.views import View as View
from graspdb_geometry.picturing.views import best as best

ASPECT = 4.0 / 3.0
UP = (0.0, 0.0, -1.0)
"""The approach points down."""
ACROSS = np.array([1.0, 0.0, 0.0])
"""Across the way that the fingers close."""
_AZIMUTHS = 16
_ELEVATIONS = (-0.45, 0.0, 0.45)
_OUTLINE = np.array([48, 50, 56], dtype=np.uint8)
_STEEP = 0.02
"""Neighbouring pixels whose distances differ by more than this share are on two surfaces."""


def around(points: NDArray[np.float64]) -> Iterator[View]:
    """Views from all sides, as near as all of these points (n, 3) are in the picture."""
    return views.around(points, _ELEVATIONS, _AZIMUTHS, ASPECT, UP)


def finished(
    pixels: NDArray[np.uint8], bodies: NDArray[np.int64], distances: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Half of what was drawn in width and height: outlined where one surface ends, and smooth.

    ``pixels`` (2 h, 2 w, 3) are uint8; ``bodies`` (2 h, 2 w) what each shows, ``distances`` how far, metres.
    """
    edge = np.zeros(bodies.shape, dtype=bool)
    for axis in (0, 1):
        inner = tuple(slice(1, None) if k == axis else slice(None) for k in (0, 1))
        nearer = np.minimum(distances, np.roll(distances, 1, axis))
        jump = np.abs(np.diff(distances, axis=axis)) > _STEEP * nearer[inner]
        edge[inner] |= (np.diff(bodies, axis=axis) != 0) | jump
    drawn = np.where(edge[:, :, None], _OUTLINE, pixels)
    height, width = bodies.shape
    blocks = drawn.reshape(height // 2, 2, width // 2, 2, 3).astype(np.uint16)
    return np.asarray((blocks.sum(axis=(1, 3)) + 2) // 4, dtype=np.uint8)
