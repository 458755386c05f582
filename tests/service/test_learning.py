"""Success probabilities that are learned: in the background, shared by replicas, only where better."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import expit
from sqlalchemy import func, select, update

from graspdb_density import se3
from graspdb_service.storage.database import Database
from graspdb_service.storage.tables import learned_estimators

#: What is learned does not depend on the database; how it is kept does, and is tested on both.
ONCE = pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Poses = tuple[Floats, Floats]
Serve = Callable[..., str]
Eventually = Callable[..., Any]
Post = Callable[..., dict[str, Any]]
PutBox = Callable[..., Any]

SIZE = (0.14, 0.02, 0.02)


def attempts(count: int, seed: int) -> tuple[Poses, Bools]:
    """Grasps of a bar along x from above; they hold the likelier the nearer to its middle they close."""
    rng = np.random.default_rng(seed)
    p = np.stack(
        [rng.uniform(-0.06, 0.06, count), rng.normal(0, 0.004, count), rng.uniform(0.011, 0.02, count)],
        axis=1,
    )
    turn = rng.normal(0, 0.2, count)
    about_z = np.stack([np.zeros(count), np.zeros(count), np.sin(turn / 2), np.cos(turn / 2)], axis=1)
    held = rng.random(count) < expit((0.03 - np.abs(p[:, 0])) / 0.002)
    return (p, se3.normalise(se3.multiply(about_z, np.array([1.0, 0, 0, 0])))), held


def tell(http: httpx.Client, post: Post, count: int, seed: int) -> dict[str, Any]:
    poses, held = attempts(count, seed)
    outcomes = ["success" if won else "slipped" for won in held]
    return post(http, "bar", poses, outcomes, gripper="pg70")


def ask(http: httpx.Client, poses: Poses, **more: Any) -> dict[str, Any]:
    body = {"poses": {"position": poses[0].tolist(), "quaternion_xyzw": poses[1].tolist()}, **more}
    answer = http.post("/objects/bar/likelihood", json=body)
    answer.raise_for_status()
    found: dict[str, Any] = answer.json()
    return found


def off(answer: dict[str, Any], held: Bools) -> float:
    """Brier's score of an answer."""
    p = np.array([math.nan if value is None else value for value in answer["success_probability"]])
    assert np.isfinite(p).mean() > 0.8
    return float(np.nanmean((p - held) ** 2))


def learned(http: httpx.Client, eventually: Eventually, poses: Poses) -> dict[str, Any]:
    """The answer once it is learned."""

    def ready() -> Any:
        answer = ask(http, poses)
        return answer if answer["estimator"]["state"] == "ready" else None

    found: dict[str, Any] = eventually(ready, seconds=120)
    return found


@pytest.fixture
def bar(database_url: str, serve: Serve, put_box: PutBox) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=serve(database_url, learned_estimates=True), timeout=60) as http:
        http.post("/objects", json={"id": "bar"}).raise_for_status()
        put_box(http, "bar", SIZE)
        yield http


@ONCE
def test_from_enough_attempts_it_is_learned_and_better(
    bar: httpx.Client, database_url: str, serve: Serve, post: Post, eventually: Eventually
) -> None:
    asked, held = attempts(400, seed=1)
    tell(bar, post, 40, seed=2)
    few = ask(bar, asked)["estimator"]
    assert (few["name"], few["state"], few["recalibrated"]) == ("kernel", "ready", False)
    batch = tell(bar, post, 400, seed=3)["batch"]
    first = ask(bar, asked)
    assert first["estimator"]["name"] == "kernel"
    assert first["estimator"]["state"] == "fitting"
    then = learned(bar, eventually, asked)
    told = then["estimator"]
    assert (told["name"], told["recalibrated"], told["attempts"]) == ("stack", True, 440)
    assert told["skill"] > told["kernel_skill"]
    assert off(then, held) < off(first, held)
    assert then["answer"] != first["answer"]
    # Every other answer names it, too, and the best grasp is ranked by it.
    for path, body in (("best-grasp", {"objective": "success_probability"}), ("best-grasp", {})):
        best = bar.post(f"/objects/bar/{path}", json=body).json()
        assert best["estimator"] == told
        grasp = best["grasps"][0]
        again = ask(bar, (np.array([grasp["position"]]), np.array([grasp["quaternion_xyzw"]])))
        assert again["success_probability"][0] == pytest.approx(grasp["success_probability"])
    # Who tells of poses far from every attempt is said where that was asked.
    alone = told | {"prior": None}
    assert bar.get("/objects/bar/density").json()["estimator"] == alone
    _judged(bar, alone)
    # Another replica, or this one restarted, has it at once.
    with httpx.Client(base_url=serve(database_url, learned_estimates=True), timeout=60) as there:
        other = ask(there, asked)
        assert other["estimator"] == told
        assert other["success_probability"] == then["success_probability"]
        # A service that may not learn answers by kernels.
        with httpx.Client(base_url=serve(database_url), timeout=60) as plain:
            assert ask(plain, asked)["success_probability"] == first["success_probability"]
    # What is gone must not have taught anything: the kernel estimate answers until it is learned again.
    bar.delete(f"/objects/bar/batches/{batch}").raise_for_status()
    tell(bar, post, 300, seed=4)
    assert ask(bar, asked)["estimator"]["name"] == "kernel"
    assert learned(bar, eventually, asked)["estimator"]["attempts"] == 340


