"""Reports: answers against the maths, the life of a run, figures, and what too few trials are told."""

from __future__ import annotations

import math
import time
import uuid
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb_density import GraspDensity, IsotropicKernel, SuccessModel, choose_widths, se3
from graspdb_density.kde.rows import Rows
from graspdb_density.se3 import Poses
from graspdb_density.statistics.convergence import verdict
from graspdb_density.statistics.incremental_bootstrap import IncrementalCurve
from graspdb_density.success.calibration import area_under_curve, assign_blocks, calibrate
from graspdb_density.vicinity.anisotropy import empirical_anisotropy
from graspdb_geometry.poses import ToolPoses
from graspdb_service.storage import objects, report_runs
from graspdb_service.storage.database import Database
from graspdb_service.storage.report_runs import RunKey

Floats = NDArray[np.float64]
Pair = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]
Serve = Callable[..., str]

REPORT = "/objects/thing/reports/"


def field(count: int, seed: int = 0) -> tuple[Pair, NDArray[np.bool_]]:
    """Pair near one grasp of a bar and whether they hold: wide along x and about y, narrow otherwise."""
    rng = np.random.default_rng(seed)
    widths = np.array([0.03, 0.006, 0.012, 0.2, 0.8, 0.2])
    xi = rng.uniform(-2.0, 2.0, (count, 6)) * widths
    return (xi[:, :3], se3.from_rotation_vector(xi[:, 3:])), np.sum((xi / widths) ** 2, axis=1) < 5.0


def outcomes(won: NDArray[np.bool_]) -> list[str]:
    return ["success" if w else "missed" for w in won]


@pytest.fixture(scope="module")
def trials() -> tuple[Pair, NDArray[np.bool_]]:
    return field(4_000)


@pytest.fixture
def filled(
    sqlite_url: str, serve: Serve, make_object: Make, post: Post, trials: tuple[Pair, NDArray[np.bool_]]
) -> httpx.Client:
    """A service with one object that the trials were posted to; it waits for whatever is asked."""
    http = httpx.Client(base_url=serve(sqlite_url, report_wait_s=60), timeout=90)
    make_object(http)
    post(http, "thing", trials[0], outcomes(trials[1]), gripper="pg70")
    return http


