"""The lease protocol over HTTP and against a model: every job done once, whatever workers do."""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from sqlalchemy import text

from graspdb.wire import (
    OUTCOME_CODES,
    GridPlan,
    MeshInfo,
    PartsInfo,
)
from graspdb_geometry.grids import PoseGrid
from graspdb_service.storage import assets, objects
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Database
from graspdb_service.storage.simulation import jobs as job_rows

BOX = {"lower": [-0.02, -0.02, -0.05], "upper": [0.02, 0.02, 0.05]}
GRID = {"position_step_m": 0.02, "rotation_step_deg": 60.0, "margin_m": 0.0}
#: 3 x 3 x 5 positions and half of 72 rotations, for the jaw is symmetric.
GRID_POSES = 45 * 36


def add_box(database: Database, slug: str) -> None:
    """An object ready for sweeps: a box that is its own convex part. The protocol never opens the files."""
    with database.write() as tx:
        objects.create(tx, slug, {"mass_kg": 0.3})
        audit.record(tx, "object.create", object=slug)
        row = objects.find(tx, slug)
        assert row is not None
        sha256 = assets.put(tx, f"a box for {slug}".encode(), "model/stl")
        mesh = MeshInfo(
            sha256=sha256,
            media_type="model/stl",
            unit="m",
            bytes=1,
            vertices=8,
            faces=12,
            bounding_box=BOX,
            volume_m3=1.6e-4,
            watertight=True,
            convex=True,
            centre_of_mass=(0, 0, 0),
            inertia_m5=None,
        )
        parts = PartsInfo(sha256=sha256, parts=1, volume_m3=1.6e-4, bounding_box=BOX)
        objects.advance(tx, row.id, append=False)
        objects.change(
            tx,
            row.id,
            {
                "mesh_sha256": sha256,
                "mesh_info": mesh.model_dump(mode="json"),
                "parts_sha256": sha256,
                "parts_info": parts.model_dump(mode="json"),
            },
        )


def simulate(payload: dict[str, Any]) -> dict[str, Any]:
    """A result as a worker makes it, with outcomes that depend on the pose index only."""
    grid = PoseGrid(**payload["grid"])
    index = grid.pose_indices(payload["start"], payload["stop"])
    codes = outcome_of(index)
    physics = index[codes != OUTCOME_CODES["collision"]]
    return {
        "outcomes": base64.b64encode(codes.tobytes()).decode(),
        "rows": {
            "pose_index": physics.tolist(),
            "width_m": [0.04] * len(physics),
            "quality": [None] * len(physics),
        },
    }


def outcome_of(index: np.ndarray) -> np.ndarray:
    return np.array([1, 2, 2, 2, 4, 6, 2, 2], dtype=np.uint8)[(index * 2_654_435_761 >> 7) % 8]


@pytest.fixture
def box(http: httpx.Client, database_url: str) -> Iterator[Database]:
    """The database behind ``http``, holding the object ``box``."""
    database = Database(database_url)
    add_box(database, "box")
    yield database
    database.dispose()


def start_sweep(http: httpx.Client, chunk_poses: int = 100, **options: Any) -> dict[str, Any]:
    answer = http.post("/objects/box/sweeps", json={"grid": GRID, "chunk_poses": chunk_poses, **options})
    assert answer.status_code == 202, answer.text
    made: dict[str, Any] = answer.json()
    return made


def claim(http: httpx.Client, worker: str = "w", limit: int = 1) -> list[dict[str, Any]]:
    answer = http.post("/jobs/claim", json={"worker": worker, "capabilities": ["simulate"], "limit": limit})
    assert answer.status_code == 200, answer.text
    found: list[dict[str, Any]] = answer.json()["jobs"]
    return found


def put_result(http: httpx.Client, job: dict[str, Any], body: dict[str, Any] | None = None) -> httpx.Response:
    return http.put(
        f"/jobs/{job['id']}/result",
        params={"lease_id": job["lease_id"]},
        json=simulate(job["payload"]) if body is None else body,
    )


