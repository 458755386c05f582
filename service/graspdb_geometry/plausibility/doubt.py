"""What is compared, and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graspdb_geometry.collision import Scene, Surface
from graspdb_geometry.grippers import GripperShape

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

#: A gripper that nobody named reaches this far beyond its tool origin, and is this large, at most.
UNKNOWN_REACH_M = 0.1
UNKNOWN_SIZE_M = 0.4


@dataclass(frozen=True, eq=False)
class Target:
    """An object, and the gripper that is said to have grasped it.

    Attributes
    ----------
    lower, upper : (3,) float64
        The object's bounding box, metres, object frame.
    solid : Scene, Surface or None
        Its geometry, where a gripper is known to test against it.
    shape : GripperShape or None
    """

    lower: FloatArray
    upper: FloatArray
    solid: Scene | Surface | None = None
    shape: GripperShape | None = None

    @property
    def centre(self) -> FloatArray:
        """The middle of the bounding box, metres, (3,)."""
        middle: FloatArray = (self.lower + self.upper) / 2
        return middle

    @property
    def object_size_m(self) -> float:
        """The bounding box's diagonal."""
        return float(np.linalg.norm(self.upper - self.lower))

    @property
    def reach_m(self) -> float:
        """How far from the tool origin the closing fingers may meet something."""
        if self.shape is None:
            return UNKNOWN_REACH_M
        half, centre = self.shape.swept()
        return float(np.linalg.norm(np.abs(centre) + half))

    @property
    def gripper_size_m(self) -> float:
        """The diagonal of a box about fingers and palm."""
        if self.shape is None:
            return UNKNOWN_SIZE_M
        half, centres = self.shape.boxes()
        extent = (centres + half).max(axis=0) - (centres - half).min(axis=0)
        return float(np.linalg.norm(extent))

    @property
    def limit_m(self) -> float:
        """Farther from the bounding box than this nothing is a grasp of the object: ten times both."""
        return 10.0 * (self.object_size_m + self.gripper_size_m)

    def offsets(self, positions: FloatArray) -> FloatArray:
        """From positions (n, 3) to the nearest point of the bounding box, metres, (n, 3); zero inside it."""
        return np.clip(positions, self.lower, self.upper) - positions


@dataclass(frozen=True, eq=False)
class Doubt:
    """Poses about which something is doubtful.

    Attributes
    ----------
    code : str
    rows : (k,) int64
        Which of the poses, ascending.
    examined : int
        How many poses were looked at: fewer than there are where looking is costly.
    likeness : str
        The tool axis that looks like the approach instead, such as ``-z``; empty for other codes.
    """

    code: str
    rows: IntArray
    examined: int
    likeness: str = ""
