"""Queries over HTTP against a real server on SQLite: best grasp, likelihood, samples, extension, /livez.

Data: successes on the shell of an ellipsoid that the gripper can close on (semi-axes 60, 30 and 30 mm), moved
along the normal within 20 mm; approach the inward normal plus noise, roll uniform. The ellipsoid is a mesh of
512 triangles that the gripper must not touch. Three in four of these successes collide with it: most
searches have to look for the edge of the free space.

Best grasps are timed over HTTP and in process, by the clock and by the processor's time; in process also
under wider kernels, most of which reach each other, without a collision test.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import json
import os
import socket
import struct
import subprocess
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

from graspdb.wire import BestGraspRequest
from graspdb_density import se3
from graspdb_service.app import create_app
from graspdb_service.settings import Settings
from graspdb_service.usecases import bestgrasp

Floats = NDArray[np.float64]
AXES = np.array([0.06, 0.03, 0.03])
KERNELS = (20_000, 160_000)


def shell(count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Grasps on the shell of a graspable ellipsoid (60 x 30 x 30 mm semi-axes), tool z inwards."""
    u = rng.normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    normal = u / AXES
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    position = u * AXES + normal * rng.uniform(-0.02, 0.02, (count, 1))
    z = -normal + 0.4 * rng.normal(size=(count, 3))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    helper = rng.normal(size=(count, 3))
    y = np.cross(z, helper)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return position, se3.from_matrix(np.stack([np.cross(y, z), y, z], axis=-1))


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
        process = subprocess.Popen(
            [*command, "--log-level", "warning"], env=environment, stdout=log, stderr=log
        )
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
    print(f"{name:46s} p50 {p50:9.1f} ms   p99 {p99:9.1f} ms   n {len(times):4d}   {note}", flush=True)


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


def in_process(database: str, slug: str, rng: np.random.Generator) -> None:
    """The same question to the use case, in this process over the same database; then with wide kernels."""
    context = create_app(Settings(database_url=database)).state.context
    try:
        wide = {"sigma_position_m": 0.015, "sigma_rotation_deg": 15.0, "collision_free": False}
        for name, more in (("  in process", {}), ("  in process, 15 mm and 15 degrees: dense", wide)):
            clock, processor = [], []
            for _ in range(43):
                asked = {
                    key: [float(x) for x in value.split(",")] if isinstance(value, str) else value
                    for key, value in workspace(rng).items()
                }
                request = BestGraspRequest(**(asked | more))
                started, busy = time.perf_counter(), time.process_time()
                bestgrasp.best_grasps(context, slug, request)
                clock.append((time.perf_counter() - started) * 1000)
                processor.append((time.process_time() - busy) * 1000)
            # The first ones read, build and load compiled code.
            told(name, clock[3:], f"processor's time p50 {np.median(processor[3:]):.1f} ms")
    finally:
        context.close()


def run(url: str, database: str, slug: str, count: int, rng: np.random.Generator) -> None:
    with httpx.Client(base_url=url, timeout=300) as http:
        http.post("/objects", json={"id": slug}).raise_for_status()
        http.put(
            f"/objects/{slug}/mesh?unit=m", content=sphere_stl(), headers={"Content-Type": "model/stl"}
        ).raise_for_status()
        poses = shell(count, rng)
        started = time.perf_counter()
        post(http, slug, poses)
        print(f"\n{count} successes posted in {time.perf_counter() - started:.1f} s")
        path = f"/objects/{slug}/best-grasp"

        def best(client: httpx.Client = http) -> httpx.Response:
            return client.get(path, params=workspace(rng))

        told("first best grasp (reads, builds)", [timed(best)])
        told("best grasp: box, cone, collision test", [timed(best) for _ in range(60)])
        in_process(database, slug, rng)
        clients = [httpx.Client(base_url=url, timeout=300) for _ in range(4)]
        with concurrent.futures.ThreadPoolExecutor(4) as pool:
            each = pool.map(lambda c: [timed(lambda: best(c)) for _ in range(40)], clients)
            told("  4 clients", [t for times in each for t in times])
        body = json.dumps(
            {"poses": {"position": poses[0][:1].tolist(), "quaternion_xyzw": poses[1][:1].tolist()}}
        )
        headers = {"Content-Type": "application/json"}
        told(
            "likelihood, 1 pose",
            [
                timed(lambda: http.post(f"/objects/{slug}/likelihood", content=body, headers=headers))
                for _ in range(60)
            ],
        )
        for many in (10_000, 200_000):
            rows = rng.integers(0, count, many)
            moved = poses[0][rows] + 0.01 * rng.normal(size=(many, 3))
            big = json.dumps(
                {"poses": {"position": moved.tolist(), "quaternion_xyzw": poses[1][rows].tolist()}}
            ).encode()
            alive: list[float] = []
            done = threading.Event()

            def watch(alive: list[float] = alive, done: threading.Event = done) -> None:
                with httpx.Client(base_url=url, timeout=60) as other:
                    while not done.is_set():
                        alive.append(timed(lambda: other.get("/livez")))
                        time.sleep(0.01)

            watcher = threading.Thread(target=watch)
            watcher.start()

            def ask(big: bytes = big) -> httpx.Response:
                return http.post(f"/objects/{slug}/likelihood", content=big, headers=headers)

            times = [timed(ask) for _ in range(3)]
            done.set()
            watcher.join()
            told(f"likelihood, {many} poses, all columns", times, f"{len(big) / 2**20:.0f} MiB of JSON")
            told("  /livez meanwhile", alive, f"max {max(alive):.0f} ms")
        told(
            "samples, 10,000",
            [timed(lambda: http.post(f"/objects/{slug}/samples", json={"count": 10_000})) for _ in range(5)],
        )
        after = []
        for _ in range(5):
            post(http, slug, shell(1000, rng))
            after.append(timed(lambda: http.get(f"/objects/{slug}/density")))
        told("density after 1,000 more trials (extends)", after)
        info = http.get(f"/objects/{slug}/density").json()
        print(f"{'density in memory':46s} {info['bytes'] / 2**20:.0f} MiB")


def main(kernels: tuple[int, ...] = KERNELS) -> None:
    """Print the table."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder, server(Path(folder)) as url:
        for count in kernels:
            run(url, database_in(Path(folder)), f"shell-{count}", count, rng)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--kernels", type=int, nargs="*", default=list(KERNELS))
    main(tuple(parser.parse_args().kernels))
