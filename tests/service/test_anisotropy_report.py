"""The anisotropy report along edges and pairs of surfaces, of a bar whose answer is known; its refusals."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graspdb_density import se3
from graspdb_geometry.collision import Scene
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70

Floats = NDArray[np.float64]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]
PutBox = Callable[..., Scene]

REPORT = "/objects/thing/reports/anisotropy"
#: A bar along z.
SIZE = (0.02, 0.04, 0.16)


def ok(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def attempts(scene: Scene, *, tilt_deg: float = 40.0) -> tuple[Floats, Floats, list[str]]:
    """Grasps of the bar from the side -x: positions of a grid at rotations about the approach, and tilted.

    They hold where the open gripper is free, something is between the fingers, and the closing axis is within
    25 degrees of the bar's y.
    """
    side = Rotation.from_matrix(np.stack([[0, 0, 1], [0, -1, 0], [1, 0, 0]], axis=-1))
    rolls = [Rotation.from_rotvec([0, 0, math.radians(a)]) for a in (-90, -55, -20, 0, 20, 40)]
    tilts = [Rotation.from_rotvec([0, math.radians(a), 0]) for a in (-tilt_deg, 0, tilt_deg)]
    turns = [side * roll * tilt for roll in rolls for tilt in tilts]
    # Off the planes that two edges are equally far from.
    x, y, z = np.arange(-4, 3) * 0.01 + 0.002, np.arange(-3, 4) * 0.01 + 0.003, np.arange(-12, 13) * 0.01
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    p = np.tile(grid, (len(turns), 1))
    q = np.repeat([turn.as_quat() for turn in turns], len(grid), axis=0)
    codes, _ = scene.classify(ToolPoses(p, q), PG70)
    closing = se3.rotate(q, np.array([0.0, 1.0, 0.0]))
    held = (codes == 2) & (np.abs(closing[:, 1]) > math.cos(math.radians(25.0)))
    told = ["success" if h else "collision" if c == 0 else "missed" for h, c in zip(held, codes, strict=True)]
    return p, q, told


@pytest.fixture
def filled(
    sqlite_url: str, serve: Callable[..., str], make_object: Make, post: Post, put_box: PutBox
) -> httpx.Client:
    """A service with all the attempts at ``thing``, and a twelfth of them at ``few``."""
    http = httpx.Client(base_url=serve(sqlite_url, report_wait_s=60), timeout=150)
    for slug, share in (("thing", 1.0), ("few", 1.0 / 12.0)):
        make_object(http, slug)
        p, q, told = attempts(put_box(http, slug, SIZE))
        assert 200 < told.count("success") < told.count("collision")
        kept = np.flatnonzero(np.random.default_rng(0).random(len(p)) < share)
        post(http, slug, (p[kept], q[kept]), [told[i] for i in kept], gripper="pg70")
    return http


def widths(body: dict[str, Any]) -> dict[str, float]:
    return {item["axis"]: item["half_width"] or 0.0 for item in body["tolerances"]}


def test_along_its_edge_a_bar_forgives_more(filled: httpx.Client) -> None:
    by = {
        name: ok(filled.get(REPORT, params={"alignment": name}))
        for name in ("gripper", "edge", "surface-pair")
    }
    assert {item["name"] for item in by["gripper"]["hypotheses"]} == {"x-wide", "z-wide", "ry-wide"}
    assert by["gripper"]["aligned"] == by["gripper"]["grasps"]
    for name in ("edge", "surface-pair"):
        body = by[name]
        assert body["alignment"] == name
        assert 0 < body["aligned"] < body["grasps"]
        assert any("along the gripper's axes" in warning for warning in body["warnings"])
        # The gripper's own x crosses the bar wherever it is rolled; an edge's and a pair's run along it.
        assert widths(body)["x"] > 2 * widths(by["gripper"])["x"]
        judged = {item["name"]: item for item in body["hypotheses"]}
        assert judged["x-wide"]["verdict"] == "confirmed"
        assert judged["x-wide"]["low"] <= judged["x-wide"]["ratio"] <= judged["x-wide"]["high"]
        assert judged["alignment-sharpens"]["verdict"] == "confirmed"
        assert "x forgives" in body["text"]
    # A side's y is the way the fingers close: what moves there is centred no better than before.
    assert widths(by["surface-pair"])["y"] < widths(by["surface-pair"])["z"]
    assert "x along the nearest edge" in by["edge"]["text"]
    assert "the pair of surfaces or edges" in by["surface-pair"]["text"]


def test_the_density_s_method_along_edges(filled: httpx.Client) -> None:
    query = "/objects/few/reports/anisotropy?method=density&sigma_position_m=0.008&sigma_rotation_deg=10"
    body = ok(filled.get(query + "&alignment=edge"))
    assert (body["method"], body["alignment"]) == ("density", "edge")
    profile = {item["axis"]: item for item in body["tolerances"]}

    def at(axis: str, where: float) -> float:
        return float(np.interp(where, profile[axis]["displacement"], profile[axis]["probability"]))

    assert at("x", 0.03) > 1.5 * at("y", 0.03)
    assert {item["name"] for item in body["hypotheses"]} >= {"x-wide", "alignment-sharpens"}


def test_success_by_relation_is_what_was_counted(filled: httpx.Client, put_box: PutBox) -> None:
    body = ok(filled.get(REPORT))
    found = {(item["relation"], *(item["angle_deg"] or ())): item for item in body["relations"]}
    square = found["surfaces", 0, 10]
    assert square["attempts"] > 200
    assert square["collisions"] + square["successes"] <= square["attempts"]
    assert square["low"] <= square["probability"] <= square["high"]
    assert square["probability"] == pytest.approx(square["successes"] / square["attempts"])
    assert square["free_probability"] == pytest.approx(
        square["successes"] / (square["attempts"] - square["collisions"])
    )
    askew = found["surfaces", 30, 45]
    assert askew["successes"] == 0 < askew["attempts"]
    assert found["none",]["attempts"] > 0
    assert found["none",]["probability"] < 0.5 * square["probability"]
    everywhere = sum(item["attempts"] for item in body["relations"] if item["relation"] == "surfaces")
    assert everywhere < body["attempts"]
    assert "on two opposite surfaces" in body["text"]


def test_what_the_geometry_does_not_have_is_said(
    http: httpx.Client, make_object: Make, post: Post, put_box: PutBox
) -> None:
    make_object(http)

    def refused(alignment: str, kind: str) -> str:
        answer = http.get(REPORT, params={"alignment": alignment})
        assert answer.status_code == 409, answer.text
        assert answer.json()["type"].endswith(kind), answer.text
        return str(answer.json()["title"])

    rng = np.random.default_rng(0)
    p, q = rng.uniform(-0.05, 0.05, (60, 3)), se3.random_quaternions(60, rng)
    told = ["success"] * 30 + ["missed"] * 30
    post(http, "thing", (p, q), told)
    assert "PUT /objects/thing/mesh" in refused("edge", "mesh-missing")
    assert "name one (gripper)" in refused("surface-pair", "gripper-unknown")
    body = http.get(REPORT, params={"alignment": "surface-pair", "gripper": "pg70"})
    assert body.json()["type"].endswith("mesh-missing")
    assert http.get(REPORT, params={"alignment": "corner"}).status_code == 422
    make_object(http, "cube")
    put_box(http, "cube", (0.1, 0.1, 0.1))
    post(http, "cube", (p, q), told, gripper="pg70")
    answer = http.get("/objects/cube/reports/anisotropy?alignment=surface-pair")
    assert answer.json()["type"].endswith("no-surface-pairs")
    assert "70 mm" in answer.json()["title"]
