"""What a web page may make a browser send to a service without keys: nothing."""

from __future__ import annotations

from collections.abc import Callable

import httpx
import pytest

OBJECT = b'{"id": "evil"}'


def _port(client: httpx.Client) -> int:
    assert client.base_url.port is not None
    return client.base_url.port


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:8000", "192.168.1.7", "", "[::2]"])
def test_an_unknown_host_is_refused_with_the_way_out(sqlite_http: httpx.Client, host: str) -> None:
    answer = sqlite_http.get("/objects", headers={"Host": host})
    assert answer.status_code == 421
    assert answer.json()["type"].endswith(":unknown-host")
    assert "GRASPDB_ALLOWED_HOSTS" in answer.json()["title"]
    # Supervisors ask by a container's address, and so does Prometheus, which a page's name is not.
    assert sqlite_http.get("/livez", headers={"Host": host}).status_code == 200
    by_address = host in ("192.168.1.7", "[::2]")
    assert sqlite_http.get("/metrics", headers={"Host": host}).status_code == (200 if by_address else 421)


@pytest.mark.parametrize("host", ["localhost:{port}", "LOCALHOST", "127.0.0.9", "[::1]:{port}"])
def test_loopback_is_served_under_its_names(sqlite_http: httpx.Client, host: str) -> None:
    named = host.format(port=_port(sqlite_http))
    assert sqlite_http.get("/objects", headers={"Host": named}).status_code == 200


def test_named_hosts_are_served(sqlite_url: str, serve: Callable[..., str]) -> None:
    url = serve(sqlite_url, allowed_hosts=("Service", "lab.example"))
    for host, status in [("service:8000", 200), ("lab.example", 200), ("other.example", 421)]:
        assert httpx.get(f"{url}/objects", headers={"Host": host}).status_code == status
    page = {"Host": "service", "Origin": "https://lab.example"}
    assert httpx.get(f"{url}/objects", headers=page).status_code == 200


def test_a_page_of_another_origin_is_refused(sqlite_http: httpx.Client) -> None:
    own = f"http://127.0.0.1:{_port(sqlite_http)}"
    as_json = {"Content-Type": "application/json"}
    for headers, status in [
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"}, 403),
        ({"Origin": own, "Sec-Fetch-Site": "same-origin"}, 201),
    ]:
        answer = sqlite_http.post("/objects", content=OBJECT, headers={**as_json, **headers})
        assert answer.status_code == status, headers
        assert "access-control-allow-origin" not in answer.headers
    followed = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
    assert sqlite_http.get("/docs", headers=followed).status_code == 200


@pytest.mark.parametrize("auth", ["off", "keys"])
def test_a_body_says_what_it_is(sqlite_url: str, serve: Callable[..., str], auth: str) -> None:
    url = serve(sqlite_url, auth=auth)
    for path in ("/objects", "/objects/evil/trials", "/objects/evil/sweeps", "/jobs/claim"):
        for content in (OBJECT, iter([OBJECT])):
            answer = httpx.post(f"{url}{path}", content=content)
            assert answer.status_code == 415
            assert "Content-Type" in answer.json()["title"]


def test_keys_need_no_known_host(sqlite_url: str, serve: Callable[..., str]) -> None:
    """A page that was let resolve its name to this machine has no key."""
    answer = httpx.get(f"{serve(sqlite_url, auth='keys')}/objects", headers={"Host": "lab.example"})
    assert answer.status_code == 401


def test_a_prefix_is_in_the_document_and_served_with_and_without(
    sqlite_url: str, serve: Callable[..., str]
) -> None:
    url = serve(sqlite_url, root_path="/graspdb")
    # A proxy may strip its prefix or not.
    for prefix in ("", "/graspdb"):
        document = httpx.get(f"{url}{prefix}/openapi.json").json()
        assert document["servers"] == [{"url": "/graspdb"}]
        assert "url: 'openapi.json'" in httpx.get(f"{url}{prefix}/docs").text
        assert httpx.get(f"{url}{prefix}/docs/assets/swagger-ui.css").status_code == 200
        assert httpx.get(f"{url}{prefix}/objects").status_code == 200
