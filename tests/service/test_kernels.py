"""Stored kernels: fitted on trials or given, used in every query, and what goes wrong with them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb_density import AnisotropicKernel, IsotropicKernel, MixtureDensity, SampledKernel, se3

Floats = NDArray[np.float64]
Poses = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]

SPREAD = np.array([0.02, 0.004, 0.01, 0.08, 0.4, 0.08])


def ridges(count: int = 400, seed: int = 0) -> Poses:
    """Grasps wide along x and about y of the gripper, about six places."""
    rng = np.random.default_rng(seed)
    at, to = rng.normal(size=(6, 3)) * 0.08, se3.random_quaternions(6, rng)
    which = rng.integers(6, size=count)
    xi = rng.normal(size=(count, 6)) * SPREAD
    p = at[which] + np.einsum("nij,nj->ni", se3.to_matrix(to[which]), xi[:, :3])
    return p, se3.multiply(to[which], se3.from_rotation_vector(xi[:, 3:]))


def problem(answer: httpx.Response, status: int) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    body: dict[str, Any] = answer.json()
    return body


def fit(http: httpx.Client, **request: Any) -> dict[str, Any]:
    answer = http.post("/kernels", json=request)
    assert answer.status_code == 201, answer.text
    body: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/kernels/{body['id']}"
    return body


def loaded(kernel: dict[str, Any]) -> AnisotropicKernel:
    parts = kernel["components"]
    return AnisotropicKernel(
        [c["weight"] for c in parts], [c["mean"] for c in parts], [c["covariance"] for c in parts]
    )


def diagonal(*widths: float) -> list[list[float]]:
    return np.diag(np.square(widths)).tolist()


GIVEN = {"components": [{"covariance": diagonal(0.02, 0.006, 0.01, 0.1, 0.3, 0.1)}]}


def test_fitted_listed_used_and_deleted(http: httpx.Client, make_object: Make, post: Post) -> None:
    make_object(http)
    poses = ridges()
    post(http, "thing", poses, gripper="pg70")
    told = problem(http.get("/objects/thing/density?kernel=anisotropic"), 409)
    assert told["type"].endswith("kernel-not-fitted")
    assert 'POST /kernels {"object": "thing", "gripper": "pg70"}' in told["title"]

    made = fit(http, object="thing")
    assert (made["gripper"], made["alignment"], made["kind"]) == ("pg70", "gripper", "anisotropic")
    source = made["provenance"]
    assert (source["origin"], source["object"], source["successes"]) == ("fitted", "thing", 400)
    assert source["revision"] == http.get("/objects/thing").json()["revision"]
    assert source["window"] == {"position_m": 0.03, "rotation_deg": 45}
    assert source["log_likelihood"] > source["isotropic_log_likelihood"]
    assert 0.5 < source["similarity"] <= 1
    assert made["widths_m"][0] > 1.5 * made["widths_m"][1]
    assert made["widths_deg"][1] > 1.5 * made["widths_deg"][0]
    assert http.get(f"/kernels/{made['id']}").json() == made

    other = fit(http, **GIVEN)
    assert (other["gripper"], other["provenance"]["origin"]) == (None, "given")
    assert [k["id"] for k in http.get("/kernels").json()["items"]] == [made["id"], other["id"]]
    assert [k["id"] for k in http.get("/kernels?object=thing").json()["items"]] == [made["id"]]
    first = http.get("/kernels?limit=1").json()
    assert [k["id"] for k in http.get(f"/kernels?cursor={first['next']}").json()["items"]] == [other["id"]]

    for name in ("anisotropic", made["id"]):
        used = http.get(f"/objects/thing/density?kernel={name}").json()["kernel"]
        assert (used["kind"], used["id"], used["alignment"]) == ("anisotropic", made["id"], "gripper")
        assert used["widths_m"] == pytest.approx(made["widths_m"])
    # The newest is used, and no cached answer of the one before.
    tag = http.get("/objects/thing/density?kernel=anisotropic").headers["etag"]
    newest = fit(http, object="thing", window={"position_m": 0.02, "rotation_deg": 30})
    answer = http.get("/objects/thing/density?kernel=anisotropic", headers={"If-None-Match": tag})
    assert (answer.status_code, answer.json()["kernel"]["id"]) == (200, newest["id"])

    assert http.delete(f"/kernels/{newest['id']}").status_code == 204
    assert problem(http.delete(f"/kernels/{newest['id']}"), 404)
    assert problem(http.get(f"/objects/thing/density?kernel={newest['id']}"), 404)
    used = http.get("/objects/thing/density?kernel=anisotropic").json()["kernel"]
    assert used["id"] == made["id"]
    # A kernel outlives the object it was fitted on.
    assert http.delete("/objects/thing").status_code == 204
    assert http.get(f"/kernels/{made['id']}").json()["provenance"]["object"] == "thing"


def test_queries_answer_what_the_maths_does(sqlite_http: httpx.Client, make_object: Make, post: Post) -> None:
    http = sqlite_http
    make_object(http)
    poses = ridges()
    g = np.random.default_rng(5).random(400) + 0.5
    post(http, "thing", poses, proposal_density=g)
    kernel = fit(http, **GIVEN)
    density = MixtureDensity(se3.Poses.of(*poses), kernel=loaded(kernel), weights=1.0 / g)
    asked = poses[0][:50] + 0.003, poses[1][:50]
    body = {"position": asked[0].tolist(), "quaternion_xyzw": asked[1].tolist()}
    found = http.post("/objects/thing/likelihood", json={"poses": body, "kernel": kernel["id"]}).json()
    np.testing.assert_allclose(found["log_density"], density.log_density(se3.Poses.of(*asked)), atol=2e-3)
    assert max(found["relative"]) <= 1
    assert found["kernel"]["id"] == kernel["id"]

    best = http.get(f"/objects/thing/best-grasp?kernel={kernel['id']}&count=3").json()
    assert best["status"] == "ok"
    top = best["grasps"][0]
    assert top["relative"] == pytest.approx(1, abs=0.02)
    exact = density.log_density(se3.Poses.of([top["position"]], [top["quaternion_xyzw"]]))[0]
    assert top["log_density"] == pytest.approx(exact, abs=2e-3)
    assert top["log_density"] >= max(found["log_density"]) - 1e-3
    logs = [grasp["log_density"] for grasp in best["grasps"]]
    assert logs == sorted(logs, reverse=True)
    half = float(np.median(poses[0][:, 0]))
    inside = http.post(
        "/objects/thing/best-grasp", json={"kernel": kernel["id"], "above_plane": [1, 0, 0, half]}
    ).json()
    assert inside["grasps"][0]["position"][0] >= half - 1e-6

    drawn = http.post(
        "/objects/thing/samples", json={"count": 2_000, "seed": 3, "kernel": kernel["id"]}
    ).json()
    p, q = np.array(drawn["position"]), np.array(drawn["quaternion_xyzw"])
    np.testing.assert_allclose(
        np.log(drawn["proposal_density"]), density.log_density(se3.Poses.of(p, q)), atol=2e-3
    )
    # Mean log density of its own draws is minus the entropy: as that of the maths' own draws.
    own = density.log_density(se3.Poses.of(*density.sample(2_000, np.random.default_rng(8))))
    assert np.log(drawn["proposal_density"]).mean() == pytest.approx(own.mean(), abs=0.25)

    # Trials that come later are in the next answer.
    more = ridges(50, seed=9)
    post(http, "thing", more, proposal_density=np.ones(50))
    grown = MixtureDensity(
        se3.Poses.of(np.concatenate([poses[0], more[0]]), np.concatenate([poses[1], more[1]])),
        kernel=loaded(kernel), weights=np.concatenate([1.0 / g, np.ones(50)]),
    )  # fmt: skip
    found = http.post("/objects/thing/likelihood", json={"poses": body, "kernel": kernel["id"]}).json()
    np.testing.assert_allclose(found["log_density"], grown.log_density(se3.Poses.of(*asked)), atol=2e-3)


def test_aligned_with_the_object(
    sqlite_http: httpx.Client, make_object: Make, post: Post, put_box: Callable[..., Any]
) -> None:
    http = sqlite_http
    make_object(http)
    told = problem(http.post("/kernels", json={"object": "thing", "alignment": "object"}), 409)
    assert "PUT /objects/thing/mesh" in told["title"]
    put_box(http, "thing")
    rng = np.random.default_rng(0)
    # Wide along the object's longest axis, its z, whatever way the gripper stands.
    p = rng.normal(size=(300, 3)) * [0.003, 0.003, 0.04]
    q = se3.multiply(
        np.array([0.0, 0.5**0.5, 0.0, 0.5**0.5]), se3.from_rotation_vector(rng.normal(size=(300, 3)) * 0.1)
    )
    post(http, "thing", (p, q))
    made = fit(http, object="thing", alignment="object")
    # The longest way first.
    assert made["widths_m"][0] > 1.5 * max(made["widths_m"][1:])
    answer = http.get("/objects/thing/density?kernel=anisotropic")
    assert answer.json()["kernel"]["alignment"] == "object"
    told = problem(
        http.post("/kernels", json={"object": "thing", "alignment": "object", "components": 2}), 422
    )
    assert told["errors"][0]["field"] == "components"
    make_object(http, "bare")
    post(http, "bare", (p, q))
    told = problem(http.get(f"/objects/bare/density?kernel={made['id']}"), 409)
    assert told["type"].endswith("mesh-missing")


def test_another_grippers_kernel_is_refused(sqlite_http: httpx.Client, make_object: Make, post: Post) -> None:
    http = sqlite_http
    make_object(http)
    post(http, "thing", ridges(), gripper="pg70")
    kernel = fit(http, gripper="panda", **GIVEN)["id"]
    for answer in (
        http.get(f"/objects/thing/density?kernel={kernel}"),
        http.get(f"/objects/thing/best-grasp?kernel={kernel}"),
        http.post("/objects/thing/samples", json={"count": 3, "kernel": kernel}),
    ):
        told = problem(answer, 409)
        assert told["type"].endswith("kernel-of-another-gripper")
        assert "panda" in told["title"]
        assert "pg70" in told["title"]


def test_bad_kernels_are_refused_with_reasons(
    sqlite_http: httpx.Client, make_object: Make, post: Post
) -> None:
    http = sqlite_http
    make_object(http)

    def refused(status: int, **request: Any) -> str:
        told = problem(http.post("/kernels", json=request), status)
        return " ".join([told["title"], *(f"{e['field']} {e['message']}" for e in told.get("errors", []))])

    assert "nothing to fit" in refused(409, object="thing")
    post(http, "thing", ridges(40))
    assert "at least 50 successes; there are 40, so 10 more" in refused(409, object="thing")
    assert "at most" not in refused(404, object="nothing")
    assert "has no mesh" in refused(409, object="thing", alignment="edge")
    assert "name the object" in refused(422)
    assert "fitted on nothing: object" in refused(422, object="thing", **GIVEN)
    singular = np.diag([1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.0]).tolist()
    assert "singular" in refused(422, components=[{"covariance": singular}])
    wide = diagonal(0.01, 0.01, 0.01, 0.1, math.radians(60), 0.1)
    assert "60 degrees" in refused(422, components=[{"covariance": wide}])
    assert "components" in refused(422, components=[{"covariance": np.eye(5).tolist()}])
    assert "no gripper 'nope'" in refused(422, gripper="nope", **GIVEN)
    kernel = fit(http, **GIVEN)["id"]
    told = problem(http.get(f"/objects/thing/density?kernel={kernel}&sigma_position_m=0.01"), 422)
    assert told["errors"][0]["field"] == "sigma_position_m"
    assert (
        "kernels there are: isotropic"
        in problem(http.get("/objects/thing/density?kernel=nope"), 404)["title"]
    )


def test_the_same_request_twice_makes_one_kernel(http: httpx.Client) -> None:
    headers = {"Idempotency-Key": "once"}
    first, again = (http.post("/kernels", json=GIVEN, headers=headers).json() for _ in range(2))
    assert first == again
    assert len(http.get("/kernels").json()["items"]) == 1


# -- sampled kernels ---------------------------------------------------------------------------------------


def as_sampled(kernel: dict[str, Any]) -> SampledKernel:
    means = np.array([c["mean"] for c in kernel["components"]])
    widths = kernel["provenance"]["component_widths"]
    return SampledKernel(
        se3.Poses(means[:, :3], se3.from_rotation_vector(means[:, 3:])),
        IsotropicKernel(widths["sigma_position_m"], math.radians(widths["sigma_rotation_deg"])),
        np.array([c["weight"] for c in kernel["components"]]),
    )


def test_a_sampled_kernel_is_drawn_and_used_in_every_query(
    http: httpx.Client, make_object: Make, post: Post
) -> None:
    make_object(http)
    poses = ridges()
    g = np.random.default_rng(5).random(400) + 0.5
    post(http, "thing", poses, gripper="pg70", proposal_density=g)
    widths = {"sigma_position_m": 0.008, "sigma_rotation_deg": 12}
    made = fit(http, object="thing", kind="sampled", components=60, component_widths=widths)
    assert (made["kind"], made["gripper"], len(made["components"])) == ("sampled", "pg70", 60)
    assert made["components"][0]["covariance"] is None
    source = made["provenance"]
    assert source["component_widths"] == widths
    assert source["window"] == {"position_m": 0.03, "rotation_deg": 45}
    assert 0.5 < source["similarity"] <= 1
    assert http.get(f"/kernels/{made['id']}").json() == made
    # It is none of those that the name anisotropic means.
    assert problem(http.get("/objects/thing/density?kernel=anisotropic"), 409)

    density = as_sampled(made).placed(se3.Poses.of(*poses), weights=1.0 / g)
    asked = poses[0][:50] + 0.003, poses[1][:50]
    body = {"position": asked[0].tolist(), "quaternion_xyzw": asked[1].tolist()}
    found = http.post("/objects/thing/likelihood", json={"poses": body, "kernel": made["id"]}).json()
    np.testing.assert_allclose(found["log_density"], density.log_density(se3.Poses.of(*asked)), atol=2e-3)
    assert max(found["relative"]) <= 1
    info = http.get(f"/objects/thing/density?kernel={made['id']}").json()
    assert (info["size"], info["kernel"]["kind"], info["kernel"]["id"]) == (400, "sampled", made["id"])
    assert info["kernel"]["widths_m"] == pytest.approx(made["widths_m"])
    assert info["kernel"]["widths_m"][0] > info["kernel"]["widths_m"][1]

    best = http.get(f"/objects/thing/best-grasp?kernel={made['id']}&count=2").json()
    top = best["grasps"][0]
    assert top["relative"] == pytest.approx(1, abs=0.02)
    exact = density.log_density(se3.Poses.of([top["position"]], [top["quaternion_xyzw"]]))[0]
    assert top["log_density"] == pytest.approx(exact, abs=2e-3)
    assert top["log_density"] >= max(found["log_density"]) - 1e-3
    drawn = http.post("/objects/thing/samples", json={"count": 500, "seed": 3, "kernel": made["id"]}).json()
    p, q = np.array(drawn["position"]), np.array(drawn["quaternion_xyzw"])
    np.testing.assert_allclose(
        np.log(drawn["proposal_density"]), density.log_density(se3.Poses.of(p, q)), atol=2e-3
    )

    # Trials that come later are in the next answer, extended or weighted anew.
    more = ridges(50, seed=9)
    post(http, "thing", more, gripper="pg70", proposal_density=np.ones(50))
    every = np.concatenate([poses[0], more[0]]), np.concatenate([poses[1], more[1]])
    grown = as_sampled(made).placed(se3.Poses.of(*every), weights=np.concatenate([1.0 / g, np.ones(50)]))
    found = http.post("/objects/thing/likelihood", json={"poses": body, "kernel": made["id"]}).json()
    np.testing.assert_allclose(found["log_density"], grown.log_density(se3.Poses.of(*asked)), atol=2e-3)


def test_a_sampled_kernel_given_by_its_displacements(
    sqlite_http: httpx.Client, make_object: Make, post: Post
) -> None:
    http = sqlite_http
    make_object(http)
    poses = ridges(30)
    post(http, "thing", poses)
    parts = [{"mean": [0.01, 0.002, 0, 0, 0.2, 0.1]}, {"mean": [0.0] * 6, "weight": 3}]
    named = fit(
        http,
        kind="sampled",
        components=parts,
        component_widths={"sigma_position_m": 0.01, "sigma_rotation_deg": 15},
    )
    # The same said with covariances.
    covariance = diagonal(*[0.01] * 3, *[math.radians(15)] * 3)
    spelled = fit(http, kind="sampled", components=[{**part, "covariance": covariance} for part in parts])
    assert spelled["provenance"]["component_widths"] == pytest.approx(
        {"sigma_position_m": 0.01, "sigma_rotation_deg": 15}
    )
    body = {"position": poses[0].tolist(), "quaternion_xyzw": poses[1].tolist()}
    logs = [
        http.post("/objects/thing/likelihood", json={"poses": body, "kernel": k["id"]}).json()["log_density"]
        for k in (named, spelled)
    ]
    np.testing.assert_allclose(logs[0], logs[1], atol=1e-6)
    density = as_sampled(named).placed(se3.Poses.of(*poses))
    np.testing.assert_allclose(logs[0], density.log_density(se3.Poses.of(*poses)), atol=2e-3)


def test_sampled_kernels_are_bounded_and_checked(
    sqlite_http: httpx.Client, make_object: Make, post: Post
) -> None:
    http = sqlite_http
    make_object(http)
    rng = np.random.default_rng(0)
    post(http, "thing", (rng.normal(size=(1_200, 3)) * 0.1, se3.random_quaternions(1_200, rng)))
    parts = [{"mean": [*(rng.normal(size=3) * 0.01), 0, 0, 0]} for _ in range(900)]
    kernel = fit(http, kind="sampled", components=parts)["id"]
    for answer in (
        http.get(f"/objects/thing/density?kernel={kernel}"),
        http.get(f"/objects/thing/best-grasp?kernel={kernel}"),
        http.post("/objects/thing/samples", json={"count": 3, "kernel": kernel}),
    ):
        told = problem(answer, 413)
        assert told["type"].endswith("too-many-components")
        assert "kind anisotropic" in told["title"]
        assert "at most 833 components" in told["title"]

    def refused(**request: Any) -> list[str]:
        told = problem(http.post("/kernels", json=request), 422)
        return [error["field"] for error in told["errors"]]

    one = {"mean": [0.0] * 6}
    assert refused(kind="sampled", components=[one] * 5_001)
    assert refused(kind="sampled", components=[one], alignment="object") == ["alignment"]
    assert refused(kind="sampled", object="thing", components="auto") == ["components"]
    assert refused(object="thing", components=17) == ["components"]
    assert refused(components=[one]) == ["components.0.covariance"]
    assert refused(components=[{"covariance": diagonal(*[0.01] * 3, *[0.1] * 3)}] * 33) == ["components"]
    assert refused(kind="sampled", components=[{"mean": [5.0, 0, 0, 0, 0, 0]}]) == ["components.0.mean"]
    tilted = diagonal(0.01, 0.02, 0.01, 0.1, 0.1, 0.1)
    assert refused(kind="sampled", components=[{**one, "covariance": tilted}]) == ["components.0.covariance"]
    alike = [diagonal(*[0.01] * 3, *[0.1] * 3), diagonal(*[0.02] * 3, *[0.1] * 3)]
    assert refused(kind="sampled", components=[{**one, "covariance": c} for c in alike]) == [
        "components.1.covariance"
    ]
    told = problem(http.get(f"/objects/thing/reports/convergence?kernel={kernel}"), 413)
    assert told["type"].endswith("too-many-components")
