"""What the physics is told of the two bodies, and what it answers: gripper, mass distribution, closing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from graspdb_geometry.grippers import GripperShape

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Part = tuple[NDArray[np.float64], NDArray[np.int64]]
"""A convex part: vertices (V, 3) in metres and outward faces (F, 3)."""

HEAVY_KG = 0.3
"""From this mass on the jaw closes with its full force."""
LIGHT_FORCE_N = 10.0
"""Below it with this one: light objects jitter between strong fingers. The contact forces are scaled
back for the test."""
MAX_FORCE_PER_MASS = 1000.0
"""And never with more newtons than this for a kilogram of the object: an unbalanced jaw would move a very
light one by more than its contacts are deep in a single step."""
MIN_FINGER_SHARE = 1.0 / 16.0
"""A finger is simulated with at least this share of the object's mass, which is what the PG70's have of the
heaviest example's. The solver does not balance what is a hundred times heavier than what presses on it: with
the Panda's fingers of 15 g not one grasp of 1.6 kg held, where at the fine step a third do, and with fingers
of 100 g the same third. Once a jaw has stalled, its fingers' inertia has no part in what holds."""


@dataclass(frozen=True, kw_only=True)
class Gripper(GripperShape):
    """A parallel jaw as the physics sees it.

    ``finger_mass_kg`` is as simulated, see :data:`MIN_FINGER_SHARE`, and so is ``closing_force_n``, at most
    the gripper's own ``force_n``, to which contact forces are scaled.
    """

    finger_mass_kg: float
    max_speed_m_s: float
    force_n: float
    closing_force_n: float

    @property
    def finger_half_extents(self) -> tuple[float, float, float]:
        return (0.5 * self.finger_width_m, 0.5 * self.finger_thickness_m, 0.5 * self.finger_length_m)

    @property
    def palm_half_extents(self) -> tuple[float, float, float]:
        x, y, z = self.palm_size_m
        return (0.5 * x, 0.5 * y, 0.5 * z)

    @property
    def palm_centre_z(self) -> float:
        return self.tip_offset_m - self.finger_length_m - 0.5 * self.palm_size_m[2]


def closing_force(force_n: float, mass_kg: float) -> float:
    """Closing force to simulate with, in newtons, for an object of this mass."""
    force = force_n if mass_kg >= HEAVY_KG else min(force_n, LIGHT_FORCE_N)
    return min(force, MAX_FORCE_PER_MASS * mass_kg)


