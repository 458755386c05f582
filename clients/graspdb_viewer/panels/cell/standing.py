"""A stored scene as it stands in the world: its boxes, objects and points."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from graspdb.wire import SceneInfo
from graspdb_viewer.page import Page, wxyz
from graspdb_viewer.scene import colours, shapes
from graspdb_viewer.scene.shapes import Shape

SCENE = "/scene"
_SEEN_THROUGH = 0.4


class SceneDrawing:
    """What a scene has in it, read once as long as it does not change."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._shown: dict[str, str] = {}
        """Names of nodes, by those of what they show."""
        self._key: tuple[str, object] | None = None

    def draw(self, scene: SceneInfo | None) -> None:
        """Show a scene in place of the one before; None for none."""
        key = None if scene is None else (scene.id, scene.updated_at)
        # Another object clears the page, and what stood on it.
        if key == self._key and all(name in self._page.nodes for name in self._shown.values()):
            return
        for name in self._shown.values():
            self._page.replace(name, None)
        self._shown, self._key = {}, key
        if scene is None:
            return
        for i, box in enumerate(scene.scene.boxes):
            self._solid(f"scene.boxes.{i}", shapes.box(box.size_m), (*box.position, *box.quaternion_xyzw))
        for i, item in enumerate(scene.scene.objects):
            shape = self._mesh(item.object)
            if shape is not None:
                self._solid(f"scene.objects.{i}", shape, item.pose)
        points = np.array(scene.scene.points).reshape(-1, 3)
        if len(points):
            node = self._page.client.scene.add_point_cloud(
                f"{SCENE}/points",
                points,
                colours.STANDING,
                point_size=2 * scene.scene.point_radius_m,
                point_shape="circle",
                precision="float32",
            )
            self._keep("points", node)

    def mark(self, hit: Collection[str]) -> None:
        """Paint what is hit red, and nothing else of the scene."""
        for what, name in self._shown.items():
            node = self._page.nodes.get(name)
            if node is not None and what != "points":
                node.color = colours.WRONG if what in hit else colours.STANDING
                # What is hit often hides what hits it.
                node.opacity = _SEEN_THROUGH if what in hit else None

    def _mesh(self, id: str) -> Shape | None:
        found = self._page.db.objects.get(id)
        return None if found.info.mesh is None else shapes.of_triangles(found.mesh_triangles())

    def _solid(self, what: str, shape: Shape, pose: Sequence[float]) -> None:
        node = self._page.solid(
            f"{SCENE}/{what.replace('.', '_')}",
            shape,
            colours.STANDING,
            side="double",
            position=np.array(pose[:3]),
            wxyz=wxyz(pose[3:]),
        )
        self._keep(what, node)

    def _keep(self, what: str, node: Any) -> None:
        name = f"standing {what}"
        self._page.replace(name, node)
        self._shown[what] = name
