"""Rotations and rigid motions on arrays.

A rotation is a unit quaternion ``(x, y, z, w)``; ``q`` and ``-q`` are the same rotation. Every function takes
arrays of shape (..., 4), (..., 3) or (..., 3, 3), broadcasts over the leading axes and computes in float64.
Angles are radians.

`Poses` is what functions of this package that ask about grasps take, and what they draw: many motions as
one value. ``Poses.of(positions, quaternions_xyzw)`` checks what comes from outside; ``poses[rows]``,
``len(poses)``, ``Poses.concatenate`` and ``positions, quaternions = poses`` do what they say; `compose` and
`inverse` are those of rigid motions, ``poses.turned()`` the jaw's twins.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "IDENTITY",
    "JAW_TURN",
    "Floats",
    "Poses",
    "adjoint",
    "angle_between",
    "canonical",
    "compose",
    "conjugate",
    "from_matrix",
    "from_rotation_vector",
    "inverse",
    "jaw_twin",
    "multiply",
    "normalise",
    "random_quaternions",
    "rotate",
    "to_matrix",
    "to_rotation_vector",
]

Floats = NDArray[np.float64]

IDENTITY: Floats = np.array([0.0, 0.0, 0.0, 1.0])
#: Half a turn about the approach axis (tool z): the mirror symmetry of a parallel jaw.
JAW_TURN: Floats = np.array([0.0, 0.0, 1.0, 0.0])

#: Quaternions this close to unit length are taken as rounding and normalised; others are refused.
UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses as one value: of the tool frame in the object frame where nothing else is said.

    `Poses.of` checks and copies; the plain constructor trusts its arrays. Immutable by convention: nobody
    writes into the arrays.

    Attributes
    ----------
    positions : (N, 3) metres
    quaternions_xyzw : (N, 4) unit
    """

    positions: Floats
    quaternions_xyzw: Floats

    @classmethod
    def of(cls, positions: ArrayLike, quaternions_xyzw: ArrayLike) -> Poses:
        """Check poses and copy them, contiguous float64, quaternions normalised.

        Raises
        ------
        ValueError
            For shapes other than (N, 3) and (N, 4), values that are not finite, or quaternions further than
            ``UNIT_TOLERANCE`` from unit length.
        """
        p = np.array(positions, dtype=np.float64, order="C")
        q = np.array(quaternions_xyzw, dtype=np.float64, order="C")
        if p.ndim != 2 or p.shape[1] != 3:
            raise ValueError(f"positions have shape (N, 3), not {p.shape}")
        if q.shape != (len(p), 4):
            raise ValueError(f"quaternions_xyzw have shape ({len(p)}, 4), not {q.shape}")
        if not (np.isfinite(p).all() and np.isfinite(q).all()):
            raise ValueError("positions and quaternions must be finite")
        length = np.linalg.norm(q, axis=1)
        wrong = np.flatnonzero(np.abs(length - 1.0) > UNIT_TOLERANCE)
        if wrong.size:
            raise ValueError(
                f"quaternion {wrong[0]} has length {length[wrong[0]]:.6g}; "
                f"it must be 1 within {UNIT_TOLERANCE}"
            )
        return cls(p, q / length[:, None])

    @classmethod
    def concatenate(cls, parts: Sequence[Poses]) -> Poses:
        """All poses of some parts, in order."""
        return cls(
            np.concatenate([part.positions for part in parts]),
            np.concatenate([part.quaternions_xyzw for part in parts]),
        )

    def __iter__(self) -> Iterator[Floats]:
        """The two arrays, to unpack."""
        return iter((self.positions, self.quaternions_xyzw))

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, rows: int | slice | NDArray[np.integer] | NDArray[np.bool_]) -> Poses:
        """Some of the poses; with a number one alone, (3,) and (4,)."""
        return Poses(self.positions[rows], self.quaternions_xyzw[rows])

    def turned(self, where: NDArray[np.bool_] | bool = True) -> Poses:
        """The jaw's twins: the same grasps with the fingers exchanged, where ``where`` says so."""
        twins = jaw_twin(self.quaternions_xyzw)
        return Poses(
            self.positions,
            np.where(np.broadcast_to(where, len(self))[:, None], twins, self.quaternions_xyzw),
        )


def multiply(a: ArrayLike, b: ArrayLike) -> Floats:
    """Hamilton product: the rotation ``b`` followed by ``a``, shape (..., 4)."""
    p, q = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    ax, ay, az, aw = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    bx, by, bz, bw = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def conjugate(q: ArrayLike) -> Floats:
    """The inverse of a unit quaternion, shape (..., 4)."""
    flipped: Floats = np.asarray(q, dtype=np.float64) * np.array([-1.0, -1.0, -1.0, 1.0])
    return flipped


def normalise(q: ArrayLike) -> Floats:
    """Scale to unit length.

    Raises
    ------
    ValueError
        Where a quaternion has no direction (length under 1e-12) or is not finite.
    """
    value = np.asarray(q, dtype=np.float64)
    length = np.linalg.norm(value, axis=-1, keepdims=True)
    if not np.all(np.isfinite(length)) or np.any(length < 1e-12):
        raise ValueError("a quaternion is zero or not finite and gives no rotation")
    return np.asarray(value / length, dtype=np.float64)


def rotate(q: ArrayLike, v: ArrayLike) -> Floats:
    """Turn vectors (..., 3) by unit quaternions (..., 4)."""
    r, u = np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64)
    axis = r[..., :3]
    t = 2.0 * np.cross(axis, u)
    return np.asarray(u + r[..., 3:] * t + np.cross(axis, t), dtype=np.float64)


