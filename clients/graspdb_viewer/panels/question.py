"""The best grasps within what the user drags about: workspace, cone, obstacle, and the object itself."""

from __future__ import annotations

import html
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal

import numpy as np

from graspdb.errors import Infeasible
from graspdb.poses import Poses
from graspdb.resources.results import Grasp, Grasps
from graspdb_viewer.page import OBJECT, Page, Subject
from graspdb_viewer.panels import words
from graspdb_viewer.panels.closing import Closing
from graspdb_viewer.panels.gizmos import Gizmos
from graspdb_viewer.panels.spoken import Spoken, constraints, spoken
from graspdb_viewer.scene import colours, shapes

Told = Callable[[Mapping[str, Any], Grasps | Infeasible | None, float], None]
_OBJECTIVES: dict[str, Literal["density", "success_probability"]] = {
    "density": "density",
    "success probability": "success_probability",
}
_NEAREST = (140, 140, 140)
_LANGUAGES = ("curl", "Python", "Command line")
_FILES = ("best-grasp.sh", "best-grasp.py", "best-grasp-command.sh")
#: Viser has nothing that writes to a clipboard. A page on a plain HTTP address has no ``navigator.clipboard``
#: either, so what is selected is copied.
_COPYABLE = """<div style="margin: 0 10px 6px">
<textarea readonly rows="{rows}" aria-label="{label}" style="{style}">{text}</textarea>
<button type="button" style="{button}" onclick="this.previousElementSibling.select();
this.textContent = document.execCommand('copy') ? 'Copied' : 'Press Ctrl+C'">Copy {label}</button></div>"""
_TEXT_STYLE = (
    "width: 100%; box-sizing: border-box; font: 0.75em monospace; padding: 0.5em; resize: vertical;"
    " white-space: pre; color: inherit; background: transparent; border: 1px solid #8888; border-radius: 4px"
)
_BUTTON_STYLE = (
    "width: 100%; font: inherit; font-size: 0.85em; padding: 0.4em; cursor: pointer;"
    " color: #fff; background: #228be6; border: 0; border-radius: 2px"
)


