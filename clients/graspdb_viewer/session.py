"""One browser tab: its page, the object it shows, and who asks the service for it."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from functools import partial

import numpy as np
import viser

from graspdb import Client
from graspdb.errors import AmbiguousSelection, GraspDBError
from graspdb.poses import Poses
from graspdb.resources.objects import GraspObject
from graspdb.resources.selection import TrialSelection
from graspdb.wire import TrialOut
from graspdb_viewer.latest import Latest
from graspdb_viewer.motion import simulated
from graspdb_viewer.page import OBJECT, Page, Subject, put, triple
from graspdb_viewer.panels import words
from graspdb_viewer.panels.cell.reach import ReachPanel
from graspdb_viewer.panels.cell.robot import RobotPanel
from graspdb_viewer.panels.closing import Closing
from graspdb_viewer.panels.grasps import GraspsPanel
from graspdb_viewer.panels.objects import ObjectsPanel
from graspdb_viewer.panels.question import QuestionPanel
from graspdb_viewer.panels.reports import ReportsPanel
from graspdb_viewer.panels.sweeps import SweepsPanel
from graspdb_viewer.panels.trials import TrialsPanel
from graspdb_viewer.scene import colours, shapes
from graspdb_viewer.view import View

_POLL_S = 3.0
_REPLAY_S = 3.0
"""A replay lasts so long from the first touch on, or as long as it did."""
_ANY = "any"
_NONE = "(no object yet)"
_SIZE_M = 0.1
"""Of what is shown without a mesh."""
_ROOM_M = 4.0
"""Edges of the floor that a robot stands on."""
_UNDER_M = 2e-3
"""So that a table's top that is as high as the base hides it."""


