"""Means under noise of the tool: a search in a wider density, and strategies led by few draws."""

from __future__ import annotations

import math
import threading

import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb_density import (
    GraspDensity,
    IsotropicKernel,
    ModeSearch,
    PoseNoise,
    Region,
    SuccessModel,
    expected,
    nearly_expected,
    se3,
)
from graspdb_density.se3 import Poses
from graspdb_density.search.start_ranking import CentreScores
from graspdb_density.search.strategies import Strategies

KERNEL = IsotropicKernel(0.012, math.radians(15))
Floats = NDArray[np.float64]


def clustered(seed: int, count: int = 400) -> GraspDensity:
    """Grasps about five poses, of unlike breadth."""
    rng = np.random.default_rng(seed)
    at = rng.integers(0, 5, count)
    middle, turned = rng.normal(size=(5, 3)) * 0.05, se3.random_quaternions(5, rng)
    breadth = np.array([0.2, 0.5, 1.0, 2.0, 3.0])[at][:, None]
    p = middle[at] + rng.normal(size=(count, 3)) * 0.006 * breadth
    q = se3.multiply(turned[at], se3.from_rotation_vector(rng.normal(size=(count, 3)) * 0.08 * breadth))
    return GraspDensity.build(Poses(p, q), kernel=KERNEL)


def exhaustive(score: object, density: GraspDensity, region: Region, seed: int) -> float:
    """The highest score from every centre and draws around them, uphill by random steps from the best."""
    rng = np.random.default_rng(seed)
    parts = [density.poses, density.sample(2_000, rng)]
    p, q, inside = region.project(*Poses.concatenate(parts))
    p, q = p[inside], q[inside]
    values = score(Poses(p, q))  # type: ignore[operator]
    top = np.argsort(-values)[:40]
    p, q, values = p[top], q[top], values[top]
    for step in np.repeat([0.5, 0.25, 0.12, 0.06], 12):
        moved = p + rng.standard_normal(p.shape) * step * KERNEL.sigma_position_m
        turns = se3.from_rotation_vector(rng.standard_normal(p.shape) * step * KERNEL.sigma_rotation)
        new_p, new_q, inside = region.project(moved, se3.multiply(q, turns))
        new = score(Poses(new_p, new_q))  # type: ignore[operator]
        better = inside & (new > values)
        p[better], q[better], values[better] = new_p[better], new_q[better], new[better]
    return float(values.max())


@pytest.mark.parametrize("seed", range(5))
def test_the_best_mean_is_where_the_wider_density_is_highest(seed: int) -> None:
    density = clustered(seed)
    region = Region([[0.0, 0.0, 1.0, 0.02]])
    search = ModeSearch(density)
    wider = search.widened(0.005, math.radians(4))
    (best,) = wider.maxima(region)
    mean = expected(density.density, tool_noise=PoseNoise(0.005, math.radians(4)), samples=1024)
    top = exhaustive(wider.density.density, density, region, seed)
    assert math.exp(best.log_density) >= 0.998 * top
    # And it is the mean by draws, but for their error and the kernel's form on rotations.
    at = Poses(best.position[None], best.quaternion_xyzw[None])
    assert math.exp(best.log_density) == pytest.approx(float(mean(at)[0]), rel=0.03)


def test_who_asks_alike_shares_the_wider_search() -> None:
    search = ModeSearch(clustered(0))
    held = search.nbytes
    wider = search.widened(0.005, 0.05)
    assert search.widened(0.005, 0.05) is wider
    assert search.nbytes >= held + wider.density.nbytes
    assert search.widened(0.004, 0.05) is not wider
    assert search.widened(0.0, 0.0) is search


@pytest.mark.parametrize("seed", range(3))
def test_strategies_led_by_few_draws_end_where_the_whole_mean_is_best(seed: int) -> None:
    density = clustered(seed)
    noise = PoseNoise(0.004, math.radians(2))
    score, leading, rough = (
        expected(density.density, object_noise=noise, samples=draws) for draws in (256, 32, 16)
    )
    found = ModeSearch(density).maxima(count=2, score=score, leading=leading, rough=rough)
    at = Poses(np.array([m.position for m in found]), np.array([m.quaternion_xyzw for m in found]))
    told = np.array([m.score for m in found])
    assert told == pytest.approx(score(at), rel=1e-9)
    assert (np.diff(told) <= 0.0).all()
    assert told[0] >= 0.995 * exhaustive(score, density, Region(), seed)


