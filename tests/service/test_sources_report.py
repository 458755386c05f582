"""The sources report: simulation against real trials."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb_density import IsotropicKernel, SuccessModel, se3
from graspdb_density.se3 import Poses

Pair = tuple[NDArray[np.float64], NDArray[np.float64]]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]
PATH = "/objects/thing/reports/sources"
WIDTHS = np.array([0.03, 0.012, 0.02, 0.3, 0.8, 0.3])


def field(count: int, seed: int, shift: float = 0.0) -> tuple[Pair, NDArray[np.bool_]]:
    """Pair around one grasp and whether they hold; ``shift`` moves what holds along x."""
    rng = np.random.default_rng(seed)
    xi = rng.uniform(-2.0, 2.0, (count, 6)) * WIDTHS
    off = xi / WIDTHS
    off[:, 0] -= shift / WIDTHS[0]
    return (xi[:, :3], se3.from_rotation_vector(xi[:, 3:])), np.sum(off**2, axis=1) < 5.0


def told(won: NDArray[np.bool_]) -> list[str]:
    return ["success" if w else "failure" for w in won]


def ok(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


@pytest.fixture
def simulated(sqlite_url: str, serve: Callable[..., str], make_object: Make, post: Post) -> httpx.Client:
    """3,000 simulated attempts."""
    http = httpx.Client(base_url=serve(sqlite_url, report_wait_s=60), timeout=90)
    make_object(http)
    poses, won = field(3_000, 0)
    post(http, "thing", poses, told(won), gripper="pg70", protocol="wrench", source="simulation")
    return http


def test_predictions_at_a_robots_poses_are_judged(simulated: httpx.Client, post: Post) -> None:
    http = simulated
    (p, q), won = field(300, 1)
    post(http, "thing", (p, q), told(won), gripper="pg70", protocol="pick", source="robot")
    kinds = [s for s in told(field(2_000, 2)[1]) if s == "success"]
    good = field(2_000, 2)
    human = good[0][0][good[1]], good[0][1][good[1]]
    post(http, "thing", human, kinds, source="human")
    body = ok(http.get(PATH + "?sigma_position_m=0.008&sigma_rotation_deg=12"))
    assert (body["attempts"], body["protocol"], body["source"]) == (3_000, "wrench", None)
    robot, person = body["sources"]
    assert (robot["source"], robot["protocols"], robot["trials"]) == ("robot", ["pick"], 300)
    assert robot["successes"] == int(won.sum())
    assert robot["share"]["low"] < won.mean() < robot["share"]["high"]
    # By the model itself, over all attempts.
    (sp, sq), swon = field(3_000, 0)
    model = SuccessModel.build(Poses.of(sp, sq), swon, kernel=IsotropicKernel(0.008, math.radians(12.0)))
    answer = model.evaluate(Poses.of(p, q))
    known = answer.effective_trials >= 1.0
    assert robot["within_reach"] == pytest.approx(int(known.sum()), abs=2)
    assert robot["predicted"] == pytest.approx(answer.probability[known].mean(), abs=5e-3)
    right = ((answer.probability > 0.5) == won)[known]
    assert robot["agreement"]["value"] == pytest.approx(right.mean(), abs=0.01)
    assert sum(robot["confusion"].values()) == robot["within_reach"]
    assert sum(item["count"] for item in robot["bins"]) == robot["within_reach"]
    assert robot["skill"]["low"] < robot["skill"]["value"] < robot["skill"]["high"]
    assert robot["auc"] > 0.7
    # Both were drawn alike: as alike as chance lets them be.
    likeness = robot["similarity"]
    assert likeness["value"] > likeness["expected"]["low"] - 0.1
    assert (person["source"], person["agreement"], person["bins"]) == ("human", None, [])
    assert person["predicted_at_successes"] == pytest.approx(person["predicted"])
    assert any("human" in text and "successes only" in text for text in body["warnings"])
    assert "300 robot trials succeed" in body["text"]
    png = http.get(PATH, headers={"Accept": "image/png"})
    assert png.content.startswith(b"\x89PNG")


def test_a_robot_that_finds_otherwise_shows(simulated: httpx.Client, post: Post) -> None:
    poses, won = field(500, 3, shift=0.04)
    post(simulated, "thing", poses, told(won), gripper="pg70", protocol="wrench", source="robot")
    (robot,) = ok(simulated.get(PATH))["sources"]
    assert robot["skill"]["value"] < 0.3
    assert robot["agreement"]["value"] < 0.95
    assert robot["similarity"]["value"] < robot["similarity"]["expected"]["low"]


def test_what_is_missing_is_said(sqlite_http: httpx.Client, make_object: Make, post: Post) -> None:
    http = sqlite_http
    make_object(http)
    none = http.get(PATH)
    assert (none.status_code, "there are 0 and 0" in none.json()["title"]) == (409, True)
    poses, won = field(2_000, 4)
    post(http, "thing", poses, told(won), gripper="pg70", protocol="wrench", source="simulation")
    alone = http.get(PATH)
    assert (alone.status_code, "There are no trials of a robot" in alone.json()["title"]) == (409, True)
    (p, q), won = field(10, 5)
    post(http, "thing", (p, q), told(won | (np.arange(10) % 2 == 0)), gripper="pg70", source="robot")
    body = ok(http.get(PATH))
    (robot,) = body["sources"]
    assert (robot["agreement"], robot["similarity"]) == (None, None)
    assert any("more trials within reach" in text for text in body["warnings"])
    # Pair where nothing was simulated are not judged.
    post(http, "thing", (p + 1.0, q), ["failure"] * 10, gripper="pg70", source="robot")
    away = ok(http.get(PATH))
    assert away["sources"][0]["trials"] == 20
    assert any("lie where nothing was simulated" in text for text in away["warnings"])
    assert http.get(PATH + "?source=robot").status_code == 422


def test_a_robot_that_holds_less_has_a_correction(simulated: httpx.Client, post: Post) -> None:
    """Half of what simulation promises: the map says so, by trials it has not seen; few are undecided."""
    http = simulated
    path = PATH + "?sigma_position_m=0.008&sigma_rotation_deg=12"
    (p, q), won = field(400, 7)
    held = won & (np.random.default_rng(8).random(400) < 0.4)
    post(http, "thing", (p[:6], q[:6]), told(held[:6]), gripper="pg70", protocol="wrench", source="robot")
    few = ok(http.get(path))["sources"][0]["correction"]
    assert few is None or (few["judged"], few["brier"]) == ("undecided", None)
    post(http, "thing", (p, q), told(held), gripper="pg70", protocol="wrench", source="robot")
    body = ok(http.get(path))
    found = body["sources"][0]["correction"]
    assert found["judged"] == "better"
    assert found["brier"] < found["uncorrected_brier"]
    assert found["corrected"][12] < found["predicted"][12] - 0.1
    assert all(
        low < middle < high
        for low, middle, high in zip(found["low"], found["corrected"], found["high"], strict=True)
    )
    assert found["effective_trials"] <= found["trials"]
    assert "corrected, simulation predicts left-out trials better" in body["text"]
    png = http.get(path, headers={"Accept": "image/png"})
    assert png.content.startswith(b"\x89PNG")


def test_probabilities_are_calibrated_for_a_robot(simulated: httpx.Client, post: Post) -> None:
    """By the sources report's correction; too few real trials, and other sources, are refused."""
    http, widths = simulated, {"sigma_position_m": 0.008, "sigma_rotation_deg": 12}
    at = {"position": "0,0,0", "quaternion_xyzw": "0,0,0,1", **widths}
    path = "/objects/thing/likelihood"
    none = http.get(path, params={**at, "calibrated_for": "robot"})
    assert (none.status_code, none.json()["type"].rsplit(":")[-1]) == (409, "too-few-real-trials")
    (p, q), won = field(400, 7)
    held = won & (np.random.default_rng(8).random(400) < 0.4)
    post(http, "thing", (p, q), told(held), gripper="pg70", protocol="wrench", source="robot")
    plain = ok(http.get(path, params={**at, "source": "simulation"}))
    found = ok(http.get(path, params={**at, "calibrated_for": "robot"}))
    info = found["calibration"]
    assert (info["source"], info["applied"], info["judged"]) == ("robot", True, "better")
    assert list(found["selection"]["sources"]) == ["simulation"]
    chance = plain["success_probability"][0]
    logit = info["shift"] + info["slope"] * math.log(chance / (1.0 - chance))
    assert found["success_probability"][0] == pytest.approx(1.0 / (1.0 + math.exp(-logit)), abs=0.01)
    assert found["density"] == pytest.approx(plain["density"])
    assert plain["calibration"] is None if "calibration" in plain else True
    best = ok(
        http.get(
            "/objects/thing/best-grasp",
            params={**widths, "calibrated_for": "robot", "objective": "success_probability"},
        )
    )
    grasp = best["grasps"][0]
    assert best["calibration"]["applied"]
    assert grasp["score"] == pytest.approx(grasp["interval"]["low"], abs=1e-6)
    sure = {**widths, "calibrated_for": "robot", "min_success_probability": 0.99}
    assert ok(http.get("/objects/thing/best-grasp", params=sure))["status"] == "infeasible"
    for wrong in ({"source": "robot"}, {"source_weight": "robot:1"}, {"calibrated_for": "simulation"}):
        answer = http.get(path, params={**at, "calibrated_for": "robot", **wrong})
        assert answer.status_code == 422
        assert next(iter(wrong)) in answer.json()["errors"][0]["field"]


def test_a_correction_that_does_not_help_is_not_applied(simulated: httpx.Client, post: Post) -> None:
    """Where simulation is right, its probabilities stay, with wider intervals, and the answer says so."""
    poses, won = field(40, 9)
    post(simulated, "thing", poses, told(won), gripper="pg70", protocol="wrench", source="robot")
    at = {"position": "0.01,0,0", "quaternion_xyzw": "0,0,0,1", "sigma_position_m": 0.02}
    plain = ok(simulated.get("/objects/thing/likelihood", params={**at, "source": "simulation"}))
    found = ok(simulated.get("/objects/thing/likelihood", params={**at, "calibrated_for": "robot"}))
    assert not found["calibration"]["applied"]
    assert "not corrected" in found["calibration"]["reason"]
    assert any("not corrected" in warning for warning in found["warnings"])
    best = ok(simulated.get("/objects/thing/best-grasp", params={"calibrated_for": "robot"}))
    assert best["calibration"]["applied"] or any("not corrected" in text for text in best["warnings"])
    assert found["success_probability"] == pytest.approx(plain["success_probability"], abs=1e-6)
    assert found["interval"]["low"][0] < plain["interval"]["low"][0]