@dataclass(frozen=True)
class MassProperties:
    """Mass, centre (m) and principal inertia (kg m^2) of a solid, in the object frame.

    ``principal_xyzw`` rotates from the principal frame to the object frame.
    """

    mass_kg: float
    centre: tuple[float, float, float]
    principal_xyzw: tuple[float, float, float, float]
    inertia: tuple[float, float, float]
    _axes: NDArray[np.float64]

    def to_principal(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) of the object frame in the principal frame."""
        return np.asarray((points - np.array(self.centre)) @ self._axes, dtype=np.float64)

    def displaced(self, offset_m: Vector) -> MassProperties:
        """The same with the centre of mass that far off, metres in the object frame. The inertia about the
        centre stays: how the mass is spread that puts it there is not known."""
        if not any(offset_m):
            return self
        x, y, z = self.centre
        return replace(self, centre=(x + offset_m[0], y + offset_m[1], z + offset_m[2]))

    def radius_of(self, parts: Sequence[Part]) -> float:
        """Farthest that any vertex is from the centre of mass, metres."""
        centre = np.array(self.centre)
        return max(float(np.linalg.norm(vertices - centre, axis=1).max()) for vertices, _ in parts)


def mass_properties(parts: Sequence[Part], mass_kg: float) -> MassProperties:
    """Mass properties of a union of convex parts of uniform density; where these overlap, the volume counts
    once for each.

    Signed tetrahedra from the origin to every face: volume det/6, first moment det/24 (a + b + c),
    second moment det/120 (s s^T + a a^T + b b^T + c c^T) with s = a + b + c. ValueError for a mass that is
    not positive, or parts that enclose no volume.
    """
    if not (np.isfinite(mass_kg) and mass_kg > 0.0):
        raise ValueError(f"mass must be positive and finite, got {mass_kg}")
    volume, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for vertices, faces in parts:
        a, b, c = (np.asarray(vertices, dtype=np.float64)[np.asarray(faces)[:, i]] for i in range(3))
        det = np.einsum("ij,ij->i", a, np.cross(b, c))
        total = a + b + c
        moment = sum(np.einsum("i,ij,ik->jk", det, v, v) for v in (total, a, b, c)) / 120.0
        # A part wound inwards counts like one wound outwards.
        sign = 1.0 if det.sum() >= 0.0 else -1.0
        volume += sign * det.sum() / 6.0
        first += sign * (det[:, None] * total).sum(axis=0) / 24.0
        second += sign * moment
    if not volume > 0.0:
        raise ValueError("the convex parts enclose no volume")
    centre = first / volume
    covariance = (second / volume - np.outer(centre, centre)) * mass_kg
    moments, axes = np.linalg.eigh(np.trace(covariance) * np.eye(3) - covariance)
    if np.linalg.det(axes) < 0.0:
        axes[:, 2] *= -1.0
    x, y, z = (float(m) for m in np.maximum(moments, 1e-12))
    return MassProperties(
        mass_kg=float(mass_kg),
        centre=(float(centre[0]), float(centre[1]), float(centre[2])),
        principal_xyzw=_quaternion(axes),
        inertia=(x, y, z),
        _axes=axes,
    )


def _quaternion(matrix: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Quaternion xyzw of a rotation matrix (3, 3): the largest eigenvector of Bar-Itzhack's symmetric
    matrix."""
    m = matrix
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] - m[1, 2]],
            [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
            [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    q = np.linalg.eigh(k)[1][:, -1]
    return (float(q[0]), float(q[1]), float(q[2]), float(q[3]))


def obj_of_parts(parts: Sequence[Part], mass: MassProperties) -> str:
    """Parts in the principal frame as a Wavefront OBJ, a group a part."""
    lines: list[str] = []
    offset = 1
    for number, (vertices, faces) in enumerate(parts):
        lines.append(f"o part{number}")
        for vertex in mass.to_principal(np.asarray(vertices, dtype=np.float64)):
            lines.append("v {:.9g} {:.9g} {:.9g}".format(*vertex))
        for face in np.asarray(faces):
            lines.append("f {} {} {}".format(*(int(i) + offset for i in face)))
        offset += len(vertices)
    return "\n".join(lines) + "\n"


def inverse(q: Quaternion) -> Quaternion:
    """The rotation back, of a unit quaternion xyzw."""
    x, y, z, w = q
    return (-x, -y, -z, w)


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Rotate by b, then by a; quaternions xyzw."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotate(q: Quaternion, v: Vector) -> Vector:
    """A vector rotated by a unit quaternion xyzw."""
    x, y, z, w = q
    tx, ty, tz = 2.0 * (y * v[2] - z * v[1]), 2.0 * (z * v[0] - x * v[2]), 2.0 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )


class End(Enum):
    """Why a closing ended."""

    STALLED = "stalled"
    EMPTY = "empty"
    TIMEOUT = "timeout"
    UNSTABLE = "unstable"
    SUNK = "sunk"


@dataclass(frozen=True)
class Contacts:
    """What presses on the object at one instant.

    ``normals`` (K, 3) are in the tool frame, into the object; ``forces`` (K,) newtons, as exerted with
    ``Gripper.closing_force_n``; ``fingers`` (K,) which body presses: 0 and 1 the fingers, -1 the palm;
    ``depths`` (K,) how deep it is in the object there, metres.
    """

    normals: NDArray[np.float64]
    forces: NDArray[np.float64]
    fingers: NDArray[np.int64]
    depths: NDArray[np.float64]

    @property
    def sunk_m(self) -> float:
        """By how much less the fingers are apart than what is between them, metres."""
        return float(sum(self.depths[self.fingers == one].max(initial=0.0) for one in (0, 1)))


@dataclass(frozen=True)
class Carried:
    """How the object came through a motion: whether both fingers still press on it at the end.

    ``translation_m`` is the farthest that the point of the object at the tool's origin moved from there,
    ``rotation_rad`` the farthest that the object turned in the jaw.
    """

    held: bool
    translation_m: float
    rotation_rad: float


@dataclass(frozen=True)
class Closing:
    """The jaw after a closing, and the object's pose in the tool frame.

    ``touched``: both fingers had touched the object at the same time. ``opening_m`` is between the fingers;
    of a stalled jaw, what it holds is this wide. ``contacts`` are several instants of a stalled jaw, none of
    any other; ``ratings`` weights held at these, over the object's, or ``carried`` what came of the
    motion, where one was asked for.
    """

    end: End
    touched: bool
    opening_m: float
    contacts: tuple[Contacts, ...]
    position: Vector
    quaternion_xyzw: Quaternion
    steps: int
    ratings: tuple[float, ...] = ()
    carried: Carried | None = None
