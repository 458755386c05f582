"""Logs, metrics and traces of a running service: a line a request that nothing forges, names that exist."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from graspdb_service.settings import Settings
from graspdb_service.telemetry import logs, traces

ROOT = Path(__file__).parents[2]
KEY = "graspdb_abc123def456_" + "x" * 43


@contextmanager
def started(tmp_path: Path, **environment: str) -> Iterator[tuple[httpx.Client, Path]]:
    """A real ``graspdb-server serve``, and the file that its standard error goes to."""
    log = tmp_path / "log"
    with log.open("w") as sink:
        process = subprocess.Popen(
            [sys.executable, "-m", "graspdb_service.cli", "serve", "--port", "0"],
            env={**os.environ, "GRASPDB_DATABASE_URL": f"sqlite:///{tmp_path}/g.sqlite", **environment},
            stderr=sink,
            stdout=subprocess.DEVNULL,
        )
    try:
        deadline = time.monotonic() + 120
        while not (found := re.search(r"http://127\.0\.0\.1:\d+", log.read_text())):
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        with httpx.Client(base_url=found[0], timeout=240) as http:
            yield http, log
    finally:
        process.send_signal(signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            process.wait(30)
        process.kill()
        process.wait()


def test_every_line_is_json_and_a_request_is_one_of_them(tmp_path: Path) -> None:
    with started(tmp_path, GRASPDB_LOG_FORMAT="json") as (http, log):
        made = http.post("/objects", json={"id": "mug"}, headers={"Authorization": f"Bearer {KEY}"})
        forged = http.get("/objects/a%0Ab%20level=error%1b%5B2J", headers={"User-Agent": "x\x1b[2J"})
        trial = {"position": [0, 0, 0.05], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True}
        http.post("/objects/mug/trials", json={"trials": [trial] * 5})
        best = http.get("/objects/mug/best-grasp")
        assert http.get("/livez").status_code == 200
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert {"time", "level", "logger", "message"} <= set.intersection(*(set(line) for line in lines))
    assert any("Uvicorn running" in line["message"] for line in lines)
    told = {line["request_id"]: line for line in lines if line["logger"] == "graspdb.request"}
    # Supervisors ask every second: they are told of only where something is wrong.
    assert len(told) == 4
    assert KEY not in log.read_text()
    line = told[made.headers["x-request-id"]]
    assert (line["method"], line["route"], line["status"]) == ("POST", "/objects", 201)
    assert line["bytes_in"] == len(made.request.content)
    assert line["bytes_out"] == len(made.content)
    assert line["database_ms"] > 0
    assert told[forged.headers["x-request-id"]]["path"].startswith("/objects/a\nb level=error\x1b")
    line = told[best.headers["x-request-id"]]
    assert 0 < line["compute_ms"] <= line["total_ms"]
    assert line["route"] == "/objects/{id}/best-grasp"


def test_a_request_with_a_key_is_told_under_the_keys_name(tmp_path: Path, server: Callable[..., Any]) -> None:
    keys = {"GRASPDB_AUTH": "keys", "GRASPDB_DATABASE_URL": f"sqlite:///{tmp_path}/g.sqlite"}
    assert server("migrate", **keys).returncode == 0
    made = json.loads(server("keys", "create", "robot-3", "--scopes", "read", "--json", **keys).stdout)
    with started(tmp_path, GRASPDB_LOG_FORMAT="json", **keys) as (http, log):
        assert http.get("/objects", headers={"Authorization": f"Bearer {made['key']}"}).status_code == 200
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    (told,) = (line for line in lines if line["logger"] == "graspdb.request")
    assert (told["key"], told["key_id"]) == ("robot-3", made["id"])
    assert made["key"] not in log.read_text()


def logged(formatter: logging.Formatter, message: str, **fields: Any) -> str:
    try:
        raise ValueError(message)
    except ValueError:
        record = logging.LogRecord("graspdb", logging.ERROR, "", 0, message, None, sys.exc_info())
    record.fields = fields
    return formatter.format(record)


@given(st.text(), st.text())
def test_nothing_logged_makes_a_line_of_its_own(message: str, value: str) -> None:
    first, *under = re.split(
        "[\n\r\x0b\x0c\x1c-\x1e\x85\u2028\u2029]", logged(logs.TextLines(), message, path=value)
    )
    assert re.match(r"\d{4}-\d\d-\d\dT[\d:.]+Z ERROR graspdb", first)
    assert all(line.startswith("    ") for line in under)
    one = logged(logs.JsonLines(), message, path=value)
    assert one.isascii()
    assert "\n" not in one
    if "://" not in value and "earer" not in value.lower():
        assert json.loads(one)["path"] == value


def test_secrets_are_left_out() -> None:
    for formatter in (logs.TextLines(), logs.JsonLines()):
        line = logged(formatter, f"postgresql://u:sesame@h/x Bearer open {KEY}", path=f"/{KEY}")
        assert not re.search("sesame|open|xxxx", line)


def test_the_level_and_the_format_are_settings(server: Callable[..., Any]) -> None:
    assert Settings(log_level="WARNING").log_level == "warning"
    refused = server("serve", GRASPDB_LOG_FORMAT="xml")
    assert refused.returncode == 1
    assert "GRASPDB_LOG_FORMAT" in refused.stderr


# --- metrics --------------------------------------------------------------------------------------------


def families(text: str) -> set[str]:
    return set(re.findall(r"^# TYPE (\w+)", text, re.MULTILINE))


def samples(text: str) -> set[str]:
    """Names that a query may use: those of samples, of which a histogram has several."""
    named = families(text)
    return named | {f"{name}{end}" for name in named for end in ("_bucket", "_sum", "_count", "_total")}


def test_metrics_tell_what_there_is(http: httpx.Client, eventually: Callable[..., Any]) -> None:
    http.post("/objects", json={"id": "mug"})
    trial = {"position": [0, 0, 0.05], "quaternion_xyzw": [1, 0, 0, 0], "outcome": True}
    http.post("/objects/mug/trials", json={"trials": [trial] * 5})
    for _ in range(2):
        assert http.get("/objects/mug/best-grasp").status_code == 200
    eventually(lambda: "graspdb_objects" in http.get("/metrics").text)
    text = http.get("/metrics").text
    value = {
        line.rsplit(" ", 1)[0]: float(line.rsplit(" ", 1)[1]) for line in text.splitlines() if line[:1] != "#"
    }
    assert value['graspdb_cache_bytes{cache="densities"}'] > 0
    assert value['graspdb_cache_hits_total{cache="densities"}'] >= 1
    assert value['graspdb_cache_misses_total{cache="densities"}'] >= 1
    assert value["graspdb_ready"] == 1
    assert value["graspdb_compute_waiting"] == 0
    assert 'graspdb_jobs{kind="simulate",state="queued"}' in value
    assert value['graspdb_phase_seconds_count{phase="compute"}'] > 0
    # One of them may be in use just then.
    assert sum(value[name] for name in value if name.startswith("graspdb_database_connections{")) >= 1


def test_strange_requests_make_no_series(sqlite_http: httpx.Client) -> None:
    before = len(sqlite_http.get("/metrics").text.splitlines())
    for number in range(40):
        sqlite_http.request(f"M{number}", "/objects")
        sqlite_http.get(f"/nothing/{number}")
        sqlite_http.get(f"/objects/none-{number}")
    assert len(sqlite_http.get("/metrics").text.splitlines()) < before + 100


def expressions() -> dict[str, list[str]]:
    """Every query in the dashboard and the alert rules, by the file it stands in."""
    board = json.loads((ROOT / "deploy/grafana/graspdb.json").read_text())
    rules = yaml.safe_load((ROOT / "deploy/prometheus/alerts.yml").read_text())
    return {
        "dashboard": [t["expr"] for panel in board["panels"] for t in panel.get("targets", [])],
        "rules": [rule["expr"] for group in rules["groups"] for rule in group["rules"]],
    }


def test_dashboard_and_alerts_name_metrics_that_exist(
    sqlite_http: httpx.Client, eventually: Callable[..., Any]
) -> None:
    sqlite_http.get("/livez")
    eventually(lambda: "graspdb_objects" in sqlite_http.get("/metrics").text)
    known = samples(sqlite_http.get("/metrics").text)
    for place, asked in expressions().items():
        assert len(asked) >= 8, place
        for expression in asked:
            named = set(
                re.findall(r"\b((?:graspdb|process|python)_\w+)", re.sub(r"\{[^}]*\}", "", expression))
            )
            assert named, expression
            assert named <= known, (place, named - known)
            assert expression.count("(") == expression.count(")")


def test_every_alert_says_what_to_do() -> None:
    rules = yaml.safe_load((ROOT / "deploy/prometheus/alerts.yml").read_text())
    for rule in (rule for group in rules["groups"] for rule in group["rules"]):
        assert rule["labels"]["severity"] in ("warning", "critical")
        assert {"summary", "description"} <= rule["annotations"].keys()
        assert re.fullmatch(r"\d+[smh]", rule["for"])


# --- traces ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("environment", "on"),
    [
        ({}, False),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://x"}, True),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://x", "OTEL_SDK_DISABLED": "true"}, False),
        ({"OTEL_EXPORTER_OTLP_ENDPOINT": "http://x", "OTEL_TRACES_EXPORTER": "none"}, False),
        ({"OTEL_TRACES_EXPORTER": "console"}, True),
    ],
)
def test_traces_are_off_unless_asked_for(
    environment: dict[str, str], on: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in os.environ if name.startswith("OTEL_")]:
        monkeypatch.delenv(name)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert traces.wanted() == on


def test_spans_reach_a_collector_and_belong_to_the_callers_trace(tmp_path: Path) -> None:
    bodies: list[bytes] = []

    class Collector(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            bodies.append(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Nothing is printed."""

    collector = HTTPServer(("127.0.0.1", 0), Collector)
    threading.Thread(target=collector.serve_forever, daemon=True).start()
    trace = "0af7651916cd43dd8448eb211c80319c"
    endpoint = f"http://127.0.0.1:{collector.server_port}"
    with started(
        tmp_path,
        OTEL_EXPORTER_OTLP_ENDPOINT=endpoint,
        OTEL_BSP_SCHEDULE_DELAY="100",
        OTEL_EXPORTER_OTLP_COMPRESSION="none",
        GRASPDB_LOG_FORMAT="json",
    ) as (http, log):
        http.post("/objects", json={"id": "mug"}, headers={"traceparent": f"00-{trace}-b7ad6b7169203331-01"})
        http.get("/objects/mug/density")
    collector.shutdown()
    collector.server_close()
    sent = b"".join(bodies)
    assert bytes.fromhex(trace) in sent
    for words in (b"POST /objects", b"database", b"http.route", b"graspdb.request_id"):
        assert words in sent
    assert f'"trace_id": "{trace}"' in log.read_text()


def test_without_the_extra_the_service_starts_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("OTEL_TRACES_EXPORTER", "console")
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.trace", None)
    traces.start()
    assert "graspdb[otel]" in caplog.text
    assert traces.trace_id() is None