def chances() -> SuccessModel:
    """Attempts about the origin that succeed the likelier the farther along x."""
    rng = np.random.default_rng(0)
    p = rng.uniform(-0.04, 0.04, (6_000, 3))
    q = se3.from_rotation_vector(rng.normal(size=(len(p), 3)) * 0.2)
    won = rng.random(len(p)) < 0.5 + 10.0 * p[:, 0]
    return SuccessModel.build(Poses(p, q), won, kernel=KERNEL)


@pytest.mark.parametrize("wall", [-1.0, -0.006, 0.0])
def test_a_mean_is_nearly_the_share_that_is_free_times_the_mean_chance(wall: float) -> None:
    """Grasps before a wall that up to half of the draws run into."""
    model, noise = chances(), {"object_noise": PoseNoise(0.004, 0.03), "tool_noise": PoseNoise(0.002, 0.02)}

    def free(poses: Poses) -> NDArray[np.bool_]:
        return np.asarray(poses.positions[:, 1] > wall, dtype=bool)

    def product(poses: Poses) -> Floats:
        return np.where(free(poses), model.probability(poses), 0.0)

    rng = np.random.default_rng(1)
    at = Poses(rng.uniform(0.0, 0.02, (60, 3)), se3.from_rotation_vector(rng.normal(size=(60, 3)) * 0.1))
    exact = expected(product, samples=1024, **noise)(at)
    near = nearly_expected(model.probability, free, tested=256, valued=8, **noise)(at)
    np.testing.assert_allclose(near, exact, rtol=0.03 if wall < 0.0 else 0.08)
    # Where nothing is free nothing is expected.
    far = Poses(at.positions - [0.0, 5.0, 0.0], at.quaternions_xyzw)
    none = nearly_expected(model.probability, free, **noise)(far)
    assert (none == 0.0).all() or wall == -1.0


def test_attempts_within_fewer_widths_tell_nearly_the_same() -> None:
    model = chances()
    at = Poses(np.random.default_rng(1).uniform(-0.02, 0.02, (50, 3)), np.tile(se3.IDENTITY, (50, 1)))
    whole, near = model.probability(at), model.narrowed(3.5).probability(at)
    assert np.abs(whole - near).max() < 0.03
    assert np.abs(whole - near).max() > 0.0
    np.testing.assert_array_equal(model.narrowed(model.cutoff).probability(at), whole)


def test_strategies_learn_which_directions_are_narrow() -> None:
    """Two at once, each of its own narrow valley, of which only ranks are told."""
    strategies, which = Strategies(2, 0.4, 10), np.arange(2)
    goal = np.array([[0.5, -0.3, 0.2, 0.1, 0.0, -0.4], [-0.2, 0.4, 0.0, 0.3, -0.5, 0.1]])
    scale = np.array([1.0, 1.0, 10.0, 10.0, 3.0, 1.0])
    first, last = np.inf, np.inf
    for _ in range(120):
        tried = strategies.ask(which)
        lost = np.sum((scale * (tried - goal[:, None])) ** 2, axis=2)
        order = np.argsort(lost, axis=1)
        strategies.tell(which, np.take_along_axis(tried, order[..., None], axis=1))
        last = float(lost.min(axis=1).max())
        first = min(first, last)
    assert last < 1e-3


def test_searches_at_once_ask_for_each_centre_once_or_little_more() -> None:
    centres = Poses(np.random.default_rng(0).normal(size=(4_000, 3)), np.tile(se3.IDENTITY, (4_000, 1)))
    known, asked, lock = CentreScores(), [0], threading.Lock()

    def score(poses: Poses) -> Floats:
        with lock:
            asked[0] += len(poses)
        return np.asarray(poses.positions.sum(axis=1))

    rows, found = np.arange(100, 4_000), []
    threads = [
        threading.Thread(target=lambda: found.append(known.at(rows, centres, score))) for _ in range(6)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(values, centres.positions[rows].sum(axis=1)) for values in found)
    # What another was at meanwhile may be done twice: a block of 256 centres of each of the five others.
    assert asked[0] <= len(rows) + 6 * 5 * 256
    before = asked[0]
    np.testing.assert_array_equal(known.at(rows[:9], centres, score), found[0][:9])
    assert asked[0] == before
