"""Motions that take an object onto itself, by which an attempt at one pose tells of others, too.

An attempt at pose T tells of S T for every turn S of the object's symmetry, and for a mirror M of M T N: of
the grasp that a mirror shows, where N is a reflection that the gripper has. A parallel jaw that is symmetric
has two, across its x-z plane (the fingers change places) and across its y-z plane (the fingers stay); what
one of them gives is the other's twin. N here is the first, diag(1, -1, 1). M and N are both of determinant
-1, so that M R N is a rotation again.

The kernel of an attempt is carried along: K(T) = sum over S of k(S^-1 T), for an axis of revolution over
equal turns that are so fine that the sum is the integral to within :data:`SHORT` of itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from ..se3 import UNIT_TOLERANCE, Floats, Poses

__all__ = ["SHORT", "Motions"]

#: Turns are this many widths of what the kernel sees of a turn; the sum of a Gaussian at such steps differs
#: from its integral by the share 2 exp(-2 pi^2 / step^2).
_STEP = 1.5
SHORT = 2.0 * math.exp(-2.0 * math.pi**2 / _STEP**2)
#: Turns at most, for kernels that are narrow beside the object.
_MOST = 180
#: Finer turns by which the nearest attempt is measured, between two.
_FINER = 17
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
    axis : (3,) or None
        Of revolution, about which the motions are ``turns`` equal ones of a few kinds.
    turns : int
    """

    centre: Floats
    quaternions: Floats
    mirrors: np.ndarray[tuple[int], np.dtype[np.bool_]]
    axis: Floats | None = None
    turns: int = 1

    @classmethod
    def of(
        cls,
        elements: ArrayLike,
        centre: ArrayLike,
        *,
        axis: ArrayLike | None = None,
        sigma_position_m: float = 1.0,
        sigma_rotation: float = 1.0,
        farthest_m: float = 0.0,
    ) -> Motions:
        """From orthogonal matrices (n, 3, 3) about a centre (3,) in the object frame, the identity first.

        Parameters
        ----------
        axis : (3,) or None
            Unit vector of an axis of revolution through the centre, which every element is turned about.
        sigma_position_m, sigma_rotation
            The kernel's least widths, metres and radians; only with an axis.
        farthest_m
            How far from the axis attempts lie.

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
        proper = np.where(mirrors[:, None, None], -matrices, matrices)
        inverse = se3.conjugate(se3.from_matrix(proper))
        if axis is None:
            return cls(middle, inverse, mirrors)
        along = np.asarray(axis, dtype=np.float64)
        width = 1.0 / math.hypot(farthest_m / sigma_position_m, 1.0 / sigma_rotation)
        turns = min(max(math.ceil(math.tau / (_STEP * width)), 4), _MOST)
        angles = -np.arange(turns) * (math.tau / turns)
        turned = se3.from_rotation_vector(angles[:, None] * along)
        every = se3.multiply(inverse[None, :], turned[:, None]).reshape(-1, 4)
        return cls(middle, every, np.tile(mirrors, turns), along, turns)

    def __len__(self) -> int:
        return len(self.quaternions)

    @property
    def coarse(self) -> Motions:
        """The same with fewer turns, for what lies far away."""
        if self.axis is None or self.turns < 8:
            return self
        kinds = len(self) // self.turns
        rows = (np.arange(0, self.turns, 4)[:, None] * kinds + np.arange(kinds)).ravel()
        return Motions(self.centre, self.quaternions[rows], self.mirrors[rows])

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

    def finer(self, poses: Poses) -> Poses:
        """Poses (M) turned about the axis by up to half a step either way, (M, k); k is 1 without an axis."""
        if self.axis is None:
            return Poses(poses.positions[:, None], poses.quaternions_xyzw[:, None])
        angles = np.linspace(-0.5, 0.5, _FINER) * (math.tau / self.turns)
        turns = se3.from_rotation_vector(angles[:, None] * self.axis)
        moved = self.centre + se3.rotate(turns, (poses.positions - self.centre)[:, None])
        return Poses(moved, se3.multiply(turns, poses.quaternions_xyzw[:, None]))
