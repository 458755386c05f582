"""Keys: who is let in to what, against a real server; the secret is told once and stored nowhere."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import text

from graspdb.wire.access.keys import SCOPES, KeyCreate
from graspdb_service.settings import Settings
from graspdb_service.storage.database import Database
from graspdb_service.usecases.access import keys

POSE = {"position": [0, 0, 0.1], "quaternion_xyzw": [1, 0, 0, 0]}
TRIAL = {**POSE, "outcome": True, "gripper": "pg70"}
OPERATIONS = [
    (method.upper(), path, operation["x-accepted-scopes"])
    for path, operations in json.loads((Path(__file__).parents[2] / "docs" / "openapi.json").read_text())[
        "paths"
    ].items()
    for method, operation in operations.items()
]
NO_UUID = "00000000-0000-4000-8000-000000000000"


class Locked:
    """A server that takes keys, and clients of it by scope."""

    def __init__(self, url: str, database_url: str) -> None:
        self.url, self.database_url = url, database_url
        self._clients: list[httpx.Client] = []
        self.admin = self.with_key("admin", ["admin"])

    def made(self, name: str, scopes: list[str], **limits: Any) -> Any:
        database = Database(self.database_url)
        try:
            request = {"name": name, "scopes": scopes, **limits}
            return keys.create(database, KeyCreate.model_validate(request))
        finally:
            database.dispose()

    def with_key(self, name: str, scopes: list[str], **limits: Any) -> httpx.Client:
        return self.client(self.made(name, scopes, **limits).key)

    def client(self, key: str | None) -> httpx.Client:
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        self._clients.append(httpx.Client(base_url=self.url, headers=headers, timeout=120))
        return self._clients[-1]

    def close(self) -> None:
        for client in self._clients:
            client.close()


@pytest.fixture
def locked(database_url: str, serve: Callable[..., str]) -> Iterator[Locked]:
    """A server that takes keys, on SQLite, then on PostgreSQL."""
    server = Locked(serve(database_url, auth="keys"), database_url)
    yield server
    server.close()


@pytest.fixture
def sqlite_locked(sqlite_url: str, serve: Callable[..., str]) -> Iterator[Locked]:
    server = Locked(serve(sqlite_url, auth="keys", max_request_burst=10_000), sqlite_url)
    yield server
    server.close()


def _kind(answer: httpx.Response) -> str:
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    return str(answer.json()["type"]).rpartition(":")[2]


def test_every_route_with_every_scope(sqlite_locked: Locked) -> None:
    """401 without a key, 403 without the scope, and neither with it."""
    clients = {scope: sqlite_locked.with_key(f"only-{scope}".replace(":", "-"), [scope]) for scope in SCOPES}
    clients["nobody"] = sqlite_locked.client(None)
    values = {"seq": "1", "gripper": "nothing"}
    wrong = []
    for method, path, accepted in OPERATIONS:
        named = path.replace("{id}", "nothing" if path.startswith("/objects") else NO_UUID)
        for name in ("seq", "gripper", "batch"):
            named = named.replace("{" + name + "}", values.get(name, NO_UUID))
        for scope, client in clients.items():
            body = {} if method in ("GET", "DELETE") else {"json": {}}
            answer = client.request(method, named, **body)  # type: ignore[arg-type]
            if accepted == ["public"]:
                right = answer.status_code == 200
            elif scope == "nobody":
                right = answer.status_code == 401 and answer.headers["www-authenticate"].startswith("Bearer")
            elif scope in (*accepted, "admin"):
                right = answer.status_code not in (401, 403) and answer.status_code < 500
            else:
                right = (
                    answer.status_code == 403
                    and _kind(answer) == "scope-missing"
                    and answer.json()["required_scopes"] == accepted
                    and accepted[0] in answer.json()["title"]
                )
            if not right:
                wrong.append((method, named, scope, answer.status_code, answer.text[:200]))
    assert len(OPERATIONS) > 40
    assert not wrong, wrong


def test_what_is_no_good_key_is_refused_and_why(locked: Locked) -> None:
    made = locked.made("robot", ["read"])
    robot = locked.client(made.key)
    assert robot.get("/objects").status_code == 200
    for bad, kind in [
        (None, "key-required"),
        ("nonsense", "key-unknown"),
        (made.key[:-1] + ("a" if made.key[-1] != "a" else "b"), "key-unknown"),
        (made.key.replace(made.id, "0" * 12), "key-unknown"),
    ]:
        answer = locked.client(bad).get("/objects")
        assert (answer.status_code, _kind(answer)) == (401, kind)
        assert "www-authenticate" in answer.headers
    assert httpx.get(f"{locked.url}/objects", headers={"Authorization": "Basic YTpi"}).status_code == 401
    assert httpx.get(f"{locked.url}/info").status_code == 200

    # Revoked by the service: at once. It stays in the list.
    assert locked.admin.delete(f"/keys/{made.id}").status_code == 204
    answer = robot.get("/objects")
    assert (answer.status_code, _kind(answer)) == (401, "key-revoked")
    assert locked.admin.delete(f"/keys/{made.id}").status_code == 204
    states = {item["name"]: item["state"] for item in locked.admin.get("/keys").json()["items"]}
    assert states == {"admin": "usable", "robot": "revoked"}

    # By another process: within two seconds.
    other = locked.made("robot", ["read"])
    robot = locked.client(other.key)
    assert robot.get("/objects").status_code == 200
    database = Database(locked.database_url)
    keys.revoke(database, other.id)
    deadline = time.monotonic() + 60
    while robot.get("/objects").status_code == 200:
        assert time.monotonic() < deadline
    with database.write() as tx:
        again = "UPDATE api_keys SET revoked_at = NULL, expires_at = created_at WHERE id = :id"
        tx.execute(text(again), {"id": other.id})
    database.dispose()
    expired = locked.client(other.key)
    while (answer := expired.get("/objects")).status_code == 200 or _kind(answer) != "key-expired":
        assert time.monotonic() < deadline


def test_a_key_is_made_rotated_and_told_once(locked: Locked) -> None:
    asked = {"name": "worker", "scopes": ["jobs:work", "read"], "expires_days": 30, "burst": 7}
    answer = locked.admin.post("/keys", json=asked)
    assert answer.status_code == 201
    assert answer.headers["cache-control"] == "no-store"
    made = answer.json()
    assert made["key"].startswith(f"graspdb_{made['id']}_")
    assert (made["scopes"], made["created_by"], made["burst"]) == (["jobs:work", "read"], "admin", 7)
    again = locked.admin.post("/keys", json=asked)
    assert (again.status_code, _kind(again)) == (409, "already-exists")
    listed = locked.admin.get("/keys").text
    database = Database(locked.database_url)
    with database.read() as tx:
        stored = repr(tx.execute(text("SELECT * FROM api_keys")).all())
    database.dispose()
    # A secret may have the separator in it.
    secret = made["key"].removeprefix(f"graspdb_{made['id']}_")
    assert secret not in listed
    assert secret not in stored

    first = locked.client(made["key"])
    assert first.get("/objects").status_code == 200
    second = locked.admin.post(f"/keys/{made['id']}/rotate", json={"overlap_s": 600}).json()
    assert (second["id"], second["expires_at"]) == (made["id"], made["expires_at"])
    assert first.get("/objects").status_code == 200
    assert locked.client(second["key"]).get("/objects").status_code == 200
    third = locked.admin.post(f"/keys/{made['id']}/rotate", json={}).json()
    assert [locked.client(item["key"]).get("/objects").status_code for item in (made, second, third)] == [
        *(401, 401, 200)
    ]
    assert locked.admin.post("/keys", json={"name": "x", "scopes": ["all"]}).status_code == 422
    limited = locked.admin.post("/keys", json={"name": "x", "scopes": ["admin"], "objects": "lab-"})
    assert limited.json()["errors"][0]["field"] == "objects"
    assert locked.admin.post("/keys/nothing/rotate", json={}).status_code == 404


def test_the_last_use_is_stored_in_the_background(locked: Locked, eventually: Callable[..., Any]) -> None:
    robot = locked.with_key("robot", ["read"])
    robot.get("/objects")

    def used() -> bool:
        return {k["name"]: k["last_used_at"] for k in locked.admin.get("/keys").json()["items"]}["robot"]

    assert eventually(used)


def test_a_key_that_asks_too_often_waits(locked: Locked) -> None:
    hasty = locked.with_key("hasty", ["read"], requests_per_s=0.5, burst=3)
    answers = [hasty.get("/grippers") for _ in range(4)]
    assert [answer.status_code for answer in answers] == [200, 200, 200, 429]
    assert _kind(answers[-1]) == "rate-limited"
    assert 1 <= int(answers[-1].headers["retry-after"]) <= 2
    # Another key is not kept waiting, and health never is.
    assert locked.admin.get("/grippers").status_code == 200
    assert hasty.get("/livez").status_code == 200


def test_a_key_limited_to_some_objects_sees_no_others(
    locked: Locked, put_box: Callable[..., Any], eventually: Callable[..., Any]
) -> None:
    admin = locked.admin
    for slug in ("lab-mug", "LAB-mug", "other-mug"):
        assert admin.post("/objects", json={"id": slug, "mass_kg": 0.3}).status_code == 201
        put_box(admin, slug)
    mine = locked.with_key("mine", ["read", "trials:write", "objects:write", "jobs:work"], objects="lab-")
    sweeps = {
        slug: admin.post(f"/objects/{slug}/sweeps", json={"poses": [POSE]}).json()["id"]
        for slug in ("other-mug", "lab-mug")
    }
    given = {"components": [{"covariance": [[float(i == j) * 1e-3 for j in range(6)] for i in range(6)]}]}
    kernel = admin.post("/kernels", json=given).json()["id"]

    def listed(path: str, name: str) -> list[str]:
        return [item[name] for item in mine.get(path).json()["items"]]

    assert listed("/objects", "id") == ["lab-mug"]
    assert listed("/sweeps", "id") == [sweeps["lab-mug"]]
    assert listed("/kernels", "id") == [kernel]
    summary = mine.get("/reports/summary").text
    assert "lab-mug" in summary
    assert "other-mug" not in summary

    # Judged by its id alone: whether there is such an object is not told.
    for slug in ("other-mug", "LAB-mug", "no-such"):
        for method, path, body in [
            ("GET", f"/objects/{slug}", None),
            ("DELETE", f"/objects/{slug}", None),
            ("POST", f"/objects/{slug}/trials", TRIAL),
            ("GET", f"/objects/{slug}/best-grasp", None),
            ("POST", f"/objects/{slug}/sweeps", {}),
            ("POST", "/objects", {"id": slug}),
            ("POST", "/kernels", {"object": slug}),
            ("GET", f"/sweeps?object={slug}", None),
            ("GET", f"/kernels?object={slug}", None),
        ]:
            answer = mine.request(method, path, json=body)
            assert (answer.status_code, _kind(answer)) == (403, "object-not-allowed"), (method, path)
            assert "'lab-'" in answer.json()["title"]
    # What has an id of its own is answered as if it did not exist.
    hidden = sweeps["other-mug"]
    for method, path in [
        ("GET", f"/sweeps/{hidden}"),
        ("GET", f"/sweeps/{hidden}/outcomes"),
        ("POST", f"/sweeps/{hidden}/cancel"),
        ("POST", f"/sweeps/{hidden}/retry"),
    ]:
        assert mine.request(method, path).status_code == 404, path

    jobs = mine.post("/jobs/claim", json={"worker": "w", "capabilities": ["simulate"], "limit": 9}).json()
    assert [job["payload"]["object"] for job in jobs["jobs"]] == ["lab-mug"]
    other = admin.post("/jobs/claim", json={"worker": "v", "capabilities": ["simulate"], "limit": 9}).json()
    (theirs,) = other["jobs"]
    place = f"/jobs/{theirs['id']}/lease?lease_id={theirs['lease_id']}"
    assert mine.put(place).status_code == 404
    assert admin.put(place).status_code == 200

    # What all objects share is not one object's to change.
    for method, path, body in [
        ("DELETE", "/grippers/panda", None),
        ("POST", "/kernels", given),
        ("DELETE", f"/kernels/{kernel}", None),
    ]:
        answer = mine.request(method, path, json=body)
        assert (answer.status_code, _kind(answer)) == (403, "object-not-allowed"), path
    assert mine.post("/objects/lab-mug/trials", json=TRIAL).status_code == 201
    assert mine.get("/objects/lab-mug").status_code == 200


def test_reports_and_kernels_of_hidden_objects_are_hidden(
    sqlite_locked: Locked, two_clusters: Any, post: Callable[..., Any]
) -> None:
    admin = sqlite_locked.admin
    admin.post("/objects", json={"id": "other"})
    admin.post("/objects", json={"id": "lab-mug"})
    for slug in ("other", "lab-mug"):
        post(admin, slug, two_clusters)
    kernel = admin.post("/kernels", json={"object": "other"}).json()["id"]
    run = admin.post("/kernels", json={"object": "other", "components": "auto"}).headers["location"]
    run = run.replace("/kernels/", "/report-runs/")
    mine = sqlite_locked.with_key("mine", ["read", "objects:write"], objects="lab-")
    for method, path in [
        ("GET", f"/kernels/{kernel}"),
        ("DELETE", f"/kernels/{kernel}"),
        ("GET", f"/objects/lab-mug/density?kernel={kernel}"),
        ("GET", run),
        ("POST", f"{run}/cancel"),
    ]:
        assert mine.request(method, path).status_code == 404, path
        allowed = admin.request("GET" if method == "DELETE" else method, path)
        assert allowed.status_code == 200, (path, allowed.text)
    assert mine.get("/kernels").json()["items"] == []


def test_without_keys_everybody_may_and_a_key_does_no_harm(sqlite_http: httpx.Client) -> None:
    answer = sqlite_http.get("/keys", headers={"Authorization": "Bearer whatever"})
    assert (answer.status_code, answer.json()) == (200, {"items": [], "next": None})


@pytest.mark.parametrize(
    ("given", "uses"),
    [
        ({}, False),
        ({"auth": "keys"}, True),
        ({"host": "0.0.0.0"}, True),
        ({"host": "0.0.0.0", "auth": "off"}, False),
        ({"host": "::1"}, False),
    ],
)
def test_keys_are_the_default_beyond_loopback(given: dict[str, Any], uses: bool) -> None:
    assert Settings(**given).uses_keys is uses


def test_a_port_that_names_a_service_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRASPDB_PORT", "tcp://10.0.0.1:8000")
    monkeypatch.setenv("GRASPDB_ALLOWED_HOSTS", "service, grasps.lab")
    assert Settings().port == 8000
    assert Settings().allowed_hosts == ("service", "grasps.lab")