class Session:
    """The page of one client, from its connection to :meth:`close`.

    Callbacks of the page only say what is wanted; questions are asked by threads of the session's own: one
    for the object and what is drawn of it, one for best grasps, so that these follow a drag.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        db: Client,
        view: View,
        link: Callable[[View], str],
        *,
        api_key: str | None = None,
    ) -> None:
        self._client, self._db, self._link, self._api_key = client, db, link, api_key
        self.page = Page(client, db, view, self._say)
        self._drawing, self._asking = Latest(self.page.failed), Latest(self.page.failed)
        self._linking = Latest(lambda _: None)
        self._listing, self._replaying = Latest(self.page.failed), Latest(self.page.failed)
        self._closed = threading.Event()
        self._build()
        self._drawing.soon(self._load)
        threading.Thread(target=self._follow, daemon=True).start()

    def close(self) -> None:
        """The tab is gone."""
        self._closed.set()
        workers = (self._drawing, self._asking, self._linking, self._listing, self._replaying)
        for worker in (*workers, self._reports, self.robot, self.reach):
            worker.close()

    # The page

    def _build(self) -> None:
        gui, view = self._client.gui, self.page.view
        # No share button: it would open a tunnel to a server of viser's.
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.set_panel_label("GraspDB")
        gui.main_panel.dock_right()
        self._notice = gui.add_markdown("", visible=False)
        self._again = gui.add_button("Again", visible=False)
        self._objects = gui.add_dropdown("Object", (view.object or _NONE,))
        self._gripper = gui.add_dropdown("Gripper", (_ANY,), visible=False)
        self._protocol = gui.add_dropdown("Protocol", (_ANY,), visible=False)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Best grasp"):
            closing = Closing(self.page)
            self.question = QuestionPanel(
                self.page,
                closing,
                self._changed,
                lambda *told: self.robot.answered(*told),
                keyed=self._api_key is not None,
            )
        self._closing = closing
        with tabs.add_tab("Robot"):
            self.robot = RobotPanel(self.page, closing, self._changed, self._choose_cell)
            self.reach = ReachPanel(self.page, lambda: self._linking.soon(self._tell_link))
        with tabs.add_tab("Grasps"):
            self._grasps = GraspsPanel(self.page, self._redraw)
        with tabs.add_tab("Trials"):
            self._trials = TrialsPanel(self.page, self._redraw, self._show_trial, self._replay)
        with tabs.add_tab("Reports"):
            self._reports = ReportsPanel(self.page)
        with tabs.add_tab("Object"):
            self._about = gui.add_markdown("")
            self._sweeps = SweepsPanel(self.page)
            self._list = ObjectsPanel(self.page, self._choose)
        self._address = gui.add_text("Link to this view", "", hint="Opens the same view again.")
        self._again.on_click(lambda _: self._drawing.soon(self._load))
        self._objects.on_update(
            lambda event: self._choose(event.target.value) if event.client_id is not None else None
        )
        for control in (self._gripper, self._protocol):
            control.on_update(lambda event: self._select() if event.client_id is not None else None)
        self._client.camera.on_update(lambda _: self._linking.soon(self._tell_link))
        scene = self._client.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(False)
        scene.configure_environment_map(None)

    def _say(self, text: str | None) -> None:
        self._notice.content = text or ""
        self._notice.visible = self._again.visible = text is not None

    def _changed(self) -> None:
        """What is asked for has changed; while a drag goes on, many times a second."""
        self._asking.soon(self.question.ask)
        self.reach.soon()
        self.reach.soon()
        self._linking.soon(self._tell_link)

    def _redraw(self) -> None:
        self._drawing.soon(self._draw)
        self._linking.soon(self._tell_link)

    def _tell_link(self) -> None:
        """The link, once nothing changes for a moment."""
        if self._closed.wait(0.3):
            return
        if OBJECT[1:] not in self.page.nodes:
            return  # the camera is not yet where the view has it
        camera = self._client.camera
        with contextlib.suppress(ValueError):
            self.page.view.camera = (triple(camera.position), triple(camera.look_at))
        address = self._link(self.page.view)
        if address != self._address.value:
            put(self._address, address)

    def _choose(self, name: str) -> None:
        view = self.page.view
        if name in (view.object, _NONE):
            return
        view.object, view.gripper, view.protocol = name, None, None
        view.box = view.cone = view.obstacle = view.object_pose = view.camera = None
        self.question.gizmos.untick()
        self._reports.clear()
        self._drawing.soon(self._load)

    def _choose_cell(self) -> None:
        """Another robot or scene: it is seen whole."""
        self.page.view.camera = None
        self._drawing.soon(self._draw_cell)
        self._linking.soon(self._tell_link)

    def _draw_cell(self) -> None:
        subject = self.page.subject
        if subject is not None:
            self.robot.settle(subject)
            self.robot.draw(subject)
            self._look(subject)
            self._asking.soon(self.question.ask)
            self.reach.soon()

    def _select(self) -> None:
        view = self.page.view
        chosen = [None if c.value == _ANY else c.value for c in (self._gripper, self._protocol)]
        view.gripper, view.protocol = chosen
        self._drawing.soon(self._load)

    def _show_trial(self, trial: TrialOut) -> None:
        """The gripper where it was, closing as far as it did."""
        there = trial.achieved_pose or trial
        pose = Poses(np.array([there.position]), np.array([there.quaternion_xyzw]))
        red, green, blue = (int(value) for value in colours.of_names([trial.outcome])[0])
        self._closing.show(pose, end_m=trial.width_m, colour=(red, green, blue))

    def _replay(self, trial: TrialOut) -> None:
        """Have a simulated trial's motion simulated again, and show it."""
        self._replaying.soon(partial(self._move, trial))

    def _move(self, trial: TrialOut) -> None:
        if trial.sweep is None:
            return
        self._trials.say("Simulating it again ...")
        try:
            moved = simulated(trial, self._db.sweeps.get(trial.sweep).info, self._db.url, self._api_key)
        except ValueError as error:
            self._trials.say(f"**No replay.** {words.plain(error)}")
            return

        def shown() -> bool:
            return self._trials.told_of is trial and not self._closed.is_set()

        if not shown():
            return
        slower = 1.0
        if len(moved.times_s):
            self._show_trial(trial)
            moved, slower = moved.slowed(_REPLAY_S)
        self._trials.say(words.replayed(moved, trial, slower))
        if len(moved.times_s):
            self._closing.replay(moved, shown)

    # The object

    def _load(self) -> None:
        """Read the object of the view, or the first there is, and draw it."""
        self._say(None)
        items = list(self._db.objects)
        names = [item.id for item in items]
        view = self.page.view
        if not names:
            self._objects.options = (_NONE,)
            self._say(
                "**There is nothing to show yet.** Add an object, such as `graspdb add-example mug`, or run"
                " `graspdb demo --view`; then press *Again*."
            )
            return
        if view.object is None:
            view.object = names[0]
        if view.object not in names:
            self._objects.options = (view.object, *names)
            self._say(f"**There is no object** `{words.plain(view.object)}` here: choose another.")
            return
        if self._objects.options != tuple(names):
            self._objects.options = tuple(names)
        put(self._objects, view.object)
        self._listing.soon(partial(self._list.draw, items))
        self._show(self._db.objects.get(view.object))

    def _show(self, item: GraspObject) -> None:
        before = self.page.subject
        try:
            subject = self._subject(item)
        except AmbiguousSelection:
            self._offer(item)
            raise
        self._offer(item)
        self.page.subject = subject
        self._about.content = words.table(item.summary())
        self.robot.settle(subject)
        if before is None or before.item.id != item.id or OBJECT[1:] not in self.page.nodes:
            self._place(subject)
        self.question.gizmos.draw()
        self._draw()
        # Last, for its robot may be gone.
        self.robot.draw(subject)
        self._asking.soon(self.question.ask)
        self.reach.soon()

    def _subject(self, item: GraspObject) -> Subject:
        view, info = self.page.view, item.info
        selection: TrialSelection = {}
        if view.gripper is not None:
            selection["gripper"] = view.gripper
        if view.protocol is not None:
            selection["protocol"] = view.protocol
        mesh, centre, size = None, np.zeros(3), _SIZE_M
        if info.mesh is not None:
            before = self.page.subject
            if before is not None and before.mesh is not None and before.item.info.mesh == info.mesh:
                mesh = before.mesh
            else:
                mesh = shapes.of_triangles(item.mesh_triangles())
            lower, upper = np.array(info.mesh.bounding_box.lower), np.array(info.mesh.bounding_box.upper)
            centre, size = (lower + upper) / 2, float(np.linalg.norm(upper - lower))
        density = item.density(**selection) if info.trials or info.outcomes else None
        subject = Subject(item, mesh, size, centre, selection, density=density)
        subject.gripper = view.gripper or (None if density is None else density.gripper)
        if subject.gripper is None and not subject.successes:
            subject.gripper = next((g.id for g in self._db.grippers), None)
        if subject.gripper is not None:
            versions = [] if density is None else density.gripper_versions
            version = f"@{versions[-1]}" if versions and "@" not in subject.gripper else ""
            subject.profile = self._db.grippers.get(f"{subject.gripper}{version}").profile
        return subject

    def _offer(self, item: GraspObject) -> None:
        """The grippers and protocols to choose from, where there is a choice."""
        batches = item.batches.list().first(1_000)
        view = self.page.view
        tried = sorted({name for batch in batches for name in batch.grippers})
        known = tried or [g.id for g in self._db.grippers]
        protocols = sorted({name for batch in batches for name in batch.protocols})
        for control, names, chosen in (
            (self._gripper, known, view.gripper),
            (self._protocol, protocols, view.protocol),
        ):
            options = (_ANY, *names) if chosen is None or chosen in names else (_ANY, *names, chosen)
            if control.options != options:
                control.options = options
            put(control, chosen or _ANY)
            control.visible = len(names) > 1

    def _place(self, subject: Subject) -> None:
        """The object frame with its mesh, and the eye in front of it."""
        scene, page = self._client.scene, self.page
        scene.reset()
        page.nodes.clear()
        scene.add_light_ambient("/lights/all", intensity=1.1)
        scene.add_light_directional("/lights/key", intensity=1.5, position=(1.0, -1.2, 2.0))
        scene.add_light_directional("/lights/fill", intensity=0.6, position=(-1.5, 1.0, 0.5))
        frame = scene.add_frame(OBJECT, axes_length=0.25 * subject.size_m, axes_radius=0.004 * subject.size_m)
        if subject.mesh is not None:
            node = page.solid(f"{OBJECT}/mesh", subject.mesh, colours.OBJECT, side="double")
            page.replace("mesh", node)
        self._look(subject)
        page.replace(OBJECT[1:], frame)

    def _look(self, subject: Subject) -> None:
        """The floor, and the eye where the view has it, or else so that the object, or the robot beside it,
        is seen whole.
        """
        view, size = self.page.view, 6 * subject.size_m
        cell = 0.01 if subject.size_m < 0.5 else 0.1
        low = float(subject.centre[2] - subject.size_m / 2)
        if subject.mesh is not None:
            low = float(subject.mesh.vertices[:, 2].min())
        target, away = subject.centre, subject.size_m * np.array([1.5, -1.7, 1.1])
        if view.robot is not None and view.robot_base is not None:
            there = np.zeros(3) if view.object_pose is None else np.array(view.object_pose.position)
            base = np.array(view.robot_base.position)
            size, cell, low = _ROOM_M, 0.1, float(base[2]) - _UNDER_M
            target = (there + subject.centre + base) / 2 + np.array([0.0, 0.0, 0.25])
            away = np.array([0.75, -1.05, 0.5]) * max(1.0, float(np.linalg.norm(there - base)) / 0.6)
        self._client.scene.add_grid(
            "/floor",
            width=size,
            height=size,
            cell_size=cell,
            section_size=10 * cell,
            position=(0.0, 0.0, low),
            cell_color=(228, 230, 233),
            section_color=(200, 204, 209),
        )
        eye, middle = view.camera or (triple(target + away), triple(target))
        self._client.camera.position, self._client.camera.look_at = np.array(eye), np.array(middle)

    def _draw(self) -> None:
        """Grasps and trials as the view has them."""
        self._grasps.draw()
        self._trials.draw()

    # What comes by itself

    def _follow(self) -> None:
        """See what has changed on the service, until the tab is gone."""
        down = False
        while not self._closed.wait(_POLL_S):
            subject = self.page.subject
            try:
                if subject is None:
                    continue
                self._sweeps.draw()
                revision = self._db.objects.get(subject.item.id).info.revision
                if down or revision != subject.item.info.revision:
                    self._drawing.soon(self._load)
                down = False
            except GraspDBError as error:
                down = True
                self.page.failed(error)
