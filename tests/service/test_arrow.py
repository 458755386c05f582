"""Arrow streams: trials in and out, outcomes of sweeps, likelihood; bad ones; without pyarrow."""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES, OUTCOMES

ARROW = "application/vnd.apache.arrow.stream"
SEND = {"Content-Type": ARROW}
ASK = {"Accept": ARROW}

Poses = tuple[NDArray[np.float64], NDArray[np.float64]]
Make = Callable[..., str]
Post = Callable[..., dict[str, Any]]


def vectors(values: Any) -> pa.Array:
    table = np.array(values, dtype=np.float64)
    return pa.FixedSizeListArray.from_arrays(pa.array(table.reshape(-1)), table.shape[1])


def stream(columns: dict[str, Any], beside: dict[str, Any] | None = None, **options: Any) -> bytes:
    table = pa.table(columns)
    if beside is not None:
        table = table.replace_schema_metadata({"graspdb": json.dumps(beside)})
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema, **options) as writer:
        writer.write_table(table, max_chunksize=100)
    return bytes(sink.getvalue().to_pybytes())


def table_of(answer: httpx.Response) -> tuple[pa.Table, dict[str, Any]]:
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == ARROW
    table = pa.ipc.open_stream(answer.content).read_all()
    table.validate(full=True)
    return table, json.loads((table.schema.metadata or {}).get(b"graspdb", b"{}"))


def problem(answer: httpx.Response, status: int) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    body: dict[str, Any] = answer.json()
    return body


@pytest.fixture
def mug(http: httpx.Client) -> httpx.Client:
    assert http.post("/objects", json={"id": "mug"}).status_code == 201
    return http


def test_trials_come_back_as_they_went(mug: httpx.Client, two_clusters: Poses) -> None:
    """Every kind of column, nulls here and there, over several batches of the stream."""
    count = len(two_clusters[0])
    rng = np.random.default_rng(0)
    outcomes = [OUTCOMES[i % 3] for i in range(count)]
    covariance = np.diag([1e-6] * 3 + [1e-4] * 3)
    time = datetime(2026, 3, 1, 12, 30, 5, 250_000, UTC)
    columns = {
        "position": vectors(two_clusters[0]),
        "quaternion_xyzw": pa.array(two_clusters[1].tolist()),
        "outcome": pa.array(outcomes).dictionary_encode(),
        "gripper": pa.array(["pg70" if i % 2 else None for i in range(count)]),
        "quality": pa.array([None if i % 5 else float(i) for i in range(count)]),
        "width_m": pa.array(rng.uniform(0, 0.07, count).astype(np.float32)),
        "measured_at": pa.array([time if i % 4 else None for i in range(count)], pa.timestamp("ns", "UTC")),
        "pose_covariance": pa.array([covariance.ravel().tolist() if i == 7 else None for i in range(count)]),
        "metadata": pa.array([json.dumps({"try": i}) if i == 3 else None for i in range(count)]),
    }
    beside = {"source": "robot", "proposal_density": 20.0, "metadata": {"lab": "a"}}
    answer = mug.post(
        "/objects/mug/trials", content=stream(columns, beside), headers={**SEND, "Idempotency-Key": "k"}
    )
    receipt = problem(answer, 201)
    assert receipt["inserted"] == count
    again = mug.post(
        "/objects/mug/trials", content=stream(columns, beside), headers={**SEND, "Idempotency-Key": "k"}
    )
    assert again.json() == receipt

    found, _ = table_of(mug.get("/objects/mug/trials", headers=ASK))
    assert found.num_rows == count
    np.testing.assert_array_equal(np.array(found["position"].to_pylist()), two_clusters[0])
    np.testing.assert_allclose(np.array(found["quaternion_xyzw"].to_pylist()), two_clusters[1], atol=1e-12)
    assert found["outcome"].to_pylist() == outcomes
    for name in ("gripper", "quality"):
        assert found[name].to_pylist() == columns[name].to_pylist()
    np.testing.assert_allclose(found["width_m"].to_pylist(), columns["width_m"].to_pylist())
    assert found["measured_at"].to_pylist() == [time if i % 4 else None for i in range(count)]
    assert found["pose_covariance"][7].as_py() == covariance.tolist()
    assert [json.loads(text) for text in found["metadata"].to_pylist()[2:5]] == [
        {"lab": "a"}, {"try": 3}, {"lab": "a"}
    ]  # fmt: skip
    assert set(found["source"].to_pylist()) == {"robot"}
    assert set(found["proposal_density"].to_pylist()) == {20.0}
    assert set(found["batch"].to_pylist()) == {receipt["batch"]}
    # As JSON tells them.
    items = mug.get("/objects/mug/trials?limit=1000").json()["items"]
    for name in ("seq", "revision", "outcome", "width_m", "sweep", "pose_index"):
        assert found[name].to_pylist() == [item[name] for item in items]

    # A page, and where the next one starts.
    page, told = table_of(mug.get("/objects/mug/trials?limit=100&outcome=success", headers=ASK))
    assert page.num_rows == 100
    rest, told = table_of(
        mug.get(f"/objects/mug/trials?limit=1000&outcome=success&cursor={told['next']}", headers=ASK)
    )
    assert told["next"] is None
    assert page["seq"].to_pylist() + rest["seq"].to_pylist() == [
        item["seq"] for item in items if item["outcome"] == "success"
    ]
    tag = mug.get("/objects/mug/trials", headers=ASK).headers["etag"]
    assert mug.get("/objects/mug/trials", headers={**ASK, "If-None-Match": tag}).status_code == 304


