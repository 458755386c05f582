"""Triangles of a gripper's profile, in its tool frame: z approach, y closing.

Every shape is ``vertices`` (V, 3) in metres and ``faces`` (F, 3), counter-clockwise from outside.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graspdb.wire import GripperProfile

Floats = NDArray[np.float64]
_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
_BOX = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


class Shape(NamedTuple):
    """Triangles."""

    vertices: Floats
    faces: NDArray[np.int64]


def of_triangles(corners: Floats) -> Shape:
    """Triangles by their corners (F, 3, 3), those at one place being one vertex."""
    vertices, places = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return Shape(vertices, places.reshape(-1, 3))


def box(size: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0)) -> Shape:
    """A box with edges along the axes."""
    return Shape(np.asarray(centre) + 0.5 * np.asarray(size) * _SIGNS, _BOX)


def joined(*shapes: Shape) -> Shape:
    """Several shapes as one."""
    starts = np.cumsum([0, *(len(shape.vertices) for shape in shapes[:-1])])
    faces = [shape.faces + start for shape, start in zip(shapes, starts, strict=True)]
    return Shape(np.concatenate([shape.vertices for shape in shapes]), np.concatenate(faces))


def palm(profile: GripperProfile) -> Shape:
    """The box behind the fingers."""
    x, y, z = profile.palm_size_m
    return box((x, y, z), (0.0, 0.0, _root(profile) - z / 2))


def finger(profile: GripperProfile, side: float, opening_m: float) -> Shape:
    """The finger on the side of +y (1) or -y (-1) with the jaw so far open."""
    size = profile.finger
    across = side * (opening_m + size.thickness_m) / 2
    length = _tip(profile, opening_m) - _root(profile)
    return box((size.width_m, size.thickness_m, length), (0.0, across, _root(profile) + length / 2))


def fingers(profile: GripperProfile, opening_m: float | None = None) -> Shape:
    """Both fingers, wide open unless said."""
    opening = profile.max_opening_m if opening_m is None else opening_m
    return joined(finger(profile, 1.0, opening), finger(profile, -1.0, opening))


def gripper(profile: GripperProfile, opening_m: float | None = None) -> Shape:
    """Palm and both fingers, wide open unless said."""
    return joined(palm(profile), fingers(profile, opening_m))


def jaw(profile: GripperProfile) -> Shape:
    """The ends of the wide-open fingers as lines of the jaw's real measures: others are seen between."""
    opening, tip = profile.max_opening_m, profile.tip_offset_m
    long = min(profile.finger.length_m, 0.45 * opening)
    thin = 0.012 * opening
    half, root = opening / 2, tip - long
    sides = [box((thin, thin, long), (0.0, side * half, root + long / 2)) for side in (1.0, -1.0)]
    across = box((thin, opening + thin, thin), (0.0, 0.0, root))
    return joined(*sides, across, box((thin, thin, long / 2), (0.0, 0.0, root - long / 4)))


def ball(radius_m: float) -> Shape:
    """An icosahedron, which is round enough for a point."""
    golden = (1 + math.sqrt(5)) / 2
    corners = [
        point
        for a in (-1.0, 1.0)
        for b in (-golden, golden)
        for point in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))
    ]
    vertices = np.array(corners) / math.hypot(1.0, golden)
    near = np.linalg.norm(vertices[:, None] - vertices[None], axis=2) < 1.2
    faces = []
    for i in range(12):
        for j in range(i + 1, 12):
            for k in range(j + 1, 12):
                if near[i, j] and near[j, k] and near[i, k]:
                    outward = np.linalg.det(vertices[[i, j, k]]) > 0
                    faces.append([i, j, k] if outward else [i, k, j])
    return Shape(radius_m * vertices, np.array(faces))


def ellipsoid(radii_m: ArrayLike, sides: int = 24) -> Shape:
    """An ellipsoid along the axes, by circles of latitude."""
    polar, turn = np.meshgrid(
        np.linspace(0.0, math.pi, sides // 2 + 1), np.linspace(0.0, 2 * math.pi, sides + 1), indexing="ij"
    )
    unit = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
    row, column = np.meshgrid(np.arange(sides // 2), np.arange(sides), indexing="ij")
    corner = (row * (sides + 1) + column).ravel()
    below = corner + sides + 1
    faces = np.concatenate(
        [np.column_stack([corner, below, below + 1]), np.column_stack([corner, below + 1, corner + 1])]
    )
    return Shape(unit.reshape(-1, 3) * np.asarray(radii_m, dtype=np.float64), faces)


def cone(half_angle_deg: float, length_m: float, sides: int = 40) -> Shape:
    """A cone whose tip is the origin and which opens towards -z, at most a half space."""
    angle = math.radians(min(half_angle_deg, 89.0))
    turn = np.linspace(0.0, 2 * math.pi, sides, endpoint=False)
    rim = length_m * np.column_stack(
        [
            math.sin(angle) * np.cos(turn),
            math.sin(angle) * np.sin(turn),
            np.full(sides, -math.cos(angle)),
        ]
    )
    after = np.roll(np.arange(1, sides + 1), -1)
    faces = np.column_stack([np.zeros(sides, dtype=np.int64), after, np.arange(1, sides + 1)])
    return Shape(np.concatenate([np.zeros((1, 3)), rim]), faces)


def edges_of_box(size: ArrayLike) -> Floats:
    """The twelve edges of a box, (12, 2, 3)."""
    corners = 0.5 * np.asarray(size) * _SIGNS
    pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
    return np.asarray(corners[np.array(pairs)])


def _tip(profile: GripperProfile, opening_m: float) -> float:
    """Where the fingertips are along z, at one opening."""
    openings = [*(at.opening_m for at in profile.tip_offsets), profile.max_opening_m]
    offsets = [*(at.tip_offset_m for at in profile.tip_offsets), profile.tip_offset_m]
    return float(np.interp(opening_m, openings, offsets))


def _root(profile: GripperProfile) -> float:
    """Where the fingers begin along z."""
    return profile.tip_offset_m - profile.finger.length_m
