"""The grid that a sweep tries, made once more from its definition, by code that shares nothing with ours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def turn(axis: int, angle: float) -> NDArray[np.float64]:
    """The rotation matrix about a coordinate axis."""
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[a, a] = matrix[b, b] = np.cos(angle)
    matrix[b, a] = np.sin(angle)
    matrix[a, b] = -np.sin(angle)
    return matrix


def pixel_directions(nside: int) -> list[tuple[float, float]]:
    """Colatitude and longitude of the 12 nside^2 HEALPix pixels, ring by ring from the north."""
    rings = []
    for ring in range(1, 4 * nside):
        south = ring > 2 * nside
        i = 4 * nside - ring if south else ring
        if i < nside:  # the cap's ring i has 4 i pixels
            z = 1 - i**2 / (3 * nside**2)
            longitudes = [np.pi / (2 * i) * (j - 0.5) for j in range(1, 4 * i + 1)]
        else:  # the belt's rings have 4 nside, every second one shifted by half a pixel
            z = 4 / 3 - 2 * i / (3 * nside)
            shift = 0.5 if (i - nside) % 2 == 0 else 0.0
            longitudes = [np.pi / (2 * nside) * (j + shift) for j in range(4 * nside)]
        rings += [(np.arccos(-z if south else z), longitude) for longitude in longitudes]
    return rings


def full_grid(
    box_m: tuple[float, float, float], step_m: float, rotation_step_deg: float, margin_m: float
) -> dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Position and rotation matrix of every pose that a symmetric gripper is swept over, by pose index."""
    nside = round(60 / rotation_step_deg)
    turns = 6 * nside
    rotations = {}
    for pixel, (theta, phi) in enumerate(pixel_directions(nside)):
        tilt = turn(2, phi) @ turn(1, theta) @ turn(2, -phi)
        # Of each pair that the jaw's half turn exchanges the first is kept.
        for k in range(turns // 2):
            rotations[pixel * turns + k] = tilt @ turn(2, 2 * np.pi * k / turns)
    reach = [round((size / 2 + margin_m) / step_m) for size in box_m]
    count = [2 * r + 1 for r in reach]
    grid = {}
    for ix in range(count[0]):
        for iy in range(count[1]):
            for iz in range(count[2]):
                position = (np.array([ix, iy, iz]) - reach) * step_m
                place = (ix * count[1] + iy) * count[2] + iz
                for rotation, matrix in rotations.items():
                    grid[place * 12 * nside**2 * turns + rotation] = (position, matrix)
    return grid


def matrices(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices of quaternions xyzw, by turning the three axes."""
    v, w = quaternions[:, None, :3], quaternions[:, None, 3:]
    axes = np.eye(3)[None]
    turned = axes + 2 * np.cross(v, np.cross(v, axes) + w * axes)
    return np.swapaxes(turned, 1, 2)
