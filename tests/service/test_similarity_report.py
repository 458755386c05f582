"""The kernel-similarity report (figure 13)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

Poses = tuple[NDArray[np.float64], NDArray[np.float64]]
PATH = "/objects/thing/reports/kernel-similarity"


def test_the_curve_its_window_and_what_is_missing(
    sqlite_url: str,
    serve: Callable[..., str],
    make_object: Callable[..., str],
    post: Callable[..., dict[str, Any]],
    two_clusters: Poses,
) -> None:
    http = httpx.Client(base_url=serve(sqlite_url, report_wait_s=60), timeout=90)
    make_object(http)
    none = http.get(PATH)
    assert (none.status_code, "there are 0, so 50 more" in none.json()["title"]) == (409, True)
    post(http, "thing", two_clusters)
    answer = http.get(PATH + "?window_position_m=0.03&window_rotation_deg=60")
    assert answer.status_code == 200, answer.text
    body = answer.json()
    assert (body["window_position_m"], round(body["window_rotation_deg"], 6)) == (0.03, 60)
    assert (body["component_position_m"], round(body["component_rotation_deg"], 6)) == (0.01, 10)
    assert body["successes"] == 500
    samples = {item["count"]: item["similarity"] for item in body["samples"]}
    assert samples[900] > samples[100] > samples[50]
    assert samples[3_600] > 0.95
    assert [item["count"] for item in body["mixtures"]] == list(range(1, 17))
    # These clusters are Gaussian, and so are the displacements within them.
    assert body["mixtures"][0]["similarity"] > 0.95
    assert "window 30 mm and 60 deg, components 10 mm and 10 deg" in body["text"]
    png = http.get(PATH + "?window_position_m=0.03&window_rotation_deg=60", headers={"Accept": "image/png"})
    assert png.content.startswith(b"\x89PNG")
    narrow = http.get(PATH + "?window_position_m=0.0005&window_rotation_deg=1")
    assert narrow.status_code == 409
    assert "widen window_position_m" in narrow.json()["title"]
    assert http.get(PATH + "?window_position_m=0").status_code == 422
    wide = http.get(PATH + "?window_position_m=0.004&component_position_m=0.2")
    assert (wide.status_code, wide.json()["type"].rpartition(":")[2]) == (409, "window-too-narrow")
    assert "narrow the components" in wide.json()["title"]
