"""Densities on a plane: against draws, against the closed form, and what the filters let through."""

from __future__ import annotations

import math

import numpy as np
import pytest

from graspdb_density import AnisotropicKernel, GraspDensity, IsotropicKernel, MixtureDensity, se3
from graspdb_density.se3 import Poses
from graspdb_density.statistics.plane_marginal import Marginal, Orientation, Plane, marginal

KERNEL = IsotropicKernel(0.012, math.radians(14.0))
PLANE = Plane.facing(np.array([1.0, -2.0, 0.5]))
SIDE = Orientation(
    approach=np.array([0.0, 0.0, -1.0]),
    approach_cone=math.radians(50.0),
    direction=np.array([1.0, 0.0, 0.0]),
    direction_cone=math.radians(40.0),
)


@pytest.fixture(scope="module")
def density() -> GraspDensity:
    """300 grasps roughly from above, of unequal weights, half of them of a jaw without symmetry."""
    rng = np.random.default_rng(0)
    turns = se3.from_rotation_vector(rng.normal(size=(300, 3)) * 0.4)
    down = se3.multiply(np.array([1.0, 0.0, 0.0, 0.0]), turns)
    return GraspDensity.build(
        Poses.of(rng.uniform(-0.1, 0.1, (300, 3)), se3.normalise(down)),
        kernel=KERNEL,
        weights=rng.uniform(0.5, 2.0, 300),
        symmetric=np.arange(300) % 2 == 0,
    )


def on_grid(found: Marginal, p: np.ndarray, plane: Plane) -> np.ndarray:
    """Points (n, 3) counted in the cells of a projection, as a density of all of them."""
    counts, _, _ = np.histogram2d(
        p @ plane.across, p @ plane.upward, bins=(found.across_edges, found.upward_edges)
    )
    return np.asarray(counts)


def area(found: Marginal) -> float:
    return float(np.diff(found.across_edges)[0] * np.diff(found.upward_edges)[0])


def test_a_plane_has_right_handed_axes_and_z_upwards() -> None:
    for normal in ([0, -1, 0], [1, 0, 0], [0, 0, 1], [0, 0, -1], [3, -4, 12]):
        plane = Plane.facing(np.array(normal, dtype=float))
        axes = np.stack([plane.across, plane.upward, plane.normal])
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        assert plane.upward[2] >= 0.0
    np.testing.assert_allclose(Plane.facing(np.array([0.0, -1.0, 0.0])).across, [1, 0, 0], atol=1e-12)


def test_one_grasp_is_a_gaussian_on_the_plane() -> None:
    one = GraspDensity.build(Poses.of([[0.01, 0.02, 0.03]], [[0, 0, 0, 1]]), kernel=KERNEL)
    found = marginal(one, PLANE, Orientation())
    at = np.array([0.01, 0.02, 0.03])
    u = 0.5 * (found.across_edges[1:] + found.across_edges[:-1]) - at @ PLANE.across
    v = 0.5 * (found.upward_edges[1:] + found.upward_edges[:-1]) - at @ PLANE.upward
    s = KERNEL.sigma_position_m
    expected = np.exp(-(u[:, None] ** 2 + v[None, :] ** 2) / (2 * s * s)) / (2 * math.pi * s * s)
    # The reach ends at three standard deviations: what would lie beyond is cut off.
    np.testing.assert_allclose(found.value, expected, atol=0.01 * expected.max())
    assert found.share == pytest.approx(1.0)
    for profile, offset in zip(found.profiles, (u, v), strict=True):
        line = np.exp(-(offset**2) / (2 * s * s)) / (math.sqrt(2 * math.pi) * s)
        np.testing.assert_allclose(profile.value, line, atol=0.01 * line.max())


