"""Weights that undo how poses were chosen: grids that overlap, that run, and beside other strategies."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES
from graspdb.wire.queries import TrialSelection
from graspdb_density import GraspDensity, IsotropicKernel, importance_weights, se3
from graspdb_density.se3 import Poses
from graspdb_geometry.grids import PoseGrid
from graspdb_service.api.context import Context
from graspdb_service.app import create_app
from graspdb_service.settings import Settings
from graspdb_service.usecases.densities.build import Built, KernelChoice

Floats = NDArray[np.float64]
Field = Callable[[Floats], NDArray[np.bool_]]

KERNEL = IsotropicKernel(0.015, np.deg2rad(40.0))
PLAIN = (TrialSelection(), KernelChoice(0.015, 40.0))
SUCCESS, FAILURE, COLLISION = (OUTCOME_CODES[name] for name in ("success", "failure", "collision"))
COARSE = {"position_step_m": 0.01, "rotation_step_deg": 60.0, "margin_m": 0.02}
RIGHT = {"lower": (0.0, -1.0, -1.0), "upper": (1.0, 1.0, 1.0)}


def density_of(ctx: Context, filters: TrialSelection, kernel: KernelChoice) -> Built:
    return ctx.densities.get(ctx.densities.selections.resolve("thing", filters), kernel)


def ball(position: Floats) -> NDArray[np.bool_]:
    """Where grasps succeed: within 30 mm of the origin, whatever their rotation."""
    near: NDArray[np.bool_] = np.linalg.norm(position, axis=1) < 0.03
    return near


@pytest.fixture
def box(http: httpx.Client, put_box: Callable[..., Any]) -> httpx.Client:
    assert http.post("/objects", json={"id": "thing", "mass_kg": 0.3}).status_code == 201
    put_box(http, "thing", (0.04, 0.04, 0.04))
    return http


@pytest.fixture
def ctx(database_url: str, http: httpx.Client) -> Iterator[Context]:
    """The parts of a second service process over the database of ``http``."""
    context = create_app(Settings(database_url=database_url)).state.context
    yield context
    context.close()


def sweep(http: httpx.Client, grid: dict[str, Any], **spec: Any) -> dict[str, Any]:
    answer = http.post("/objects/thing/sweeps", json={"grid": grid, **spec})
    assert answer.status_code == 202, answer.text
    made: dict[str, Any] = answer.json()
    return made


def work(http: httpx.Client, field: Field = ball, jobs: int | None = None) -> int:
    """Be a worker: poses in the field succeed, half of the others collide."""
    done = 0
    while jobs is None or done < jobs:
        claimed = http.post("/jobs/claim", json={"worker": "w", "limit": 1}).json()["jobs"]
        if not claimed:
            break
        for job in claimed:
            payload = job["payload"]
            index = PoseGrid(**payload["grid"]).pose_indices(payload["start"], payload["stop"])
            position, _ = PoseGrid(**payload["grid"]).poses(index)
            codes = np.where(field(position), SUCCESS, np.where(index % 2, COLLISION, FAILURE)).astype(
                np.uint8
            )
            rows = index[codes != COLLISION].tolist()
            answer = http.put(
                f"/jobs/{job['id']}/result",
                params={"lease_id": job["lease_id"]},
                json={
                    "outcomes": base64.b64encode(codes.tobytes()).decode(),
                    "rows": {
                        "pose_index": rows,
                        "width_m": [None] * len(rows),
                        "quality": [None] * len(rows),
                    },
                },
            )
            assert answer.status_code == 200, answer.text
            done += 1
    return done


def log_density(http: httpx.Client, positions: Floats, quaternions: Floats) -> Floats:
    answer = http.post(
        "/objects/thing/likelihood",
        json={
            "poses": {"position": positions.tolist(), "quaternion_xyzw": quaternions.tolist()},
            "kernel": {"sigma_position_m": 0.015, "sigma_rotation_deg": 40},
            "include": ["log_density"],
        },
    )
    assert answer.status_code == 200, answer.text
    return np.array(answer.json()["log_density"])


def weights_told(http: httpx.Client) -> dict[str, Any]:
    told: dict[str, Any] = http.get("/objects/thing/density").json()["weights"]
    return told


def test_overlapping_grids_tell_of_the_field_what_one_does(box: httpx.Client, ctx: Context) -> None:
    """A grid of all, and more rotations of the right side alone; the field is the same on either side."""
    rng = np.random.default_rng(0)
    right = rng.uniform([0.005, -0.02, -0.02], [0.03, 0.02, 0.02], (400, 3))
    poses = (
        np.concatenate([right * [-1.0, 1.0, 1.0], right]),
        np.tile(se3.random_quaternions(400, rng), (2, 1)),
    )
    sweep(box, COARSE)
    work(box)
    one = log_density(box, *poses)
    assert weights_told(box)["kind"] == "equal"
    beyond = {"lower": (0.005, -1.0, -1.0), "upper": (1.0, 1.0, 1.0)}
    sweep(box, {**COARSE, "rotation_step_deg": 30.0, "region": beyond, "max_poses": 30_000})
    work(box)
    both = log_density(box, *poses)
    assert abs(np.mean(both - one)) < 0.03
    assert np.std(both - one) < 0.1
    assert abs(np.mean(both[400:] - both[:400])) < 0.03
    told = weights_told(box)
    assert told["kind"] == "mixture"
    tried = box.get("/objects/thing").json()["outcomes"]
    assert told["poses_tried"] == sum(tried.values())

    # What every trial tells of itself alone counts the right side several times.
    built = density_of(ctx, *PLAIN)
    assert built.density is not None
    rows = built.density.positions, built.density.quaternions_xyzw
    weights = importance_weights(built.weighing.proposal)
    naive = GraspDensity.build(Poses.of(*rows), kernel=KERNEL, weights=weights).log_density(Poses.of(*poses))
    assert np.mean(naive[400:] - naive[:400]) > 0.3


def exposure(positions: Floats, grids: list[tuple[PoseGrid, float]]) -> Floats:
    """sum n_k g_k, grids of different lattices done by so much: the definition, position by position."""
    total = np.zeros(len(positions))
    for grid, share in grids:
        ends = grid.poses(grid.pose_indices(0, grid.total)[[0, -1]])[0]
        half = grid.position_step_m / 2
        inside = ((positions > ends[0] - half) & (positions < ends[1] + half)).all(axis=1)
        total += share * grid.total * inside / (8 * np.pi**2 * grid.volume_m3)
    return total


def test_weights_are_the_balance_heuristic_while_a_sweep_runs(
    box: httpx.Client, ctx: Context, database_url: str
) -> None:
    """A running sweep's exposure grows: what is extended and weighted anew equals what is built at once."""
    lower, upper = (-0.02,) * 3, (0.02,) * 3
    first = sweep(box, COARSE)
    work(box)
    fine = {**COARSE, "position_step_m": 0.007, "region": RIGHT, "max_poses": 3_000, "seed": 4}
    second = sweep(box, fine, chunk_poses=500)
    grids = [
        PoseGrid(lower, upper, 0.01, 60.0, 0.02),
        PoseGrid(lower, upper, 0.007, 60.0, 0.02, region=(RIGHT["lower"], RIGHT["upper"])),
    ]
    assert first["poses"] == grids[0].total
    probe = np.random.default_rng(1).uniform(-0.04, 0.04, (100, 3))
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (100, 1))
    extended: list[Built] = []
    for chunk in range(second["chunks"] + 1):
        built = density_of(ctx, *PLAIN)
        assert built.density is not None
        share = 500 * chunk / grids[1].total
        expected = 1.0 / exposure(built.density.positions, [(grids[0], 1.0), (grids[1], share)])
        np.testing.assert_allclose(built.density.weights, expected / expected.sum(), rtol=1e-6)
        other = create_app(Settings(database_url=database_url)).state.context
        fresh = density_of(other, *PLAIN)
        other.close()
        np.testing.assert_allclose(
            built.density.log_density(Poses.of(probe, turns)),
            fresh.density.log_density(Poses.of(probe, turns)),
            atol=1e-5,
        )
        extended.append(built)
        work(box, jobs=1)
    assert extended[-1].density is not None
    assert extended[-1].density.size > extended[0].density.size  # type: ignore[union-attr]


