"""The OpenAPI document: committed, complete, and shown without the internet."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx

COMMITTED = Path(__file__).parents[2] / "docs" / "openapi.json"


def test_committed_document_is_current() -> None:
    command = [sys.executable, "-m", "graspdb_service.cli", "openapi"]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert json.loads(printed) == json.loads(COMMITTED.read_text()), (
        "the API changed: run `graspdb-server openapi > docs/openapi.json` and look at the difference"
    )


def test_document_is_served_and_whole(sqlite_http: httpx.Client) -> None:
    document = sqlite_http.get("/openapi.json").json()
    assert document == json.loads(COMMITTED.read_text())
    schemas = document["components"]["schemas"]
    used = set(re.findall(r'"#/components/schemas/([^"]+)"', json.dumps(document)))
    assert used <= set(schemas)
    assert "HTTPValidationError" not in schemas


def test_every_operation_names_its_problems_and_bodies(sqlite_http: httpx.Client) -> None:
    document: dict[str, Any] = sqlite_http.get("/openapi.json").json()
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            problem = operation["responses"]["default"]["content"]
            assert set(problem) == {"application/problem+json"}, (method, path)
            assert operation["description"], (method, path)
    body = document["paths"]["/objects/{id}/trials"]["post"]["requestBody"]["content"]
    assert set(body) == {"application/json", "application/x-ndjson", "application/vnd.apache.arrow.stream"}
    mesh = document["paths"]["/objects/{id}/mesh"]["put"]["requestBody"]["content"]
    assert set(mesh) == {"model/stl", "model/obj", "model/ply", "model/gltf-binary"}


def test_docs_page_loads_nothing_from_elsewhere(sqlite_http: httpx.Client) -> None:
    page = sqlite_http.get("/docs").text
    links = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert links
    for link in links:
        # Relative, so that it is right below a proxy's prefix, too.
        assert link.startswith("docs/assets/")
        assert sqlite_http.get(f"/{link}").status_code == 200
    assert "url: 'openapi.json'" in page
