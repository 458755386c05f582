"""Real decompositions, by the child alone and by the whole worker, and what becomes of hopeless ones."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import trimesh

from graspdb import Client
from graspdb.transport import Transport
from graspdb.wire import DecomposePayload
from graspdb_geometry import meshes
from graspdb_geometry.deviation import deviation
from graspdb_simworker import loop
from graspdb_simworker.decomposition import supervisor
from graspdb_simworker.decomposition.supervisor import DecompositionFailed, ResourceLimits
from graspdb_simworker.loop import Worker
from graspdb_simworker.process.runner import ChunkCancelled

LIMITS = ResourceLimits(seconds=120.0)
PAYLOAD = DecomposePayload(object="angle", mesh="/objects/angle/mesh", mesh_sha256="", unit="mm")


def angle_stl(open_by: int = 0) -> bytes:
    """An L of 20 mm thick legs, 80 mm long and 30 mm wide, in millimetres; some triangles may be missing."""
    outline = np.array([(0, 0), (80, 0), (80, 20), (20, 20), (20, 80), (0, 80)], dtype=np.float64)
    count = len(outline)
    vertices = np.concatenate([np.c_[outline, np.zeros(count)], np.c_[outline, np.full(count, 30.0)]])
    bottom = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    faces = [(a, c, b) for a, b, c in bottom] + [(a + count, b + count, c + count) for a, b, c in bottom]
    for i in range(count):
        j = (i + 1) % count
        faces += [(i, j, j + count), (i, j + count, i + count)]
    mesh = trimesh.Trimesh(vertices - [30, 30, 15], faces, process=False)
    data = mesh.subdivide().subdivide()
    data.update_faces(np.arange(len(data.faces)) >= open_by)
    stl: bytes = data.export(file_type="stl")
    return stl


def ring_stl() -> bytes:
    """A ring of 65,536 triangles in millimetres, which takes seconds."""
    stl: bytes = trimesh.creation.torus(30, 10, 256, 128).export(file_type="stl")
    return stl


VOLUME = (0.08 * 0.02 + 0.06 * 0.02) * 0.03


def check_parts(glb: bytes) -> None:
    parts = meshes.parts_from_glb(glb)
    assert 2 <= len(parts) <= 8
    volume = sum(float(trimesh.Trimesh(v, f, process=False).volume) for v, f in parts)
    assert volume == pytest.approx(VOLUME, rel=0.01)
    mesh = meshes.load(angle_stl(), "model/stl", "mm")
    assert deviation(mesh, parts).largest_m < 1e-3


def test_an_angle_is_split_the_same_every_time() -> None:
    notes: list[str] = []
    first = supervisor.decompose(PAYLOAD, angle_stl(), limits=LIMITS, progress=notes.append)
    check_parts(first)
    assert "faces in a body" in notes[0]
    assert "left, at most 120 s" in notes[0]
    assert "mm off" in notes[-1]
    assert "% volume" in notes[-1]
    scaled = PAYLOAD.model_copy(update={"unit": "m", "scale": 0.001})
    assert supervisor.decompose(scaled, angle_stl(), limits=LIMITS) == first


def test_too_little_time_is_said_with_the_way_out() -> None:
    with pytest.raises(DecompositionFailed, match=r"more than 0\.05 s .*--decompose-seconds.*convex parts"):
        supervisor.decompose(PAYLOAD, ring_stl(), limits=ResourceLimits(seconds=0.05))


def test_work_is_bounded_and_not_the_wait() -> None:
    # The kernel ends what has used up its processor time, long before three minutes are over by the clock.
    script = "import resource as r; r.setrlimit(r.RLIMIT_CPU, (1, 9))\nwhile True: pass"
    with pytest.raises(DecompositionFailed, match=r"more than 60 s .*--decompose-seconds"):
        supervisor.decompose(
            PAYLOAD, angle_stl(), limits=ResourceLimits(seconds=60.0), command=(sys.executable, "-c", script)
        )


def test_a_signal_to_the_whole_group_is_left_to_the_worker() -> None:
    def notice(note: str) -> None:
        for child in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split():
            if b"decomposition.child" in Path(f"/proc/{child}/cmdline").read_bytes():
                os.kill(int(child), signal.SIGTERM)
                sent.append(note)

    sent: list[str] = []

    check_parts(supervisor.decompose(PAYLOAD, angle_stl(), limits=LIMITS, progress=notice))
    assert sent


def test_too_little_memory_is_said_with_the_way_out() -> None:
    with pytest.raises(DecompositionFailed, match="memory"):
        supervisor.decompose(PAYLOAD, angle_stl(), limits=ResourceLimits(120.0, 150 * 2**20))


def test_what_is_no_mesh_is_refused_with_the_reason() -> None:
    with pytest.raises(DecompositionFailed, match="not STL"):
        supervisor.decompose(PAYLOAD, b"hello", limits=LIMITS)


def test_a_child_that_dies_is_told_apart() -> None:
    command = (sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    with pytest.raises(DecompositionFailed, match="SIGSEGV"):
        supervisor.decompose(PAYLOAD, angle_stl(), limits=LIMITS, command=command)


def test_the_best_so_far_is_taken_when_time_is_over() -> None:
    script = (
        "import time; from graspdb_simworker.process import channel as m;"
        "m.Inbox(0).receive(); m.send(1, m.RESULT, b'coarse'); m.send(1, m.RESULT, b'finer'); time.sleep(60)"
    )
    found = supervisor.decompose(
        PAYLOAD, angle_stl(), limits=ResourceLimits(seconds=0.3), command=(sys.executable, "-c", script)
    )
    assert found == b"finer"


def test_it_stops_when_it_is_not_wanted_any_more() -> None:
    began = time.monotonic()
    command = (sys.executable, "-c", "import time; time.sleep(600)")
    with pytest.raises(ChunkCancelled):
        supervisor.decompose(
            PAYLOAD,
            angle_stl(),
            limits=LIMITS,
            wanted=lambda: time.monotonic() < began + 0.5,
            command=command,
        )


def test_it_ends_with_a_killed_worker(
    tmp_path: Path, descendants: Callable[[], list[str]], eventually: Callable[..., Any]
) -> None:
    (tmp_path / "mesh.stl").write_bytes(ring_stl())
    script = (
        "import pathlib, sys; from graspdb.wire import DecomposePayload;"
        "from graspdb_simworker.decomposition.supervisor import ResourceLimits, decompose;"
        "decompose(DecomposePayload.model_validate_json(sys.argv[1]), pathlib.Path(sys.argv[2]).read_bytes(),"
        " limits=ResourceLimits(), progress=lambda note: print(note, flush=True))"
    )
    arguments = [PAYLOAD.model_dump_json(), str(tmp_path / "mesh.stl")]
    with subprocess.Popen([sys.executable, "-c", script, *arguments], stdout=subprocess.PIPE) as worker:
        assert worker.stdout is not None
        assert b"faces in a body" in worker.stdout.readline()
        time.sleep(np.random.default_rng().uniform(0.0, 1.0))
        worker.kill()
        eventually(lambda: not descendants(), 10)


@pytest.fixture
def url(serve: Callable[..., str], sqlite_url: str) -> str:
    return serve(sqlite_url, retry_after_s=0.2, lease_s=6.0)


def upload(http: httpx.Client, content: bytes) -> dict[str, Any]:
    made = http.post("/objects", json={"id": "angle", "density_kg_m3": 1_000})
    assert made.status_code == 201, made.text
    stored = http.put("/objects/angle/mesh?unit=mm", content=content, headers={"Content-Type": "model/stl"})
    assert stored.status_code == 200, stored.text
    info: dict[str, Any] = stored.json()
    return info


def sweep(http: httpx.Client, **grid: Any) -> dict[str, Any]:
    answer = http.post("/objects/angle/sweeps", json={"grid": {"max_poses": 3_000, "seed": 2, **grid}})
    assert answer.status_code == 202, answer.text
    made: dict[str, Any] = answer.json()
    return made


def test_a_foreign_mesh_with_a_hole_is_swept_from_end_to_end(url: str) -> None:
    """Uploaded in millimetres and not watertight: mended, decomposed, simulated, and a grasp comes out."""
    with httpx.Client(base_url=url, timeout=60) as http, Transport(url, retries=0) as transport:
        info = upload(http, angle_stl(open_by=3))
        assert info["watertight"]
        assert any("mended" in warning for warning in info["warnings"])
        made = sweep(http)
        assert made["waiting_for"]["state"] == "queued"
        # A worker without CoACD leaves it alone.
        Worker(transport, name="plain", exit_when_idle=True).run()
        assert http.get(f"/sweeps/{made['id']}").json()["poses_done"] == 0
        with Client(url) as db:
            assert "CoACD" in str(db.sweeps.get(made["id"]).hint())

        seen: set[str] = set()
        worker = Worker(transport, name="able", exit_when_idle=True, decompositions=LIMITS)
        thread = threading.Thread(target=worker.run, daemon=True)
        thread.start()
        while thread.is_alive():
            waiting = http.get(f"/sweeps/{made['id']}").json()["waiting_for"]
            if waiting and waiting["state"] == "running":
                seen.add(waiting["progress"] or waiting["worker"])
            thread.join(0.1)
        assert seen
        assert worker.tally.failures == 0
        now = http.get(f"/sweeps/{made['id']}").json()
        assert (now["state"], now["poses_done"], now["waiting_for"]) == ("done", 3_000, None)
        assert now["outcomes"]["success"] > 0
        assert now["outcomes"]["collision"] > 0
        thing = http.get("/objects/angle").json()
        assert thing["convex_parts"]["parts"] >= 2
        assert thing["convex_parts"]["deviation_m"] < 1e-3
        check_parts(http.get("/objects/angle/convex-parts").content)
        best = http.get("/objects/angle/best-grasp").json()
        assert best["status"] == "ok"


def test_ready_chunks_of_other_objects_do_not_wait_for_it(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    done = threading.Event()
    parts: list[bytes] = []

    def slow(*_: Any, wanted: Callable[[], bool], progress: Callable[[str], None], **__: Any) -> bytes:
        progress("cutting")
        while wanted() and not done.wait(0.05):
            pass
        return parts[0]

    monkeypatch.setattr(loop, "decompose", slow)
    with httpx.Client(base_url=url, timeout=60) as http, Transport(url, retries=0) as transport:
        parts.append(supervisor.decompose(PAYLOAD, angle_stl(), limits=LIMITS))
        upload(http, angle_stl())
        waiting = sweep(http, max_poses=200)
        assert http.post("/objects", json={"id": "brick", "mass_kg": 0.1}).status_code == 201
        brick = trimesh.creation.box((0.03, 0.03, 0.1)).export(file_type="stl")
        stored = http.put("/objects/brick/mesh", content=brick, headers={"Content-Type": "model/stl"})
        assert stored.status_code == 200
        ready = http.post("/objects/brick/sweeps", json={"grid": {"max_poses": 200}}).json()
        assert ready["waiting_for"] is None

        worker = Worker(transport, name="one", exit_when_idle=True, decompositions=LIMITS)
        thread = threading.Thread(target=worker.run, daemon=True)
        thread.start()
        deadline = time.monotonic() + 120.0
        while http.get(f"/sweeps/{ready['id']}").json()["state"] != "done":
            assert time.monotonic() < deadline
            time.sleep(0.1)
        waits_for = http.get(f"/sweeps/{waiting['id']}").json()["waiting_for"]
        assert (waits_for["state"], waits_for["progress"]) == ("running", "cutting")
        # Idle now but for the decomposition, after which there are chunks again.
        done.set()
        thread.join(120.0)
        assert not thread.is_alive()
        assert http.get(f"/sweeps/{waiting['id']}").json()["state"] == "done"
        assert worker.tally.failures == 0


def test_a_failed_decomposition_fails_the_sweep_with_its_reason(url: str) -> None:
    with httpx.Client(base_url=url, timeout=60) as http, Transport(url, retries=0) as transport:
        upload(http, ring_stl())
        made = sweep(http)
        worker = Worker(
            transport, name="hasty", exit_when_idle=True, decompositions=ResourceLimits(seconds=0.05)
        )
        worker.run()
        # No second attempt: it would end the same way.
        assert worker.tally.failures == 1
        now = http.get(f"/sweeps/{made['id']}").json()
        assert now["state"] == "failed"
        assert "--decompose-seconds" in now["failed_chunks"][0]["error"]
        assert "PUT /objects/angle/convex-parts" in now["failed_chunks"][0]["error"]


def test_a_cancelled_sweep_stops_the_decomposition(url: str) -> None:
    with httpx.Client(base_url=url, timeout=60) as http, Transport(url, retries=0) as transport:
        upload(http, ring_stl())
        made = sweep(http)
        worker = Worker(transport, name="cancelled", exit_when_idle=True, decompositions=LIMITS)
        thread = threading.Thread(target=worker.run, daemon=True)
        thread.start()
        deadline = time.monotonic() + 60.0
        while http.get(f"/sweeps/{made['id']}").json()["waiting_for"]["state"] != "running":
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert http.post(f"/sweeps/{made['id']}/cancel").is_success
        thread.join(60.0)
        assert not thread.is_alive()
        assert (worker.tally.jobs, worker.tally.lost) == (0, 1)
        assert http.get("/objects/angle").json()["convex_parts"] is None
