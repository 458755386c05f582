"""While the database is away, densities that the service holds answer on, and say that they are stale."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from graspdb_service.storage import schema
from graspdb_service.storage.database import Database
from postgres_server import PostgresPrograms, PostgresServer

Poses = tuple[Any, Any]
POSE = {"position": [0, 0, 0.06], "quaternion_xyzw": [1, 0, 0, 0]}
#: Other questions to a density than the one it was built for.
QUESTIONS: list[tuple[str, dict[str, Any]]] = [
    ("best-grasp", {"count": 2, "approach": [0, 0, -1], "approach_cone_deg": 40}),
    ("best-grasp", {"objective": "success_probability", "kernel": "anisotropic"}),
    ("likelihood", {"poses": [POSE]}),
    ("samples", {"count": 5}),
    ("proposals", {"count": 5, "strategy": "uncertainty"}),
]


@pytest.fixture
def postgres(postgres_programs: PostgresPrograms) -> Iterator[PostgresServer]:
    """A PostgreSQL of the test's own, to be stopped."""
    with tempfile.TemporaryDirectory(prefix="graspdb-outage-") as folder:
        server = PostgresServer(Path(folder), postgres_programs)
        try:
            yield server
        finally:
            server.stop()


@pytest.fixture
def away(
    postgres: PostgresServer,
    serve: Callable[..., str],
    make_object: Callable[..., str],
    post: Callable[..., Any],
    two_clusters: Poses,
) -> Iterator[tuple[httpx.Client, str]]:
    """A client and an object whose densities were asked for before the database went."""
    database = Database(postgres.url)
    schema.upgrade(database)
    database.dispose()
    with httpx.Client(base_url=serve(postgres.url, probe_seconds=0.5), timeout=60) as http:
        slug = make_object(http)
        outcomes = ["failure" if i % 4 == 0 else "success" for i in range(len(two_clusters[0]))]
        post(http, slug, two_clusters, outcomes, gripper="pg70", protocol="lift", source="robot")
        make_object(http, "other")
        make_object(http, "gone")
        assert http.get("/objects/gone/best-grasp").status_code == 200
        assert http.delete("/objects/gone").is_success
        assert http.get("/objects/gone/best-grasp").status_code == 404
        fitted = http.post("/kernels", json={"object": slug, "gripper": "pg70", "components": 2})
        assert fitted.status_code == 201, fitted.text
        for kernel in ("isotropic", "anisotropic"):
            asked = http.get(
                f"/objects/{slug}/best-grasp", params={"kernel": kernel, "objective": "success_probability"}
            )
            assert asked.status_code == 200, asked.text
            assert not asked.json()["stale"]
        postgres.pause()
        yield http, slug
        postgres.resume()


def test_stale(away: tuple[httpx.Client, str], postgres: PostgresServer, eventually: Any) -> None:
    http, slug = away
    eventually(lambda: http.get("/readyz").status_code == 503)
    for kind, question in QUESTIONS:
        answer = http.post(f"/objects/{slug}/{kind}", json=question)
        assert answer.status_code == 200, answer.text
        told = answer.json()
        assert told["stale"], kind
        assert told["revision"] == 1
        assert told["answer"] is None
        assert told["warnings"][0].startswith("stale: the database does not answer (")
        assert "etag" not in answer.headers

    density = http.get(f"/objects/{slug}/density", headers={"If-None-Match": "*"})
    assert (density.status_code, density.json()["stale"]) == (200, True)
    assert "findings" in density.json()["warnings"][-1]
    # What was never asked, what changes something, and what needs the database is refused.
    for method, path, body in [
        ("GET", "/objects/other/best-grasp", None),
        # What the service has told to be gone no outage brings back.
        ("GET", "/objects/gone/best-grasp", None),
        ("GET", f"/objects/{slug}", None),
        ("GET", f"/objects/{slug}/reports/projection", None),
        ("POST", f"/objects/{slug}/trials", {**POSE, "outcome": True}),
        ("POST", f"/objects/{slug}/best-grasp", {"name": "mine"}),
    ]:
        answer = http.request(method, path, json=body)
        assert answer.status_code == 503, (method, path, answer.text)
        assert answer.headers["content-type"] == "application/problem+json"

    postgres.resume()
    eventually(lambda: http.get("/readyz").status_code == 200)
    fresh = http.get(f"/objects/{slug}/best-grasp")
    assert not fresh.json()["stale"]
    assert fresh.headers["etag"]
