"""The whole gripper at one grasp, as it opens and closes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.poses import Poses
from graspdb.wire import GripperProfile
from graspdb_viewer.motion import Motion
from graspdb_viewer.page import OBJECT, Page, put, wxyz
from graspdb_viewer.scene import colours, shapes
from graspdb_viewer.scene.shapes import Shape

GRIPPER = f"{OBJECT}/gripper"
_CLOSES_S = 1.2
_FRAMES = 30
_STEEL = (120, 135, 150)
_SEEN_THROUGH = 0.45
"""The palm is often between the eye and what the fingers hold."""
_STAYS_S = 2.0
"""The end of a replay is seen so long."""
_PAUSE_S = 0.04


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
        self._parts: dict[str, object] = {}
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
        self._put("palm", shapes.palm(profile), _STEEL, opacity=_SEEN_THROUGH)
        self._draw()

    def move(self, pose: Poses) -> None:
        """The gripper that is shown, elsewhere in the object frame: on the arm's way to its grasp."""
        frame = self._page.nodes.get("gripper")
        if frame is not None and self._pose is not None:
            frame.position, frame.wxyz = pose.position[0], wxyz(pose.quaternion_xyzw[0])

    def close_by(self, share: float) -> None:
        """The jaw between wide open (0) and on the object (1)."""
        subject = self._page.subject
        if subject is not None and subject.profile is not None and self._pose is not None:
            widest, closed = 1e3 * subject.profile.max_opening_m, 1e3 * (self._end_m or 0.0)
            put(self._slider, widest + (closed - widest) * share)
            self._draw()

    def replay(self, motion: Motion, shown: Callable[[], bool]) -> None:
        """Move the fingers and the object as they moved, while the jaw stands still, and put them back.

        It ends early once ``shown`` says so.
        """
        page, at = self._page, self._pose
        profile = None if page.subject is None else page.subject.profile
        mesh: Any = page.nodes.get("mesh")
        if at is None or profile is None or mesh is None or not self._moving.acquire(blocking=False):
            return
        try:
            # The tool stands where the trial had it.
            there = Poses.of(at.matrices @ motion.poses.matrices)
            turns = _continuous(there.quaternion_xyzw)
            began, end = time.monotonic(), float(motion.times_s[-1])
            while shown():
                now = min(time.monotonic() - began, end)
                left, right, *pose = (
                    float(np.interp(now, motion.times_s, column))
                    for column in (*motion.fingers_m.T, *there.position.T, *turns.T)
                )
                self._fingers(profile, 2 * left, 2 * right)
                put(self._slider, 1e3 * min(max(left + right, 0.0), profile.max_opening_m))
                turn = np.array(pose[3:])
                mesh.position, mesh.wxyz = np.array(pose[:3]), wxyz(turn / np.linalg.norm(turn))
                if now >= end:
                    break
                time.sleep(_PAUSE_S)
            until = time.monotonic() + _STAYS_S
            while shown() and time.monotonic() < until:
                time.sleep(_PAUSE_S)
        finally:
            if page.nodes.get("mesh") is mesh is not None:
                mesh.position, mesh.wxyz = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
            self._moving.release()

    def _draw(self) -> None:
        subject = self._page.subject
        if self._pose is None or subject is None or subject.profile is None:
            return
        opening = 1e-3 * self._slider.value
        self._fingers(subject.profile, opening, opening)

    def _fingers(self, profile: GripperProfile, left: float, right: float) -> None:
        """Either finger as far from the middle as with the jaw so far open, metres."""
        for part, side, opening in (("left", 1.0, left), ("right", -1.0, right)):
            self._put(part, shapes.finger(profile, side, opening), self._colour)

    def _put(self, part: str, shape: Shape, colour: tuple[int, int, int], **options: Any) -> None:
        """Show a part of the gripper; the same one stays: a drag moves the whole ten times a second."""
        key = (shape.vertices.tobytes(), colour)
        if part in self._page.nodes and self._parts.get(part) == key:
            return
        self._page.replace(part, self._page.solid(f"{GRIPPER}/{part}", shape, colour, **options))
        self._parts[part] = key

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


def _continuous(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same rotations (n, 4), each of the sign that is nearer to the one before."""
    signs = np.ones(len(quaternions))
    along = np.einsum("nc,nc->n", quaternions[1:], quaternions[:-1])
    signs[1:] = np.cumprod(np.where(along < 0, -1.0, 1.0))
    return quaternions * signs[:, None]
