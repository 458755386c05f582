"""Shapes of parallel-jaw grippers: two finger boxes and a palm box in the tool frame.

Tool frame: z is the approach, y the closing direction, the origin midway between the fingers,
``tip_offset_m`` behind the fingertips.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: Order of the boxes that :meth:`GripperShape.boxes` returns.
FINGER_PLUS, FINGER_MINUS, PALM = 0, 1, 2

_MIN_SIZE_M = 1e-4
_MAX_SIZE_M = 2.0


@dataclass(frozen=True)
class GripperShape:
    """Two box-shaped fingers that close along y, and a palm box directly behind their base.

    Parameters
    ----------
    max_opening_m : float
        Gap between the inner faces of the open fingers.
    finger_width_m, finger_thickness_m, finger_length_m : float
        Finger extents along x, y and z.
    tip_offset_m : float
        Distance from the tool origin forward to the fingertips; at most the finger's length.
    palm_size_m : (3,) float
        Extents of the palm along x, y and z, centred on the tool's z axis.

    Raises
    ------
    ValueError
        Naming the field, for a size that is not finite or not between 0.1 mm and 2 m.
    """

    max_opening_m: float
    finger_width_m: float
    finger_thickness_m: float
    finger_length_m: float
    tip_offset_m: float
    palm_size_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        for name in ("max_opening_m", "finger_width_m", "finger_thickness_m", "finger_length_m"):
            _check_size(name, float(getattr(self, name)))
        palm = tuple(float(v) for v in self.palm_size_m)
        if len(palm) != 3:
            raise ValueError("palm_size_m must be three numbers")
        for value in palm:
            _check_size("palm_size_m", value)
        object.__setattr__(self, "palm_size_m", palm)
        if not (math.isfinite(self.tip_offset_m) and 0.0 <= self.tip_offset_m <= self.finger_length_m):
            raise ValueError("tip_offset_m must lie between 0 and finger_length_m")

    def boxes(self, opening_m: float | None = None) -> tuple[FloatArray, FloatArray]:
        """Boxes of the gripper, axis-aligned in the tool frame.

        Parameters
        ----------
        opening_m : float, optional
            Gap between the fingers' inner faces, from 0 to ``max_opening_m`` (the default).

        Returns
        -------
        half_extents : (3, 3) float64
            Rows: the finger at +y, the finger at -y, the palm. Metres.
        centres : (3, 3) float64
            In the tool frame.
        """
        opening = self._checked_opening(opening_m)
        x, y, z = self.finger_width_m / 2, self.finger_thickness_m / 2, self.finger_length_m / 2
        palm = np.asarray(self.palm_size_m) / 2
        finger_z = self.tip_offset_m - z
        half_extents = np.array([[x, y, z], [x, y, z], palm])
        centres = np.array(
            [
                [0.0, opening / 2 + y, finger_z],
                [0.0, -opening / 2 - y, finger_z],
                [0.0, 0.0, self.tip_offset_m - self.finger_length_m - palm[2]],
            ]
        )
        return half_extents, centres

    def column(self, opening_m: float | None = None) -> tuple[FloatArray, FloatArray]:
        """Box between the fingers: the volume that they sweep in closing.

        Returns
        -------
        half_extents, centre : (3,) float64
            Tool frame, metres.
        """
        opening = self._checked_opening(opening_m)
        half_extents = np.array([self.finger_width_m / 2, opening / 2, self.finger_length_m / 2])
        return half_extents, np.array([0.0, 0.0, self.tip_offset_m - self.finger_length_m / 2])

    def slimmer(self, margin_m: float) -> GripperShape:
        """The same with the fingers' pads smaller by a margin at either side and at the tip, metres.

        That is at most a quarter of a pad's width, and half of what the tips are ahead of the tool origin.
        What lies between these fingers is more than grazed by the others.
        """
        margin = min(margin_m, self.finger_width_m / 4, self.tip_offset_m / 2)
        return replace(
            self,
            finger_width_m=self.finger_width_m - 2 * margin,
            finger_length_m=self.finger_length_m - margin,
            tip_offset_m=self.tip_offset_m - margin,
        )

    def _checked_opening(self, opening_m: float | None) -> float:
        opening = self.max_opening_m if opening_m is None else float(opening_m)
        if not 0.0 <= opening <= self.max_opening_m:
            raise ValueError(f"opening_m must lie between 0 and {self.max_opening_m:g} m")
        return opening


def _check_size(name: str, value: float) -> None:
    if not (math.isfinite(value) and _MIN_SIZE_M <= value <= _MAX_SIZE_M):
        raise ValueError(f"{name} must lie between {_MIN_SIZE_M:g} and {_MAX_SIZE_M:g} m")


#: Schunk PG70 after the RobWork project's public device files: 35 mm stroke each, tool origin 140 mm from the
#: base (70 - 23 mm of finger behind it, then a 92 mm housing).
PG70 = GripperShape(
    max_opening_m=0.070,
    finger_width_m=0.020,
    finger_thickness_m=0.015,
    finger_length_m=0.070,
    tip_offset_m=0.023,
    palm_size_m=(0.080, 0.112, 0.092),
)

#: Franka hand: 80 mm opening, tool origin at the centre of the contact pads, 103.4 mm in front of the hand's
#: frame.  The hand's front face is 66 mm from that frame, so a 45 mm finger ends 7.6 mm beyond the origin.
PANDA = GripperShape(
    max_opening_m=0.080,
    finger_width_m=0.020,
    finger_thickness_m=0.015,
    finger_length_m=0.045,
    tip_offset_m=0.0076,
    palm_size_m=(0.063, 0.204, 0.066),
)

GRIPPER_SHAPES: dict[str, GripperShape] = {"pg70": PG70, "panda": PANDA}
