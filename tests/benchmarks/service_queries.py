"""Queries over HTTP against a real server on SQLite: best grasp, likelihood, samples, extension, /livez.

Data: successes on the shell of an ellipsoid that the gripper can close on (semi-axes 60, 30 and 30 mm), moved
along the normal within 20 mm; approach the inward normal plus noise, roll uniform. The ellipsoid is a mesh of
512 triangles that the gripper must not touch. Three in four of these successes collide with it: most
searches have to look for the edge of the free space.

Best grasps are timed over HTTP and in process, by the clock and by the processor's time; in process also
under wider kernels, most of which reach each other, without a collision test. All kinds of request take
turns, some of each in every round, so that what else the machine does meets them alike.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import json
import os
import socket
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from graspdb.processes import ChildProcess
from graspdb.wire import BestGraspRequest
from graspdb_service.api.context import Context
from graspdb_service.app import create_app
from graspdb_service.settings import Settings
from graspdb_service.usecases.grasps.answer import best_grasps

sys.path.append(str(Path(__file__).parents[1] / "density"))
import ellipsoid_shell

Floats = NDArray[np.float64]
AXES = np.array([0.06, 0.03, 0.03])
KERNELS = (20_000, 160_000)
ROUNDS = 5
DENSE = {"sigma_position_m": 0.015, "sigma_rotation_deg": 15.0, "collision_free": False}


def shell(count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Grasps on the shell of a graspable ellipsoid (60 x 30 x 30 mm semi-axes), tool z inwards."""
    return ellipsoid_shell.shell(count, rng, semi_axes_m=AXES, depth_m=0.02)


def sphere_stl(subdivisions: int = 3) -> bytes:
    """The ellipsoid as a subdivided octahedron, binary STL."""
    e = np.eye(3)
    faces = [
        (sx * e[0], sy * e[1], sz * e[2]) if sx * sy * sz > 0 else (sy * e[1], sx * e[0], sz * e[2])
        for sx in (1, -1)
        for sy in (1, -1)
        for sz in (1, -1)
    ]
    for _ in range(subdivisions):
        halved = []
        for a, b, c in faces:
            ab, bc, ca = (m / np.linalg.norm(m) for m in (a + b, b + c, c + a))
            halved += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = halved
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *(np.array(f) * AXES).ravel(), 0) for f in faces)
    return b"\0" * 80 + struct.pack("<I", len(faces)) + rows


def database_in(folder: Path) -> str:
    """The database of a server in this folder."""
    return f"sqlite:///{folder / 'bench.sqlite'}"


@contextmanager
def server(folder: Path) -> Iterator[str]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [
        sys.executable,
        "-c",
        "from graspdb_service.cli import main; main()",
        "serve",
        "--port",
        str(port),
    ]
    environment = os.environ | {"GRASPDB_DATABASE_URL": database_in(folder)}
    with (folder / "log").open("w") as log:
        process = ChildProcess([*command, "--log-level", "warning"], env=environment, stdout=log, stderr=log)
    url = f"http://127.0.0.1:{port}"
    try:
        for _ in range(600):
            try:
                if httpx.get(f"{url}/readyz").status_code == 200:
                    break
            except httpx.TransportError:
                time.sleep(0.1)
        yield url
    finally:
        process.terminate()
        process.wait(15)


def post(http: httpx.Client, slug: str, poses: tuple[Floats, Floats]) -> None:
    for start in range(0, len(poses[0]), 20_000):
        part = slice(start, start + 20_000)
        columns = {
            "position": poses[0][part].tolist(),
            "quaternion_xyzw": poses[1][part].tolist(),
            "outcome": ["success"] * len(poses[0][part]),
        }
        answer = http.post(f"/objects/{slug}/trials", json={"columns": columns, "gripper": "pg70"})
        answer.raise_for_status()


def timed(call: Callable[[], httpx.Response]) -> float:
    started = time.perf_counter()
    call().raise_for_status()
    return (time.perf_counter() - started) * 1000


def told(name: str, times: list[float], note: str = "") -> None:
    p50, p99 = np.percentile(times, [50, 99])
    print(f"{name:61s} p50 {p50:9.1f} ms   p99 {p99:9.1f} ms   n {len(times):4d}   {note}", flush=True)


def workspace(rng: np.random.Generator) -> dict[str, Any]:
    """A box, a cone and the collision test: a different one each time, so that nothing repeats."""
    lower = np.array([-0.1, -0.1, 0.0]) + rng.uniform(0, 0.02, 3)
    direction = np.array([0, 0, -1.0]) + 0.3 * rng.normal(size=3)
    return {
        "box_min": ",".join(f"{x:.6f}" for x in lower),
        "box_max": "0.2,0.2,0.2",
        "approach": ",".join(f"{x:.6f}" for x in direction),
        "approach_cone_deg": 45,
        "collision_free": True,
    }