def let_leases_run_out(database: Database) -> None:
    with database.write() as tx:
        tx.execute(text("UPDATE jobs SET lease_expires_at = 0 WHERE state = 'leased'"))


def is_lost(answer: httpx.Response) -> bool:
    return answer.status_code == 409 and bool(answer.json()["type"].endswith(":lease-lost"))


def stored_indices(database: Database) -> list[int]:
    with database.read() as tx:
        rows = tx.execute(text("SELECT pose_index FROM trials WHERE pose_index IS NOT NULL ORDER BY 1"))
        return [int(index) for (index,) in rows]


def expected_indices(plan: dict[str, Any] | None = None) -> list[int]:
    grid = PoseGrid(**BOX, **{**GRID, **(plan or {})})
    index = grid.pose_indices(0, grid.total)
    return sorted(index[outcome_of(index) != OUTCOME_CODES["collision"]].tolist())


def test_workers_finish_a_sweep_and_every_pose_is_stored_once(http: httpx.Client, box: Database) -> None:
    sweep = start_sweep(http)
    assert (sweep["state"], sweep["poses"], sweep["chunks"]) == ("queued", GRID_POSES, 17)
    first = claim(http)[0]
    assert first["payload"]["grid"] == {
        **BOX,
        **GRID,
        "region": None,
        "max_poses": None,
        "seed": 0,
        "symmetric": True,
    }
    assert first["payload"]["gripper"]["max_opening_m"] == 0.07
    assert (first["payload"]["start"], first["payload"]["stop"]) == (0, 100)
    assert http.get(f"/sweeps/{sweep['id']}").json()["state"] == "running"
    before = http.get("/objects/box").json()["revision"]
    answer = put_result(http, first)
    assert answer.status_code == 200
    assert answer.json() == {
        "job": first["id"],
        "revision": before + 1,
        "inserted": answer.json()["inserted"],
    }
    while found := claim(http, limit=5):
        for job in found:
            assert put_result(http, job).status_code == 200
    assert stored_indices(box) == expected_indices()
    done = http.get(f"/sweeps/{sweep['id']}").json()
    assert (done["state"], done["chunks_done"], done["poses_done"]) == ("done", 17, GRID_POSES)
    assert sum(done["outcomes"].values()) == GRID_POSES
    # Rows and packed outcomes together are every pose, and the object counts them.
    batch = http.get(f"/objects/box/batches/{sweep['batch']}").json()
    assert batch["inserted"] == len(expected_indices())
    assert batch["packed"] == GRID_POSES - batch["inserted"]
    assert http.get("/objects/box").json()["outcomes"] == done["outcomes"] == batch["outcomes"]
    worker = http.get("/workers").json()["items"][0]
    assert (worker["worker"], worker["jobs_done"], worker["poses_done"]) == ("w", 17, GRID_POSES)
    assert worker["jobs_leased"] == 0


def test_rows_carry_the_pose_the_service_derived_and_the_grids_density(
    http: httpx.Client, box: Database
) -> None:
    sweep = start_sweep(http, 2_000)
    assert put_result(http, claim(http)[0]).status_code == 200
    trials = http.get("/objects/box/trials", params={"limit": 1_000}).json()["items"]
    index = np.array([trial["pose_index"] for trial in trials])
    position, quaternion = PoseGrid(**BOX, **GRID).poses(index)
    np.testing.assert_allclose([trial["position"] for trial in trials], position, atol=1e-15)
    np.testing.assert_allclose([trial["quaternion_xyzw"] for trial in trials], quaternion, atol=1e-15)
    # 45 cells of (2 cm)^3 and all of SO(3), whose volume is 8 pi^2.
    density = 1 / (8 * np.pi**2 * 45 * 0.02**3)
    for trial in trials:
        assert trial["proposal_density"] == pytest.approx(density, rel=1e-12)
        assert (trial["gripper"], trial["source"], trial["protocol"]) == ("pg70", "simulation", "wrench")
        assert (trial["sweep"], trial["width_m"], trial["quality"]) == (sweep["id"], 0.04, None)


