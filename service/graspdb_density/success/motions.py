"""Motions that take an object onto itself, by which an attempt at one pose tells of others, too.

An attempt at pose T tells of S T for every turn S of the object's symmetry, and for a mirror M of M T N: of
the grasp that a mirror shows, where N is a reflection that the gripper has. A parallel jaw that is symmetric
has two, across its x-z plane (the fingers change places) and across its y-z plane (the fingers stay); what
one of them gives is the other's twin. N here is the first, diag(1, -1, 1). M and N are both of determinant
-1, so that M R N is a rotation again.

An attempt tells of a pose by the image of it that is nearest, in the kernel's measure: k is the largest of
k(S^-1 T). So it counts once, however many of its images lie near a pose. About an axis of revolution the
nearest turn is found for every attempt, exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import se3
from ..se3 import UNIT_TOLERANCE, Floats, Poses

__all__ = ["Motions"]

#: Turns about an axis by which attempts far away are looked for.
_COARSE = 24
#: The half turn about the tool's y axis, by which a mirrored rotation is one: -N.
_HALF_TURN = np.array([0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Motions:
    """Motions of an object, the identity first, and poses as they see them. Use `of`.

    Attributes
    ----------
    centre : (3,)
        What stays where it is, metres, object frame.
    quaternions : (n, 4)
        The inverse turns; of a mirror M that of -M.
    mirrors : (n,) bool
    upright : (4,) or None
        The turn that takes an axis of revolution to z: every motion may be followed by any turn about it.
    """

    centre: Floats
    quaternions: Floats
    mirrors: NDArray[np.bool_]
    upright: Floats | None = None

    @classmethod
    def of(cls, elements: ArrayLike, centre: ArrayLike, *, axis: ArrayLike | None = None) -> Motions:
        """From orthogonal matrices (n, 3, 3) about a centre (3,) in the object frame, the identity first.

        Parameters
        ----------
        axis : (3,) or None
            Unit vector of an axis of revolution through the centre, about which all else may be turned.

        Raises
        ------
        ValueError
            For matrices that are not orthogonal, or whose first is not the identity.
        """
        matrices, middle = np.asarray(elements, dtype=np.float64), np.asarray(centre, dtype=np.float64)
        if matrices.ndim != 3 or matrices.shape[1:] != (3, 3) or middle.shape != (3,):
            raise ValueError("elements have shape (n, 3, 3) and the centre (3,)")
        off = np.abs(np.einsum("nki,nkj->nij", matrices, matrices) - np.eye(3)).max(initial=0.0)
        if (
            off > UNIT_TOLERANCE
            or not len(matrices)
            or np.abs(matrices[0] - np.eye(3)).max() > UNIT_TOLERANCE
        ):
            raise ValueError("elements are orthogonal, and the first is the identity")
        mirrors = np.linalg.det(matrices) < 0.0
        inverse = se3.conjugate(se3.from_matrix(np.where(mirrors[:, None, None], -matrices, matrices)))
        upright = None if axis is None else _to_z(np.asarray(axis, dtype=np.float64))
        return cls(middle, inverse, mirrors, upright)

    def __len__(self) -> int:
        return len(self.quaternions)

    def images(self, poses: Poses) -> Poses:
        """Poses (M) as attempts see them after each motion: S^-1 T, (M, n)."""
        away = (poses.positions - self.centre)[:, None]
        # A point goes with the mirror itself, of which the quaternion is the negative.
        sign = np.where(self.mirrors, -1.0, 1.0)[:, None]
        moved = self.centre + sign * se3.rotate(self.quaternions, away)
        turned = se3.multiply(self.quaternions, poses.quaternions_xyzw[:, None])
        if self.mirrors.any():
            turned[:, self.mirrors] = se3.multiply(turned[:, self.mirrors], _HALF_TURN)
        return Poses(moved, turned)

    def in_half_plane(self, poses: Poses) -> Poses:
        """Poses (..., 3), (..., 4) turned about the axis of revolution until x points away from it, z along
        it, seen from the centre.
        """
        assert self.upright is not None
        away = se3.rotate(self.upright, poses.positions - self.centre)
        azimuth = np.arctan2(away[..., 1], away[..., 0])
        flat = np.stack([np.hypot(away[..., 0], away[..., 1]), np.zeros_like(azimuth), away[..., 2]], axis=-1)
        back = np.zeros((*azimuth.shape, 4))
        back[..., 2], back[..., 3] = -np.sin(0.5 * azimuth), np.cos(0.5 * azimuth)
        return Poses(flat, se3.multiply(se3.multiply(back, self.upright), poses.quaternions_xyzw))

    def from_half_plane(self, poses: Poses) -> Poses:
        """What `in_half_plane` made of poses (M), in the object frame, at some turn about the axis."""
        assert self.upright is not None
        down = se3.conjugate(self.upright)
        return Poses(
            self.centre + se3.rotate(down, poses.positions),
            se3.multiply(down, poses.quaternions_xyzw),
        )

    def spread(self, poses: Poses, turns: int) -> Poses:
        """Poses (M) and where the motions take them, about an axis of revolution by equal turns, (M n,)."""
        kinds = self if self.upright is None else self.turned(turns)
        # The motions are a group, so that their inverses are the motions.
        p, q = kinds.images(poses)
        return Poses(p.reshape(-1, 3), q.reshape(-1, 4))

    def turned(self, turns: int) -> Motions:
        """The motions without the axis of revolution, but with equal turns about it."""
        assert self.upright is not None
        axis = se3.rotate(se3.conjugate(self.upright), np.array([0.0, 0.0, 1.0]))
        about = se3.from_rotation_vector(np.arange(turns)[:, None] * (math.tau / turns) * axis)
        every = se3.multiply(self.quaternions[None, :], about[:, None]).reshape(-1, 4)
        return Motions(self.centre, every, np.tile(self.mirrors, turns))

    def turned_about(self, poses: Poses) -> Poses:
        """Poses (M, n) of the half-plane at some turns about the axis, (M, n k)."""
        turns = se3.from_rotation_vector(
            np.arange(_COARSE)[:, None] * (math.tau / _COARSE) * np.array([0.0, 0.0, 1.0])
        )
        moved = se3.rotate(turns, poses.positions[:, :, None])
        turned = se3.multiply(turns, poses.quaternions_xyzw[:, :, None])
        return Poses(moved.reshape(len(moved), -1, 3), turned.reshape(len(turned), -1, 4))


def _to_z(axis: Floats) -> Floats:
    """The turn (4,) that takes a unit vector to z."""
    if axis[2] < -1.0 + 1e-9:
        return np.array([1.0, 0.0, 0.0, 0.0])
    return se3.normalise(np.array([axis[1], -axis[0], 0.0, 1.0 + axis[2]]))
