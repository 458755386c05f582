"""From where to look at a grasp, and how what was drawn becomes a picture. No pybullet here.

Two views: the whole of object and gripper, and the fingers close by from another side. The jaw points down.
Which side shows the fingers best depends on the object, so several are tried in small.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FIELD_OF_VIEW_DEG = 28.0
ASPECT = 4.0 / 3.0
UP = (0.0, 0.0, -1.0)
"""The approach points down."""
_AZIMUTHS = 16
_ELEVATIONS = (-0.45, 0.0, 0.45)
_FILLED = 0.92
_OUTLINE = np.array([48, 50, 56], dtype=np.uint8)
_STEEP = 0.02
"""Neighbouring pixels whose distances differ by more than this share are on two surfaces."""


@dataclass(frozen=True)
class View:
    """A camera at ``eye`` that looks at ``target``; both in the jaw's frame, metres."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]

    @property
    def distance_m(self) -> float:
        return math.dist(self.eye, self.target)

    @property
    def towards(self) -> NDArray[np.float64]:
        """Direction from what is looked at to the eye."""
        return np.asarray(np.subtract(self.eye, self.target) / self.distance_m, dtype=np.float64)

    def aside(self, other: View) -> bool:
        """Whether it looks from another side, by 50 degrees at least."""
        return float(self.towards @ other.towards) < math.cos(math.radians(50.0))


def around(points: NDArray[np.float64]) -> Iterator[View]:
    """Views from all sides, as near as all of these points (n, 3) are in the picture."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    tangent = _FILLED * math.tan(math.radians(0.5 * FIELD_OF_VIEW_DEG))
    for elevation in _ELEVATIONS:
        for k in range(_AZIMUTHS):
            azimuth = 2.0 * math.pi * (k + 0.5) / _AZIMUTHS
            flat = math.cos(elevation)
            towards = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
            right = np.cross(UP, towards)
            right /= np.linalg.norm(right)
            across, along, near = (
                (points - centre) @ axis for axis in (right, np.cross(towards, right), towards)
            )
            needed = near + np.maximum(np.abs(across) / ASPECT, np.abs(along)) / tangent
            x, y, z = (float(v) for v in centre + float(needed.max()) * towards)
            yield View((x, y, z), (float(centre[0]), float(centre[1]), float(centre[2])))


def best(
    views: Sequence[View], first: NDArray[np.int64], second: NDArray[np.int64], thing: NDArray[np.int64]
) -> View:
    """The view that shows most of both fingers and something of the object, and best how they close.

    ``first``, ``second`` and ``thing`` are for each how many pixels show the fingers and the object.
    """
    sideways = np.abs([view.towards[0] for view in views])
    scores = (np.minimum(first, second) + 0.25 * (first + second) + 0.02 * thing) * (0.4 + 0.6 * sideways)
    return views[int(np.argmax(scores))]


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
