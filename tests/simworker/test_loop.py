"""The pull loop against the real service."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import Any

import httpx
import pytest

from graspdb.errors import Unreachable
from graspdb.examples import example
from graspdb.processes import ChildProcess
from graspdb.transport import Transport
from graspdb.wire import OUTCOMES, ClaimedJob, ClaimRequest, SimulatePayload, SweepInfo
from graspdb_simworker import loop
from graspdb_simworker.loop import Lease, Worker, WorkerFailed
from graspdb_simworker.process.local import LocalRunner
from graspdb_simworker.process.runner import ChunkFailed
from graspdb_simworker.simulation import chunks

Plan = Callable[..., dict[str, Any]]


@pytest.fixture(scope="module")
def url(serve_module: Callable[..., str], tmp_path_factory: pytest.TempPathFactory) -> str:
    """A service that knows the mug."""
    database = tmp_path_factory.mktemp("service") / "graspdb.sqlite"
    url = serve_module(f"sqlite:///{database}", retry_after_s=0.2, lease_s=6.0)
    mug = example("mug")
    with httpx.Client(base_url=url, timeout=60.0) as http:
        created = http.post("/objects", json={"id": "mug", "mass_kg": mug.mass_kg, "friction": mug.friction})
        assert created.status_code == 201, created.text
        for path, body, media in (
            ("mesh", mug.stl(), "model/stl"),
            ("convex-parts", mug.parts_glb(), "model/gltf-binary"),
        ):
            stored = http.put(f"/objects/mug/{path}", content=body, headers={"Content-Type": media})
            assert stored.is_success, stored.text
    return url


@pytest.fixture
def http(url: str) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=url, timeout=30.0) as client:
        yield client


@pytest.fixture
def transport(url: str) -> Iterator[Transport]:
    with Transport(url, retries=0) as transport:
        yield transport


@pytest.fixture
def plan(http: httpx.Client) -> Iterator[Plan]:
    """Plan a sweep on the mug: ``plan(max_poses, chunk_poses, ...)``; the next test finds none of it."""
    made: list[str] = []

    def make(max_poses: int, chunk_poses: int, **more: Any) -> dict[str, Any]:
        answer = http.post(
            "/objects/mug/sweeps",
            json={
                "grid": {"max_poses": max_poses, "seed": 4},
                "gripper": "pg70",
                "protocol": "wrench",
                "chunk_poses": chunk_poses,
                **more,
            },
        )
        assert answer.status_code == 202, answer.text
        sweep: dict[str, Any] = answer.json()
        made.append(sweep["id"])
        return sweep

    yield make
    for sweep in made:
        http.post(f"/sweeps/{sweep}/cancel")


@pytest.fixture
def until_leased(http: httpx.Client, eventually: Callable[..., Any]) -> Callable[[], Any]:
    """Waits until a worker has a job."""
    return lambda: eventually(lambda: any(w["jobs_leased"] for w in http.get("/workers").json()["items"]))


class Running:
    """A worker in a thread of its own."""

    def __init__(self, worker: Worker) -> None:
        self.worker = worker
        self.error: BaseException | None = None
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self) -> None:
        try:
            self.worker.run()
        except BaseException as error:  # noqa: BLE001 - handed to the test
            self.error = error

    def stop(self) -> None:
        self.worker.stop()
        self.join()

    def join(self) -> None:
        self.thread.join(60.0)
        assert not self.thread.is_alive()


def test_a_sweep_is_done_whole_with_the_outcomes_of_its_poses(
    http: httpx.Client,
    transport: Transport,
    plan: Plan,
    payload_of: Callable[..., SimulatePayload],
    workpiece_of: Callable[..., chunks.Workpiece],
) -> None:
    sweep = plan(2_000, 500)
    worker = Worker(transport, name="two", processes=2, exit_when_idle=True)
    worker.run()
    assert (worker.tally.jobs, worker.tally.poses, worker.tally.failures) == (4, 2_000, 0)
    done = http.get(f"/sweeps/{sweep['id']}").json()
    assert (done["state"], done["chunks_done"], done["poses_done"]) == ("done", 4, 2_000)

    stored: dict[int, str] = {}
    cursor = None
    while True:
        parameters = {"limit": 1_000, **({"cursor": cursor} if cursor else {})}
        page = http.get(f"/sweeps/{sweep['id']}/outcomes", params=parameters).json()
        stored.update(zip(page["pose_index"], page["outcome"], strict=True))
        cursor = page["next"]
        if cursor is None:
            break
    # The same poses, each once, as this process plans and simulates them from the example's own parts.
    payload = payload_of("mug", grid={"max_poses": 2_000, "seed": 4}, stop=2_000)
    indices, _, _ = chunks.poses_of(payload)
    here = chunks.simulate_chunk(payload, workpiece_of("mug"))
    assert sorted(stored) == indices.tolist()
    expected = [OUTCOMES[code] for code in here.outcomes]
    different = [stored[i] != outcome for i, outcome in zip(indices.tolist(), expected, strict=True)]
    assert sum(different) <= 4, "parts travel as float32: at most a few borderline poses may differ"
    assert {name: list(stored.values()).count(name) for name in set(stored.values())} == {
        name: count for name, count in done["outcomes"].items() if count
    }
    assert {"collision", "missed", "slipped", "success"} <= set(stored.values())


def test_a_stopped_worker_gives_its_lease_back(
    http: httpx.Client, transport: Transport, plan: Plan, until_leased: Callable[[], Any]
) -> None:
    plan(100_000, 100_000)
    running = Running(Worker(transport, name="stopped"))
    until_leased()
    running.stop()
    assert running.error is None
    # At once another may have it; without the release it would wait for the lease to run out.
    claim = http.post("/jobs/claim", json={"worker": "next", "capabilities": ["simulate"]}).json()
    assert len(claim["jobs"]) == 1


def test_a_cancelled_sweep_stops_the_child(
    http: httpx.Client, transport: Transport, plan: Plan, until_leased: Callable[[], Any]
) -> None:
    sweep = plan(100_000, 100_000)
    worker = Worker(transport, name="cancelled", exit_when_idle=True)
    running = Running(worker)
    until_leased()
    assert http.post(f"/sweeps/{sweep['id']}/cancel").is_success
    running.join()
    assert (worker.tally.jobs, worker.tally.lost) == (0, 1)


def test_a_long_chunk_outlives_its_lease_by_the_heartbeat(
    http: httpx.Client, transport: Transport, plan: Plan
) -> None:
    sweep = plan(40, 40)

    class Slow(LocalRunner):
        """A child that takes longer than a lease lasts."""

        def run(self, payload: Any, parts_glb: bytes, **options: Any) -> Any:
            wanted = options["wanted"]
            deadline = time.monotonic() + 8.0
            while time.monotonic() < deadline:
                assert wanted()
                time.sleep(0.1)
            return super().run(payload, parts_glb, **options)

    worker = Worker(transport, name="slow", exit_when_idle=True, make_runner=Slow)
    running = Running(worker)
    time.sleep(7.0)
    stolen = http.post("/jobs/claim", json={"worker": "thief", "capabilities": ["simulate"]}).json()
    assert stolen["jobs"] == []
    running.join()
    assert running.error is None
    assert (worker.tally.jobs, worker.tally.lost) == (1, 0)
    assert http.get(f"/sweeps/{sweep['id']}").json()["state"] == "done"


def test_parts_are_fetched_once_and_checked(http: httpx.Client, transport: Transport, plan: Plan) -> None:
    plan(40, 40)
    answer = http.post(
        "/jobs/claim",
        json=ClaimRequest(worker="parts", capabilities=["simulate"]).model_dump(),
    ).json()
    job = ClaimedJob.model_validate(answer["jobs"][0])
    payload = job.payload
    assert isinstance(payload, SimulatePayload)
    lease = Lease(job.id, job.lease_id, job.lease_s, time.monotonic())
    worker = Worker(transport, name="parts")
    data = worker._parts_of(payload, lease)
    assert hashlib.sha256(data).hexdigest() == payload.parts_sha256
    gone = payload.model_copy(update={"convex_parts": "/objects/none/convex-parts"})
    assert worker._parts_of(gone, lease) is data
    with pytest.raises(ChunkFailed, match="can't fetch"):
        worker._parts_of(gone.model_copy(update={"parts_sha256": "1" * 64}), lease)
    with pytest.raises(ChunkFailed, match="SHA-256"):
        worker._parts_of(payload.model_copy(update={"parts_sha256": "0" * 64}), lease)


def test_a_job_that_fails_is_reported_with_its_reason(
    http: httpx.Client, transport: Transport, plan: Plan
) -> None:
    sweep = plan(40, 40)

    def broken() -> LocalRunner:
        return LocalRunner((sys.executable, "-c", "import sys; sys.exit(9)"))

    worker = Worker(transport, name="broken", exit_when_idle=True, make_runner=broken)
    worker.run()
    assert worker.tally.failures >= 1
    failed = http.get(f"/sweeps/{sweep['id']}").json()
    assert failed["state"] == "failed"
    assert "exit code 9" in failed["failed_chunks"][0]["error"]


def test_a_result_is_sent_again_until_the_service_answers(
    http: httpx.Client, transport: Transport, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = plan(200, 200)
    monkeypatch.setattr(loop, "_backoff", lambda failures: 0.05)

    class Cut(Transport):
        """The service takes the result, its answer is lost, and then the wire is cut for two more tries."""

        tries = 0

        def request(self, method: str, path: str, **options: Any) -> httpx.Response:
            if Cut.tries and path.endswith("/lease"):  # would be told that the job is done
                raise Unreachable("the wire is cut")
            if path.endswith("/result"):
                Cut.tries += 1
                if Cut.tries == 1:
                    super().request(method, path, **options)
                if Cut.tries <= 3:
                    raise Unreachable("the wire is cut")
            return super().request(method, path, **options)

    with Cut(transport.url, retries=0, timeout_s=1.0) as cut:
        worker = Worker(cut, name="stubborn", exit_when_idle=True)
        worker.run()
    assert Cut.tries == 4
    assert (worker.tally.jobs, worker.tally.lost, worker.tally.failures) == (1, 0, 0)
    done = http.get(f"/sweeps/{sweep['id']}").json()
    assert (done["state"], done["poses_done"]) == ("done", 200)


def test_a_dead_heartbeat_stops_the_worker(transport: Transport) -> None:
    class Dying(Worker):
        def _heartbeat(self) -> None:
            raise MemoryError("no more")

    with pytest.raises(WorkerFailed, match="heartbeat died"):
        Dying(transport, name="dying").run()


def test_a_worker_waits_for_a_service_that_is_not_there() -> None:
    with Transport("http://127.0.0.1:9", retries=0) as nowhere:
        running = Running(Worker(nowhere, name="patient"))
        time.sleep(1.0)
        assert running.thread.is_alive()
        running.stop()
    assert running.error is None


def cli(*arguments: str) -> ChildProcess:
    return ChildProcess(
        [sys.executable, "-m", "graspdb_simworker.cli", *arguments], stderr=subprocess.PIPE, text=True
    )


def test_the_command_works_until_idle_and_ends_well_on_a_signal(
    http: httpx.Client, url: str, plan: Plan, until_leased: Callable[[], Any]
) -> None:
    sweep = plan(400, 200)
    with cli("run", "--url", url, "--exit-when-idle") as process:
        _, said = process.communicate(timeout=60)
    assert process.returncode == 0, said
    assert "2 jobs, 400 poses" in said
    assert http.get(f"/sweeps/{sweep['id']}").json()["state"] == "done"

    plan(100_000, 100_000)
    with cli("run", "--url", url, "--name", "signalled") as process:
        until_leased()
        os.kill(process.pid, signal.SIGTERM)
        _, said = process.communicate(timeout=30)
    assert process.returncode == 0, said
    assert (
        len(http.post("/jobs/claim", json={"worker": "next", "capabilities": ["simulate"]}).json()["jobs"])
        == 1
    )


def test_a_sweep_is_simulated_by_the_engine_that_it_names(
    http: httpx.Client, transport: Transport, plan: Plan
) -> None:
    named, free = plan(600, 600, engine="mujoco"), plan(601, 601)
    Worker(transport, name="bullet", exit_when_idle=True, engine="pybullet", engines=["pybullet"]).run()
    told = [http.get(f"/sweeps/{sweep['id']}").json() for sweep in (named, free)]
    assert [sweep["state"] for sweep in told] == ["queued", "done"]
    assert told[1]["engines"] == [f"pybullet {version('pybullet')}"]
    Worker(transport, name="both", exit_when_idle=True, engines=["pybullet", "mujoco"]).run()
    done = http.get(f"/sweeps/{named['id']}").json()
    assert (done["state"], done["engines"]) == ("done", [f"mujoco {version('mujoco')}"])
    assert SweepInfo.model_validate(done).sole_engine == "mujoco"
    mixed = {**done, "engines": [*done["engines"], *told[1]["engines"]]}
    assert SweepInfo.model_validate(mixed).sole_engine is None


def test_one_worker_simulates_both_halves_of_a_sweep(http: httpx.Client, url: str, plan: Plan) -> None:
    first = plan(400, 200, engine="both")
    with cli("run", "--url", url, "--exit-when-idle", "--engine", "both") as process:
        _, said = process.communicate(timeout=60)
    assert "4 jobs, 800 poses" in said
    told = [http.get(f"/sweeps/{id}").json() for id in (first["id"], first["linked"])]
    assert [item["engines"] for item in told] == [
        [f"{engine} {version(engine)}"] for engine in ("pybullet", "mujoco")
    ]
    # What never met physics was judged by one collision test.
    assert told[0]["outcomes"]["collision"] == told[1]["outcomes"]["collision"]
    batch = {"batch": first["batch"]}
    rows = http.get("/objects/mug/trials", params=batch).json()["items"]
    assert {row["engine"] for row in rows} == set(told[0]["engines"])


@pytest.mark.parametrize(
    ("missing", "asked", "remedy"),
    [
        (["pybullet", "mujoco"], [], "graspdb[sim,mujoco]"),
        (["pybullet"], ["--engine", "pybullet"], "x86-64"),
        (["mujoco"], ["--engine", "mujoco"], "graspdb[sim,mujoco]"),
        (["mujoco"], ["--engine", "both"], "graspdb[sim,mujoco]"),
        ([], ["--engine", "drake"], "pybullet, mujoco"),
    ],
)
def test_the_command_explains_a_missing_engine_in_one_line(
    missing: list[str], asked: list[str], remedy: str
) -> None:
    hide = f"import sys; sys.modules.update(dict.fromkeys({missing}));"
    script = f"{hide} from graspdb_simworker.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", script, "run", *asked], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert remedy in line