class QuestionPanel:
    """What is asked for, and what is answered; ``changed`` is called at every change, and while dragging,
    ``told`` with every question and its answer, in the order in which they were asked.
    """

    def __init__(
        self, page: Page, closing: Closing, changed: Callable[[], None], told: Told, *, keyed: bool
    ) -> None:
        self._page, self._closing, self._keyed, self._told = page, closing, keyed, told
        gui, view = page.client.gui, page.view
        self._count = gui.add_slider("Best grasps", 0, 20, 1, initial_value=view.best)
        self._objective = gui.add_dropdown(
            "Ranked by", tuple(_OBJECTIVES), initial_value=view.objective.replace("_", " ")
        )
        self.gizmos = Gizmos(page, changed)
        self._answer = gui.add_markdown("")
        self._latency = gui.add_markdown("")
        self._elsewhere = gui.add_button(
            "Copy the question", hint="As curl, Python and a command line.", disabled=True
        )
        self._elsewhere.on_click(lambda _: self._tell_elsewhere())
        self.spoken: Spoken | None = None
        self.answered: Grasps | None = None
        self.questions = 0

        def on_change(_: Any) -> None:
            view.best = int(self._count.value)
            view.objective = _OBJECTIVES[self._objective.value]
            changed()

        for control in (self._count, self._objective):
            control.on_update(on_change)

    def ask(self) -> None:
        """Ask for the best grasps of the view, and show them or why there are none."""
        page, view, subject = self._page, self._page.view, self._page.subject
        self.spoken = None
        if subject is None or view.best == 0:
            self._nothing("")
            return
        given = constraints(view, subject.selection, solid=subject.mesh is not None)
        if subject.density is None or not subject.successes:
            if subject.gripper is None or subject.mesh is None:
                self._nothing("**No best grasp yet**: nothing has succeeded.")
                return
            given["gripper"] = subject.gripper
        self.spoken = spoken(page.db.url, subject.item.id, view.best, given, keyed=self._keyed)
        self._elsewhere.disabled = False
        began = time.perf_counter()
        try:
            found = subject.item.best_grasps(count=view.best, **given)
        except Infeasible as error:
            self._infeasible(error)
            self._told(given, error, time.perf_counter() - began)
            return
        self.answered = found
        self._show(subject, found)
        self._told(given, found, time.perf_counter() - began)
        self.questions += 1
        self._latency.content = (
            f"Answered in {1e3 * (time.perf_counter() - began):.0f} ms, at revision {found.revision:,}."
        )

    def _show(self, subject: Subject, found: Grasps) -> None:
        best = found[0]
        self._closing.show(_pose(best), end_m=best.width_m)
        others = [_pose(grasp) for grasp in found[1:]]
        node = None
        if others and subject.profile is not None:
            poses = Poses(*(np.concatenate(part) for part in zip(*others, strict=True)))
            shape = shapes.fingers(subject.profile)
            node = self._page.instances(
                f"{OBJECT}/best", shape, poses, colours.SECOND, lod="off", opacity=0.55
            )
        self._page.replace("best", node)
        self._page.replace("nearest", None)
        fewer = f" Only {len(found)} distinct ones exist." if found.status == "fewer" else ""
        prior = " **By geometry alone: nothing has succeeded yet.**" if best.prior else ""
        minded = "".join(f"\n\n*Mind:* {words.plain(warning)}" for warning in found.warnings)
        self._answer.content = f"**Best grasp.**{prior}{fewer}\n\n{words.table(best.summary())}{minded}"

    def _tell_elsewhere(self) -> None:
        """The question of this moment in three languages, to be copied or downloaded."""
        told, client = self.spoken, self._page.client
        if told is None:
            return
        with client.gui.add_modal("Ask the same elsewhere") as modal:
            for label, name, text in zip(_LANGUAGES, _FILES, told, strict=True):
                client.gui.add_markdown(f"**{label}**")
                client.gui.add_html(_copyable(label, text))
                download = client.gui.add_button(f"Download {name}")
                download.on_click(partial(self._download, name, text.encode()))
            client.gui.add_button("Close").on_click(lambda _: modal.close())

    def _download(self, name: str, content: bytes, _: Any) -> None:
        self._page.client.send_file_download(name, content, save_immediately=True)

    def _infeasible(self, error: Infeasible) -> None:
        nearest = error.nearest if isinstance(error.nearest, Grasp) else None
        self._nothing(_why_none(error))
        subject = self._page.subject
        # Where the arm fails its own gripper is drawn.
        alone = error.reach is None or error.reach.joints is None
        if nearest is not None and alone and subject is not None and subject.profile is not None:
            shape = shapes.gripper(subject.profile)
            node = self._page.instances(
                f"{OBJECT}/nearest", shape, _pose(nearest), _NEAREST, lod="off", opacity=0.5
            )
            self._page.replace("nearest", node)

    def _nothing(self, why: str) -> None:
        self.answered = None
        self._elsewhere.disabled = self.spoken is None
        self._closing.show(None)
        self._page.replace("best", None)
        self._page.replace("nearest", None)
        self._answer.content, self._latency.content = why, ""
        self.questions += 1


def _copyable(label: str, text: str) -> str:
    """A text with a button that copies it."""
    return _COPYABLE.format(
        label=label,
        rows=min(14, 1 + text.count("\n")),
        text=html.escape(text),
        style=_TEXT_STYLE,
        button=_BUTTON_STYLE,
    )


def _pose(grasp: Grasp) -> Poses:
    return Poses(np.array([grasp.position]), np.array([grasp.quaternion_xyzw]))


def _why_none(error: Infeasible) -> str:
    """What excludes what, what would do, and what the grey gripper is."""
    if not error.conflict and error.nearest is None:
        return f"**No grasp.** {words.plain(error)}"
    names = [f"`{name}`" for name in error.conflict]
    what = "all that was tried" if len(names) == 1 else "each other"
    told = "**No grasp fulfils this**"
    if names:
        told += f": {' and '.join(names)} exclude{'s' if len(names) == 1 else ''} {what}."
    if error.relax:
        values = (
            f"`{name}={','.join(f'{number:.4g}' for number in np.atleast_1d(value))}`"
            if not isinstance(value, bool)
            else f"`{name}={str(value).lower()}`"
            for name, value in error.relax.items()
        )
        told += f"\n\nThis would do: {' or '.join(values)}."
    if error.nearest is not None:
        told += "\n\nGrey: the nearest grasp outside."
    return told
