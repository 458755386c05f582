"""What best grasps are ranked by: density, success probability, means under noise; exhaustive search."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb.wire import BestGraspRequest
from graspdb_density import (
    GraspDensity,
    IsotropicKernel,
    PoseNoise,
    Region,
    SuccessModel,
    expected,
    se3,
    validate_reach,
)
from graspdb_density.se3 import Poses
from graspdb_density.search.mode_search import MeanShiftSearch, ModeSearch
from graspdb_density.search.scored_poses import Score
from graspdb_geometry.collision import Scene
from graspdb_geometry.poses import ToolPoses
from graspdb_service.api.context import Context
from graspdb_service.app import create_app
from graspdb_service.problems import ProblemError
from graspdb_service.settings import Settings
from graspdb_service.usecases.densities import success_models
from graspdb_service.usecases.grasps import question
from graspdb_service.usecases.grasps.admissible import NearSuccesses
from graspdb_service.usecases.grasps.answer import best_grasps
from known_jaws import PG70

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Pair = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]

WIDTHS = {"sigma_position_m": 0.015, "sigma_rotation_deg": 15}
KERNEL = IsotropicKernel(0.015, math.radians(15))
UP = (0.0, 0.0, 0.0, 1.0)


def ask(http: httpx.Client, **query: Any) -> dict[str, Any]:
    answer = http.get("/objects/thing/best-grasp", params={**WIDTHS, **query})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


@pytest.fixture
def lucky(clusters: Callable[..., Pair]) -> tuple[Pair, list[str]]:
    """Left 80 % of 300 succeed, right all of 3, in the middle the most successes, but one in two."""
    parts = [
        clusters([((-0.1, 0, 0), UP)], 300, seed=1),
        clusters([((0.1, 0, 0), UP)], 3, seed=2),
        clusters([((0, 0, 0), UP)], 800, seed=3),
    ]
    rng = np.random.default_rng(0)
    shares = np.concatenate([np.full(300, 0.8), np.full(3, 1.0), np.full(800, 0.5)])
    won = rng.random(len(shares)) < shares
    poses = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
    return poses, ["success" if w else "slipped" for w in won]


def test_success_probability_ranks_by_the_lower_end(
    http: httpx.Client, make_object: Make, post: Post, lucky: tuple[Pair, list[str]]
) -> None:
    make_object(http)
    poses, outcomes = lucky
    post(http, "thing", poses, outcomes)
    (by_density,) = ask(http)["grasps"]
    assert abs(by_density["position"][0]) < 0.03
    answer = ask(
        http, objective="success_probability", count=8, min_separation_m=0.04, min_separation_deg=180
    )
    best, *others = answer["grasps"]
    assert answer["ranking"]["objective"] == "success_probability"
    assert "lower end" in answer["ranking"]["score"]
    assert best["position"][0] < -0.06
    for grasp in answer["grasps"]:
        # Out of reach of every attempt it has no interval, and ranks below all that have.
        if grasp["support"]["enough"]:
            assert grasp["score"] == pytest.approx(grasp["interval"]["low"], abs=1e-6)
    assert all(other["score"] <= best["score"] + 1e-9 for other in others)
    assert {round(grasp["position"][0], 1) for grasp in answer["grasps"]} >= {-0.1, 0.0, 0.1}
    # No pose that any of many tries finds near a success is better.
    won = np.array(outcomes) == "success"
    model = SuccessModel.build(Poses.of(*poses), won, kernel=KERNEL)
    rng = np.random.default_rng(1)
    rows = rng.choice(np.flatnonzero(won), 20_000)
    p = poses[0][rows] + rng.normal(size=(20_000, 3)) * 0.006
    q = se3.multiply(poses[1][rows], se3.from_rotation_vector(rng.normal(size=(20_000, 3)) * 0.1))
    near = validate_reach(model).covers
    assert best["score"] >= model.lower_end(Poses.of(p, q), near=near).max() * 0.999
    # Candidates are ranked by the same.
    body = {
        "candidates": {"position": [[0, 0, 0], [-0.1, 0, 0]], "quaternion_xyzw": [list(UP)] * 2},
        "objective": "success_probability",
        "count": 2,
        **WIDTHS,
    }
    ranked = http.post("/objects/thing/best-grasp", json=body).json()["grasps"]
    assert [grasp["candidate"] for grasp in ranked] == [1, 0]


def test_a_sample_of_many_attempts_finds_nearly_the_same(
    sqlite_http: httpx.Client,
    make_object: Make,
    post: Post,
    lucky: tuple[Pair, list[str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    http = sqlite_http
    monkeypatch.setattr(success_models, "_LARGE", 900)
    monkeypatch.setattr(success_models, "_SAMPLE", 500)
    make_object(http)
    (p, q), outcomes = lucky
    model = SuccessModel.build(Poses.of(p, q), np.array(outcomes) == "success", kernel=KERNEL)
    order = np.random.default_rng(2).permutation(len(p))
    # Before it is large, as it grows large, and as a large one is extended.
    for part in np.split(order, [600, 1_000]):
        post(http, "thing", (p[part], q[part]), [outcomes[i] for i in part])
        assert ask(http, objective="success_probability")["status"] == "ok"
    (best,) = ask(http, objective="success_probability")["grasps"]
    (estimate,) = model.evaluate(Poses.of([best["position"]], [best["quaternion_xyzw"]])).low
    assert best["score"] == pytest.approx(estimate, abs=2e-3)
    near = np.linalg.norm(p - [-0.1, 0, 0], axis=1) < 0.01
    top = model.lower_end(Poses.of(p[near], q[near]), near=validate_reach(model).covers).max()
    assert best["score"] > 0.97 * top


def test_robust_prefers_what_survives_noise(
    sqlite_http: httpx.Client, make_object: Make, post: Post, clusters: Callable[..., Pair]
) -> None:
    """A sharp cluster with the higher density and a broad one; failures all around the sharp one."""
    http = sqlite_http
    make_object(http)
    sharp = clusters([((0.1, 0, 0), UP)], 150, seed=1, sigma_m=0.002, sigma_rad=0.05)
    broad = clusters([((-0.1, 0, 0), UP)], 400, seed=2, sigma_m=0.02, sigma_rad=0.2)
    around = clusters([((0.1, 0, 0), UP)], 900, seed=3, sigma_m=0.03, sigma_rad=0.3)
    far = np.linalg.norm(around[0] - [0.1, 0, 0], axis=1) > 0.015
    p = np.concatenate([sharp[0], broad[0], around[0][far]])
    q = np.concatenate([sharp[1], broad[1], around[1][far]])
    won = np.arange(len(p)) < 550
    post(http, "thing", (p, q), ["success" if w else "missed" for w in won])
    narrow = {"sigma_position_m": 0.006, "sigma_rotation_deg": 10}
    assert ask(http, **narrow)["grasps"][0]["position"][0] > 0.05
    kernel = IsotropicKernel(0.006, math.radians(10))
    density = GraspDensity.build(se3.Poses.of(p[won], q[won]), kernel=kernel)
    model = SuccessModel.build(Poses.of(p, q), won, kernel=kernel)
    middle = (p[won].min(axis=0) + p[won].max(axis=0)) / 2
    at_object = PoseNoise(0.02, math.radians(2), tuple(middle))  # type: ignore[arg-type]
    for query, noise, value in (
        ({"pose_noise_m": 0.02, "pose_noise_deg": 2}, {"object_noise": at_object}, "success_probability"),
        ({"tool_noise_m": 0.02}, {"tool_noise": PoseNoise(0.02, 0.0)}, "success_probability"),
        ({"pose_noise_m": 0.02, "pose_noise_deg": 2}, {"object_noise": at_object}, "density"),
    ):
        answer = ask(http, objective="robust", robust_of=value, **query, **narrow)
        (grasp,) = answer["grasps"]
        assert value == "density" or grasp["position"][0] < -0.05
        ranking = answer["ranking"]
        assert (ranking["objective"], ranking["robust_of"]) == ("robust", value)
        told = ranking["pose_noise"] if "pose_noise_m" in query else ranking["tool_noise"]
        assert told.startswith("20 mm")
        assert ("left" in told) == ("pose_noise_m" in query)

        def chance(poses: Poses) -> Floats:
            return model.evaluate(poses).probability

        scored = density.density if value == "density" else chance
        exactly = expected(scored, samples=4_096, **noise)  # type: ignore[arg-type]
        (exact,) = exactly(Poses(np.array([grasp["position"]]), np.array([grasp["quaternion_xyzw"]])))
        assert grasp["score"] == pytest.approx(exact, rel=0.08)
        rng = np.random.default_rng(1)
        rows = rng.integers(0, 550, 200)
        nearly = expected(scored, samples=1_024, **noise)  # type: ignore[arg-type]
        assert grasp["score"] > 0.93 * nearly(Poses(p[rows], q[rows])).max()
    # What is averaged by default is the chance, where there is one to average.
    default = ask(http, objective="robust", tool_noise_m=0.02, **narrow)
    assert default["ranking"]["robust_of"] == "success_probability"


def test_collisions_under_noise_count(
    sqlite_http: httpx.Client, make_object: Make, put_box: Callable[..., Scene], post: Post
) -> None:
    """Grasps of a bar of 60 mm in a jaw of 70 mm: beside the middle a finger is near and noise hits."""
    http = sqlite_http
    make_object(http)
    scene = put_box(http, "thing", (0.02, 0.06, 0.1))
    rng = np.random.default_rng(0)
    p = np.array([0, 0, 0.045]) + rng.uniform(-1, 1, (600, 3)) * [0.004, 0.0049, 0.004]
    q = se3.multiply(np.array([1.0, 0, 0, 0]), se3.from_rotation_vector(rng.normal(size=(600, 3)) * 0.01))
    free = ~scene.collides(ToolPoses(p, q), PG70)
    p, q = p[free], q[free]
    won = rng.random(len(p)) < np.where(p[:, 1] > 0.002, 0.95, 0.8)
    post(http, "thing", (p, q), ["success" if w else "slipped" for w in won], gripper="pg70")
    query = {"sigma_position_m": 0.003, "sigma_rotation_deg": 5}
    (likely,) = ask(http, objective="success_probability", **query)["grasps"]
    (robust,) = ask(http, objective="robust", pose_noise_m=0.002, **query)["grasps"]
    assert likely["position"][1] > 0.001
    assert abs(robust["position"][1]) < 0.0015
    assert robust["collision_free"] is True
    # A bar turning by 3 degrees about its own centre moves a grasp at its end by 2.4 mm.
    turning = ask(http, objective="robust", pose_noise_deg=3, **query)
    assert "bounding box's centre" in turning["ranking"]["pose_noise"]
    (turned,) = turning["grasps"]
    assert turned["score"] < likely["success_probability"]


def test_scores_of_chance_come_where_they_cost_little_or_are_asked_for(
    sqlite_http: httpx.Client,
    make_object: Make,
    post: Post,
    two_clusters: Pair,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    http = sqlite_http
    make_object(http)
    post(http, "thing", two_clusters)
    refused = http.get("/objects/thing/best-grasp", params={"objective": "success_probability"})
    assert refused.status_code == 409
    assert refused.json()["type"].endswith("no-attempts")
    default = ask(http, objective="robust", pose_noise_m=0.01)
    assert default["ranking"]["robust_of"] == "density"

    post(http, "thing", two_clusters, "slipped")
    names = ("success_probability", "interval", "effective_trials")
    (grasp,) = ask(http)["grasps"]
    assert all(grasp[name] is not None for name in names)
    (grasp,) = ask(http, include="density,relative")["grasps"]
    assert all(grasp[name] is None for name in names)
    monkeypatch.setattr(question, "FEW_ATTEMPTS", 999)
    (grasp,) = ask(http)["grasps"]
    assert all(grasp[name] is None for name in names)
    for query in ({"include": "success_probability"}, {"objective": "success_probability"}):
        (grasp,) = ask(http, **query)["grasps"]
        assert all(grasp[name] is not None for name in names)


# -- against exhaustive search -------------------------------------------------------------------------------


@contextmanager
def use_case(url: str) -> Iterator[Context]:
    ctx = create_app(Settings(database_url=url)).state.context
    try:
        yield ctx
    finally:
        ctx.close()


def random_request(rng: np.random.Generator, scene: bool) -> tuple[dict[str, Any], Region]:
    """Constraints in the world of an object that stands askew, and the same region in the object frame."""
    shift, turn = rng.normal(size=3), se3.random_quaternions(1, rng)[0]
    in_world = bool(rng.random() < 0.6)
    rotation = se3.to_matrix(turn) if in_world else np.eye(3)
    origin = shift if in_world else np.zeros(3)
    query: dict[str, Any] = {}
    if in_world or rng.random() < 0.5:
        query = {"object_pose": [*shift, *turn], "frame": "world" if in_world else "object"}
    planes: list[list[float]] = []

    def place() -> Floats:
        return rng.uniform([-0.2, -0.1, -0.1], [0.2, 0.1, 0.1])

    def plane() -> list[float]:
        normal = rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        planes.append([*normal, -0.06])
        there = rotation @ normal
        return [*there, float(-0.06 + there @ origin)]

    if rng.random() < 0.6:
        centre, half = rotation @ place() + origin, rng.uniform(0.02, 0.12, 3)
        query |= {"box_min": (centre - half).tolist(), "box_max": (centre + half).tolist()}
        for axis, sign in ((a, s) for a in range(3) for s in (1, -1)):
            normal = sign * rotation[axis]  # n . (R x + t) >= d
            limit = sign * centre[axis] - half[axis] - sign * origin[axis]
            planes.append([*normal, limit])
    elif rng.random() < 0.6:
        centre, radius = place(), rng.uniform(0.02, 0.1)
        query["sphere"] = [*(rotation @ centre + origin), radius]
    if rng.random() < 0.3:
        query["above_plane"] = plane()
    if rng.random() < 0.3:
        query["half_spaces"] = [plane() for _ in range(rng.integers(1, 4))]
    cones: dict[str, Any] = {}
    if rng.random() < 0.5:
        axis, angle = rng.standard_normal(3), rng.uniform(10, 60)
        query |= {"approach": (rotation @ axis).tolist(), "approach_cone_deg": angle}
        cones |= {"approach": axis, "approach_angle": math.radians(angle)}
    if rng.random() < 0.4:
        axis, angle = rng.standard_normal(3), rng.uniform(10, 60)
        axis = np.cross(axis, cones["approach"]) if cones else axis
        query |= {"closing": (rotation @ axis).tolist(), "closing_cone_deg": angle}
        cones |= {"closing": axis, "closing_angle": math.radians(angle)}
    ball = None
    if "sphere" in query:
        ball = [[*(rotation.T @ (np.array(query["sphere"][:3]) - origin)), query["sphere"][3]]]
    query["collision_free"] = scene
    return query, Region(half_spaces=planes or None, spheres=ball, **cones)


def exhaustive(
    density: GraspDensity, region: Region, scene: Scene | None, starts: int, rng: np.random.Generator
) -> float:
    """Best log density by mean shift from every feasible centre and from uniform feasible starts."""
    low, high = density.positions.min(axis=0) - 0.05, density.positions.max(axis=0) + 0.05
    p = np.concatenate([density.positions, rng.uniform(low, high, (starts, 3))])
    q = np.concatenate([density.quaternions_xyzw, se3.random_quaternions(starts, rng)])
    p, q, inside = region.project(p, q)
    p, q = p[inside], q[inside]
    value = density.log_density(se3.Poses.of(p, q), threads=2)
    # A start a thousandth as good as the best is left out: hours would go into the tails.
    kept = value > value.max() - math.log(1e3) if len(value) else np.zeros(0, dtype=bool)
    ranking = ModeSearch(density).ranking(2)
    search = MeanShiftSearch(density, ranking, density.log_density, region, None, 2)
    passed = search.climb(se3.Poses(p[kept], q[kept]), 60)[0].poses
    p, q = np.concatenate([p, passed.positions]), np.concatenate([q, passed.quaternions_xyzw])
    inside = region.contains(p, q)
    p, q = p[inside], q[inside]
    if scene is not None and len(p):
        free = ~scene.collides(ToolPoses(p, q), PG70, threads=2)
        p, q = p[free], q[free]
    return float(density.log_density(se3.Poses.of(p, q), threads=2).max()) if len(p) else -math.inf


def compare(
    url: str, http: httpx.Client, put_box: Callable[..., Scene], post: Post, kernels: int, seeds: range
) -> None:
    http.post("/objects", json={"id": "thing"}).raise_for_status()
    scene = put_box(http, "thing", (0.3, 0.03, 0.03))
    rng = np.random.default_rng(0)
    centres = rng.uniform([-0.2, -0.1, -0.1], [0.2, 0.1, 0.1], (kernels // 40, 3))
    turns = se3.random_quaternions(len(centres), rng)
    rows = rng.integers(0, len(centres), kernels)
    p = centres[rows] + rng.normal(size=(kernels, 3)) * 0.012
    q = se3.multiply(turns[rows], se3.from_rotation_vector(rng.normal(size=(kernels, 3)) * 0.2))
    for part in np.array_split(np.arange(kernels), max(1, kernels // 10_000)):
        post(http, "thing", (p[part], q[part]), gripper="pg70")
    density = GraspDensity.build(se3.Poses.of(p, q), kernel=KERNEL)
    with use_case(url) as ctx:
        for seed in seeds:
            rng = np.random.default_rng(seed)
            query, region = random_request(rng, scene=seed % 3 == 2)
            tested = scene if query["collision_free"] else None
            try:
                answer, *_ = best_grasps(ctx, "thing", BestGraspRequest(**query, **WIDTHS))
            except ProblemError:
                assert not region.project(np.zeros((1, 3)), se3.IDENTITY[None])[2].any(), seed
                continue
            best = exhaustive(density, region, tested, 5 * kernels, rng)
            if answer.status == "infeasible":
                assert best < KERNEL.log_peak - 8.0, seed
                continue
            (grasp,) = answer.grasps
            pose = np.array([grasp.position]), np.array([grasp.quaternion_xyzw])
            assert region.contains(*pose).all(), seed
            assert tested is None or not tested.collides(ToolPoses(*pose), PG70).any(), seed
            assert math.exp(grasp.log_density - best) >= 0.999, (seed, grasp.log_density - best, query)


def test_against_exhaustive_search(
    sqlite_url: str, sqlite_http: httpx.Client, put_box: Callable[..., Scene], post: Post
) -> None:
    compare(sqlite_url, sqlite_http, put_box, post, 1_000, range(12))


class Field:
    """Attempts in clusters, each with its own share of successes, about a bar; the chance as the contract
    defines it.
    """

    def __init__(self, kernels: int, scene: Scene) -> None:
        rng = np.random.default_rng(0)
        centres = rng.uniform([-0.2, -0.1, -0.1], [0.2, 0.1, 0.1], (kernels // 40, 3))
        turns, shares = se3.random_quaternions(len(centres), rng), rng.uniform(0.3, 0.95, len(centres))
        rows = rng.integers(0, len(centres), round(2.5 * kernels))
        p = centres[rows] + rng.normal(size=(len(rows), 3)) * 0.012
        q = se3.multiply(turns[rows], se3.from_rotation_vector(rng.normal(size=(len(rows), 3)) * 0.2))
        # Where the gripper collides nothing can be tried.
        free = ~scene.collides(ToolPoses(p, q), PG70, threads=2)
        rows, self.positions, self.quaternions = rows[free], p[free], q[free]
        self.won = rng.random(len(rows)) < shares[rows]
        self.scene = scene
        self.model = SuccessModel.build(Poses.of(self.positions, self.quaternions), self.won, kernel=KERNEL)
        self.density = GraspDensity.build(
            se3.Poses.of(self.positions[self.won], self.quaternions[self.won]), kernel=KERNEL
        )
        self.near = NearSuccesses(self.density, 2.0)
        self.reach = validate_reach(self.model)

    def chance(self, column: str) -> Score:
        def score(poses: Poses) -> Floats:
            values = np.zeros(len(poses))
            free = np.flatnonzero(~self.scene.collides(poses, PG70, threads=2))
            if len(free):
                if column == "probability":
                    values[free] = self.model.probability(poses[free], threads=2)
                else:
                    # Out of reach of every attempt, no higher than if nothing had been tried.
                    near = self.reach.covers
                    values[free] = self.model.lower_end(poses[free], level=0.9, near=near, threads=2)
            return values

        return score

    def best(
        self,
        rough: Score,
        score: Score,
        region: Region,
        free: bool,
        climbers: int,
        rng: np.random.Generator,
    ) -> float:
        """Highest score near a success: from every success's nearest feasible pose and samples around them
        the most promising by ``rough``, and from those random steps uphill.
        """
        p, q, inside = region.project(
            *(
                np.concatenate(pair)
                for pair in zip(self.successes, self.density.sample(5_000, rng), strict=True)
            )
        )
        p, q = p[inside], q[inside]

        def allowed(p: Floats, q: Floats) -> Bools:
            ok = self.near(Poses(p, q))
            return ok & ~self.scene.collides(ToolPoses(p, q), PG70, threads=2) if free else ok

        ok = allowed(p, q) if len(p) else np.zeros(0, dtype=bool)
        p, q = p[ok], q[ok]
        if not len(p):
            return -math.inf
        top = np.argsort(-rough(Poses(p, q)))[:climbers]
        p, q, values = p[top], q[top], score(Poses(p[top], q[top]))
        for step in np.repeat([0.5, 0.25, 0.12, 0.06, 0.03], 12):
            moved = p + rng.standard_normal(p.shape) * step * KERNEL.sigma_position_m
            turned = se3.from_rotation_vector(rng.standard_normal(p.shape) * step * KERNEL.sigma_rotation)
            new_p, new_q, inside = region.project(moved, se3.multiply(q, turned))
            new = score(Poses(new_p, new_q))
            better = np.flatnonzero(inside & (new > values))
            better = better[allowed(new_p[better], new_q[better])]
            p[better], q[better], values[better] = new_p[better], new_q[better], new[better]
        return float(values.max())

    @property
    def successes(self) -> Pair:
        return self.density.positions, self.density.quaternions_xyzw


def compare_scores(
    url: str,
    http: httpx.Client,
    put_box: Callable[..., Scene],
    post: Post,
    kernels: int,
    seeds: range,
) -> None:
    """By the chance's lower end and, each second time, by its mean under noise."""
    http.post("/objects", json={"id": "thing"}).raise_for_status()
    field = Field(kernels, put_box(http, "thing", (0.3, 0.03, 0.03)))
    told = ["success" if won else "slipped" for won in field.won]
    for part in np.array_split(np.arange(len(told)), max(1, len(told) // 10_000)):
        poses = field.positions[part], field.quaternions[part]
        post(http, "thing", poses, [told[i] for i in part], gripper="pg70")
    with use_case(url) as ctx:
        for seed in seeds:
            rng = np.random.default_rng(seed)
            query, region = random_request(rng, scene=seed % 3 != 2)
            if seed % 2:
                query |= {"objective": "robust", "pose_noise_m": 0.004, "pose_noise_deg": 2.0}
                noise = PoseNoise(0.004, math.radians(2.0))
                rough, score = (
                    expected(field.chance("probability"), object_noise=noise, samples=draws)
                    for draws in (16, 256)
                )
            else:
                query["objective"] = "success_probability"
                rough = score = field.chance("low")
            try:
                answer, *_ = best_grasps(ctx, "thing", BestGraspRequest(**query, **WIDTHS))
            except ProblemError:
                assert not region.project(np.zeros((1, 3)), se3.IDENTITY[None])[2].any(), seed
                continue
            climbers = 12 if seed % 2 else 200
            best = field.best(rough, score, region, query["collision_free"], climbers, rng)
            if answer.status == "infeasible":
                assert best == -math.inf, seed
                continue
            (grasp,) = answer.grasps
            pose = Poses(np.array([grasp.position]), np.array([grasp.quaternion_xyzw]))
            assert region.contains(*pose).all(), seed
            assert field.near(pose).all(), seed
            assert not query["collision_free"] or not field.scene.collides(pose, PG70).any(), seed
            assert grasp.score == pytest.approx(float(score(pose)[0]), rel=1e-3, abs=1e-6), seed
            assert grasp.score >= 0.995 * best, (seed, grasp.score / best, query)


def test_chances_and_means_against_exhaustive_search(
    sqlite_url: str, sqlite_http: httpx.Client, put_box: Callable[..., Scene], post: Post
) -> None:
    compare_scores(sqlite_url, sqlite_http, put_box, post, 600, range(6))


@pytest.mark.long
@pytest.mark.timeout(3_600)
def test_chances_and_means_against_exhaustive_search_at_20_000_kernels(
    sqlite_url: str, sqlite_http: httpx.Client, put_box: Callable[..., Scene], post: Post
) -> None:
    compare_scores(sqlite_url, sqlite_http, put_box, post, 20_000, range(100, 150))


@pytest.mark.long
@pytest.mark.timeout(3_600)
def test_against_exhaustive_search_at_20_000_kernels(
    sqlite_url: str, sqlite_http: httpx.Client, put_box: Callable[..., Scene], post: Post
) -> None:
    compare(sqlite_url, sqlite_http, put_box, post, 20_000, range(100, 150))
