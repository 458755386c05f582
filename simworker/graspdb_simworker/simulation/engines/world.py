"""What a physics engine is asked for: a world with a jaw and an object, to be posed, driven and read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from graspdb.wire.sweeps import Fidelity
from graspdb_simworker.simulation.bodies import (
    Contacts,
    Gripper,
    MassProperties,
    Part,
    Quaternion,
    Vector,
)


@dataclass(frozen=True)
class Stepping:
    """How an engine cuts time, while fewer than two fingers press and while both do; ``iterations`` of its
    solver at most, and no more once one changes no velocity by more than the root of ``residual``, m/s, where
    an engine can be told that. While both press, the jaw is looked at after every ``look_steps``."""

    approach_dt_s: float
    squeeze_dt_s: float
    iterations: int
    look_steps: int = 1
    residual: float = 1e-7


class EngineWorld(Protocol):
    """A jaw at the origin, its tool frame the world's, and an object that floats; without gravity.

    Poses of the object are those of its principal frame of inertia in the tool frame. Whatever was done
    before :meth:`park`, what is done after it comes out the same in every bit.
    """

    inflated_m: float
    """How much thicker than it is the engine takes the object to be, on every side."""
    finer: tuple[Stepping, ...]
    """In which steps to go on where forces ring, or to close once more where a closing can't be believed, one
    after the other until it can."""

    def __init__(
        self, parts: Sequence[Part], mass: MassProperties, friction: float, gripper: Gripper, *, visible: bool
    ) -> None:
        """``parts`` are convex, in the object frame; ``visible``: build what can be seen."""

    @staticmethod
    def stepping(fidelity: Fidelity, mass_kg: float, *, carried: bool) -> Stepping:
        """How finely to close on an object of this mass, which is carried afterwards or not."""

    def cut(self, stepping: Stepping) -> None:
        """Cut time so from the next :meth:`drive` or :meth:`park` on."""

    def damp(self, rate: float) -> None:
        """Damp the object's motion at this rate, 1/s."""

    def drive(self, dt: float) -> None:
        """Close both fingers, with the closing force and at the highest speed at most, in steps of ``dt``."""

    def place(self, where: Vector, orientation: Quaternion, finger_m: float) -> None:
        """The object here, at rest, and each finger so far from the middle, already closing."""

    def advance(self, steps: int) -> float:
        """Make so many steps; how far the fingers are apart then, metres."""

    def touching(self) -> tuple[int, float]:
        """How many fingers press on the object, and how deep the jaw is in it, metres, not below 0."""

    def contacts(self) -> Contacts:
        """What presses on the object."""

    def depth_between(self) -> float:
        """How deep the object is in the space between the open fingers, metres; minus infinity outside.

        The deepest part counts: moved by less than its depth, it is still there.
        """

    def body(self) -> tuple[Vector, Quaternion]:
        """Where the object is."""

    def fingers(self) -> tuple[float, float]:
        """How far the finger at -y, the first, and that at +y are from the middle, metres."""

    def show(self, where: Vector, orientation: Quaternion, fingers_m: tuple[float, float]) -> None:
        """Put object and fingers here, to be looked at."""

    def park(self) -> None:
        """Forget the grasp: the object far away and at rest, the jaw open and driven at the first step."""

    def aim(self) -> None:
        """Choose from where the grasp that begins is looked at."""

    def picture(self) -> NDArray[np.uint8]:
        """The grasp as a whole and close by, (height, width, 3)."""

    def close_world(self) -> None:
        """Free the memory at once; the world can't be used afterwards."""