def canonical(q: ArrayLike) -> Floats:
    """The one of ``q`` and ``-q`` whose last non-zero component, read from w back to x, is positive."""
    value = np.array(q, dtype=np.float64)
    sign = np.zeros(value.shape[:-1])
    for component in (3, 2, 1, 0):
        sign = np.where(sign == 0.0, np.sign(value[..., component]), sign)
    return np.asarray(value * np.where(sign < 0.0, -1.0, 1.0)[..., None], dtype=np.float64)


def from_rotation_vector(vector: ArrayLike) -> Floats:
    """Exponential map: rotation vectors (..., 3), axis times angle in radians, to unit quaternions (...,
    4).
    """
    v = np.asarray(vector, dtype=np.float64)
    half = 0.5 * np.linalg.norm(v, axis=-1, keepdims=True)
    # np.sinc(t) is sin(pi t)/(pi t): exact through zero.
    return np.concatenate([0.5 * v * np.sinc(half / np.pi), np.cos(half)], axis=-1)


def to_rotation_vector(q: ArrayLike) -> Floats:
    """Logarithm: unit quaternions (..., 4) to the shortest rotation vectors (..., 3), length at most pi."""
    value = np.asarray(q, dtype=np.float64)
    value = np.where(value[..., 3:] < 0.0, -value, value)
    axis, w = value[..., :3], value[..., 3:]
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    half = np.arctan2(sine, w)
    # Near zero half/sine tends to 1/w (next term of relative size sine^2/6, below rounding here).
    scale = np.where(sine < 1e-9, 2.0 / np.maximum(w, 0.5), 2.0 * half / np.maximum(sine, 1e-300))
    return np.asarray(scale * axis, dtype=np.float64)


def to_matrix(q: ArrayLike) -> Floats:
    """Unit quaternions (..., 4) to rotation matrices (..., 3, 3); columns are the turned axes x, y, z."""
    value = np.asarray(q, dtype=np.float64)
    x, y, z, w = value[..., 0], value[..., 1], value[..., 2], value[..., 3]
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_matrix(matrix: ArrayLike) -> Floats:
    """Rotation matrices (..., 3, 3) to unit quaternions (..., 4) of canonical sign.

    The eigenvector of the largest eigenvalue of Bar-Itzhack's 4x4 matrix (2000, version 3): stable at every
    angle and, for a matrix that is only nearly a rotation, the nearest one.

    Raises
    ------
    ValueError
        For a matrix further than 1e-3 from a rotation, a reflection included.
    """
    m = np.asarray(matrix, dtype=np.float64)
    if m.shape[-2:] != (3, 3):
        raise ValueError(f"a rotation matrix has shape (..., 3, 3), not {m.shape}")
    defect = np.abs(np.einsum("...ji,...jk->...ik", m, m) - np.eye(3)) if m.size else np.zeros(1)
    if not np.all(defect <= UNIT_TOLERANCE) or np.any(np.linalg.det(m) < 0.0):
        raise ValueError("a matrix is not a rotation (columns must be orthonormal and right-handed)")
    k = np.zeros((*m.shape[:-2], 4, 4))
    for i in range(3):
        for j in range(3):
            k[..., i, j] = m[..., i, j] + m[..., j, i]
        j, h = (i + 1) % 3, (i + 2) % 3
        k[..., i, i] = m[..., i, i] - m[..., j, j] - m[..., h, h]
        k[..., i, 3] = k[..., 3, i] = m[..., h, j] - m[..., j, h]
    k[..., 3, 3] = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    _, vectors = np.linalg.eigh(k / 3.0)
    return canonical(vectors[..., :, -1])


def angle_between(a: ArrayLike, b: ArrayLike) -> Floats:
    """Angle of the rotation from ``a`` to ``b`` in [0, pi] radians; accurate near 0, where arccos is not."""
    relative = multiply(conjugate(a), b)
    sine = np.linalg.norm(relative[..., :3], axis=-1)
    return np.asarray(2.0 * np.arctan2(sine, np.abs(relative[..., 3])), dtype=np.float64)


def jaw_twin(q: ArrayLike) -> Floats:
    """The same grasp with the fingers exchanged: ``q`` turned by pi about the tool's z (right
    multiplication).
    """
    return multiply(q, JAW_TURN)


def compose(outer: Poses, inner: Poses) -> Poses:
    """The inner poses seen from the outer's parent frame; arrays broadcast."""
    turned = rotate(outer.quaternions_xyzw, inner.positions)
    return Poses(outer.positions + turned, multiply(outer.quaternions_xyzw, inner.quaternions_xyzw))


def inverse(poses: Poses) -> Poses:
    """The inverse rigid motions."""
    back = conjugate(poses.quaternions_xyzw)
    return Poses(-rotate(back, poses.positions), back)


def adjoint(pose: Poses) -> Floats:
    """The 6x6 matrix that takes a small motion along and about the axes of a frame, translation first, to the
    same along and about those of its parent, where the frame has this one pose, (3,) and (4,).
    """
    rotation = to_matrix(pose.quaternions_xyzw)
    x, y, z = pose.positions
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[rotation, cross @ rotation], [np.zeros((3, 3)), rotation]])


def random_quaternions(count: int, rng: np.random.Generator) -> Floats:
    """Rotations uniform under the Haar measure, shape (count, 4)."""
    # A normalised Gaussian; its length is below 1e-3 with probability 1e-13, so a retry loop is not worth its
    # code.
    return normalise(rng.standard_normal((count, 4)))
