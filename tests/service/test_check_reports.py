"""Reports on simulated checks: draws at several widths, best grasps again; no GET simulates anything.

A worker with made-up physics stands in for pybullet: a grasp of the box holds near its middle, fails farther
off, and collides beyond.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from sqlalchemy import select

from graspdb.wire import OUTCOME_CODES
from graspdb_density import se3
from graspdb_service.storage.database import Database
from graspdb_service.storage.tables import report_runs

#: Seconds of sums over draws, which the other tests read from both databases.
ONCE = pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)

Poses = tuple[NDArray[np.float64], NDArray[np.float64]]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]
PATH = "/objects/thing/reports/"


def ok(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def physics(positions: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Success within 20 mm of the origin, missed within 35, collision beyond."""
    far = np.linalg.norm(np.asarray(positions).reshape(-1, 3), axis=1)
    codes = [OUTCOME_CODES[name] for name in ("success", "missed", "collision")]
    return np.array(codes, dtype=np.uint8)[np.digitize(far, [0.02, 0.035])]


def simulate(http: httpx.Client) -> int:
    """Be a worker until nothing is left; the poses simulated."""
    done = 0
    while jobs := http.post("/jobs/claim", json={"worker": "w", "limit": 50}).json()["jobs"]:
        for job in jobs:
            codes = physics(np.array(job["payload"]["poses"]["position"]))
            rows = np.flatnonzero(codes != OUTCOME_CODES["collision"]) + job["payload"]["start"]
            answer = http.put(
                f"/jobs/{job['id']}/result",
                params={"lease_id": job["lease_id"]},
                json={
                    "outcomes": base64.b64encode(codes.tobytes()).decode(),
                    "rows": {
                        "pose_index": rows.tolist(),
                        "width_m": [None] * len(rows),
                        "quality": [None] * len(rows),
                    },
                },
            )
            assert answer.status_code == 200, answer.text
            done += len(codes)
    return done


@pytest.fixture
def filled(
    database_url: str,
    serve: Callable[..., str],
    make_object: Make,
    post: Post,
    put_box: Callable[..., Any],
) -> httpx.Client:
    """600 attempts at a small box that can be simulated, half of them successes, on either database."""
    http = httpx.Client(base_url=serve(database_url, report_wait_s=60), timeout=90)
    make_object(http, mass_kg=0.1)
    put_box(http, "thing", (0.004, 0.006, 0.004))
    # The box is convex: it is its own part, and its sweeps wait for nobody.
    rng = np.random.default_rng(0)
    p = rng.normal(size=(900, 3)) * 0.012
    q = se3.random_quaternions(900, rng)
    codes = physics(p)
    names = {code: name for name, code in OUTCOME_CODES.items()}
    post(http, "thing", (p, q), [names[int(code)] for code in codes], gripper="pg70", protocol="wrench")
    return http


