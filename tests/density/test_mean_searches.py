"""Means under noise of the tool: a search in a wider density, and strategies led by few draws."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb_density import GraspDensity, IsotropicKernel, ModeSearch, PoseNoise, Region, expected, se3
from graspdb_density.se3 import Poses

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