def test_flags_times_and_structs(mug: httpx.Client) -> None:
    columns = {
        "position": pa.array([[0, 0, 0], [1, 0, 0]], pa.list_(pa.int32())),
        "quaternion_xyzw": vectors([[0, 0, 0, 1]] * 2),
        "outcome": pa.array([True, False]),
        "measured_at": pa.array(["2026-01-31T12:00:00Z", None]),
        "metadata": pa.array([{"a": 1}, None]),
        "pose_covariance": pa.array([np.eye(6).tolist(), None]),
    }
    problem(mug.post("/objects/mug/trials", content=stream(columns), headers=SEND), 201)
    one, two = mug.get("/objects/mug/trials").json()["items"]
    assert (one["outcome"], two["outcome"]) == ("success", "failure")
    assert (one["metadata"], two["metadata"]) == ({"a": 1}, None)
    assert one["measured_at"].startswith("2026-01-31T12:00:00")
    assert one["pose_covariance"] == np.eye(6).tolist()
    empty, _ = table_of(mug.get("/objects/mug/trials?outcome=dropped", headers=ASK))
    assert empty.num_rows == 0
    assert empty.schema.names[:3] == ["seq", "revision", "batch"]


@pytest.fixture(scope="module")
def shared(
    tmp_path_factory: pytest.TempPathFactory, serve_module: Callable[..., str]
) -> Iterator[httpx.Client]:
    """A mug that refused trials leave as it was."""
    database = tmp_path_factory.mktemp("arrow") / "graspdb.sqlite"
    with httpx.Client(base_url=serve_module(f"sqlite:///{database}"), timeout=60) as client:
        client.post("/objects", json={"id": "mug"}).raise_for_status()
        yield client


