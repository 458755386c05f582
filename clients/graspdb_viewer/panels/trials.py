"""Trials as points, by outcome or source; a click on one tells its story."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from graspdb.poses import Poses
from graspdb.wire import TrialOut
from graspdb_viewer.page import OBJECT, Page
from graspdb_viewer.panels import words
from graspdb_viewer.scene import colours, shapes
from graspdb_viewer.view import MOST_GRASPS

ALL = "all"


class TrialsPanel:
    """Which trials are shown; ``changed`` is called when the user changes that, ``chosen`` at a click on one,
    and ``replay`` where its motion is wanted.
    """

    def __init__(
        self,
        page: Page,
        changed: Callable[[], None],
        chosen: Callable[[TrialOut], None],
        replay: Callable[[TrialOut], None],
    ) -> None:
        self._page, self._chosen = page, chosen
        gui, view = page.client.gui, page.view
        self._shown = gui.add_checkbox("Show trials", initial_value=view.trials)
        self._count = gui.add_slider(
            "How many ", 100, MOST_GRASPS, 100, initial_value=max(100, view.trials_count)
        )
        self._by = gui.add_dropdown("Coloured by ", ("outcome", "source"), initial_value=view.trials_by)
        self._outcome = gui.add_dropdown("Only", (ALL,))
        self._legend = gui.add_html("")
        self._story = gui.add_markdown("")
        self._replay = gui.add_button("Replay its motion", visible=False)
        self._told = gui.add_markdown("")
        self._told_of: TrialOut | None = None
        self._replay.on_click(lambda _: None if self._told_of is None else replay(self._told_of))
        self._trials: list[TrialOut] = []

        def on_change(_: Any) -> None:
            view.trials = self._shown.value
            view.trials_by = "source" if self._by.value == "source" else "outcome"
            view.trials_count = int(self._count.value)
            changed()

        for control in (self._shown, self._count, self._by, self._outcome):
            control.on_update(on_change)

    def draw(self) -> None:
        """Read the trials of the view and draw them."""
        page, view, subject = self._page, self._page.view, self._page.subject
        self._trials, self._told_of = [], None
        self._replay.visible, self._told.content = False, ""
        if subject is None or not view.trials:
            page.replace("trials", None)
            self._legend.content, self._story.content = "", ""
            return
        counts = subject.item.info.outcomes
        options = (ALL, *sorted(name for name, n in counts.items() if n))
        if self._outcome.options != options:
            self._outcome.options = options
        only = None if self._outcome.value == ALL else self._outcome.value
        listing = subject.item.trials.list(outcome=only, **subject.selection)
        self._trials = listing.first(view.trials_count)
        if not self._trials:
            page.replace("trials", None)
            self._legend.content = ""
            self._story.content = (
                "**Nothing to show**: no trial is stored as a row; a sweep's collisions are only counted."
                if subject.item.info.trials or counts
                else "**Nothing was tried yet**: post trials, or have workers simulate some:"
                f" `graspdb sweep {subject.item.id}`."
            )
            return
        named = [getattr(trial, view.trials_by) for trial in self._trials]
        poses = _poses(self._trials)
        node = page.instances(
            f"{OBJECT}/trials", shapes.ball(0.012 * subject.size_m), poses, colours.of_names(named), lod="off"
        )
        node.on_click(self._clicked)
        page.replace("trials", node)
        tally = Counter(name or "unknown" for name in named)
        self._legend.content = colours.legend(list(tally), list(tally.values()))
        rows = subject.item.info.trials
        self._story.content = (
            f"The first {len(self._trials):,} of {rows:,} trials, each a point at the tool's origin."
            " **Click one** and it tells its story."
        )

    def tell(self, trial: TrialOut) -> None:
        """A trial's story."""
        self._story.content = words.story(trial)
        self._told_of = trial
        self._replay.visible, self._told.content = trial.sweep is not None, ""

    @property
    def told_of(self) -> TrialOut | None:
        """The trial whose story is told."""
        return self._told_of

    def say(self, text: str) -> None:
        """Something about the replay of the trial that is told of."""
        self._told.content = text

    def _clicked(self, event: Any) -> None:
        if event.instance_index is not None and event.instance_index < len(self._trials):
            trial = self._trials[event.instance_index]
            self.tell(trial)
            self._chosen(trial)


def _poses(trials: list[TrialOut]) -> Poses:
    """Where they were tried: the achieved pose where it is known."""
    there = [trial.achieved_pose or trial for trial in trials]
    return Poses(
        np.array([pose.position for pose in there]), np.array([pose.quaternion_xyzw for pose in there])
    )
