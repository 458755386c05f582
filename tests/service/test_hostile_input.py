"""Strings, headers, cursors and bodies that nobody sends by mistake: refused by name, never a failure."""

from __future__ import annotations

import base64
import json
import socket
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import quote

import httpx
import pytest

Serve = Callable[..., str]
JSON = {"Content-Type": "application/json"}
POSE = {"position": [0, 0, 0.1], "quaternion_xyzw": [1, 0, 0, 0]}
TEXTS = {
    "nul": "a\0b",
    "control": "a\x1b[2Jb",
    "right to left": "\u202eabc\u2066",
    "emoji": "🙂" * 20,
    "combining": "e\u0301" * 100,
    "not a character": "\uffff\U0010ffff",
    "long": "x" * 300,
    "longer": "x" * 20_000,
    "quotes": "'; DROP TABLE objects; --",
    "per cent": "%00%s{0}",
    "dots": "../../etc/passwd",
    "blank": " ",
}


@pytest.fixture(scope="module")
def clients(
    tmp_path_factory: pytest.TempPathFactory, serve_module: Serve, postgres_module_url: str
) -> Iterator[list[httpx.Client]]:
    """Clients of a service on SQLite and of one on PostgreSQL, each with a mug that has a trial."""
    folder = tmp_path_factory.mktemp("hostile")
    urls = f"sqlite:///{folder / 'graspdb.sqlite'}", postgres_module_url
    made = [httpx.Client(base_url=serve_module(url), timeout=60) for url in urls]
    for http in made:
        http.post("/objects", json={"id": "mug"}).raise_for_status()
        http.post("/objects/mug/trials", json={**POSE, "outcome": True}).raise_for_status()
    yield made
    for http in made:
        http.close()


def _refused(answer: httpx.Response) -> None:
    told = (answer.request.method, str(answer.request.url)[:200], answer.text[:300])
    assert 400 <= answer.status_code < 500, told
    assert answer.headers["content-type"] == "application/problem+json", told
    assert len(answer.content) < 5_000, told


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_strange_ids_are_of_nothing(clients: list[httpx.Client], text: str) -> None:
    name = quote(text, safe="")
    paths = [f"/objects/{name}", f"/grippers/{name}", f"/kernels/{name}", f"/sweeps/{name}"]
    paths += [f"/report-runs/{name}", f"/objects/mug/batches/{name}", f"/objects/{name}/density"]
    for http in clients:
        for path in paths:
            _refused(http.get(path))
            assert http.get("/objects/mug").status_code == 200
        for path in (
            f"/objects/{name}",
            f"/grippers/{name}",
            f"/kernels/{name}",
            f"/objects/mug/batches/{name}",
        ):
            _refused(http.delete(path))
        for parameter in ("batch", "gripper", "protocol", "source", "cursor", "nothing"):
            answer = http.get(f"/objects/mug/trials?{parameter}={name}")
            assert answer.status_code < 500
        for path in ("/sweeps", "/kernels"):
            assert http.get(f"{path}?object={name}").status_code in (404, 422)
        for call in ("lease", "result", "failure"):
            _refused(http.put(f"/jobs/{name}/{call}?lease_id={name}", json={"error": "x"}))


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_strange_texts_come_back_or_are_refused(clients: list[httpx.Client], text: str) -> None:
    for http in clients:
        for field in ("gripper", "protocol", "source", "outcome"):
            _refused(http.post("/objects/mug/trials", json={**POSE, "outcome": True, field: text}))
        _refused(http.post("/objects", json={"id": text}))
        changed = http.patch("/objects/mug", json={"name": text, "metadata": {text: [text]}})
        if changed.status_code == 200:
            assert http.get("/objects/mug").json()["name"] == text
            assert http.get("/objects/mug").json()["metadata"] == {text: [text]}
        else:
            _refused(changed)
        corrected = http.patch("/objects/mug/trials/1", json={"metadata": {text: text}, "reason": text})
        assert corrected.status_code in (200, 422)
        claim = {"worker": text, "capabilities": [text]}
        assert http.post("/jobs/claim", json=claim).status_code in (200, 422)


KEYS = {
    "empty": b"", "latin": "schlüssel".encode("latin-1"), "utf-8": "ключ".encode(), "blank": b"a b",
    "long": b"k" * 201, "control": b"a\x07b", "tab": b"a\tb",
}  # fmt: skip