def test_it_is_kept_up(bar: httpx.Client, post: Post, eventually: Eventually) -> None:
    asked, _ = attempts(50, seed=1)
    tell(bar, post, 400, seed=2)
    assert learned(bar, eventually, asked)["estimator"]["attempts"] == 400
    # A few more are told by what is known; of many more it is learned again, and answers meanwhile.
    tell(bar, post, 40, seed=3)
    assert ask(bar, asked)["estimator"]["attempts"] == 400
    tell(bar, post, 200, seed=4)
    assert ask(bar, asked)["estimator"]["name"] == "stack"
    eventually(lambda: ask(bar, asked)["estimator"]["attempts"] == 640, seconds=120)


@ONCE
def test_without_a_shape_the_kernel_estimate_is_set_right_or_left(
    database_url: str, serve: Serve, post: Post, eventually: Eventually
) -> None:
    with httpx.Client(base_url=serve(database_url, learned_estimates=True), timeout=60) as http:
        http.post("/objects", json={"id": "bar"}).raise_for_status()
        tell(http, post, 600, seed=2)
        asked, held = attempts(400, seed=1)
        before = ask(http, asked)
        then = learned(http, eventually, asked)
        assert then["estimator"]["name"] == "kernel"
        assert off(then, held) <= off(before, held) + 1e-3


def test_what_can_not_be_read_is_learned_again_and_nothing_outlives_its_object(
    bar: httpx.Client, database_url: str, serve: Serve, post: Post, eventually: Eventually
) -> None:
    asked, _ = attempts(50, seed=1)
    tell(bar, post, 300, seed=2)
    told = learned(bar, eventually, asked)["estimator"]
    database = Database(database_url)
    eventually(lambda: _kept(database) == 1)
    with database.write() as tx:
        tx.execute(update(learned_estimators).values(content=b"spoilt"))
    with httpx.Client(base_url=serve(database_url, learned_estimates=True), timeout=60) as there:
        assert ask(there, asked)["estimator"]["state"] == "fitting"
        assert learned(there, eventually, asked)["estimator"] == told
    bar.delete("/objects/bar").raise_for_status()
    assert _kept(database) == 0
    database.dispose()


def _kept(database: Database) -> int:
    with database.read() as tx:
        return int(tx.execute(select(func.count()).select_from(learned_estimators)).scalar_one())


def _judged(http: httpx.Client, told: dict[str, Any]) -> None:
    """The report says how well what was learned predicts, by blocks that it had not seen."""
    report = http.get("/objects/bar/reports/calibration").json()
    found = report["learned"]
    assert found["estimator"] == told
    assert found["skill"]["value"] == pytest.approx(told["skill"], abs=1e-3)
    assert found["skill"]["low"] < found["skill"]["value"] < found["skill"]["high"]
    assert found["judged"] == sum(item["count"] for item in found["bins"]) == 440
    assert 0.5 < found["told_share"] <= 1.0
    assert found["coverage"] is None or found["coverage"] > 0.5
    assert "Brier skill" in report["text"]
    assert "learned" in report["text"]
