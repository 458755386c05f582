"""What the user drags about in the scene: a workspace, an approach cone, an obstacle, the object."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from graspdb_viewer.page import Page, put, triple, wxyz, xyzw
from graspdb_viewer.scene import colours, shapes
from graspdb_viewer.view import Box, Cone, Obstacle, Placed

_WORKSPACE, _CONE = (0, 114, 178), (230, 159, 0)
_DOWN = (1.0, 0.0, 0.0, 0.0)
"""Half a turn about x: the approach is downwards."""
_MARK = 1e-3


class Gizmos:
    """Checkboxes that bring each, its sizes, and what is dragged; the view's parts are what it says."""

    def __init__(self, page: Page, changed: Callable[[], None]) -> None:
        self._page, self._changed = page, changed
        gui, view = page.client.gui, page.view
        self._box = gui.add_checkbox("Workspace box", initial_value=view.box is not None)
        self._box_size = gui.add_vector3("Its edges [mm]", (100.0, 100.0, 100.0), min=(1,) * 3, step=1.0)
        self._cone = gui.add_checkbox("Approach cone", initial_value=view.cone is not None)
        self._angle = gui.add_slider("Half angle [°]", 1.0, 90.0, 1.0, initial_value=45.0)
        self._obstacle = gui.add_checkbox("Obstacle", initial_value=view.obstacle is not None)
        self._obstacle_size = gui.add_vector3("Its edges [mm] ", (50.0, 50.0, 50.0), min=(1,) * 3, step=1.0)
        self._pose = gui.add_checkbox("Move the object", initial_value=view.object_pose is not None)
        for control in (self._box, self._cone, self._obstacle, self._pose):
            control.on_update(lambda _: self._switched())
        for sized in (self._box_size, self._obstacle_size, self._angle):
            sized.on_update(lambda event: self._sized() if event.client_id is not None else None)

    def draw(self) -> None:
        """All that the view has, and nothing else."""
        view = self._page.view
        with self._page.client.atomic():
            self._draw_pose(view.object_pose)
            self._draw_box(view.box)
            self._draw_cone(view.cone)
            self._draw_obstacle(view.obstacle)
        self._box_size.visible = view.box is not None
        self._angle.visible = view.cone is not None
        self._obstacle_size.visible = view.obstacle is not None

    def untick(self) -> None:
        """Nothing of it is there any more: another object is shown."""
        for control in (self._box, self._cone, self._obstacle, self._pose):
            put(control, False)

    def _switched(self) -> None:
        """Bring or take away what the boxes say, the new ones about the object."""
        view, subject = self._page.view, self._page.subject
        if subject is None:
            return
        size, there = subject.size_m, subject.centre
        if view.object_pose is not None:
            there = there + np.asarray(view.object_pose.position)
        if self._box.value != (view.box is not None):
            view.box = (
                Box(centre=triple(there), size=(round(0.8 * size, 3),) * 3) if self._box.value else None
            )
        if self._cone.value != (view.cone is not None):
            view.cone = Cone(quaternion_xyzw=_DOWN) if self._cone.value else None
        if self._obstacle.value != (view.obstacle is not None):
            beside = triple(there + np.array([1.1 * size, 0.0, 0.0]))
            view.obstacle = (
                Obstacle(position=beside, size=(round(0.4 * size, 3),) * 3) if self._obstacle.value else None
            )
        if self._pose.value != (view.object_pose is not None):
            view.object_pose = Placed(position=(0.0, 0.0, 0.0)) if self._pose.value else None
        self.draw()
        self._changed()

    def _sized(self) -> None:
        view = self._page.view
        with suppress(ValueError):  # half a number, while somebody types
            if view.box is not None:
                view.box = view.box.model_copy(update={"size": _metres(self._box_size.value)})
            if view.obstacle is not None:
                view.obstacle = view.obstacle.model_copy(update={"size": _metres(self._obstacle_size.value)})
            if view.cone is not None:
                view.cone = view.cone.model_copy(update={"half_angle_deg": float(self._angle.value)})
        self.draw()
        self._changed()

    def _gizmo(self, name: str, at: Placed, **options: Any) -> Any:
        """A handle to drag, kept while it is there: one that is added again would drop the drag."""
        page = self._page
        node = page.nodes.get(name)
        if node is None:
            size = 0.1 if page.subject is None else page.subject.size_m
            node = page.client.scene.add_transform_controls(
                f"/{name}", scale=0.45 * size, line_width=3.0, depth_test=False, **options
            )
            node.on_update(lambda event: self._dragged(name, event.target))
            page.replace(name, node)
        turn = wxyz(at.quaternion_xyzw)
        if not np.allclose(node.position, at.position) or not np.allclose(node.wxyz, turn):
            node.position, node.wxyz = np.array(at.position), turn
        return node

    def _dragged(self, name: str, node: Any) -> None:
        view = self._page.view
        position, quaternion = triple(node.position), xyzw(node.wxyz)
        with suppress(ValueError):  # dragged a kilometre away
            if name == "workspace" and view.box is not None:
                view.box = view.box.model_copy(update={"centre": position})
            elif name == "cone" and view.cone is not None:
                view.cone = view.cone.model_copy(update={"quaternion_xyzw": quaternion})
            elif name == "obstacle" and view.obstacle is not None:
                update = {"position": position, "quaternion_xyzw": quaternion}
                view.obstacle = view.obstacle.model_copy(update=update)
            elif name == "pose" and view.object_pose is not None:
                view.object_pose = Placed(position=position, quaternion_xyzw=quaternion)
                self._place_object()
        self._changed()

    def _draw_pose(self, pose: Placed | None) -> None:
        self._place_object()
        if pose is None:
            self._page.replace("pose", None)
        else:
            self._gizmo("pose", pose)

    def _place_object(self) -> None:
        pose = self._page.view.object_pose or Placed(position=(0.0, 0.0, 0.0))
        node = self._page.nodes.get("object")
        if node is not None:
            node.position, node.wxyz = np.array(pose.position), wxyz(pose.quaternion_xyzw)

    def _draw_box(self, box: Box | None) -> None:
        page, scene = self._page, self._page.client.scene
        if box is None:
            for name in ("workspace edges", "workspace fill", "workspace"):
                page.replace(name, None)
            return
        self._gizmo("workspace", Placed(position=box.centre), disable_rotations=True)
        _set(self._box_size, box.size)
        edges = shapes.edges_of_box(box.size)
        lines = scene.add_line_segments(
            "/workspace/edges", edges, _WORKSPACE, thickness=2.5, thickness_units="screen"
        )
        page.replace("workspace edges", lines)
        fill = scene.add_box("/workspace/fill", dimensions=box.size, color=_WORKSPACE, opacity=0.06)
        page.replace("workspace fill", fill)

    def _draw_cone(self, cone: Cone | None) -> None:
        page = self._page
        if cone is None or page.subject is None:
            page.replace("cone surface", None)
            page.replace("cone", None)
            return
        there = page.subject.centre
        if page.view.object_pose is not None:
            there = there + np.asarray(page.view.object_pose.position)
        placed = Placed(position=triple(there), quaternion_xyzw=cone.quaternion_xyzw)
        self._gizmo("cone", placed, disable_axes=True, disable_sliders=True)
        if self._angle.value != cone.half_angle_deg:
            put(self._angle, cone.half_angle_deg)
        shape = shapes.cone(cone.half_angle_deg, 0.9 * page.subject.size_m)
        surface = page.solid("/cone/surface", shape, _CONE, opacity=0.25, side="double", flat_shading=False)
        page.replace("cone surface", surface)

    def _draw_obstacle(self, obstacle: Obstacle | None) -> None:
        page = self._page
        if obstacle is None:
            page.replace("obstacle body", None)
            page.replace("obstacle", None)
            return
        self._gizmo("obstacle", obstacle)
        _set(self._obstacle_size, obstacle.size)
        body = page.client.scene.add_box("/obstacle/body", dimensions=obstacle.size, color=colours.OBSTACLE)
        page.replace("obstacle body", body)


def _metres(millimetres: Any) -> tuple[float, float, float]:
    x, y, z = (min(max(1e-3 * float(value), 1e-4), 100.0) for value in millimetres)
    return (x, y, z)


def _set(control: Any, size: Any) -> None:
    """Show a size in millimetres, unless it is what is shown."""
    shown = tuple(1e3 * value for value in size)
    if not np.allclose(control.value, shown, atol=_MARK):
        put(control, shown)
