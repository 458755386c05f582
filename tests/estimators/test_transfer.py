"""What other objects tell of one: right for objects that they never saw, doubted where they tell nothing."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import expit

from graspdb_density import se3
from graspdb_density.se3 import Poses
from graspdb_density.success.calibration import brier_skill
from graspdb_estimators import GraspFeatures, Lesson, Transfer, fit_transfer
from graspdb_geometry.closing import ClosingGeometry
from graspdb_geometry.collision import box_part
from known_jaws import PG70

Floats = NDArray[np.float64]
SIZES = ((0.14, 0.02), (0.2, 0.03), (0.16, 0.04), (0.18, 0.015), (0.22, 0.025))


def bar(length: float, width: float) -> GraspFeatures:
    """A bar along x, as wide as high."""
    vertices, faces = box_part((length / 2, width / 2, width / 2), (0, 0, 0), (0, 0, 0, 1))
    corners = np.asarray(vertices)[np.asarray(faces)]
    return GraspFeatures(ClosingGeometry(corners, np.zeros(3)), PG70)


def attempts(length: float, width: float, count: int, seed: int) -> tuple[Poses, Floats]:
    """Grasps from above, and how likely each holds: the likelier the nearer to the middle."""
    rng = np.random.default_rng(seed)
    p = np.stack(
        [
            rng.uniform(-0.45 * length, 0.45 * length, count),
            rng.normal(0, 0.003, count),
            rng.uniform(0.5 * width - 0.005, 0.5 * width + 0.015, count),
        ],
        axis=1,
    )
    turn = rng.normal(0, 0.2, count)
    about = np.stack([np.zeros(count), np.zeros(count), np.sin(turn / 2), np.cos(turn / 2)], axis=1)
    q = se3.normalise(se3.multiply(about, np.array([1.0, 0, 0, 0])))
    return Poses(p, q), expit((0.035 - np.abs(p[:, 0])) / 0.003)


def lesson(size: tuple[float, float], seed: int, *, shape: str = "", chance: float | None = None) -> Lesson:
    poses, truth = attempts(*size, 600, seed)
    rng = np.random.default_rng(seed + 100)
    held = rng.random(600) < (truth if chance is None else chance)
    closed = bar(*size).at(poses)[:, : len(bar(*size).closing.features(poses[:1], PG70)[0])]
    return Lesson(shape or str(size), poses, held.astype(float), np.ones(600), closed.astype(np.float32))


@pytest.fixture(scope="module")
def learned() -> Transfer:
    found = fit_transfer([lesson(size, seed) for seed, size in enumerate(SIZES)])
    assert found is not None
    return found


def test_an_object_nobody_tried_is_predicted(learned: Transfer) -> None:
    size = (0.17, 0.022)
    poses, truth = attempts(*size, 2_000, 50)
    p = learned.prior("another", bar(*size), poses)
    assert learned.better_untried
    assert np.mean(np.abs(p - truth)) < 0.1
    assert brier_skill(p, np.random.default_rng(0).random(2_000) < truth) > 0.6
    # What it says of its skill is of objects that it had not seen, either.
    assert learned.untried.skills[0] == pytest.approx(0.75, abs=0.15)


def test_an_object_that_taught_it_is_answered_by_the_others(learned: Transfer) -> None:
    shape = str(SIZES[0])
    left_out = fit_transfer([lesson(size, seed) for seed, size in enumerate(SIZES)])
    assert left_out is not None
    own = learned.trees_for(shape)
    assert own is not learned.stack.trees
    # Whatever this object's outcomes were, the trees for it are the same.
    told = [lesson(size, seed, chance=0.5 if size == SIZES[0] else None) for seed, size in enumerate(SIZES)]
    otherwise = fit_transfer(told)
    assert otherwise is not None
    features = told[0].closed
    np.testing.assert_array_equal(otherwise.trees_for(shape).logit(features), own.logit(features))


def test_copies_of_a_shape_are_left_out_together() -> None:
    copies = [lesson(SIZES[0], seed, shape="one") for seed in range(4)]
    assert fit_transfer(copies) is None
    found = fit_transfer([*copies, lesson(SIZES[1], 5), lesson(SIZES[2], 6)])
    assert found is not None
    assert found.objects == 3


def test_first_attempts_are_told_better_with_it(learned: Transfer) -> None:
    assert learned.better_with_few
    skill, of_kernel = learned.stack.left_out.skills
    assert skill > of_kernel + 0.05


def test_outcomes_that_no_shape_explains_are_not_believed() -> None:
    chances = (0.2, 0.8, 0.5, 0.7, 0.3)
    told = [
        lesson(size, seed, chance=chance)
        for seed, (size, chance) in enumerate(zip(SIZES, chances, strict=True))
    ]
    found = fit_transfer(told)
    assert found is not None
    assert not found.better_untried


def test_it_is_kept_as_it_was(learned: Transfer) -> None:
    again = Transfer.of_bytes(learned.to_bytes())
    features, (poses, _) = bar(*SIZES[1]), attempts(*SIZES[1], 100, 9)
    for shape in (str(SIZES[1]), "another"):
        np.testing.assert_array_equal(
            again.prior(shape, features, poses), learned.prior(shape, features, poses)
        )
    assert again.objects == learned.objects
    with pytest.raises(ValueError, match="no transfer"):
        Transfer.of_bytes(b"spoilt")
    with pytest.raises(ValueError, match="no transfer"):
        Transfer.of_bytes(learned.stack.to_bytes())
