"""Proposals: where they lie, that their densities are right, and that they weight the trials sent back."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from graspdb_density import GraspDensity, IsotropicKernel, SuccessModel, se3
from graspdb_density.se3 import Poses
from graspdb_geometry.collision import Scene, box_part
from graspdb_geometry.poses import ToolPoses
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.grasps.proposals import uncertain
from known_jaws import PG70

Floats = NDArray[np.float64]
Pair = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]

WIDTHS = {"sigma_position_m": 0.015, "sigma_rotation_deg": 15}
KERNEL = IsotropicKernel(0.015, math.radians(15))
UP = (0.0, 0.0, 0.0, 1.0)


def propose(http: httpx.Client, **body: Any) -> dict[str, Any]:
    answer = http.post("/objects/thing/proposals", json={**WIDTHS, **body})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def arrays(answer: dict[str, Any]) -> tuple[Floats, Floats, Floats]:
    position, quaternion, density = (
        np.array(answer[name]) for name in ("position", "quaternion_xyzw", "proposal_density")
    )
    return position, quaternion, density


@pytest.fixture
def known_and_unknown(clusters: Callable[..., Pair]) -> tuple[Pair, list[str]]:
    """400 attempts on the left, 12 on the right, half of either successful."""
    left, right = clusters([((-0.1, 0, 0), UP)], 400, seed=1), clusters([((0.1, 0, 0), UP)], 12, seed=2)
    poses = np.concatenate([left[0], right[0]]), np.concatenate([left[1], right[1]])
    return poses, ["success", "slipped"] * 206


def test_uncertainty_goes_where_little_is_known(
    http: httpx.Client, make_object: Make, post: Post, known_and_unknown: tuple[Pair, list[str]]
) -> None:
    make_object(http)
    post(http, "thing", *known_and_unknown)
    by_density = arrays(propose(http, count=2_000, seed=1, strategy="density"))
    uncertainty = propose(http, count=2_000, seed=1, strategy="uncertainty")
    assert uncertainty["strategy"] == "uncertainty"
    assert "variance" in uncertainty["criterion"]
    p, q, g = arrays(uncertainty)
    assert (p[:, 0] > 0).mean() > 4 * (by_density[0][:, 0] > 0).mean()
    # One more trial there is expected to lower the variance of the estimate more.
    poses, outcomes = known_and_unknown
    model = SuccessModel.build(Poses.of(*poses), np.array(outcomes) == "success", kernel=KERNEL)

    def gain(positions: Floats, quaternions: Floats) -> float:
        found = model.evaluate(Poses.of(positions, quaternions))
        chance, trials = found.probability, found.effective_trials + 1
        now = chance * (1 - chance) / (trials + 1)
        after = np.zeros(len(trials))
        for outcome, share in ((1.0, chance), (0.0, 1 - chance)):
            then = (chance * trials + outcome) / (trials + 1)
            after += share * then * (1 - then) / (trials + 2)
        return float((now - after).mean())

    assert gain(p, q) > 3 * gain(*by_density[:2])
    # Nor does it go where nothing is known at all.
    assert (np.linalg.norm(p[:, None] - poses[0][None], axis=2).min(axis=1) < 0.07).all()
    assert (g > 0).all()
    again = propose(http, count=2_000, seed=1, strategy="uncertainty")
    assert again == uncertainty
    other = propose(http, count=2_000, seed=2, strategy="uncertainty")
    assert other["position"] != uncertainty["position"]


@pytest.mark.parametrize("strategy", ["density", "uncertainty"])
def test_proposals_integrate_to_one(
    sqlite_http: httpx.Client,
    make_object: Make,
    post: Post,
    known_and_unknown: tuple[Pair, list[str]],
    strategy: str,
) -> None:
    """The mean of h / g over draws from g is the integral of h wherever g is: here 1, both twins included."""
    http = sqlite_http
    make_object(http)
    post(http, "thing", *known_and_unknown)
    p, q, g = arrays(propose(http, count=60_000, seed=5, strategy=strategy))
    narrow = IsotropicKernel(0.006, math.radians(6))
    for symmetric in (True, False):
        h = GraspDensity.build(se3.Poses.of(p[:300], q[:300]), kernel=narrow, symmetric=symmetric)
        ratio = h.density(se3.Poses.of(p[300:], q[300:]), cutoff=None, threads=2) / g[300:]
        error = ratio.std() / math.sqrt(len(ratio))
        assert error < 0.05
        assert ratio.mean() == pytest.approx(1.0, abs=4 * error)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), symmetric=st.booleans())
def test_any_uncertainty_integrates_to_one(seed: int, symmetric: bool) -> None:
    """Uniform poses in a box that holds it all, against the volume of box and rotations."""
    rng = np.random.default_rng(seed)
    kernel = IsotropicKernel(0.02, math.radians(40))
    p, q = rng.normal(size=(60, 3)) * 0.02, se3.random_quaternions(60, rng)
    won = rng.random(60) < 0.4
    won[:2] = True, False
    density = GraspDensity.build(se3.Poses.of(p[won], q[won]), kernel=kernel, symmetric=symmetric)
    model = SuccessModel.build(Poses.of(p, q), won, kernel=kernel, symmetric=symmetric)
    proposal = uncertain(density, model, None)
    assert proposal is not None
    low, high = proposal.positions.min(axis=0) - 0.05, proposal.positions.max(axis=0) + 0.05
    at, to = rng.uniform(low, high, (60_000, 3)), se3.random_quaternions(60_000, rng)
    values = proposal.density(se3.Poses(at, to), cutoff=5.0) * np.prod(high - low) * 8 * math.pi**2
    error = values.std() / math.sqrt(len(values))
    assert values.mean() == pytest.approx(1.0, abs=4.5 * error + 1e-3)


def test_trials_of_proposals_are_weighted(
    sqlite_http: httpx.Client, make_object: Make, post: Post, known_and_unknown: tuple[Pair, list[str]]
) -> None:
    http = sqlite_http
    make_object(http)
    post(http, "thing", *known_and_unknown)
    make_object(http, "other")
    p, q, g = arrays(propose(http, count=50, seed=5, strategy="uncertainty"))
    post(http, "other", (p, q), proposal_density=g)
    density = GraspDensity.build(se3.Poses.of(p, q), kernel=KERNEL, weights=1 / g)
    answer = http.post(
        "/objects/other/likelihood",
        json={"poses": {"position": p.tolist(), "quaternion_xyzw": q.tolist()}, **WIDTHS},
    ).json()
    np.testing.assert_allclose(answer["density"], density.density(se3.Poses.of(p, q)), rtol=5e-3)


def test_uncertainty_leaves_out_what_collides(clusters: Callable[..., Pair]) -> None:
    scene = Scene([box_part([0.01, 0.03, 0.05], [0, 0, 0], [0, 0, 0, 1])])
    p, q = clusters([((0, 0, 0.045), (1.0, 0, 0, 0))], 300, sigma_m=0.004, sigma_rad=0.05)
    free = ~scene.collides(ToolPoses(p, q), PG70)
    p, q = p[free], q[free]
    won = np.arange(len(p)) % 2 == 0
    density = GraspDensity.build(se3.Poses.of(p[won], q[won]), kernel=KERNEL)
    model = SuccessModel.build(Poses.of(p, q), won, kernel=KERNEL)
    blind, seeing = uncertain(density, model, None), uncertain(density, model, CollisionTest(scene, PG70))
    assert blind is not None
    assert seeing is not None
    assert scene.collides(ToolPoses(blind.positions, blind.quaternions_xyzw), PG70).mean() > 0.2
    assert not scene.collides(ToolPoses(seeing.positions, seeing.quaternions_xyzw), PG70).any()
    # Where everything near collides, nothing is left.
    huge = Scene([box_part([0.5, 0.5, 0.5], [0, 0, 0], [0, 0, 0, 1])])
    assert uncertain(density, model, CollisionTest(huge, PG70)) is None


def test_what_can_not_be_proposed_says_why(
    sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Pair
) -> None:
    http = sqlite_http
    make_object(http)

    def refused(**body: Any) -> tuple[int, str]:
        answer = http.post("/objects/thing/proposals", json=body)
        return answer.status_code, str(answer.json()["type"]).rpartition(":")[2]

    for strategy in ("density", "uncertainty"):
        assert refused(strategy=strategy) == (409, "no-successes")
    post(http, "thing", two_clusters)
    assert refused(strategy="uncertainty") == (409, "no-attempts")
    assert refused(strategy="luck")[0] == 422
    assert refused(count=0)[0] == 422
    assert http.post("/objects/none/proposals", json={}).status_code == 404
    samples = http.post("/objects/thing/samples", json={"count": 20, "seed": 3}).json()
    proposed = http.post("/objects/thing/proposals", json={"count": 20, "seed": 3}).json()
    assert proposed["position"] == samples["position"]
    assert proposed["proposal_density"] == samples["proposal_density"]
