"""The summary of all objects: counts by outcome, and rates by each way of counting."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]


def poses(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.zeros((count, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))


def test_every_outcome_is_counted_by_each_rule(http: httpx.Client, make_object: Make, post: Post) -> None:
    assert http.get("/reports/summary").json()["rows"] == []
    for slug in ("a", "b", "empty"):
        make_object(http, slug)
    told = ["success"] * 6 + ["collision"] * 50 + ["missed"] * 30 + ["slipped"] * 10 + ["timeout"] * 4
    post(http, "a", poses(105), told + ["simulation_error"] * 5, gripper="pg70", source="simulation")
    post(http, "a", poses(10), ["success"] * 8 + ["failure"] * 2, gripper="pg70", source="robot")
    post(http, "b", poses(3), "success", source="human")
    answer = http.get("/reports/summary")
    body = answer.json()
    simulated, real, human = body["rows"]
    assert (simulated["object"], simulated["gripper"], simulated["source"]) == ("a", "pg70", "simulation")
    assert simulated["outcomes"] == {
        "success": 6,
        "collision": 50,
        "missed": 30,
        "slipped": 10,
        "timeout": 4,
        "simulation_error": 5,
    }
    # An error of the simulation is no attempt.
    assert (simulated["trials"], simulated["successes"]) == (100, 6)
    rates = {item["rule"]: (item["trials"], item["rate"]["value"]) for item in simulated["rates"]}
    assert rates == {"attempts": (100, 0.06), "free": (50, 0.12), "met": (20, 0.3)}
    assert set(body["rules"]) == set(rates)
    for item in simulated["rates"]:
        assert item["rate"]["low"] < item["rate"]["value"] < item["rate"]["high"]
    # The jaw is symmetric: each has its twin.
    assert (simulated["doubled_successes"], simulated["doubled_failures"]) == (12, 188)
    assert (real["source"], real["rates"][0]["rate"]["value"]) == ("robot", 0.8)
    assert (human["object"], human["rates"][0]["rate"]["value"]) == ("b", 1.0)
    assert human["rates"][0]["rate"]["low"] < 0.7
    assert "no trials yet: empty" in body["warnings"]
    assert "113 trials of 2 objects, 17 of them successes" in body["text"]
    tag = answer.headers["etag"]
    assert http.get("/reports/summary", headers={"If-None-Match": tag}).status_code == 304
    post(http, "b", poses(1), "failure", source="human")
    assert http.get("/reports/summary", headers={"If-None-Match": tag}).status_code == 200


@pytest.mark.parametrize("kind", ["png", "svg+xml"])
def test_its_figure(sqlite_http: httpx.Client, make_object: Make, post: Post, kind: str) -> None:
    accept = {"Accept": f"image/{kind}"}
    assert sqlite_http.get("/reports/summary", headers=accept).status_code == 200
    make_object(sqlite_http)
    post(sqlite_http, "thing", poses(4), ["success", "failure", "missed", "collision"])
    drawn = sqlite_http.get("/reports/summary", headers=accept)
    assert (drawn.status_code, drawn.headers["content-type"]) == (200, f"image/{kind}")
    assert sqlite_http.get("/reports/summary?object=thing").status_code == 422
