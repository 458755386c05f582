"""Rotations inside compiled loops: unit quaternions by their components x, y, z, w."""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

from .options import inlined

__all__ = ["relative", "turned_back"]


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
