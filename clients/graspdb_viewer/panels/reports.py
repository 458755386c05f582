"""Reports at the press of a button: as Plotly figures, and tolerances as an ellipsoid at the best grasp."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from graspdb.errors import GraspDBError
from graspdb.reports import Anisotropy
from graspdb_viewer.latest import Latest, Task
from graspdb_viewer.page import Page, Subject
from graspdb_viewer.panels import charts, words
from graspdb_viewer.panels.closing import GRIPPER
from graspdb_viewer.scene import shapes

_TOLERANCE = (0, 158, 115)
_ASPECT = 1.35


class ReportsPanel:
    """A button a report; each is asked by a thread of its own, for some take minutes."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._workers: list[Latest] = []
        gui = page.client.gui
        self._figures: dict[str, Any] = {}
        self._texts: dict[str, Any] = {}
        for title, name in (
            ("Enough tried? (convergence)", "convergence"),
            ("To be believed? (calibration)", "calibration"),
            ("How wide a kernel? (widths)", "widths"),
            ("Where? (projection)", "projection"),
        ):
            self._button(title, name)
        with gui.add_folder("Tolerance at the best grasp", expand_by_default=True):
            button = gui.add_button("Draw the tolerance")
            self._tolerance = gui.add_markdown("")
        tolerance = self._told("tolerance", self._tolerance, self._ellipsoid)
        self._on_press(button, tolerance)

    def close(self) -> None:
        """Ask nothing any more."""
        for worker in self._workers:
            worker.close()

    def clear(self) -> None:
        """Another object: what was said is no longer of what is shown."""
        for key in list(self._figures):
            self._figures.pop(key).remove()
        for text in self._texts.values():
            text.content = ""
        self._tolerance.content = ""
        self._page.replace("tolerance", None)

    def _button(self, title: str, name: str) -> None:
        gui = self._page.client.gui
        folder = gui.add_folder(title, expand_by_default=True)
        with folder:
            button = gui.add_button("Compute")
            text = gui.add_markdown("")
        self._texts[name] = text

        def compute(subject: Subject) -> str:
            report = _ask(subject, name)
            figure = getattr(charts, name)(report)
            if (shown := self._figures.get(name)) is not None:
                shown.figure = figure
            else:
                with folder:
                    self._figures[name] = gui.add_plotly(
                        figure, aspect=_ASPECT, config={"displayModeBar": False}
                    )
            minded = "".join(f"\n\n*Mind:* {words.plain(warning)}" for warning in report.raw.warnings)
            return f"{words.plain(report.raw.text)}{minded}"

        self._on_press(button, self._told(name, text, compute))

    def _on_press(self, button: Any, task: Task) -> None:
        worker = Latest(self._page.failed)
        self._workers.append(worker)
        button.on_click(lambda _: worker.soon(task))

    def _told(self, name: str, text: Any, compute: Callable[[Subject], str]) -> Task:
        """A task that says what a report came to, or why there is none, where it stands."""

        def task() -> None:
            subject = self._page.subject
            if subject is None:
                return
            text.content = "*Computing ...*"
            try:
                text.content = compute(subject)
            except (GraspDBError, ValueError) as error:
                if name in self._figures:
                    self._figures.pop(name).remove()
                text.content = f"**Not yet.** {words.plain(error)}"

        return task

    def _ellipsoid(self, subject: Subject) -> str:
        report = subject.item.reports.anisotropy(**subject.selection)
        self._draw(subject, report)
        rows = {_AXES[item.axis]: item.in_words() for item in report.raw.tolerances if item.axis in _AXES}
        return f"{words.plain(report.raw.text)}\n\n{words.table(rows)}"

    def _draw(self, subject: Subject, report: Anisotropy) -> None:
        """Half widths along the gripper's axes about the tool's origin, where all three are known."""
        radii = [report.forgives.get(axis) for axis in "xyz"]
        if any(radius is None for radius in radii) or "gripper" not in self._page.nodes:
            self._page.replace("tolerance", None)
            return
        shape = shapes.ellipsoid(np.array(radii, dtype=np.float64))
        node = self._page.solid(f"{GRIPPER}/tolerance", shape, _TOLERANCE, opacity=0.45, flat_shading=False)
        self._page.replace("tolerance", node)


_AXES = {
    "x": "across the fingers (x)",
    "y": "closing (y)",
    "z": "approach (z)",
    "rx": "about x",
    "ry": "about y",
    "rz": "about z",
}


def _ask(subject: Subject, name: str) -> Any:
    reports, selection = subject.item.reports, subject.selection
    asked = {"widths": reports.bandwidth}.get(name) or getattr(reports, name)
    return asked(**selection)
