"""From a drag in the viewer to the new grasp on the page, in a real Chromium that draws in software.

The workspace box of an object with 20,000 kernels is dragged along z in small steps; a step's time is from
the mouse's move until the page shows another best grasp. Beside it: what the service alone takes to answer.
The same of a Panda's base, dragged away from a box on a table, until the page shows other joints.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import service_queries
import trimesh
from playwright.sync_api import Browser

from graspdb import Client
from graspdb.resources.trials import DoubtfulTrials

sys.path.append(str(Path(__file__).parents[1] / "support"))
import known_robots
from graspdb_viewer.panels.spoken import constraints
from graspdb_viewer.serving import ViewerServer, link_to, serving
from graspdb_viewer.view import Box, Placed, View
from viewer_tab import Tab, chromium

KERNELS = 20_000
STEPS = 30
GOAL_MS = 300.0
_SHOWN = "() => [...document.querySelectorAll('table')].map(table => table.innerText).join()"


def main(kernels: int = KERNELS, steps: int = STEPS) -> None:
    """Print medians and the slowest of both."""
    warnings.simplefilter("ignore", DoubtfulTrials)  # many of the shell's grasps collide: that is meant
    with (
        tempfile.TemporaryDirectory() as folder,
        service_queries.server(Path(folder)) as url,
        Client(url) as db,
    ):
        item = db.objects.create("ellipsoid", mesh=service_queries.sphere_stl(), media_type="model/stl")
        position, quaternion = service_queries.shell(kernels, np.random.default_rng(1))
        item.trials.add(np.column_stack([position, quaternion]), True, gripper="pg70")
        view = View(
            object="ellipsoid", grasps="none", box=Box(centre=(0.0, 0.0, 0.04), size=(0.2, 0.2, 0.03))
        )
        with serving(db, port=0) as server, chromium() as browser:
            tab = Tab(browser, server, link_to(server.url, view))
            tab.until(lambda: tab.session.question.answered)
            tab.page.wait_for_timeout(2_000)
            shown = tab.session.page.subject
            assert shown is not None
            times = dragged(tab, np.array([0.0, 0.0, 0.04 + 0.33 * shown.size_m]), steps)
            asked = []
            for step in range(steps):
                there = Box(centre=(0.0, 0.0, 0.04 - 5e-4 * step), size=(0.2, 0.2, 0.03))
                given = constraints(View(box=there), {})
                began = time.perf_counter()
                item.best_grasps(count=3, **given)
                asked.append(1e3 * (time.perf_counter() - began))
            base_times, base_asked = of_a_base(db, server, browser, steps)
    print(f"{kernels:,} kernels          median     slowest [ms]")
    for name, measured in (
        ("drag to new grasp", times),
        ("the question alone", asked),
        ("drag to new joints", base_times),
        ("the question alone", base_asked),
    ):
        print(f"{name:<22}{statistics.median(measured):8.0f}{max(measured):12.0f}")
    print(f"goal: {GOAL_MS:.0f} ms from drag to new grasp")


def of_a_base(
    db: Client, server: ViewerServer, browser: Browser, steps: int
) -> tuple[list[float], list[float]]:
    """Milliseconds of each step of a drag of a Panda's base, and of its questions alone."""
    item = db.objects.create(
        "box", mesh=bytes(trimesh.creation.box((0.06, 0.04, 0.1)).export(file_type="stl"))
    )
    poses = np.tile([0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0], (200, 1))
    poses[:, :3] += np.random.default_rng(1).normal(scale=0.004, size=(200, 3))
    item.trials.add(poses, True, gripper="panda")
    db.robots.put("panda", known_robots.PANDA, flange="panda_link8")
    db.scenes.put("table", boxes=[{"position": [0.5, 0.0, -0.05], "size_m": [1.0, 1.4, 0.1]}])
    shown = {"object": "box", "grasps": "none", "best": 1, "robot": "panda", "scene": "table"}
    view = View.model_validate({**shown, "object_pose": {"position": [0.5, 0.0, 0.05]}})
    tab = Tab(browser, server, link_to(server.url, view))
    tab.tab("Robot")
    tab.until(lambda: tab.session.robot.way)
    tab.page.wait_for_timeout(2_000)
    times = dragged(tab, np.array([0.14, 0.0, 0.0]), steps, by=(-2.0, -0.6))
    end, asked = tab.session.page.view.robot_base, []
    assert end is not None
    for share in np.linspace(0.0, 1.0, steps):
        base = Placed(position=(float(share) * end.position[0], 0.0, 0.0))
        given = constraints(view.model_copy(update={"robot_base": base}), {})
        began = time.perf_counter()
        item.best_grasps(count=1, **given)
        asked.append(1e3 * (time.perf_counter() - began))
    return times, asked


def dragged(tab: Tab, handle: np.ndarray, steps: int, by: tuple[float, float] = (0.0, 2.0)) -> list[float]:
    """Milliseconds of each step, pixels, of a drag of this point of the world, until the page shows another
    answer.
    """
    x, y = tab.on_screen(handle)
    mouse, times = tab.page.mouse, []
    mouse.move(x, y)
    tab.page.wait_for_timeout(500)
    mouse.down()
    for step in range(1, steps + 1):
        before = tab.page.evaluate(_SHOWN)
        began = time.perf_counter()
        mouse.move(x + by[0] * step, y + by[1] * step)
        tab.page.wait_for_function(f"before => ({_SHOWN})() !== before", arg=before, timeout=30_000)
        times.append(1e3 * (time.perf_counter() - began))
        tab.page.wait_for_timeout(150)
    mouse.up()
    return times


if __name__ == "__main__":
    main()
