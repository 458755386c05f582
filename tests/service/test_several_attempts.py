"""k of n: trials and sweeps' poses that were tried several times, stored and given back, and what counts."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES, OUTCOMES

ARROW = "application/vnd.apache.arrow.stream"
LINES = "application/x-ndjson"
GRASP: dict[str, Any] = {"position": [0.01, -0.02, 0.1], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}
#: Outcome, attempts and successes.
TRIED = [("success", 10, 7), ("slipped", 10, 4), ("success", None, None), ("success", 2, 1), ("missed", 5, 0)]
NAMES = ("outcome", "attempts", "successes")
Put = Callable[..., Any]


@pytest.fixture
def mug(http: httpx.Client) -> httpx.Client:
    http.post("/objects", json={"id": "mug"})
    return http


def _stream(columns: dict[str, Any]) -> bytes:
    table, sink = pa.table(columns), pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return bytes(sink.getvalue().to_pybytes())


def _bodies() -> dict[str, tuple[bytes, str]]:
    rows = [{**GRASP, **dict(zip(NAMES, row, strict=True))} for row in TRIED]
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    return {
        "trials": (json.dumps({"trials": rows}).encode(), "application/json"),
        "columns": (json.dumps({"columns": columns}).encode(), "application/json"),
        "lines": ("\n".join(map(json.dumps, rows)).encode(), LINES),
        "arrow": (_stream(columns), ARROW),
    }


def _post(http: httpx.Client, body: bytes, media: str) -> httpx.Response:
    return http.post("/objects/mug/trials", content=body, headers={"Content-Type": media})


def _told(trials: list[dict[str, Any]]) -> list[tuple[Any, ...]]:
    return [tuple(trial[name] for name in NAMES) for trial in trials]


@pytest.mark.parametrize("form", ["trials", "columns", "lines", "arrow"])
def test_every_form_keeps_them(mug: httpx.Client, form: str) -> None:
    answer = _post(mug, *_bodies()[form])
    assert answer.status_code == 201, answer.text
    assert _told(mug.get("/objects/mug/trials").json()["items"]) == TRIED
    lines = mug.get("/objects/mug/trials", headers={"Accept": LINES}).text.splitlines()
    assert _told([json.loads(line) for line in lines]) == TRIED
    assert _told([mug.get("/objects/mug/trials/2").json()]) == TRIED[1:2]
    table = pa.ipc.open_stream(mug.get("/objects/mug/trials", headers={"Accept": ARROW}).content).read_all()
    kept = table.select(["position", "quaternion_xyzw", *NAMES])
    assert _post(mug, _stream(dict(zip(kept.column_names, kept.columns, strict=True))), ARROW).is_success
    assert _told(mug.get("/objects/mug/trials").json()["items"]) == TRIED * 2


@pytest.mark.parametrize(
    ("tried", "field", "told"),
    [
        (("success", 10, 4), "outcome", "4 successes of 10 attempts are a failure: it is one from half on"),
        (("dropped", 10, 5), "outcome", "5 successes of 10 attempts are success"),
        (("success", 10, 11), "successes", "11 successes of 10 attempts"),
        (("success", 10, None), "successes", "attempts and successes come together"),
        (("success", None, 1), "attempts", "attempts and successes come together"),
        (("success", 2.5, 2), "attempts", "a whole number"),
        (("missed", 0, 0), "attempts", "a finite number from 1 to 1e+06"),
    ],
)
def test_what_contradicts_itself_is_refused(
    mug: httpx.Client, tried: tuple[Any, ...], field: str, told: str
) -> None:
    answer = mug.post("/objects/mug/trials", json={**GRASP, **dict(zip(NAMES, tried, strict=True))})
    assert answer.status_code == 422
    (error,) = answer.json()["errors"]
    assert error["field"] == field
    assert told in error["message"]
    assert mug.get("/objects/mug/trials").json()["items"] == []


def test_a_correction_does_not_contradict_the_attempts(mug: httpx.Client) -> None:
    _post(mug, *_bodies()["trials"])
    answer = mug.patch("/objects/mug/trials/1", json={"outcome": "dropped"})
    assert answer.status_code == 422
    assert "succeeded in 7 of 10 attempts: withdraw it" in answer.json()["errors"][0]["message"]
    assert mug.patch("/objects/mug/trials/2", json={"outcome": "dropped"}).is_success


def _poses(count: int, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    rotation = rng.normal(size=(count, 4))
    return {
        "position": rng.uniform(-0.03, 0.03, (count, 3)).tolist(),
        "quaternion_xyzw": (rotation / np.linalg.norm(rotation, axis=1)[:, None]).tolist(),
    }


def _add(http: httpx.Client, slug: str, columns: dict[str, Any], **shared: Any) -> None:
    http.post("/objects", json={"id": slug})
    body = {"columns": columns, "gripper": "panda", "source": "robot", **shared}
    answer = http.post(f"/objects/{slug}/trials", json=body)
    assert answer.status_code == 201, answer.text


def test_they_weigh_by_their_share(http: httpx.Client) -> None:
    """Densities and probabilities are those of as many rows; as evidence each counts as one."""
    count, draws = 60, 4
    poses = _poses(count, 0)
    won = np.random.default_rng(1).integers(0, draws, count, endpoint=True)
    outcome = np.where(2 * won >= draws, "success", "slipped").tolist()
    _add(
        http, "several", {**poses, "outcome": outcome, "attempts": [draws] * count, "successes": won.tolist()}
    )
    each = np.repeat(np.arange(count), draws)
    rows = {name: [values[i] for i in each] for name, values in poses.items()}
    _add(http, "rows", {**rows, "outcome": [i < k for k in won.tolist() for i in range(draws)]})
    widths = {"kind": "isotropic", "sigma_position_m": 0.02, "sigma_rotation_deg": 40.0}
    ask = {"poses": _poses(20, 2), "kernel": widths}
    several, single = (
        http.post(f"/objects/{slug}/likelihood", json=ask).json() for slug in ("several", "rows")
    )
    np.testing.assert_allclose(several["density"], single["density"], rtol=1e-4)
    for name, other in zip(several["success_probability"], single["success_probability"], strict=True):
        assert name is None or other is None or name == pytest.approx(other, abs=0.03)
    trials = np.array(several["support"]["effective_trials"])
    np.testing.assert_allclose(trials * draws, single["support"]["effective_trials"], rtol=1e-3)
    density = http.get("/objects/several/density", params={"kernel": "isotropic"}).json()
    assert density["size"] == int((won > 0).sum())
    assert density["outcomes"] == {
        "success": int((2 * won >= draws).sum()),
        "slipped": int((2 * won < draws).sum()),
    }
    assert "times the share that succeeded" in density["weights"]["rule"]


def test_a_density_grows_as_it_is_built(http: httpx.Client) -> None:
    """What came in two batches with a question between them is what came in one."""
    poses, won = _poses(40, 3), np.random.default_rng(4).integers(0, 5, 40, endpoint=True)
    columns = {
        **poses,
        "outcome": np.where(2 * won >= 5, "success", "missed").tolist(),
        "attempts": [5 if i % 3 else None for i in range(40)],
        "successes": [int(k) if i % 3 else None for i, k in enumerate(won)],
    }
    _add(http, "whole", columns)
    ask = {"poses": _poses(10, 5)}
    for part in (slice(0, 25), slice(25, 40)):
        _add(http, "parts", {name: values[part] for name, values in columns.items()})
        parts = http.post("/objects/parts/likelihood", json=ask).json()
    whole = http.post("/objects/whole/likelihood", json=ask).json()
    np.testing.assert_allclose(parts["density"], whole["density"], rtol=1e-5)
    assert parts["support"]["effective_trials"] == pytest.approx(
        whole["support"]["effective_trials"], rel=1e-5
    )


# -- sweeps ------------------------------------------------------------------------------------------------


def _claim(http: httpx.Client, capabilities: list[str]) -> dict[str, Any] | None:
    jobs = http.post("/jobs/claim", json={"worker": "w", "capabilities": capabilities}).json()["jobs"]
    return jobs[0] if jobs else None


def _result(outcomes: NDArray[np.uint8], won: NDArray[np.uint8] | None, index: list[int]) -> dict[str, Any]:
    rows = {"pose_index": index, "width_m": [0.03] * len(index), "quality": [1.0] * len(index)}
    body = {
        "outcomes": base64.b64encode(outcomes.tobytes()).decode(),
        "rows": rows,
        "engine": "pybullet 3.2.7",
    }
    return body if won is None else {**body, "successes": base64.b64encode(won.tobytes()).decode()}


def test_a_sweep_that_draws(http: httpx.Client, put_box: Put) -> None:
    http.post("/objects", json={"id": "box", "mass_kg": 0.2})
    put_box(http, "box")
    asked = {"draws": 8, "friction": 0.3, "pose_noise_m": 0.001}
    sweep = http.post("/objects/box/sweeps", json={"poses": _poses(5, 6), "randomise": asked})
    assert sweep.status_code == 202, sweep.text
    told = sweep.json()["randomise"]
    assert sweep.json()["chunks"] == 1
    assert told.items() >= asked.items()
    assert told["seed"] == 0
    # A worker that knows nothing of draws does not get it.
    assert _claim(http, ["simulate", "pybullet"]) is None
    (told_of,) = http.get(f"/sweeps/{sweep.json()['id']}").json()["warnings"]
    assert "can simulate a pose under what is drawn: they are of an older version" in told_of
    job = _claim(http, ["simulate", "drawn-wrench", "pybullet"])
    if job is None:
        pytest.fail(f"nothing to claim: {sweep.json()}")
    assert job["payload"]["randomise"] == told
    codes = np.array(
        [OUTCOME_CODES[name] for name in ("success", "slipped", "collision", "collision", "missed")]
    )
    codes, won = codes.astype(np.uint8), np.array([8, 3, 1, 0, 0], dtype=np.uint8)
    path = f"/jobs/{job['id']}/result?lease_id={job['lease_id']}"

    def refused(body: dict[str, Any], word: str) -> None:
        answer = http.put(path, json=body)
        assert answer.status_code == 422, answer.text
        assert word in json.dumps(answer.json()["errors"]), answer.text

    refused(_result(codes, None, [0, 1, 2]), "of 8 draws of each pose")
    refused(_result(codes, won[:4], [0, 1, 2]), "5 numbers, one for every pose of the chunk, not 4")
    refused(_result(codes, won + np.uint8(1), [0, 1, 2]), "more than 8 draws")
    refused(_result(codes, won[::-1].copy(), [0, 1, 2]), "success is half of them")
    refused(_result(codes, won, [0, 1]), "pose 2 succeeded, so it must have a row")
    refused(_result(codes, won, [0, 1, 2, 3]), "must have no row")
    stored = http.put(path, json=_result(codes, won, [0, 1, 2]))
    assert stored.status_code == 200, stored.text
    trials = http.get("/objects/box/trials").json()["items"]
    assert [(t["outcome"], t["attempts"], t["successes"]) for t in trials] == [
        ("success", 8, 8),
        ("slipped", 8, 3),
        ("collision", 8, 1),
    ]
    outcomes = http.get(f"/sweeps/{sweep.json()['id']}/outcomes").json()
    assert outcomes["outcome"] == [OUTCOMES[code] for code in codes]
    assert (outcomes["attempts"], outcomes["successes"]) == ([8] * 5, won.tolist())
    assert http.get("/objects/box").json()["outcomes"] == {
        "success": 1, "slipped": 1, "collision": 2, "missed": 1,
    }  # fmt: skip
    table = pa.ipc.open_stream(
        http.get(f"/sweeps/{sweep.json()['id']}/outcomes", headers={"Accept": ARROW}).content
    ).read_all()
    assert table["successes"].to_pylist() == won.tolist()
    # All three of which some draw succeeded are in the density, the last by an eighth.
    density = http.get("/objects/box/density").json()
    assert density["size"] == 3
    assert density["effective_sample_size"] == pytest.approx((8 + 3 + 1) ** 2 / (64 + 9 + 1), rel=1e-4)
    # What was simulated stays: that is said before what else is wrong with a correction.
    refusal = http.patch("/objects/box/trials/1", json={"outcome": "dropped"})
    assert (refusal.status_code, refusal.json()["type"].rpartition(":")[2]) == (409, "trial-of-a-sweep")
    copy = http.post("/objects/box/copies", json={"id": "box-2", "trials": True})
    assert copy.is_success, copy.text
    again = http.get("/objects/box-2/trials").json()["items"]
    assert [t["successes"] for t in again] == [8, 3, 1]


def test_chunks_that_draw_have_fewer_poses(sqlite_http: httpx.Client, put_box: Put) -> None:
    http = sqlite_http
    http.post("/objects", json={"id": "box", "mass_kg": 0.2})
    put_box(http, "box")
    plain, drawn = (
        http.post("/objects/box/sweeps", json={"grid": {"max_poses": 50_000}, **more}).json()
        for more in ({}, {"randomise": {"draws": 10}})
    )
    assert drawn["chunks"] > 2 * plain["chunks"]


def test_what_is_drawn_has_to_be_something(http: httpx.Client, put_box: Put) -> None:
    http.post("/objects", json={"id": "box", "mass_kg": 0.2})
    put_box(http, "box")
    nothing = {"friction": 0, "mass": 0, "centre_of_mass_m": 0, "pose_noise_m": 0, "pose_noise_deg": 0}
    for asked, word in (
        (nothing, "nothing is drawn: every spread is 0"),
        ({"finger_compliance": 0.3}, "finger_compliance is of lift and shake"),
        ({"draws": 1}, "greater than or equal to 2"),
    ):
        answer = http.post("/objects/box/sweeps", json={"poses": _poses(2, 0), "randomise": asked})
        assert answer.status_code == 422
        assert word in json.dumps(answer.json()), answer.text
