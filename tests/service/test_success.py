"""Success probability against its definition, over every attempt: posted, packed, collided."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import beta

from graspdb.wire import OUTCOME_CODES, OUTCOMES
from graspdb_density import IsotropicKernel, se3
from graspdb_geometry.collision import Scene
from graspdb_geometry.grids import PoseGrid
from graspdb_geometry.poses import ToolPoses
from known_jaws import PG70

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]

KERNEL = IsotropicKernel(0.015, np.deg2rad(15))
WIDTHS = {"sigma_position_m": 0.015, "sigma_rotation_deg": 15}
COLLISION = OUTCOME_CODES["collision"]


def by_definition(trials: Poses, success: Bools, queries: Poses) -> tuple[Floats, Floats, Floats, Floats]:
    """P, its interval's ends and n_e: the sums of the definition in float64, without a cut-off."""
    first = KERNEL.log_kernel(
        se3.Poses(queries[0][:, None], queries[1][:, None]), se3.Poses.of(trials[0], trials[1])
    )
    second = KERNEL.log_kernel(
        se3.Poses(queries[0][:, None], queries[1][:, None]),
        se3.Poses.of(trials[0], se3.jaw_twin(trials[1])),
    )
    k = np.exp(first) + np.exp(second)
    total = k.sum(axis=1)
    n = total**2 / (k**2).sum(axis=1)
    m0 = success.mean()
    p = (m0 + n * (k @ success) / total) / (1 + n)
    return (
        p,
        beta.ppf(0.05, p * (1 + n), (1 - p) * (1 + n)),
        beta.ppf(0.95, p * (1 + n), (1 - p) * (1 + n)),
        n,
    )


def ask(http: httpx.Client, poses: Poses, **more: Any) -> dict[str, Any]:
    body = {"poses": {"position": poses[0].tolist(), "quaternion_xyzw": poses[1].tolist()}, **WIDTHS, **more}
    answer = http.post("/objects/thing/likelihood", json=body)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def compare(answer: dict[str, Any], expected: tuple[Floats, ...]) -> None:
    """Where an attempt is near enough for a probability: elsewhere there is none."""
    told = np.array(answer["support"]["enough"])
    assert told.sum() >= 10
    columns = answer["success_probability"], answer["interval"]["low"], answer["interval"]["high"]
    for column, values, tolerance in zip(columns, expected, (2e-3, 3e-3, 3e-3), strict=False):
        found = np.array(column, dtype=np.float64)
        np.testing.assert_array_equal(np.isfinite(found), told)
        np.testing.assert_allclose(found[told], values[told], atol=tolerance)
    np.testing.assert_allclose(answer["effective_trials"], expected[3], rtol=1e-2)
    assert answer["interval"]["level"] == 0.9


def test_posted_attempts(
    http: httpx.Client, make_object: Make, post: Post, clusters: Callable[..., Poses]
) -> None:
    """No mesh: collisions are failures. What broke off is no attempt; a source of successes tells nothing."""
    make_object(http)
    rng = np.random.default_rng(0)
    trials = clusters([((0, 0, 0), (0, 0, 0, 1.0)), ((0.02, 0, 0), (1.0, 0, 0, 0))], 150, sigma_m=0.02)
    names = rng.choice(["success", "slipped", "collision", "simulation_error"], 300, p=[0.5, 0.2, 0.2, 0.1])
    post(http, "thing", trials, names.tolist(), source="robot", proposal_density=7.5)
    queries = clusters([((0.01, 0, 0), (0, 0, 0, 1.0))], 60, seed=9, sigma_m=0.02)
    tried = names != "simulation_error"
    attempts, won = (trials[0][tried], trials[1][tried]), (names == "success")[tried]
    compare(ask(http, queries), by_definition(attempts, won, queries))

    shown = clusters([((0, 0, 0), (0, 0, 0, 1.0))], 100, seed=3)
    post(http, "thing", shown, "success", source="human")
    compare(ask(http, queries), by_definition(attempts, won, queries))
    # Its first failure makes it a source of attempts, with all that it has posted.
    post(http, "thing", (shown[0][:1], shown[1][:1]), "missed", source="human")
    everything = tuple(np.concatenate([a, s, s[:1]]) for a, s in zip(attempts, shown, strict=True))
    won = np.concatenate([won, np.ones(100, dtype=bool), [False]])
    compare(ask(http, queries), by_definition((everything[0], everything[1]), won, queries))
    # The tail extends.
    post(http, "thing", trials, "dropped", source="robot")
    everything = tuple(np.concatenate([a, t]) for a, t in zip(everything, trials, strict=True))
    won = np.concatenate([won, np.zeros(300, dtype=bool)])
    compare(ask(http, queries), by_definition((everything[0], everything[1]), won, queries))
    best = http.get("/objects/thing/best-grasp", params=WIDTHS).json()["grasps"][0]
    pose = np.array([best["position"]]), np.array([best["quaternion_xyzw"]])
    expected = by_definition((everything[0], everything[1]), won, pose)
    assert best["success_probability"] == pytest.approx(expected[0][0], abs=2e-3)
    assert best["interval"]["low"] == pytest.approx(expected[1][0], abs=3e-3)
    assert best["effective_trials"] == pytest.approx(expected[3][0], rel=1e-2)