@pytest.mark.parametrize("orientation", [Orientation(), SIDE])
def test_it_is_what_draws_from_the_density_show(density: GraspDensity, orientation: Orientation) -> None:
    found = marginal(density, PLANE, orientation)
    p, q = density.sample(400_000, np.random.default_rng(1))
    passed = orientation.holds(q)
    drawn = on_grid(found, p[passed], PLANE)
    assert found.share == pytest.approx(passed.mean(), abs=4e-3)
    assert found.value.sum() * area(found) == pytest.approx(found.share, rel=0.02)
    assert found.passing == int(orientation.holds(density.quaternions_xyzw).sum())
    # Cells joined four by four: their counts spread by their root.
    expected = found.value * area(found) * len(p)
    shape = tuple(4 * (n // 4) for n in expected.shape)
    coarse = [
        table[: shape[0], : shape[1]].reshape(shape[0] // 4, 4, shape[1] // 4, 4).sum(axis=(1, 3))
        for table in (drawn, expected)
    ]
    busy = coarse[1] > 400
    assert busy.sum() > 100
    off = np.abs(coarse[0][busy] / coarse[1][busy] - 1.0)
    assert off.max() < 0.25
    assert off.mean() < 0.05
    for profile in found.profiles:
        assert (profile.low <= profile.value).all()
        assert (profile.value <= profile.high).all()


def test_directions_pass_either_way_and_approaches_do_not() -> None:
    turned = se3.jaw_twin(np.array([[0.0, 0.0, 0.0, 1.0]]))
    along = Orientation(direction=np.array([1.0, 0.0, 0.0]))
    assert along.holds(np.array([[0.0, 0.0, 0.0, 1.0]])).all()
    assert along.holds(turned).all()
    up = Orientation(approach=np.array([0.0, 0.0, 1.0]))
    assert up.holds(turned).all()
    assert not up.holds(np.array([[1.0, 0.0, 0.0, 0.0]])).any()
    assert not Orientation(direction=np.array([0.0, 0.0, 1.0])).holds(turned).any()


@pytest.mark.parametrize("orientation", [Orientation(), SIDE])
def test_a_gaussian_alike_in_all_directions_is_the_isotropic_kernel(
    density: GraspDensity, orientation: Orientation
) -> None:
    covariance = np.diag([KERNEL.sigma_position_m**2] * 3 + [KERNEL.sigma_rotation**2] * 3)
    mixture = MixtureDensity(
        Poses.of(density.positions, density.quaternions_xyzw),
        kernel=AnisotropicKernel.gaussian(covariance),
        weights=density.weights,
        symmetric=density.symmetric,
    )
    computed, drawn = (marginal(each, PLANE, orientation) for each in (density, mixture))
    assert (computed.drawn, drawn.drawn > 100_000) == (0, True)
    assert drawn.share == pytest.approx(computed.share, abs=6e-3)
    for one, other in zip(computed.profiles, drawn.profiles, strict=True):
        again = np.interp(one.at, other.at, other.value)
        assert np.abs(again - one.value).max() < 0.06 * one.value.max()


def test_fewer_grasps_have_wider_intervals(density: GraspDensity) -> None:
    few = GraspDensity.build(Poses.of(density.positions[:40], density.quaternions_xyzw[:40]), kernel=KERNEL)
    many, one = marginal(density, PLANE, SIDE), marginal(few, PLANE, SIDE)
    assert one.share_high - one.share_low > 1.5 * (many.share_high - many.share_low)
    assert many.share_low < many.share < many.share_high


def test_one_far_grasp_leaves_the_picture_as_it_was() -> None:
    rng = np.random.default_rng(0)
    p, q = rng.normal(scale=0.02, size=(200, 3)), se3.random_quaternions(201, rng)
    alone = marginal(GraspDensity.build(Poses.of(p, q[:200]), kernel=KERNEL), PLANE, Orientation())
    far = np.concatenate([p, [[20.0, 5.0, 3.0]]])
    found = marginal(GraspDensity.build(Poses.of(far, q), kernel=KERNEL), PLANE, Orientation())
    assert (found.outside, alone.outside) == (1, 0)
    np.testing.assert_allclose(found.across_edges, alone.across_edges, atol=1e-9)
    np.testing.assert_allclose(found.value, alone.value * 200 / 201, rtol=1e-6, atol=1e-6 * alone.value.max())
    assert found.share == pytest.approx(1.0)
    assert found.value.sum() * area(found) == pytest.approx(200 / 201, abs=0.01)
    for item, other in zip(found.profiles, alone.profiles, strict=True):
        np.testing.assert_allclose(item.value, other.value * 200 / 201, rtol=1e-6, atol=1e-6)


def test_cells_wider_than_the_kernel_hold_the_same_share() -> None:
    """Two grasps 9 m apart: no smoothing is left to do."""
    p = np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    density = GraspDensity.build(Poses.of(p, np.tile(se3.IDENTITY, (2, 1))), kernel=KERNEL)
    found = marginal(density, Plane.facing(np.array([0.0, -1.0, 0.0])), Orientation())
    assert found.outside == 0
    assert found.value.sum() * area(found) == pytest.approx(1.0)
    step = float(np.diff(found.profiles[0].at)[0])
    assert found.profiles[0].value.sum() * step == pytest.approx(1.0)
    assert np.all(np.isfinite(found.profiles[1].high))
