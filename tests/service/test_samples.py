"""Draws from a density: repeatable, right in distribution, with the density they were drawn with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

import brute_force
from graspdb.wire import Selection
from graspdb_density import IsotropicKernel, se3
from graspdb_service.app import create_app
from graspdb_service.settings import Settings
from graspdb_service.usecases.grasps.samples import draw

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]

WIDTHS = {"sigma_position_m": 0.015, "sigma_rotation_deg": 15}


def fields(answer: httpx.Response, status: int = 422) -> set[str]:
    assert answer.status_code == status, answer.text
    return {item["field"] for item in answer.json()["errors"]}


def test_repeatable_and_with_their_density(
    http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(http)
    post(http, "thing", two_clusters)
    path = "/objects/thing/samples"
    first = http.post(path, json={"count": 2000, "seed": 7, **WIDTHS}).json()
    assert first["seed"] == 7
    assert http.post(path, json={"count": 2000, "seed": 7, **WIDTHS}).json() == first
    assert http.post(path, json={"count": 2000, "seed": 8, **WIDTHS}).json()["position"] != first["position"]
    made_up = http.post(path, json={"count": 5}).json()
    assert http.post(path, json={"count": 5, "seed": made_up["seed"]}).json() == made_up

    position, quaternion = np.array(first["position"]), np.array(first["quaternion_xyzw"])
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1, atol=1e-12)
    exact = brute_force.log_density(
        IsotropicKernel(0.015, np.deg2rad(15)),
        se3.Poses.of(*two_clusters),
        se3.Poses.of(position, quaternion),
    )
    np.testing.assert_allclose(np.log(first["proposal_density"]), exact, atol=1e-3)
    # 300 of 500 successes are from above: within four standard deviations of the binomial.
    top = np.linalg.norm(position - [0, 0, 0.06], axis=1) < np.linalg.norm(position - [-0.08, 0, 0], axis=1)
    assert abs(top.mean() - 0.6) < 4 * np.sqrt(0.24 / 2000)
    # Each jaw twin is drawn as often as the other.
    plain = se3.angle_between(quaternion[top], np.array([1.0, 0, 0, 0])) < np.pi / 2
    assert abs(plain.mean() - 0.5) < 4 * np.sqrt(0.25 / top.sum())


def test_a_wider_kernel_spreads_wider(
    sqlite_http: httpx.Client, make_object: Make, post: Post, clusters: Callable[..., Poses]
) -> None:
    make_object(sqlite_http)
    post(sqlite_http, "thing", clusters([((0, 0, 0), (0, 0, 0, 1.0))], 500, sigma_m=0.01))
    for sigma in (0.01, 0.04):
        answer = sqlite_http.post(
            "/objects/thing/samples",
            json={
                "count": 20_000,
                "seed": 1,
                "kernel": {"sigma_position_m": sigma, "sigma_rotation_deg": 10},
            },
        ).json()
        assert np.allclose(np.std(answer["position"], axis=0), np.hypot(0.01, sigma), rtol=0.1)


def test_weights_shape_the_draws(
    sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    make_object(sqlite_http)
    proposal = np.where(np.arange(500) < 300, 30.0, 10.0)
    post(sqlite_http, "thing", two_clusters, proposal_density=proposal)
    answer = sqlite_http.post("/objects/thing/samples", json={"count": 10_000, "seed": 2, **WIDTHS}).json()
    top = np.array(answer["position"])[:, 2] > 0.03
    assert abs(top.mean() - 300 / 900) < 4 * np.sqrt(0.22 / 10_000)


def test_bad_requests(sqlite_http: httpx.Client, make_object: Make, post: Post, two_clusters: Poses) -> None:
    http = sqlite_http
    make_object(http)
    path = "/objects/thing/samples"
    nothing = http.post(path, json={"count": 3})
    assert nothing.status_code == 409
    assert nothing.json()["type"].endswith("no-successes")
    post(http, "thing", two_clusters)
    assert fields(http.post(path, json={"count": 0})) == {"count"}
    assert fields(http.post(path, json={"count": 2.5})) == {"count"}
    assert fields(http.post(path, json={"seed": -1})) == {"seed"}
    assert fields(http.post(path, json={"seed": 2**70})) == {"seed"}
    assert fields(http.post(path, json={"cuont": 1})) == {"cuont"}
    assert http.post("/objects/none/samples", json={}).status_code == 404


def test_limit(
    serve: Callable[..., str], sqlite_url: str, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    with httpx.Client(base_url=serve(sqlite_url, max_samples=10)) as http:
        make_object(http)
        post(http, "thing", two_clusters)
        assert fields(http.post("/objects/thing/samples", json={"count": 11}), 413) == {"count"}


def test_draw_for_other_use_cases(
    http: httpx.Client, database_url: str, make_object: Make, post: Post, two_clusters: Poses
) -> None:
    """What a sweep over samples calls gives what the route answers."""
    make_object(http)
    post(http, "thing", two_clusters)
    answer = http.post("/objects/thing/samples", json={"count": 50, "seed": 3}).json()
    ctx = create_app(Settings(database_url=database_url)).state.context
    try:
        drawn = draw(ctx, "thing", Selection(), 50, 3)
    finally:
        ctx.close()
    np.testing.assert_array_equal(drawn.position, answer["position"])
    np.testing.assert_array_equal(drawn.quaternion_xyzw, answer["quaternion_xyzw"])
    np.testing.assert_array_equal(drawn.proposal_density, answer["proposal_density"])
