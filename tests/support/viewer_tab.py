"""A tab of the viewer in a real headless Chromium, for tests and benchmarks."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from graspdb_viewer.serving import ViewerServer
from graspdb_viewer.session import Session

#: Where screenshots are kept to be looked at.
SCREENSHOTS = Path(__file__).parents[2] / "screenshots"
WIDTH, HEIGHT = 900, 640
#: WebGL in software, and no look at what a browser would call home for.
FLAGS = (
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-sandbox"),
)
PATIENCE_MS = 90_000


def _chromium() -> str:
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if (path := shutil.which(name)) is not None:
            return path
    raise AssertionError("these tests need the system package chromium; make test-core leaves them out")


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser that draws in software."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=_chromium(), args=list(FLAGS), timeout=PATIENCE_MS
        )
        yield browser
        browser.close()


class Tab:
    """A page of the viewer, and what its browser did."""

    def __init__(self, browser: Browser, viewer: ViewerServer, address: str) -> None:
        self.page: Page = browser.new_page(
            viewport={"width": WIDTH, "height": HEIGHT},
            device_scale_factor=1,
            permissions=["clipboard-read", "clipboard-write"],
        )
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
        there = self.page.get_by_role("tab", name=name, exact=True)
        there.scroll_into_view_if_needed()
        box = there.bounding_box()
        assert box is not None
        self.press(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def push(self, name: str) -> None:
        """Push a button."""
        button = self.page.get_by_role("button", name=name, exact=True)
        button.wait_for(state="visible")
        button.scroll_into_view_if_needed()
        box = button.bounding_box()
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
        # What viser says of a browser that draws in software, which lies over the scene.
        self.page.add_style_tag(content=".mantine-Notifications-root { visibility: hidden }")
        self.page.wait_for_timeout(300)
        picture = self.page.screenshot(timeout=PATIENCE_MS)
        (SCREENSHOTS / f"{name}.png").write_bytes(picture)
        return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))
