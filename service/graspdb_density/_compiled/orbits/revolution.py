"""All turns about an axis of revolution.

No image is made: attempts and poses are turned to one half-plane through the axis (x away from it, z along
it), and the turn between two is the one at which they are nearest. A turn by phi takes the exponent of
position to ``d^2 + 2 r s (1 - cos phi)`` for distances r and s from the axis, and the cosine of half the
angle between the rotations to ``A cos(phi / 2 - beta)``.
"""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from ..diagonal import rotation_vector
from ..isotropic import BLOCK, COUNT, OFFSET, TWIN, empty_runs, place, runs_within
from ..options import exact, inlined
from ..quaternions import turned_back
from .images import totals

__all__ = ["revolution_displacements", "revolution_sums"]

#: Parabolas laid towards the nearest turn, through what lies so far apart, in radians of half the turn.
_PARABOLAS, _APART = 2, 0.02


@exact
def _displaced(r, s, dz, ax, ay, az, aw, bx, by, bz, bw, psi, half, turning):
    """From a row that is turned by 2 psi about the axis to a pose: translation (3), rotation vector (3), and
    the exponents of either.
    """
    c, d = math.cos(psi), math.sin(psi)
    # The turn times the row's rotation.
    ex, ey, ez, ew = c * ax - d * ay, c * ay + d * ax, c * az + d * aw, c * aw - d * az
    x, y, z = r - s * (1.0 - 2.0 * d * d), -2.0 * s * c * d, dz
    if turning:
        x, y, z = turned_back(ex, ey, ez, ew, x, y, z)
    u, v, t = rotation_vector(ex, ey, ez, ew, bx, by, bz, bw)
    moved = half[0] * x * x + half[1] * y * y + half[2] * z * z
    turned = half[3] * u * u + half[4] * v * v + half[5] * t * t
    return x, y, z, u, v, t, moved, turned


@inlined
def _turned(r, s, a, b, weight, kappa):
    """Of a row whose rotation's cosine with a pose's is ``a``, and ``b`` after half a turn: what the exponent
    of the nearest turn lies above that of no distance but across the half-plane, and the sine and cosine of
    that turn times a length.

    1 - cos x is taken for sin^2 x / 2, which is less: by an eighth where half an angle is 45 degrees.
    """
    most = math.sqrt(a * a + b * b)
    lever, turn = 2.0 * weight * r * s, 0.25 * kappa * most
    away, along = 0.0, lever + turn
    if most > 0.0:
        # The turn at which rotations are nearest, 2 beta, by the doubled angle of (a, b).
        away = turn * 2.0 * a * b / (most * most)
        along = lever + turn * (a * a - b * b) / (most * most)
    apart = kappa * (1.0 - most) + lever + turn - math.sqrt(away * away + along * along)
    return apart, away, along


@exact
def _nearest_along_axes(r, s, dz, ax, ay, az, aw, bx, by, bz, bw, psi, half, turning):
    """Half the turn near ``psi`` at which a row is nearest under widths for every axis, and the exponent."""
    e = 1e30
    for _ in range(_PARABOLAS):
        middle = _displaced(r, s, dz, ax, ay, az, aw, bx, by, bz, bw, psi, half, turning)
        e = middle[6] + middle[7]
        before = _displaced(r, s, dz, ax, ay, az, aw, bx, by, bz, bw, psi - _APART, half, turning)
        after = _displaced(r, s, dz, ax, ay, az, aw, bx, by, bz, bw, psi + _APART, half, turning)
        low, high = before[6] + before[7], after[6] + after[7]
        curve = low + high - 2.0 * e
        if curve > 0.0:
            step = 0.5 * _APART * (low - high) / curve
            psi += max(-0.5, min(0.5, step))
    last = _displaced(r, s, dz, ax, ay, az, aw, bx, by, bz, bw, psi, half, turning)
    return psi, last[6] + last[7]


@inlined
def _bounds(half, kappa):
    """Weights of a squared distance and of 1 - the cosine of half an angle that no exponent lies below."""
    if kappa > 0.0:
        return 1.0, kappa
    return min(half[0], min(half[1], half[2])), 8.0 * min(half[3], min(half[4], half[5]))


@exact
def _nearest(at, r, i, data, s, twin, half, kappa, weight, concentration, cut, turning):
    """The least exponent of a row, or of its twin, over all turns, half that turn, and whether it is the
    twin's; 1e30 beyond the cut.
    """
    dr, dz = r - s, at.z - data[2, i]
    base = weight * (dr * dr + dz * dz)
    best, chosen, second = 1e30, 0.0, False
    for which in range(2 if twin else 1):
        ax, ay, az, aw = data[3, i], data[4, i], data[5, i], data[6, i]
        if which:
            # The row turned about its z: q times (0, 0, 1, 0).
            ax, ay, az, aw = data[4, i], -data[3, i], data[6, i], -data[5, i]
        a = ax * at.qx + ay * at.qy + az * at.qz + aw * at.qw
        b = ax * at.qy - ay * at.qx + aw * at.qz - az * at.qw
        apart, away, along = _turned(r, s, a, b, weight, concentration)
        e = base + apart
        if e > cut or e >= best:
            continue
        psi = 0.5 * math.atan2(away, along)
        if kappa <= 0.0:
            psi, e = _nearest_along_axes(
                r, s, dz, ax, ay, az, aw, at.qx, at.qy, at.qz, at.qw, psi, half, turning
            )  # fmt: skip
        if e < best:
            best, chosen, second = e, psi, which == 1
    return best, chosen, second


