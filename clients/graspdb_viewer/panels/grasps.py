"""Grasps by the thousand: the gripper at each, coloured by density or success probability."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from graspdb.poses import Poses
from graspdb_viewer.page import OBJECT, Page, Subject
from graspdb_viewer.scene import colours, shapes
from graspdb_viewer.view import MOST_GRASPS

_SHOWN: dict[str, Literal["draws", "successes", "none"]] = {
    "drawn from the density": "draws",
    "trials that succeeded": "successes",
    "none": "none",
}
_COLOURS: dict[str, Literal["density", "success_probability"]] = {
    "density": "density",
    "success probability": "success_probability",
}
_DRAWN: dict[str, Literal["jaw", "gripper", "cloud"]] = {
    "jaws": "jaw",
    "whole grippers": "gripper",
    "a cloud of points": "cloud",
}
_POINT = 0.006
"""Size of a cloud's points, of the object's diagonal."""
_SEED = 1
"""Of the draws, so that a link shows the same ones."""
_OPACITY, _OF_FEW, _FEW = 0.2, 0.8, 100
"""So that the object is seen through thousands of them, and few of them are seen themselves."""
_DARK = -3.0
"""Common logarithm of the relative density that is as dark as none."""


class GraspsPanel:
    """Which grasps are shown, and how; ``changed`` is called when the user changes that."""

    def __init__(self, page: Page, changed: Callable[[], None]) -> None:
        self._page = page
        gui, view = page.client.gui, page.view
        shown = next(words for words, key in _SHOWN.items() if key == view.grasps)
        self._which = gui.add_dropdown("Grasps", tuple(_SHOWN), initial_value=shown)
        self._count = gui.add_slider("How many", 100, MOST_GRASPS, 100, initial_value=max(100, view.count))
        self._colour = gui.add_dropdown(
            "Coloured by", tuple(_COLOURS), initial_value=view.colour.replace("_", " ")
        )
        drawn = next(words for words, key in _DRAWN.items() if key == view.drawn)
        self._drawn = gui.add_dropdown("Drawn as", tuple(_DRAWN), initial_value=drawn)
        self._bar = gui.add_image(colours.bar(), format="png")
        self._told = gui.add_markdown("")
        self._kept: tuple[object, Poses, str] | None = None

        def on_change(_: Any) -> None:
            view.grasps = _SHOWN[self._which.value]
            view.count = int(self._count.value)
            view.colour = _COLOURS[self._colour.value]
            view.drawn = _DRAWN[self._drawn.value]
            changed()

        for control in (self._which, self._count, self._colour, self._drawn):
            control.on_update(on_change)

    def draw(self) -> None:
        """Ask for the grasps of the view and draw them."""
        page, view, subject = self._page, self._page.view, self._page.subject
        refused = _nothing(subject) if view.grasps != "none" else ""
        if subject is None or subject.profile is None or refused is not None:
            self._bar.visible = False
            self._told.content = refused or ""
            page.replace("grasps", None)
            return
        poses, told = self._asked(subject)
        values, low, meaning = self._valued(subject, poses)
        # The brightest last, so that it lies over the others.
        order = np.argsort(np.where(np.isfinite(values), values, -np.inf), kind="stable")
        there = Poses(poses.position[order], poses.quaternion_xyzw[order])
        painted = colours.of_values(values[order], low, low + 1.0 if low == 0.0 else 0.0)
        if view.drawn == "cloud":
            node: Any = page.client.scene.add_point_cloud(
                f"{OBJECT}/grasps",
                there.position,
                painted,
                point_size=_POINT * subject.size_m,
                point_shape="circle",
                precision="float32",
            )
        else:
            whole = view.drawn == "gripper"
            shape = shapes.gripper(subject.profile) if whole else shapes.jaw(subject.profile)
            opacity = max(_OPACITY, _OF_FEW * min(1.0, _FEW / len(painted)))
            node = page.instances(f"{OBJECT}/grasps", shape, there, painted, lod="off", opacity=opacity)
        page.replace("grasps", node)
        unknown = int(np.sum(~np.isfinite(values)))
        grey = f" Grey: unknown, too far from every attempt ({unknown:,})." if unknown else ""
        self._bar.visible = True
        self._told.content = f"{meaning}{grey}\n\n{told}"

    def _asked(self, subject: Subject) -> tuple[Poses, str]:
        """Poses and words for them, kept while only their colours change."""
        view, item = self._page.view, subject.item
        key = (item.id, item.info.revision, *subject.selection.items(), view.grasps, view.count)
        if self._kept is not None and self._kept[0] == key:
            return self._kept[1:]
        if not subject.successes:
            drawn = item.proposals(view.count, strategy="edges", seed=_SEED, gripper=subject.gripper)
            poses = Poses(drawn.position, drawn.quaternion_xyzw)
            told = (
                f"**Prior**: nothing has succeeded yet. These {len(poses.position):,} grasps close on opposed"
                " surfaces or edges, by geometry alone; some collide."
            )
        elif view.grasps == "draws":
            sampled = item.samples(view.count, seed=_SEED, **subject.selection)
            poses = Poses(sampled.position, sampled.quaternion_xyzw)
            told = (
                f"{len(poses.position):,} grasps drawn from the density of {subject.successes:,} successes."
            )
        else:
            listing = item.trials.list(outcome="success", withdrawn=False, **subject.selection)
            listed = [trial.achieved_pose or trial for trial in listing.first(view.count)]
            poses = Poses(
                np.array([pose.position for pose in listed]),
                np.array([pose.quaternion_xyzw for pose in listed]),
            )
            told = f"The first {len(listed):,} of {subject.successes:,} successes, as they came."
        self._kept = (key, poses, told)
        return poses, told

    def _valued(self, subject: Subject, poses: Poses) -> tuple[NDArray[np.float64], float, str]:
        """A value a pose, the value that is darkest, and what colours mean."""
        item, by = subject.item, self._page.view.colour
        if by == "success_probability":
            if subject.successes:
                answer = item.likelihood(poses.rows, include=["success_probability"], **subject.selection)
                found, what = answer.success_probability, "of success"
            else:
                asked = ["prior_success_probability", "support"]
                answer = item.likelihood(poses.rows, include=asked, gripper=subject.gripper)
                found, what = answer.prior_success_probability, "by geometry alone"
            values = np.full(len(poses.position), np.nan) if found is None else found
            return values, 0.0, f"Probability {what}: 0 dark, 1 bright."
        if not subject.successes:
            return np.zeros(len(poses.position)), _DARK, "Without a density every prior grasp is alike."
        answer = item.likelihood(poses.rows, include=["relative"], **subject.selection)
        relative = np.zeros(len(poses.position)) if answer.relative is None else answer.relative
        values = np.log10(np.maximum(relative, 10.0**_DARK))
        return values, _DARK, "Density relative to its maximum: 1/1000 dark, 1 bright (logarithmic)."


def _nothing(subject: Subject | None) -> str | None:
    """Why there is no grasp to show; None where there is."""
    if subject is None:
        return ""
    if subject.profile is None:
        return "The trials name no gripper, so there is none to draw: choose one above."
    if not subject.successes and subject.mesh is None:
        return "**Nothing to show yet**: no trial has succeeded, and there is no mesh for a prior."
    return None
