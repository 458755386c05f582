"""Bodies drawn by rays: lit by the sky from all sides and by a lamp, each casting shadows, outlined.

Light comes from fixed directions, of which every sample of a pixel takes its own share: so shadows are soft
and the picture has no noise, and the same scene gives the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from graspdb_geometry.picturing.surfaces import Body, Floats
from graspdb_geometry.picturing.views import FIELD_OF_VIEW_DEG, View

F = TypeVar("F", np.float32, np.float64)
Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Singles = NDArray[np.float32]

_SAMPLES = 2
"""A pixel has so many samples along either side, for smooth edges."""
_DIRECTIONS = 64
"""Where the sky's light comes from: shared out between the samples of a pixel."""
_LAMP = (-0.45, 0.75, 0.85)
"""Where the lamp is, along the picture's axes: from the left, above, and before it."""
_LAMP_SPREAD = 0.10
_SKY, _LAMP_LIGHT = 0.72, 0.78
_OUTLINE = np.array([0.035, 0.04, 0.05])
_STEEP = 0.02
"""Neighbouring samples whose distances differ by more than this share are on two surfaces."""
_TOP, _BOTTOM = np.array([1.0, 1.0, 1.0]), np.array([0.82, 0.84, 0.87])
_GAMMA = 2.2
_LIFTED = 2e-4
"""Light is looked for from so far above the surface, in sizes of the scene: else it would shade itself."""
_RAYS = 65_536
"""Rays at a time, between two breaths."""
_FAR = 1e6


class Seen(NamedTuple):
    """What rays (n,) met: a triangle or -1, how far, where in it, and which way (n, 3) they went."""

    triangle: Ints
    far: Singles
    u: Singles
    v: Singles
    ways: Singles


