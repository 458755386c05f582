"""Convex parts made by a worker: one job an object, waited for by its sweeps, had or missed by all."""

from __future__ import annotations

import base64
import struct
import threading
from typing import Any

import httpx
import numpy as np
import pytest
from sqlalchemy import text

from graspdb_geometry import meshes
from graspdb_geometry.grids import PoseGrid
from graspdb_service.storage.database import Database

GRID = {"position_step_m": 0.02, "rotation_step_deg": 60.0, "margin_m": 0.0, "max_poses": 300}
STL = {"Content-Type": "model/stl"}
GLB = {"Content-Type": "model/gltf-binary"}
_FACES = (
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
)  # fmt: skip


def _box(size: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> meshes.Part:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return corners * size + centre, np.array(_FACES)


def _stl(*parts: meshes.Part) -> bytes:
    triangles = np.concatenate([vertices[faces] for vertices, faces in parts]).astype("<f4")
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.ravel(), 0) for triangle in triangles)
    return b"\0" * 80 + struct.pack("<I", len(triangles)) + body


DUMBBELL = [_box((0.04, 0.04, 0.04), (0, 0, z)) for z in (-0.05, 0.05)]
# A cavity so thin that it changes no measure, but its body is not convex any more.
_SLIT = _box((0.004, 0.004, 1e-6), (0, 0, -0.05))
DENTED = [*DUMBBELL, (_SLIT[0], _SLIT[1][:, ::-1])]
PARTS = meshes.parts_to_glb(DUMBBELL)
VOLUME = 2 * 0.04**3


def add(http: httpx.Client, slug: str = "bell", **properties: Any) -> str:
    made = http.post("/objects", json={"id": slug, **(properties or {"mass_kg": 0.2})})
    assert made.status_code == 201, made.text
    stored = http.put(f"/objects/{slug}/mesh", content=_stl(*DENTED), headers=STL)
    assert stored.status_code == 200, stored.text
    return slug


@pytest.fixture
def bell(http: httpx.Client) -> httpx.Client:
    """A client of a service with the object ``bell``: two boxes, one of them not quite convex."""
    add(http)
    return http


def start(http: httpx.Client, slug: str = "bell", **spec: Any) -> dict[str, Any]:
    answer = http.post(f"/objects/{slug}/sweeps", json={"grid": GRID, **spec})
    assert answer.status_code == 202, answer.text
    made: dict[str, Any] = answer.json()
    return made


def sweep(http: httpx.Client, made: dict[str, Any]) -> dict[str, Any]:
    now: dict[str, Any] = http.get(f"/sweeps/{made['id']}").json()
    return now


def claim(http: httpx.Client, *capabilities: str, limit: int = 64) -> list[dict[str, Any]]:
    wish = {"worker": "w", "capabilities": capabilities or ("simulate", "decompose"), "limit": limit}
    answer = http.post("/jobs/claim", json=wish)
    assert answer.status_code == 200, answer.text
    found: list[dict[str, Any]] = answer.json()["jobs"]
    return found


def put_result(
    http: httpx.Client, job: dict[str, Any], body: bytes = PARTS, headers: dict[str, str] = GLB
) -> httpx.Response:
    return http.put(
        f"/jobs/{job['id']}/result", params={"lease_id": job["lease_id"]}, content=body, headers=headers
    )


def fail(http: httpx.Client, job: dict[str, Any], **report: Any) -> httpx.Response:
    url, lease = f"/jobs/{job['id']}/failure", {"lease_id": job["lease_id"]}
    return http.put(url, params=lease, json={"error": "CoACD gave up", **report})


def simulate(http: httpx.Client, job: dict[str, Any]) -> None:
    """Every pose collides: what is found does not matter here."""
    payload = job["payload"]
    count = payload["stop"] - payload["start"]
    body = {
        "outcomes": base64.b64encode(bytes([2] * count)).decode(),
        "rows": {"pose_index": [], "width_m": [], "quality": []},
    }
    answer = http.put(f"/jobs/{job['id']}/result", params={"lease_id": job["lease_id"]}, json=body)
    assert answer.status_code == 200, answer.text


def kind_of(answer: httpx.Response) -> tuple[int, str]:
    return answer.status_code, answer.json()["type"].rsplit(":", 1)[1]


