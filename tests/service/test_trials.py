"""Trials: four forms of a body, one of an answer; a batch whole or not at all."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from graspdb.wire import OUTCOMES, SOURCES

Serve = Callable[..., str]
Q = [0.0, 0.0, 0.0, 1.0]
GRASP: dict[str, Any] = {"position": [0.01, -0.02, 0.1], "quaternion_xyzw": Q, "outcome": "success"}
LINES = {"Content-Type": "application/x-ndjson"}
JSON = {"Content-Type": "application/json"}


@pytest.fixture
def mug(http: httpx.Client) -> httpx.Client:
    """A client of a service that has an object ``mug``."""
    http.post("/objects", json={"id": "mug"})
    return http


def _all(http: httpx.Client, **query: Any) -> list[dict[str, Any]]:
    answer = http.get("/objects/mug/trials", params=query, headers={"Accept": "application/x-ndjson"})
    assert answer.status_code == 200, answer.text
    return [json.loads(line) for line in answer.text.split("\n") if line]


def test_one_trial(mug: httpx.Client) -> None:
    answer = mug.post("/objects/mug/trials", json=GRASP)
    assert answer.status_code == 201, answer.text
    receipt = answer.json()
    assert receipt == {"batch": receipt["batch"], "inserted": 1, "revision": 1, "findings": []}
    assert answer.headers["location"] == f"/objects/mug/batches/{receipt['batch']}"
    page = mug.get("/objects/mug/trials").json()
    assert page["next"] is None
    (trial,) = page["items"]
    assert trial.items() >= {**GRASP, "seq": 1, "revision": 1, "batch": receipt["batch"]}.items()
    assert (trial["gripper"], trial["sweep"], trial["pose_index"]) == (None, None, None)


def test_defaults_stand_once_for_the_whole_batch(mug: httpx.Client) -> None:
    body = {
        "trials": [GRASP, {**GRASP, "gripper": "panda", "metadata": {"own": 1}, "proposal_density": 3.0}],
        "gripper": "pg70",
        "source": "robot",
        "protocol": "lift",
        "proposal_density": 2.5,
        "metadata": {"run": 7},
    }
    assert mug.post("/objects/mug/trials", json=body).json()["inserted"] == 2
    first, second = _all(mug)
    shared = {"source": "robot", "protocol": "lift"}
    assert first.items() >= {**shared, "gripper": "pg70", "proposal_density": 2.5}.items()
    assert second.items() >= {**shared, "gripper": "panda", "proposal_density": 3.0}.items()
    assert (first["metadata"], second["metadata"]) == ({"run": 7}, {"own": 1})


def test_columns_and_lines_store_the_same(mug: httpx.Client) -> None:
    rng = np.random.default_rng(3)
    quaternions = rng.normal(size=(50, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    columns = {
        "position": rng.normal(size=(50, 3)).tolist(),
        "quaternion_xyzw": quaternions.tolist(),
        "outcome": [OUTCOMES[i % 9] for i in range(50)],
        "gripper": ["pg70" if i % 3 else None for i in range(50)],
        "source": [SOURCES[i % 4] for i in range(50)],
        "quality": [None if i % 5 == 0 else i / 7 for i in range(50)],
        "width_m": [i / 1000 for i in range(50)],
        "measured_at": ["2026-01-02T03:04:05.678901+02:00" if i % 2 else None for i in range(50)],
        "metadata": [{"i": i} if i % 7 == 0 else None for i in range(50)],
        "pose_covariance": [np.eye(6).tolist() if i % 11 == 0 else None for i in range(50)],
    }
    rows = [{name: column[i] for name, column in columns.items()} for i in range(50)]
    assert mug.post("/objects/mug/trials", json={"columns": columns}).status_code == 201
    lines = "\n".join(json.dumps(row) for row in rows) + "\n\n"
    assert mug.post("/objects/mug/trials", content=lines, headers=LINES).json()["inserted"] == 50
    assert mug.post("/objects/mug/trials", json={"trials": rows}).json()["inserted"] == 50
    stored = _all(mug)
    own = [{k: v for k, v in t.items() if k not in ("seq", "revision", "batch")} for t in stored]
    assert own[:50] == own[50:100] == own[100:]
    assert [t["seq"] for t in stored] == list(range(1, 151))
    assert stored[1]["measured_at"] == "2026-01-02T01:04:05.678901+00:00"
    for row, trial in zip(rows, stored, strict=False):
        for name in (
            "position",
            "quality",
            "width_m",
            "outcome",
            "gripper",
            "source",
            "metadata",
            "pose_covariance",
        ):
            assert trial[name] == row[name]


def test_pose_as_a_matrix(mug: httpx.Client) -> None:
    turn = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    body = {"trials": [GRASP, {"matrix": turn, "outcome": False}]}
    assert mug.post("/objects/mug/trials", json=body).status_code == 201
    second = _all(mug)[1]
    assert second["position"] == [0.1, 0.2, 0.3]
    assert second["quaternion_xyzw"] == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5])
    assert second["outcome"] == "failure"


def test_nearly_unit_quaternion_is_normalised(mug: httpx.Client) -> None:
    mug.post("/objects/mug/trials", json={**GRASP, "quaternion_xyzw": [0, 0, 0, 1.0009]})
    mug.post("/objects/mug/trials", json={**GRASP, "quaternion_xyzw": [0, 0, 0.6, -0.8]})
    assert [t["quaternion_xyzw"] for t in _all(mug)] == [[0, 0, 0, 1], [0, 0, 0.6, -0.8]]


finite = {"allow_nan": False, "allow_infinity": False}


@st.composite
def _trials(draw: st.DrawFn) -> list[dict[str, Any]]:
    number = st.floats(-1000, 1000, **finite)
    trials = []
    for _ in range(draw(st.integers(1, 5))):
        axis = draw(st.lists(st.integers(-9, 9), min_size=4, max_size=4).filter(any))
        norm = math.sqrt(sum(x * x for x in axis))
        trial = {
            "position": draw(st.lists(number, min_size=3, max_size=3)),
            "quaternion_xyzw": [x / norm for x in axis],
            "outcome": draw(st.sampled_from(OUTCOMES)),
        }
        optional: dict[str, st.SearchStrategy[Any]] = {
            "gripper": st.sampled_from(["pg70", "panda"]),
            "source": st.sampled_from(SOURCES),
            "protocol": st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,9}", fullmatch=True),
            "proposal_density": st.floats(1e-30, 1e15, **finite),
            "quality": st.floats(-1e9, 1e9, **finite),
            "width_m": st.floats(0, 10, **finite),
            "metadata": st.dictionaries(
                st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=5),
                st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats(**finite),
                max_size=3,
            ),
        }
        for name, strategy in optional.items():
            if draw(st.booleans()):
                trial[name] = draw(strategy)
        trials.append(trial)
    return trials


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(trials=_trials(), form=st.sampled_from(["trials", "columns", "lines"]))
def test_what_is_posted_is_read_back(mug: httpx.Client, trials: list[dict[str, Any]], form: str) -> None:
    if form == "lines":
        content = b"\n".join(json.dumps(trial).encode() for trial in trials)
        answer = mug.post("/objects/mug/trials", content=content, headers=LINES)
    elif form == "columns":
        names = sorted(set().union(*trials))
        columns = {name: [trial.get(name) for trial in trials] for name in names}
        answer = mug.post("/objects/mug/trials", json={"columns": columns})
    else:
        answer = mug.post("/objects/mug/trials", json={"trials": trials})
    assert answer.status_code == 201, answer.text
    stored = _all(mug, batch=answer.json()["batch"])
    assert len(stored) == len(trials)
    for sent, found in zip(trials, stored, strict=True):
        assert found["quaternion_xyzw"] == pytest.approx(sent["quaternion_xyzw"], abs=1e-15)
        assert found["gripper_version"] == (None if sent.get("gripper") is None else 1)
        own = {"quaternion_xyzw", "seq", "revision", "batch", "withdrawn", "gripper_version"}
        for name in set(found) - own:
            assert found[name] == sent.get(name), name


def _bad() -> Iterator[tuple[str, str, list[str]]]:
    """Bodies and the fields they must be refused for."""

    def with_(**change: Any) -> str:
        return json.dumps({**GRASP, **change})

    def without(name: str) -> str:
        return json.dumps({k: v for k, v in GRASP.items() if k != name})

    columns = {"position": [[0, 0, 0]] * 3, "quaternion_xyzw": [Q] * 3, "outcome": [True] * 3}
    for name in GRASP:
        yield f"no {name}", without(name), [name]
        yield f"null {name}", with_(**{name: None}), [name]
    yield "zero quaternion", with_(quaternion_xyzw=[0, 0, 0, 0]), ["quaternion_xyzw"]
    yield "long quaternion", with_(quaternion_xyzw=[0, 0, 0, 2]), ["quaternion_xyzw"]
    yield "off quaternion", with_(quaternion_xyzw=[0, 0, 0, 1.0011]), ["quaternion_xyzw"]
    yield "short quaternion", with_(quaternion_xyzw=[0, 0, 1]), ["quaternion_xyzw"]
    yield "tiny quaternion", with_(quaternion_xyzw=[1e-320, 0, 0, 0]), ["quaternion_xyzw"]
    yield "large quaternion", with_(quaternion_xyzw=[1e308, 1e308, 1e308, 1e308]), ["quaternion_xyzw"]
    yield "far", with_(position=[0, 0, 1e4]), ["position"]
    yield "huge integer", with_(position=[0, 0, 10**400]), ["position"]
    yield "2 numbers", with_(position=[0, 0]), ["position"]
    yield "nested", with_(position=[[0, 0, 0]]), ["position"]
    yield "text", with_(position=["0", "0", "0"]), ["position"]
    yield "text list", with_(position="0,0,0"), ["position"]
    yield "booleans", with_(position=[True, False, True]), ["position"]
    yield "outcome name", with_(outcome="yes"), ["outcome"]
    yield "outcome number", with_(outcome=1), ["outcome"]
    yield "outcome list", with_(outcome=["success"]), ["outcome"]
    yield "unknown field", with_(posiiton=1), ["posiiton"]
    yield "gripper name", with_(gripper="a b"), ["gripper"]
    yield "gripper NUL", with_(gripper="a\x00"), ["gripper"]
    yield "gripper unknown", with_(gripper="nope"), ["gripper"]
    yield "gripper number", with_(gripper=3), ["gripper"]
    yield "source", with_(source="guess"), ["source"]
    yield "protocol", with_(protocol="x" * 65), ["protocol"]
    yield "proposal 0", with_(proposal_density=0), ["proposal_density"]
    yield "proposal < 0", with_(proposal_density=-1), ["proposal_density"]
    yield "proposal text", with_(proposal_density="1"), ["proposal_density"]
    yield "width < 0", with_(width_m=-0.01), ["width_m"]
    yield "width bool", with_(width_m=True), ["width_m"]
    yield "quality", with_(quality=1e300), ["quality"]
    yield "time", with_(measured_at="yesterday"), ["measured_at"]
    yield "time number", with_(measured_at=5), ["measured_at"]
    yield "time early", with_(measured_at="0001-01-01T00:00:00+14:00"), ["measured_at"]
    yield "covariance shape", with_(pose_covariance=[[1]]), ["pose_covariance"]
    yield "covariance sign", with_(pose_covariance=(-np.eye(6)).tolist()), ["pose_covariance"]
    yield "covariance skew", with_(pose_covariance=np.triu(np.ones((6, 6))).tolist()), ["pose_covariance"]
    yield "metadata", with_(metadata=[1]), ["metadata"]
    yield "metadata NUL", with_(metadata={"a": "\x00"}), ["metadata"]
    yield "metadata size", with_(metadata={"a": "x" * 70_000}), ["metadata"]
    yield "surrogate", '{"\\ud800": 1, ' + json.dumps(GRASP)[1:], ["?"]
    yield "matrix and position", with_(matrix=np.eye(4).tolist()), ["matrix"]
    yield "matrix scale", json.dumps({"matrix": (2 * np.eye(4)).tolist(), "outcome": True}), ["matrix"]
    yield "index", json.dumps({"trials": [GRASP] * 3 + [{**GRASP, "position": [0]}]}), ["trials.3.position"]
    yield "no trials", json.dumps({"trials": []}), ["trials"]
    yield "trials object", json.dumps({"trials": {}}), ["trials"]
    yield "trial null", json.dumps({"trials": [GRASP, None]}), ["trials.1"]
    yield "beside", json.dumps({"trials": [GRASP], "griper": "pg70"}), ["griper"]
    yield "both", json.dumps({"trials": [GRASP], "columns": columns}), ["trials"]
    yield "beside value", json.dumps({"trials": [GRASP], "proposal_density": 0}), ["proposal_density"]
    yield "default gripper", json.dumps({"trials": [GRASP], "gripper": "nope"}), ["gripper"]
    yield (
        "column missing",
        json.dumps({"columns": {"position": [[0, 0, 0]]}}),
        [
            "columns.quaternion_xyzw",
            "columns.outcome",
        ],
    )
    yield "column unknown", json.dumps({"columns": {**columns, "pose": []}}), ["columns.pose"]
    yield "column length", json.dumps({"columns": {**columns, "outcome": [True]}}), ["columns.outcome"]
    yield (
        "column value",
        json.dumps({"columns": {**columns, "outcome": [True, True, "no"]}}),
        ["columns.outcome.2"],
    )
    yield "column scalar", json.dumps({"columns": {**columns, "gripper": "pg70"}}), ["columns.gripper"]
    yield "columns empty", json.dumps({"columns": {name: [] for name in columns}}), ["columns.position"]
    yield "columns list", json.dumps({"columns": []}), ["columns"]
    yield "truncated", '{"position":[0,0', ["body"]
    yield "list", json.dumps([GRASP]), ["body"]
    yield "number", "3", ["body"]
    yield "empty", "", ["body"]
    yield "deep", "[" * 200_000, ["body"]
    yield "not text", "\udcff", ["body"]


def test_bad_body_names_its_fields_and_stores_nothing(mug: httpx.Client) -> None:
    for what, body, fields in _bad():
        content = body.encode("utf-8", "surrogateescape")
        answer = mug.post("/objects/mug/trials", content=content, headers=JSON)
        assert answer.status_code == 422, (what, answer.text)
        assert answer.headers["content-type"] == "application/problem+json"
        assert [error["field"] for error in answer.json()["errors"]] == fields, what
    after = mug.get("/objects/mug").json()
    assert (after["trials"], after["revision"]) == (0, 0)
    assert mug.get("/objects/mug/batches").json()["items"] == []


NUMBERS = {
    "position": "[{}, 0, 0]",
    "quaternion_xyzw": "[0, {}, 0, 1]",
    "proposal_density": "{}",
    "quality": "{}",
    "width_m": "{}",
    "pose_covariance": "[" + ", ".join(["[{}, 0, 0, 0, 0, 0]"] * 6) + "]",
    "metadata": '{{"deep": [{{"x": {}}}]}}',
}


@pytest.mark.parametrize("bad", ["NaN", "Infinity", "-Infinity", "1e999", "-1e999"])
def test_no_float_field_takes_what_is_not_finite(mug: httpx.Client, bad: str) -> None:
    grasp = json.dumps(GRASP)[1:-1]
    for name, form in NUMBERS.items():
        value = form.replace("{}", bad).replace("{{", "{").replace("}}", "}")
        own = f'{{{grasp}, "{name}": {value}}}'
        bodies = {
            name: (own, JSON),
            f"trials.1.{name}": (f'{{"trials": [{{{grasp}}}, {own}]}}', JSON),
            f"trials.1.{name} ": (f"{{{grasp}}}\n{own}\n", LINES),
        }
        columns = {"position": [GRASP["position"]], "quaternion_xyzw": [Q], "outcome": [True]}
        columns.pop(name, None)
        given_columns = json.dumps(columns)[1:-1]
        bodies[f"columns.{name}.0"] = (f'{{"columns": {{{given_columns}, "{name}": [{value}]}}}}', JSON)
        if name in ("proposal_density", "metadata"):
            bodies[f"{name} "] = (f'{{"trials": [{{{grasp}}}], "{name}": {value}}}', JSON)
        for field, (content, headers) in bodies.items():
            answer = mug.post("/objects/mug/trials", content=content, headers=headers)
            assert answer.status_code == 422, (field, answer.text)
            assert [error["field"] for error in answer.json()["errors"]] == [field.strip()]
    assert mug.get("/objects/mug").json()["revision"] == 0


def test_bad_line_is_named(mug: httpx.Client) -> None:
    good = json.dumps(GRASP)
    for bad, field in (('{"position"', "trials.1"), ("[]", "trials.1"), (f"{good},{good}", "trials.1")):
        answer = mug.post("/objects/mug/trials", content=f"{good}\n{bad}\n{good}", headers=LINES)
        assert answer.status_code == 422
        assert answer.json()["errors"][0]["field"] == field
    assert mug.post("/objects/mug/trials", content="\n \n", headers=LINES).status_code == 422
    assert mug.get("/objects/mug").json()["trials"] == 0


def test_many_errors_are_named_up_to_a_number(mug: httpx.Client) -> None:
    body = {
        "columns": {"position": [[0, 0, None]] * 500, "quaternion_xyzw": [Q] * 500, "outcome": [True] * 500}
    }
    errors = mug.post("/objects/mug/trials", json=body).json()["errors"]
    assert [error["field"] for error in errors] == [f"columns.position.{i}" for i in range(20)]


def test_other_media_types_are_415(mug: httpx.Client) -> None:
    for media in ("text/csv", "application/x-www-form-urlencoded", "multipart/form-data"):
        answer = mug.post("/objects/mug/trials", content=json.dumps(GRASP), headers={"Content-Type": media})
        assert answer.status_code == 415
    assert mug.post("/objects/none/trials", json=GRASP).status_code == 404


def test_too_many_trials_are_413_and_say_how_to_split(sqlite_url: str, serve: Serve) -> None:
    with httpx.Client(base_url=serve(sqlite_url, max_batch_trials=3)) as http:
        http.post("/objects", json={"id": "mug"})
        columns = {"position": [[0, 0, 0]] * 4, "quaternion_xyzw": [Q] * 4, "outcome": [True] * 4}
        lines = "\n".join([json.dumps(GRASP)] * 4)
        for answer in (
            http.post("/objects/mug/trials", json={"trials": [GRASP] * 4}),
            http.post("/objects/mug/trials", json={"columns": columns}),
            http.post("/objects/mug/trials", content=lines, headers=LINES),
        ):
            assert answer.status_code == 413
            assert answer.json()["limit"] == 3
            assert "batches of at most 3" in answer.json()["title"]
        assert http.post("/objects/mug/trials", json={"trials": [GRASP] * 3}).status_code == 201


def test_filters_select_rows(mug: httpx.Client) -> None:
    def add(**more: Any) -> dict[str, Any]:
        answer = mug.post("/objects/mug/trials", json={**GRASP, **more})
        receipt: dict[str, Any] = answer.json()
        return receipt

    add()
    add(gripper="pg70", source="robot", outcome="slipped")
    third = add(gripper="pg70", source="simulation", protocol="lift")
    add(gripper="panda", source="simulation", protocol="wrench", outcome=False)

    def seqs(**query: Any) -> list[int]:
        return [trial["seq"] for trial in mug.get("/objects/mug/trials", params=query).json()["items"]]

    assert seqs() == [1, 2, 3, 4]
    assert seqs(outcome="success") == [1, 3]
    assert seqs(outcome="slipped") == [2]
    assert seqs(gripper="pg70") == [2, 3]
    assert seqs(source="simulation") == [3, 4]
    assert seqs(protocol="lift", gripper="pg70") == [3]
    assert seqs(protocol="lift", gripper="panda") == []
    assert seqs(gripper="unheard-of") == []
    assert seqs(batch=third["batch"]) == [3]
    assert seqs(batch="nope") == []
    assert seqs(since_revision=2) == [3, 4]
    assert seqs(since_revision=third["revision"], outcome="failure") == [4]
    for query in (
        "outcome=good",
        "source=x",
        "since_revision=-1",
        "since_revision=1e999",
        "gripper=a%00",
        "grip=x",
    ):
        assert mug.get(f"/objects/mug/trials?{query}").status_code == 422, query


def test_pages_and_streams_cover_every_row_once(mug: httpx.Client) -> None:
    columns = {
        "position": [[i / 1000, 0, 0] for i in range(250)],
        "quaternion_xyzw": [Q] * 250,
        "outcome": [True] * 250,
    }
    mug.post("/objects/mug/trials", json={"columns": columns})
    seen: list[int] = []
    query: dict[str, Any] = {"limit": 100}
    while True:
        page = mug.get("/objects/mug/trials", params=query).json()
        seen += [trial["seq"] for trial in page["items"]]
        if page["next"] is None:
            break
        query["cursor"] = page["next"]
    assert seen == list(range(1, 251))
    assert [trial["seq"] for trial in _all(mug)] == seen
    assert len(_all(mug, limit=7)) == 7
    assert len(mug.get("/objects/mug/trials").json()["items"]) == 100


def test_stream_spans_its_pieces(mug: httpx.Client) -> None:
    count = 12_345
    columns = {
        "position": [[0, 0, 0]] * count,
        "quaternion_xyzw": [Q] * count,
        "outcome": [i % 2 == 0 for i in range(count)],
    }
    assert mug.post("/objects/mug/trials", json={"columns": columns}).json()["inserted"] == count
    assert [trial["seq"] for trial in _all(mug)] == list(range(1, count + 1))
    assert [trial["seq"] for trial in _all(mug, outcome="success")] == list(range(1, count + 1, 2))


def test_list_has_an_etag_of_its_own_for_each_form(mug: httpx.Client) -> None:
    mug.post("/objects/mug/trials", json=GRASP)
    page = mug.get("/objects/mug/trials")
    lines = mug.get("/objects/mug/trials", headers={"Accept": "application/x-ndjson"})
    assert page.headers["etag"] != lines.headers["etag"]
    tag = {"If-None-Match": page.headers["etag"]}
    assert mug.get("/objects/mug/trials", headers=tag).status_code == 304
    assert mug.get("/objects/mug/trials?limit=1", headers=tag).status_code == 200
    mug.post("/objects/mug/trials", json=GRASP)
    assert mug.get("/objects/mug/trials", headers=tag).status_code == 200
    assert mug.get("/objects/mug/trials", headers={"Accept": "image/png"}).status_code == 406


def test_tail_by_revision_loses_no_row_while_many_write(mug: httpx.Client) -> None:
    """Sequence numbers have no gap and become visible in order, whoever commits first."""
    batches, threads = 15, 8
    done = threading.Event()
    tail: list[dict[str, Any]] = []

    def write(number: int) -> None:
        rng = np.random.default_rng(number)
        for _ in range(batches):
            size = int(rng.integers(1, 9))
            answer = mug.post(
                "/objects/mug/trials", json={"trials": [GRASP] * size, "protocol": f"p{number % 3}"}
            )
            assert answer.status_code == 201, answer.text

    def follow() -> None:
        while True:
            last = done.is_set()
            found = _all(mug, since_revision=tail[-1]["revision"] if tail else 0)
            tail.extend(found)
            if last:
                return

    follower = threading.Thread(target=follow)
    follower.start()
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(write, range(threads)))
    done.set()
    follower.join()
    count = mug.get("/objects/mug").json()["trials"]
    assert [trial["seq"] for trial in tail] == list(range(1, count + 1))
    revisions = [trial["revision"] for trial in tail]
    assert revisions == sorted(revisions)
    assert set(revisions) == set(range(1, batches * threads + 1))
    owners = {trial["revision"]: trial["batch"] for trial in tail}
    assert all(owners[trial["revision"]] == trial["batch"] for trial in tail)
