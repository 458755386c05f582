"""A robot's arm to be drawn: where its links are at joint values."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graspdb import wire
from graspdb.poses import matrices

Floats = NDArray[np.float64]


class Solid(NamedTuple):
    """A convex solid of a link: vertices (V, 3) in the frame number ``frame``, metres, and faces (F, 3)."""

    link: str
    frame: int
    vertices: Floats
    faces: NDArray[np.int64]


class RobotShape:
    """An arm's chain of n joints and the convex solids on its links, as they are tested for collisions.

    ``joints`` are the joints' names, ``solids`` all solids. Frame 0 is the root link's, frame i that of joint
    i, and frame n + 1 the flange's.
    """

    def __init__(self, raw: wire.RobotShape) -> None:
        self.raw = raw
        self.joints = [joint.name for joint in raw.joints]
        self.solids = [
            Solid(s.link, s.joint, np.array(s.vertices).reshape(-1, 3), np.array(s.faces).reshape(-1, 3))
            for s in raw.solids
        ]
        self._placements = np.array(
            [matrices(joint.placement.position, joint.placement.quaternion_xyzw) for joint in raw.joints]
        )
        self._flange = matrices(raw.flange.position, raw.flange.quaternion_xyzw)

    def frames(self, joints: ArrayLike) -> Floats:
        """Poses (N, n + 2, 4, 4) of all frames in the root link's, for joint values (N, n) or (n,), radians
        and metres: forward kinematics. ValueError for another number of values.
        """
        values = np.atleast_2d(np.asarray(joints, dtype=np.float64))
        if values.ndim != 2 or values.shape[1] != len(self.joints):
            raise ValueError(f"joints have shape {values.shape}, not (N, {len(self.joints)})")
        found = np.empty((len(values), len(self.joints) + 2, 4, 4))
        found[:, 0] = np.eye(4)
        for i, joint in enumerate(self.raw.joints):
            moved = _moved(np.array(joint.axis), values[:, i], joint.sliding)
            found[:, i + 1] = found[:, i] @ self._placements[i] @ moved
        found[:, -1] = found[:, -2] @ self._flange
        return found


def _moved(axis: Floats, values: Floats, sliding: bool) -> Floats:
    """(N, 4, 4) motions along or about an axis (3,)."""
    zero = np.zeros((len(values), 3))
    if sliding:
        return matrices(zero + values[:, None] * axis, np.tile([0.0, 0.0, 0.0, 1.0], (len(values), 1)))
    half = values[:, None] / 2
    return matrices(zero, np.concatenate([np.sin(half) * axis, np.cos(half)], axis=1))
