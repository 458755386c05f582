"""Shapes of parallel-jaw grippers: two finger boxes and a palm box in the tool frame.

Tool frame: z is the approach, y the closing direction, the origin midway between the fingers,
``tip_offset_m`` behind the fingertips.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt
from typing_extensions import Self

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
        Finger extents along x, y and z, of the wide-open jaw.
    tip_offset_m : float
        Distance from the tool origin forward to the wide-open fingertips; at most the finger's length.
    palm_size_m : (3,) float
        Extents of the palm along x, y and z, centred on the tool's z axis.
    tip_offsets : (opening_m, tip_offset_m), ...
        Where the tips are at smaller openings, ascending, of fingers that move on arcs: linear in between,
        and up to ``tip_offset_m`` wide open. The fingers begin at the palm throughout.

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
    tip_offsets: tuple[tuple[float, float], ...] = ()

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
        below = -1.0
        for opening, offset in self.tip_offsets:
            if not (max(below, 0.0) <= opening < self.max_opening_m and opening > below):
                raise ValueError("tip_offsets must be at ascending openings from 0 on, below max_opening_m")
            length = self.finger_length_m + offset - self.tip_offset_m
            if not (math.isfinite(offset) and offset >= 0.0 and _MIN_SIZE_M <= length <= _MAX_SIZE_M):
                raise ValueError("tip_offsets must be from 0 on, and ahead of the palm")
            below = opening

    @property
    def farthest_tip_m(self) -> float:
        """How far ahead of the tool origin the tips ever are, metres."""
        return max([self.tip_offset_m, *(offset for _, offset in self.tip_offsets)])

    def tip_at(self, opening_m: float) -> float:
        """Distance from the tool origin forward to the tips at an opening, metres."""
        if not self.tip_offsets:
            return self.tip_offset_m
        openings, offsets = zip(*self.tip_offsets, (self.max_opening_m, self.tip_offset_m), strict=True)
        return float(np.interp(opening_m, openings, offsets))

    def at(self, opening_m: float) -> Self:
        """The same jaw, as far open as that at most: its tips are where they are then, its palm stays."""
        opening = self._checked_opening(opening_m)
        tip = self.tip_at(opening)
        return replace(
            self,
            max_opening_m=max(opening, _MIN_SIZE_M),
            finger_length_m=self.finger_length_m + tip - self.tip_offset_m,
            tip_offset_m=tip,
            tip_offsets=tuple(known for known in self.tip_offsets if known[0] < opening),
        )

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
        tip = self.tip_at(opening)
        back = self.tip_offset_m - self.finger_length_m
        x, y, z = self.finger_width_m / 2, self.finger_thickness_m / 2, (tip - back) / 2
        palm = np.asarray(self.palm_size_m) / 2
        half_extents = np.array([[x, y, z], [x, y, z], palm])
        centres = np.array(
            [
                [0.0, opening / 2 + y, tip - z],
                [0.0, -opening / 2 - y, tip - z],
                [0.0, 0.0, back - palm[2]],
            ]
        )
        return half_extents, centres

    def column(self, opening_m: float | None = None) -> tuple[FloatArray, FloatArray]:
        """Box between the fingers at an opening: where they move straight, the volume that they sweep.

        Returns
        -------
        half_extents, centre : (3,) float64
            Tool frame, metres.
        """
        opening = self._checked_opening(opening_m)
        return self._between(opening, self.tip_at(opening))

    def swept(self) -> tuple[FloatArray, FloatArray]:
        """A box about all that the fingers sweep in closing; as :meth:`column` where they move straight."""
        return self._between(self.max_opening_m, self.farthest_tip_m)

    def slimmer(self, margin_m: float) -> Self:
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
            tip_offsets=tuple((opening, max(tip - margin, 0.0)) for opening, tip in self.tip_offsets),
        )

    def _between(self, opening_m: float, tip_m: float) -> tuple[FloatArray, FloatArray]:
        half = (tip_m - self.tip_offset_m + self.finger_length_m) / 2
        return (
            np.array([self.finger_width_m / 2, opening_m / 2, half]),
            np.array([0.0, 0.0, tip_m - half]),
        )

    def _checked_opening(self, opening_m: float | None) -> float:
        opening = self.max_opening_m if opening_m is None else float(opening_m)
        if not 0.0 <= opening <= self.max_opening_m:
            raise ValueError(f"opening_m must lie between 0 and {self.max_opening_m:g} m")
        return opening


class _Finger(Protocol):
    @property
    def width_m(self) -> float: ...
    @property
    def thickness_m(self) -> float: ...
    @property
    def length_m(self) -> float: ...


class _Tip(Protocol):
    @property
    def opening_m(self) -> float: ...
    @property
    def tip_offset_m(self) -> float: ...


class _Profile(Protocol):
    """What of a gripper's profile makes its shape."""

    @property
    def max_opening_m(self) -> float: ...
    @property
    def finger(self) -> _Finger: ...
    @property
    def tip_offset_m(self) -> float: ...
    @property
    def tip_offsets(self) -> Sequence[_Tip]: ...
    @property
    def palm_size_m(self) -> tuple[float, float, float]: ...


def shape_of(profile: _Profile) -> GripperShape:
    """The boxes of a gripper's profile, metres; ValueError as :class:`GripperShape`."""
    return GripperShape(
        max_opening_m=profile.max_opening_m,
        finger_width_m=profile.finger.width_m,
        finger_thickness_m=profile.finger.thickness_m,
        finger_length_m=profile.finger.length_m,
        tip_offset_m=profile.tip_offset_m,
        palm_size_m=profile.palm_size_m,
        tip_offsets=tuple((tip.opening_m, tip.tip_offset_m) for tip in profile.tip_offsets),
    )


def _check_size(name: str, value: float) -> None:
    if not (math.isfinite(value) and _MIN_SIZE_M <= value <= _MAX_SIZE_M):
        raise ValueError(f"{name} must lie between {_MIN_SIZE_M:g} and {_MAX_SIZE_M:g} m")
