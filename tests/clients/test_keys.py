"""Keys from the client's side: shown with every request, typed refusals, pauses, proxies."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from graspdb import Client, errors
from graspdb.transport import Transport
from graspdb.wire.presets.grippers import PRESETS


def _server(*arguments: str, database_url: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "graspdb_service.cli", *arguments]
    environment = {**os.environ, "GRASPDB_DATABASE_URL": database_url}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=120)


@pytest.fixture
def admin(sqlite_url: str, serve: Callable[..., str]) -> Any:
    """An SDK with a key from the command line, of a server that takes keys."""
    made = _server("keys", "create", "boss", "--scopes", "admin", "--json", database_url=sqlite_url)
    assert made.returncode == 0, made.stderr
    secret = json.loads(made.stdout)
    assert set(secret) == {"id", "key"}
    with Client(serve(sqlite_url, auth="keys"), api_key=secret["key"] + "\n") as client:
        yield client


def test_the_command_makes_lists_rotates_and_revokes(sqlite_url: str) -> None:
    scopes = ("--scopes", "read,trials:write", "--objects", "lab-", "--expires-days", "3")
    made = _server("keys", "create", "arm", *scopes, "--json", database_url=sqlite_url)
    first = json.loads(made.stdout)
    again = _server("keys", "create", "arm", *scopes, database_url=sqlite_url)
    assert again.returncode == 1
    assert "already" in again.stderr
    rotated = json.loads(_server("keys", "rotate", first["id"], "--json", database_url=sqlite_url).stdout)
    assert rotated["id"] == first["id"]
    assert rotated["key"] != first["key"]
    assert _server("keys", "revoke", first["id"], database_url=sqlite_url).returncode == 0
    (listed,) = json.loads(_server("keys", "list", "--json", database_url=sqlite_url).stdout)
    assert (listed["state"], listed["objects"]) == ("revoked", "lab-")
    wrong = _server("keys", "create", "x", "--scopes", "all", database_url=sqlite_url)
    assert wrong.returncode == 1
    assert "--scopes" in wrong.stderr
    assert "Traceback" not in wrong.stderr


def test_beyond_loopback_nobody_is_served_by_oversight(sqlite_url: str) -> None:
    refused = _server("serve", "--host", "0.0.0.0", "--port", "0", database_url=sqlite_url)
    assert refused.returncode == 1
    for way_out in ("graspdb-server keys create", "127.0.0.1", "--auth off"):
        assert way_out in refused.stderr


def test_the_sdk_makes_keys_and_names_what_is_missing(admin: Client) -> None:
    made = admin.keys.create("arm", scopes=["read"], objects="lab-", expires_days=2)
    assert made.expires_at is not None
    assert made.expires_at < datetime.now(UTC) + timedelta(days=2, seconds=5)
    with Client(admin.url, api_key=made.key) as arm:
        assert list(arm.objects) == []
        with pytest.raises(errors.PermissionDenied, match="objects:write") as denied:
            arm.objects.create("lab-mug")
        assert denied.value.scopes == ("objects:write",)
        with pytest.raises(errors.PermissionDenied, match="lab-") as denied:
            arm.objects.get("mug")
        assert denied.value.scopes == ()
        other = admin.keys.rotate(made.id)
        with pytest.raises(errors.AuthenticationError, match="rotated"):
            list(arm.objects)
    admin.keys.revoke(other.id)
    assert [(key.name, key.state) for key in admin.keys] == [("boss", "usable"), ("arm", "revoked")]
    with pytest.raises(errors.InvalidInput):
        admin.keys.create("x", scopes=["all"])
    told = [(entry.action, entry.key) for entry in admin.audit.list(key="boss")]
    assert told == [("key.revoke", "boss"), ("key.rotate", "boss"), ("key.create", "boss")]
    assert list(admin.audit.list(since=datetime.now(UTC) + timedelta(days=1))) == []


def test_without_a_key_the_way_to_one_is_named(admin: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    with Client(admin.url) as nobody, pytest.raises(errors.AuthenticationError, match="GRASPDB_API_KEY"):
        list(nobody.objects)
    monkeypatch.setenv("GRASPDB_API_KEY", "not a key")
    with pytest.raises(ValueError, match="GRASPDB_API_KEY"):
        Client(admin.url)


def test_a_hasty_key_is_slowed_down_by_the_pauses_it_is_told(admin: Client) -> None:
    made = admin.keys.create("hasty", scopes=["read"], requests_per_s=0.5, burst=1)
    with Client(admin.url, api_key=made.key) as patient:
        assert [len(list(patient.grippers)) for _ in range(2)] == [len(PRESETS)] * 2
    with Client(admin.url, api_key=made.key, retries=0) as hasty, pytest.raises(errors.RateLimited):
        list(hasty.grippers)


def test_loopback_is_reached_whatever_the_proxies(admin: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:9")
    monkeypatch.setenv("ALL_PROXY", "socks5://127.0.0.1:9")
    monkeypatch.setenv("NO_PROXY", "localhost,[::1],fe80::/10")
    with Transport(admin.url) as transport:
        assert transport.request("GET", "/info").is_success
    with pytest.raises(errors.GraspDBError, match=r"proxy variable.*lab\.example"):
        Transport("http://lab.example")


def test_a_service_link_is_no_port(sqlite_url: str, tmp_path: Path) -> None:
    environment = {**os.environ, "GRASPDB_PORT": "tcp://10.0.0.1:8000"}
    command = [sys.executable, "-m", "graspdb_service.cli", "migrate", "--database-url", sqlite_url]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    environment["GRASPDB_PORT"] = "many"
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "GRASPDB_PORT" in done.stderr