def test_eight_claimers_never_get_the_same_job(http: httpx.Client, box: Database) -> None:
    sweep = start_sweep(http, 10)
    got: list[str] = []

    def work(name: str) -> None:
        with httpx.Client(base_url=http.base_url, timeout=60) as client:
            while found := claim(client, name, limit=3):
                got.extend(job["id"] for job in found)

    threads = [threading.Thread(target=work, args=(f"w{number}",)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(got) == len(set(got)) == sweep["chunks"] == 162


def test_a_late_result_is_refused_once_another_has_the_job(http: httpx.Client, box: Database) -> None:
    start_sweep(http, 2_000)
    stalled = claim(http)[0]
    assert claim(http) == []
    let_leases_run_out(box)
    # The same worker's name proves nothing.
    taken = claim(http)[0]
    assert taken["id"] == stalled["id"]
    assert taken["lease_id"] != stalled["lease_id"]
    for method, path in (("PUT", "lease"), ("DELETE", "lease")):
        url = f"/jobs/{stalled['id']}/{path}"
        assert is_lost(http.request(method, url, params={"lease_id": stalled["lease_id"]}))
    assert is_lost(put_result(http, stalled))
    failure = http.put(
        f"/jobs/{stalled['id']}/failure", params={"lease_id": stalled["lease_id"]}, json={"error": "late"}
    )
    assert is_lost(failure)
    assert stored_indices(box) == []
    assert put_result(http, taken).status_code == 200
    assert is_lost(put_result(http, stalled))
    assert stored_indices(box) == expected_indices()


def test_the_statement_that_completes_a_job_fences_by_itself(http: httpx.Client, box: Database) -> None:
    """Between looking at a job and completing it, another claim may come."""
    start_sweep(http, 2_000)
    stalled = claim(http)[0]
    let_leases_run_out(box)
    taken = claim(http)[0]
    for lease, done in ((stalled["lease_id"], False), (taken["lease_id"], True), (taken["lease_id"], False)):
        with box.write() as tx:
            counts = {"all": {}, "packed": {}}
            assert job_rows.complete(tx, taken["id"], lease, sha256="", answer={}, counts=counts) is done


def test_a_result_after_its_lease_ran_out_is_accepted_while_nobody_else_came(
    http: httpx.Client, box: Database
) -> None:
    start_sweep(http, 2_000)
    job = claim(http)[0]
    let_leases_run_out(box)
    assert put_result(http, job).status_code == 200
    assert stored_indices(box) == expected_indices()


def test_a_lease_of_a_clock_that_was_set_back_does_not_last_for_ever(
    http: httpx.Client, box: Database
) -> None:
    """A clock that is set back by a day makes a lease granted before end a day late."""
    start_sweep(http, 5_000)
    held = claim(http, "a")[0]

    def set_back(seconds: float) -> None:
        with box.write() as tx:
            statement = text(
                "UPDATE jobs SET lease_expires_at = lease_expires_at + :by WHERE state = 'leased'"
            )
            tx.execute(statement, {"by": seconds})
            tx.execute(text("UPDATE workers SET last_seen = last_seen + :by"), {"by": seconds})

    set_back(600.0)
    assert claim(http, "b") == [], "a clock's correction, or a replica with longer leases, takes no job away"
    set_back(86_400.0)
    again = claim(http, "b")[0]
    assert again["id"] == held["id"]
    assert is_lost(put_result(http, held))
    assert put_result(http, again).status_code == 200


def test_renewing_keeps_a_job(http: httpx.Client, box: Database) -> None:
    start_sweep(http, 2_000)
    job = claim(http)[0]
    let_leases_run_out(box)
    renewed = http.put(f"/jobs/{job['id']}/lease", params={"lease_id": job["lease_id"]})
    assert renewed.status_code == 200
    assert renewed.json()["cancel"] is False
    assert renewed.json()["lease_s"] == 60
    assert claim(http, "other") == []


def test_the_same_result_again_gets_the_same_answer(http: httpx.Client, box: Database) -> None:
    start_sweep(http)
    job = claim(http)[0]
    first = put_result(http, job)
    put_result(http, claim(http)[0])
    again = put_result(http, job)
    assert (again.status_code, again.json()) == (200, first.json())
    other = simulate(job["payload"])
    other["rows"]["width_m"][0] = 0.05
    assert is_lost(put_result(http, job, other))
    indices = stored_indices(box)
    assert len(indices) == len(set(indices))


def test_a_result_sent_many_times_at_once_is_stored_once(http: httpx.Client, box: Database) -> None:
    start_sweep(http, 2_000)
    job = claim(http)[0]
    answers: list[Any] = []

    def send() -> None:
        with httpx.Client(base_url=http.base_url, timeout=60) as client:
            answers.append(put_result(client, job))

    threads = [threading.Thread(target=send) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [answer.status_code for answer in answers] == [200] * 6
    assert len({answer.text for answer in answers}) == 1
    assert stored_indices(box) == expected_indices()


def test_giving_a_job_back_is_no_attempt(http: httpx.Client, box: Database) -> None:
    start_sweep(http, 2_000)
    for _ in range(6):
        job = claim(http)[0]
        gone = http.delete(f"/jobs/{job['id']}/lease", params={"lease_id": job["lease_id"]})
        assert gone.status_code == 204
    assert put_result(http, claim(http)[0]).status_code == 200


def fail(http: httpx.Client, job: dict[str, Any], error: str) -> httpx.Response:
    return http.put(f"/jobs/{job['id']}/failure", params={"lease_id": job["lease_id"]}, json={"error": error})


def test_a_job_that_keeps_failing_ends_and_can_be_retried(http: httpx.Client, box: Database) -> None:
    sweep = start_sweep(http, 1_000)
    for attempt in range(4):
        job = claim(http)[0]
        answer = fail(http, job, f"boom {attempt}")
        state = "failed" if attempt == 3 else "queued"
        assert answer.json() == {"job": job["id"], "state": state, "attempts": attempt + 1}
        # The report's answer may be lost: the same again changes nothing.
        assert fail(http, job, f"boom {attempt}").json() == answer.json()
    assert put_result(http, claim(http)[0]).status_code == 200
    ended = http.get(f"/sweeps/{sweep['id']}").json()
    assert ended["state"] == "failed"
    assert ended["failed_chunks"] == [{"chunk": 0, "attempts": 4, "error": "boom 3"}]
    assert claim(http) == []
    assert is_lost(put_result(http, job))
    retried = http.post(f"/sweeps/{sweep['id']}/retry").json()
    assert (retried["state"], retried["chunks_failed"]) == ("running", 0)
    assert put_result(http, claim(http)[0]).status_code == 200
    assert http.get(f"/sweeps/{sweep['id']}").json()["state"] == "done"
    assert stored_indices(box) == expected_indices()


def test_a_job_that_kills_every_worker_ends(http: httpx.Client, box: Database) -> None:
    sweep = start_sweep(http, 2_000)
    for attempt in range(4):
        assert len(claim(http, f"victim {attempt}")) == 1
        let_leases_run_out(box)
    assert claim(http, "survivor") == []
    ended = http.get(f"/sweeps/{sweep['id']}").json()
    assert ended["state"] == "failed"
    assert "the lease ran out 4 times" in ended["failed_chunks"][0]["error"]


def test_after_cancelling_nothing_is_stored(http: httpx.Client, box: Database) -> None:
    sweep = start_sweep(http)
    done, held = claim(http, limit=2)
    assert put_result(http, done).status_code == 200
    before = stored_indices(box)
    cancelled = http.post(f"/sweeps/{sweep['id']}/cancel").json()
    assert (cancelled["state"], cancelled["chunks_done"]) == ("cancelled", 1)
    renewed = http.put(f"/jobs/{held['id']}/lease", params={"lease_id": held["lease_id"]})
    assert renewed.json()["cancel"] is True
    assert is_lost(put_result(http, held))
    assert claim(http) == []
    assert stored_indices(box) == before
    assert http.delete("/objects/box").status_code == 204


def test_a_sweeps_object_and_batch_stay_while_it_runs(http: httpx.Client, box: Database) -> None:
    sweep = start_sweep(http, 2_000)
    assert http.delete("/objects/box").status_code == 409
    assert http.delete(f"/objects/box/batches/{sweep['batch']}").status_code == 409
    assert put_result(http, claim(http)[0]).status_code == 200
    assert http.delete(f"/objects/box/batches/{sweep['batch']}").status_code == 204
    assert stored_indices(box) == []
    assert http.get("/objects/box").json()["outcomes"] == {}
    assert http.post(f"/sweeps/{sweep['id']}/retry").json()["type"].endswith(":batch-deleted")


def spoil(result: dict[str, Any], how: str) -> dict[str, Any]:
    codes = np.frombuffer(base64.b64decode(result["outcomes"]), dtype=np.uint8).copy()
    rows = result["rows"]
    if how == "short":
        codes = codes[:-1]
    elif how == "code":
        codes[3] = 9
    elif how == "foreign":
        rows["pose_index"][-1] = 10_000_000
    elif how == "huge":
        rows["pose_index"][-1] = 2**70
    elif how == "twice":
        rows["pose_index"][1] = rows["pose_index"][0]
    elif how == "widths":
        rows["width_m"].pop()
    elif how == "collision":
        codes[:] = OUTCOME_CODES["collision"]
    elif how == "success":
        codes[codes == OUTCOME_CODES["collision"]] = OUTCOME_CODES["success"]
    elif how == "nan":
        rows["quality"][0] = float("nan")
    elif how == "unknown":
        rows["colour"] = []
    result["outcomes"] = base64.b64encode(codes.tobytes()).decode()
    return result


def test_a_result_that_does_not_fit_is_named_and_not_stored(
    sqlite_http: httpx.Client, sqlite_url: str
) -> None:
    database = Database(sqlite_url)
    add_box(database, "box")
    start_sweep(sqlite_http, 2_000)
    job = claim(sqlite_http)[0]
    before = sqlite_http.get("/objects/box").json()
    for how, field in [
        ("short", "outcomes"),
        ("code", "outcomes"),
        ("foreign", "rows.pose_index"),
        ("huge", "rows.pose_index"),
        ("twice", "rows.pose_index"),
        ("widths", "rows.width_m"),
        ("collision", "rows.pose_index"),
        ("success", "rows.pose_index"),
        ("nan", ""),
        ("unknown", "rows.colour"),
    ]:
        answer = sqlite_http.put(
            f"/jobs/{job['id']}/result",
            params={"lease_id": job["lease_id"]},
            content=json.dumps(spoil(simulate(job["payload"]), how)),
            headers={"Content-Type": "application/json"},
        )
        assert answer.status_code == 422, (how, answer.text)
        assert answer.json()["errors"][0]["field"].startswith(field), (how, answer.text)
    assert stored_indices(database) == []
    assert sqlite_http.get("/objects/box").json() == before
    assert put_result(sqlite_http, job).status_code == 200
    database.dispose()


def test_bad_requests_are_named(sqlite_http: httpx.Client) -> None:
    missing = sqlite_http.put(
        "/jobs/none/result",
        params={"lease_id": "x"},
        json={"outcomes": "", "rows": {"pose_index": [], "width_m": [], "quality": []}},
    )
    assert missing.status_code == 404
    assert sqlite_http.put("/jobs/none/lease").json()["errors"][0]["field"] == "lease_id"
    nothing = sqlite_http.post("/jobs/claim", json={"worker": "w", "capabilities": []})
    assert nothing.json()["errors"][0]["field"] == "capabilities"
    idle = sqlite_http.post("/jobs/claim", json={"worker": "w"}).json()
    assert idle["jobs"] == []
    assert idle["retry_after_s"] > 0


def test_a_lift_sweep_waits_for_a_worker_that_can(sqlite_http: httpx.Client, sqlite_url: str) -> None:
    database = Database(sqlite_url)
    add_box(database, "box")
    start_sweep(sqlite_http, 2_000, protocol="lift")
    assert claim(sqlite_http) == []
    able = sqlite_http.post("/jobs/claim", json={"worker": "w", "capabilities": ["simulate", "lift"]}).json()
    assert able["jobs"][0]["payload"]["protocol"] == "lift"
    database.dispose()


def test_how_hard_a_sweep_shakes_is_part_of_its_protocol(sqlite_http: httpx.Client, sqlite_url: str) -> None:
    """Older workers, which know the usual shake alone, do not get it, and who waits is told."""
    database = Database(sqlite_url)
    add_box(database, "box")
    sweep = start_sweep(sqlite_http, 2_000, protocol="shake-5-100")
    assert sweep["protocol"] == "shake-5-100"
    older, newer = ["simulate", "shake", "drawn-shake"], ["simulate", "shake", "stated-shake"]
    assert sqlite_http.post("/jobs/claim", json={"worker": "old", "capabilities": older}).json()["jobs"] == []
    (warning,) = sqlite_http.get(f"/sweeps/{sweep['id']}").json()["warnings"]
    assert "older version" in warning
    able = sqlite_http.post("/jobs/claim", json={"worker": "new", "capabilities": newer}).json()
    assert able["jobs"][0]["payload"]["protocol"] == "shake-5-100"
    assert start_sweep(sqlite_http, 2_000, protocol="shake-20-100")["protocol"] == "shake"
    for unknown in ("shake-5", "shake-0-100", "shake-5-100-1", "drop"):
        refused = sqlite_http.post("/objects/box/sweeps", json={"protocol": unknown})
        assert refused.status_code == 422
        (error,) = refused.json()["errors"]
        assert error["field"] == "protocol"
        assert "shake-5-100" in error["message"]
    database.dispose()


def test_a_sweep_of_an_engine_waits_for_a_worker_that_has_it(http: httpx.Client, box: Database) -> None:
    def ask(worker: str, *can: str) -> list[dict[str, Any]]:
        body = {"worker": worker, "capabilities": ["simulate", *can], "limit": 1}
        found: list[dict[str, Any]] = http.post("/jobs/claim", json=body).json()["jobs"]
        return found

    sweep = start_sweep(http, 2_000, engine="mujoco")
    assert (sweep["engine"], sweep["engines"]) == ("mujoco", [])
    (warning,) = sweep["warnings"]
    assert "no worker that has mujoco" in warning
    assert "graspdb[sim,mujoco]" in warning
    assert ask("old") == []
    assert ask("bullet", "pybullet") == []
    (job,) = ask("both", "pybullet", "mujoco")
    assert job["payload"]["engine"] == "mujoco"
    assert http.get(f"/sweeps/{sweep['id']}").json()["warnings"] == []
    refused = put_result(http, job, simulate(job["payload"]) | {"engine": "MuJoCo!"})
    assert (refused.status_code, refused.json()["errors"][0]["field"]) == (422, "engine")
    stored = put_result(http, job, simulate(job["payload"]) | {"engine": "mujoco 4.0.0"}).json()
    assert http.get(f"/sweeps/{sweep['id']}").json()["engines"] == ["mujoco 4.0.0"]
    assert http.get(f"/objects/box/batches/{sweep['batch']}").json()["engines"] == ["mujoco 4.0.0"]

    # What another engine says of the same poses is no repeat; the same engine again is one.
    for engine, kept in (("pybullet", stored["inserted"]), ("mujoco", 0)):
        start_sweep(http, 2_000, engine=engine)
        (job,) = ask("both", "pybullet", "mujoco")
        assert put_result(http, job).json()["inserted"] == kept

    # A sweep that names none goes to any worker, and a worker that tells none leaves it unknown.
    free = start_sweep(http, 2_000)
    (job,) = ask("old")
    assert job["payload"]["engine"] is None
    put_result(http, job)
    done = http.get(f"/sweeps/{free['id']}").json()
    assert (done["state"], done["engine"], done["engines"]) == ("done", None, [])


# --- against a model ------------------------------------------------------------------------------------


def test_a_grid_plan_on_the_wire_is_the_grid_of_the_service() -> None:
    """What a worker makes of a payload must be what the service derives poses from."""
    fields = set(GridPlan.model_fields)
    assert fields == {field for field in PoseGrid.__dataclass_fields__ if not field.startswith("_")}
