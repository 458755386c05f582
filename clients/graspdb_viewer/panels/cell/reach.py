"""The map of reach: which grasps the arm takes from where it stands, and how many from places around."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from graspdb.poses import Poses
from graspdb_viewer.latest import Latest
from graspdb_viewer.page import OBJECT, Page, Subject
from graspdb_viewer.panels.spoken import constraints
from graspdb_viewer.scene import colours, shapes

_SHOWN: dict[str, Literal["none", "grasps", "bases"]] = {
    "none": "none",
    "grasps that it takes": "grasps",
    "places for its base": "bases",
}
_GRASPS, _TRIED = 200, 12
"""Grasps that are coloured, and those that are tried at every place."""
_PLACES, _STEP_M = 13, 0.15
"""Places along either edge of the square about the object, and how far apart they are."""
_SEED = 1
_REST_S = 0.4
_COLOURS = {
    "taken": (0, 158, 115),
    "too_far": (150, 150, 150),
    "joint_limit": (230, 159, 0),
    "singular": (204, 121, 167),
    "self_collision": (120, 60, 130),
    "collision": colours.WRONG,
}
_WORDS = {
    "taken": "the arm takes it",
    "too_far": "too far",
    "joint_limit": "beyond a joint's limit",
    "singular": "singular on the way",
    "self_collision": "links collide",
    "collision": "collides with what stands around",
}


class ReachPanel:
    """Which map is shown; asked by a thread of its own, for it takes longer than a best grasp."""

    def __init__(self, page: Page, changed: Callable[[], None]) -> None:
        self._page = page
        gui, view = page.client.gui, page.view
        shown = next(words for words, key in _SHOWN.items() if key == view.reach)
        self._which = gui.add_dropdown("Map of reach", tuple(_SHOWN), initial_value=shown)
        self._bar = gui.add_image(colours.bar(), format="png", visible=False)
        self._legend = gui.add_html("")
        self._told = gui.add_markdown("")
        self._asking = Latest(self._failed)
        self._kept: tuple[object, Poses] | None = None
        self._wanted = 0
        self._key: object = None
        self.shown: tuple[str, Any] | None = None
        """What is drawn: ``grasps`` or ``bases``, and the service's answer."""

        def on_change(_: Any) -> None:
            view.reach = _SHOWN[self._which.value]
            self.soon()
            changed()

        self._which.on_update(on_change)

    def close(self) -> None:
        """The tab is gone."""
        self._asking.close()

    def soon(self) -> None:
        """Ask for the map of the view once nothing changes for a moment: best grasps go before."""
        self._wanted += 1
        self._asking.soon(partial(self._wait, self._wanted))

    def _wait(self, number: int) -> None:
        if self._page.view.reach != "none":
            time.sleep(_REST_S)
        if number == self._wanted:
            self._ask()

    def _failed(self, error: Exception) -> None:
        self._nothing()
        self._page.failed(error)

    def _nothing(self) -> None:
        for name in ("reach grasps", "reach bases"):
            self._page.replace(name, None)
        self._bar.visible, self._legend.content, self._told.content = False, "", ""
        self.shown = self._key = None

    def _ask(self) -> None:
        view, subject = self._page.view, self._page.subject
        if subject is None or subject.profile is None or view.robot is None or view.reach == "none":
            self._nothing()
            return
        given = constraints(view, subject.selection, solid=subject.mesh is not None)
        names = (
            "robot",
            "robot_base_pose",
            "object_pose",
            "scene",
            "obstacles",
            "pregrasp_distance_m",
            "lift_m",
        )
        asked = {name: given[name] for name in names if name in given}
        asked["gripper"] = subject.selection.get("gripper") or subject.gripper
        poses = self._poses(subject)
        key = (view.reach, self._kept and self._kept[0], _of_the_map(view.reach, asked))
        if key == self._key and f"reach {view.reach}" in self._page.nodes:
            return
        self._key = None
        if view.reach == "grasps":
            answer = subject.item.reach(poses.rows, **asked)
            self._draw_grasps(subject, poses, [reason or "taken" for reason in answer.reason])
        else:
            places = _around(np.array(asked["object_pose"]), np.array(asked["robot_base_pose"]))
            answer = subject.item.reach(poses.rows[:_TRIED], bases=places, **asked)
            self._draw_bases(places, np.array(answer.base_share))
        self.shown, self._key = (view.reach, answer), key

    def _poses(self, subject: Subject) -> Poses:
        """Grasps drawn from the density, or before any success from the prior; kept."""
        item = subject.item
        key = (item.id, item.info.revision, *subject.selection.items())
        if self._kept is None or self._kept[0] != key:
            if subject.successes:
                drawn = item.samples(_GRASPS, seed=_SEED, **subject.selection)
            else:
                drawn = item.proposals(_GRASPS, strategy="edges", seed=_SEED, gripper=subject.gripper)
            self._kept = key, Poses(drawn.position, drawn.quaternion_xyzw)
        return self._kept[1]

    def _draw_grasps(self, subject: Subject, poses: Poses, what: list[str]) -> None:
        assert subject.profile is not None
        painted = np.array([_COLOURS[name] for name in what], dtype=np.uint8)
        node = self._page.instances(
            f"{OBJECT}/reach", shapes.jaw(subject.profile), poses, painted, lod="off", opacity=0.7
        )
        self._page.replace("reach bases", None)
        self._page.replace("reach grasps", node)
        self._bar.visible = False
        counts = {name: what.count(name) for name in _COLOURS if name in what}
        self._legend.content = colours.legend_of(
            [(_COLOURS[name], f"{_WORDS[name]} {count:,}") for name, count in counts.items()]
        )
        self._told.content = f"{len(what):,} grasps drawn from the density, with the base where it stands."

    def _draw_bases(self, places: NDArray[np.float64], share: NDArray[np.float64]) -> None:
        there = Poses(places[:, :3] + [0.0, 0.0, 2e-3], np.tile([0.0, 0.0, 0.0, 1.0], (len(places), 1)))
        disc = shapes.box((0.8 * _STEP_M, 0.8 * _STEP_M, 2e-3))
        painted = colours.of_values(np.where(share > 0, share, np.nan), 0.0, 1.0)
        node = self._page.instances("/reach", disc, there, painted, lod="off", opacity=0.85)
        self._page.replace("reach grasps", None)
        self._page.replace("reach bases", node)
        self._bar.visible, self._legend.content = True, ""
        self._told.content = (
            f"Share of {_TRIED} grasps drawn from the density that the arm takes with its base there, turned"
            " to the object: few dark, all bright; grey: not one."
        )


def _of_the_map(which: str, asked: dict[str, Any]) -> str:
    """What a map depends on: that of places not on where the base is now, but on how high."""
    if which == "bases":
        asked = {**asked, "robot_base_pose": asked["robot_base_pose"][2]}
    return repr(sorted(asked.items()))


def _around(object_pose: NDArray[np.float64], base: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (N, 7) of the base on a square about the object, as high as it is, its x towards the object."""
    line = (np.arange(_PLACES) - _PLACES // 2) * _STEP_M
    x, y = (part.ravel() for part in np.meshgrid(line, line))
    away = np.hypot(x, y) > 1.5 * _STEP_M
    x, y = x[away], y[away]
    turn = np.arctan2(-y, -x) / 2
    zero = np.zeros(len(x))
    place = [object_pose[0] + x, object_pose[1] + y, zero + base[2]]
    return np.column_stack([*place, zero, zero, np.sin(turn), np.cos(turn)])
