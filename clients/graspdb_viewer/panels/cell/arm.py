"""The arm in the scene: its links where joint values put them, and the base that is dragged."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.poses import Poses
from graspdb.poses import matrices as matrices_of
from graspdb.resources.cells.shapes import RobotShape
from graspdb.wire import GripperProfile, RobotInfo
from graspdb.wire.frames.gripper_frames import BASE, compose, inverse
from graspdb_viewer.page import Page, wxyz
from graspdb_viewer.scene import colours, shapes
from graspdb_viewer.scene.shapes import Shape
from graspdb_viewer.view import Placed

Floats = NDArray[np.float64]
ROBOT = "/robot"
"""The node of the root link's frame: what lies below it moves with the base while it is dragged."""
_HANDLE_M = 0.3
_MOST_LABELS = 4


@dataclass(frozen=True, eq=False)
class ShownRobot:
    """A robot as it is drawn; ``tool_in_flange`` (4, 4) is None where that is not known."""

    info: RobotInfo
    shape: RobotShape
    profile: GripperProfile | None
    tool_in_flange: Floats | None

    @property
    def rest(self) -> Floats:
        """Joints (n,) in the middle of their limits, 0 without."""
        return np.array(
            [
                0.0 if joint.lower is None or joint.upper is None else (joint.lower + joint.upper) / 2
                for joint in self.info.joints
            ]
        )

    def beyond(self, joints: Floats) -> dict[str, tuple[float, float]]:
        """Of joints (n,) that are beyond a limit: the value and the limit, by the joint's name."""
        found = {}
        for joint, value in zip(self.info.joints, joints, strict=True):
            for limit, off in ((joint.lower, -1.0), (joint.upper, 1.0)):
                if limit is not None and off * (value - limit) > 1e-6:
                    found[joint.name] = (float(value), limit)
        return found

    def moved_by(self, joint: str) -> set[str]:
        """The links next after a joint."""
        frame = self.shape.joints.index(joint) + 1
        return {solid.link for solid in self.shape.solids if solid.frame == frame}


def tool_in_flange(info: RobotInfo, profile: GripperProfile | None) -> Floats | None:
    """The tool's pose (4, 4) in the flange link, as the service has it: by the robot's mount, the gripper's
    frame ``flange``, or both bases being one; None where the tool is not known.
    """
    if profile is None:
        return None
    mount = info.gripper_mount
    named = "flange" if mount is None and "flange" in profile.frames else BASE
    try:
        pose = profile.in_tool(named)
    except ValueError:
        return None
    if named == BASE and mount is not None:
        pose = compose(pose, inverse(mount))
    return np.asarray(np.linalg.inv(matrices_of(pose.position, pose.quaternion_xyzw)))


class ArmDrawing:
    """The arm's links below the handle of its base; ``dragged`` takes where the handle is."""

    def __init__(self, page: Page, dragged: Callable[[Any], None]) -> None:
        self._page, self._dragged = page, dragged
        self._parts: list[str] = []

    def remove(self) -> None:
        """No robot is shown."""
        for name in [*self._parts, "robot gripper", "robot"]:
            self._page.replace(name, None)
        self._label({}, None, None)
        self._parts = []

    def stand(self, base: Placed) -> None:
        """The base at a pose in the world, with a handle that slides on the floor and turns."""
        page = self._page
        node = page.nodes.get("robot")
        if node is None:
            node = page.client.scene.add_transform_controls(
                ROBOT,
                scale=_HANDLE_M,
                line_width=3.0,
                depth_test=False,
                active_axes=(True, True, False),
                position=base.position,
                wxyz=wxyz(base.quaternion_xyzw),
            )
            node.on_update(lambda event: self._dragged(event.target))
            page.replace("robot", node)
        turn = wxyz(base.quaternion_xyzw)
        if not np.allclose(node.position, base.position) or not np.allclose(node.wxyz, turn):
            node.position, node.wxyz = np.array(base.position), turn

    def put(
        self,
        robot: ShownRobot,
        joints: Floats,
        *,
        red: Mapping[str, str] | None = None,
        pale: bool = False,
        gripper: bool = False,
    ) -> None:
        """The links at joints (n,), those of ``red`` in red and labelled with what is said of them;
        ``gripper`` has the open gripper drawn at the flange, too.
        """
        red = red or {}
        frames = Poses.of(robot.shape.frames(joints)[0])
        with self._page.client.atomic():
            self._parts = [f"arm {i}" for i in range(len(robot.shape.solids))]
            for name, solid in zip(self._parts, robot.shape.solids, strict=True):
                node = self._page.nodes.get(name)
                if node is None:
                    shape = Shape(solid.vertices, solid.faces)
                    path = f"{ROBOT}/{name.replace(' ', '')}"
                    node = self._page.solid(path, shape, colours.LINK, side="double", flat_shading=False)
                    self._page.replace(name, node)
                _colour(node, _of(solid.link, red, pale))
                node.position = frames.position[solid.frame]
                node.wxyz = wxyz(frames.quaternion_xyzw[solid.frame])
            self._gripper(robot, frames.matrices[-1] if gripper else None, red)
        self._label(red, robot, frames)

    def _gripper(self, robot: ShownRobot, flange: Floats | None, red: Collection[str]) -> None:
        page = self._page
        if flange is None or robot.profile is None or robot.tool_in_flange is None:
            page.replace("robot gripper", None)
            return
        there = Poses.of((flange @ robot.tool_in_flange)[None])
        colour = colours.WRONG if "gripper" in red else colours.LINK_PALE
        node = page.solid(
            f"{ROBOT}/gripper",
            shapes.gripper(robot.profile),
            colour,
            position=there.position[0],
            wxyz=wxyz(there.quaternion_xyzw[0]),
        )
        page.replace("robot gripper", node)

    def _label(self, red: Mapping[str, str], robot: ShownRobot | None, frames: Poses | None) -> None:
        """What is wrong with links, beside them."""
        page, told = self._page, list(red.items())[:_MOST_LABELS]
        for i in range(_MOST_LABELS):
            if robot is None or frames is None or i >= len(told) or not told[i][1]:
                page.replace(f"label {i}", None)
                continue
            link, text = told[i]
            frame = next((s.frame for s in robot.shape.solids if s.link == link), len(frames.position) - 1)
            there = frames.position[frame]
            for solid in robot.shape.solids:
                if solid.link == link:
                    there = frames.matrices[frame][:3, :3] @ solid.vertices.mean(axis=0) + there
                    break
            label = page.client.scene.add_label(
                f"{ROBOT}/label{i}", text, position=there, font_screen_scale=0.85, anchor="bottom-left"
            )
            page.replace(f"label {i}", label)


def _of(link: str, red: Collection[str], pale: bool) -> tuple[int, int, int]:
    if link in red:
        return colours.WRONG
    return colours.LINK_PALE if pale else colours.LINK


def _colour(node: Any, colour: tuple[int, int, int]) -> None:
    if tuple(node.color) != colour:
        node.color = colour
