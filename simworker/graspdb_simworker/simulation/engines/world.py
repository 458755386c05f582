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
    """How an engine cuts time, until both fingers touch and from then on; ``iterations`` of its solver at
    most."""

    approach_dt_s: float
    squeeze_dt_s: float
    iterations: int


class EngineWorld(Protocol):
    """A jaw at the origin, its tool frame the world's, and an object that floats; without gravity.

    Poses of the object are those of its principal frame of inertia in the tool frame. Whatever was done
    before :meth:`park`, what is done after it comes out the same in every bit.
    """

    inflated_m: float
    """How much thicker than it is the engine takes the object to be, on every side."""

    def __init__(
        self, parts: Sequence[Part], mass: MassProperties, friction: float, gripper: Gripper, *, visible: bool
    ) -> None:
        """``parts`` are convex, in the object frame; ``visible``: build what can be seen."""

    @staticmethod
    def stepping(fidelity: Fidelity, mass_kg: float) -> Stepping:
        """How finely to simulate an object of this mass."""

    def cut(self, stepping: Stepping) -> None:
        """Cut time so from the next :meth:`park` on."""

    def damp(self, rate: float) -> None:
        """Damp the object's motion at this rate, 1/s."""

    def drive(self, dt: float) -> None:
        """Close both fingers, with the closing force and at the highest speed at most, in steps of ``dt``."""

    def place(self, where: Vector, orientation: Quaternion, finger_m: float) -> None:
        """The object here, at rest, and each finger so far from the middle, already closing."""

    def advance(self) -> float:
        """Make a step; how far the fingers are apart then, metres."""

    def pressed(self) -> bool:
        """Whether both fingers press on the object."""

    def contacts(self) -> Contacts:
        """What presses on the object."""

    def sunk(self, depth_m: float) -> bool:
        """Whether the jaw is deeper in the object than this."""

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