@pytest.mark.parametrize("key", KEYS.values(), ids=KEYS)
def test_strange_keys_are_named(clients: list[httpx.Client], key: bytes) -> None:
    for http in clients:
        headers = httpx.Headers([(b"Idempotency-Key", key), (b"Content-Type", b"application/json")])
        answer = http.post("/objects", content=b'{"id": "cup"}', headers=headers)
        assert answer.status_code in (400, 422), answer.text
        if answer.status_code == 422:
            assert answer.json()["errors"][0]["field"] == "Idempotency-Key"
        assert http.get("/objects/cup").status_code == 404


@pytest.mark.parametrize(
    "header", ["If-None-Match", "Accept", "Content-Type", "Authorization", "X-Request-ID", "Range", "Cookie"]
)
def test_strange_headers_change_nothing(clients: list[httpx.Client], header: str) -> None:
    for http in clients:
        for value in (b"\xff\xfe", b"a" * 8_000, b",,;;=q", b"*/*;q=nan", b"W/", b'"', b"bytes=0-1"):
            answer = http.get("/objects/mug/trials", headers=httpx.Headers([(header.encode(), value)]))
            assert answer.status_code in (200, 304, 401, 406), (header, value, answer.text)


def _cursor(value: Any) -> str:
    return base64.urlsafe_b64encode(json.dumps(value).encode()).decode().rstrip("=")


CURSORS = [
    *("", "a", "=", "%", "é", "W10", "x" * 500, "A" * 4_000),
    *map(_cursor, (None, True, -1, 2**63, 2**200, 1.5, 1e308, "", "x" * 100, "a\0b", [1], {"a": 1}, "1", 1)),
    _cursor([[[[[[]]]]]]),
    base64.urlsafe_b64encode(b"[" * 300).decode(),
    base64.urlsafe_b64encode(b"NaN").decode(),
    base64.urlsafe_b64encode(b"\xff\xfe").decode(),
    base64.urlsafe_b64encode(b"1" * 300).decode(),
]


@pytest.mark.parametrize(
    "path",
    ["objects", "grippers", "kernels", "sweeps", "workers", "objects/mug/trials", "objects/mug/batches"],
)
def test_forged_cursors(clients: list[httpx.Client], path: str) -> None:
    for http in clients:
        for cursor in CURSORS:
            answer = http.get(f"/{path}", params={"cursor": cursor})
            assert answer.status_code in (200, 422), (cursor, answer.text)
            if answer.status_code == 422:
                assert answer.json()["errors"][0]["field"] == "cursor"


NESTED = 2_000
BODIES = {
    "empty": b"",
    "blank": b" \n ",
    "utf-32": '{"id": "cup"}'.encode("utf-32")[:-2],
    "latin-1": '{"id": "cup", "name": "é"}'.encode("latin-1"),
    "half a surrogate": b'{"id": "cup", "name": "\\udc00"}',
    "overlong utf-8": b'{"id": "cup", "name": "\xc0\x80"}',
    "deep lists": b'{"id": "cup", "metadata": {"a": ' + b"[" * NESTED + b"]" * NESTED + b"}}",
    "deep objects": b'{"id": ' + b'{"a":' * NESTED + b"1" + b"}" * NESTED + b"}",
    "open lists": b"[" * 200_000,
    "many names": b'{"id": "cup", ' + b",".join(b'"k%d": 0' % i for i in range(50_000)) + b"}",
    "many names within": b'{"metadata": {' + b",".join(b'"%d":0' % i for i in range(5_000)) + b"}}",
    "comments": b'{"id": "cup" /* a cup */}',
    "single quotes": b"{'id': 'cup'}",
    "two documents": b'{"id": "cup"}{"id": "cup"}',
    "cut": b'{"id": "cup"',
    "text": b'"cup"',
    "many digits": b'{"id": "cup", "mass_kg": 0.' + b"1" * 100_000 + b"e400}",
    "a list": b'[{"id": "cup"}]',
}  # fmt: skip


@pytest.mark.parametrize("body", BODIES.values(), ids=BODIES)
@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("POST", "/objects"),
        ("PATCH", "/objects/mug"),
        ("POST", "/objects/mug/trials"),
        ("POST", "/objects/mug/likelihood"),
        ("POST", "/objects/mug/best-grasp"),
        ("POST", "/objects/mug/sweeps"),
        ("POST", "/kernels"),
        ("POST", "/jobs/claim"),
        ("PUT", "/jobs/x/result?lease_id=x"),
        ("PATCH", "/objects/mug/trials/1"),
    ],
    ids=lambda value: value.strip("/").replace("/", " "),
)
def test_hostile_bodies_are_problems(
    clients: list[httpx.Client], method: str, path: str, body: bytes
) -> None:
    http = clients[0]
    for content in (body, iter([body[:7], body[7:]])):
        _refused(http.request(method, path, content=content, headers=JSON))
    assert http.get("/objects/cup").status_code == 404


