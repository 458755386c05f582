"""Kernels along edges and pairs of surfaces, used on other objects, and kernels that predict success."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graspdb_density import AnisotropicKernel, DiagonalKernel, MixtureDensity, SuccessModel, se3
from graspdb_density.se3 import Poses
from graspdb_geometry.features.jaw_pairs import pairs_of_mesh
from graspdb_geometry.features.ridges import ridges_of_mesh
from graspdb_geometry.poses import ToolPoses

#: A fit does not depend on the database; what is refused and kept is tested on both.
ONCE = pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)

Floats = NDArray[np.float64]
Pair = tuple[Floats, Floats]
Post = Callable[..., dict[str, Any]]
Make = Callable[..., str]
PutBox = Callable[..., Any]

SIZE, OTHER = (0.02, 0.04, 0.16), (0.15, 0.03, 0.03)


def box(size: tuple[float, float, float]) -> tuple[Floats, NDArray[np.int64]]:
    import trimesh

    made = trimesh.creation.box(extents=size)
    return np.asarray(made.vertices), np.asarray(made.faces, dtype=np.int64)


def grasps(count: int, seed: int = 0) -> Pair:
    """From -x, all along the bar, at any of a few rolls: long along its edges, whatever the gripper's."""
    rng = np.random.default_rng(seed)
    side = Rotation.from_matrix(np.stack([[0, 0, 1], [0, -1, 0], [1, 0, 0]], axis=-1))
    rolls = np.radians(np.array([-75, -40, -5, 20, 50])[rng.integers(5, size=count)])
    q = (side * Rotation.from_rotvec(np.outer(rolls, [0, 0, 1]))).as_quat()
    q = se3.multiply(q, se3.from_rotation_vector(rng.normal(size=(count, 3)) * [0.05, 0.2, 0.05]))
    p = np.column_stack(
        [
            -0.012 + rng.normal(size=count) * 0.003,
            0.011 + rng.normal(size=count) * 0.003,
            rng.uniform(-0.07, 0.07, count),
        ]
    )
    return p, se3.normalise(q)