def test_bandwidth_names_the_sweeps_it_lacks_and_tells_what_they_found(filled: httpx.Client) -> None:
    http = filled
    body = ok(http.get(PATH + "bandwidth"))
    assert body["draws"] == []
    assert len(body["calls"]) == 4
    assert any("no draws have been simulated" in warning for warning in body["warnings"])
    assert http.get("/sweeps").json()["items"] == []
    told = [point for point in body["grid"] if point["log_likelihood"] is not None]
    best = max(told, key=lambda point: point["log_likelihood"])
    assert body["recommended"]["sigma_position_m"] == best["sigma_position_m"]
    assert body["recommended"]["sigma_rotation_deg"] == best["sigma_rotation_deg"]
    assert body["range_m"][0] <= best["sigma_position_m"] <= body["range_m"][1]
    revision = body["revision"]
    for call in body["calls"]:
        made = http.request(call["method"], call["path"], json=call["body"])
        assert made.status_code == 202, made.text
    assert simulate(http) == 4 * 500
    again = ok(http.get(PATH + "bandwidth"))
    assert again["revision"] == revision
    assert again["calls"] == []
    assert again["grid"] == body["grid"]
    widths = [item["kernel"]["sigma_position_m"] for item in again["draws"]]
    assert widths == sorted(call["body"]["sample"]["kernel"]["sigma_position_m"] for call in body["calls"])
    shares = [item["success"]["value"] for item in again["draws"]]
    assert shares == sorted(shares, reverse=True)
    for item in again["draws"]:
        assert (item["draws"], sum(item["outcomes"].values()), item["protocol"]) == (500, 500, "wrench")
        won, hit = (item["outcomes"].get(name, 0) for name in ("success", "collision"))
        assert item["success"]["value"] == won / 500
        assert item["collision"]["value"] == hit / 500
        assert item["free_success"]["value"] == won / (500 - hit)
        assert item["success"]["low"] < won / 500 < item["success"]["high"]
    assert "Simulated draws succeed" in again["text"]
    # The draws are those the service makes of that kernel.
    first = again["draws"][0]["kernel"]
    drawn = ok(
        http.post(
            "/objects/thing/samples",
            json={
                "count": 500,
                "seed": 0,
                "kernel": {k: first[k] for k in ("sigma_position_m", "sigma_rotation_deg")},
            },
        )
    )
    won = int((physics(np.array(drawn["position"])) == OUTCOME_CODES["success"]).sum())
    assert again["draws"][0]["outcomes"]["success"] == won
    # What a deleted batch had found is told no more.
    sweep = http.get("/sweeps").json()["items"][0]
    assert http.delete(f"/objects/thing/batches/{sweep['batch']}").status_code in (200, 204)
    assert len(ok(http.get(PATH + "bandwidth"))["draws"]) == 3
    png = http.get(PATH + "bandwidth", headers={"Accept": "image/png"})
    assert png.content.startswith(b"\x89PNG")


def test_bandwidth_of_too_few(sqlite_http: httpx.Client, make_object: Make, post: Post) -> None:
    http = sqlite_http
    make_object(http)
    none = http.get(PATH + "bandwidth")
    assert (none.status_code, "there are 0, so 200 more" in none.json()["title"]) == (409, True)
    post(http, "thing", (np.zeros((150, 3)), np.tile([0.0, 0, 0, 1], (150, 1))))
    few = http.get(PATH + "bandwidth")
    assert (few.status_code, "there are 150, so 50 more" in few.json()["title"]) == (409, True)
    post(http, "thing", (np.zeros((50, 3)), np.tile([0.0, 0, 0, 1], (50, 1))))
    alike = http.get(PATH + "bandwidth")
    assert (alike.status_code, "one block" in alike.json()["title"]) == (409, True)
    assert http.get(PATH + "bandwidth?sigma_position_m=0.01").status_code == 422


def test_calibration_judges_grasps_that_were_simulated_again(filled: httpx.Client) -> None:
    http = filled
    before = ok(http.get(PATH + "calibration"))
    assert before["checked"] is None
    assert any("POST /objects/thing/sweeps" in warning for warning in before["warnings"])
    rng = np.random.default_rng(5)
    p = rng.normal(size=(200, 3)) * 0.012
    q = se3.random_quaternions(200, rng)
    made = http.post(
        "/objects/thing/sweeps",
        json={
            "poses": {"position": p.tolist(), "quaternion_xyzw": q.tolist()},
            "gripper": "pg70",
            "purpose": "check",
        },
    )
    assert made.status_code == 202, made.text
    assert simulate(http) == 200
    body = ok(http.get(PATH + "calibration"))
    # Nothing but the check is new: no prediction rests on it.
    assert body["skill"] == before["skill"]
    assert body["revision"] == before["revision"]
    again = body["checked"]
    codes = physics(p)
    won = int((codes == OUTCOME_CODES["success"]).sum())
    assert (again["grasps"], again["successes"]) == (200, won)
    assert again["rate"]["low"] < won / 200 < again["rate"]["high"]
    assert sum(item["count"] for item in again["bins"]) == 200
    # Predictions are those that queries answer, which tell none where nothing near was tried.
    answer = ok(
        http.post(
            "/objects/thing/likelihood",
            json={
                "poses": {"position": p.tolist(), "quaternion_xyzw": q.tolist()},
                "include": ["success_probability"],
            },
        )
    )
    told = [chance for chance in answer["success_probability"] if chance is not None]
    assert len(told) > 150
    assert again["predicted"] == pytest.approx(np.mean(told), abs=2e-3 if len(told) == 200 else 0.05)
    assert f"Simulated again, {won} of 200 given grasps succeed" in body["text"]
    png = http.get(PATH + "calibration", headers={"Accept": "image/png"})
    assert png.content.startswith(b"\x89PNG")


