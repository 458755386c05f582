"""The whole gripper at one grasp, as it opens and closes."""

from __future__ import annotations

import threading
import time
from typing import Any

from graspdb.poses import Poses
from graspdb_viewer.page import OBJECT, Page, put, wxyz
from graspdb_viewer.scene import colours, shapes

GRIPPER = f"{OBJECT}/gripper"
_CLOSES_S = 1.2
_FRAMES = 30
_STEEL = (120, 135, 150)


class Closing:
    """The gripper at a grasp or at a trial: ``show`` puts it there, its buttons close and open it."""

    def __init__(self, page: Page) -> None:
        self._page = page
        gui = page.client.gui
        self._slider = gui.add_slider("Jaw open [mm]", 0.0, 100.0, 0.1, initial_value=100.0, disabled=True)
        self._button = gui.add_button("Close the jaw", disabled=True)
        self._end_m: float | None = None
        self._pose: Poses | None = None
        self._moving = threading.Lock()
        self._slider.on_update(lambda event: self._draw() if event.client_id is not None else None)
        self._button.on_click(self._move)

    def show(
        self, pose: Poses | None, *, end_m: float | None = None, colour: tuple[int, int, int] = colours.BEST
    ) -> None:
        """The wide-open gripper at a pose in the object frame; it closes until ``end_m`` where that is known.

        None: there is no grasp to show.
        """
        subject = self._page.subject
        profile = None if subject is None else subject.profile
        gone = pose is None or profile is None
        self._slider.disabled = self._button.disabled = gone
        frame = self._page.nodes.get("gripper")
        if pose is None or profile is None:
            self._pose = None
            if frame is not None:
                frame.visible = False
            return
        self._pose, self._end_m, self._colour = pose, end_m, colour
        widest = 1e3 * profile.max_opening_m
        if self._slider.max != widest:
            self._slider.max = widest
        put(self._slider, widest)
        if frame is None:
            frame = self._page.client.scene.add_frame(GRIPPER, show_axes=False)
            self._page.replace("gripper", frame)
        frame.position, frame.wxyz, frame.visible = pose.position[0], wxyz(pose.quaternion_xyzw[0]), True
        self._page.replace("palm", self._page.solid(f"{GRIPPER}/palm", shapes.palm(profile), _STEEL))
        self._draw()

    def _draw(self) -> None:
        subject = self._page.subject
        if self._pose is None or subject is None or subject.profile is None:
            return
        opening = 1e-3 * self._slider.value
        for part, side in (("left", 1.0), ("right", -1.0)):
            shape = shapes.finger(subject.profile, side, opening)
            self._page.replace(part, self._page.solid(f"{GRIPPER}/{part}", shape, self._colour))

    def _move(self, _: Any) -> None:
        """Close until the fingers touch, as far as that is known, or open again."""
        subject = self._page.subject
        if subject is None or subject.profile is None or not self._moving.acquire(blocking=False):
            return
        try:
            widest = 1e3 * subject.profile.max_opening_m
            closed = 1e3 * (self._end_m or 0.0)
            closing = self._slider.value > 0.5 * (widest + closed)
            start, end = self._slider.value, closed if closing else widest
            for step in range(1, _FRAMES + 1):
                put(self._slider, start + (end - start) * step / _FRAMES)
                self._draw()
                time.sleep(_CLOSES_S / _FRAMES)
            self._button.label = "Open the jaw" if closing else "Close the jaw"
        finally:
            self._moving.release()