def made(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 201, answer.text
    body: dict[str, Any] = answer.json()
    return body


def ok(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 200, answer.text
    body: dict[str, Any] = answer.json()
    return body


def problem(answer: httpx.Response, status: int) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    body: dict[str, Any] = answer.json()
    return body


def expected(kernel: dict[str, Any], poses: Pair, size: tuple[float, float, float], at: Pair) -> Floats:
    """The density under a stored kernel by the maths, its frames from the box's own geometry."""
    ridges = ridges_of_mesh(*box(size))
    if kernel["alignment"] == "edge":
        frames = ridges.frames(poses[0])
    else:
        frames = pairs_of_mesh(*box(size), ridges, watertight=True, opening_m=0.07).frames(ToolPoses(*poses))
    own = np.isfinite(frames).all(axis=(1, 2))
    assert 0 < own.sum() < len(own)
    frames = np.where(own[:, None, None], frames, se3.to_matrix(poses[1]))
    parts = kernel["components"]
    shape = AnisotropicKernel(
        [c["weight"] for c in parts], [c["mean"] for c in parts], [c["covariance"] for c in parts], "fixed"
    )
    density = MixtureDensity(se3.Poses.of(*poses), kernel=shape, frames=frames)
    return np.exp(density.log_density(se3.Poses.of(*at)))


@ONCE
@pytest.mark.parametrize("alignment", ["edge", "surface-pair"])
def test_fitted_along_its_edges_and_used_on_another(
    http: httpx.Client, make_object: Make, post: Post, put_box: PutBox, alignment: str
) -> None:
    for slug, size in (("thing", SIZE), ("other", OTHER)):
        make_object(http, slug)
        put_box(http, slug, size)
    p, q = grasps(500)
    # A few at nothing, along the gripper's own axes.
    p[:25, 2] += 0.3
    post(http, "thing", (p, q), gripper="pg70")
    kernel = made(http.post("/kernels", json={"object": "thing", "alignment": alignment}))
    assert (kernel["alignment"], kernel["gripper"]) == (alignment, "pg70")
    source = kernel["provenance"]
    assert (source["origin"], source["object"], source["successes"]) == ("fitted", "thing", 500)
    along = made(http.post("/kernels", json={"object": "thing"}))
    if alignment == "edge":
        assert kernel["widths_m"][0] > 2 * kernel["widths_m"][1]
        assert source["log_likelihood"] > along["provenance"]["log_likelihood"]

    def asked(slug: str, at: Pair) -> Floats:
        body = {
            "poses": {"position": at[0].tolist(), "quaternion_xyzw": at[1].tolist()},
            "kernel": kernel["id"],
            "include": ["density"],
        }
        return np.array(ok(http.post(f"/objects/{slug}/likelihood", json=body))["density"])

    at = p[100:130] + 0.002, q[100:130]
    np.testing.assert_allclose(asked("thing", at), expected(kernel, (p, q), SIZE, at), rtol=2e-3)
    # On the other object frames are those of its own edges; further grasps extend the density.
    turned = p[:, [2, 1, 0]] * [1.0, 1.0, 1.5], q
    post(http, "other", (turned[0][:300], turned[1][:300]), gripper="pg70")
    at = turned[0][100:130] + 0.002, turned[1][100:130]
    asked("other", at)
    post(http, "other", (turned[0][300:], turned[1][300:]), gripper="pg70")
    np.testing.assert_allclose(asked("other", at), expected(kernel, turned, OTHER, at), rtol=2e-3)
    best = ok(http.get(f"/objects/other/best-grasp?kernel={kernel['id']}&collision_free=false"))
    assert best["status"] == "ok"
    assert best["kernel"]["alignment"] == alignment
    # An object without geometry can't tell its edges.
    make_object(http, "bare")
    post(http, "bare", (p, q), gripper="pg70")
    told = problem(http.get(f"/objects/bare/density?kernel={kernel['id']}"), 409)
    assert told["type"].endswith("mesh-missing")


def test_convergence_under_an_aligned_kernel(
    sqlite_url: str, serve: Callable[..., str], make_object: Make, post: Post, put_box: PutBox
) -> None:
    http = httpx.Client(base_url=serve(sqlite_url, report_wait_s=60), timeout=90)
    make_object(http)
    put_box(http, "thing", SIZE)
    post(http, "thing", grasps(400), gripper="pg70")
    kernel = made(http.post("/kernels", json={"object": "thing", "alignment": "edge"}))
    for matching in ("determinants", "likelihood"):
        body = ok(http.get(f"/objects/thing/reports/convergence?kernel={kernel['id']}&matching={matching}"))
        own, matched = body["curves"]
        assert (own["kernel"]["alignment"], matched["kernel"]["kind"]) == ("edge", "isotropic")
        if matching == "determinants":
            assert own["points"][-1]["log_likelihood"] > matched["points"][-1]["log_likelihood"]
        else:
            assert body["matched"] is True


def test_aligned_kernels_that_are_none(http: httpx.Client, make_object: Make, post: Post) -> None:
    make_object(http)
    post(http, "thing", grasps(60), gripper="pg70")
    told = problem(http.post("/kernels", json={"object": "thing", "alignment": "edge"}), 409)
    assert told["type"].endswith("mesh-missing")
    spread = np.diag(np.square([0.02, 0.006, 0.01, 0.1, 0.3, 0.1]))
    given = {"alignment": "edge", "components": [{"covariance": spread.tolist()}]}
    assert made(http.post("/kernels", json=given))["widths_m"][0] == pytest.approx(0.02)
    spread[0, 2] = spread[2, 0] = 5e-5
    given["components"] = [{"covariance": spread.tolist()}]
    assert "no sign" in str(problem(http.post("/kernels", json=given), 422)["errors"])
    several = {"object": "thing", "alignment": "edge", "components": 2}
    assert "no sign" in str(problem(http.post("/kernels", json=several), 422)["errors"])


# -- what predicts success


def field(count: int, seed: int) -> tuple[Pair, NDArray[np.bool_]]:
    """Success changes within millimetres along the gripper's x and within centimetres along y."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(-0.08, 0.08, (count, 3))
    q = se3.from_rotation_vector(rng.normal(size=(count, 3)) * 0.1)
    chance = 0.5 + 0.45 * np.sin(2 * math.pi * p[:, 0] / 0.048)
    return (p, q), rng.random(count) < chance


@ONCE
def test_a_kernel_that_predicts_success_is_used_for_that_alone(
    http: httpx.Client, make_object: Make, post: Post
) -> None:
    make_object(http)
    (p, q), won = field(6_000, 0)
    told = ["success" if w else "missed" for w in won]
    post(http, "thing", (p, q), told, gripper="pg70")
    kernel = made(http.post("/kernels", json={"object": "thing", "kind": "probability"}))
    source = kernel["provenance"]
    assert (kernel["kind"], kernel["gripper"], source["attempts"]) == ("probability", "pg70", 6_000)
    assert source["log_loss"] < source["isotropic_log_loss"]
    assert source["brier_skill"] > source["isotropic_brier_skill"] + 0.02
    assert kernel["widths_m"][1] > 1.5 * kernel["widths_m"][0]

    def asked(at: Pair, **more: Any) -> dict[str, Any]:
        poses = {"position": at[0].tolist(), "quaternion_xyzw": at[1].tolist()}
        return ok(http.post("/objects/thing/likelihood", json={"poses": poses, **more}))

    at = field(200, 5)[0]
    plain, by = asked(at), asked(at, kernel=kernel["id"])
    assert by["kernel"]["kind"] == "probability"
    assert by["kernel"]["widths_m"] == kernel["widths_m"]
    # The density is the default one.
    np.testing.assert_allclose(by["density"], plain["density"], rtol=1e-6)
    widths = [*kernel["widths_m"], *np.radians(kernel["widths_deg"])]
    model = SuccessModel.build(Poses.of(p, q), won, kernel=DiagonalKernel.of(widths))
    found = model.evaluate(Poses.of(*at))
    told = np.array(by["support"]["enough"])
    assert told.sum() > 40
    likely, low, other = (
        np.array(column, dtype=np.float64)
        for column in (by["success_probability"], by["interval"]["low"], plain["success_probability"])
    )
    np.testing.assert_allclose(likely[told], found.probability[told], atol=1e-4)
    np.testing.assert_allclose(low[told], found.low[told], atol=1e-3)
    truth = 0.5 + 0.45 * np.sin(2 * math.pi * at[0][:, 0] / 0.048)
    both = told & np.isfinite(other)
    errors = [np.mean((chances[both] - truth[both]) ** 2) for chances in (likely, other)]
    assert errors[0] < 0.8 * errors[1]
    # What comes later counts, and searches rank by it.
    first = int(np.flatnonzero(told)[0])
    post(
        http,
        "thing",
        tuple(column[first : first + 1].repeat(30, 0) for column in at),
        "missed",
        gripper="pg70",
    )
    assert asked(at, kernel=kernel["id"])["success_probability"][first] < likely[first]
    best = ok(http.get(f"/objects/thing/best-grasp?objective=success_probability&kernel={kernel['id']}"))
    assert math.sin(2 * math.pi * best["grasps"][0]["position"][0] / 0.048) > 0.5
    # Calibration judges what it predicts.
    judged = ok(http.get(f"/objects/thing/reports/calibration?kernel={kernel['id']}"))
    every = ok(http.get("/objects/thing/reports/calibration"))
    assert judged["kernel"]["id"] == kernel["id"]
    assert judged["auc_density"] == pytest.approx(every["auc_density"])
    assert judged["brier"] != pytest.approx(every["brier"], rel=1e-3)
    # It shapes no density, so it is not what anisotropic means.
    assert problem(http.get("/objects/thing/density?kernel=anisotropic"), 409)


@ONCE
def test_success_predicted_along_the_object_s_own_axes(
    http: httpx.Client, make_object: Make, post: Post, put_box: PutBox
) -> None:
    make_object(http)
    make_object(http, "bare")
    put_box(http, "thing", (0.02, 0.04, 0.16))
    rng = np.random.default_rng(4)
    # Beside the object, where nothing collides; grippers point every way.
    p = rng.uniform([0.46, -0.04, -0.04], [0.54, 0.04, 0.04], (5_000, 3))
    q = se3.from_rotation_vector(rng.normal(size=(len(p), 3)) * 0.6)
    won = rng.random(len(p)) < 0.5 + 0.45 * np.sin(2 * math.pi * p[:, 1] / 0.04)
    for slug in ("thing", "bare"):
        post(http, slug, (p, q), ["success" if w else "missed" for w in won], gripper="pg70")
    request = {"object": "thing", "kind": "probability"}
    along = made(http.post("/kernels", json={**request, "alignment": "object"}))
    gripper = made(http.post("/kernels", json=request))
    assert (along["alignment"], gripper["alignment"]) == ("object", "gripper")
    assert along["provenance"]["log_loss"] < gripper["provenance"]["log_loss"] - 0.01
    # The longest way first: z, y, x.
    assert along["widths_m"][1] < 0.6 * min(along["widths_m"][0], along["widths_m"][2])
    at = {"position": p[:50].tolist(), "quaternion_xyzw": q[50:100].tolist()}
    asked = {"poses": at, "kernel": along["id"]}
    found = ok(http.post("/objects/thing/likelihood", json=asked))
    assert found["kernel"]["alignment"] == "object"
    widths = [*along["widths_m"], *np.radians(along["widths_deg"])]
    model = SuccessModel.build(Poses.of(p, q), won, kernel=DiagonalKernel.of(widths, np.eye(3)[::-1]))
    expected = model.evaluate(Poses.of(p[:50], q[50:100])).probability
    likely, told = np.array(found["success_probability"], dtype=np.float64), found["support"]["enough"]
    assert sum(told) >= 10
    np.testing.assert_allclose(likely[told], expected[told], atol=1e-4)
    judged = ok(http.get(f"/objects/thing/reports/calibration?kernel={along['id']}"))
    assert judged["kernel"]["id"] == along["id"]
    # Another object needs a shape to have such axes.
    told = problem(http.post("/objects/bare/likelihood", json=asked), 409)
    assert "PUT /objects/bare/mesh" in told["title"]
    problem(http.post("/kernels", json={**request, "object": "bare", "alignment": "object"}), 409)


def test_predictors_that_are_none(http: httpx.Client, make_object: Make, post: Post) -> None:
    make_object(http)
    (p, q), won = field(300, 1)
    post(http, "thing", (p[:60], q[:60]), ["success" if w else "missed" for w in won[:60]], gripper="pg70")
    told = problem(http.post("/kernels", json={"object": "thing", "kind": "probability"}), 409)
    assert "at least 50 successes and 50 failures" in told["title"]

    def refused(**request: Any) -> str:
        return str(problem(http.post("/kernels", json={"kind": "probability", **request}), 422)["errors"])

    spread = np.diag(np.square([0.02, 0.006, 0.01, 0.1, 0.3, 0.1]))
    one = {"covariance": spread.tolist()}
    given = made(http.post("/kernels", json={"kind": "probability", "components": [one]}))
    assert given["widths_m"] == pytest.approx([0.02, 0.006, 0.01])
    assert "one component" in refused(components=[one, one])
    assert "no mean" in refused(components=[{**one, "mean": [0.01, 0, 0, 0, 0, 0]}])
    spread[1, 2] = spread[2, 1] = 1e-5
    assert "diagonal" in refused(components=[{"covariance": spread.tolist()}])
    assert "alignment=gripper or alignment=object" in refused(object="thing", alignment="edge")
    assert "no window" in refused(object="thing", window={"position_m": 0.03})
    assert "one component" in refused(object="thing", components=3)
