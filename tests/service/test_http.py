"""HTTP itself: HEAD and OPTIONS, what a 405 allows, methods nobody knows, compressed bodies."""

from __future__ import annotations

import gzip
import json
import re
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

Serve = Callable[..., str]

DOCUMENT: dict[str, Any] = json.loads((Path(__file__).parents[2] / "docs" / "openapi.json").read_text())
METHODS = {"get", "put", "post", "patch", "delete"}
TRIAL = {"position": [0, 0, 0.1], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True}
LIMIT = 20_000


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory, serve_module: Serve) -> Iterator[httpx.Client]:
    folder = tmp_path_factory.mktemp("http")
    url = serve_module(f"sqlite:///{folder / 'graspdb.sqlite'}", max_body_bytes=LIMIT)
    with httpx.Client(base_url=url, timeout=60) as http:
        http.post("/objects", json={"id": "mug"})
        http.post("/objects/mug/trials", json=TRIAL)
        yield http


def _filled(path: str) -> str:
    return re.sub(r"\{[a-z]+\}", "1", path.replace("{id}", "mug"))


def _allowed(operations: dict[str, Any]) -> set[str]:
    methods = {method.upper() for method in operations} | {"OPTIONS"}
    return methods | ({"HEAD"} if "GET" in methods else set())


@pytest.mark.parametrize("path", DOCUMENT["paths"])
def test_a_path_says_what_it_allows(client: httpx.Client, path: str) -> None:
    operations = DOCUMENT["paths"][path]
    for method in ({*METHODS, "invented"} - set(operations)) | {"options"}:
        answer = client.request(method.upper(), _filled(path))
        assert answer.status_code == (204 if method == "options" else 405), answer.text
        assert set(answer.headers["allow"].split(", ")) == _allowed(operations)
    head = client.head(_filled(path))
    assert head.content == b""
    if "get" not in operations:
        assert head.status_code == 405
    else:
        got = client.get(_filled(path))
        assert head.status_code == got.status_code
        assert head.headers["content-type"] == got.headers["content-type"]


def test_head_tells_length_and_tag_of_the_answer(client: httpx.Client) -> None:
    for path in ("/openapi.json", "/docs", "/docs/assets/swagger-ui.css", "/livez", "/objects/mug"):
        got, head = client.get(path), client.head(path)
        assert head.status_code == 200
        for name in ("content-length", "content-type", "etag"):
            assert head.headers.get(name) == got.headers.get(name), (path, name)
    lines = client.head("/objects/mug/trials", headers={"Accept": "application/x-ndjson"})
    assert (lines.status_code, lines.content) == (200, b"")
    assert client.get("/livez").json() == {"status": "alive"}  # on the connection that HEAD used


def test_options_of_nothing_and_of_everything(client: httpx.Client) -> None:
    assert client.options("/nothing").status_code == 404
    everything = client.options("/", extensions={"target": b"*"})
    assert everything.status_code == 204
    assert "PATCH" in everything.headers["allow"]
    assert client.put("/docs").headers["allow"] == "GET, HEAD, OPTIONS"
    assert client.put("/docs/assets/swagger-ui.css").headers["allow"] == "GET, HEAD, OPTIONS"


def test_invented_methods_share_one_metric(client: httpx.Client) -> None:
    for i in range(5):
        assert client.request(f"M{i}", "/livez").status_code == 405
    metrics = client.get("/metrics").text
    assert 'method="other"' in metrics
    assert 'method="M' not in metrics


def _raw_deflate(body: bytes) -> bytes:
    packer = zlib.compressobj(wbits=-15)
    return packer.compress(body) + packer.flush()


def _post(http: httpx.Client, coding: str, body: bytes, *, chunk: int = 0) -> httpx.Response:
    content: Any = (body[i : i + chunk] for i in range(0, len(body), chunk)) if chunk else body
    headers = {"Content-Type": "application/json", "Content-Encoding": coding}
    return http.post("/objects/mug/trials", content=content, headers=headers)


@pytest.mark.parametrize("chunk", [0, 7])
@pytest.mark.parametrize(
    ("coding", "pack"),
    [
        ("gzip", gzip.compress),
        ("X-GZIP", gzip.compress),
        ("gzip", lambda body: gzip.compress(body[:10]) + gzip.compress(body[10:])),
        ("deflate", zlib.compress),
        ("deflate", _raw_deflate),
        ("identity", bytes),
    ],
)
def test_compressed_body_is_read(
    client: httpx.Client, coding: str, pack: Callable[[bytes], bytes], chunk: int
) -> None:
    answer = _post(client, coding, pack(json.dumps(TRIAL).encode()), chunk=chunk)
    assert answer.status_code == 201, answer.text
    made = client.request(
        "PATCH",
        "/objects/mug",
        content=pack(b'{"name": "mug"}'),
        headers={"Content-Type": "application/json", "Content-Encoding": coding},
    )
    assert made.status_code == 200, made.text


#: Named by their number: what gzip writes holds the time, and every process must name a test alike.
REFUSED = [
    ("br", b"x", 415),
    ("zstd", b"x", 415),
    ("gzip, gzip", gzip.compress(gzip.compress(b"{}")), 415),
    ("gzip", b"{}", 400),
    ("gzip", gzip.compress(b'{"trials": []}')[:-5], 400),
    ("gzip", gzip.compress(b"{}") + b"more", 400),
    ("deflate", zlib.compress(b"{}") * 2, 400),
    ("gzip", gzip.compress(b"") * 12_000, 413),
    ("gzip", gzip.compress(b" " * (LIMIT + 1)), 413),
    ("gzip", gzip.compress(b" " * 15_000_000, 9), 413),
    ("deflate", zlib.compress(b" " * 15_000_000, 9), 413),
    ("gzip", gzip.compress(b""), 422),
    ("gzip", b"", 422),
]


@pytest.mark.parametrize(("coding", "body", "status"), REFUSED, ids=range(len(REFUSED)))
def test_compressed_body_that_is_refused(client: httpx.Client, coding: str, body: bytes, status: int) -> None:
    before = client.get("/objects/mug").json()["trials"]
    answer = _post(client, coding, body)
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    if status == 415:
        assert answer.headers["accept-encoding"] == "gzip, deflate"
    assert client.get("/objects/mug").json()["trials"] == before
