"""The list of objects, with the service's pictures of them."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from PIL import Image

from graspdb.errors import GraspDBError
from graspdb.resources.objects import GraspObject
from graspdb_viewer.page import Page
from graspdb_viewer.panels import words

_MOST = 24
_WIDTH, _HEIGHT = 240, 150


class ObjectsPanel:
    """The first objects there are, each with its picture; a button shows it: ``choose`` takes its id."""

    def __init__(self, page: Page, choose: Callable[[str], None]) -> None:
        self._page, self._choose = page, choose
        self._told = page.client.gui.add_markdown("")
        self._folder = page.client.gui.add_folder("All objects")
        self._shown: dict[str, tuple[Any, list[Any]]] = {}

    def draw(self, items: list[GraspObject]) -> None:
        """Show these objects; pictures of those that have not changed are not asked for again."""
        told = [f"The first {_MOST} of {len(items):,} objects."] if len(items) > _MOST else []
        items = items[:_MOST]
        keys = {item.id: item.info.mesh and item.info.mesh.sha256 for item in items}
        for name in [name for name, (key, _) in self._shown.items() if keys.get(name, "") != key]:
            for handle in self._shown.pop(name)[1]:
                handle.remove()
        for item in items:
            if item.id in self._shown:
                continue
            handles: list[Any] = []
            with self._folder:
                if item.info.mesh is not None:
                    try:
                        png = item.picture(width=_WIDTH, height=_HEIGHT)
                    except GraspDBError as error:
                        told = [f"No pictures: {words.plain(error)}"]
                    else:
                        pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
                        handles.append(self._page.client.gui.add_image(pixels, format="png"))
                button = self._page.client.gui.add_button(
                    f"Show {item.id}", hint=_in_a_line(item), color="gray"
                )
            button.on_click(partial(self._chosen, item.id))
            self._shown[item.id] = (keys[item.id], [*handles, button])
        self._told.content = "\n\n".join(told)

    def _chosen(self, name: str, _: Any) -> None:
        self._choose(name)


def _in_a_line(item: GraspObject) -> str:
    """What of an object is told beside its name."""
    successes = item.info.outcomes.get("success", 0)
    mesh = "" if item.info.mesh is not None else ", no mesh"
    return f"{sum(item.info.outcomes.values()):,} trials, {successes:,} successes{mesh}"
