"""Points of a sensor against a convex solid."""

# Numba infers the types of compiled functions.
# mypy: allow-untyped-defs

from __future__ import annotations

from numba import njit

__all__ = ["meets_points"]


@njit(fastmath=True, error_model="numpy", nogil=True, cache=True)
def meets_points(place, planes, middle, reach, points, radius):
    """Whether a point (K, 3) is within ``radius`` of every plane (P, 4: normal, offset) of a solid.

    That is all within the radius of the solid, and a little more beyond its edges and corners. ``place``
    (4, 4) is the solid's frame; ``middle`` (3,) and ``reach`` are the ball about it.
    """
    near = (reach + radius) ** 2
    for k in range(len(points)):
        a, b, c = points[k, 0] - place[0, 3], points[k, 1] - place[1, 3], points[k, 2] - place[2, 3]
        x = place[0, 0] * a + place[1, 0] * b + place[2, 0] * c
        y = place[0, 1] * a + place[1, 1] * b + place[2, 1] * c
        z = place[0, 2] * a + place[1, 2] * b + place[2, 2] * c
        if (x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2 > near:
            continue
        inside = True
        for i in range(len(planes)):
            if planes[i, 0] * x + planes[i, 1] * y + planes[i, 2] * z + planes[i, 3] > radius:
                inside = False
                break
        if inside:
            return True
    return False