def test_failures_alone_move_the_weights_of_two_grids(box: httpx.Client, ctx: Context) -> None:
    sweep(box, COARSE)
    work(box)
    sweep(box, {**COARSE, "position_step_m": 0.007, "region": RIGHT})
    work(box, jobs=1)
    before = density_of(ctx, *PLAIN)
    work(box, field=lambda position: np.zeros(len(position), dtype=bool))
    after = density_of(ctx, *PLAIN)
    assert before.density is not None
    assert after.density is not None
    assert after.density.size == before.density.size
    ratio = after.density.weights / before.density.weights
    right = after.density.positions[:, 0] > 0.004
    assert ratio[right].max() < 0.9 * ratio[after.density.positions[:, 0] < -0.004].min()


@pytest.mark.parametrize(
    "other",
    [
        {"region": {"lower": (-1, -1, -1), "upper": (0.02, 1, 1)}},
        {"max_poses": 900, "seed": 3},
        {"max_poses": 900, "seed": 3, "region": RIGHT},
    ],
)
def test_sweeps_of_one_lattice_count_each_pose_once(
    box: httpx.Client, ctx: Context, other: dict[str, Any]
) -> None:
    """After the whole grid its poses have been tried; a part swept before must not count double."""
    sweep(box, {**COARSE, **other})
    work(box)
    sweep(box, COARSE)
    work(box)
    built = density_of(ctx, *PLAIN)
    assert built.density is not None
    np.testing.assert_allclose(built.density.weights * built.density.size, 1.0, rtol=1e-9)
    told = weights_told(box)
    assert told["poses_tried"] == PoseGrid((-0.02,) * 3, (0.02,) * 3, 0.01, 60.0, 0.02).total