def test_of_a_name_that_stands_twice_the_last_counts(clients: list[httpx.Client]) -> None:
    for http in clients:
        body = b'{"id": "a", "name": "one", "name": "two", "id": "twice"}'
        made = http.post("/objects", content=body, headers=JSON)
        assert (made.status_code, made.json()["id"], made.json()["name"]) == (201, "twice", "two")


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ("trials?limit=1&limit=2", 422),
        ("trials?outcome=success&outcome=failure", 422),
        ("density?gripper=pg70&gripper=panda", 422),
        ("best-grasp?box_min=0,0,0&box_min=1,1,1", 422),
        ("best-grasp?box_min=0&box_min=0&box_min=0", 200),
        ("best-grasp?include=density&include=relative", 200),
        ("best-grasp?box_min=0,0", 422),
        ("best-grasp?box_min=0,0,0,0", 422),
        ("best-grasp?box_min=", 422),
        ("best-grasp?box_min=0,,0", 422),
        ("best-grasp?box_min=a,b,c", 422),
        ("best-grasp?sphere=0,0,0", 422),
        ("best-grasp?object_pose=0,0,0", 422),
        ("likelihood?position=0,0,0&quaternion_xyzw=1,0,0", 422),
        ("likelihood?position=0,0,0", 422),
        ("density?%00=1", 422),
        ("density?" + "&".join(f"a{i}" for i in range(5_000)), 422),
        ("trials?limit=1e1", 422),
        ("trials?limit=١", 422),
        ("trials?limit=" + "1" * 5_000, 422),
        ("trials?since_revision=-0", 200),
    ],
    ids=lambda value: str(value)[:40],
)
def test_queries(clients: list[httpx.Client], query: str, status: int) -> None:
    for http in clients:
        answer = http.get(f"/objects/mug/{query}")
        assert answer.status_code == status, answer.text
        if status == 422:
            _refused(answer)


@pytest.mark.parametrize(
    ("media", "body", "status"),
    [
        ("application/json; charset=utf-16", '{"name": "é"}'.encode("utf-16"), 200),
        ("application/json; charset=latin-1", '{"name": "é"}'.encode("latin-1"), 400),
        ("application/json; charset=utf-8", '{"name": "é"}'.encode(), 200),
        ("APPLICATION/JSON", b'{"name": "e"}', 200),
        ("application/merge-patch+json", b'{"name": "e"}', 200),
        ("text/plain", b'{"name": "e"}', 415),
        ("application/x-www-form-urlencoded", b"name=e", 415),
        ("multipart/form-data; boundary=x", b"--x--", 415),
        ("application/json, text/plain", b'{"name": "e"}', None),
    ],
)
def test_media_types(clients: list[httpx.Client], media: str, body: bytes, status: int | None) -> None:
    answer = clients[0].patch("/objects/mug", content=body, headers={"Content-Type": media})
    assert answer.status_code == (status or answer.status_code), answer.text
    assert answer.status_code < 500


RAW = {
    "chunk of nonsense": b"POST /objects HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    "negative length": b"POST /objects HTTP/1.1\r\nHost: x\r\nContent-Length: -1\r\n\r\n",
    "two lengths": b"POST /objects HTTP/1.1\r\nHost: x\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n{}",
    "length and chunks": b"POST /objects HTTP/1.1\r\nHost: x\r\nContent-Length: 5\r\n"
    b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    "no host": b"GET /livez HTTP/1.1\r\n\r\n",
    "a space in the path": b"GET /objects/a b HTTP/1.1\r\nHost: x\r\n\r\n",
    "bytes in the path": b"GET /objects/\xff\xfe HTTP/1.1\r\nHost: x\r\n\r\n",
    "a whole address": b"GET http://elsewhere/livez HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n",
    "another version": b"GET /livez HTTP/9.9\r\nHost: x\r\n\r\n",
    "nothing known": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
    "a name of a header": b"GET /livez HTTP/1.1\r\nHost: x\r\nX y: z\r\n\r\n",
}


@pytest.mark.parametrize("request_bytes", RAW.values(), ids=RAW)
def test_what_is_no_http(clients: list[httpx.Client], request_bytes: bytes) -> None:
    url = clients[0].base_url
    with socket.create_connection((url.host, url.port or 80), timeout=20) as connection:
        connection.sendall(request_bytes)
        status = connection.recv(100).partition(b" ")[2][:3]
    assert status[:1] in (b"2", b"4", b""), status
    assert clients[0].get("/livez").status_code == 200
