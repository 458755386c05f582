"""kill -9 with real processes: a sweep completes all the same, and what was acknowledged is there.

Service and worker run as a user starts them. The worker is killed while it holds a lease, the service while
a batch of trials is on its way; both are started again. The grid is made here once more, from its
definition, by code that shares nothing with the service's.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from graspdb.processes import ChildProcess

STEP_M, ROTATION_STEP_DEG, MARGIN_M = 0.01, 60.0, 0.02
BOX_M = (0.04, 0.04, 0.10)
BATCH = 2_000
PATIENCE_S = 180.0


# --- the grid from its definition -----------------------------------------------------------------------


def turn(axis: int, angle: float) -> NDArray[np.float64]:
    """The rotation matrix about a coordinate axis."""
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[a, a] = matrix[b, b] = np.cos(angle)
    matrix[b, a] = np.sin(angle)
    matrix[a, b] = -np.sin(angle)
    return matrix


def pixel_directions(nside: int) -> list[tuple[float, float]]:
    """Colatitude and longitude of the 12 nside^2 HEALPix pixels, ring by ring from the north."""
    rings = []
    for ring in range(1, 4 * nside):
        south = ring > 2 * nside
        i = 4 * nside - ring if south else ring
        if i < nside:  # the cap's ring i has 4 i pixels
            z = 1 - i**2 / (3 * nside**2)
            longitudes = [np.pi / (2 * i) * (j - 0.5) for j in range(1, 4 * i + 1)]
        else:  # the belt's rings have 4 nside, every second one shifted by half a pixel
            z = 4 / 3 - 2 * i / (3 * nside)
            shift = 0.5 if (i - nside) % 2 == 0 else 0.0
            longitudes = [np.pi / (2 * nside) * (j + shift) for j in range(4 * nside)]
        rings += [(np.arccos(-z if south else z), longitude) for longitude in longitudes]
    return rings


def full_grid() -> dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Position and rotation matrix of every pose that a symmetric gripper is swept over, by pose index."""
    nside = round(60 / ROTATION_STEP_DEG)
    turns = 6 * nside
    rotations = {}
    for pixel, (theta, phi) in enumerate(pixel_directions(nside)):
        tilt = turn(2, phi) @ turn(1, theta) @ turn(2, -phi)
        # Of each pair that the jaw's half turn exchanges the first is kept.
        for k in range(turns // 2):
            rotations[pixel * turns + k] = tilt @ turn(2, 2 * np.pi * k / turns)
    reach = [round((size / 2 + MARGIN_M) / STEP_M) for size in BOX_M]
    count = [2 * r + 1 for r in reach]
    grid = {}
    for ix in range(count[0]):
        for iy in range(count[1]):
            for iz in range(count[2]):
                position = (np.array([ix, iy, iz]) - reach) * STEP_M
                place = (ix * count[1] + iy) * count[2] + iz
                for rotation, matrix in rotations.items():
                    grid[place * 12 * nside**2 * turns + rotation] = (position, matrix)
    return grid


def matrices(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices of quaternions xyzw, by turning the three axes."""
    v, w = quaternions[:, None, :3], quaternions[:, None, 3:]
    axes = np.eye(3)[None]
    turned = axes + 2 * np.cross(v, np.cross(v, axes) + w * axes)
    return np.swapaxes(turned, 1, 2)


# --- processes ------------------------------------------------------------------------------------------


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Process:
    """A command of ours, as its own process group."""

    def __init__(self, log: Path, *command: str, **environment: str) -> None:
        self._log = log
        self._command = command
        self._environment = {**os.environ, **environment}
        self._process: ChildProcess | None = None

    def start(self) -> None:
        with self._log.open("ab") as log:
            self._process = ChildProcess(
                [str(Path(sys.executable).with_name(self._command[0])), *self._command[1:]],
                stdout=log,
                stderr=subprocess.STDOUT,
                env=self._environment,
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def kill(self) -> None:
        """kill -9, of this process alone: its children have to notice by themselves."""
        assert self._process is not None
        assert self._process.poll() is None, f"it ended by itself:\n{self._log.read_text()[-3000:]}"
        os.kill(self.pid, signal.SIGKILL)
        self._process.wait(30)

    def stop(self) -> int:
        """Ask it to end, and how it did."""
        assert self._process is not None
        self._process.terminate()
        return self._process.wait(60)

    def clean_up(self) -> None:
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
            self._process.wait(30)

    def group_is_empty(self) -> bool:
        try:
            os.killpg(self.pid, 0)
        except ProcessLookupError:
            return True
        return False


@contextmanager
def running(process: Process) -> Iterator[Process]:
    try:
        process.start()
        yield process
    finally:
        process.clean_up()


def wait_for(what: str, condition: Callable[[], Any], *, every: float = 0.02) -> Any:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        try:
            found = condition()
        except httpx.TransportError:
            found = None
        if found:
            return found
        time.sleep(every)
    raise AssertionError(f"{what}: not within {PATIENCE_S:g} s")


class Poster(threading.Thread):
    """Posts batches of trials one after the other, and keeps what was acknowledged."""

    def __init__(self, url: str) -> None:
        super().__init__(daemon=True)
        self._url = url
        self.keys: list[str] = []
        self.acknowledged: dict[int, dict[str, Any]] = {}
        self.uncertain: set[int] = set()
        self.sending = threading.Event()
        self.finish = threading.Event()
        self.error: str | None = None

    def body(self, number: int) -> dict[str, Any]:
        """A batch that says in every trial which one it is."""
        position = [[number * 1e-3, index * 1e-4, 0.5] for index in range(BATCH)]
        columns = {
            "position": position,
            "quaternion_xyzw": [[0, 0, 0, 1]] * BATCH,
            "outcome": [False] * BATCH,
        }
        return {"columns": columns, "gripper": "pg70", "source": "robot", "protocol": "wrench"}

    def post(self, client: httpx.Client, number: int) -> httpx.Response:
        headers = {"Idempotency-Key": self.keys[number], "Content-Type": "application/json"}
        content = json.dumps(self.body(number))
        self.sending.set()
        try:
            return client.post("/objects/box/trials", content=content, headers=headers)
        finally:
            self.sending.clear()

    def run(self) -> None:
        with httpx.Client(base_url=self._url, timeout=60) as client:
            while not self.finish.is_set():
                number = len(self.keys)
                self.keys.append(str(uuid.uuid4()))
                try:
                    answer = self.post(client, number)
                except httpx.TransportError:
                    self.uncertain.add(number)
                    wait_for("the service is back", lambda: client.get("/readyz").is_success)
                    continue
                if answer.status_code != 201:
                    self.error = answer.text
                    return
                self.acknowledged[number] = answer.json()
                self.finish.wait(0.1)


def box_stl() -> bytes:
    corner = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * BOX_M
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    content = b"".join(struct.pack("<12fH", 0, 0, 0, *corner[list(face)].ravel(), 0) for face in faces)
    return b"\0" * 80 + struct.pack("<I", len(faces)) + content


def outcomes(client: httpx.Client, sweep: str) -> dict[str, list[Any]]:
    joined: dict[str, list[Any]] = {}
    cursor = None
    while True:
        page = client.get(
            f"/sweeps/{sweep}/outcomes", params={"limit": 20_000, **({"cursor": cursor} if cursor else {})}
        ).json()
        for name in ("pose_index", "position", "quaternion_xyzw", "outcome"):
            joined.setdefault(name, []).extend(page[name])
        cursor = page["next"]
        if cursor is None:
            return joined


def stored_trials(client: httpx.Client) -> list[dict[str, Any]]:
    answer = client.get("/objects/box/trials", headers={"Accept": "application/x-ndjson"})
    assert answer.status_code == 200, answer.text
    return [json.loads(line) for line in answer.text.splitlines()]


# --- the test -------------------------------------------------------------------------------------------


def test_kill_9_of_worker_and_service_loses_and_repeats_nothing(database_url: str, tmp_path: Path) -> None:
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    service = Process(
        tmp_path / "service.log",
        *("graspdb-server", "serve", "--port", str(port), "--database-url", database_url),
        GRASPDB_LEASE_S="2",
        GRASPDB_RETRY_AFTER_S="0.2",
        # Each killed worker costs an attempt, and so may a service that is away for longer than a lease.
        GRASPDB_MAX_ATTEMPTS="20",
    )
    worker = Process(
        tmp_path / "worker.log", "graspdb-simworker", "run", "--url", url, "--name", "w", "--verbose"
    )
    rng = np.random.default_rng()
    with running(service), httpx.Client(base_url=url, timeout=60) as client:
        wait_for("the service starts", lambda: client.get("/readyz").is_success)
        assert client.post("/objects", json={"id": "box", "mass_kg": 0.16}).status_code == 201
        mesh = client.put("/objects/box/mesh", content=box_stl(), headers={"Content-Type": "model/stl"})
        assert mesh.is_success, mesh.text
        grid = {"position_step_m": STEP_M, "rotation_step_deg": ROTATION_STEP_DEG, "margin_m": MARGIN_M}
        made = client.post("/objects/box/sweeps", json={"grid": grid, "chunk_poses": 1_000})
        assert made.status_code == 202, made.text
        sweep = f"/sweeps/{made.json()['id']}"

        def info() -> dict[str, Any]:
            found: dict[str, Any] = client.get(sweep).json()
            return found

        def leased() -> int:
            return sum(item["jobs_leased"] for item in client.get("/workers").json()["items"])

        def kill_the_worker_at_work() -> None:
            for _ in range(20):
                before = info()["chunks_done"]
                wait_for("the worker gets on", lambda n=before: info()["chunks_done"] > n and leased())
                worker.kill()
                caught = leased() == 1
                wait_for("the worker's child ends too", worker.group_is_empty)
                worker.start()
                if caught:
                    return
            raise AssertionError("every kill came just between two chunks")

        def kill_the_service_at_work() -> None:
            before = len(poster.acknowledged)
            wait_for("the poster gets on", lambda: len(poster.acknowledged) > before + 1)
            assert info()["state"] == "running", "the sweep ended before the faults did: make it longer"
            assert poster.sending.wait(PATIENCE_S)
            time.sleep(float(rng.uniform(0.0, 0.05)))
            service.kill()
            time.sleep(0.2)
            service.start()
            wait_for("the service is back", lambda: client.get("/readyz").is_success)

        poster = Poster(url)
        with running(worker):
            poster.start()
            kill_the_worker_at_work()
            kill_the_service_at_work()
            kill_the_service_at_work()
            state = wait_for(
                "the sweep ends",
                lambda: (now := info())["state"] not in ("queued", "running") and now,
                every=0.2,
            )
            poster.finish.set()
            poster.join(60)
            assert worker.stop() == 0, (tmp_path / "worker.log").read_text()[-3000:]
        assert poster.error is None
        assert poster.uncertain, "no kill met a batch on its way"
        assert (state["state"], state["failed_chunks"]) == ("done", [])
        found = outcomes(client, state["id"])
        trials = stored_trials(client)
        check_sweep(found, [trial for trial in trials if trial["sweep"] is not None])
        posted = check_batches(poster, [trial for trial in trials if trial["sweep"] is None])
        total = Counter(found["outcome"]) + Counter({"failure": BATCH * len(posted)})
        assert client.get("/objects/box").json()["outcomes"] == dict(total)

        # Whoever is unsure sends again, with the same key: then each is there, once.
        for number in poster.uncertain:
            answer = poster.post(client, number)
            assert answer.status_code == 201, answer.text
        again = [trial for trial in stored_trials(client) if trial["sweep"] is None]
        assert check_batches(poster, again) == set(range(len(poster.keys)))


def check_sweep(found: dict[str, list[Any]], rows: list[dict[str, Any]]) -> None:
    """Every pose of the grid has one outcome and the right pose; those that met physics have one row."""
    grid = full_grid()
    index = found["pose_index"]
    assert len(index) == len(set(index))
    assert set(index) == set(grid)
    positions = np.array([grid[i][0] for i in index])
    rotations = np.array([grid[i][1] for i in index])
    np.testing.assert_allclose(found["position"], positions, atol=1e-12)
    np.testing.assert_allclose(matrices(np.array(found["quaternion_xyzw"])), rotations, atol=1e-12)
    outcome = dict(zip(index, found["outcome"], strict=True))
    assert {"success", "collision"} < set(outcome.values())
    stored = [row["pose_index"] for row in rows]
    assert len(stored) == len(set(stored))
    assert [outcome[i] for i in stored] == [row["outcome"] for row in rows]
    # What has no row is what geometry alone decided.
    assert {outcome[i] for i in outcome.keys() - set(stored)} <= {"collision", "missed"}
    np.testing.assert_allclose([row["position"] for row in rows], [grid[i][0] for i in stored], atol=1e-12)


def check_batches(poster: Poster, rows: list[dict[str, Any]]) -> set[int]:
    """Each posted batch is there whole and once, or not at all; which are there."""
    found: dict[int, list[int]] = {}
    names: dict[int, set[str]] = {}
    for row in rows:
        number, index = round(row["position"][0] * 1e3), round(row["position"][1] * 1e4)
        found.setdefault(number, []).append(index)
        names.setdefault(number, set()).add(row["batch"])
    for number, indices in found.items():
        assert sorted(indices) == list(range(BATCH)), f"batch {number}"
        assert len(names[number]) == 1
    for number, receipt in poster.acknowledged.items():
        assert names.get(number) == {receipt["batch"]}
    assert found.keys() <= poster.acknowledged.keys() | poster.uncertain
    return set(found)
