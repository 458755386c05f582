"""Sweeps over HTTP: what is checked before a worker starts, what workers are told, what counts."""

from __future__ import annotations

import base64
import hashlib
import re
import struct
import threading
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES, OUTCOMES
from graspdb_geometry.grids import PoseGrid

GRID = {"position_step_m": 0.02, "rotation_step_deg": 60.0, "margin_m": 0.0}
BOX = {"lower": (-0.02, -0.02, -0.05), "upper": (0.02, 0.02, 0.05)}
GRID_POSES = 45 * 36


def box_stl(size: tuple[float, float, float], shift: float = 0.0) -> bytes:
    """Triangles of a box about the origin, moved along x, without the STL's header."""
    corner = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    corner[:, 0] += shift
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return b"".join(struct.pack("<12fH", 0, 0, 0, *corner[list(t)].ravel(), 0) for t in triangles)


def stl(*bodies: bytes) -> bytes:
    content = b"".join(bodies)
    return b"\0" * 80 + struct.pack("<I", len(content) // 50) + content


def put_mesh(http: httpx.Client, slug: str, content: bytes, unit: str = "m") -> None:
    answer = http.put(
        f"/objects/{slug}/mesh", params={"unit": unit}, content=content, headers={"Content-Type": "model/stl"}
    )
    assert answer.status_code in (200, 201), answer.text


def add_box(http: httpx.Client, slug: str = "box", **properties: Any) -> str:
    made = http.post("/objects", json={"id": slug, **({"mass_kg": 0.3} | properties)})
    assert made.status_code == 201, made.text
    put_mesh(http, slug, stl(box_stl((0.04, 0.04, 0.1))))
    return slug


def start(http: httpx.Client, slug: str = "box", **spec: Any) -> dict[str, Any]:
    answer = http.post(f"/objects/{slug}/sweeps", json=spec)
    assert answer.status_code == 202, answer.text
    assert answer.headers["location"] == f"/sweeps/{answer.json()['id']}"
    made: dict[str, Any] = answer.json()
    return made


def codes_of(positions: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Made-up outcomes that depend on the position alone, collisions among them."""
    key = np.rint(np.asarray(positions).reshape(-1, 3) * 1e6).astype(np.int64) @ np.array([7, 31, 131])
    return np.array([1, 2, 4, 2, 6], dtype=np.uint8)[key % 5]


def work(http: httpx.Client, limit: int = 64, jobs: int | None = None) -> list[dict[str, Any]]:
    """Be a worker until nothing is left, or for so many jobs; the payloads."""
    done: list[dict[str, Any]] = []
    while jobs is None or len(done) < jobs:
        most = limit if jobs is None else min(limit, jobs - len(done))
        claimed = http.post("/jobs/claim", json={"worker": "w", "limit": most}).json()["jobs"]
        if not claimed:
            break
        for job in claimed:
            payload = job["payload"]
            if payload["grid"]:
                grid = PoseGrid(**payload["grid"])
                index = grid.pose_indices(payload["start"], payload["stop"])
                codes = codes_of(grid.poses(index)[0])
            else:
                index = np.arange(payload["start"], payload["stop"])
                codes = codes_of(np.array(payload["poses"]["position"]))
            physics = index[codes != OUTCOME_CODES["collision"]].tolist()
            answer = http.put(
                f"/jobs/{job['id']}/result",
                params={"lease_id": job["lease_id"]},
                json={
                    "outcomes": base64.b64encode(codes.tobytes()).decode(),
                    "rows": {
                        "pose_index": physics,
                        "width_m": [None] * len(physics),
                        "quality": [0.5] * len(physics),
                    },
                },
            )
            assert answer.status_code == 200, answer.text
            done.append(payload)
    return done


def trials(http: httpx.Client, slug: str = "box") -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = []
    cursor = None
    while True:
        page = http.get(
            f"/objects/{slug}/trials", params={"limit": 1_000, **({"cursor": cursor} if cursor else {})}
        ).json()
        items += page["items"]
        cursor = page["next"]
        if cursor is None:
            return items


def outcomes(http: httpx.Client, sweep: str, limit: int) -> dict[str, list[Any]]:
    """Every page of a sweep's outcomes, joined."""
    joined: dict[str, list[Any]] = {}
    cursor = None
    while True:
        answer = http.get(
            f"/sweeps/{sweep}/outcomes", params={"limit": limit, **({"cursor": cursor} if cursor else {})}
        )
        assert answer.status_code == 200, answer.text
        page = answer.json()
        assert len(page["pose_index"]) <= limit
        for name in ("pose_index", "position", "quaternion_xyzw", "outcome"):
            joined.setdefault(name, []).extend(page[name])
        cursor = page["next"]
        if cursor is None:
            return joined


def problem(answer: httpx.Response) -> tuple[int, str, list[str]]:
    body = answer.json()
    return answer.status_code, body["type"].rsplit(":", 1)[1], [e["field"] for e in body.get("errors", [])]


# --- planning -------------------------------------------------------------------------------------------


def test_the_default_is_the_grid_of_the_whole_object(sqlite_http: httpx.Client) -> None:
    add_box(sqlite_http)
    answer = sqlite_http.post("/objects/box/sweeps")
    assert answer.status_code == 202, answer.text
    info = answer.json()
    # 9 x 9 x 15 positions in 10 mm steps with a 20 mm margin, half of 4,608 rotations.
    grid = {name: value for name, value in info["grid"].items() if value is not None}
    assert grid == {"position_step_m": 0.01, "rotation_step_deg": 15, "margin_m": 0.02, "seed": 0}
    assert (info["plan"], info["poses"], info["full_grid_poses"]) == ("grid", 1215 * 2304, 1215 * 4608)
    assert (info["gripper"], info["protocol"], info["purpose"]) == ("pg70", "wrench", "collect")
    assert (info["state"], info["poses_done"], info["outcomes"]) == ("queued", 0, {})
    assert sqlite_http.get(f"/sweeps/{info['id']}").json() == info


def test_a_key_makes_one_sweep(http: httpx.Client) -> None:
    add_box(http)
    spec = {"grid": GRID}
    first, again = (
        http.post("/objects/box/sweeps", json=spec, headers={"Idempotency-Key": "k"}) for _ in range(2)
    )
    assert first.status_code == again.status_code == 202
    assert first.json() == again.json()
    assert first.headers["location"] == again.headers["location"]
    assert len(http.get("/sweeps").json()["items"]) == 1
    other = http.post("/objects/box/sweeps", json={}, headers={"Idempotency-Key": "k"})
    assert problem(other)[:2] == (422, "idempotency-key-reused")
    work(http)
    assert http.delete(f"/objects/box/batches/{first.json()['batch']}").status_code == 204
    gone = http.post("/objects/box/sweeps", json=spec, headers={"Idempotency-Key": "k"})
    assert gone.status_code == 409


def test_what_an_object_lacks_is_said(sqlite_http: httpx.Client) -> None:
    http = sqlite_http
    assert http.post("/objects/ghost/sweeps", json={}).status_code == 404
    http.post("/objects", json={"id": "bare"})
    assert problem(http.post("/objects/bare/sweeps", json={}))[:2] == (409, "mesh-missing")
    put_mesh(http, "bare", stl(box_stl((0.02, 0.02, 0.1)), box_stl((0.02, 0.02, 0.1), 0.06)))
    assert problem(http.post("/objects/bare/sweeps", json={}))[2] == ["mass_kg"]
    http.post("/objects", json={"id": "massless"})
    put_mesh(http, "massless", stl(box_stl((0.04, 0.04, 0.1))))
    assert problem(http.post("/objects/massless/sweeps", json={}))[2] == ["mass_kg"]
    http.patch("/objects/massless", json={"density_kg_m3": 1_000})
    start(http, "massless", grid=GRID)
    assert work(http)[0]["mass_kg"] == pytest.approx(0.16, rel=1e-3)


def test_a_mesh_in_the_wrong_unit_is_noticed(sqlite_http: httpx.Client) -> None:
    sqlite_http.post("/objects", json={"id": "giant", "mass_kg": 1})
    put_mesh(sqlite_http, "giant", stl(box_stl((4.0, 4.0, 9.0))))
    answer = sqlite_http.post("/objects/giant/sweeps", json={"grid": {"max_poses": 100}})
    assert problem(answer) == (422, "mesh-size", ["mesh"])
    title = answer.json()["title"]
    assert "sent with unit=m;" in title
    assert "0.09 m with unit=cm" in title or "0.229 m with unit=in" in title
    assert "unit=mm" not in title
    put_mesh(sqlite_http, "giant", stl(box_stl((4.0, 4.0, 9.0))), unit="cm")
    start(sqlite_http, "giant", grid={"max_poses": 100})
    # As small as this no unit helps that it could have been sent in.
    put_mesh_again = {"id": "speck", "mass_kg": 1}
    sqlite_http.post("/objects", json=put_mesh_again)
    put_mesh(sqlite_http, "speck", stl(box_stl((0.4, 0.4, 0.5))), unit="mm")
    title = sqlite_http.post("/objects/speck/sweeps", json={}).json()["title"]
    assert "far too small" in title
    assert "unit=m:" in title or "unit=m " in title


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"tip_offset_m": 0.2}, "gripper"),
        ({"max_opening_m": 5e-4}, "gripper"),
        ({"max_speed_m_s": 1e-6}, "gripper"),
        ({"max_speed_m_s": 5}, "gripper"),
        ({"max_acceleration_m_s2": 1e-9}, "gripper"),
        ({"force_n": 1e-6}, "gripper"),
        ({"finger_mass_kg": 1e-9}, "gripper"),
        ({"finger": {"width_m": 2e-5, "thickness_m": 0.01, "length_m": 0.05}}, "gripper"),
    ],
)
def test_a_degenerate_gripper_is_refused(
    sqlite_http: httpx.Client, change: dict[str, Any], field: str
) -> None:
    add_box(sqlite_http)
    profile = {
        "max_opening_m": 0.08,
        "finger": {"width_m": 0.02, "thickness_m": 0.01, "length_m": 0.05},
        "palm_size_m": [0.06, 0.2, 0.06],
    }
    made = sqlite_http.post("/grippers", json={"id": "odd", **profile, **change})
    # Some are refused at the door already.
    assert made.status_code in (201, 422)
    answer = sqlite_http.post("/objects/box/sweeps", json={"grid": GRID, "gripper": "odd"})
    assert problem(answer)[0] == 422
    assert problem(answer)[2] == [field]
    if made.status_code == 201:
        # It names what is wrong, and the bound.
        (changed,) = change
        assert changed in answer.text
        assert "below" in answer.text or "above" in answer.text or changed == "tip_offset_m"