def test_nothing_tried_is_null(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    few = two_clusters[0][:4], two_clusters[1][:4]
    for _ in range(2):
        answer = ask(http, few)
        assert answer["success_probability"] == [None] * 4
        assert answer["interval"] == {"level": 0.9, "low": [None] * 4, "high": [None] * 4}
        assert answer["effective_trials"] == [0] * 4
        post(http, "thing", two_clusters)
    only = ask(http, few, include=["effective_trials"])
    assert not {"success_probability", "interval", "density", "collision_free"} & only.keys()


def run_sweep(
    http: httpx.Client, scene: Scene, **options: Any
) -> tuple[dict[str, Any], Poses, NDArray[np.uint8]]:
    """A sweep with made-up physics: what collides, collides; the rest succeeds where x is positive.

    Of the failures every other one is packed, the others are rows.
    """
    grid = {"position_step_m": 0.02, "rotation_step_deg": 60, "max_poses": 1500, "seed": 1}
    body = {"grid": grid, "gripper": "pg70", "chunk_poses": 400, **options}
    sweep = http.post("/objects/thing/sweeps", json=body)
    assert sweep.status_code == 202, sweep.text
    positions, quaternions, outcomes = [], [], []
    while True:
        jobs = http.post(
            "/jobs/claim", json={"worker": "w", "capabilities": ["simulate"], "limit": 1}
        ).json()["jobs"]
        if not jobs:
            break
        (job,) = jobs
        payload = job["payload"]
        plan = PoseGrid(**payload["grid"])
        index = plan.pose_indices(payload["start"], payload["stop"])
        p, q = plan.poses(index)
        codes = np.where(p[:, 0] > 0, OUTCOME_CODES["success"], OUTCOME_CODES["missed"]).astype(np.uint8)
        codes[scene.collides(ToolPoses(p, q), PG70)] = COLLISION
        rows = index[(codes == OUTCOME_CODES["success"]) | ((codes != COLLISION) & (index % 2 == 0))]
        result = {
            "outcomes": base64.b64encode(codes.tobytes()).decode(),
            "rows": {
                "pose_index": rows.tolist(),
                "width_m": [0.04] * len(rows),
                "quality": [None] * len(rows),
            },
        }
        done = http.put(f"/jobs/{job['id']}/result", params={"lease_id": job["lease_id"]}, json=result)
        assert done.status_code == 200, done.text
        positions.append(p), quaternions.append(q), outcomes.append(codes)
        # Asked after every chunk, so that the model is extended by each.
        asked = np.array([[0.03, 0, 0]]), np.array([[0, 0, 0, 1.0]])
        assert ask(http, asked)["effective_trials"][0] >= 0
    return (np.concatenate(positions), np.concatenate(quaternions)), np.concatenate(outcomes)


def test_sweeps_with_their_packed_outcomes(
    http: httpx.Client, make_object: Make, put_box: Callable[..., Scene], post: Post
) -> None:
    make_object(http, mass_kg=0.2)
    scene = put_box(http, "thing", (0.03, 0.03, 0.03))
    poses, codes = run_sweep(http, scene)
    assert {OUTCOMES[c] for c in np.unique(codes)} == {"success", "missed", "collision"}
    rng = np.random.default_rng(1)
    rows = rng.integers(0, len(codes), 150)
    queries = poses[0][rows] + 0.005 * rng.normal(size=(150, 3)), poses[1][rows]
    tried = codes != COLLISION
    attempts, won = (poses[0][tried], poses[1][tried]), codes[tried] == OUTCOME_CODES["success"]
    collides = scene.collides(ToolPoses(*queries), PG70)
    assert 10 < collides.sum() < 140

    def expected(attempts: Poses, won: Bools) -> tuple[Floats, ...]:
        columns = by_definition(attempts, won, queries)
        for column in columns[:3]:
            column[collides] = 0
        return columns

    answer = ask(http, queries)
    assert answer["collision_free"] == (~collides).tolist()
    compare(answer, expected(attempts, won))

    # The same grid again tells nothing new; trials of a lab with the same gripper do.
    run_sweep(http, scene)
    compare(ask(http, queries), expected(attempts, won))
    posted = post(http, "thing", queries, "slipped", gripper="pg70", protocol="wrench", source="robot")
    both = np.concatenate([attempts[0], queries[0]]), np.concatenate([attempts[1], queries[1]])
    compare(ask(http, queries), expected(both, np.concatenate([won, np.zeros(150, dtype=bool)])))

    # A check tells nothing, by definition.
    run_sweep(http, scene, purpose="check", fidelity="fine")
    compare(ask(http, queries), expected(both, np.concatenate([won, np.zeros(150, dtype=bool)])))

    # What is deleted is forgotten.
    assert http.delete(f"/objects/thing/batches/{posted['batch']}").status_code in (200, 204)
    compare(ask(http, queries), expected(attempts, won))