def test_sweeps_wait_for_one_decomposition_and_go_on_with_its_parts(bell: httpx.Client) -> None:
    first = start(bell)
    assert first["state"] == "queued"
    assert first["waiting_for"]["kind"] == "decompose"
    assert first["waiting_for"]["state"] == "queued"
    second = start(bell, grid={**GRID, "seed": 1})
    assert second["waiting_for"]["job"] == first["waiting_for"]["job"]
    assert claim(bell, "simulate") == []
    (job,) = claim(bell)
    mesh = bell.get("/objects/bell").json()["mesh"]
    assert job["kind"] == "decompose"
    assert job["payload"] == {
        "object": "bell",
        "mesh": "/objects/bell/mesh",
        "mesh_sha256": mesh["sha256"],
        "media_type": "model/stl",
        "scale": 1.0,
        "unit": "m",
        "max_parts": meshes.MAX_PARTS,
    }
    renewed = bell.put(
        f"/jobs/{job['id']}/lease", params={"lease_id": job["lease_id"], "progress": "halfway"}
    )
    assert renewed.status_code == 200
    for made in (first, second):
        now = sweep(bell, made)
        assert (now["state"], now["waiting_for"]["state"]) == ("queued", "running")
        assert (now["waiting_for"]["progress"], now["waiting_for"]["worker"]) == ("halfway", "w")
    before = bell.get("/objects/bell").json()
    answer = put_result(bell, job)
    assert answer.status_code == 200, answer.text
    after = bell.get("/objects/bell").json()
    assert after["revision"] == after["epoch"] == before["revision"] + 1 == answer.json()["revision"]
    parts = after["convex_parts"]
    assert (parts["parts"], parts["warnings"]) == (2, [])
    assert parts["volume_m3"] == pytest.approx(VOLUME, rel=1e-5)
    assert parts["deviation_m"] < 1e-6
    assert bell.get("/objects/bell/convex-parts").content == PARTS
    chunks = claim(bell)
    assert {chunk["payload"]["sweep"] for chunk in chunks} == {first["id"], second["id"]}
    for chunk in chunks:
        assert chunk["payload"]["parts_sha256"] == parts["sha256"]
        assert chunk["payload"]["mass_kg"] == 0.2
        simulate(bell, chunk)
    for made in (first, second):
        now = sweep(bell, made)
        assert (now["state"], now["waiting_for"]) == ("done", None)
    # The same again is another sweep over the same poses, each of which counts once.
    third = start(bell)
    assert third["waiting_for"] is None
    known = bell.get("/objects/bell").json()["trials"]
    for chunk in claim(bell):
        simulate(bell, chunk)
    assert sweep(bell, third)["state"] == "done"
    assert bell.get("/objects/bell").json()["trials"] == known


def test_repeats_are_found_between_sweeps_that_waited(bell: httpx.Client) -> None:
    for _ in range(2):
        start(bell)
    put_result(bell, claim(bell, "decompose")[0])
    for chunk in claim(bell):
        simulate(bell, chunk)
    assert bell.get("/objects/bell").json()["trials"] == GRID["max_poses"]


def test_a_result_again_is_answered_the_same_and_a_late_one_refused(
    bell: httpx.Client, database_url: str
) -> None:
    start(bell)
    (late,) = claim(bell)
    database = Database(database_url)
    with database.write() as tx:
        tx.execute(text("UPDATE jobs SET lease_expires_at = 0 WHERE state = 'leased'"))
    database.dispose()
    (job,) = claim(bell)
    assert job["id"] == late["id"]
    assert kind_of(put_result(bell, late)) == (409, "lease-lost")
    assert bell.get("/objects/bell").json()["convex_parts"] is None
    answer = put_result(bell, job)
    assert answer.status_code == 200
    assert put_result(bell, job).json() == answer.json()
    other = meshes.parts_to_glb(DUMBBELL[:1])
    assert kind_of(put_result(bell, job, other)) == (409, "lease-lost")
    assert bell.get("/objects/bell").json()["convex_parts"]["parts"] == 2