@ONCE
def test_convergence_matched_by_the_success_of_simulated_draws(filled: httpx.Client) -> None:
    http = filled
    kernel = http.post("/kernels", json={"object": "thing"}).json()
    path = PATH + f"convergence?kernel={kernel['id']}&matching=success"
    refused = http.get(path)
    assert refused.status_code == 409, refused.text
    problem = refused.json()
    assert problem["type"].endswith("checks-needed")
    # The kernel itself, and isotropic ones at several widths.
    assert len(problem["calls"]) == 6
    for call in problem["calls"]:
        made = http.request(call["method"], call["path"], json=call["body"])
        assert made.status_code == 202, made.text
    assert simulate(http) == 6 * 500
    body = ok(http.get(path))
    assert body["matching"] == "success"
    own, matched = body["curves"]
    assert own["kernel"]["id"] == kernel["id"]
    drawn = ok(http.get(PATH + "bandwidth"))["draws"]
    target = next(d["success"]["value"] for d in drawn if d["kernel"]["id"] == kernel["id"])
    shares = {
        d["kernel"]["sigma_position_m"]: d["success"]["value"] for d in drawn if d["kernel"]["id"] is None
    }
    widths = sorted(shares)
    if body["matched"]:
        # Between the widths whose draws succeed more and less often.
        wide = next((w for w in widths if shares[w] < target), widths[-1])
        assert widths[0] * 0.98 <= matched["kernel"]["sigma_position_m"] <= wide * 1.02
    else:
        assert any("matches by success" in warning for warning in body["warnings"])
        ends = (widths[0], widths[-1])
        assert min(abs(matched["kernel"]["sigma_position_m"] / end - 1.0) for end in ends) < 0.02


def test_answers_about_past_checks_are_not_kept(filled: httpx.Client, database_url: str) -> None:
    """Reports that say what became of checks: one answer a question, however often checks finish."""
    http = filled
    database = Database(database_url)

    def kept() -> list[tuple[str, int, str]]:
        with database.read() as tx:
            rows = tx.execute(select(report_runs.c.report, report_runs.c.revision, report_runs.c.parameters))
            return sorted((r.report, r.revision, str(r.parameters["filters"]["protocol"])) for r in rows)

    for path in ("bandwidth", "calibration", "anisotropy"):
        ok(http.get(PATH + path))
    before = kept()
    assert [report for report, _, _ in before] == ["anisotropy", "bandwidth", "calibration"]
    for seed in range(2):
        sample = {"count": 30, "seed": seed}
        made = http.post("/objects/thing/sweeps", json={"sample": sample, "gripper": "pg70",
                         "protocol": "wrench", "purpose": "check"})  # fmt: skip
        assert made.status_code == 202, made.text
        simulate(http)
        for path in ("bandwidth", "calibration", "anisotropy"):
            ok(http.get(PATH + path))
        assert kept() == before
    # Another revision's answers go with the checks', those of other questions stay.
    ok(http.get(PATH + "bandwidth?gripper=pg70"))
    assert kept() == before
    http.post("/objects/thing/trials", json={"position": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1],
              "outcome": True, "gripper": "pg70", "protocol": "wrench"}).raise_for_status()  # fmt: skip
    ok(http.get(PATH + "bandwidth"))
    assert [(report, revision > before[0][1]) for report, revision, _ in kept()] == [
        ("anisotropy", False),
        ("bandwidth", True),
        ("calibration", False),
    ]
    database.dispose()