GOOD: dict[str, Any] = {
    "position": vectors([[0, 0, 0]] * 3),
    "quaternion_xyzw": vectors([[0, 0, 0, 1]] * 3),
    "outcome": pa.array(["success"] * 3),
}


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"position": vectors([[0, 0, 0], [0, np.nan, 0], [0, 0, 0]])}, "columns.position.1"),
        ({"position": vectors([[0, 0, 0], [0, np.inf, 0], [0, 0, 0]])}, "columns.position.1"),
        ({"position": vectors([[0, 0, 0], [0, 1e5, 0], [0, 0, 0]])}, "columns.position.1"),
        ({"position": vectors([[0, 0, 0, 0]] * 3)}, "columns.position"),
        ({"position": pa.array([[0.0, 0.0, 0.0], [0.0, 0.0], [0.0, 0.0, 0.0]])}, "columns.position.1"),
        ({"position": pa.array([[0.0, 0.0, 0.0], None, [0.0, 0.0, 0.0]])}, "columns.position.1"),
        ({"position": pa.array([[0.0, 0.0, 0.0], [0.0, None, 0.0], [0.0] * 3])}, "columns.position.1"),
        ({"position": pa.array(["a"] * 3)}, "columns.position"),
        ({"position": None}, "columns.position"),
        ({"quaternion_xyzw": vectors([[0, 0, 0, 1], [0, 0, 0, 2]] * 2)[:3]}, "columns.quaternion_xyzw.1"),
        ({"outcome": pa.array(["success", "good", "missed"])}, "columns.outcome.1"),
        ({"outcome": pa.array(["success", None, "missed"])}, "columns.outcome.1"),
        ({"outcome": pa.array([1, 0, 1])}, "columns.outcome"),
        ({"quality": pa.array([1.0, np.nan, None])}, "columns.quality.1"),
        ({"quality": pa.array(["a", "b", "c"])}, "columns.quality"),
        ({"width_m": pa.array([0.1, -1.0, None])}, "columns.width_m.1"),
        ({"proposal_density": pa.array([1.0, 0.0, None])}, "columns.proposal_density.1"),
        ({"gripper": pa.array(["pg70", "a b", None])}, "columns.gripper.1"),
        ({"gripper": pa.array(["pg70", "nope", None])}, "columns.gripper.1"),
        ({"source": pa.array(["robot", "dream", None])}, "columns.source.1"),
        ({"measured_at": pa.array(["noon", None, None])}, "columns.measured_at.0"),
        ({"metadata": pa.array(["noon", None, None])}, "columns.metadata.0"),
        ({"metadata": pa.array([{"a": np.nan}, None, None])}, "columns.metadata.0"),
        ({"metadata": pa.array(["{}"] * 3).dictionary_encode()}, "columns.metadata"),
        ({"pose_covariance": pa.array([[1.0] * 5, None, None])}, "columns.pose_covariance.0"),
        ({"colour": pa.array(["red"] * 3)}, "columns.colour"),
        # What another type can't hold is refused, not rounded.
        ({"quality": pa.array([1, 2**53 + 1, None])}, "columns.quality.1"),
        ({"quality": pa.array([1, 2**63, 3], pa.uint64())}, "columns.quality.1"),
        ({"quality": pa.array([1, None, -(2**63)])}, "columns.quality.2"),
        ({"position": pa.array([[0, 0, 0], [0, 2**53 + 1, 0], [0, 0, 0]])}, "columns.position.1"),
        ({"quality": pa.array([1.0, 0.0, 1.0]).cast(pa.float16())}, None),
        ({"quality": pa.array([1, 2, 3]).cast(pa.decimal128(21, 1))}, "columns.quality"),
        ({"quality": pa.array([1.0, 2.0, 1.0]).dictionary_encode()}, "columns.quality"),
        ({"quality": pa.array([True, False, None])}, "columns.quality"),
        ({"outcome": pa.array([1.0, 0.0, 1.0])}, "columns.outcome"),
        ({"outcome": pa.array([True, False, True]).dictionary_encode()}, "columns.outcome"),
        ({"outcome": pa.array(["success"] * 3, pa.large_string())}, None),
        ({"outcome": pa.array(["success"] * 3, pa.string_view())}, "columns.outcome"),
        ({"gripper": pa.array(["pg70", None, "pg70\0"], pa.large_string())}, "columns.gripper.2"),
        (
            {"gripper": pa.DictionaryArray.from_arrays(pa.array([0, 1, 0]), pa.array(["pg70", None]))},
            None,
        ),
        ({"measured_at": pa.array([1, 2, 3], pa.timestamp("ns"))}, "columns.measured_at.0"),
        ({"measured_at": pa.array([1000, None, 1], pa.timestamp("ns"))}, "columns.measured_at.2"),
        ({"measured_at": pa.array([0, 2**62, 0], pa.timestamp("s"))}, "columns.measured_at.1"),
        ({"measured_at": pa.array([0, -(2**63), 0], pa.timestamp("ms"))}, "columns.measured_at.1"),
        ({"measured_at": pa.array([0, 2**62, 0], pa.timestamp("us"))}, "columns.measured_at.1"),
        ({"measured_at": pa.array([0, 0, 4 * 10**9], pa.timestamp("s", "UTC"))}, None),
        ({"measured_at": pa.array([0] * 3, pa.timestamp("us", "Mars/Olympus"))}, "columns.measured_at"),
        ({"measured_at": pa.array([0] * 3, pa.date32())}, "columns.measured_at"),
        ({"measured_at": pa.array([0] * 3, pa.int64())}, "columns.measured_at.0"),
        ({"metadata": pa.array([{"t": datetime(2026, 1, 1)}, None, None])}, "columns.metadata.0"),
        ({"metadata": pa.array([[1, 2], None, None])}, "columns.metadata.0"),
        ({"metadata": pa.array([b"{}", None, None])}, "columns.metadata"),
        ({"position": pa.array([[0.0] * 3] * 3, pa.large_list(pa.float32()))}, None),
        ({"position": pa.array([[0.0] * 3] * 3).cast(pa.list_(pa.decimal128(21, 1)))}, "columns.position"),
        ({"position": pa.nulls(3)}, "columns.position"),
    ],
)  # fmt: skip
def test_bad_columns_are_named(shared: httpx.Client, changes: dict[str, Any], field: str | None) -> None:
    """And what is as good as another type of the same values is taken: None."""
    columns = {name: column for name, column in {**GOOD, **changes}.items() if column is not None}
    before = shared.get("/objects/mug").json()["trials"]
    answer = shared.post("/objects/mug/trials", content=stream(columns), headers=SEND)
    told = problem(answer, 422 if field else 201)
    if field:
        assert told["errors"][0]["field"] == field
    assert shared.get("/objects/mug").json()["trials"] == before + (0 if field else 3)


