"""Where a grasp may be: linear and spherical limits on the tool's origin, cones for its approach and
closing axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from ..se3 import Floats
from . import feasible_projection
from .feasible_projection import Limits

__all__ = ["Region"]

#: A pose this far outside is still inside: what rounding moves.
TOLERANCE_M = 2e-9
TOLERANCE = 1e-7


@dataclass(frozen=True, eq=False, slots=True)
class Region:
    """Admissible poses of the tool in the object frame; everything given holds at once.

    Parameters
    ----------
    half_spaces : (K, 4) or None
        Rows n, d: ``n . x >= d`` at the tool's origin, metres where n is a unit vector (n is normalised, d
        with it).
    approach, approach_angle : (3,), radians
        The tool's z lies within the angle of this direction.
    closing, closing_angle : (3,), radians
        The tool's y lies within the angle of this direction or, unless ``closing_signed``, of its opposite:
        for a symmetric jaw both are one grasp.
    spheres : (S, 4) or None
        Centres and radii, metres: the tool's origin lies inside each.

    Raises
    ------
    ValueError
        For wrong shapes, values that are not finite, directions of no length, angles outside 0 to pi, radii
        below 0, or an approach and a closing cone that no rotation satisfies (the axes are perpendicular).
    """

    half_spaces: ArrayLike | None = None
    approach: ArrayLike | None = None
    approach_angle: float | None = None
    closing: ArrayLike | None = None
    closing_angle: float | None = None
    spheres: ArrayLike | None = None
    closing_signed: bool = False
    limits: Limits = field(init=False, repr=False)

    def __post_init__(self) -> None:
        planes = _rows(self.half_spaces, "half_spaces")
        length = np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
        if np.any(length < 1e-12):
            raise ValueError("a half space's normal has no length")
        balls = _rows(self.spheres, "spheres")
        if np.any(balls[:, 3] < 0.0):
            raise ValueError("a sphere's radius is negative")
        cones = np.zeros(9)
        cones[0:4] = _cone(self.approach, self.approach_angle, "approach")
        cones[4:8] = _cone(self.closing, self.closing_angle, "closing")
        cones[8] = float(self.closing_signed)
        if cones[3] >= 0.0 and cones[7] >= 0.0:
            dot = float(np.clip(cones[0:3] @ cones[4:7], -1.0, 1.0))
            gap = abs(math.acos(dot) - 0.5 * math.pi)
            excess = gap - float(cones[3] + cones[7])
            if excess > TOLERANCE:
                raise ValueError(
                    "approach and closing contradict each other: the axes of a jaw are perpendicular and no "
                    f"rotation brings both into their cones (they miss by {math.degrees(excess):.3g} degrees)"
                )
        object.__setattr__(self, "limits", Limits(planes / length, balls, cones))

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike) -> Floats:
        """The six half spaces (6, 4) of an axis-aligned box, for ``half_spaces``."""
        low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
        if low.shape != (3,) or high.shape != (3,):
            raise ValueError("a box is given by two corners of 3 coordinates")
        if np.any(low > high):
            raise ValueError("a box's lower corner lies above its upper one")
        return np.concatenate(
            [np.hstack([np.eye(3), low[:, None]]), np.hstack([-np.eye(3), -high[:, None]])]
        ).astype(np.float64)

    def contains(self, positions: ArrayLike, quaternions_xyzw: ArrayLike) -> NDArray[np.bool_]:
        """Which poses (M,) lie inside, within 2e-9 m and 1e-7 rad."""
        p, q = se3.Poses.of(positions, quaternions_xyzw)
        inside = np.empty(len(p), dtype=bool)
        feasible_projection.contains_all(self.limits, p, q, TOLERANCE_M, TOLERANCE, inside)
        return inside

    def project(
        self, positions: ArrayLike, quaternions_xyzw: ArrayLike
    ) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Nearest poses inside, position and rotation each by itself, and which (M,) got there."""
        p, q = se3.Poses.of(positions, quaternions_xyzw)
        inside = np.empty(len(p), dtype=bool)
        feasible_projection.project_all(self.limits, p, q, inside)
        return p, q, inside

    def active(self, position: Floats, quaternion: Floats) -> tuple[str, ...]:
        """Names of what holds the pose: ``half_spaces[i]``, ``spheres[i]``, ``approach``, ``closing``."""
        planes, balls, cones = self.limits
        inside = planes[:, :3] @ position - planes[:, 3]
        names = [f"half_spaces[{i}]" for i in np.flatnonzero(inside < 1e-5)]
        inside = balls[:, 3] - np.linalg.norm(position - balls[:, :3], axis=1)
        names += [f"spheres[{i}]" for i in np.flatnonzero(inside < 1e-5)]
        for name, angle, other in (("approach", 3, 7), ("closing", 7, 3)):
            alone = cones.copy()
            alone[other] = -1.0
            if cones[angle] >= 0.0 and feasible_projection.cone_excess(alone, quaternion) > -1e-4:
                names.append(name)
        return tuple(names)


def _rows(value: ArrayLike | None, name: str) -> Floats:
    rows = np.zeros((0, 4)) if value is None else np.atleast_2d(np.array(value, dtype=np.float64))
    if rows.size == 0:
        rows = rows.reshape(0, 4)
    if rows.ndim != 2 or rows.shape[1] != 4:
        raise ValueError(f"{name} have shape (K, 4), not {rows.shape}")
    if not np.isfinite(rows).all():
        raise ValueError(f"{name} must be finite")
    return rows


def _cone(axis: ArrayLike | None, angle: float | None, name: str) -> Floats:
    """Unit axis and angle (4,); angle -1 for none."""
    if axis is None:
        if angle is not None:
            raise ValueError(f"{name}_angle is given without {name}")
        return np.array([0.0, 0.0, 0.0, -1.0])
    direction = np.array(axis, dtype=np.float64)
    if direction.shape != (3,) or not np.isfinite(direction).all():
        raise ValueError(f"{name} must be 3 finite numbers")
    length = float(np.linalg.norm(direction))
    if length < 1e-12:
        raise ValueError(f"{name} has no direction")
    if angle is None or not math.isfinite(angle) or not 0.0 <= angle <= math.pi:
        raise ValueError(f"{name}_angle must be between 0 and pi radians, not {angle!r}")
    return np.append(direction / length, angle)
