"""Numba kernel: what each finger of a closing jaw would touch, by lines between the fingers.

Lines along the closing direction stand at the middles of a raster over the pads. Where a line first meets the
surface from either side is what that finger finds there.
"""

from __future__ import annotations

import numba as nb
import numpy as np
import numpy.typing as npt

from graspdb_geometry._compiled.convex import _rotation, _to_tool
from graspdb_geometry._compiled.surface import _STACK, Tree, _boxes_apart

FloatArray = npt.NDArray[np.float64]

#: Lines across a pad's width and along its length.
ACROSS, ALONG = 7, 14
#: Lines that a finger meets within these depths of the first touch it, metres: pads give, and parts settle.
_TOUCH = np.array([0.0005, 0.002])
#: Numbers of a finger: for either depth its lines, the middle of these (x, z) and their mean normal; of the
#: deeper the least and greatest x and z; the finger's travel; how far other lines lie behind on the mean.
OF_A_FINGER = 18
_PER_TOUCH, _LIMITS, _TRAVEL, _BEHIND = 6, 12, 16, 17
#: Lines behind by more count as this, metres.
_FARTHEST = 0.02


@nb.njit(cache=True, nogil=True)
def _meet(
    p: FloatArray, r: FloatArray, column: FloatArray, tree: Tree, first: FloatArray, normals: FloatArray
) -> None:
    """Fill first (2, ACROSS, ALONG), least and greatest y at which each line meets the surface, and the
    normals (2, ACROSS, ALONG, 3) there; untouched where it does not.
    """
    nodes, links, triangles = tree
    c, h = column[0], column[1]
    step_x, step_z = 2.0 * h[0] / ACROSS, 2.0 * h[2] / ALONG
    x0, z0 = c[0] - h[0] + 0.5 * step_x, c[2] - h[2] + 0.5 * step_z
    scratch = np.empty(3)
    t = np.empty((3, 3))
    n = np.empty(3)
    stack = np.empty(_STACK, dtype=np.int64)
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if _boxes_apart(c, h, nodes[node], p, r, scratch):
            continue
        if links[node, 0] >= 0:
            stack[depth] = links[node, 0]
            stack[depth + 1] = links[node, 1]
            depth += 2
            continue
        for f in range(-1 - links[node, 0], links[node, 1]):
            for v in range(3):
                _to_tool(triangles[f, v], p, r, t[v])
            u0, u1, u2 = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
            v0, v1, v2 = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
            n[0], n[1], n[2] = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
            if n[1] == 0.0:
                continue  # it lies along the lines
            n /= np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
            turned = u0 * v2 - u2 * v0
            low_x, high_x = min(t[0, 0], t[1, 0], t[2, 0]), max(t[0, 0], t[1, 0], t[2, 0])
            low_z, high_z = min(t[0, 2], t[1, 2], t[2, 2]), max(t[0, 2], t[1, 2], t[2, 2])
            begin_x = max(0, int(np.ceil((low_x - x0) / step_x)))
            begin_z = max(0, int(np.ceil((low_z - z0) / step_z)))
            for i in range(begin_x, min(ACROSS - 1, int(np.floor((high_x - x0) / step_x))) + 1):
                dx = x0 + i * step_x - t[0, 0]
                for j in range(begin_z, min(ALONG - 1, int(np.floor((high_z - z0) / step_z))) + 1):
                    dz = z0 + j * step_z - t[0, 2]
                    a = (dx * v2 - dz * v0) / turned
                    b = (u0 * dz - u2 * dx) / turned
                    if a < 0.0 or b < 0.0 or a + b > 1.0:
                        continue
                    y = t[0, 1] + a * u1 + b * v1
                    if abs(y - c[1]) > h[1]:
                        continue
                    if y < first[0, i, j]:
                        first[0, i, j] = y
                        normals[0, i, j] = n
                    if y > first[1, i, j]:
                        first[1, i, j] = y
                        normals[1, i, j] = n


@nb.njit(cache=True, nogil=True)
def _finger(
    side: int, extreme: float, column: FloatArray, first: FloatArray, normals: FloatArray, out: FloatArray
) -> None:
    """Fill the numbers of one finger, the one at -y for side 0."""
    c, h = column[0], column[1]
    step_x, step_z = 2.0 * h[0] / ACROSS, 2.0 * h[2] / ALONG
    out[:] = 0.0
    out[_LIMITS] = out[_LIMITS + 2] = np.inf
    out[_LIMITS + 1] = out[_LIMITS + 3] = -np.inf
    met = 0
    for i in range(ACROSS):
        x = c[0] - h[0] + (i + 0.5) * step_x
        for j in range(ALONG):
            if not np.isfinite(first[0, i, j]):
                continue
            met += 1
            z = c[2] - h[2] + (j + 0.5) * step_z
            behind = abs(first[side, i, j] - extreme)
            out[_BEHIND] += min(behind, _FARTHEST)
            for k in range(2):
                if behind > _TOUCH[k]:
                    continue
                at = k * _PER_TOUCH
                out[at] += 1.0
                out[at + 1] += x
                out[at + 2] += z
                for a in range(3):
                    out[at + 3 + a] += normals[side, i, j, a]
            if behind <= _TOUCH[1]:
                out[_LIMITS] = min(out[_LIMITS], x)
                out[_LIMITS + 1] = max(out[_LIMITS + 1], x)
                out[_LIMITS + 2] = min(out[_LIMITS + 2], z)
                out[_LIMITS + 3] = max(out[_LIMITS + 3], z)
    out[_BEHIND] /= met
    for k in range(2):
        at = k * _PER_TOUCH
        for a in range(1, _PER_TOUCH):
            out[at + a] /= out[at]
        # Towards the finger, whose side it is.
        out[at + 4] *= 1.0 if side == 1 else -1.0
    out[_TRAVEL] = h[1] - (extreme - c[1] if side == 1 else c[1] - extreme)


@nb.njit(cache=True, nogil=True)
def fingers(p: FloatArray, q: FloatArray, column: FloatArray, tree: Tree, out: FloatArray) -> None:
    """Fill out (n, 2 * OF_A_FINGER + 4): what the finger at -y would touch, and the one at +y; the object's
    extent along y where both touch, how far its middle is off the jaw's, how many lines meet it, and their
    mean length in it; NaN where no line does.

    Parameters
    ----------
    column : (2, 3)
        Centre and half extents of what lies between the open fingers, tool frame.
    """
    first = np.empty((2, ACROSS, ALONG))
    normals = np.zeros((2, ACROSS, ALONG, 3))
    r = np.empty((3, 3))
    for i in range(p.shape[0]):
        _rotation(q[i], r)
        first[0] = np.inf
        first[1] = -np.inf
        _meet(p[i], r, column, tree, first, normals)
        low, high, met, inside = np.inf, -np.inf, 0, 0.0
        for a in range(ACROSS):
            for b in range(ALONG):
                if np.isfinite(first[0, a, b]):
                    met += 1
                    low = min(low, first[0, a, b])
                    high = max(high, first[1, a, b])
                    inside += first[1, a, b] - first[0, a, b]
        if met == 0:
            out[i] = np.nan
            continue
        _finger(0, low, column, first, normals, out[i, :OF_A_FINGER])
        _finger(1, high, column, first, normals, out[i, OF_A_FINGER : 2 * OF_A_FINGER])
        rest = out[i, 2 * OF_A_FINGER :]
        rest[0], rest[1], rest[2], rest[3] = high - low, 0.5 * (high + low) - column[0, 1], met, inside / met
