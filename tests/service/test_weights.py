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
    weights = importance_weights(built.proposal_density)
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


def test_grids_beside_trials_that_know_their_own_density(
    box: httpx.Client, ctx: Context, post: Callable[..., Any]
) -> None:
    """What can't be evaluated elsewhere has 1 / g of its own; one that tells nothing takes the mean."""
    sweep(box, COARSE)
    work(box)
    rng = np.random.default_rng(2)
    poses = rng.normal(size=(40, 3)) * 0.01, np.tile([0.0, 0.0, 0.0, 1.0], (40, 1))
    post(box, "thing", poses, gripper="pg70", protocol="wrench", source="robot")
    assert weights_told(box)["kind"] == "equal"
    before = density_of(ctx, *PLAIN)
    g = rng.uniform(500.0, 5_000.0, 40)
    post(box, "thing", poses, gripper="pg70", protocol="wrench", proposal_density=g)
    told = weights_told(box)
    assert (told["kind"], told["without_proposal_density"]) == ("mixture-and-own", 40)
    built = density_of(ctx, *PLAIN)
    assert before.density is not None
    assert built.density is not None
    grid = PoseGrid((-0.02,) * 3, (0.02,) * 3, 0.01, 60.0, 0.02)
    swept = before.density.size - 40
    own = np.concatenate([np.full(swept, 8 * np.pi**2 * grid.volume_m3), np.full(40, np.nan), 1.0 / g])
    own[np.isnan(own)] = np.nanmean(own)
    np.testing.assert_allclose(built.density.weights, own / own.sum(), rtol=1e-6)
