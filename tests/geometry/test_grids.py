"""Rotation and pose grids: counts, uniformity, symmetry, indices, and the subsample's permutation."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graspdb_geometry import grids
from graspdb_geometry.permutation import SeededPermutation

CONE = ((-0.04, -0.04, -0.2), (0.04, 0.04, 0.2))


def hopf_rotations(step_deg: float, *, symmetric: bool = False) -> grids.FloatArray:
    """Every rotation of a grid, or one of each pair that the jaw's half turn exchanges."""
    grid = grids.hopf_grid(float(step_deg))
    index = np.arange(grid.size)
    if symmetric:
        index = index[index % grid.psi_count < grid.psi_count // 2]
    return grid.quaternions(index)


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between all pairs of rotations."""
    return np.asarray(np.degrees(2 * np.arccos(np.clip(np.abs(a @ b.T), 0, 1))))


def test_fifteen_degrees_give_4608_rotations_spread_evenly() -> None:
    q = hopf_rotations(15)
    assert q.shape == (4608, 4)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-15)
    apart = angles_deg(q, q) + 360 * np.eye(len(q))
    nearest = apart.min(axis=1)
    assert nearest.min() > 12.6
    assert nearest.max() < 15.01
    # Covering radius, estimated from below by random rotations: random grids of this size leave 20 degrees.
    probe = np.random.default_rng(0).normal(size=(20_000, 4))
    probe /= np.linalg.norm(probe, axis=1, keepdims=True)
    # Of each only the angle to the nearest: an arc cosine of every pair takes 20 times as long.
    cosine = np.concatenate([np.abs(part @ q.T).max(axis=1) for part in np.split(probe, 20)])
    assert 12.0 < np.degrees(2 * np.arccos(np.minimum(cosine, 1))).max() < 13.6


@pytest.mark.parametrize("nside", [1, 2, 3, 4, 7])
def test_healpix_centres_are_equal_area_and_balanced(nside: int) -> None:
    z, phi = grids.healpix_centres(nside)
    assert z.shape == phi.shape == (12 * nside**2,)
    assert np.all((phi >= 0) & (phi < 2 * np.pi))
    s = np.sqrt(1 - z * z)
    directions = np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=1e-14)
    # Second moments of a uniform sphere: exact only in the limit.
    np.testing.assert_allclose(directions.T @ directions / len(z), np.eye(3) / 3, atol=0.5 / (12 * nside**2))
    assert len({tuple(np.round(d, 9)) for d in directions}) == len(z)


def test_healpix_nside_1_as_published() -> None:
    z, phi = grids.healpix_centres(1)
    np.testing.assert_allclose(z, [2 / 3] * 4 + [0] * 4 + [-2 / 3] * 4, atol=1e-15)
    np.testing.assert_allclose(phi[:4], np.pi / 4 * np.array([1, 3, 5, 7]))
    np.testing.assert_allclose(phi[4:8], np.pi / 2 * np.arange(4), atol=1e-15)


@pytest.mark.parametrize("step", [60, 30, 20, 15])
def test_closed_under_the_jaws_half_turn_and_one_of_each_pair_is_kept(step: float) -> None:
    grid = grids.hopf_grid(step)
    index = np.arange(grid.size)
    q = grid.quaternions(index)
    x, y, z, w = q.T
    turned = np.stack([y, -x, w, -z], axis=-1)  # q times the half turn about z
    twin = grid.twin(index)
    np.testing.assert_allclose(np.abs(np.sum(turned * q[twin], axis=1)), 1.0, atol=1e-14)
    assert np.array_equal(grid.twin(twin), index)
    kept = hopf_rotations(step, symmetric=True)
    assert len(kept) * 2 == grid.size
    kept_index = index[index % grid.psi_count < grid.psi_count // 2]
    np.testing.assert_array_equal(kept, q[kept_index])
    assert set(kept_index).isdisjoint(twin[kept_index])


def test_rotations_have_the_same_bits_in_any_array() -> None:
    grid = grids.hopf_grid(15.0)
    q = grid.quaternions(np.arange(grid.size))
    for i in (0, 1, 77, 4607):
        np.testing.assert_array_equal(grid.quaternions([i])[0], q[i])


@pytest.mark.parametrize("step", [0, -15, 0.5, 91, np.nan, np.inf])
def test_absurd_rotation_steps_are_refused(step: float) -> None:
    with pytest.raises(ValueError, match="rotation_step_deg"):
        hopf_rotations(step)
    with pytest.raises(ValueError, match="rotation_step_deg"):
        grids.PoseGrid(*CONE, rotation_step_deg=step)


def test_the_cones_grid_by_hand() -> None:
    grid = grids.PoseGrid(*CONE)
    assert grid.position_count == 13 * 13 * 45
    assert grid.full_total == 13 * 13 * 45 * 4608
    assert grid.total == 13 * 13 * 45 * 2304
    assert grid.volume_m3 == pytest.approx(13 * 13 * 45 * 1e-6)
    positions, _ = grid.poses([0, 4607, 4608, 45 * 4608, 13 * 45 * 4608, grid.full_total - 1])
    np.testing.assert_allclose(
        positions,
        [
            [-0.06, -0.06, -0.22],
            [-0.06, -0.06, -0.22],
            [-0.06, -0.06, -0.21],
            [-0.06, -0.05, -0.22],
            [-0.05, -0.06, -0.22],
            [0.06, 0.06, 0.22],
        ],
        atol=1e-15,
    )


def test_indices_are_ascending_unique_and_skip_the_twins() -> None:
    grid = grids.PoseGrid((0, 0, 0), (0.02, 0.01, 0.0), margin_m=0.0, rotation_step_deg=60)
    everything = grid.pose_indices(0, grid.total)
    expected = [p * 72 + pixel * 6 + psi for p in range(6) for pixel in range(12) for psi in range(3)]
    assert everything.tolist() == expected
    whole = grids.PoseGrid((0, 0, 0), (0.02, 0.01, 0), margin_m=0, rotation_step_deg=60, symmetric=False)
    assert whole.pose_indices(0, whole.total).tolist() == list(range(6 * 72))


def test_float32_rounding_of_the_box_does_not_drop_a_layer() -> None:
    box = tuple(tuple(float(np.float32(v)) for v in corner) for corner in CONE)
    assert grids.PoseGrid(*box).position_count == 13 * 13 * 45  # type: ignore[arg-type]


@settings(max_examples=60, deadline=None)
@given(
    corner=st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    size=st.tuples(*[st.floats(0, 0.15)] * 3),
    step=st.floats(0.005, 0.05),
    margin=st.floats(0, 0.05),
)
def test_positions_are_exactly_the_lattice_points_of_the_box(
    corner: Any, size: Any, step: float, margin: float
) -> None:
    upper = tuple(c + s for c, s in zip(corner, size, strict=True))
    ranges = []
    for low, high in zip(corner, upper, strict=True):
        # All multiples, by trying: the tolerance of a thousandth of a step is part of the definition.
        near = range(-60, 61)
        ranges.append(
            [k for k in near if low - margin - 1e-3 * step <= k * step <= high + margin + 1e-3 * step]
        )
    expected = list(itertools.product(*ranges))
    if not expected:
        with pytest.raises(ValueError, match="position_step_m"):
            grids.PoseGrid(corner, upper, step, 60, margin)
        return
    grid = grids.PoseGrid(corner, upper, step, 60, margin)
    assert grid.position_count == len(expected)
    positions, _ = grid.poses(np.arange(grid.position_count) * grid.rotation_count)
    np.testing.assert_allclose(positions, np.array(expected) * step, atol=1e-12)


def test_region_chooses_among_the_same_indices() -> None:
    region = ((-0.02, -1.0, 0.0), (0.03, 0.0, 0.05))
    whole = grids.PoseGrid(*CONE, position_step_m=0.02, rotation_step_deg=60)
    part = grids.PoseGrid(*CONE, position_step_m=0.02, rotation_step_deg=60, region=region)
    index = whole.pose_indices(0, whole.total)
    positions, _ = whole.poses(index)
    inside = np.all(
        (positions >= np.array(region[0]) - 1e-9) & (positions <= np.array(region[1]) + 1e-9), axis=1
    )
    np.testing.assert_array_equal(part.pose_indices(0, part.total), index[inside])
    assert part.full_total == whole.full_total
    assert part.volume_m3 == pytest.approx(part.position_count * 8e-6)
    with pytest.raises(ValueError, match="region"):
        grids.PoseGrid(*CONE, region=((1, 1, 1), (2, 2, 2)))


def test_subsamples_are_nested_prefixes_of_one_permutation_of_the_plan() -> None:
    def taken(count: int, seed: int) -> set[int]:
        grid = grids.PoseGrid(*CONE, position_step_m=0.05, rotation_step_deg=60, max_poses=count, seed=seed)
        chunks = [grid.pose_indices(a, min(a + 97, grid.total)) for a in range(0, grid.total, 97)]
        assert all(np.all(np.diff(chunk) > 0) for chunk in chunks)
        index = np.concatenate(chunks)
        assert len(index) == grid.total == len(set(index.tolist()))
        return set(index.tolist())

    whole = grids.PoseGrid(*CONE, position_step_m=0.05, rotation_step_deg=60)
    everything = set(whole.pose_indices(0, whole.total).tolist())
    assert taken(100, 1) < taken(1000, 1) < everything
    assert taken(10**9, 1) == everything
    assert taken(1000, 1) != taken(1000, 2)


def test_a_subsample_is_uniform_over_positions_and_rotations() -> None:
    grid = grids.PoseGrid(*CONE, max_poses=200_000, seed=11)
    positions, quaternions = grid.poses(grid.pose_indices(0, grid.total))
    # Standard errors: 0.22 / sqrt(3) / sqrt(2e5) m along z, 1 / sqrt(3 * 2e5) for a direction's component.
    assert abs(positions[:, 2].mean()) < 5 * 0.13 / np.sqrt(2e5)
    x, y, z, w = quaternions.T
    approach = np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=-1)
    assert np.all(np.abs(approach.mean(axis=0)) < 5 / np.sqrt(6e5))


@pytest.mark.parametrize(
    ("fields", "name"),
    [
        ({"position_step_m": 0.0}, "position_step_m"),
        ({"position_step_m": -0.01}, "position_step_m"),
        ({"position_step_m": np.nan}, "position_step_m"),
        ({"position_step_m": 5.0}, "position_step_m"),
        ({"position_step_m": 1e-4, "rotation_step_deg": 1.0, "margin_m": 10.0}, "position_step_m"),
        ({"margin_m": -0.001}, "margin_m"),
        ({"margin_m": np.inf}, "margin_m"),
        ({"margin_m": 11.0}, "margin_m"),
        ({"lower": (0.0, 0.0, np.nan)}, "lower"),
        ({"lower": (1.0, 1.0, 1.0)}, "lower"),
        ({"upper": (1e6, 1.0, 1.0)}, "upper"),
        ({"lower": (0.0, 0.0)}, "lower"),
        ({"region": ((0, 0, 0), (np.inf, 0, 0))}, "region"),
        ({"max_poses": 0}, "max_poses"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**63}, "seed"),
    ],
)
def test_bad_fields_are_named(fields: dict[str, Any], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        grids.PoseGrid(**({"lower": CONE[0], "upper": CONE[1]} | fields))


def test_ranges_and_indices_outside_are_refused() -> None:
    grid = grids.PoseGrid(*CONE)
    for start, stop in ((-1, 3), (5, 4), (0, grid.total + 1)):
        with pytest.raises(ValueError, match="start and stop"):
            grid.pose_indices(start, stop)
    for index in (-1, grid.full_total):
        with pytest.raises(ValueError, match="pose_index"):
            grid.poses([index])
    assert grid.pose_indices(7, 7).shape == (0,)


@settings(max_examples=60, deadline=None)
@given(size=st.integers(1, 3000), seed=st.integers(0, 2**63 - 1))
def test_the_permutation_is_a_bijection_with_random_access(size: int, seed: int) -> None:
    permutation = SeededPermutation(size, seed)
    image = permutation(np.arange(size))
    assert np.array_equal(np.sort(image), np.arange(size))
    some = np.random.default_rng(size).integers(size, size=20)
    np.testing.assert_array_equal(permutation(some), image[some])


@settings(max_examples=30, deadline=None)
@given(size=st.integers(2**40, 2**62), seed=st.integers(0, 2**63 - 1))
def test_the_permutation_of_huge_sets_stays_inside_and_injective(size: int, seed: int) -> None:
    image = SeededPermutation(size, seed)(np.arange(500))
    assert image.min() >= 0
    assert image.max() < size
    assert len(np.unique(image)) == 500


def test_the_permutation_never_changes() -> None:
    # Stored sweeps refer to these numbers: a different result here would silently rewrite their plans.
    assert SeededPermutation(1000, 0)([0, 1, 2, 999]).tolist() == [688, 260, 89, 684]
    assert SeededPermutation(17_521_920, 42)([0, 1, 2]).tolist() == [460013, 17359195, 10046838]


@pytest.mark.parametrize(("size", "seed"), [(0, 0), (2**62 + 1, 0), (5, -1), (5, 2**63)])
def test_permutation_limits(size: int, seed: int) -> None:
    with pytest.raises(ValueError):
        SeededPermutation(size, seed)