def test_halves_of_one_lattice_weigh_by_how_much_was_tried(box: httpx.Client, ctx: Context) -> None:
    """A tenth of the poses at random, then the right half wholly."""
    grid = PoseGrid((-0.02,) * 3, (0.02,) * 3, 0.01, 60.0, 0.02)
    share = (grid.total // 10) / grid.total
    sweep(box, {**COARSE, "max_poses": grid.total // 10})
    work(box)
    sweep(box, {**COARSE, "region": RIGHT})
    work(box)
    built = density_of(ctx, *PLAIN)
    assert built.density is not None
    right = built.density.positions[:, 0] > -0.004
    expected = np.where(right, 1.0, 1.0 / share)
    np.testing.assert_allclose(built.density.weights, expected / expected.sum(), rtol=1e-9)


def balance(built: Built, grid: PoseGrid, told: Floats, rows: slice, untold: Poses | None) -> Floats:
    """1 / sum n_s g_s(x) at the successes of a density, by the definition: a grid, trials that tell their
    density (these rows of the successes), and attempts of others that do not.
    """
    assert built.density is not None
    kernel, poses = built.density.kernel, built.density.poses
    total = exposure(poses.positions, [(grid, 1.0)])

    def near(attempts: Poses, at: Poses) -> Floats:
        both = [
            np.exp([kernel.log_kernel(Poses(*pose), many) for pose in zip(*at, strict=True)]).sum(axis=1)
            for many in (attempts, attempts.turned())
        ]
        return np.asarray(0.5 * (both[0] + both[1]))

    if len(told):
        other = np.ones(len(poses), dtype=bool)
        other[rows] = False
        total[other] += near(poses[rows], poses[other])
        total[rows] += len(told) * told
    if untold is not None:
        total += near(untold, poses)
    return np.asarray((1.0 / total) / (1.0 / total).sum())


def test_sources_are_weighed_by_how_densely_each_tried(
    box: httpx.Client, ctx: Context, post: Callable[..., Any], database_url: str
) -> None:
    """The balance heuristic over a grid, trials that tell their density, and a robot's that do not; what is
    extended equals what is built at once.
    """
    sweep(box, COARSE)
    work(box)
    grid = PoseGrid((-0.02,) * 3, (0.02,) * 3, 0.01, 60.0, 0.02)
    density_of(ctx, *PLAIN)
    rng = np.random.default_rng(2)
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (40, 1))
    robot = rng.normal(size=(40, 3)) * 0.01, turn
    outcome = ["success" if number % 2 else "failure" for number in range(40)]
    post(box, "thing", robot, outcome, gripper="pg70", protocol="wrench", source="robot")
    told = weights_told(box)
    assert (told["kind"], told["without_proposal_density"]) == ("balance", 20)
    built = density_of(ctx, *PLAIN)
    assert built.density is not None
    nothing: Floats = np.empty(0)
    expected = balance(built, grid, nothing, slice(0, 0), Poses.of(*robot))
    np.testing.assert_allclose(built.density.weights, expected, rtol=1e-3)
    g = rng.uniform(500.0, 5_000.0, 40)
    away = robot[0] + [0.03, 0.0, 0.0], turn
    post(box, "thing", away, gripper="pg70", protocol="wrench", source="human", proposal_density=g)
    built = density_of(ctx, *PLAIN)
    assert built.density is not None
    size = built.density.size
    expected = balance(built, grid, g, slice(size - 40, size), Poses.of(*robot))
    np.testing.assert_allclose(built.density.weights, expected, rtol=1e-3)
    other = create_app(Settings(database_url=database_url)).state.context
    fresh = density_of(other, *PLAIN)
    other.close()
    assert fresh.density is not None
    np.testing.assert_allclose(built.density.weights, fresh.density.weights, rtol=1e-5)
    probe = built.density.poses[::50]
    np.testing.assert_allclose(built.density.log_density(probe), fresh.density.log_density(probe), atol=1e-5)
    sources = box.get("/objects/thing/density").json()["selection"]["sources"]
    assert list(sources) == ["human", "robot", "simulation"]
    assert sum(item["share_of_weight"] for item in sources.values()) == pytest.approx(1.0)
    assert (sources["robot"]["trials"], sources["robot"]["successes"]) == (40, 20)
    assert sources["simulation"]["trials"] == grid.total


def test_one_grasp_tried_often_counts_as_the_volume_it_covers(
    sqlite_http: httpx.Client, make_object: Callable[..., str], post: Callable[..., Any]
) -> None:
    """However often a robot repeats one grasp, its share of the weight stays as it is."""
    make_object(sqlite_http)
    rng = np.random.default_rng(3)
    spread = rng.uniform(-0.05, 0.05, (400, 3)), se3.random_quaternions(400, rng)
    post(sqlite_http, "thing", spread, source="simulation")
    one = np.tile([0.2, 0.0, 0.0], (10, 1)), np.tile([0.0, 0.0, 0.0, 1.0], (10, 1))
    shares = []
    for _ in range(4):
        post(sqlite_http, "thing", one, source="robot")
        info = sqlite_http.get("/objects/thing/density?sigma_position_m=0.01&sigma_rotation_deg=15").json()
        shares.append(info["selection"]["sources"]["robot"]["share_of_weight"])
    # The volume of one kernel, and that of 400 attempts that hardly overlap.
    np.testing.assert_allclose(shares, shares[0], rtol=1e-4)
    assert shares[0] == pytest.approx(1 / 401, rel=0.1)


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize("sources", [["robot"], ["robot", "simulation"], ["robot", None, "human"]])
def test_words_on_weights_are_true_of_the_trials(
    sqlite_http: httpx.Client,
    make_object: Callable[..., str],
    post: Callable[..., Any],
    sources: list[str | None],
    told: bool,
) -> None:
    """Without a grid no grid is told of; one source that tells nothing weighs all alike."""
    make_object(sqlite_http)
    rng = np.random.default_rng(4)
    for source in sources:
        poses = rng.normal(size=(30, 3)) * 0.02, se3.random_quaternions(30, rng)
        more = {"proposal_density": 1_000.0} if told else {}
        post(sqlite_http, "thing", poses, **({} if source is None else {"source": source}), **more)
    info = sqlite_http.get("/objects/thing/density").json()
    weights, selected = info["weights"], info["selection"]["sources"]
    assert "grid" not in weights["rule"]
    assert weights["poses_tried"] is None
    assert weights["without_proposal_density"] == (0 if told else 30 * len(sources))
    assert set(selected) == {source or "unspecified" for source in sources}
    assert weights["kind"] == ("balance" if len(sources) > 1 else "own" if told else "equal")
    for source, item in selected.items():
        assert (item["trials"], item["successes"]) == (30, 30)
        assert ("estimated" in item["weights"]) == (len(sources) > 1 and not told), source


@pytest.fixture
def two_sources(
    sqlite_http: httpx.Client, make_object: Callable[..., str], post: Callable[..., Any]
) -> httpx.Client:
    """A robot that succeeds on the right, and a simulation that succeeds on the left, at the same poses."""
    make_object(sqlite_http)
    rng = np.random.default_rng(5)
    poses = rng.uniform(-0.03, 0.03, (300, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (300, 1))
    for source, sign in (("robot", 1.0), ("simulation", -1.0)):
        outcome = ["success" if won else "failure" for won in sign * poses[0][:, 0] > 0.0]
        post(sqlite_http, "thing", poses, outcome, source=source)
    return sqlite_http


def asked(http: httpx.Client, where: str = "likelihood", **parameters: Any) -> dict[str, Any]:
    at = {"position": "0.015,0,0", "quaternion_xyzw": "0,0,0,1"} if where == "likelihood" else {}
    answer = http.get(f"/objects/thing/{where}", params={**at, **parameters})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_a_source_counts_as_much_as_asked(two_sources: httpx.Client) -> None:
    http = two_sources
    plain = asked(http)
    same = asked(http, source_weight="robot:3,simulation:3,human:3,import:3")
    assert same["log_density"] == pytest.approx(plain["log_density"])
    assert same["success_probability"] == pytest.approx(plain["success_probability"])
    fifth = asked(http, source_weight="robot:1,simulation:0.2")
    alone = asked(http, source="robot")
    left_out = asked(http, source_weight="simulation:0")
    for name in ("log_density", "success_probability", "effective_trials"):
        assert left_out[name] == pytest.approx(alone[name]), name
    assert plain["success_probability"][0] == pytest.approx(0.5, abs=0.05)
    robot = alone["success_probability"][0]
    expected = (robot + 0.2 * (1.0 - robot)) / 1.2
    assert fifth["success_probability"][0] == pytest.approx(expected, abs=0.03)
    assert fifth["effective_trials"][0] == pytest.approx(0.6 * plain["effective_trials"][0], rel=0.05)
    sources = fifth["selection"]["sources"]
    shares = {name: item["share_of_weight"] for name, item in plain["selection"]["sources"].items()}
    expected = shares["robot"] / (shares["robot"] + 0.2 * shares["simulation"])
    assert sources["robot"]["share_of_weight"] == pytest.approx(expected)
    assert (sources["robot"]["source_weight"], sources["simulation"]["source_weight"]) == (1.0, 0.2)
    assert left_out["selection"]["sources"]["simulation"]["trials"] == 0
    # Whatever asks a density takes it, as an object or a string.
    best = asked(http, "best-grasp", source_weight="robot:1,simulation:0.01")
    assert best["grasps"][0]["position"][0] > 0.0
    body = {"source_weight": {"simulation": 1, "robot": 0.01}}
    assert http.post("/objects/thing/best-grasp", json=body).json()["grasps"][0]["position"][0] < 0.0
    drawn = http.post("/objects/thing/samples", json={**body, "count": 100, "seed": 1}).json()
    assert np.mean(np.array(drawn["position"])[:, 0] < 0.0) > 0.7


@pytest.mark.parametrize(
    "wrong",
    [
        "robot", "robot:", "robot:-1", "robot:nan", "robot:inf", "robot:1e300", "gripper:1", "", "robot:1,",
        ":1", "robot:1,robot:2", "robot:0,simulation:0", "robot:0,simulation:0,human:0,import:0", "robot:1:2",
    ],
)  # fmt: skip
def test_weights_that_mean_nothing_are_refused(two_sources: httpx.Client, wrong: str) -> None:
    for where in ("density", "best-grasp"):
        answer = two_sources.get(f"/objects/thing/{where}", params={"source_weight": wrong})
        assert answer.status_code == 422, (wrong, answer.text)
        assert "source_weight" in answer.json()["errors"][0]["field"]
    for odd in ({}, {"robot": None}, {"robot": True}, {"robot": [1]}, [1], 3, {"robot": "x"}, {"dog": 1}):
        answer = two_sources.post("/objects/thing/best-grasp", json={"source_weight": odd})
        assert answer.status_code == 422, (odd, answer.text)


def test_success_models_grow_by_weight(two_sources: httpx.Client, post: Callable[..., Any]) -> None:
    """What is extended tells what is read at once, with weights, too."""
    asked(two_sources, source_weight="robot:1,simulation:0.2")
    rng = np.random.default_rng(6)
    poses = rng.uniform(-0.03, 0.03, (50, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (50, 1))
    for source in ("robot", "simulation", "human"):
        post(two_sources, "thing", poses, ["success", "failure"] * 25, source=source)
    grown = asked(two_sources, source_weight="robot:1,simulation:0.2")
    fresh = asked(two_sources, source_weight="robot:10,simulation:2,human:10,import:10")
    for name in ("log_density", "success_probability", "effective_trials"):
        assert grown[name] == pytest.approx(fresh[name], rel=1e-4), name
