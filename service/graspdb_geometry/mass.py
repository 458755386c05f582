"""Volume, centre of mass and inertia of the solid within triangles, and how far they can be trusted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from graspdb_geometry.mesh_reading.content import FloatArray

IntArray = npt.NDArray[np.int64]

#: Lines through a mesh along each of two sides that look for places it encloses twice; half of a large one.
_LINES_A_SIDE = 20
_MANY = 200_000
#: A rotation to a direction that no edge of a modelled part has: by 0.3, 0.5 and 0.7 rad about z, y and x.
_TILT = Rotation.from_euler("zyx", [0.3, 0.5, 0.7]).as_matrix()
#: Comparisons of a line with a triangle at once.
_BLOCK = 4_000_000


class SolidMeasures(NamedTuple):
    """Volume (m^3), centre of mass (3,) and inertia (3, 3) about it at unit density (m^5)."""

    volume: float
    centre: FloatArray
    inertia: FloatArray


def area(corners: FloatArray) -> float:
    """Area of triangles (F, 3, 3)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * float(np.linalg.norm(normals, axis=1).sum())


def surface_centre(corners: FloatArray) -> FloatArray:
    """Middle of the surface of triangles (F, 3, 3), weighed by area, (3,)."""
    spans = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(np.average(corners.mean(axis=1), axis=0, weights=np.linalg.norm(spans, axis=1)))


def mass_properties(corners: FloatArray) -> SolidMeasures:
    """Of the solid within outward triangles (F, 3, 3), metres.

    Sums over signed tetrahedra from a point near the mesh (Tonon, "Explicit exact formulas for the 3-D
    tetrahedron inertia tensor", J. Math. Stat. 1, 2005, in covariance form).
    """
    origin = corners.reshape(-1, 3).mean(axis=0)  # near the mesh, or distant meshes would cancel badly
    tetrahedra = corners - origin
    signed = np.einsum("ij,ij->i", tetrahedra[:, 0], np.cross(tetrahedra[:, 1], tetrahedra[:, 2])) / 6.0
    volume = float(signed.sum())
    if volume == 0.0:
        return SolidMeasures(0.0, origin, np.zeros((3, 3)))
    total = tetrahedra.sum(axis=1)
    centre = np.einsum("i,ij->j", signed, total) / (4.0 * volume)
    # Integral of x x^T over a tetrahedron with a corner at 0: V / 20 (sum of a a^T over corners + s s^T).
    second = np.einsum("i,ikj,ikl->jl", signed, tetrahedra, tetrahedra)
    second += np.einsum("i,ij,il->jl", signed, total, total)
    covariance = second / 20.0 - volume * np.outer(centre, centre)
    inertia = np.trace(covariance) * np.eye(3) - covariance
    return SolidMeasures(volume, origin + centre, inertia)


def share_counted_wrong(corners: FloatArray, *, seed: int = 0) -> float:
    """The share of a closed surface's volume that it does not enclose exactly once, by lines through it.

    A surface that runs through itself encloses places twice, or inside out: sums over its triangles count
    them so. Zero for a solid; the same input gives the same answer.

    Parameters
    ----------
    corners : (F, 3, 3) float64
        Closed, outward triangles.
    """
    rng = np.random.default_rng(seed)
    turned = corners @ _TILT
    flat, height = turned[:, :, :2], turned[:, :, 2]
    low, high = flat.min(axis=1), flat.max(axis=1)
    lower, upper = low.min(axis=0), high.max(axis=0)
    side = _LINES_A_SIDE if len(corners) <= _MANY else _LINES_A_SIDE // 2
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    lines = lower + (cells + rng.random(cells.shape)) / side * (upper - lower)
    once = wrong = 0.0
    block = max(1, _BLOCK // len(corners))
    for first in range(0, len(lines), block):
        some = lines[first : first + block]
        boxed = np.all((low <= some[:, None]) & (high >= some[:, None]), axis=2)
        line, triangle = np.nonzero(boxed)
        crossing, z, sign = _crossings(some[line], flat[triangle], height[triangle])
        right, not_right = _lengths(line[crossing], z, sign)
        once, wrong = once + right, wrong + not_right
    return wrong / (once + wrong) if once + wrong > 0.0 else 0.0


def _crossings(
    points: FloatArray, flat: FloatArray, height: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Which of the lines (n, 2) along z meet their triangles (n, 3, 2), where, and 1 where they leave."""
    a, b, c = (flat[:, k] - points for k in range(3))
    weights = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)
    hit = np.all(weights >= 0.0, axis=1) | np.all(weights <= 0.0, axis=1)
    total = weights.sum(axis=1)
    hit &= total != 0.0
    z = np.einsum("ij,ij->i", weights[hit], height[hit]) / total[hit]
    return np.flatnonzero(hit), z, np.sign(total[hit])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _lengths(line: IntArray, z: FloatArray, sign: FloatArray) -> tuple[float, float]:
    """Along lines with crossings: how much of them is inside once, and how much otherwise but not outside."""
    order = np.lexsort((z, line))
    line, z, sign = line[order], z[order], sign[order]
    inside = np.cumsum(-sign)
    new = np.diff(line, prepend=-1) != 0
    # A line through an edge may miss a crossing: it tells nothing.
    number = np.cumsum(new) - 1
    kept = (np.bincount(number, sign) == 0.0)[number]
    start = np.flatnonzero(new)
    inside -= (inside + sign)[start][number]
    length = np.where(np.append(new[1:], True), 0.0, np.append(np.diff(z), 0.0))
    counts = kept & (length > 0.0)
    once = counts & (inside == 1.0)
    wrong = counts & (inside != 1.0) & (inside != 0.0)
    return float(length[once].sum()), float(length[wrong].sum())