class Asked:
    """The same questions over HTTP, by several clients, and to the use case in this process."""

    def __init__(self, url: str, context: Context, slug: str, rng: np.random.Generator) -> None:
        self.context, self.slug, self.rng = context, slug, rng
        self.clients = [httpx.Client(base_url=url, timeout=300) for _ in range(4)]
        self.http = self.clients[0]
        self.times: dict[str, list[float]] = {}
        self.notes: dict[str, str] = {}

    def close(self) -> None:
        for client in self.clients:
            client.close()

    def took(self, name: str, times: list[float]) -> None:
        self.times.setdefault(name, []).extend(times)

    def best(self, client: httpx.Client) -> httpx.Response:
        return client.get(f"/objects/{self.slug}/best-grasp", params=workspace(self.rng))

    def in_process(self, more: dict[str, Any]) -> tuple[float, float]:
        """Milliseconds by the clock and of the processor."""
        asked = {
            key: [float(x) for x in value.split(",")] if isinstance(value, str) else value
            for key, value in workspace(self.rng).items()
        }
        request = BestGraspRequest(**(asked | more))
        started, busy = time.perf_counter(), time.process_time()
        best_grasps(self.context, self.slug, request)
        return (time.perf_counter() - started) * 1000, (time.process_time() - busy) * 1000

    def likelihoods(self, name: str, body: bytes, times: int) -> None:
        """Posts a body of poses, and asks whether the service is alive meanwhile."""
        headers = {"Content-Type": "application/json"}
        alive: list[float] = []
        done = threading.Event()

        def watch() -> None:
            while not done.is_set():
                alive.append(timed(lambda: self.clients[1].get("/livez")))
                time.sleep(0.01)

        watcher = threading.Thread(target=watch)
        watcher.start()
        path = f"/objects/{self.slug}/likelihood"
        try:
            self.took(
                name,
                [timed(lambda: self.http.post(path, content=body, headers=headers)) for _ in range(times)],
            )
        finally:
            done.set()
            watcher.join()
        self.took(f"  /livez meanwhile ({name})", alive)

    def round(self, bodies: dict[str, bytes]) -> None:
        """Some of every kind of request; the first after more trials is not counted."""
        self.best(self.http).raise_for_status()
        self.took(
            "best grasp: box, cone, collision test", [timed(lambda: self.best(self.http)) for _ in range(15)]
        )
        for name, more in (("  in process", {}), ("  in process, 15 mm and 15 degrees: dense", DENSE)):
            self.in_process(more)
            pairs = [self.in_process(more) for _ in range(10)]
            self.took(name, [clock for clock, _ in pairs])
            self.took(f"{name}, processor's time", [busy for _, busy in pairs])
        with concurrent.futures.ThreadPoolExecutor(4) as pool:
            each = pool.map(lambda c: [timed(lambda: self.best(c)) for _ in range(15)], self.clients)
            self.took("  4 clients", [t for times in each for t in times])
        for name, body in bodies.items():
            self.likelihoods(name, body, 15 if len(body) < 1_000 else 1)
        path = f"/objects/{self.slug}/samples"
        self.took("samples, 10,000", [timed(lambda: self.http.post(path, json={"count": 10_000}))])
        post(self.http, self.slug, shell(1000, self.rng))
        self.took(
            "density after 1,000 more trials (extends)",
            [timed(lambda: self.http.get(f"/objects/{self.slug}/density"))],
        )


def run(url: str, context: Context, slug: str, count: int, rng: np.random.Generator) -> None:
    asked = Asked(url, context, slug, rng)
    http = asked.http
    try:
        http.post("/objects", json={"id": slug}).raise_for_status()
        http.put(
            f"/objects/{slug}/mesh?unit=m", content=sphere_stl(), headers={"Content-Type": "model/stl"}
        ).raise_for_status()
        poses = shell(count, rng)
        started = time.perf_counter()
        post(http, slug, poses)
        print(f"\n{count} successes posted in {time.perf_counter() - started:.1f} s")
        asked.took("first best grasp (reads, builds)", [timed(lambda: asked.best(http))])
        # Here too the first ones read, build and load compiled code.
        for more in ({}, DENSE):
            for _ in range(2):
                asked.in_process(more)
        bodies = {}
        for many in (1, 10_000, 200_000):
            rows = rng.integers(0, count, many)
            moved = poses[0][rows] + 0.01 * rng.normal(size=(many, 3))
            columns = {"position": moved.tolist(), "quaternion_xyzw": poses[1][rows].tolist()}
            bodies[f"likelihood, {many} poses, all columns"] = json.dumps({"poses": columns}).encode()
        for _ in range(ROUNDS):
            asked.round(bodies)
        for name, times in asked.times.items():
            told(name, times, f"max {max(times):.0f} ms" if "livez" in name else "")
        info = http.get(f"/objects/{slug}/density").json()
        print(f"{'density in memory':61s} {info['bytes'] / 2**20:.0f} MiB")
    finally:
        asked.close()


def main(kernels: tuple[int, ...] = KERNELS) -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder, server(Path(folder)) as url:
        context = create_app(Settings(database_url=database_in(Path(folder)))).state.context
        try:
            for count in kernels:
                run(url, context, f"shell-{count}", count, rng)
        finally:
            context.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--kernels", type=int, nargs="*", default=list(KERNELS))
    main(tuple(parser.parse_args().kernels))
