"""The viewer in a real headless Chromium: it renders, is dragged, asks, tells, and stays here."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest
from playwright.sync_api import Browser

import known_robots
from graspdb import Client
from graspdb_viewer.motion import simulated
from graspdb_viewer.scene import colours
from graspdb_viewer.serving import ViewerServer, link_to, serving
from graspdb_viewer.view import Placed, View
from viewer_tab import WIDTH, Tab, chromium

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One Chromium for all tests here."""
    with chromium() as opened:
        yield opened


@pytest.fixture(scope="module")
def viewer(service_url: str) -> Iterator[ViewerServer]:
    """A viewer of the shared service, few grasps at a time: pixels are drawn in software."""
    with (
        Client(service_url, retries=1) as db,
        serving(db, port=0, view=View(count=100, trials_count=100)) as server,
    ):
        yield server


@pytest.fixture
def tab(browser: Browser, viewer: ViewerServer) -> Iterator[Callable[[str], Tab]]:
    """Open an address in a tab; afterwards nothing was complained of, and nothing left the machine."""
    tabs: list[Tab] = []

    def make(address: str) -> Tab:
        tabs.append(Tab(browser, viewer, address))
        return tabs[-1]

    yield make
    for opened in tabs:
        opened.page.close()
        assert not opened.complaints
        assert opened.hosts <= {urlsplit(viewer.url).netloc}


def _box(size: tuple[float, float, float]) -> bytes:
    import trimesh

    return bytes(trimesh.creation.box(size).export(file_type="stl"))


@pytest.fixture(scope="module")
def box_id(service_url: str) -> str:
    """A box that was grasped from above and from +x, with failures beside."""
    rng = np.random.default_rng(0)
    half = np.sqrt(0.5)
    name = f"viewed-{os.getpid()}"
    with Client(service_url, retries=1) as db:
        item = db.objects.create(name, mesh=_box((0.06, 0.04, 0.1)), media_type="model/stl", mass_kg=0.2)
        for place, turn, outcome in (
            ((0.0, 0.0, 0.05), (1.0, 0.0, 0.0, 0.0), "success"),
            ((0.03, 0.0, 0.0), (0.0, -half, 0.0, half), "success"),
            ((0.0, 0.0, 0.07), (1.0, 0.0, 0.0, 0.0), "slipped"),
        ):
            position = np.array(place) + rng.normal(scale=0.004, size=(40, 3))
            rows = np.column_stack([position, np.tile(turn, (40, 1))])
            item.trials.add(
                rows,
                outcome,
                gripper="pg70",
                source="robot",
                width_m=0.04,
                metadata={"operator": "Ada Lovelace"},
            )
    return name


def _best_z(tab: Tab) -> float | None:
    found = tab.session.question.answered
    return None if found is None or not len(found) else float(found[0].position[2])


