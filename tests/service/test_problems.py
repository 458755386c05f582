"""Errors are problems (RFC 9457) that name the field and never echo the input."""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Callable
from typing import Any

import httpx
import pytest

from graspdb_service.settings import Settings
from graspdb_service.storage import database

Serve = Callable[..., str]
JSON = {"Content-Type": "application/json"}
NOT_FINITE = ("NaN", "Infinity", "-Infinity", "1e999", "-1e999")

OBJECT: dict[str, Any] = {
    "id": "cup",
    "mass_kg": 0.1,
    "density_kg_m3": 900,
    "friction": 0.4,
    "metadata": {"a": 1.5},
}
GRIPPER: dict[str, Any] = {
    "id": "mine",
    "max_opening_m": 0.05,
    "finger": {"width_m": 0.01, "thickness_m": 0.01, "length_m": 0.05},
    "tip_offset_m": 0.01,
    "palm_size_m": [0.05, 0.08, 0.05],
    "finger_mass_kg": 0.1,
    "max_speed_m_s": 0.05,
    "max_acceleration_m_s2": 1.0,
    "force_n": 20.0,
    "friction": 0.5,
    "base_to_tool": {"position": [0, 0, 0.1], "quaternion_xyzw": [0, 0, 0, 1]},
}


def _numbers(document: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all numbers in a document."""
    if isinstance(document, dict):
        items: Any = document.items()
    elif isinstance(document, list):
        items = enumerate(document)
    else:
        return [path] if isinstance(document, (int, float)) else []
    return [found for key, value in items for found in _numbers(value, (*path, key))]


def _with(document: Any, path: tuple[Any, ...], literal: str) -> str:
    """The document as text with one number replaced by a literal."""
    copy = json.loads(json.dumps(document))
    place = copy
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = "@"
    return json.dumps(copy).replace('"@"', literal)


@pytest.mark.parametrize("bad", NOT_FINITE)
def test_no_float_field_takes_what_is_not_finite(http: httpx.Client, bad: str) -> None:
    http.post("/objects", json={"id": "mug"})
    patch = {key: value for key, value in OBJECT.items() if key != "id"}
    for method, url, body in (
        ("POST", "/objects", OBJECT),
        ("PATCH", "/objects/mug", patch),
        ("POST", "/grippers", GRIPPER),
    ):
        for path in _numbers(body):
            answer = http.request(method, url, content=_with(body, path, bad), headers=JSON)
            assert answer.status_code == 422, (url, path, answer.text)
            field = answer.json()["errors"][0]["field"]
            assert field.split(".")[0] == path[0]
            assert bad not in answer.text
    assert [item["id"] for item in http.get("/objects").json()["items"]] == ["mug"]
    assert http.get("/objects/mug").json()["revision"] == 0
    assert all(item["builtin"] for item in http.get("/grippers").json()["items"])


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"id": "cup", "mass_kg": ' + b"9" * 5_000 + b"}",
        b'{"id": "cup", "name": "\\u0000"}',
        b'{"id": "cup", "name": "\\ud800"}',
        b'{"id": "cup", "\\ud800": 1}',
        b'{"id": "cup", "metadata": {"\\ud800": 1}}',
        b'{"id": "cup", "metadata": {"a": "\\u0000"}}',
        b'{"id": "cup", "metadata": ' + b'{"a":' * 900 + b"1" + b"}" * 900 + b"}",
        b'{"id": "cup", "metadata": {"a": "' + b"x" * 70_000 + b'"}}',
        b'{"id": "cup", "name": "' + b"x" * 5_000 + b'"}',
    ],
    ids=lambda body: body[:40].decode("latin-1"),
)  # fmt: skip
def test_hostile_body_is_a_problem(http: httpx.Client, body: bytes) -> None:
    answer = http.post("/objects", content=body, headers=JSON)
    assert 400 <= answer.status_code < 500, answer.text
    problem = answer.json()
    assert answer.headers["content-type"] == "application/problem+json"
    assert problem["type"].startswith("urn:graspdb:problem:")
    assert problem["status"] == answer.status_code
    assert problem["request_id"] == answer.headers["x-request-id"]
    assert len(answer.content) < 5_000
    assert http.get("/objects").json()["items"] == []


def test_body_that_is_no_json_is_415(sqlite_http: httpx.Client) -> None:
    answer = sqlite_http.post("/objects", data={"id": "cup"})
    assert answer.status_code == 415
    assert "application/json" in answer.json()["title"]


def test_wrong_method_and_path_are_problems(sqlite_http: httpx.Client) -> None:
    wrong = sqlite_http.put("/objects")
    assert (wrong.status_code, wrong.json()["type"]) == (405, "urn:graspdb:problem:method-not-allowed")
    missing = sqlite_http.get("/object")
    assert (missing.status_code, missing.json()["type"]) == (404, "urn:graspdb:problem:not-found")


@pytest.mark.parametrize("chunked", [False, True])
def test_body_over_the_limit_is_413(sqlite_url: str, serve: Serve, chunked: bool) -> None:
    with httpx.Client(base_url=serve(sqlite_url, max_body_bytes=10_000)) as http:
        http.post("/objects", json={"id": "mug"})
        body = b'{"trials": [' + b" " * 20_000 + b"]}"
        content: Any = (body[i : i + 1_000] for i in range(0, len(body), 1_000)) if chunked else body
        answer = http.post("/objects/mug/trials", content=content, headers=JSON)
        assert answer.status_code == 413
        assert answer.headers["content-type"] == "application/problem+json"
        assert http.get("/objects/mug").json()["trials"] == 0


def test_every_limit_is_told(sqlite_http: httpx.Client) -> None:
    limits = sqlite_http.get("/info").json()["limits"]
    assert set(limits) == {name for name in Settings.model_fields if name.startswith(("max_", "min_"))}


def test_huge_header_is_refused(sqlite_http: httpx.Client) -> None:
    """Raw, for a client would rather not send it: the service must not hold megabytes of a header."""
    url = sqlite_http.base_url
    with socket.create_connection((url.host, url.port or 80), timeout=20) as connection:
        connection.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\nX-Junk: " + b"x" * 1_000)
        try:
            for _ in range(300):
                connection.sendall(b"x" * 10_000)
            connection.sendall(b"\r\n\r\n")
            status = re.match(rb"HTTP/1.1 (\d+)", connection.recv(100))
        except OSError:
            return
    assert status is None or status.group(1).startswith(b"4")


def test_bug_is_a_500_without_its_details(
    sqlite_url: str, serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    from graspdb_service.usecases import objects

    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("the password is swordfish")

    with httpx.Client(base_url=serve(sqlite_url)) as http:
        monkeypatch.setattr(objects, "page", broken)
        answer = http.get("/objects")
    assert answer.status_code == 500
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["request_id"] == answer.headers["x-request-id"]
    assert "swordfish" not in answer.text


def test_busy_database_is_503_and_stores_nothing(
    sqlite_url: str, serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database, "SQLITE_BUSY_MS", 50)
    with httpx.Client(base_url=serve(sqlite_url)) as http:
        http.post("/objects", json={"id": "mug"})
        other = database.Database(sqlite_url)
        with other.write():
            answer = http.post("/objects", json={"id": "cup"}, headers={"Idempotency-Key": "k"})
            assert http.get("/objects/mug").status_code == 200
        other.dispose()
        assert answer.status_code == 503
        assert answer.headers["retry-after"]
        assert answer.json()["type"].endswith(":database-unavailable")
        assert http.post("/objects", json={"id": "cup"}, headers={"Idempotency-Key": "k"}).status_code == 201


@pytest.mark.parametrize(
    ("path", "body", "field", "told"),
    [
        ("/objects", {"id": "m", "mass": 1.0}, "mass", "did you mean 'mass_kg'?"),
        ("/objects/mug/best-grasp", {"object_pos": [0, 0, 0]}, "object_pos", "did you mean 'object_pose'?"),
        ("/grippers", {"id": "g", "finger": {"length": 0.04}}, "finger.length", "did you mean 'length_m'?"),
        (
            "/grippers",
            {"id": "hand", "fingers": 3},
            "fingers",
            "hands with more fingers can't be described yet",
        ),
        ("/grippers", {"id": "cup", "suction_cups": 4}, "suction_cups", "suction cups and hands"),
        ("/objects/mug/trials", {"trials": [{"posiiton": [0, 0, 0]}]}, "trials.0.posiiton", "'position'?"),
    ],
)
def test_an_unknown_field_is_told_what_was_meant(
    sqlite_http: httpx.Client, path: str, body: Any, field: str, told: str
) -> None:
    sqlite_http.post("/objects", json={"id": "mug"})
    answer = sqlite_http.post(path, json=body)
    assert answer.status_code == 422
    assert any(told in error["message"] for error in answer.json()["errors"] if error["field"] == field)