class Stage:
    """Bodies ready to be looked at; ``breathe`` is called every few thousand rays.

    Needs Embree's bindings (``embreex``): ImportError without.
    """

    def __init__(self, bodies: Sequence[Body], breathe: Callable[[], None] = lambda: None) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._breathe = breathe
        corners = np.concatenate([body.corners for body in bodies])
        # In single precision, which is Embree's: about the middle and of unit size, whatever the scene's.
        self._size = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
        self._middle = corners.reshape(-1, 3).mean(axis=0)
        self._corners = self._scaled(corners)
        self._normals = np.concatenate([body.normals for body in bodies]).astype(np.float32)
        first, second, third = (self._corners[:, k] for k in range(3))
        self._flat = _unit(np.cross(second - first, third - first))
        self._body = np.repeat(np.arange(len(bodies)), [len(body.corners) for body in bodies])
        # Colours are told as screens show them.
        self._colours = np.array([body.colour for body in bodies], dtype=np.float32) ** _GAMMA
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, self._corners)

    def counted(self, view: View, width: int, height: int) -> Ints:
        """How many pixels of a picture of this size each body would have."""
        triangle = self._seen(view, width, height, np.arange(width * height)).triangle
        return np.bincount(self._body[triangle[triangle >= 0]], minlength=len(self._colours))

    def draw(self, view: View, width: int, height: int) -> Bytes:
        """A picture (height, width, 3)."""
        wide, high = _SAMPLES * width, _SAMPLES * height
        shade = np.linspace(0.0, 1.0, high)[:, None] ** 1.5
        rows = (1 - shade) * _TOP**_GAMMA + shade * _BOTTOM**_GAMMA
        light = np.repeat(rows.astype(np.float32), wide, axis=0)
        bodies = np.full(wide * high, -1)
        far = np.full(wide * high, _FAR, dtype=np.float32)
        # By parts, so that a large picture takes little memory beside its own.
        for start in range(0, wide * high, _RAYS):
            places = np.arange(start, min(start + _RAYS, wide * high))
            seen = self._seen(view, wide, high, places)
            hit = np.flatnonzero(seen.triangle >= 0)
            row, column = np.divmod(places[hit], wide)
            share = (row % _SAMPLES) * _SAMPLES + column % _SAMPLES
            light[places[hit]] = self._shaded(view, seen, hit, share)
            bodies[places[hit]], far[places[hit]] = self._body[seen.triangle[hit]], seen.far[hit]
        light[_edges(bodies, far, (high, wide))] = _OUTLINE
        smooth = light.reshape(height, _SAMPLES, width, _SAMPLES, 3).mean(axis=(1, 3))
        return np.asarray(np.rint(255.0 * np.clip(smooth, 0.0, 1.0) ** (1 / _GAMMA)), dtype=np.uint8)

    def _scaled(self, points: Floats) -> Singles:
        return np.ascontiguousarray((points - self._middle) / self._size, dtype=np.float32)

    def _seen(self, view: View, width: int, height: int, places: Ints) -> Seen:
        """What rays through the middles of some pixels (n,) meet, counted row by row from above."""
        self._breathe()
        tangent = math.tan(math.radians(0.5 * FIELD_OF_VIEW_DEG))
        row, column = np.divmod(places[:, None], width)
        across = (2 * column + 1 - width) / height * tangent
        along = (height - 1 - 2 * row) / height * tangent
        right, up, towards = view.axes
        ways = _unit(across * right + along * up - towards).astype(np.float32)
        eyes = np.tile(self._scaled(np.asarray(view.eye)), (len(ways), 1))
        found = self._scene.run(eyes, ways, query="INTERSECT", output=True)
        return Seen(found["primID"], found["tfar"], found["u"], found["v"], ways)

    def _shaded(self, view: View, seen: Seen, hit: Ints, share: Ints) -> Singles:
        """Linear light (n, 3) of samples that hit something, each with its ``share`` of the directions."""
        triangle = seen.triangle[hit]
        u, v, ways = seen.u[hit, None], seen.v[hit, None], seen.ways[hit]
        within = (1 - u - v, u, v)
        points = sum(part * self._corners[triangle, k] for k, part in enumerate(within))
        normal = _unit(sum(part * self._normals[triangle, k] for k, part in enumerate(within)))
        face = self._flat[triangle]
        # Both sides of an open surface are seen.
        back = np.einsum("nc,nc->n", face, ways) > 0
        normal[back], face[back] = -normal[back], -face[back]
        start = points + _LIFTED * face
        sky, lamp = self._directions(view)
        lit = np.empty((len(hit), 1), dtype=np.float32)
        for k in range(_SAMPLES**2):
            mine = np.flatnonzero(share == k)
            args = start[mine], normal[mine], face[mine]
            lit[mine, 0] = _SKY * self._light(*args, sky[k :: _SAMPLES**2])
            lit[mine, 0] += _LAMP_LIGHT * self._light(*args, lamp[k :: _SAMPLES**2])
        towards = -np.einsum("nc,nc->n", normal, ways)[:, None]
        lit += 0.10 * np.clip(towards, 0.0, 1.0)
        return np.asarray(self._colours[self._body[triangle]] * lit, dtype=np.float32)

    def _directions(self, view: View) -> tuple[Floats, Floats]:
        """Directions of the sky's light, most from above, and the lamp's, (n, 4): the last is how much."""
        up = np.asarray(view.up)
        place = np.arange(_DIRECTIONS) + 0.5
        height = 1 - 2 * place / _DIRECTIONS
        turn = math.pi * (1 + math.sqrt(5)) * place
        flat = np.sqrt(1 - height**2)
        ball = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
        strength = 0.6 + 0.4 * ball @ up
        # A white surface that faces up, and that nothing shades, has light 1.
        strength /= np.sum(strength * np.clip(ball @ up, 0.0, None)) / _SAMPLES**2
        order = np.random.default_rng(0).permutation(_DIRECTIONS)
        sky = np.column_stack([ball, strength])[order]
        right, upward, towards = view.axes
        middle = _LAMP[0] * right + _LAMP[1] * upward + _LAMP[2] * towards
        near = middle / np.linalg.norm(middle) + _LAMP_SPREAD * ball[:: _DIRECTIONS // 16]
        near /= np.linalg.norm(near, axis=1, keepdims=True)
        near = near[np.random.default_rng(1).permutation(len(near))]
        lamp = np.column_stack([near, np.full(len(near), _SAMPLES**2 / len(near))])
        return sky, lamp

    def _light(self, start: Singles, normal: Singles, face: Singles, lights: Floats) -> Singles:
        """How much light comes to points (n,) from directions, each where nothing is in its way."""
        found = np.zeros(len(start), dtype=np.float32)
        for x, y, z, strength in lights.astype(np.float32):
            way = np.array([x, y, z])
            cosine = np.where(face @ way > 0, normal @ way, 0.0)
            facing = np.flatnonzero(cosine > 0)
            self._breathe()
            ways = np.tile(way, (len(facing), 1))
            free = self._scene.run(start[facing], ways, query="OCCLUDED") < 0
            found[facing] += np.where(free, strength * cosine[facing], 0.0)
        return found


def _edges(bodies: Ints, far: Singles, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Where one surface ends and another begins, (n,)."""
    far, bodies = far.reshape(shape), bodies.reshape(shape)
    edge = np.zeros(shape, dtype=bool)
    for axis in (0, 1):
        inner = tuple(slice(1, None) if k == axis else slice(None) for k in (0, 1))
        nearer = np.minimum(far, np.roll(far, 1, axis))
        jump = np.abs(np.diff(far, axis=axis)) > _STEEP * nearer[inner]
        edge[inner] |= (np.diff(bodies, axis=axis) != 0) | jump
    return edge.ravel()


def _unit(vectors: NDArray[F]) -> NDArray[F]:
    """Vectors (n, 3) of length 1; those without a length as they are."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1), dtype=vectors.dtype)
