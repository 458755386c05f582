"""Two engines over one plan: the sweep that stores, the one that compares, and what engines say of trials."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest

from graspdb.wire import OUTCOME_CODES
from graspdb_geometry.grids import PoseGrid
from graspdb_service.settings import Settings
from graspdb_service.storage.database import Database
from graspdb_service.usecases.reports.engines import reasons
from graspdb_service.usecases.upkeep import doctor

GRID = {"position_step_m": 0.02, "rotation_step_deg": 60.0, "max_poses": 240, "seed": 1}
DOWN = [1.0, 0.0, 0.0, 0.0]
ENGINES = {"pybullet": "pybullet 3.2.7", "mujoco": "mujoco 3.3.1"}
#: By the rest of the pose index by 7: what each engine says.
CODES = {
    "pybullet": np.array([1, 1, 6, 1, 3, 2, 6], dtype=np.uint8),
    "mujoco": np.array([1, 6, 6, 1, 1, 2, 6], dtype=np.uint8),
}


def work(http: httpx.Client, *engines: str, jobs: int = 10_000) -> list[dict[str, Any]]:
    """Be a worker that has these engines until nothing is left, or for so many jobs; the payloads."""
    done: list[dict[str, Any]] = []
    asked = {"worker": "+".join(engines) or "none", "capabilities": ["simulate", *engines]}
    while len(done) < jobs and (claimed := http.post("/jobs/claim", json=asked).json()["jobs"]):
        for job in claimed:
            payload = job["payload"]
            index = np.arange(payload["start"], payload["stop"])
            if payload["grid"]:
                index = PoseGrid(**payload["grid"]).pose_indices(payload["start"], payload["stop"])
            codes = CODES[payload["engine"] or "pybullet"][index % 7]
            rows = index[codes != OUTCOME_CODES["collision"]].tolist()
            body = {
                "outcomes": base64.b64encode(codes.tobytes()).decode(),
                "rows": {"pose_index": rows, "quality": [0.1] * len(rows), "width_m": [0.03] * len(rows)},
                "engine": ENGINES[payload["engine"] or "pybullet"],
            }
            put = http.put(f"/jobs/{job['id']}/result?lease_id={job['lease_id']}", json=body)
            assert put.status_code == 200, put.text
            done.append(payload)
    return done


@pytest.fixture(scope="module", params=["sqlite", "postgres"])
def service(
    request: pytest.FixtureRequest, serve_module: Callable[..., str], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[httpx.Client]:
    """A service on each database, all of whose counts agree with the rows when the tests are through."""
    url = f"sqlite:///{tmp_path_factory.mktemp('linked') / 'graspdb.sqlite'}"
    if request.param == "postgres":
        url = request.getfixturevalue("postgres_module_url")
    with httpx.Client(base_url=serve_module(url), timeout=60.0) as client:
        yield client
    database = Database(url)
    told = list(doctor.examine(database, Settings(database_url=url), {}))
    database.dispose()
    assert [item for item in told if item.level == "error"] == []


@pytest.fixture
def box(
    service: httpx.Client, make_object: Callable[..., str], put_box: Callable[..., Any]
) -> Iterator[httpx.Client]:
    """A service with the object ``box`` and no other, and nothing to do for workers."""
    put_box(service, make_object(service, "box", mass_kg=0.2))
    yield service
    for item in service.get("/objects").json()["items"]:
        for made in service.get("/sweeps", params={"object": item["id"]}).json()["items"]:
            service.post(f"/sweeps/{made['id']}/cancel")
        assert service.delete(f"/objects/{item['id']}").status_code == 204


def sweep(http: httpx.Client, slug: str = "box", **more: Any) -> dict[str, Any]:
    spec = {"grid": GRID, "chunk_poses": 60, "engine": "both", **more}
    answer = http.post(f"/objects/{slug}/sweeps", json=spec)
    assert answer.status_code == 202, answer.text
    made: dict[str, Any] = answer.json()
    return made


def info(http: httpx.Client, name: str) -> dict[str, Any]:
    found: dict[str, Any] = http.get(f"/sweeps/{name}").json()
    return found


def trials(http: httpx.Client, slug: str = "box") -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = http.get(f"/objects/{slug}/trials?limit=1000").json()["items"]
    return rows


def test_two_engines_simulate_the_same_poses_and_the_first_stores_them(box: httpx.Client) -> None:
    key = {"Idempotency-Key": "both-engines"}
    spec = {"grid": GRID, "chunk_poses": 60, "engine": "both"}
    first = box.post("/objects/box/sweeps", json=spec, headers=key).json()
    assert box.post("/objects/box/sweeps", json=spec, headers=key).json() == first
    other = info(box, first["linked"])
    assert (first["engine"], first["purpose"], other["linked"]) == ("pybullet", "collect", first["id"])
    assert (other["engine"], other["purpose"], other["poses"]) == ("mujoco", "compare", first["poses"])
    assert [item["id"] for item in box.get("/sweeps").json()["items"]] == [first["id"], other["id"]]
    created = [item["subject"] for item in box.get("/audit?action=sweep.create").json()["items"]]
    assert {first["id"], other["id"]} <= set(created)

    # Who has one engine takes what that simulates; who has both begins with what stores.
    assert {payload["sweep"] for payload in work(box, "mujoco", jobs=1)} == {other["id"]}
    assert box.get("/objects/box").json()["outcomes"] == {}
    assert {payload["sweep"] for payload in work(box, "pybullet", "mujoco", jobs=1)} == {first["id"]}
    before = box.get("/objects/box").json()
    assert work(box, "pybullet", "mujoco")
    told = [info(box, name) for name in (first["id"], other["id"])]
    assert [item["state"] for item in told] == ["done", "done"]
    assert [item["engines"] for item in told] == [["pybullet 3.2.7"], ["mujoco 3.3.1"]]
    assert told[0]["outcomes"]["success"] != told[1]["outcomes"]["success"]
    after = box.get("/objects/box").json()
    # What the other engine says changes what can be believed, so it is another revision, and no trial.
    assert after["revision"] == before["revision"] + 6
    assert after["outcomes"] == told[0]["outcomes"]
    assert {trial["sweep"] for trial in trials(box)} == {first["id"]}
    batch = box.get(f"/objects/box/batches/{other['batch']}").json()
    assert (batch["inserted"], batch["packed"], batch["outcomes"]) == (0, 240, told[1]["outcomes"])
    one = box.get(f"/sweeps/{first['id']}/outcomes?limit=1000").json()
    two = box.get(f"/sweeps/{other['id']}/outcomes?limit=1000").json()
    assert one["pose_index"] == two["pose_index"]
    assert one["position"] == two["position"]


def test_both_wait_for_workers(
    sqlite_http: httpx.Client, make_object: Callable[..., str], put_box: Callable[..., Any]
) -> None:
    put_box(sqlite_http, make_object(sqlite_http, "box", mass_kg=0.2))
    told = sweep(sqlite_http)["warnings"]
    assert [name for name in ENGINES if any(f"no worker that has {name}" in each for each in told)] == [
        *ENGINES
    ]
    sqlite_http.post("/jobs/claim", json={"worker": "w", "capabilities": ["pybullet", "mujoco"]})
    assert info(sqlite_http, sqlite_http.get("/sweeps").json()["items"][0]["id"])["warnings"] == []


def test_a_trial_says_which_engine_simulated_it(box: httpx.Client) -> None:
    made = sweep(box, engine=None)
    work(box)
    assert {trial["engine"] for trial in trials(box)} == {"pybullet 3.2.7"}
    batch = f"/objects/box/batches/{made['batch']}"
    assert box.get(batch).json()["engines"] == ["pybullet 3.2.7"]
    # Posted ones may say so, once for a batch or by trial; questions are about all of them.
    pose = {"position": [0, 0, 0.05], "quaternion_xyzw": DOWN}
    about = {"gripper": "pg70", "protocol": "wrench", "source": "simulation"}
    columns = {name: [value] * 3 for name, value in pose.items()} | {"outcome": [True, False, True]}
    told = {"columns": {**columns, "engine": ["gazebo", None, "mujoco 3.1"]}, "engine": "isaac 4.2", **about}
    assert box.post("/objects/box/trials", json=told).status_code == 201
    assert [trial["engine"] for trial in trials(box)[-3:]] == ["gazebo", "isaac 4.2", "mujoco 3.1"]
    newest = box.get("/objects/box/batches").json()["items"][-1]
    assert newest["engines"] == ["gazebo", "isaac 4.2", "mujoco 3.1"]
    density = box.get("/objects/box/density")
    assert density.status_code == 200, density.text
    assert density.json()["selection"]["sources"]["simulation"]["trials"] == 243
    rows = box.get("/reports/summary").json()["rows"]
    assert [(row["trials"], row["gripper"]) for row in rows] == [(243, "pg70")]
    refused = box.post("/objects/box/trials", json={**told, "columns": {**columns, "engine": ["X!"] * 3}})
    assert (refused.status_code, refused.json()["errors"][0]["field"]) == (422, "columns.engine.0")
    assert box.post("/objects/box/trials", json={**told, "engine": "Two Words 3"}).status_code == 422
    assert box.delete(batch).status_code == 204
    assert box.get("/objects/box").json()["outcomes"] == {"success": 2, "failure": 1}


def test_attempts_count_where_all_of_them_are_rows(box: httpx.Client) -> None:
    """The provenance of the sweep itself has no tally then."""
    poses = [{"position": [0, 0.001 * i, 0.05], "quaternion_xyzw": DOWN} for i in range(5)]
    sweep(box, grid=None, poses=poses)
    work(box, "pybullet")
    asked = {"poses": poses[:1], "gripper": "pg70"}
    likely = box.post("/objects/box/likelihood", json=asked).json()
    assert likely["support"]["nearest_attempt"]["position_m"][0] < 1e-9
    assert likely["support"]["effective_trials"][0] > 1.0


def likelihood(http: httpx.Client, poses: list[dict[str, Any]], slug: str = "box") -> dict[str, np.ndarray]:
    answer = http.post(f"/objects/{slug}/likelihood", json={"poses": poses, "gripper": "pg70"}).json()
    low, high = (np.array(answer["interval"][end], dtype=float) for end in ("low", "high"))
    told = {"low": low, "high": high, "p": np.array(answer["success_probability"], dtype=float)}
    return told | {"revision": answer["revision"]}


def test_disagreement_makes_a_probability_less_sure(
    box: httpx.Client, make_object: Callable[..., str], put_box: Callable[..., Any]
) -> None:
    """One attempt a pose, whatever came first; and what either engine alone says lies within."""
    places = np.random.default_rng(3).uniform((-0.01, -0.002, 0.045), (0.01, 0.002, 0.055), (140, 3))
    plan = {
        "poses": [{"position": place, "quaternion_xyzw": DOWN} for place in places.tolist()],
        "grid": None,
    }
    sweep(box, **plan)
    work(box, "pybullet")
    asked = plan["poses"][::7]
    before = likelihood(box, asked)
    work(box, "mujoco", jobs=1)
    some = likelihood(box, asked)
    work(box, "mujoco")
    after = likelihood(box, asked)
    assert before["revision"] < some["revision"] < after["revision"]
    for earlier, later in ((before, some), (some, after)):
        assert (later["high"] - later["low"]).sum() > (earlier["high"] - earlier["low"]).sum()
    # The same attempts in another order, and each engine alone.
    told = {}
    for slug, engine in (("other", "both"), ("alone-p", "pybullet"), ("alone-m", "mujoco")):
        put_box(box, make_object(box, slug, mass_kg=0.2))
        sweep(box, slug, engine=engine, **plan)
        work(box, "mujoco")
        work(box, "pybullet")
        told[slug] = likelihood(box, asked, slug)
    for name in ("low", "high", "p"):
        np.testing.assert_allclose(told["other"][name], after[name], atol=1e-6)
    assert (told["alone-p"]["p"] != told["alone-m"]["p"]).any()
    for alone in ("alone-p", "alone-m"):
        assert (after["low"] - 1e-9 <= told[alone]["p"]).all()
        assert (told[alone]["p"] <= after["high"] + 1e-9).all()
    np.testing.assert_allclose(told["alone-p"]["p"], before["p"], atol=1e-6)
    np.testing.assert_allclose(told["alone-p"]["high"], before["high"], atol=1e-6)
    mean = 0.5 * (told["alone-p"]["p"] + told["alone-m"]["p"])
    np.testing.assert_allclose(after["p"], mean, atol=1e-6)


def report(http: httpx.Client, slug: str = "box", **query: str) -> httpx.Response:
    answer = http.get(f"/objects/{slug}/reports/engines", params=query)
    while answer.status_code == 202:
        run = http.get(answer.headers["location"]).json()
        if run["state"] != "running":
            answer = http.get(f"/objects/{slug}/reports/engines", params=query)
    return answer


def test_the_report_says_on_which_grasps_engines_differ_and_why(box: httpx.Client) -> None:
    assert report(box).json()["type"].endswith(":linked-sweeps-needed")
    first = sweep(box)
    sweep(box, purpose="check", grid={**GRID, "max_poses": 60, "seed": 2})
    work(box, "pybullet")
    assert report(box).json()["type"].endswith(":linked-sweeps-needed")
    work(box, "mujoco")
    told = report(box).json()
    pair = next(item for item in told["pairs"] if item["sweep"] == first["id"])
    assert len(told["pairs"]) == 2
    assert pair["engines"] + pair["other_engines"] == [*ENGINES.values()]
    found = {
        item: box.get(f"/sweeps/{item}/outcomes?limit=1000").json() for item in (first["id"], first["linked"])
    }
    ours, theirs = (np.array(item["outcome"]) for item in found.values())
    same = (ours == "success") == (theirs == "success")
    free = (ours != "collision") | (theirs != "collision")
    assert (pair["poses"], pair["waiting"], pair["broken_off"]) == (240, 0, 0)
    assert pair["agreement"]["value"] == pytest.approx(same.mean())
    assert pair["agreement"]["low"] < same.mean() < pair["agreement"]["high"]
    assert pair["physics"] == free.sum() < 240
    assert pair["physics_agreement"]["value"] == pytest.approx(same[free].mean())
    assert sum(item["poses"] for item in pair["outcomes"]) == 240
    assert pair["disagreements"] == (~same).sum() == sum(item["poses"] for item in pair["reasons"])
    # By 0.1 of the weight the qualities are far from the limit of `wrench`, 1.
    assert {item["reason"] for item in pair["reasons"]} == {"edge", "unexplained"}
    index = found[first["id"]]["pose_index"]
    place = index.index(pair["first"][0]["pose_index"])
    assert place == np.flatnonzero(~same)[0]
    assert pair["first"][0]["position"] == pytest.approx(found[first["id"]]["position"][place])
    assert (pair["first"][0]["outcome"], pair["first"][0]["other_outcome"]) == (ours[place], theirs[place])
    assert pair["first"][0]["quality"] == pytest.approx(0.1)
    assert sum(len(item["first"]) for item in told["pairs"]) <= 100
    assert f"{same.mean():.1%}" in told["text"]
    assert report(box, protocol="lift").json()["type"].endswith(":linked-sweeps-needed")
    picture = box.get("/objects/box/reports/engines", headers={"Accept": "image/svg+xml"})
    assert picture.content.startswith(b"<?xml")


@pytest.mark.parametrize(
    ("protocol", "failed", "qualities", "why"),
    [
        ("wrench", "wrench_insufficient", (1.1, 0.95), "margin"),
        ("wrench", "wrench_insufficient", (2.0, 0.3), "unexplained"),
        ("wrench", "slipped", (2.0, float("nan")), "edge"),
        ("lift", "slipped", (0.9, -0.1), "margin"),
        ("lift", "dropped", (0.9, -3.0), "edge"),
        # Squeezed out while the jaw closed: nothing was carried.
        ("lift", "slipped", (0.9, 0.0), "edge"),
        ("shake", "timeout", (0.1, 0.1), "timeout"),
    ],
)
def test_reasons(protocol: str, failed: str, qualities: tuple[float, float], why: str) -> None:
    one = reasons.Said("pybullet", "success", qualities[0], 0.03)
    two = reasons.Said("mujoco", failed, qualities[1], float("nan"))
    assert reasons.reason(protocol, one, two) == reasons.reason(protocol, two, one) == why
    assert "success in pybullet" in reasons.words(protocol, one, two)


@pytest.mark.parametrize(("won", "other", "why"), [(5, 4, "draws"), (6, 4, "draws"), (9, 2, "edge")])
def test_reasons_of_draws(won: int, other: int, why: str) -> None:
    one = reasons.Said("pybullet", "success", 2.0, 0.03, won, 10)
    two = reasons.Said("mujoco", "slipped", float("nan"), 0.01, other, 10)
    assert reasons.reason("wrench", one, two) == why
    assert f"({won} of 10" in reasons.words("wrench", one, two)


def test_what_is_done_to_one_of_two_is_done_to_both(box: httpx.Client) -> None:
    first = sweep(box)
    place = f"/objects/box/batches/{first['batch']}"
    other = info(box, first["linked"])
    work(box, "pybullet")
    assert box.delete(place).json()["type"].endswith(":sweep-running")
    box.post(f"/sweeps/{first['id']}/cancel")
    # Each has a state of its own: what was done stays done.
    assert [info(box, s["id"])["state"] for s in (first, other)] == ["done", "cancelled"]
    box.post(f"/sweeps/{first['id']}/retry")
    assert info(box, other["id"])["state"] == "queued"
    box.post(f"/sweeps/{other['id']}/cancel")
    box.post(f"/sweeps/{other['id']}/retry")
    work(box, "mujoco", jobs=2)
    box.post(f"/sweeps/{other['id']}/cancel")

    # Who takes back what was compared leaves the trials; who takes these back leaves nothing.
    outcomes = box.get("/objects/box").json()["outcomes"]
    epoch = box.get("/objects/box").json()["epoch"]
    assert box.delete(f"/objects/box/batches/{other['batch']}").status_code == 204
    assert box.get("/objects/box").json()["outcomes"] == outcomes
    assert box.get("/objects/box").json()["epoch"] > epoch
    assert box.post(f"/sweeps/{other['id']}/retry").json()["type"].endswith(":batch-deleted")
    assert box.post(f"/sweeps/{first['id']}/retry").json()["state"] == "done"
    again = sweep(box, grid={**GRID, "seed": 2})
    work(box, "pybullet", "mujoco")
    for made in (first, again):
        assert box.delete(f"/objects/box/batches/{made['batch']}").status_code == 204
    left = box.get("/objects/box").json()
    assert (left["outcomes"], left["trials"]) == ({}, 0)
    assert box.get("/objects/box/batches").json()["items"] == []
    deleted = [item["subject"] for item in box.get("/audit?action=batch.delete").json()["items"]]
    pairs = [(made["batch"], info(box, made["linked"])["batch"]) for made in (first, again)]
    assert {key for pair in pairs for key in pair} <= set(deleted)
    assert len(deleted) == len(set(deleted))


def test_a_check_by_both_changes_nothing(box: httpx.Client) -> None:
    before = box.get("/objects/box").json()
    first = sweep(box, purpose="check")
    assert (first["purpose"], info(box, first["linked"])["purpose"]) == ("check", "compare")
    work(box, "pybullet", "mujoco")
    assert box.get("/objects/box").json() == before
    assert box.delete(f"/objects/box/batches/{first['batch']}").status_code == 204
    assert box.get("/objects/box").json() == before


def test_copies_are_linked_with_each_other(box: httpx.Client) -> None:
    first = sweep(box)
    sweep(box, purpose="check")
    work(box, "pybullet", "mujoco")
    assert box.post("/objects/box/copies", json={"id": "copy", "trials": True}).status_code == 201
    copies = {item["id"]: item for item in box.get("/sweeps?object=copy").json()["items"]}
    assert sorted(item["purpose"] for item in copies.values()) == ["collect", "compare"]
    assert all(copies[item["linked"]]["linked"] == name for name, item in copies.items())
    assert {trial["engine"] for trial in trials(box, "copy")} == {"pybullet 3.2.7"}
    collected = next(item for item in copies.values() if item["purpose"] == "collect")
    assert collected["outcomes"] == info(box, first["id"])["outcomes"]
    assert box.delete(f"/objects/copy/batches/{collected['batch']}").status_code == 204
    assert box.get("/objects/copy/batches").json()["items"] == []
    assert len(trials(box)) == sum(
        n for name, n in info(box, first["id"])["outcomes"].items() if name != "collision"
    )