def ok(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def problem(answer: httpx.Response, status: int) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    body: dict[str, Any] = answer.json()
    return body


def finished(http: httpx.Client, location: str, *states: str) -> dict[str, Any]:
    deadline = time.monotonic() + 60
    while True:
        run = ok(http.get(location))
        if run["state"] in states:
            return run
        assert run["state"] == "running", run
        assert time.monotonic() < deadline, run
        time.sleep(0.05)


# -- answers


def test_convergence_is_the_curve_of_the_maths(
    filled: httpx.Client, trials: tuple[Pair, NDArray[np.bool_]]
) -> None:
    (p, q), won = trials
    body = ok(filled.get(REPORT + "convergence"))
    kernel = choose_widths(Rows.of(Poses.of(p[won], q[won]))).kernel
    curve = IncrementalCurve.of(Rows.of(Poses.of(p[won], q[won])), kernel, threads=2).curve
    judged = verdict(curve)
    (found,) = body["curves"]
    assert [point["grasps"] for point in found["points"]] == [point.grasps for point in curve.points]
    np.testing.assert_allclose(
        [point["similarity"] for point in found["points"]],
        [point.similarity for point in curve.points],
        atol=1e-4,
    )
    np.testing.assert_allclose(
        [point["log_likelihood"] for point in found["points"]],
        [point.log_likelihood for point in curve.points],
        atol=1e-3,
    )
    assert found["verdict"]["state"] == judged.state
    assert found["verdict"]["needed"]["value"] == pytest.approx(judged.needed.grasps, rel=0.02)
    assert body["held_out"] == curve.held_out
    assert (body["object"], body["gripper"], body["level"]) == ("thing", "pg70", 0.9)
    assert f"{int(won.sum()):,} successful grasps are" in body["text"]


def test_convergence_beside_the_matched_isotropic_kernel(filled: httpx.Client) -> None:
    assert (
        "nothing-to-match" in problem(filled.get(REPORT + "convergence?matching=determinants"), 409)["type"]
    )
    kernel = filled.post("/kernels", json={"object": "thing"}).json()
    body = ok(filled.get(REPORT + "convergence?kernel=anisotropic"))
    own, matched = body["curves"]
    assert (own["kernel"]["id"], body["matching"], body["matched"]) == (kernel["id"], "determinants", True)
    assert matched["kernel"]["sigma_position_m"] == pytest.approx(kernel["sigma_position_m"])
    assert matched["kernel"]["sigma_rotation_deg"] == pytest.approx(kernel["sigma_rotation_deg"])
    # Both judged by the same held-out grasps: the shape of the vicinity predicts them better.
    assert own["points"][-1]["log_likelihood"] > matched["points"][-1]["log_likelihood"]
    assert body["ratio"]["low"] <= body["ratio"]["value"] <= body["ratio"]["high"]
    told = problem(filled.get(REPORT + "convergence?kernel=anisotropic&matching=success"), 409)
    assert told["type"].endswith("checks-needed")
    assert "POST /objects/thing/sweeps" in told["title"]
    assert told["calls"][0]["body"]["sample"]["kernel"] == kernel["id"]


def test_empirical_anisotropy_is_that_of_the_maths(
    filled: httpx.Client, trials: tuple[Pair, NDArray[np.bool_]]
) -> None:
    (p, q), won = trials
    body = ok(filled.get(REPORT + "anisotropy"))
    found = empirical_anisotropy(Poses.of(p, q), won)
    assert (body["attempts"], body["grasps"]) == (4_000, found.grasps)
    assert body["translation_pairs"] == found.translation_pairs
    for item, expected in zip(body["tolerances"], found.tolerances, strict=True):
        assert item["axis"] == expected.axis
        assert item["count"] == expected.count.tolist()
        np.testing.assert_allclose(item["probability"], expected.probability, atol=1e-6)
        if not item["within"]:
            assert item["half_width"] == pytest.approx(expected.half_width, rel=1e-6)
    for name, ours in (("translations", found.translations), ("rotations", found.rotations)):
        for item, other in zip(body[name], ours, strict=True):
            values = np.array([[np.nan if v is None else v for v in row] for row in item["probability"]])
            np.testing.assert_allclose(values, other.probability, atol=1e-6)
            assert np.array(item["count"]).tolist() == other.count.tolist()
    assert body["text"].startswith("A good grasp forgives")
    assert "mm" in body["text"]
    assert "deg" in body["text"]
    assert "along x" in body["text"]
    width = {item["axis"]: item["half_width"] for item in body["tolerances"]}
    assert width["x"] > 1.5 * width["y"]
    assert width["ry"] > 1.5 * width["rx"]


def test_anisotropy_by_density_agrees_on_what_is_wide(filled: httpx.Client) -> None:
    body = ok(filled.get(REPORT + "anisotropy?method=density&sigma_position_m=0.004&sigma_rotation_deg=6"))
    assert (body["method"], body["kernel"]["sigma_position_m"]) == ("density", 0.004)
    profile = {item["axis"]: item for item in body["tolerances"]}

    def at(axis: str, where: float) -> float:
        item = profile[axis]
        return float(np.interp(where, item["displacement"], item["probability"]))

    assert at("x", 0.015) > 1.3 * at("y", 0.015)
    assert at("ry", 0.4) > 1.3 * at("rx", 0.4)
    # A wide kernel hides what is narrower: nothing is claimed of it.
    body = ok(filled.get(REPORT + "anisotropy?method=density&sigma_position_m=0.03&sigma_rotation_deg=30"))
    hidden = [item["axis"] for item in body["tolerances"] if item["within"]]
    assert "y" in hidden
    assert all(item["half_width"] is None for item in body["tolerances"] if item["within"])
    assert any("smooths more than a grasp forgives" in warning for warning in body["warnings"])
    assert "along y" not in body["text"]


def test_calibration_judges_blocks_left_out(
    filled: httpx.Client, trials: tuple[Pair, NDArray[np.bool_]]
) -> None:
    (p, q), won = trials
    body = ok(filled.get(REPORT + "calibration?sigma_position_m=0.006&sigma_rotation_deg=10"))
    kernel = IsotropicKernel(0.006, math.radians(10))
    blocks = assign_blocks(p, edge_m=0.018)
    predicted, ranked = np.zeros(len(p)), np.zeros(len(p))
    for fold in range(blocks.folds):
        train, held = blocks.fold != fold, blocks.fold == fold
        model = SuccessModel.build(Poses.of(p[train], q[train]), won[train], kernel=kernel)
        predicted[held] = model.evaluate(Poses.of(p[held], q[held])).probability
        density = GraspDensity.build(se3.Poses.of(p[train & won], q[train & won]), kernel=kernel)
        ranked[held] = density.log_density(se3.Poses.of(p[held], q[held]))
    expected = calibrate(predicted, won, blocks=blocks.block)
    assert body["skill"]["value"] == pytest.approx(expected.skill, abs=1e-3)
    assert body["skill"]["low"] == pytest.approx(expected.skill_low, abs=1e-3)
    assert body["ece"] == pytest.approx(expected.ece, abs=1e-3)
    assert body["auc_probability"] == pytest.approx(expected.auc, abs=1e-3)
    assert body["auc_density"] == pytest.approx(area_under_curve(ranked, won), abs=1e-3)
    assert [item["count"] for item in body["bins"]] == [item.count for item in expected.bins]
    assert 0.2 < body["skill"]["value"] < 1
    assert (body["judged"], body["blocks"], body["collisions_known"]) == (4_000, blocks.count, False)
    assert any("collisions count as ordinary failures" in warning for warning in body["warnings"])


def test_collisions_known_and_aligned_with_the_object(
    sqlite_http: httpx.Client, make_object: Make, post: Post, put_box: Callable[..., Any]
) -> None:
    http = sqlite_http
    make_object(http)
    assert (
        "PUT /objects/thing/mesh" in problem(http.get(REPORT + "anisotropy?alignment=object"), 409)["title"]
    )
    scene = put_box(http, "thing", (0.02, 0.03, 0.08))
    rng = np.random.default_rng(0)
    p = rng.uniform(-1.0, 1.0, (3_000, 3)) * [0.05, 0.06, 0.08]
    q = se3.random_quaternions(3_000, rng)
    from known_jaws import PG70

    hit = scene.collides(ToolPoses(p, q), PG70)
    won = ~hit & (np.abs(p[:, 1]) < 0.02)
    told = ["collision" if h else "success" if w else "missed" for h, w in zip(hit, won, strict=True)]
    assert 20 < won.sum() < hit.sum()
    post(http, "thing", (p, q), told, gripper="pg70")
    body = ok(http.get(REPORT + "calibration"))
    assert body["collisions_known"] is True
    assert body["free_skill"]["value"] is not None
    assert body["skill"]["value"] > 0.3
    assert body["share"] == pytest.approx(won.mean())
    aligned = ok(http.get(REPORT + "anisotropy?alignment=object"))
    assert aligned["alignment"] == "object"
    assert "the object's principal axes" in aligned["text"]


def test_a_grids_outcomes_count_without_being_rows(
    sqlite_http: httpx.Client, make_object: Make, post: Post
) -> None:
    """Reports read packed outcomes; here only that sources which post successes alone tell no share."""
    http = sqlite_http
    make_object(http)
    (p, q), won = field(3_000, seed=3)
    post(http, "thing", (p, q), outcomes(won), source="simulation")
    post(http, "thing", (p[:50], q[:50]), "success", source="human")
    assert ok(http.get(REPORT + "anisotropy"))["attempts"] == 3_000


# -- what too few trials are told


def test_too_little_is_said_with_what_is_needed(
    sqlite_http: httpx.Client, make_object: Make, post: Post
) -> None:
    http = sqlite_http
    make_object(http)

    def refused(path: str, kind: str, status: int = 409) -> str:
        told = problem(http.get(REPORT + path), status)
        assert told["type"].endswith(kind), told
        again = problem(http.get(REPORT + path), status)
        assert again["title"] == told["title"]
        return str(told["title"])

    assert "at least 200 successful grasps" in refused("convergence", "too-few-trials")
    assert "there are 0" in refused("anisotropy", "too-few-trials")
    assert "there are 0 and 0" in refused("calibration", "too-few-trials")
    poses, won = field(3_000, seed=1)
    p, q = poses[0][won], poses[1][won]
    post(http, "thing", (p[:3], q[:3]))
    assert "there are 3, so 197 more" in refused("convergence", "too-few-trials")
    assert "so 17 more are needed" in refused("anisotropy", "too-few-trials")
    post(http, "thing", (p[3:150], q[3:150]))
    for path in ("anisotropy", "anisotropy?method=density"):
        assert "needs failures" in refused(path, "failures-needed")
    assert "of sources that post failures" in refused("calibration", "too-few-trials")
    fields = {e["field"] for e in problem(http.get(REPORT + "anisotropy?alignment=corner"), 422)["errors"]}
    assert fields == {"alignment"}
    problem(http.get(REPORT + "anisotropy?method=guess"), 422)
    problem(http.get(REPORT + "convergence?methods=x"), 422)
    problem(http.get(REPORT + "nothing"), 404)
    problem(http.get("/objects/other/reports/convergence"), 404)
    problem(http.get(REPORT + "convergence?kernel=anisotropic"), 409)
    problem(http.get("/report-runs/nothing"), 404)
    # More trials are another revision: no answer is kept beyond it.
    post(http, "thing", (p[150:260], q[150:260]))
    ok(http.get(REPORT + "convergence"))


# -- figures


@pytest.mark.parametrize("path", ["convergence", "anisotropy", "calibration"])
def test_figures_by_accept(filled: httpx.Client, path: str) -> None:
    png = filled.get(REPORT + path, headers={"Accept": "image/png"})
    assert png.status_code == 200, png.text
    assert png.headers["content-type"] == "image/png"
    assert png.content.startswith(b"\x89PNG")
    svg = filled.get(REPORT + path, headers={"Accept": "image/svg+xml, image/png;q=0.5"})
    assert svg.headers["content-type"] == "image/svg+xml"
    assert ElementTree.fromstring(svg.content).tag.endswith("svg")
    assert svg.headers["etag"] != png.headers["etag"]
    again = filled.get(REPORT + path, headers={"Accept": "image/png", "If-None-Match": png.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    plain = filled.get(REPORT + path, headers={"Accept": "text/html, */*;q=0.1"})
    assert plain.headers["content-type"] == "application/json"
    assert "Accept" in plain.headers["vary"]
    assert filled.get(REPORT + path, headers={"Accept": "text/html"}).status_code == 406


# -- the life of a run


@pytest.fixture
def impatient(database_url: str, serve: Serve, make_object: Make, post: Post) -> httpx.Client:
    """A service that waits for no report, on either database."""
    http = httpx.Client(base_url=serve(database_url, report_wait_s=0), timeout=60)
    make_object(http)
    poses, won = field(2_000)
    post(http, "thing", poses, outcomes(won))
    return http


def test_a_run_is_joined_polled_kept_and_left_behind(
    impatient: httpx.Client, post: Post, database_url: str, serve: Serve
) -> None:
    http = impatient
    path = REPORT + "convergence"
    answer = http.get(path)
    assert answer.status_code == 202
    location = answer.headers["location"]
    run = answer.json()
    assert location == f"/report-runs/{run['id']}"
    assert (run["object"], run["report"], run["state"]) == ("thing", "convergence", "running")
    # Another replica joins the same run.
    other = httpx.Client(base_url=serve(database_url, report_wait_s=30), timeout=60)
    joined = other.get(path)
    assert joined.status_code == 200, joined.text
    done = finished(http, location, "done")
    assert done["result"] == joined.json()
    assert (done["progress"], done["result"]["revision"]) == (1, done["revision"])
    kept = http.get(path)
    assert ok(kept) == joined.json()
    tag = kept.headers["etag"]
    assert http.get(path, headers={"If-None-Match": tag}).status_code == 304
    # What has ended can't be cancelled.
    assert ok(http.post(f"{location}/cancel"))["state"] == "done"
    post(http, "thing", field(10, seed=5)[0], "missed")
    newer = http.get(path, headers={"If-None-Match": tag})
    assert newer.status_code == 202
    assert newer.headers["location"] != location
    assert finished(http, newer.headers["location"], "done")["revision"] > done["revision"]
    # The answer about the past is gone.
    assert http.get(location).status_code == 404


def test_cancelled_runs_stop_and_can_be_asked_again(impatient: httpx.Client) -> None:
    http = impatient
    path = REPORT + "convergence"
    location = http.get(path).headers["location"]
    assert ok(http.post(f"{location}/cancel"))["state"] == "cancelled"
    assert ok(http.get(location))["state"] == "cancelled"
    again = http.get(path)
    assert again.status_code == 202
    assert again.headers["location"] == location
    assert finished(http, location, "done")["result"]["report"] == "convergence"


def test_a_dead_holders_run_is_taken_over_and_a_living_ones_is_not(
    impatient: httpx.Client, database_url: str
) -> None:
    http = impatient
    # What another replica would have asked for: taken from a run of this one.
    location = http.get(REPORT + "convergence").headers["location"]
    mine = finished(http, location, "done")
    database = Database(database_url)
    with database.write() as tx:
        row = objects.find(tx, "thing")
        assert row is not None
        stored = report_runs.get(tx, mine["id"])
        assert stored is not None
        key = RunKey(row.id, row.revision, "convergence", "0" * 64, stored.parameters)
        other = str(uuid.uuid4())
        assert report_runs.ask(tx, key, id=other, lease_id="theirs")
        assert not report_runs.ask(tx, key, id=str(uuid.uuid4()), lease_id="late")
        assert report_runs.renew(tx, {other: ("late", 0.5)}) == set()
        assert report_runs.renew(tx, {other: ("theirs", 0.5)}) == {other}
    run = ok(http.get(f"/report-runs/{other}"))
    assert (run["state"], run["progress"]) == ("running", 0.5)
    with database.write() as tx:
        report_runs.release(tx, other, "theirs")
    taken = finished(http, f"/report-runs/{other}", "done")
    assert taken["result"] == mine["result"]
    with database.write() as tx:
        # Whoever lost it comes too late.
        assert not report_runs.finish(tx, other, "theirs", result="{}")
        assert report_runs.get(tx, other).result != "{}"  # type: ignore[union-attr]
    database.dispose()
    # Deleting the object deletes its runs.
    assert http.delete("/objects/thing").status_code == 204
    assert http.get(location).status_code == 404


def test_asked_many_times_at_once_it_is_computed_once(
    sqlite_url: str, serve: Serve, make_object: Make, post: Post
) -> None:
    http = httpx.Client(base_url=serve(sqlite_url, report_wait_s=0), timeout=60)
    make_object(http)
    poses, won = field(2_000)
    post(http, "thing", poses, outcomes(won))
    places = {http.get(REPORT + "convergence").headers.get("location") for _ in range(5)}
    assert len(places - {None}) == 1
