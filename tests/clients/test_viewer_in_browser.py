"""The viewer in a real headless Chromium: it renders, is dragged, asks, tells, and stays here."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from graspdb import Client
from graspdb_viewer.serving import ViewerServer, link_to, serving
from graspdb_viewer.session import Session
from graspdb_viewer.view import View

pytestmark = pytest.mark.browser

#: Where screenshots are kept to be looked at.
SCREENSHOTS = Path(__file__).parents[2] / "screenshots"
WIDTH, HEIGHT = 900, 640
#: WebGL in software, and no look at what a browser would call home for.
FLAGS = (
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-sandbox"),
)
PATIENCE_MS = 120_000


def _chromium() -> str:
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if (path := shutil.which(name)) is not None:
            return path
    raise AssertionError("these tests need the system package chromium; make test-core leaves them out")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """One Chromium for all tests here."""
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=_chromium(), args=list(FLAGS), timeout=PATIENCE_MS
        )
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def viewer(service_url: str) -> Iterator[ViewerServer]:
    """A viewer of the shared service, few grasps at a time: pixels are drawn in software."""
    with (
        Client(service_url, retries=1) as db,
        serving(db, port=0, view=View(count=100, trials_count=100)) as server,
    ):
        yield server


class Tab:
    """A page of the viewer, and what its browser did."""

    def __init__(self, browser: Browser, viewer: ViewerServer, address: str) -> None:
        self.page: Page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, device_scale_factor=1)
        self.page.set_default_timeout(PATIENCE_MS)
        self.complaints: list[str] = []
        self.hosts: set[str] = set()
        self.page.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on(
            "request", lambda request: self.hosts.add(urlsplit(request.url.removeprefix("blob:")).netloc)
        )
        self.page.on("websocket", lambda socket: self.hosts.add(urlsplit(socket.url).netloc))
        known = set(viewer.sessions)
        self.page.goto(address)
        self.until(lambda: set(viewer.sessions) - known)
        self.session: Session = viewer.sessions[max(set(viewer.sessions) - known)]

    def until(self, condition: Callable[[], Any]) -> Any:
        """What a condition comes to, which the browser goes on meanwhile."""
        for _ in range(PATIENCE_MS // 100):
            if found := condition():
                return found
            self.page.wait_for_timeout(100)
        raise AssertionError("it never happened")

    def says(self, text: str) -> None:
        """Wait until the page shows this."""
        self.page.get_by_text(text).first.wait_for(state="attached")

    def press(self, x: float, y: float) -> None:
        """A real click at a place; Playwright's own would wait for a still picture."""
        self.page.mouse.click(x, y)

    def tab(self, name: str) -> None:
        """Turn to a tab."""
        box = self.page.get_by_role("tab", name=name, exact=True).bounding_box()
        assert box is not None
        self.press(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def tick(self, label: str) -> None:
        """Tick the box of this label."""
        text = self.page.get_by_text(label, exact=True).last
        text.wait_for(state="attached")
        box = text.locator("xpath=ancestor::div[.//input][1]//input").first.bounding_box()
        assert box is not None
        self.press(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def on_screen(self, point: Any) -> tuple[float, float]:
        """Where a point of the world is drawn, pixels."""
        camera = self.session.page.client.camera
        w, x, y, z = camera.wxyz
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        seen = turn.T @ (np.asarray(point) - camera.position)
        scale = camera.image_height / 2 / np.tan(camera.fov / 2)
        return (
            float(camera.image_width / 2 + scale * seen[0] / seen[2]),
            float(camera.image_height / 2 + scale * seen[1] / seen[2]),
        )

    def drag(self, start: tuple[float, float], by: tuple[float, float]) -> None:
        """A real drag of the mouse."""
        mouse = self.page.mouse
        mouse.move(*start)
        self.page.wait_for_timeout(300)
        mouse.down()
        for step in range(1, 6):
            mouse.move(start[0] + by[0] * step / 5, start[1] + by[1] * step / 5)
            self.page.wait_for_timeout(60)
        mouse.up()

    def shot(self, name: str) -> np.ndarray:
        """What is seen, kept for people to look at."""
        SCREENSHOTS.mkdir(exist_ok=True)
        self.page.wait_for_timeout(300)
        picture = self.page.screenshot(timeout=PATIENCE_MS)
        (SCREENSHOTS / f"{name}.png").write_bytes(picture)
        return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))


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
                rows, outcome, gripper="pg70", source="robot", width_m=0.04, metadata={"operator": "Ada"}
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

    opened.until(lambda: "trials" in opened.session.page.nodes)
    opened.tab("Trials")
    opened.says("success 80")
    trial = opened.session._trials._trials[0]
    opened.page.wait_for_timeout(500)
    opened.press(*opened.on_screen(trial.position))
    opened.says("Ada")
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


def test_a_service_that_is_down_is_told(browser: Browser) -> None:
    with Client("http://127.0.0.1:9", retries=0) as nobody, serving(nobody, port=0) as server:
        opened = Tab(browser, server, server.url)
        opened.says("The service does not answer")
        opened.page.close()
