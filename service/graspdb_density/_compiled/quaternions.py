"""Rotations inside compiled loops: unit quaternions by their components x, y, z, w."""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from .options import inlined

__all__ = ["angle_factor", "relative", "turned_back"]

F32 = np.float32
_ONE = F32(1.0)


def _angle_coefficients() -> tuple[np.float32, ...]:
    """Power series in ``2 w - 1`` of the factor ``2 acos(w) / sqrt(1 - w^2)`` on [0, 1].

    It turns a unit quaternion's vector part into the rotation vector. Analytic up to w = -1, so degree 10
    leaves a relative error below float32's rounding.
    """
    w = 0.5 * (1.0 + np.cos(np.pi * (np.arange(64) + 0.5) / 64))
    factor = 2.0 * np.arccos(w) / np.sqrt(1.0 - w * w)
    series = np.polynomial.Chebyshev.fit(2.0 * w - 1.0, factor, 10, domain=[-1.0, 1.0])
    return tuple(F32(v) for v in series.convert(kind=np.polynomial.Polynomial).coef)


(_A0, _A1, _A2, _A3, _A4, _A5, _A6, _A7, _A8, _A9, _A10) = _angle_coefficients()


@inlined
def angle_factor(w):
    """Rotation angle over the sine of its half, for w = cos(angle / 2) in [0, 1]."""
    t = w + w - _ONE
    y = _A10 * t + _A9
    y = y * t + _A8
    y = y * t + _A7
    y = y * t + _A6
    y = y * t + _A5
    y = y * t + _A4
    y = y * t + _A3
    y = y * t + _A2
    y = y * t + _A1
    return y * t + _A0


@inlined
def relative(ax, ay, az, aw, bx, by, bz, bw):
    """The rotation from a to b in the frame of a, ``a^-1 b``."""
    return (
        aw * bx - ax * bw - ay * bz + az * by,
        aw * by + ax * bz - ay * bw - az * bx,
        aw * bz - ax * by + ay * bx - az * bw,
        aw * bw + ax * bx + ay * by + az * bz,
    )


@inlined
def turned_back(x, y, z, w, dx, dy, dz):
    """A vector in the frame of a quaternion: R^T d."""
    # t = 2 (-v) x d; d + w t + (-v) x t.
    tx = 2.0 * (z * dy - y * dz)
    ty = 2.0 * (x * dz - z * dx)
    tz = 2.0 * (y * dx - x * dy)
    return (
        dx + w * tx + z * ty - y * tz,
        dy + w * ty + x * tz - z * tx,
        dz + w * tz + y * tx - x * ty,
    )
