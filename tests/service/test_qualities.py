"""A trial's named qualities, and a batch's licence, citation and origin: given back as they came."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from graspdb.wire.base import MAX_QUALITIES
from graspdb_service.storage.trials.qualities import layout_of

Serve = Callable[..., str]
ARROW = "application/vnd.apache.arrow.stream"
LINES = "application/x-ndjson"
GRASP: dict[str, Any] = {
    "position": [0.01, -0.02, 0.1],
    "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0],
    "outcome": "success",
}
FLEX = {"flex": [1.0, 0.0, None], "motion": [1e-7, 0.1, 3.0], "rank/top": [None, None, -0.0]}
#: What the three trials of FLEX have.
ROWS = [{"flex": 1.0, "motion": 1e-7}, {"flex": 0.0, "motion": 0.1}, {"motion": 3.0, "rank/top": -0.0}]
SHA256 = "0f" * 32
ORIGIN = {"file": "mug.h5", "format": "acronym", "sha256": SHA256}


@pytest.fixture
def mug(http: httpx.Client) -> httpx.Client:
    http.post("/objects", json={"id": "mug"})
    return http


def _stream(columns: dict[str, Any], beside: dict[str, Any] | None = None) -> bytes:
    table = pa.table(columns).replace_schema_metadata({"graspdb": json.dumps(beside or {})})
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return bytes(sink.getvalue().to_pybytes())


def _bodies() -> dict[str, tuple[bytes, str]]:
    """The same three trials in every form of a request."""
    rows = [{**GRASP, "qualities": scores} for scores in ROWS]
    columns = {name: [value] * 3 for name, value in GRASP.items()}
    flat = {f"qualities.{name}": pa.array(values, pa.float64()) for name, values in FLEX.items()}
    struct = pa.StructArray.from_arrays([pa.array(x, pa.float64()) for x in FLEX.values()], list(FLEX))
    return {
        "trials": (json.dumps({"trials": rows}).encode(), "application/json"),
        "columns": (json.dumps({"columns": {**columns, "qualities": FLEX}}).encode(), "application/json"),
        "lines": ("\n".join(map(json.dumps, rows)).encode(), LINES),
        "arrow": (_stream({**columns, **flat}), ARROW),
        "struct": (_stream({**columns, "qualities": struct}), ARROW),
    }


def _post(http: httpx.Client, body: bytes, media: str, **query: Any) -> httpx.Response:
    return http.post("/objects/mug/trials", content=body, headers={"Content-Type": media}, params=query)


@pytest.mark.parametrize("form", ["trials", "columns", "lines", "arrow", "struct"])
def test_every_form_keeps_them(mug: httpx.Client, form: str) -> None:
    answer = _post(mug, *_bodies()[form])
    assert answer.status_code == 201, answer.text
    stored = mug.get("/objects/mug/trials").json()["items"]
    assert [trial["qualities"] for trial in stored] == ROWS
    assert json.dumps([trial["qualities"] for trial in stored]) == json.dumps(ROWS), "-0.0 and all"
    # The batch's first stands for the one quality.
    assert [trial["quality"] for trial in stored] == [1.0, 0.0, None]
    lines = mug.get("/objects/mug/trials", headers={"Accept": LINES}).text.splitlines()
    assert [json.loads(line)["qualities"] for line in lines] == ROWS
    one = mug.get("/objects/mug/trials/2").json()
    assert one["qualities"] == ROWS[1]
    (batch,) = mug.get("/objects/mug/batches").json()["items"]
    assert batch["qualities"] == ["flex", "motion", "rank/top"]


def test_an_arrow_answer_posted_again_is_the_same(mug: httpx.Client) -> None:
    _post(mug, *_bodies()["columns"])
    _post(mug, json.dumps({**GRASP, "qualities": {"other": 7}}).encode(), "application/json")
    _post(mug, json.dumps(GRASP).encode(), "application/json")
    answer = mug.get("/objects/mug/trials", headers={"Accept": ARROW})
    table = pa.ipc.open_stream(answer.content).read_all()
    named = [name for name in table.column_names if name.startswith("qualities.")]
    assert named == ["qualities.flex", "qualities.motion", "qualities.rank/top", "qualities.other"]
    kept = ["position", "quaternion_xyzw", "outcome", *named]
    assert _post(mug, _stream({name: table[name] for name in kept}), ARROW).status_code == 201
    stored = mug.get("/objects/mug/trials").json()["items"]
    assert [trial["qualities"] for trial in stored] == [*ROWS, {"other": 7.0}, None] * 2


def test_a_quality_that_is_given_stays(mug: httpx.Client) -> None:
    trials = [
        {**GRASP, "quality": 0.5, "qualities": {"b": 1, "a": 2}},
        {**GRASP, "qualities": {"a": 3}},
        {**GRASP, "qualities": {"a": 4, "b": 5}},
        {**GRASP, "qualities": None},
        {**GRASP, "qualities": {"a": None}},
    ]
    mug.post("/objects/mug/trials", json={"trials": trials})
    stored = mug.get("/objects/mug/trials").json()["items"]
    assert [trial["quality"] for trial in stored] == [0.5, None, 5.0, None, None]
    assert [trial["qualities"] for trial in stored] == [
        {"b": 1.0, "a": 2.0},
        {"a": 3.0},
        {"b": 5.0, "a": 4.0},
        None,
        None,
    ]


score = st.one_of(
    st.none(), st.floats(-1e9, 1e9), st.sampled_from([0.0, 1.0, -1.0, 0.5]), st.integers(-9, 9).map(float)
)


@given(st.lists(st.dictionaries(st.sampled_from("abcdef"), score), min_size=1, max_size=6))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_numbers_come_back_as_they_went(mug: httpx.Client, rows: list[dict[str, Any]]) -> None:
    answer = mug.post(
        "/objects/mug/trials", json={"trials": [{**GRASP, "qualities": row} for row in rows]}
    ).json()
    stored = mug.get("/objects/mug/trials", params={"batch": answer["batch"]}).json()["items"]
    wanted = [{name: value for name, value in row.items() if value is not None} for row in rows]
    assert [trial["qualities"] or {} for trial in stored] == wanted


def test_numbers_take_the_narrowest_floats_that_hold_them() -> None:
    scores = np.array([[1.0, 0.5, 0.1, 70_000.0, np.nan], [np.nan, np.float32(0.1), 0.2, 1e9, np.nan]])
    layout = layout_of(["flag", "single", "double", "far", "none"], scores)
    assert layout is not None
    assert [kind for _, kind in layout] == ["<f2", "<f4", "<f8", "<f4", "<f2"]
    assert layout_of([], np.empty(0)) is None


def test_long_columns_are_read_in_pieces(sqlite_http: httpx.Client) -> None:
    count = 40_000
    values = np.random.default_rng(0).normal(size=count)
    columns = {name: [value] * count for name, value in GRASP.items()}
    columns["qualities"] = {"first": values.tolist(), "second": [None, *values[1:].tolist()]}
    sqlite_http.post("/objects", json={"id": "mug"})
    answer = sqlite_http.post("/objects/mug/trials", json={"columns": columns})
    assert answer.status_code == 201, answer.text
    table = pa.ipc.open_stream(sqlite_http.get("/objects/mug/trials", headers={"Accept": ARROW}).content)
    stored = table.read_all()
    assert np.array_equal(stored["qualities.first"].to_numpy(), values)
    assert stored["qualities.second"].to_pylist()[:2] == [None, values[1]]


@pytest.mark.parametrize(
    ("columns", "field"),
    [
        ({"qualities": [{"a": 1}]}, "columns.qualities"),
        ({"qualities": {"a": [1, 2]}}, "columns.qualities.a"),
        ({"qualities": {"a": ["x"]}}, "columns.qualities.a.0"),
        ({"qualities": {"a": [1e10]}}, "columns.qualities.a.0"),
        ({"qualities": {"a": 3}}, "columns.qualities.a"),
        ({"qualities": {"": [1]}}, "columns.qualities.0"),
        ({"qualities": {"ä b": [1]}}, "columns.qualities.0"),
        ({"qualities.a": [1]}, "columns.qualities.a"),
        ({"qualities": {f"q{i}": [1] for i in range(MAX_QUALITIES + 1)}}, "columns.qualities"),
    ],
)
def test_bad_columns_are_named(sqlite_http: httpx.Client, columns: dict[str, Any], field: str) -> None:
    sqlite_http.post("/objects", json={"id": "mug"})
    body = {"columns": {**{name: [value] for name, value in GRASP.items()}, **columns}}
    answer = sqlite_http.post("/objects/mug/trials", json=body)
    assert answer.status_code == 422, answer.text
    assert answer.json()["errors"][0]["field"] == field
    assert sqlite_http.get("/objects/mug").json()["trials"] == 0


@pytest.mark.parametrize(
    ("qualities", "field"),
    [
        (3, "qualities"),
        ([1], "qualities"),
        ({"a": True}, "qualities.a"),
        ({"a": "1"}, "qualities.a"),
        ({"a": {"b": 1}}, "qualities.a"),
        ({"a" * 65: 1}, "qualities"),
        ({"\x00": 1}, "qualities"),
    ],
)
def test_bad_qualities_of_a_trial_are_named(sqlite_http: httpx.Client, qualities: Any, field: str) -> None:
    sqlite_http.post("/objects", json={"id": "mug"})
    answer = sqlite_http.post("/objects/mug/trials", json={**GRASP, "qualities": qualities})
    assert answer.status_code == 422, answer.text
    assert answer.json()["errors"][0]["field"] == field


def test_names_are_limited(sqlite_url: str, serve: Serve) -> None:
    """In a request, however they come, and among all trials of an object."""
    with httpx.Client(base_url=serve(sqlite_url, max_object_qualities=40), timeout=60) as http:
        assert http.get("/info").json()["limits"]["max_object_qualities"] == 40
        http.post("/objects", json={"id": "mug"})
        for rows in (
            [{f"q{i}": 1.0 for i in range(99)}],
            [{f"q{i}": 1.0} for i in range(99)],
            [{f"q{i // 1_000}": 1.0} for i in range(99_000)],
        ):
            lines = "\n".join(json.dumps({**GRASP, "qualities": row}) for row in rows)
            refused = _post(http, lines.encode(), LINES)
            assert refused.status_code == 422, refused.text
            assert refused.json()["type"] == "urn:graspdb:problem:too-many-qualities"
            assert refused.json()["limit"] == MAX_QUALITIES
        wide = {f"qualities.q{i}": [1.0] for i in range(99)}
        assert _post(http, _stream({n: [v] for n, v in GRASP.items()} | wide), ARROW).status_code == 422

        def post(names: list[str]) -> httpx.Response:
            scores = dict.fromkeys(names, 1.0)
            return http.post("/objects/mug/trials", json={**GRASP, "qualities": scores})

        assert post([f"a{i}" for i in range(30)]).status_code == 201
        refused = post([f"b{i}" for i in range(11)])
        assert refused.json()["type"] == "urn:graspdb:problem:too-many-qualities"
        assert refused.json()["errors"][0]["field"] == "qualities.b10"
        assert http.get("/objects/mug").json()["trials"] == 1
        assert post([f"b{i}" for i in range(10)]).status_code == 201
        assert post(["a3", "b3"]).status_code == 201
        assert post(["c"]).status_code == 422


def test_the_same_rows_with_other_qualities_are_no_repetition(sqlite_http: httpx.Client) -> None:
    sqlite_http.post("/objects", json={"id": "mug"})

    def post(**scores: float) -> list[str]:
        body = {"trials": [{**GRASP, "qualities": scores}]}
        return [
            item["code"] for item in sqlite_http.post("/objects/mug/trials", json=body).json()["findings"]
        ]

    assert post(a=1.0, b=2.0) == []
    assert post(b=2.0, a=1.0) == ["posted-before"]
    assert post(a=2.0, b=1.0) == []


def test_a_copy_has_them_too(mug: httpx.Client) -> None:
    _post(mug, *_bodies()["lines"], licence="CC-BY-4.0", citation="Doe 2020", origin_file="mug.h5")
    copied = mug.post("/objects/mug/copies", json={"id": "cup", "trials": True})
    assert copied.status_code == 201, copied.text
    mug.delete("/objects/mug")
    assert [trial["qualities"] for trial in mug.get("/objects/cup/trials").json()["items"]] == ROWS
    (batch,) = mug.get("/objects/cup/batches?licence=CC-BY-4.0").json()["items"]
    assert (batch["citation"], batch["origin"]["file"]) == ("Doe 2020", "mug.h5")
    answer = mug.get("/objects/cup/trials", headers={"Accept": ARROW})
    assert "qualities.flex" in pa.ipc.open_stream(answer.content).schema.names


@pytest.mark.parametrize("form", ["trials", "columns", "arrow"])
def test_a_batch_keeps_whose_it_is_as_told_beside_the_trials(mug: httpx.Client, form: str) -> None:
    told = {"licence": "CC-BY-NC-4.0", "citation": "Eppner et al. 2021", "origin": ORIGIN}
    rows = {name: [value] for name, value in GRASP.items()}
    if form == "arrow":
        answer = _post(mug, _stream(rows, told), ARROW)
    else:
        answer = mug.post("/objects/mug/trials", json={**told, form: rows if form == "columns" else [GRASP]})
    assert answer.status_code == 201, answer.text
    batch = mug.get(answer.headers["location"]).json()
    assert {name: batch[name] for name in told} == told
    plain = mug.get(mug.post("/objects/mug/trials", json=GRASP).headers["location"]).json()
    assert [plain[name] for name in (*told, "qualities")] == [None, None, None, []]


def test_batches_and_trials_are_chosen_by_licence(mug: httpx.Client) -> None:
    for licence in ("CC-BY-4.0", "CC-BY-NC-4.0", "CC-BY-4.0", None):
        given_one = {} if licence is None else {"licence": licence}
        assert _post(mug, json.dumps(GRASP).encode(), LINES, **given_one).status_code == 201
    found = mug.get("/objects/mug/batches", params={"licence": "CC-BY-4.0", "limit": 1}).json()
    more = mug.get("/objects/mug/batches", params={"licence": "CC-BY-4.0", "cursor": found["next"]}).json()
    assert more["next"] is None
    batches = [*found["items"], *more["items"]]
    assert [batch["licence"] for batch in batches] == ["CC-BY-4.0"] * 2

    def seqs(**query: Any) -> list[int]:
        return [trial["seq"] for trial in mug.get("/objects/mug/trials", params=query).json()["items"]]

    assert seqs(licence="CC-BY-4.0") == [1, 3]
    assert seqs(licence="CC-BY-NC-4.0") == [2]
    assert seqs(licence="none such") == []
    assert seqs(licence="CC-BY-4.0", batch=batches[1]["batch"]) == [3]
    assert seqs(licence="CC-BY-NC-4.0", batch=batches[1]["batch"]) == []
    assert len(seqs()) == 4


def test_what_the_address_says_belongs_to_the_request(sqlite_http: httpx.Client) -> None:
    sqlite_http.post("/objects", json={"id": "mug"})
    body = json.dumps({"trials": [GRASP], "licence": "MIT"}).encode()
    twice = _post(sqlite_http, body, "application/json", licence="MIT")
    assert twice.status_code == 422
    assert twice.json()["errors"][0]["field"] == "licence"
    misplaced = _post(sqlite_http, json.dumps({**GRASP, "licence": "MIT"}).encode(), LINES)
    assert "in the address" in misplaced.json()["errors"][0]["message"]
    headers = {"Content-Type": LINES, "Idempotency-Key": "k"}
    line = json.dumps(GRASP)

    def post(**query: str) -> httpx.Response:
        return sqlite_http.post("/objects/mug/trials", content=line, headers=headers, params=query)

    first = post(licence="MIT", origin_sha256=SHA256)
    assert first.status_code == 201
    assert post(licence="MIT", origin_sha256=SHA256).json() == first.json()
    assert post(licence="BSD").json()["type"] == "urn:graspdb:problem:idempotency-key-reused"
    for query in ({"licence": ""}, {"licence": "x" * 101}, {"origin_sha256": "FF"}, {"origin": "x"}):
        assert post(**query).status_code == 422, query
    batch = sqlite_http.get(first.headers["location"]).json()
    assert (batch["licence"], batch["origin"]) == ("MIT", {"file": None, "format": None, "sha256": SHA256})