def test_a_result_sent_many_times_at_once_is_stored_once(bell: httpx.Client) -> None:
    start(bell)
    (job,) = claim(bell)
    answers: list[httpx.Response] = []

    def send() -> None:
        with httpx.Client(base_url=bell.base_url, timeout=60) as client:
            answers.append(put_result(client, job))

    before = bell.get("/objects/bell").json()["revision"]
    threads = [threading.Thread(target=send) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {answer.status_code for answer in answers} == {200}
    assert len({answer.text for answer in answers}) == 1
    assert bell.get("/objects/bell").json()["revision"] == before + 1


def test_parts_are_checked_like_those_that_a_user_sends(bell: httpx.Client) -> None:
    start(bell)
    (job,) = claim(bell)
    vertices, faces = DUMBBELL[0]
    dented = vertices.copy()
    dented[0] *= 0.3
    answer = put_result(bell, job, meshes.parts_to_glb([DUMBBELL[1], (dented, faces)]))
    assert kind_of(answer) == (422, "mesh-not-usable")
    assert answer.json()["errors"][0]["field"].startswith("parts")
    assert kind_of(put_result(bell, job, b"glTF")) == (422, "mesh-not-usable")
    json_headers = {"Content-Type": "application/json"}
    rows = b'{"outcomes": "", "rows": {"pose_index": [], "width_m": [], "quality": []}}'
    assert put_result(bell, job, rows, json_headers).status_code == 415
    assert bell.get("/objects/bell").json()["convex_parts"] is None
    # What was refused has cost nothing: the job is still the worker's.
    assert put_result(bell, job).status_code == 200
    (chunk,) = claim(bell, limit=1)
    assert put_result(bell, chunk).status_code == 415


def test_parts_that_miss_the_mesh_are_refused_from_a_worker_too(bell: httpx.Client) -> None:
    start(bell)
    (job,) = claim(bell)
    hull = meshes.parts_to_glb([_box((0.04, 0.04, 0.14))])
    refused = put_result(bell, job, hull)
    assert kind_of(refused) == (422, "convex-parts-deviate")
    # Halfway between the two boxes the hull is 20 mm from either's edge, and 30 from their faces.
    assert refused.json()["deviation_m"] == pytest.approx(0.03, abs=0.002)
    assert "175.0%" in refused.json()["title"]
    assert bell.get("/objects/bell").json()["convex_parts"] is None
    assert put_result(bell, job).status_code == 200


def test_what_parts_add_to_the_volume_is_that_of_their_union(bell: httpx.Client) -> None:
    made = start(bell)
    twice = meshes.parts_to_glb([*DUMBBELL, _box((0.04, 0.04, 0.05), (0, 0, 0.045))])
    answer = bell.put("/objects/bell/convex-parts?accept_deviation=true", content=twice, headers=GLB)
    assert answer.status_code == 200
    parts = bell.get("/objects/bell").json()["convex_parts"]
    assert parts["volume_m3"] == pytest.approx(VOLUME + 0.04 * 0.04 * 0.05, rel=1e-5)
    assert parts["volume_share"] == pytest.approx(1.125, rel=1e-5)
    assert "112.5%" in parts["warnings"][0]
    # So says the sweep that had waited for others.
    assert any("112.5% of its volume" in warning for warning in sweep(bell, made)["warnings"])


def test_a_failed_attempt_is_repeated_and_the_last_one_fails_the_sweeps(bell: httpx.Client) -> None:
    made = [start(bell), start(bell, grid={**GRID, "seed": 1})]
    for attempt in range(1, 5):
        (job,) = claim(bell)
        noted = fail(bell, job).json()
        assert (noted["state"], noted["attempts"]) == ("queued" if attempt < 4 else "failed", attempt)
    assert claim(bell) == []
    for one in made:
        now = sweep(bell, one)
        assert now["state"] == "failed"
        assert now["chunks_failed"] == now["chunks"]
        assert (now["waiting_for"]["state"], now["waiting_for"]["error"]) == ("failed", "CoACD gave up")
        reason = now["failed_chunks"][0]["error"]
        assert "CoACD gave up" in reason
        assert "PUT /objects/bell/convex-parts" in reason
    refused = bell.post("/objects/bell/sweeps", json={"grid": GRID})
    assert kind_of(refused) == (409, "convex-parts-missing")
    assert "CoACD gave up" in refused.json()["title"]
    assert "PUT /objects/bell/convex-parts" in refused.json()["title"]


def test_the_same_request_is_answered_the_same_whatever_became_of_it(bell: httpx.Client) -> None:
    """Its first answer having been lost, a client must learn which sweep it made, not that none can be."""
    key = {"Idempotency-Key": "one"}
    first = bell.post("/objects/bell/sweeps", json={"grid": GRID}, headers=key)
    assert first.status_code == 202
    fail(bell, claim(bell)[0], permanent=True)
    assert kind_of(bell.post("/objects/bell/sweeps", json={"grid": GRID})) == (409, "convex-parts-missing")
    again = bell.post("/objects/bell/sweeps", json={"grid": GRID}, headers=key)
    assert (again.status_code, again.json()) == (202, first.json())
    assert again.headers["location"] == first.headers["location"]
    other = bell.post("/objects/bell/sweeps", json={"grid": {**GRID, "seed": 2}}, headers=key)
    assert kind_of(other) == (422, "idempotency-key-reused")
    assert len(bell.get("/sweeps").json()["items"]) == 1


def test_a_permanent_failure_is_not_repeated(bell: httpx.Client) -> None:
    made = start(bell)
    assert fail(bell, claim(bell)[0], permanent=True).json()["state"] == "failed"
    assert sweep(bell, made)["state"] == "failed"


def test_leases_that_run_out_fail_it_too(bell: httpx.Client, database_url: str) -> None:
    made = start(bell)
    database = Database(database_url)
    for _ in range(4):
        (job,) = claim(bell)
        with database.write() as tx:
            tx.execute(text("UPDATE jobs SET lease_expires_at = 0 WHERE state = 'leased'"))
    database.dispose()
    assert claim(bell) == []
    now = sweep(bell, made)
    assert now["state"] == "failed"
    assert "lease ran out 4 times" in now["failed_chunks"][0]["error"]
    assert kind_of(put_result(bell, job)) == (409, "lease-lost")


def test_retrying_decomposes_again_or_takes_the_parts_that_came(bell: httpx.Client) -> None:
    first, second = start(bell), start(bell, grid={**GRID, "seed": 1})
    fail(bell, claim(bell)[0], permanent=True)
    again = bell.post(f"/sweeps/{first['id']}/retry").json()
    assert (again["state"], again["waiting_for"]["state"]) == ("queued", "queued")
    assert again["waiting_for"]["error"] is None
    (job,) = claim(bell)
    assert job["kind"] == "decompose"
    assert put_result(bell, job).status_code == 200
    chunks = claim(bell)
    assert {chunk["payload"]["sweep"] for chunk in chunks} == {first["id"]}
    assert sweep(bell, second)["state"] == "failed"
    assert bell.post(f"/sweeps/{second['id']}/retry").json()["waiting_for"] is None
    chunks += claim(bell)
    assert {chunk["payload"]["sweep"] for chunk in chunks} == {first["id"], second["id"]}
    for chunk in chunks:
        simulate(bell, chunk)
    assert sweep(bell, first)["state"] == sweep(bell, second)["state"] == "done"


@pytest.mark.parametrize("claimed", [False, True])
def test_parts_that_a_user_sends_meanwhile_end_the_waiting(bell: httpx.Client, claimed: bool) -> None:
    made = start(bell)
    jobs = claim(bell) if claimed else []
    assert bell.put("/objects/bell/convex-parts", content=PARTS, headers=GLB).status_code == 200
    for job in jobs:
        renewed = bell.put(f"/jobs/{job['id']}/lease", params={"lease_id": job["lease_id"]})
        assert renewed.json()["cancel"] is True
        assert kind_of(put_result(bell, job, meshes.parts_to_glb(DUMBBELL[:1]))) == (409, "lease-lost")
    assert sweep(bell, made)["waiting_for"] is None
    kinds = {job["kind"] for job in claim(bell)}
    assert kinds == {"simulate"}
    # Now a sweep depends on them.
    other = meshes.parts_to_glb(DUMBBELL[:1])
    assert bell.put("/objects/bell/convex-parts", content=other, headers=GLB).status_code == 409


def test_cancelling_the_last_sweep_that_waits_stops_the_decomposition(bell: httpx.Client) -> None:
    first, second = start(bell), start(bell, grid={**GRID, "seed": 1})
    (job,) = claim(bell)
    lease = {"lease_id": job["lease_id"]}
    assert bell.post(f"/sweeps/{first['id']}/cancel").json()["state"] == "cancelled"
    assert bell.put(f"/jobs/{job['id']}/lease", params=lease).json()["cancel"] is False
    assert bell.delete("/objects/bell").status_code == 409
    assert bell.post(f"/sweeps/{second['id']}/cancel").json()["state"] == "cancelled"
    assert bell.put(f"/jobs/{job['id']}/lease", params=lease).json()["cancel"] is True
    assert kind_of(put_result(bell, job)) == (409, "lease-lost")
    assert claim(bell) == []
    # A new sweep asks for it once more.
    third = start(bell)
    assert third["waiting_for"]["state"] == "queued"
    assert put_result(bell, claim(bell)[0]).status_code == 200
    assert {chunk["payload"]["sweep"] for chunk in claim(bell)} == {third["id"]}
    bell.post(f"/sweeps/{third['id']}/cancel")
    assert bell.delete("/objects/bell").status_code == 204


def test_a_lease_given_back_is_no_attempt(bell: httpx.Client) -> None:
    start(bell)
    for _ in range(6):
        (job,) = claim(bell)
        gone = bell.delete(f"/jobs/{job['id']}/lease", params={"lease_id": job["lease_id"]})
        assert gone.status_code == 204
    assert put_result(bell, claim(bell)[0]).status_code == 200


def test_many_sweeps_at_once_ask_for_one_decomposition(bell: httpx.Client) -> None:
    made: list[dict[str, Any]] = []

    def send(seed: int) -> None:
        with httpx.Client(base_url=bell.base_url, timeout=60) as client:
            made.append(start(client, grid={**GRID, "seed": seed}))

    threads = [threading.Thread(target=send, args=(seed,)) for seed in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({one["waiting_for"]["job"] for one in made}) == 1
    assert [job["kind"] for job in claim(bell)] == ["decompose"]


def test_a_mass_by_density_uses_the_meshs_volume(sqlite_http: httpx.Client) -> None:
    add(sqlite_http, "dense", density_kg_m3=1_000)
    start(sqlite_http, "dense")
    put_result(sqlite_http, claim(sqlite_http)[0])
    assert claim(sqlite_http)[0]["payload"]["mass_kg"] == pytest.approx(1_000 * VOLUME, rel=1e-5)


def test_without_a_volume_the_mass_by_density_waits_for_the_parts(sqlite_http: httpx.Client) -> None:
    http = sqlite_http
    http.post("/objects", json={"id": "open", "density_kg_m3": 1_000})
    (vertices, faces), other = DUMBBELL
    # Half of one box is missing: no hole that could be filled in good faith.
    half = vertices, faces[:6]
    stored = http.put("/objects/open/mesh", content=_stl(half, other), headers=STL).json()
    assert (stored["watertight"], stored["volume_m3"]) == (False, None)
    first = start(http, "open")
    http.patch("/objects/open", json={"density_kg_m3": 5_000})
    assert put_result(http, claim(http)[0]).status_code == 200
    # They fill what the mesh leaves open, which nothing tells to be wrong; but it is said.
    parts = http.get("/objects/open").json()["convex_parts"]
    assert (parts["deviates"], parts["volume_share"]) == (True, None)
    assert any("mm off the mesh" in warning for warning in sweep(http, first)["warnings"])
    chunk = claim(http, limit=1)[0]
    assert chunk["payload"]["sweep"] == first["id"]
    # As it was when the sweep was made.
    assert chunk["payload"]["mass_kg"] == pytest.approx(1_000 * VOLUME, rel=1e-5)


def test_given_poses_wait_as_well(sqlite_http: httpx.Client) -> None:
    add(sqlite_http)
    poses = [{"position": [0, 0, 0.1], "quaternion_xyzw": [1, 0, 0, 0]}]
    made = sqlite_http.post("/objects/bell/sweeps", json={"poses": poses}).json()
    put_result(sqlite_http, claim(sqlite_http)[0])
    for chunk in claim(sqlite_http):
        assert chunk["payload"]["poses"]["position"] == [[0, 0, 0.1]]
        simulate(sqlite_http, chunk)
    assert sweep(sqlite_http, made)["state"] == "done"


def test_a_flat_mesh_is_refused_before_a_worker_sees_it(sqlite_http: httpx.Client) -> None:
    sqlite_http.post("/objects", json={"id": "sheet", "mass_kg": 0.1})
    sheet = b"v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0.1 0.1 0\nf 1 2 3\nf 2 4 3\n"
    stored = sqlite_http.put("/objects/sheet/mesh", content=sheet, headers={"Content-Type": "model/obj"})
    assert stored.status_code == 200
    answer = sqlite_http.post("/objects/sheet/sweeps", json={"grid": GRID})
    assert kind_of(answer) == (422, "mesh-flat")
    assert "PUT /objects/sheet/convex-parts" in answer.json()["title"]


def test_the_grid_that_waited_is_the_one_that_was_planned(sqlite_http: httpx.Client) -> None:
    add(sqlite_http)
    made = start(sqlite_http)
    put_result(sqlite_http, claim(sqlite_http)[0])
    chunks: list[dict[str, Any]] = claim(sqlite_http)
    grid = PoseGrid(**chunks[0]["payload"]["grid"])
    assert made["poses"] == grid.total == GRID["max_poses"]
    np.testing.assert_allclose(grid.upper, [0.02, 0.02, 0.07], atol=1e-7)
