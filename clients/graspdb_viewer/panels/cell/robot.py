"""A robot that takes the grasps: its arm at pregrasp, grasp and lift, and its base that is dragged."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.errors import Infeasible
from graspdb.poses import Poses, matrices
from graspdb.resources.results import Grasps
from graspdb.wire import GraspJoints, RobotReach, SceneInfo
from graspdb_viewer.latest import Latest
from graspdb_viewer.page import Page, Subject, put, triple, wxyz, xyzw
from graspdb_viewer.panels.cell import words
from graspdb_viewer.panels.cell.arm import ArmDrawing, ShownRobot, tool_in_flange
from graspdb_viewer.panels.cell.standing import SceneDrawing
from graspdb_viewer.panels.closing import Closing
from graspdb_viewer.scene import colours
from graspdb_viewer.view import Placed

Floats = NDArray[np.float64]
_NONE = "none"
_BESIDE_M = 0.5
"""How far from the object a robot is put at first, where nothing says where it stands."""
_STAGES = ("pregrasp", "grasp", "lift")
_LASTS_S, _CLOSES_S, _STAYS_S = 1.6, 0.6, 1.0
_FRAME_S = 0.04


@dataclass(frozen=True, eq=False)
class ArmWay:
    """Joints (n,) of an answer by stage, 0 to 2, and the frames that it was asked in, (4, 4) in the world."""

    stages: Mapping[int, Floats]
    base: Floats
    object_pose: Floats

    @classmethod
    def of(cls, joints: GraspJoints, given: Mapping[str, Any]) -> ArmWay:
        """The way of an answer to a question."""
        stages = {
            place: np.array(getattr(joints, name))
            for place, name in enumerate(_STAGES)
            if getattr(joints, name) is not None
        }
        return cls(stages, _matrix(given["robot_base_pose"]), _matrix(given["object_pose"]))

    @property
    def ends(self) -> tuple[int, int]:
        """The first and the last stage there is."""
        return min(self.stages), max(self.stages)

    def joints(self, at: float) -> Floats:
        """Joints (n,) between stages, each on its own straight line."""
        first, last = self.ends
        places = [place for place in range(first, last + 1) if place in self.stages]
        rows = np.array([self.stages[place] for place in places])
        return np.array([np.interp(at, places, column) for column in rows.T])


class RobotPanel:
    """Which robot and scene there are, where the robot stands, and how far it is on its way.

    ``changed`` is called where that changes what is asked; ``chosen`` where another robot or scene is shown.
    """

    def __init__(
        self, page: Page, closing: Closing, changed: Callable[[], None], chosen: Callable[[], None]
    ) -> None:
        self._page, self._closing, self._changed, self._chosen = page, closing, changed, chosen
        gui, view = page.client.gui, page.view
        self._robots = gui.add_dropdown("Robot", (_NONE, *([] if view.robot is None else [view.robot])))
        self._scenes = gui.add_dropdown("Scene", (_NONE, *([] if view.scene is None else [view.scene])))
        self._slider = gui.add_slider(
            "Stage", 0.0, 2.0, 0.01, 1.0, marks=tuple(enumerate(_STAGES)), disabled=True
        )
        self._play = gui.add_button("Play the motion", disabled=True)
        self._told = gui.add_markdown("")
        self._stand = gui.add_button("Stand where it takes one", visible=False)
        self._lock = threading.RLock()
        self._arm, self._standing = ArmDrawing(page, self._dragged), SceneDrawing(page)
        self._robot: ShownRobot | None = None
        self._scene: SceneInfo | None = None
        self._better: Placed | None = None
        self.way: ArmWay | None = None
        self._playing = Latest(page.failed)
        for control in (self._robots, self._scenes):
            control.on_update(lambda event: self._switched() if event.client_id is not None else None)
        self._slider.on_update(lambda event: self._slid() if event.client_id is not None else None)
        self._play.on_click(lambda _: self._playing.soon(self._run))
        self._stand.on_click(lambda _: self._move_there())

    def close(self) -> None:
        """The tab is gone."""
        self.way = None
        self._playing.close()

    def settle(self, subject: Subject) -> None:
        """Give a robot a place where the view has none for it."""
        view = self._page.view
        if view.robot is not None and view.robot_base is None:
            view.robot_base = _first_place(subject, view.object_pose)

    def draw(self, subject: Subject) -> None:
        """What the view has of robot and scene; asks for what is not known of them."""
        view, db = self._page.view, self._page.db
        self._offer()
        scene = None if view.scene is None else db.scenes.get(view.scene)
        robot = None
        if view.robot is not None:
            info, before = db.robots.get(view.robot), self._robot
            known = before is not None and before.info.sha256 == info.sha256
            shape = before.shape if before is not None and known else db.robots.shape(view.robot)
            robot = ShownRobot(info, shape, subject.profile, tool_in_flange(info, subject.profile))
        with self._lock:
            other = robot is None or self._robot is None or robot.shape is not self._robot.shape
            if other:
                self._arm.remove()
                self._put_back()
                self.way = None
            self._robot, self._scene = robot, scene
            self._standing.draw(scene)
            if robot is not None and view.robot_base is not None:
                self._arm.stand(view.robot_base)
                if other or "arm 0" not in self._page.nodes:
                    self._arm.put(robot, robot.rest, pale=True)
            elif robot is None:
                self._standing.mark(())
                self._stand.visible = False
                first = "Choose a robot, or store" if len(self._robots.options) > 1 else "Store"
                self._told.content = f"{first} one: `graspdb robots put arm panda.urdf --flange panda_link8`."
                self._enable(None)

    def answered(self, given: Mapping[str, Any], found: Grasps | Infeasible | None, seconds: float) -> None:
        """An answer to a question, in the order in which they were asked; None where there is none."""
        with self._lock:
            robot = self._robot
            if robot is None or given.get("robot") != robot.info.id:
                return
            self.way, self._better = None, None
            self._put_back()
            hit: set[str] = set()
            if isinstance(found, Grasps) and found[0].joints is not None:
                self.way = ArmWay.of(found[0].joints, given)
                self._show(self._slider.value)
                self._told.content = words.taken(robot, found[0])
            elif isinstance(found, Infeasible) and found.reach is not None:
                hit = self._refused(robot, found.reach)
            else:
                self._arm.put(robot, robot.rest, pale=True)
                self._told.content = "There is no grasp for the arm to take."
            self._told.content += f"\n\nAnswered in {1e3 * seconds:.0f} ms."
            self._stand.visible = self._better is not None
            self._enable(self.way)
            self._standing.mark(hit)
            _paint(self._page.nodes.get("mesh"), "object" in hit, colours.OBJECT)
            _paint(self._page.nodes.get("obstacle body"), "obstacles.boxes.0" in hit, colours.OBSTACLE)

    def _refused(self, robot: ShownRobot, reach: RobotReach) -> set[str]:
        """Show why the arm takes none; what its links hit."""
        red: dict[str, str] = {}
        joints = robot.rest if reach.joints is None else np.array(reach.joints)
        for item in reach.colliding:
            red.setdefault(item.link, f"{item.link} meets {words.thing(item.other, self._scene)}")
            # Another link, if it is one, is red too, and told of once.
            red.setdefault(item.other, "")
        for name, (value, limit) in robot.beyond(joints).items():
            for link in robot.moved_by(name):
                red.setdefault(link, f"{name} at {value:.2f}, limit {limit:.2f}")
        self._arm.put(robot, joints, red=red, pale=reach.joints is None, gripper=reach.joints is not None)
        self._told.content = words.refused(robot, reach, self._scene)
        place = reach.nearest_base_pose
        if place is None:
            self._told.content += "\n\nNo place around was found for the base where it takes one."
        else:
            self._better = Placed(position=place.position, quaternion_xyzw=place.quaternion_xyzw)
            at = ", ".join(f"{number:.2f}" for number in place.position)
            self._told.content += f"\n\nWith its base at {at} m it takes one."
        return {item.other for item in reach.colliding}

    # The way

    def _enable(self, way: ArmWay | None) -> None:
        self._slider.disabled = self._play.disabled = way is None
        if way is not None and (self._slider.min, self._slider.max) != way.ends:
            self._slider.min, self._slider.max = way.ends

    def _show(self, at: float) -> None:
        """The arm, the gripper and what it holds at a stage of the way, 0 to 2."""
        robot, way = self._robot, self.way
        if robot is None or way is None:
            return
        at = min(max(at, way.ends[0]), way.ends[1])
        joints = way.joints(at)
        self._arm.put(robot, joints)
        grasp = self._gripper_at(robot, way, way.joints(1.0))
        now = self._gripper_at(robot, way, joints)
        if grasp is None or now is None:
            return
        self._closing.move(Poses.of(now[None]))
        self._place_mesh(now @ np.linalg.inv(grasp) if at > 1.0 else np.eye(4))

    def _gripper_at(self, robot: ShownRobot, way: ArmWay, joints: Floats) -> Floats | None:
        """The tool's pose (4, 4) in the object frame."""
        if robot.tool_in_flange is None:
            return None
        flange = robot.shape.frames(joints)[0, -1]
        return np.asarray(np.linalg.inv(way.object_pose) @ way.base @ flange @ robot.tool_in_flange)

    def _place_mesh(self, pose: Floats) -> None:
        mesh = self._page.nodes.get("mesh")
        if mesh is not None:
            there = Poses.of(pose[None])
            mesh.position, mesh.wxyz = there.position[0], wxyz(there.quaternion_xyzw[0])

    def _put_back(self) -> None:
        """The object where it stands."""
        self._place_mesh(np.eye(4))

    def _slid(self) -> None:
        with self._lock:
            self._show(self._slider.value)

    def _run(self) -> None:
        """The whole way, the jaw closing on the object between approach and lift, and back to the grasp."""
        way = self.way
        if way is None:
            return
        first, last = way.ends
        parts = [(float(first), 1.0, _LASTS_S, None), (1.0, 1.0, _CLOSES_S, (0.0, 1.0))]
        parts += [(1.0, float(last), _LASTS_S, None), (float(last), float(last), _STAYS_S, None)]
        self._closing.close_by(0.0)
        for start, end, lasts, jaw in parts:
            began = time.monotonic()
            while self.way is way:
                share = min((time.monotonic() - began) / lasts, 1.0)
                smooth = share * share * (3.0 - 2.0 * share)
                with self._lock:
                    if self.way is not way:
                        return
                    put(self._slider, round(start + (end - start) * smooth, 3))
                    self._show(start + (end - start) * smooth)
                if jaw is not None:
                    self._closing.close_by(smooth)
                if share >= 1.0:
                    break
                time.sleep(_FRAME_S)
        with self._lock:
            if self.way is way:
                put(self._slider, 1.0)
                self._show(1.0)
                self._closing.close_by(0.0)

    # What the user does

    def _offer(self) -> None:
        view, db = self._page.view, self._page.db
        for control, names, chosen in (
            (self._robots, [robot.id for robot in db.robots], view.robot),
            (self._scenes, [scene.id for scene in db.scenes], view.scene),
        ):
            options = (_NONE, *names, *([] if chosen is None or chosen in names else [chosen]))
            if control.options != options:
                control.options = options
            put(control, chosen or _NONE)

    def _switched(self) -> None:
        view = self._page.view
        robot, scene = (None if c.value == _NONE else c.value for c in (self._robots, self._scenes))
        if (robot, scene) == (view.robot, view.scene):
            return
        if robot is None:
            view.robot_base = None
        view.robot, view.scene = robot, scene
        self._chosen()

    def _dragged(self, node: Any) -> None:
        with suppress(ValueError):  # dragged a kilometre away
            self._page.view.robot_base = Placed(
                position=triple(node.position), quaternion_xyzw=xyzw(node.wxyz)
            )
        self._changed()

    def _move_there(self) -> None:
        with self._lock:
            if self._better is None:
                return
            self._page.view.robot_base = self._better
            self._arm.stand(self._better)
        self._changed()


def _first_place(subject: Subject, object_pose: Placed | None) -> Placed:
    """Where a robot stands of which nothing says it: at the world's origin, or where the object is, beside
    it and as low.
    """
    if object_pose is not None:
        return Placed(position=(0.0, 0.0, 0.0))
    low = subject.centre[2] - subject.size_m / 2
    if subject.mesh is not None:
        low = subject.mesh.vertices[:, 2].min()
    return Placed(position=(round(float(subject.centre[0]) - _BESIDE_M, 3), 0.0, round(float(low), 4)))


def _matrix(pose: Any) -> Floats:
    values = np.asarray(pose, dtype=np.float64)
    return matrices(values[:3], values[3:])


def _paint(node: Any, hit: bool, colour: tuple[int, int, int]) -> None:
    wanted = colours.WRONG if hit else colour
    if node is not None and tuple(node.color) != wanted:
        node.color = wanted