@exact
def revolution_sums(cells, positions, quaternions, half, kappa, turning, radius, out):
    """As `image_sums`, over all turns about an axis: rows and images (M, n, 3), (M, n, 4) lie in one
    half-plane; of twins, too, the nearer one counts.
    """
    runs, cut, data = empty_runs(cells, BLOCK), radius * radius, cells.data
    weight, concentration = _bounds(half, kappa)
    off = cells.centre[0] * cells.scale
    largest = np.zeros(data.shape[1])
    reached = np.empty(data.shape[1], dtype=np.int64)
    for j in range(positions.shape[0]):
        count, least, nearest = 0, 1e30, -1
        for n in range(positions.shape[1]):
            at = place(cells, positions[j, n], quaternions[j, n], 1.0)
            bx, by, bz, bw = at.qx, at.qy, at.qz, at.qw
            for r in range(runs_within(cells, at, radius, BLOCK, runs)):
                twin = runs[r, 2] > 0
                for i in range(runs[r, 0], runs[r, 1]):
                    x, z = at.x - data[0, i], at.z - data[2, i]
                    base = weight * (x * x + z * z)
                    if base > cut:
                        continue
                    e = 1e30
                    if kappa > 0.0:
                        # As `_nearest`, without the turn itself.
                        ax, ay, az, aw = data[3, i], data[4, i], data[5, i], data[6, i]
                        s, needed = data[0, i] + off, 1.0 - (cut - base) / kappa
                        a = ax * bx + ay * by + az * bz + aw * bw
                        b = ax * by - ay * bx + aw * bz - az * bw
                        # What no turn changes of the rotations already tells of most rows.
                        if needed <= 0.0 or a * a + b * b >= needed * needed:
                            e = base + _turned(at.x + off, s, a, b, weight, kappa)[0]
                        if twin:
                            a = ay * bx - ax * by + aw * bz - az * bw
                            b = ay * by + ax * bx - az * bz - aw * bw
                            if needed <= 0.0 or a * a + b * b >= needed * needed:
                                e = min(e, base + _turned(at.x + off, s, a, b, weight, kappa)[0])
                    else:
                        e, _, _ = _nearest(
                            at, at.x + off, i, data, data[0, i] + off, twin, half, kappa, weight,
                            concentration, cut, turning,
                        )  # fmt: skip
                    if e > cut:
                        continue
                    if e < least:
                        least, nearest = e, i
                    k = math.exp(-e)
                    if largest[i] == 0.0:
                        reached[count] = i
                        count += 1
                    largest[i] = max(largest[i], k)
        totals(largest, reached, count, least, nearest, out[j])


@exact
def revolution_displacements(cells, places, positions, quaternions, half, kappa, turning, out):
    """As `diagonal.displacements`, from the row at its place, turned to where it is nearest to an image."""
    table, data, scale = cells.table, cells.data, cells.scale
    weight, concentration = _bounds(half, kappa)
    off = cells.centre[0] * scale
    for j in range(positions.shape[0]):
        i, twin, least = places[j], False, 1e30
        for s in range(table.shape[0]):
            if table[s, OFFSET] <= i < table[s, OFFSET] + table[s, COUNT]:
                twin = table[s, TWIN] > 0.0
        for n in range(positions.shape[1]):
            at = place(cells, positions[j, n], quaternions[j, n], 1.0)
            r, s = at.x + off, data[0, i] + off
            e, psi, second = _nearest(
                at, r, i, data, s, twin, half, kappa, weight, concentration, 1e29, turning
            )  # fmt: skip
            if e >= least:
                continue
            least = e
            ax, ay, az, aw = data[3, i], data[4, i], data[5, i], data[6, i]
            if second:
                ax, ay, az, aw = ay, -ax, aw, -az
            x, y, z, u, v, t, moved, turned = _displaced(
                r, s, at.z - data[2, i], ax, ay, az, aw, at.qx, at.qy, at.qz, at.qw, psi, half, turning
            )  # fmt: skip
            out[j, 0] = math.sqrt(x * x + y * y + z * z) / scale
            out[j, 1] = math.sqrt(u * u + v * v + t * t)
            out[j, 2] = math.sqrt(2.0 * moved)
            out[j, 3] = math.sqrt(2.0 * turned)
            if not turning:
                c, d = math.cos(psi), math.sin(psi)
                x, y, z = turned_back(
                    c * ax - d * ay, c * ay + d * ax, c * az + d * aw, c * aw - d * az, x, y, z
                )
            out[j, 4], out[j, 5], out[j, 6] = x / scale, y / scale, z / scale
            out[j, 7], out[j, 8], out[j, 9] = u, v, t