def test_a_page_renders_is_dragged_and_asks(
    tab: Callable[[str], Tab], viewer: ViewerServer, box_id: str
) -> None:
    opened = tab(link_to(viewer.url, View(object=box_id, count=100)))
    question = opened.session.question
    opened.until(lambda: question.answered)
    opened.until(lambda: "grasps" in opened.session.page.nodes)
    opened.says("Best grasp.")
    picture = opened.shot("best-grasp")
    scene = picture[:, : WIDTH // 2].reshape(-1, 3)
    assert len(np.unique(scene, axis=0)) > 200, "nothing is drawn"

    opened.tick("Workspace box")
    opened.until(lambda: opened.session.page.view.box)
    box = opened.session.page.view.box
    assert box is not None
    asked = question.questions
    size = opened.session.page.subject.size_m  # type: ignore[union-attr]
    upward = np.array(box.centre) + np.array([0.0, 0.0, 0.33 * size])
    opened.page.wait_for_timeout(500)
    start = opened.on_screen(upward)
    opened.drag(start, (0.0, -60.0))
    opened.until(lambda: opened.session.page.view.box.centre[2] > box.centre[2] + 0.01)  # type: ignore[union-attr]
    opened.until(lambda: question.questions > asked)
    lower = opened.session.page.view.box.centre[2] - box.size[2] / 2  # type: ignore[union-attr]
    opened.until(lambda: (z := _best_z(opened)) is None or z >= lower - 1e-6)
    opened.shot("workspace")


def test_a_link_opens_the_same_view_and_a_conflict_is_told(
    tab: Callable[[str], Tab], viewer: ViewerServer, box_id: str
) -> None:
    view = View.model_validate(
        {
            "object": box_id,
            "count": 100,
            "trials": True,
            "trials_count": 100,
            "box": {"centre": [0.0, 0.0, 0.05], "size": [0.05, 0.05, 0.03]},
            "cone": {"quaternion_xyzw": [0.0, 0.0, 0.0, 1.0], "half_angle_deg": 20},
        }
    )
    opened = tab(link_to(viewer.url, view))
    shown = opened.session.page.view
    assert shown.model_copy(update={"camera": None}) == view
    opened.says("No grasp fulfils this")
    opened.says("exclude")
    link = opened.until(lambda: opened.session._address.value)
    assert View.of(link.rpartition("?")[2]).model_copy(update={"camera": None}) == view


def test_a_click_on_a_trial_tells_its_story(
    tab: Callable[[str], Tab], viewer: ViewerServer, box_id: str, service_url: str
) -> None:
    with Client(service_url, retries=1) as db:
        listed = db.objects.get(box_id).trials.list().first(100)
    # The outermost of those that were grasped from +x, seen from near.
    trial = max(listed, key=lambda trial: trial.position[0])
    eye = np.array(trial.position) + np.array([0.03, -0.004, 0.004])
    view = View(
        object=box_id,
        grasps="none",
        best=0,
        trials=True,
        trials_count=100,
        camera=((float(eye[0]), float(eye[1]), float(eye[2])), trial.position),
    )
    opened = tab(link_to(viewer.url, view))
    opened.until(lambda: "trials" in opened.session.page.nodes)
    opened.tab("Trials")
    opened.says("success 80")
    opened.page.wait_for_timeout(1_000)
    opened.press(*opened.on_screen(trial.position))
    opened.says("Ada Lovelace")
    opened.shot("trial")


def test_words_where_there_is_nothing_to_show(
    tab: Callable[[str], Tab], viewer: ViewerServer, service_url: str
) -> None:
    name = f"untried-{os.getpid()}"
    with Client(service_url, retries=1) as db:
        db.objects.create(name, mesh=_box((0.05, 0.04, 0.12)), media_type="model/stl", mass_kg=0.2)
        opened = tab(link_to(viewer.url, View(object="no-such")))
        opened.says("There is no object")
        opened.page.close()
        prior = View(object=name, count=100)
        opened = tab(link_to(viewer.url, prior))
        opened.says("By geometry alone")
        opened.shot("prior")


def test_the_question_is_taken_elsewhere_and_another_object_is_chosen_by_its_picture(
    tab: Callable[[str], Tab], viewer: ViewerServer, box_id: str, service_url: str
) -> None:
    other = f"beside-{os.getpid()}"
    with Client(service_url, retries=1) as db:
        db.objects.create(other, mesh=_box((0.05, 0.03, 0.08)), media_type="model/stl", mass_kg=0.2)
    opened = tab(link_to(viewer.url, View(object=box_id, grasps="none")))
    question = opened.session.question
    opened.until(lambda: question.answered)
    opened.push("Copy the question")
    for name, text in zip(("curl", "Python", "Command line"), question.spoken, strict=True):  # type: ignore[arg-type]
        opened.push(f"Copy {name}")
        opened.page.get_by_role("button", name="Copied").first.wait_for()
        assert opened.page.evaluate("navigator.clipboard.readText()") == text
    with opened.page.expect_download() as coming:
        opened.push("Download best-grasp.sh")
    assert Path(coming.value.path()).read_text() == question.spoken.curl  # type: ignore[union-attr]
    opened.shot("elsewhere")
    opened.push("Close")
    opened.page.get_by_text("Copied").first.wait_for(state="detached")
    opened.tab("Object")
    opened.says(f"Show {other}")
    opened.until(lambda: opened.page.locator("img").count() >= 2)
    opened.shot("objects")
    opened.push(f"Show {other}")
    opened.until(lambda: opened.session.page.subject.item.id == other)  # type: ignore[union-attr]
    opened.tab("Best grasp")
    opened.says("By geometry alone")


@pytest.mark.usefixtures("worker")
def test_a_simulated_trial_is_replayed_as_it_went(
    tab: Callable[[str], Tab], viewer: ViewerServer, service_url: str
) -> None:
    name = f"replayed-{os.getpid()}"
    with Client(service_url, retries=1) as db:
        item = db.objects.create(name, mesh=_box((0.03, 0.03, 0.1)), media_type="model/stl", mass_kg=0.2)
        # Off the middle, so that the object is moved as the jaw closes.
        item.sweep(poses=[[0.0, 0.006, 0.045, 1, 0, 0, 0]], gripper="pg70").wait(timeout=120)
        (trial,) = item.refresh().trials.list().first(2)
        sweep = db.sweeps.get(str(trial.sweep)).info
    camera = ((0.25, -0.05, 0.12), (0.0, 0.0, 0.05))
    view = View(object=name, grasps="none", best=0, trials=True, camera=camera)
    opened = tab(link_to(viewer.url, view))
    opened.until(lambda: "trials" in opened.session.page.nodes)
    opened.tab("Trials")
    opened.page.wait_for_timeout(1_000)
    opened.session._trials._clicked(SimpleNamespace(instance_index=0))
    mesh = opened.session.page.nodes["mesh"]
    opened.push("Replay its motion")
    opened.says("Its worker's own states")
    opened.until(lambda: abs(mesh.position[1] - 0.006) < 1e-3)  # the jaw has centred it
    opened.shot("replay")
    opened.until(lambda: mesh.position[1] == 0.0)
    # Told as something else, it is not taken for the trial.
    moved = simulated(trial, sweep, service_url, None)
    assert moved.is_of(trial)
    assert not moved.is_of(trial.model_copy(update={"width_m": 0.02}))


@pytest.fixture(scope="module")
def cell_id(service_url: str) -> str:
    """The Panda, a box that was grasped from above, and a wall between them: one id for all three."""
    pytest.importorskip("pinocchio")
    name = f"cell-{os.getpid()}"
    rows = np.tile([0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0], (40, 1))
    rows[:, :3] += np.random.default_rng(1).normal(scale=0.004, size=(40, 3))
    with Client(service_url, retries=1) as db:
        item = db.objects.create(name, mesh=_box((0.06, 0.04, 0.1)), media_type="model/stl", mass_kg=0.2)
        item.trials.add(rows, "success", gripper="panda", source="robot")
        db.robots.put(name, known_robots.PANDA, flange="panda_link8")
        wall = {"position": [0.35, 0.0, 0.35], "size_m": [0.02, 0.8, 0.7]}
        db.scenes.put(name, boxes=[wall], objects={name: [0.9, 0.6, 0.0, 0, 0, 0, 1]})
    return name


def _links_off_m(opened: Tab, joints: np.ndarray) -> float:
    """How far the farthest drawn link is from where pinocchio has it at these joints."""
    import pinocchio as pin

    model = pin.buildModelFromUrdf(str(known_robots.PANDA))
    data, q = model.createData(), pin.neutral(model)
    q[:7] = joints
    pin.framesForwardKinematics(model, data, q)
    robot = opened.session.robot._robot
    assert robot is not None
    return max(
        float(np.linalg.norm(opened.session.page.nodes[f"arm {i}"].position - there.translation))
        for i, solid in enumerate(robot.shape.solids)
        for there in [data.oMf[model.getFrameId(solid.link)]]
    )


def test_an_arm_is_shown_where_its_joints_put_it_and_answers_while_its_base_is_dragged(
    tab: Callable[[str], Tab], viewer: ViewerServer, cell_id: str
) -> None:
    base = Placed(position=(0.0, 0.0, -0.05))
    stand = Placed(position=(0.5, 0.0, 0.0))
    view = View(
        object=cell_id, grasps="none", robot=cell_id, robot_base=base, object_pose=stand, reach="grasps"
    )
    opened = tab(link_to(viewer.url, view))
    robot, question = opened.session.robot, opened.session.question
    opened.until(lambda: robot.way)
    opened.tab("Robot")
    opened.says("The arm takes the best grasp")
    opened.says("the arm takes it")
    kind, found = opened.session.reach.shown  # type: ignore[misc]
    assert kind == "grasps"
    assert found.reached.count(True) > 100
    opened.page.wait_for_timeout(1_000)
    assert _links_off_m(opened, np.array(question.answered[0].joints.grasp)) < 1e-4  # type: ignore[index]
    opened.shot("robot")

    asked = question.questions
    opened.drag(opened.on_screen((0.14, 0.0, -0.05)), (-60.0, 5.0))
    opened.until(lambda: opened.session.page.view.robot_base.position[0] < -0.02)  # type: ignore[union-attr]
    opened.page.wait_for_timeout(300)
    opened.until(lambda: question.questions > asked)
    there = opened.session.page.view.robot_base
    assert there is not None
    assert there.position[2] == pytest.approx(-0.05)
    opened.until(lambda: robot.way and np.allclose(robot.way.base[:3, 3], there.position, atol=1e-4))
    assert _links_off_m(opened, np.array(question.answered[0].joints.grasp)) < 1e-4  # type: ignore[index]

    opened.push("Play the motion")
    opened.until(lambda: robot._slider.value == 2.0)
    lift = np.array(question.answered[0].joints.lift)  # type: ignore[index]
    opened.until(lambda: _links_off_m(opened, lift) < 1e-4)
    # What it holds is lifted straight up, by its frame and so far as was asked.
    lifted = opened.session.page.nodes["mesh"].position
    assert lifted == pytest.approx([0.0, 0.0, view.lift_m], abs=2e-3)
    opened.until(lambda: robot._slider.value == 1.0)


def test_links_in_the_way_are_red_and_where_the_base_could_stand_is_a_button(
    tab: Callable[[str], Tab], viewer: ViewerServer, cell_id: str
) -> None:
    view = View(
        object=cell_id,
        grasps="none",
        robot=cell_id,
        scene=cell_id,
        robot_base=Placed(position=(0.0, 0.0, -0.05)),
        object_pose=Placed(position=(0.5, 0.0, 0.0)),
        reach="bases",
    )
    opened = tab(link_to(viewer.url, view))
    robot, nodes = opened.session.robot, opened.session.page.nodes
    opened.tab("Robot")
    opened.says("It would collide.")
    opened.says("meets box 1 of the scene")
    opened.until(lambda: opened.session.reach.shown)
    shares = opened.session.reach.shown[1].base_share  # type: ignore[index]
    assert (min(shares), max(shares) > 0.5) == (0.0, True)
    opened.page.wait_for_timeout(500)
    shown = robot._robot
    assert shown is not None
    red = {
        solid.link
        for i, solid in enumerate(shown.shape.solids)
        if tuple(nodes[f"arm {i}"].color) == colours.WRONG
    }
    assert red
    assert all(f"{link} meets" in robot._told.content.replace("&#95;", "_") for link in red)
    assert tuple(nodes["standing scene.boxes.0"].color) == colours.WRONG
    assert tuple(nodes["standing scene.objects.0"].color) == colours.STANDING
    opened.shot("links-in-the-way")
    opened.push("Stand where it takes one")
    opened.says("The arm takes the best grasp")
    assert tuple(nodes["standing scene.boxes.0"].color) == colours.STANDING


def test_a_service_that_is_down_is_told(browser: Browser) -> None:
    with Client("http://127.0.0.1:9", retries=0) as nobody, serving(nobody, port=0) as server:
        opened = Tab(browser, server, server.url)
        opened.says("The service does not answer")
        opened.page.close()