@pytest.mark.parametrize("given", ["mass_kg", "density_kg_m3"])
def test_an_object_lighter_than_a_gram_is_refused(sqlite_http: httpx.Client, given: str) -> None:
    http = sqlite_http
    add_box(http)
    other = "density_kg_m3" if given == "mass_kg" else "mass_kg"
    for bad in (0, -1, "NaN", "Infinity"):
        body = f'{{"{given}": {bad}}}'
        answer = http.patch("/objects/box", content=body, headers={"Content-Type": "application/json"})
        assert answer.status_code == 422, bad
    assert http.patch("/objects/box", json={given: 1e-9, other: None}).status_code == 200
    answer = http.post("/objects/box/sweeps", json={"grid": GRID})
    assert problem(answer)[::2] == (422, [given])
    assert "below 0.001 kg" in answer.text
    http.patch("/objects/box", json={given: 0.5 if given == "mass_kg" else 1_000})
    start(http, "box", grid=GRID)


GIVEN = {"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}

BAD_REQUESTS: list[tuple[dict[str, Any], str]] = [
    ({"gripper": "none-such"}, "gripper"),
    ({"grid": {"region": {"lower": [1, 1, 1], "upper": [2, 2, 2]}}}, "grid.region"),
    ({"grid": {"region": {"lower": [1, 1, 1], "upper": [0, 0, 0]}}}, "grid.region"),
    (
        {"grid": {"position_step_m": 0.3, "region": {"lower": [0.01] * 3, "upper": [0.02] * 3}}},
        "grid.region",
    ),
    ({"grid": {"position_step_m": 0}}, "grid.position_step_m"),
    ({"grid": {"rotation_step_deg": 1}}, "grid.rotation_step_deg"),
    ({"grid": {"max_poses": 0}}, "grid.max_poses"),
    ({"grid": {"seed": -1}}, "grid.seed"),
    ({"grid": {"steps": 3}}, "grid.steps"),
    ({"grid": GRID, "sample": {"count": 3}}, "body"),
    ({"poses": []}, "poses"),
    ({"poses": [{"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 0]}]}, "poses"),
    ({"poses": {"position": [[0, 0, 0]], "quaternion_xyzw": []}}, "poses"),
    ({"poses": [GIVEN], "proposal_density": [1.0, 2.0]}, "proposal_density"),
    ({"poses": [GIVEN], "proposal_density": 0}, "proposal_density"),
    ({"proposal_density": 1.0}, "body"),
    ({"grid": GRID, "chunk_poses": 0}, "chunk_poses"),
    ({"grid": {"position_step_m": 0.005}, "chunk_poses": 1}, "chunk_poses"),
    ({"protocol": "juggle"}, "protocol"),
    ({"sample": {"count": 2_000_000}}, "sample.count"),
    ({"grips": 1}, "grips"),
]


def test_a_bad_request_names_its_field(sqlite_http: httpx.Client) -> None:
    add_box(sqlite_http)
    for spec, field in BAD_REQUESTS:
        answer = sqlite_http.post("/objects/box/sweeps", json=spec)
        assert answer.status_code == 422, (spec, answer.text)
        assert any(found.startswith(field) for found in problem(answer)[2]), (spec, answer.text)
    for number in ("NaN", "Infinity", "1e999"):
        body = f'{{"grid": {{"margin_m": {number}}}}}'
        answer = sqlite_http.post(
            "/objects/box/sweeps", content=body, headers={"Content-Type": "application/json"}
        )
        assert answer.status_code == 422, number
    assert sqlite_http.get("/sweeps").json()["items"] == []


def test_more_poses_than_a_sweep_takes_are_told_as_such(serve: Any, sqlite_url: str) -> None:
    with httpx.Client(base_url=serve(sqlite_url, max_samples=2), timeout=60) as http:
        add_box(http)
        for spec, field in (({"poses": [GIVEN] * 3}, "poses"), ({"sample": {"count": 3}}, "sample.count")):
            answer = http.post("/objects/box/sweeps", json=spec)
            assert problem(answer) == (422, "too-many-poses", [field])
            assert answer.json()["limit"] == 2
            assert "several sweeps" in answer.json()["title"]


def test_a_grid_over_the_limit_says_how_to_shrink_it(serve: Any, sqlite_url: str) -> None:
    with httpx.Client(base_url=serve(sqlite_url, max_sweep_poses=10_000), timeout=60) as http:
        add_box(http)
        answer = http.post("/objects/box/sweeps", json={})
        assert problem(answer) == (422, "too-many-poses", ["grid"])
        title = answer.json()["title"]
        assert "max_poses=10000" in title
        assert "unit" not in title
        # What is named is enough by itself, and the step before would not be.
        step = float(re.search(r"position_step_m=([\d.]+)", title)[1])  # type: ignore[index]
        too_fine = http.post("/objects/box/sweeps", json={"grid": {"position_step_m": step - 0.001}})
        assert problem(too_fine)[1] == "too-many-poses"
        start(http, grid={"position_step_m": step})
        start(http, grid={"max_poses": 10_000})


def test_every_way_to_shrink_a_grid_is_enough(serve: Any, sqlite_url: str) -> None:
    with httpx.Client(base_url=serve(sqlite_url, max_sweep_poses=1_000_000), timeout=60) as http:
        add_box(http)
        title = http.post("/objects/box/sweeps", json={}).json()["title"]
        ways = dict(re.findall(r"(position_step_m|rotation_step_deg|margin_m)=([\d.]+)", title))
        assert set(ways) == {"position_step_m", "rotation_step_deg", "margin_m"}
        for field, value in ways.items():
            start(http, grid={field: float(value)})


def test_a_large_grid_of_a_large_object_asks_about_the_unit(sqlite_http: httpx.Client) -> None:
    sqlite_http.post("/objects", json={"id": "duck", "mass_kg": 1})
    put_mesh(sqlite_http, "duck", stl(box_stl((1.2, 1.5, 1.6))))
    answer = sqlite_http.post("/objects/duck/sweeps", json={})
    assert problem(answer)[1] == "too-many-poses"
    assert "unit wrong? It is 1.6 m long" in answer.json()["title"]


def test_thousands_of_jobs_are_made_at_once(http: httpx.Client) -> None:
    add_box(http)
    info = start(http, grid={"position_step_m": 0.01}, chunk_poses=500)
    assert info["chunks"] == -(-1215 * 2304 // 500) == 5599
    assert http.get(f"/sweeps/{info['id']}").json()["chunks"] == 5599


# --- what workers are told, what counts -----------------------------------------------------------------


def test_a_sweep_keeps_the_world_it_was_made_in(http: httpx.Client) -> None:
    add_box(http, friction=0.7)
    info = start(http, grid=GRID)
    assert http.patch("/objects/box", json={"mass_kg": 9, "friction": 0.1}).status_code == 200
    payload = work(http, jobs=1)[0]
    assert (payload["mass_kg"], payload["friction"]) == (0.3, 0.7)
    parts = http.get(payload["convex_parts"])
    assert parts.status_code == 200
    assert hashlib.sha256(parts.content).hexdigest() == payload["parts_sha256"]
    assert payload["sweep"] == info["id"]
    replaced = http.put(
        "/objects/box/mesh", content=stl(box_stl((0.05, 0.04, 0.1))), headers={"Content-Type": "model/stl"}
    )
    assert replaced.status_code == 409


def test_an_asymmetric_gripper_sweeps_both_of_each_pair(sqlite_http: httpx.Client) -> None:
    add_box(sqlite_http)
    profile = sqlite_http.get("/grippers/pg70").json()["profile"]
    sqlite_http.post("/grippers", json={**profile, "id": "handed", "symmetric": False})
    info = start(sqlite_http, grid=GRID, gripper="handed")
    assert info["poses"] == info["full_grid_poses"] == 2 * GRID_POSES


def test_given_poses_are_simulated_in_their_order(http: httpx.Client) -> None:
    add_box(http)
    rng = np.random.default_rng(5)
    position = rng.normal(size=(70, 3)) * 0.05
    quaternion = rng.normal(size=(70, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    columns = {"position": position.tolist(), "quaternion_xyzw": quaternion.tolist()}
    info = start(http, poses=columns, chunk_poses=30)
    payloads = work(http)
    assert [(p["start"], p["stop"]) for p in payloads] == [(0, 30), (30, 60), (60, 70)]
    told = np.concatenate([p["poses"]["position"] for p in payloads])
    np.testing.assert_array_equal(told, position)
    found = outcomes(http, info["id"], 100_000)
    assert found["pose_index"] == list(range(70))
    np.testing.assert_array_equal(found["position"], position)
    np.testing.assert_allclose(found["quaternion_xyzw"], quaternion, atol=1e-15)
    assert found["outcome"] == [OUTCOMES[code] for code in codes_of(position)]
    stored = trials(http)
    kept = codes_of(position) != OUTCOME_CODES["collision"]
    assert [trial["pose_index"] for trial in stored] == np.flatnonzero(kept).tolist()
    np.testing.assert_array_equal([trial["position"] for trial in stored], position[kept])
    # Nobody drew them, so they have no density to be weighted by.
    assert {trial["proposal_density"] for trial in stored} == {None}


@pytest.mark.parametrize("each", [True, False])
def test_given_poses_keep_the_density_they_were_drawn_with(sqlite_http: httpx.Client, each: bool) -> None:
    add_box(sqlite_http)
    position = np.linspace([-0.1, 0.0, 0.0], [0.1, 0.0, 0.0], 30)
    columns = {"position": position.tolist(), "quaternion_xyzw": [[0, 0, 0, 1]] * 30}
    densities = [None, *np.linspace(1.0, 2.0, 29).tolist()] if each else [3.0] * 30
    start(sqlite_http, poses=columns, proposal_density=densities if each else 3.0)
    work(sqlite_http)
    stored = trials(sqlite_http)
    assert stored
    for trial in stored:
        assert trial["proposal_density"] == densities[trial["pose_index"]]


def test_a_list_of_poses_may_hold_matrices(sqlite_http: httpx.Client) -> None:
    add_box(sqlite_http)
    matrix = [[1, 0, 0, 0.1], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
    start(sqlite_http, poses=[{"matrix": matrix}])
    payload = work(sqlite_http)[0]
    assert payload["poses"]["position"] == [[0.1, 0, 0]]
    np.testing.assert_allclose(payload["poses"]["quaternion_xyzw"], [[0.5**0.5, 0, 0, 0.5**0.5]])


def test_draws_carry_the_density_they_were_drawn_with(
    http: httpx.Client, two_clusters: Any, post: Any
) -> None:
    add_box(http)
    assert problem(http.post("/objects/box/sweeps", json={"sample": {"count": 5}}))[0] == 409
    post(http, "box", two_clusters, gripper="pg70", protocol="wrench")
    asked = {"count": 40, "seed": 11}
    drawn = http.post("/objects/box/samples", json={**asked, "gripper": "pg70"}).json()
    info = start(http, sample=asked)
    assert (info["plan"], info["poses"], info["seed"]) == ("sample", 40, 11)
    payloads = work(http)
    told = np.concatenate([p["poses"]["position"] for p in payloads])
    np.testing.assert_allclose(told, drawn["position"], atol=1e-12)
    stored = [trial for trial in trials(http) if trial["sweep"] == info["id"]]
    assert stored
    for trial in stored:
        expected = drawn["proposal_density"][trial["pose_index"]]
        assert trial["proposal_density"] == pytest.approx(expected, rel=1e-9)


def test_a_check_is_stored_but_counts_nowhere(http: httpx.Client) -> None:
    add_box(http)
    grid = start(http, grid=GRID, chunk_poses=500)
    work(http, jobs=1)
    before = http.get("/objects/box").json()
    check = start(http, grid={**GRID, "max_poses": 200}, purpose="check", fidelity="fine")
    # Somebody waits for a check: it goes before the grid that is running.
    payload = work(http, jobs=1)[0]
    assert (payload["sweep"], payload["fidelity"]) == (check["id"], "fine")
    after = http.get("/objects/box").json()
    assert (after["revision"], after["outcomes"]) == (before["revision"], before["outcomes"])
    done = http.get(f"/sweeps/{check['id']}").json()
    assert (done["state"], sum(done["outcomes"].values())) == ("done", 200)
    assert len(outcomes(http, check["id"], 1_000)["outcome"]) == 200
    assert {trial["sweep"] for trial in trials(http)} == {grid["id"]}
    batch = http.get(f"/objects/box/batches/{check['batch']}").json()
    assert (batch["inserted"], batch["outcomes"]) == (0, done["outcomes"])
    assert http.delete(f"/objects/box/batches/{check['batch']}").status_code == 204
    assert http.get("/objects/box").json()["outcomes"] == before["outcomes"]


def test_outcomes_come_in_pages_collisions_included(http: httpx.Client) -> None:
    add_box(http)
    info = start(http, grid=GRID, chunk_poses=333)
    assert outcomes(http, info["id"], 10) == {
        "pose_index": [],
        "position": [],
        "quaternion_xyzw": [],
        "outcome": [],
    }
    work(http)
    grid = PoseGrid(**BOX, **GRID)
    index = grid.pose_indices(0, grid.total)
    position, quaternion = grid.poses(index)
    for limit in (100_000, 333, 100):
        found = outcomes(http, info["id"], limit)
        assert found["pose_index"] == index.tolist()
        np.testing.assert_array_equal(found["position"], position)
        np.testing.assert_array_equal(found["quaternion_xyzw"], quaternion)
        assert found["outcome"] == [OUTCOMES[code] for code in codes_of(position)]
    bad = http.get(f"/sweeps/{info['id']}/outcomes", params={"cursor": "zzz"})
    assert problem(bad) == (422, "invalid-request", ["cursor"])


def test_sweeps_are_listed_newest_first_and_filtered(http: httpx.Client) -> None:
    add_box(http)
    add_box(http, "other")
    first = start(http, grid=GRID)
    work(http)
    second = start(http, "other", grid={**GRID, "max_poses": 50})
    third = start(http, grid={**GRID, "max_poses": 50, "seed": 1})

    def ids(**filters: Any) -> list[str]:
        found: list[str] = []
        cursor = None
        while True:
            extra = {"cursor": cursor} if cursor else {}
            page = http.get("/sweeps", params={**filters, **extra}).json()
            found += [item["id"] for item in page["items"]]
            cursor = page["next"]
            if cursor is None:
                return found

    assert ids() == ids(limit=1) == [third["id"], second["id"], first["id"]]
    assert ids(object="box") == [third["id"], first["id"]]
    assert ids(state="queued") == [third["id"], second["id"]]
    assert ids(state="done") == [first["id"]]
    http.post(f"/sweeps/{third['id']}/cancel")
    assert ids(state="cancelled", object="box") == [third["id"]]
    assert ids(state="running") == ids(state="failed") == []
    assert http.get("/sweeps", params={"object": "ghost"}).status_code == 404
    assert problem(http.get("/sweeps", params={"state": "asleep"}))[2] == ["state"]
    assert http.get("/sweeps/none").status_code == 404
    assert http.post("/sweeps/none/cancel").status_code == 404


def test_progress_shows_a_rate_and_the_time_left(http: httpx.Client) -> None:
    add_box(http)
    info = start(http, grid=GRID, chunk_poses=500)
    work(http, jobs=2)
    now = http.get(f"/sweeps/{info['id']}").json()
    assert (now["state"], now["chunks_done"], now["poses_done"]) == ("running", 2, 1_000)
    assert now["rate_poses_s"] > 0
    assert now["time_left_s"] == pytest.approx((GRID_POSES - 1_000) / now["rate_poses_s"])
    assert now["started_at"] >= now["created_at"]
    work(http)
    done = http.get(f"/sweeps/{info['id']}").json()
    assert done["time_left_s"] is None
    assert done["finished_at"] >= done["started_at"]


# --- repeats --------------------------------------------------------------------------------------------


def counted(http: httpx.Client) -> dict[str, int]:
    found: dict[str, int] = http.get("/objects/box").json()["outcomes"]
    return found


def expected_counts(*grids: PoseGrid) -> dict[str, int]:
    """Outcomes of the poses of several grids together, each pose index once."""
    index = np.unique(np.concatenate([grid.pose_indices(0, grid.total) for grid in grids]))
    codes, numbers = np.unique(codes_of(grids[0].poses(index)[0]), return_counts=True)
    return {OUTCOMES[code]: int(number) for code, number in zip(codes, numbers, strict=True)}


@pytest.mark.parametrize(
    "plans",
    [
        [{"max_poses": 400, "seed": 3}, {"max_poses": 900, "seed": 3}],
        [{"max_poses": 400, "seed": 3}, {"max_poses": 400, "seed": 4}, {}],
        [{"region": {"lower": [-1, -1, -1], "upper": [1, 1, 0]}}, {}],
        [{}, {"region": {"lower": [-1, -1, -1], "upper": [1, 1, 0]}}, {"max_poses": 70}],
        [{}, {}],
    ],
    ids=["growing", "seeds", "region-first", "region-later", "same"],
)
def test_repeats_of_a_pose_count_once(http: httpx.Client, plans: list[dict[str, Any]]) -> None:
    add_box(http)
    grids, batches = [], []
    for number, plan in enumerate(plans):
        info = start(http, grid={**GRID, **plan}, chunk_poses=130)
        work(http)
        region = plan.get("region")
        box = None if region is None else (tuple(region["lower"]), tuple(region["upper"]))
        grids.append(PoseGrid(**BOX, **GRID, **{**plan, "region": box}))
        batches.append(info["batch"])
        assert counted(http) == expected_counts(*grids), f"after sweep {number}"
        index = [trial["pose_index"] for trial in trials(http)]
        assert len(index) == len(set(index))
        # The sweep itself still tells all that was simulated.
        assert len(outcomes(http, info["id"], 100_000)["outcome"]) == grids[-1].total
    # Whatever the last one added goes with its batch, and nothing else.
    assert http.delete(f"/objects/box/batches/{batches[-1]}").status_code == 204
    assert counted(http) == expected_counts(*grids[:-1])


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (0, 2, 1)])
def test_deleting_a_sweep_leaves_what_others_repeated(http: httpx.Client, order: tuple[int, ...]) -> None:
    """Stored once by whoever finished a pose first, and left while anybody who has simulated it stays."""
    add_box(http)
    region = {"lower": [-1, -1, -1], "upper": [1, 1, 0]}
    plans: list[dict[str, Any]] = [{"max_poses": 400, "seed": 3}, {}, {"region": region}]
    infos, grids = [], []
    for plan in plans:
        infos.append(start(http, grid={**GRID, **plan}, chunk_poses=130))
        work(http)
        box = (tuple(region["lower"]), tuple(region["upper"])) if "region" in plan else None
        grids.append(PoseGrid(**BOX, **GRID, **{**plan, "region": box}))
    left = [0, 1, 2]
    for number in order:
        assert http.delete(f"/objects/box/batches/{infos[number]['batch']}").status_code == 204
        left.remove(number)
        remaining = [grids[i] for i in left]
        assert counted(http) == (expected_counts(*remaining) if left else {})
        rows = trials(http)
        index = [trial["pose_index"] for trial in rows]
        assert len(index) == len(set(index))
        own = {infos[i]["id"] for i in left}
        assert {trial["sweep"] for trial in rows} <= own
        # Batches hold what is left between them, and a row keeps what was measured.
        held = [http.get(f"/objects/box/batches/{infos[i]['batch']}").json() for i in left]
        assert sum(batch["inserted"] for batch in held) == len(rows)
        assert sum(sum(batch["outcomes"].values()) for batch in held) == sum(counted(http).values())
        assert sum(batch["inserted"] + batch["packed"] for batch in held) == sum(counted(http).values())
        assert {trial["quality"] for trial in rows} <= {0.5}
        for batch in held:
            assert len(
                http.get(f"/objects/box/trials?batch={batch['batch']}&limit=1000").json()["items"]
            ) == (min(batch["inserted"], 1_000))
        size = http.get("/objects/box/density").json()["size"]
        assert size == counted(http).get("success", 0)


def test_two_sweeps_over_one_grid_at_once_store_each_pose_once(http: httpx.Client) -> None:
    add_box(http)
    for _ in range(2):
        start(http, grid=GRID, chunk_poses=100)

    def run() -> None:
        with httpx.Client(base_url=http.base_url, timeout=60) as client:
            work(client, limit=2)

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    grid = PoseGrid(**BOX, **GRID)
    assert counted(http) == expected_counts(grid)
    index = sorted(trial["pose_index"] for trial in trials(http))
    every = grid.pose_indices(0, grid.total)
    assert index == every[codes_of(grid.poses(every)[0]) != OUTCOME_CODES["collision"]].tolist()


def test_another_world_makes_another_simulation(http: httpx.Client) -> None:
    add_box(http)
    start(http, grid=GRID)
    work(http)
    once = counted(http)
    http.patch("/objects/box", json={"mass_kg": 0.5})
    start(http, grid=GRID)
    work(http)
    assert counted(http) == {name: 2 * number for name, number in once.items()}


def test_replicas_over_one_database_share_the_queue(serve: Any, database_url: str) -> None:
    with (
        httpx.Client(base_url=serve(database_url), timeout=60) as one,
        httpx.Client(base_url=serve(database_url), timeout=60) as two,
    ):
        add_box(one)
        info = start(one, grid=GRID, chunk_poses=200)
        while work(one, jobs=1) or work(two, jobs=1):
            work(two, jobs=1)
        for http in (one, two):
            assert http.get(f"/sweeps/{info['id']}").json()["state"] == "done"
            assert counted(http) == expected_counts(PoseGrid(**BOX, **GRID))
