"""From where to look at something, so that all of it is in the picture. Metres, in the frame of the scene."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
FIELD_OF_VIEW_DEG = 28.0
"""From the lower edge to the upper one."""
_FILLED = 0.92


@dataclass(frozen=True)
class View:
    """A camera at ``eye`` that looks at ``target``, with ``up`` upward in the picture."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @property
    def distance_m(self) -> float:
        return math.dist(self.eye, self.target)

    @property
    def towards(self) -> Floats:
        """Direction from what is looked at to the eye."""
        return np.asarray(np.subtract(self.eye, self.target) / self.distance_m, dtype=np.float64)

    @property
    def axes(self) -> Floats:
        """Rows: to the right in the picture, upward in it, and towards the eye; unit vectors."""
        towards = self.towards
        right = np.cross(self.up, towards)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(towards, right), towards])

    def aside(self, other: View) -> bool:
        """Whether it looks from another side, by 50 degrees at least."""
        return float(self.towards @ other.towards) < math.cos(math.radians(50.0))


def view_from(
    points: Floats,
    azimuth: float,
    elevation: float,
    aspect: float,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> View:
    """The view from a side, radians about z from x and above the x-y plane, as near as all points are in it.

    ``points`` are (n, 3), ``aspect`` is width over height; the elevation must not be straight along z.
    """
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    tangent = _FILLED * math.tan(math.radians(0.5 * FIELD_OF_VIEW_DEG))
    flat = math.cos(elevation)
    towards = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    across, along, near = ((points - centre) @ axis for axis in (right, np.cross(towards, right), towards))
    needed = near + np.maximum(np.abs(across) / aspect, np.abs(along)) / tangent
    x, y, z = (float(v) for v in centre + float(needed.max()) * towards)
    return View((x, y, z), (float(centre[0]), float(centre[1]), float(centre[2])), up)


def around(
    points: Floats,
    elevations: Sequence[float],
    azimuths: int,
    aspect: float,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Iterator[View]:
    """Views from all sides, each as :func:`view_from`."""
    for elevation in elevations:
        for k in range(azimuths):
            yield view_from(points, 2.0 * math.pi * (k + 0.5) / azimuths, elevation, aspect, up)


def best(
    views: Sequence[View],
    across: Floats,
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    thing: NDArray[np.int64],
) -> View:
    """The view that shows most of both fingers and something of the object, and best how they close.

    ``across`` (3,) is the direction across which they do, along the fingers' width; ``first``, ``second`` and
    ``thing`` are for each view how many pixels show the fingers and the object.
    """
    sideways = np.abs([float(view.towards @ across) for view in views])
    scores = (np.minimum(first, second) + 0.25 * (first + second) + 0.02 * thing) * (0.4 + 0.6 * sideways)
    return views[int(np.argmax(scores))]