def test_what_is_no_stream_is_refused(sqlite_http: httpx.Client) -> None:
    http = sqlite_http
    http.post("/objects", json={"id": "mug"})
    good = stream(GOOD)
    rng = np.random.default_rng(0)
    broken = [b"", b"{}", rng.bytes(500), good[: len(good) // 2], good[100:]]
    broken += [stream(GOOD, options=pa.ipc.IpcWriteOptions(compression=name)) for name in ("zstd", "lz4")]
    for content in broken:
        told = problem(http.post("/objects/mug/trials", content=content, headers=SEND), 422)
        assert told["errors"][0]["field"] in ("body", "columns.position"), content[:20]
    told = problem(http.post("/objects/mug/trials", content=broken[-1], headers=SEND), 422)
    assert "compressed" in told["errors"][0]["message"]
    for beside, field in (({"colour": 1}, "colour"), ({"source": "dream"}, "source")):
        told = problem(http.post("/objects/mug/trials", content=stream(GOOD, beside), headers=SEND), 422)
        assert told["errors"][0]["field"] == field
    # Flipped bytes are refused or make another valid stream, never a failure of the service.
    for _ in range(100):
        content = bytearray(good)
        for at in rng.integers(0, len(content), 3):
            content[at] = rng.integers(256)
        answer = http.post("/objects/mug/trials", content=bytes(content), headers=SEND)
        assert answer.status_code in (201, 422, 413), answer.text


def test_more_trials_than_a_batch_may_have(sqlite_url: str, serve: Callable[..., str]) -> None:
    with httpx.Client(base_url=serve(sqlite_url, max_batch_trials=2)) as http:
        http.post("/objects", json={"id": "mug"})
        told = problem(http.post("/objects/mug/trials", content=stream(GOOD), headers=SEND), 413)
        assert told["limit"] == 2


def test_likelihood_asked_and_answered_in_arrow(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    post(http, "thing", two_clusters)
    post(http, "thing", two_clusters, "missed")
    asked = np.concatenate([two_clusters[0][:200], [[9.0, 9.0, 9.0]]]), two_clusters[1][:201]
    options = {"kernel": {"sigma_position_m": 0.01, "sigma_rotation_deg": 12}}
    columns = {"position": vectors(asked[0]), "quaternion_xyzw": vectors(asked[1])}
    body = {"poses": {"position": asked[0].tolist(), "quaternion_xyzw": asked[1].tolist()}, **options}
    plain = http.post("/objects/thing/likelihood", json=body).json()
    path = "/objects/thing/likelihood"
    for answer in (
        http.post(path, content=stream(columns, options), headers={**SEND, **ASK}),
        http.post(path, json=body, headers=ASK),
    ):
        table, told = table_of(answer)
        assert told["kernel"] == plain["kernel"]
        assert told["revision"] == plain["revision"]
        assert told["interval_level"] == plain["interval"]["level"]
        for name in ("density", "log_density", "relative", "success_probability", "effective_trials"):
            found = np.array(table[name].to_pylist(), dtype=np.float64)
            np.testing.assert_allclose(found, np.array(plain[name], dtype=np.float64), rtol=1e-9)
        assert table["interval_low"].to_pylist() == pytest.approx(plain["interval"]["low"])
    json_back = http.post(path, content=stream(columns, options), headers=SEND)
    assert json_back.json()["density"] == plain["density"]
    limited = stream(columns, {"include": ["relative"]})
    table, _ = table_of(http.post(path, content=limited, headers={**SEND, **ASK}))
    assert table.column_names == ["relative"]

    bad = {**columns, "position": vectors(np.where(np.arange(201)[:, None] == 5, np.nan, asked[0]))}
    told = problem(http.post(path, content=stream(bad), headers=SEND), 422)
    assert told["errors"][0]["field"] == "poses.position.5"
    told = problem(
        http.post(path, content=stream({**columns, "outcome": columns["position"]}), headers=SEND), 422
    )
    assert told["errors"][0]["field"] == "poses.outcome"
    told = problem(http.post(path, content=stream(columns, {"colour": 1}), headers=SEND), 422)
    assert told["errors"][0]["field"] == "colour"
    assert problem(http.post(path, json=body, headers={"Accept": "text/csv"}), 406)


def test_outcomes_of_a_sweep(http: httpx.Client, make_object: Make, put_box: Callable[..., Any]) -> None:
    make_object(http, mass_kg=0.3)
    put_box(http, "thing", (0.04, 0.04, 0.04))
    grid = {"position_step_m": 0.02, "rotation_step_deg": 60.0, "margin_m": 0.0}
    sweep = http.post("/objects/thing/sweeps", json={"grid": grid, "chunk_poses": 200}).json()["id"]
    empty, _ = table_of(http.get(f"/sweeps/{sweep}/outcomes", headers=ASK))
    assert empty.num_rows == 0
    while jobs := http.post("/jobs/claim", json={"worker": "w", "limit": 1}).json()["jobs"]:
        start, stop = jobs[0]["payload"]["start"], jobs[0]["payload"]["stop"]
        codes = np.where(np.arange(start, stop) % 2, OUTCOME_CODES["collision"], OUTCOME_CODES["failure"])
        none: dict[str, list[float]] = {"pose_index": [], "width_m": [], "quality": []}
        http.put(
            f"/jobs/{jobs[0]['id']}/result",
            params={"lease_id": jobs[0]["lease_id"]},
            json={"outcomes": base64.b64encode(codes.astype(np.uint8).tobytes()).decode(), "rows": none},
        ).raise_for_status()
    plain = http.get(f"/sweeps/{sweep}/outcomes?limit=100000").json()
    table, told = table_of(http.get(f"/sweeps/{sweep}/outcomes", headers=ASK))
    assert told == {
        "sweep": sweep,
        "frame": "tool",
        "convention": "graspdb",
        "tool_to_frame": None,
        "warnings": [],
        "next": None,
    }
    for name in ("pose_index", "position", "quaternion_xyzw", "outcome"):
        assert table[name].to_pylist() == plain[name]
    first, told = table_of(http.get(f"/sweeps/{sweep}/outcomes?limit=150", headers=ASK))
    rest, _ = table_of(http.get(f"/sweeps/{sweep}/outcomes?cursor={told['next']}", headers=ASK))
    assert first["pose_index"].to_pylist() + rest["pose_index"].to_pylist() == plain["pose_index"]
    assert problem(http.get("/sweeps/nope/outcomes", headers=ASK), 404)


def test_without_pyarrow_json_goes_on(sqlite_http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    http, content = sqlite_http, stream(GOOD)
    http.post("/objects", json={"id": "mug"})
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for answer, status in (
        (http.post("/objects/mug/trials", content=content, headers=SEND), 415),
        (http.post("/objects/mug/likelihood", content=content, headers=SEND), 415),
        (http.get("/objects/mug/trials", headers=ASK), 406),
    ):
        told = problem(answer, status)
        assert told["type"].endswith("arrow-not-installed")
        assert "pip install 'graspdb[service,arrow]'" in told["title"]
    assert http.get("/objects/mug/trials").status_code == 200
