"""Health, metrics, versions and limits; what every route promises."""

from __future__ import annotations

import httpx


def test_health_answers(http: httpx.Client) -> None:
    assert http.get("/livez").json() == {"status": "alive"}
    ready = http.get("/readyz").json()
    assert ready["status"] == "ready"
    assert ready["age_s"] >= 0
    assert {"schema", "write"} <= set(ready["checks"])


def test_info_states_limits(sqlite_http: httpx.Client) -> None:
    info = sqlite_http.get("/info").json()
    assert info["database"] == "sqlite"
    assert info["limits"]["max_query_poses"] >= 1_000_000


def test_metrics_count_requests_by_route(sqlite_http: httpx.Client) -> None:
    sqlite_http.get("/livez")
    text = sqlite_http.get("/metrics").text
    assert 'graspdb_http_requests_total{method="GET",route="/livez",status="200"}' in text


def test_unknown_query_parameter_is_refused_by_name(sqlite_http: httpx.Client) -> None:
    answer = sqlite_http.get("/livez?verbose=1")
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["errors"] == [{"field": "verbose", "message": "unknown query parameter"}]


def test_errors_are_problems_with_the_request_id(sqlite_http: httpx.Client) -> None:
    missing = sqlite_http.get("/nothing/here")
    assert missing.status_code == 404
    assert missing.json()["request_id"] == missing.headers["x-request-id"]
    wrong = sqlite_http.post("/livez")
    assert wrong.status_code == 405
    assert wrong.json()["type"].endswith("method-not-allowed")


def test_docs_load_nothing_from_elsewhere(sqlite_http: httpx.Client) -> None:
    page = sqlite_http.get("/docs")
    assert page.status_code == 200
    assert "//" not in page.text.replace("http://127.0.0.1", "").replace("<!--", "").split("<script>")[0]
    assert sqlite_http.get("/docs/assets/swagger-ui-bundle.js").status_code == 200
