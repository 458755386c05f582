"""Where an object is believed to be: the grasp that is best on average over that."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import httpx
import numpy as np
import pytest

from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_density.search.pose_noise import expected_over, normal_displacements

DOWN = (1.0, 0.0, 0.0, 0.0)
WIDTHS = {"sigma_position_m": 0.004, "sigma_rotation_deg": 8}


@pytest.fixture
def thing(
    sqlite_http: httpx.Client, make_object: Callable[..., str], post: Callable[..., Any], clusters: Any
) -> httpx.Client:
    """A sharp peak of successes, and beside it a broad one, less high."""
    make_object(sqlite_http)
    sharp = clusters([((0, 0, 0), DOWN)], 200, sigma_m=0.001)
    broad = clusters([((0.1, 0, 0), DOWN)], 1_500, sigma_m=0.012)
    both = tuple(np.concatenate(pair) for pair in zip(sharp, broad, strict=True))
    post(sqlite_http, "thing", both)
    return sqlite_http


def best(http: httpx.Client, **asked: Any) -> dict[str, Any]:
    answer = http.post("/objects/thing/best-grasp", json={**WIDTHS, **asked})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_an_exact_pose_takes_the_peak_and_a_doubtful_one_the_broad_success(thing: httpx.Client) -> None:
    mean = [0.5, 0, 0, 0, 0, 0, 1]
    (sharp,) = best(thing, object_pose=mean)["grasps"]
    assert abs(sharp["position"][0]) < 0.01
    covariance = np.diag([0.02**2] * 3 + [0.01**2] * 3).tolist()
    answer = best(thing, object_pose={"mean": mean, "covariance": covariance})
    (robust,) = answer["grasps"]
    assert answer["ranking"]["objective"] == "robust"
    assert answer["ranking"]["pose_noise"] == "the covariance of the object's pose"
    assert abs(robust["position"][0] - 0.1) < 0.02
    assert robust["world"]["position"][0] == pytest.approx(0.5 + robust["position"][0])


def test_weighted_poses_are_averaged_by_their_weights(thing: httpx.Client) -> None:
    poses = [[0.5, y, 0, 0, 0, 0, 1] for y in (0.0, 0.03)]
    (alone,) = best(thing, object_pose={"poses": poses, "weights": [1, 0]})["grasps"]
    assert abs(alone["position"][0]) < 0.01
    (between,) = best(thing, object_pose={"poses": poses})["grasps"]
    # The sharp peak of one of the two: half as good as if it were surely there.
    assert between["score"] == pytest.approx(0.5 * alone["score"], rel=0.1)


def test_a_kept_question_is_asked_again_as_it_was(thing: httpx.Client) -> None:
    poses = [[0.5, y, 0, 0, 0, 0, 1] for y in (0.0, 0.03)]
    asked = best(thing, object_pose={"poses": poses})
    kept = thing.get(f"/answers/{asked['answer']}").json()["question"]
    assert kept["object_belief"]["poses"] == poses
    assert best(thing, **kept)["answer"] == asked["answer"]


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"object_pose": {"mean": [0, 0, 0, 0, 0, 0, 1]}}, "covariance"),
        ({"object_pose": {"covariance": np.eye(6).tolist()}}, "mean"),
        ({"object_pose": {"poses": []}}, "poses"),
        ({"object_pose": {"poses": [[0, 0, 0, 0, 0, 0, 1]], "weights": [1, 2]}}, "weights"),
        (
            {"object_pose": {"poses": [[0, 0, 0, 0, 0, 0, 1]]}, "objective": "density"},
            "leave objective out",
        ),
        ({"object_pose": {"poses": [[0, 0, 0, 0, 0, 0, 1]]}, "pose_noise_m": 0.01}, "leave the noise out"),
    ],
)
def test_what_is_no_belief_is_refused(thing: httpx.Client, asked: dict[str, Any], told: str) -> None:
    answer = thing.post("/objects/thing/best-grasp", json=asked)
    assert answer.status_code == 422, answer.text
    assert told in answer.text


def test_the_mean_over_displacements_is_their_weighted_mean() -> None:
    rng = np.random.default_rng(0)
    there = Poses(rng.normal(size=(5, 3)), se3.random_quaternions(5, rng))
    weights = rng.uniform(size=5)
    weights /= weights.sum()

    def value(poses: Poses) -> Any:
        return np.exp(-np.sum(poses.positions**2, axis=1)) * poses.quaternions_xyzw[:, 0] ** 2

    asked = Poses(rng.normal(size=(7, 3)), se3.random_quaternions(7, rng))
    wanted = np.zeros(7)
    for k in range(5):
        p, q = se3.compose(Poses(there.positions[k], there.quaternions_xyzw[k]), asked)
        wanted += weights[k] * value(Poses(p, q))
    assert np.allclose(expected_over(value, there, weights)(asked), wanted)


def test_draws_have_the_covariance_that_was_asked_for() -> None:
    root = np.random.default_rng(1).normal(size=(6, 6))
    covariance = root @ root.T
    drawn = normal_displacements(covariance, 4096)
    assert np.allclose(np.cov(drawn.T), covariance, atol=0.05 * np.abs(covariance).max())
    with pytest.raises(ValueError, match="eigenvalue"):
        normal_displacements(np.diag([1.0, 1, 1, 1, 1, -1]), 4)
