"""What Prometheus makes of ``deploy/prometheus``, and of every query of Grafana's dashboard."""

from __future__ import annotations

import json
from typing import Any

import httpx

from lab import ROOT, Compose, command, say, wait_for

BOARD = ROOT / "deploy/grafana/graspdb.json"
SOURCES = ROOT / "deploy/grafana/provisioning/datasources/graspdb.yaml"
#: Told of a SQLite file alone.
SQLITE_ONLY = ("graspdb_disk_free_bytes", "graspdb_database_bytes", "graspdb_journal_bytes")


class Prometheus:
    """The profile's container, asked as Grafana would."""

    def __init__(self, compose: Compose) -> None:
        self._compose = compose
        self._url = f"http://{compose.address('prometheus')}:9090"
        wait_for("Prometheus is ready", lambda: httpx.get(f"{self._url}/-/ready").is_success)

    def _get(self, path: str, **parameters: str) -> Any:
        answer = httpx.get(f"{self._url}/api/v1/{path}", params=parameters, timeout=60)
        assert answer.is_success, answer.text
        return answer.json()["data"]

    def check_files(self) -> None:
        words = ("promtool", "check", "config", "/etc/prometheus/prometheus.yml")
        command("podman", "exec", self._compose.container("prometheus"), *words)

    def wait_scraped(self, replicas: int) -> None:
        """Twice at least, so that there are rates."""

        def scraped() -> bool:
            found = self._get("query", query='count_over_time(up{job="graspdb"}[10m]) >= 2')["result"]
            return len(found) == replicas

        wait_for("Prometheus has scraped every replica twice", scraped)
        targets = self._get("targets", state="active")["activeTargets"]
        assert [target["health"] for target in targets] == ["up"] * replicas, targets

    def ask_rules(self) -> None:
        """Each has been evaluated without an error; none fires."""

        def evaluated() -> list[dict[str, Any]]:
            rules = [rule for group in self._get("rules")["groups"] for rule in group["rules"]]
            return [] if any(rule["health"] == "unknown" for rule in rules) else rules

        rules = wait_for("rules are evaluated", evaluated)
        assert len(rules) >= 5
        assert {(rule["health"], rule["state"]) for rule in rules} == {("ok", "inactive")}, rules
        say(f"  {len(rules)} alert rules in force, none fires")

    def ask_dashboard(self) -> None:
        """Every query of every panel has numbers, but those of a SQLite file."""
        board = json.loads(BOARD.read_text("utf-8"))
        asked = {t["expr"]: panel["title"] for panel in board["panels"] for t in panel.get("targets", [])}
        expected = {expr: title for expr, title in asked.items() if not any(n in expr for n in SQLITE_ONLY)}
        for expr, title in expected.items():
            query = expr.replace("$instance", ".*")
            wait_for(f"{title}: {expr}", lambda query=query: self._get("query", query=query)["result"], 90)
        for expr in asked.keys() - expected.keys():
            self._get("query", query=expr.replace("$instance", ".*"))
        say(f"  {len(expected)} of {len(asked)} queries of the dashboard have numbers, the rest is SQLite's")

    def reached_as_grafana_would(self) -> None:
        """Under the address that the dashboard's data source has, from another container of the project."""
        import yaml  # brought by podman-compose

        (source,) = yaml.safe_load(SOURCES.read_text("utf-8"))["datasources"]
        code = "import sys, urllib.request as u; print(u.urlopen(sys.argv[1] + '/-/ready').status)"
        name = self._compose.container("service")
        assert command("podman", "exec", name, "python", "-c", code, source["url"]).strip() == "200"
