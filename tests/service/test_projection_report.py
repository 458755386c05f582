"""The projection report: planes, filters, the object's outline, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

Poses = tuple[NDArray[np.float64], NDArray[np.float64]]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]
PATH = "/objects/thing/reports/projection"


@pytest.fixture
def filled(sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses) -> httpx.Client:
    """300 grasps from above around (0, 0, 60) mm and 200 from the side around (-80, 0, 0) mm."""
    make_object(sqlite_http)
    post(sqlite_http, "thing", two_clusters, gripper="pg70")
    return sqlite_http


def ok(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def peak(body: dict[str, Any]) -> tuple[float, float]:
    """Where the picture is darkest, metres."""
    values = np.array(body["values"])
    i, j = np.unravel_index(values.argmax(), values.shape)
    across, upward = np.array(body["across_m"]), np.array(body["upward_m"])
    return float(0.5 * (across[i] + across[i + 1])), float(0.5 * (upward[j] + upward[j + 1]))


def test_all_grasps_and_those_from_one_side(filled: httpx.Client) -> None:
    body = ok(filled.get(PATH + "?plane=xz"))
    assert (body["report"], body["plane"], body["grasps"], body["passing"]) == ("projection", "xz", 500, 500)
    assert body["across"] == [1, 0, 0]
    assert body["upward"] == [0, 0, 1]
    assert [item["axis"] for item in body["profiles"]] == ["x", "z"]
    assert body["share"]["value"] == pytest.approx(1)
    values = np.array(body["values"])
    assert values.max() == 1
    area = np.diff(body["across_m"])[0] * np.diff(body["upward_m"])[0]
    assert values.sum() * body["peak_per_m2"] * area == pytest.approx(1, abs=0.03)
    np.testing.assert_allclose(peak(body), (0, 0.06), atol=0.008)
    for item in body["profiles"]:
        step = np.diff(item["at_m"])[0]
        assert sum(item["density_per_m"]) * step == pytest.approx(1, abs=0.03)

    above = ok(filled.get(PATH + "?plane=xz&approach=-z"))
    assert above["passing"] == pytest.approx(300, abs=6)
    assert above["share"]["value"] == pytest.approx(0.6, abs=0.05)
    np.testing.assert_allclose(peak(above), (0, 0.06), atol=0.008)
    side = ok(filled.get(PATH, params={"plane": "0,-1,0", "approach": "2,0,0", "approach_cone_deg": 40}))
    np.testing.assert_allclose(peak(side), (-0.08, 0), atol=0.008)
    assert side["approach"] == [1, 0, 0]
    assert side["share"]["value"] == pytest.approx(0.4, abs=0.05)
    assert side["share"]["low"] < side["share"]["value"] < side["share"]["high"]
    assert "within 40 deg of x" in side["text"]
    # Tool x of those from above lies along x, of those from the side along -z: either sign.
    across = ok(filled.get(PATH + "?direction=z"))
    assert across["passing"] == pytest.approx(200, abs=6)
    assert ok(filled.get(PATH + "?direction=-z"))["passing"] == across["passing"]
    # Without a plane, the one that shows most of these: they lie along x and z.
    assert across["plane"] == "xz"
    seen = ok(filled.get(PATH, params={"plane": "1,1,0"}))
    assert np.dot(seen["normal"], seen["across"]) == pytest.approx(0)


def test_with_a_stored_kernel_and_over_the_objects_outline(
    filled: httpx.Client, put_box: Callable[..., Any], make_object: Make, post: Post, two_clusters: Poses
) -> None:
    assert ok(filled.get(PATH))["outline"] == []
    assert filled.post("/kernels", json={"object": "thing"}).status_code == 201
    body = ok(filled.get(PATH + "?plane=xz&approach=-z&kernel=anisotropic"))
    assert body["kernel"]["kind"] == "anisotropic"
    assert body["drawn"] > 0
    np.testing.assert_allclose(peak(body), (0, 0.06), atol=0.01)
    assert body["share"]["value"] == pytest.approx(0.6, abs=0.05)
    make_object(filled, "box")
    put_box(filled, "box", (0.04, 0.06, 0.1))
    post(filled, "box", two_clusters, gripper="pg70")
    (polygon,) = ok(filled.get("/objects/box/reports/projection?plane=yz"))["outline"]
    np.testing.assert_allclose(np.abs(polygon), np.tile([0.03, 0.05], (len(polygon), 1)), atol=1e-6)


def test_what_is_refused_says_why(sqlite_http: httpx.Client, make_object: Make, post: Post) -> None:
    http = sqlite_http
    make_object(http)
    none = http.get(PATH)
    assert (none.status_code, none.json()["type"].rpartition(":")[2]) == (409, "too-few-trials")
    assert "at least 1 successful trial" in none.json()["title"]
    post(http, "thing", (np.zeros((3, 3)), np.tile([1.0, 0, 0, 0], (3, 1))))
    body = ok(http.get(PATH))
    assert any("rests on 3 grasps" in warning for warning in body["warnings"])
    away = http.get(PATH + "?approach=z&approach_cone_deg=5")
    assert (away.status_code, away.json()["type"].rpartition(":")[2]) == (409, "no-such-grasps")
    assert "widen approach_cone_deg" in away.json()["title"]
    for query in ("plane=zz", "plane=0,0,0", "approach=up", "direction=1,2", "direction_cone_deg=120"):
        refused = http.get(f"{PATH}?{query}")
        assert refused.status_code == 422, query
        assert refused.json()["errors"][0]["field"].split(".")[0] == query.partition("=")[0]


def test_its_figure(filled: httpx.Client) -> None:
    png = filled.get(PATH + "?approach=-z", headers={"Accept": "image/png"})
    assert (png.status_code, png.headers["content-type"]) == (200, "image/png")
    svg = filled.get(PATH + "?approach=-z", headers={"Accept": "image/svg+xml"})
    assert "successful grasps" in svg.text or "<svg" in svg.text
