"""Sweeps of the object, as workers simulate them."""

from __future__ import annotations

from itertools import islice

from graspdb_viewer.page import Page, put
from graspdb_viewer.panels import words

_SHOWN = 3


class SweepsPanel:
    """The newest sweeps, how far each is, and what came out."""

    def __init__(self, page: Page) -> None:
        self._page = page
        gui = page.client.gui
        self._told = gui.add_markdown("")
        self._bars = [(gui.add_progress_bar(0.0, visible=False), gui.add_markdown("")) for _ in range(_SHOWN)]

    def draw(self) -> None:
        """Ask how far they are."""
        subject = self._page.subject
        if subject is None:
            return
        sweeps = list(islice(subject.item.sweeps(), _SHOWN))
        none = f"**No sweep yet**: `graspdb sweep {subject.item.id}` has workers simulate grasps."
        self._told.content = "The newest sweeps:" if sweeps else none
        for number, (bar, text) in enumerate(self._bars):
            bar.visible = number < len(sweeps)
            if number >= len(sweeps):
                text.content = ""
                continue
            sweep = sweeps[number]
            done = 100.0 * sweep.info.poses_done / max(sweep.info.poses, 1)
            put(bar, done)
            bar.animated = not sweep.finished
            rows = sweep.summary()
            if (waits := sweep.waits_for()) is not None:
                rows["waits for"] = waits
            text.content = words.table(rows)
