"""Every report of trials that fill no volume: an answer, its figure, or a plain refusal with a way out."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from degenerate_trials import KINDS

Floats = NDArray[np.float64]
Pair = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]

#: Reports by the ways they can be asked; kernels' similarity, which takes long, has tests of its own.
ASKED = (
    "anisotropy",
    "anisotropy?method=density",
    "convergence",
    "bandwidth",
    "projection",
    "projection?plane=1,1,0&approach=-z",
    "calibration",
    "calibration?sigma_position_m=0.001&sigma_rotation_deg=2",
)
REFUSED = {"too-few-trials", "failures-needed", "no-such-grasps"}
#: What a refusal says can be done.
WAYS_OUT = (
    "more are needed", "at least", "post ", "add trials", "widen", "many more", "further apart", "sweep"
)  # fmt: skip
#: From 200 successes on there are curves and widths.
COUNT = 320
#: Much as others are to the reports; densities and mixtures meet all of them.
LIKE_OTHERS = {"one rotation", "one position", "two poses", "huge", "half turns", "antipodal twins"}


def answered(http: httpx.Client, path: str, *, drawn: bool = True) -> dict[str, Any] | None:
    """A report, which also draws, or None where it was refused as it should be."""
    deadline = time.monotonic() + 60.0
    while (answer := http.get(path)).status_code == 202:
        assert time.monotonic() < deadline, path
    assert answer.status_code in (200, 409), f"{path}: {answer.text}"
    body: dict[str, Any] = answer.json()
    if answer.status_code == 409:
        assert body["type"].rpartition(":")[2] in REFUSED, body
        assert any(way in body["title"] for way in WAYS_OUT), body["title"]
        return None
    assert body["text"].endswith("."), body["text"]
    if drawn:
        figure = http.get(path, headers={"Accept": "image/svg+xml"})
        assert figure.status_code == 200, f"{path}: {figure.text}"
    return body


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.long] if kind in LIKE_OTHERS else []) for kind in KINDS]
)
def test_a_report_or_a_refusal(sqlite_http: httpx.Client, make_object: Make, post: Post, kind: str) -> None:
    http = sqlite_http
    trials = KINDS[kind](COUNT, np.random.default_rng(0))
    make_object(http)
    told = ["success" if won else "missed" for won in trials.won]
    post(http, "thing", tuple(trials.poses), told, gripper="pg70", source="robot")
    for asked in ASKED:
        answered(http, f"/objects/thing/reports/{asked}", drawn="?" not in asked)
    assert http.get("/reports/summary", headers={"Accept": "image/svg+xml"}).status_code == 200
    make_object(http, "both")
    for source in ("simulation", "robot"):
        post(http, "both", tuple(trials.poses), told, gripper="pg70", source=source)
    answered(http, "/objects/both/reports/sources")


def test_trials_from_above_at_one_height(http: httpx.Client, make_object: Make, post: Post) -> None:
    """What none of them tried is told of none."""
    trials = KINDS["planar"](COUNT, np.random.default_rng(0))
    make_object(http)
    told = ["success" if won else "missed" for won in trials.won]
    post(http, "thing", tuple(trials.poses), told, gripper="pg70")
    body = answered(http, "/objects/thing/reports/anisotropy")
    assert body is not None
    by = {item["axis"]: item for item in body["tolerances"]}
    for axis in ("z", "rx", "ry"):
        assert by[axis]["half_width"] is None
        assert by[axis]["tried"] == [0, 0]
    assert any("nothing was tried displaced along or about z, rx, ry alone" in w for w in body["warnings"])
    assert "z against y" in body["text"]
    assert {item["verdict"] for item in body["hypotheses"] if item["ratio"] is None} == {"undecided"}
    fitted = http.post("/kernels", json={"object": "thing", "components": 2})
    assert fitted.status_code == 201, fitted.text


def test_kernels_of_trials_that_differ_in_one_way_only(
    sqlite_http: httpx.Client, make_object: Make, post: Post
) -> None:
    http = sqlite_http
    asked = "reports/kernel-similarity?window_position_m=0.01&window_rotation_deg=60"
    for slug, kind in (("flat", "planar"), ("taught", "identical")):
        trials = KINDS[kind](60, np.random.default_rng(0))
        make_object(http, slug)
        post(http, slug, tuple(trials.poses), gripper="pg70")
    flat, taught = (answered(http, f"/objects/{slug}/{asked}") for slug in ("flat", "taught"))
    assert flat is not None
    assert flat["mixtures"][1]["similarity"] > 0.8
    assert any("along z, about x, about y of the gripper" in warning for warning in flat["warnings"])
    assert taught is not None
    assert taught["mixtures"][0]["similarity"] > 0.99
    assert any("at one pose" in warning for warning in taught["warnings"])


def test_one_pose_tried_again_and_again(sqlite_http: httpx.Client, make_object: Make, post: Post) -> None:
    http = sqlite_http
    trials = KINDS["identical"](COUNT, np.random.default_rng(0))
    make_object(http)
    told = ["success" if won else "missed" for won in trials.won]
    post(http, "thing", tuple(trials.poses), told, gripper="pg70")
    body = answered(http, "/objects/thing/reports/anisotropy")
    assert body is not None
    assert body["text"].startswith("No tolerance can be told from these trials, the warnings say why")
    assert all(item["half_width"] is None for item in body["tolerances"])
    # No block can be left out, so nothing chose the widths.
    kernel = http.get("/objects/thing/density").json()["kernel"]
    assert kernel["sigma_position_m"] == pytest.approx(0.015)
    assert "one block" in kernel["rule"]


def test_one_far_trial_spoils_no_picture(sqlite_http: httpx.Client, make_object: Make, post: Post) -> None:
    http = sqlite_http
    rng = np.random.default_rng(0)
    p, q = rng.normal(scale=0.02, size=(300, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (300, 1))
    # Most of them lie in the plane of x and z: the far one alone would say x and y.
    p[:, 1] *= 0.1
    make_object(http)
    post(http, "thing", (p, q), gripper="pg70")
    alone = answered(http, "/objects/thing/reports/projection")
    make_object(http, "far")
    post(http, "far", (np.concatenate([p, [[5.0, 20.0, 0.5]]]), q[[*range(300), 0]]), gripper="pg70")
    body = answered(http, "/objects/far/reports/projection")
    assert alone is not None
    assert body is not None
    assert (body["plane"], body["outside"], alone["outside"]) == (alone["plane"], 1, 0) == ("xz", 1, 0)
    np.testing.assert_allclose(body["across_m"], alone["across_m"], atol=0.002)
    assert body["peak_per_m2"] == pytest.approx(alone["peak_per_m2"] * 300 / 301, rel=0.02)
    (told,) = (warning for warning in body["warnings"] if "outside the picture" in warning)
    assert "1 of 301 successful grasps lies up to 20.6 m" in told
    assert "(trial 301)" in told
    svg = http.get("/objects/far/reports/projection", headers={"Accept": "image/svg+xml"})
    assert svg.status_code == 200
    # Two that are apart are no outliers: they are shown, coarsely, and it is said.
    make_object(http, "apart")
    post(http, "apart", (np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]]), q[:2]), gripper="pg70")
    coarse = answered(http, "/objects/apart/reports/projection")
    assert coarse is not None
    assert coarse["outside"] == 0
    assert any("wider than the kernel" in warning for warning in coarse["warnings"])


def test_a_taught_pose_is_the_best_of_its_equals(
    sqlite_http: httpx.Client, make_object: Make, post: Post
) -> None:
    """Around one pose that held 20 times of 25 the probability is the same: the density decides."""
    http = sqlite_http
    make_object(http)
    p, q = np.tile([0.0, 0.0, 0.05], (25, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (25, 1))
    post(http, "thing", (p, q), ["success"] * 20 + ["missed"] * 5, gripper="pg70", source="robot")
    for objective in ("success_probability", "robust&pose_noise_m=0.002"):
        answer = http.get(f"/objects/thing/best-grasp?objective={objective}")
        assert answer.status_code == 200, answer.text
        (grasp,) = answer.json()["grasps"]
        assert np.linalg.norm(np.subtract(grasp["position"], p[0])) < 0.003, objective
        assert grasp["relative"] > 0.97
    # Of given poses, too; and the score that is told is the score.
    away = [
        {"position": [0.0, 0.0, 0.05 + 0.002 * k], "quaternion_xyzw": [1, 0, 0, 0]} for k in (4, 3, 1, 0, 2)
    ]
    body = {"objective": "success_probability", "candidates": away, "count": 5}
    found = http.post("/objects/thing/best-grasp", json=body).json()["grasps"]
    assert [item["candidate"] for item in found] == [3, 2, 4, 1, 0]
    near = [item for item in found if item["support"]["enough"]]
    assert [item["candidate"] for item in near] == [3, 2]
    for item in near:
        assert item["score"] == pytest.approx(item["interval"]["low"], abs=1e-7)
    for item in found[len(near) :]:
        assert item["interval"] is None
        assert item["score"] < near[-1]["score"]
