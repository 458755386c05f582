"""What is said of a grasp's vicinity never goes beyond the pairs of trials that there are."""

from __future__ import annotations

import itertools
import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from degenerate_trials import KINDS, Trials
from graspdb_density import GraspDensity, IsotropicKernel, se3
from graspdb_density.se3 import Floats, Poses
from graspdb_density.vicinity.anisotropy import empirical_anisotropy
from graspdb_density.vicinity.displacement_bins import Anisotropy
from graspdb_density.vicinity.displacement_density import density_anisotropy
from graspdb_density.vicinity.half_width import LEAST_PAIRS, tolerances
from graspdb_density.vicinity.hypotheses import sharpened, wide_axes
from graspdb_density.vicinity.tried_range import tried_range

OFF_M, OFF = 0.005, math.radians(7.5)
STEP_M, STEP = 0.005, math.radians(7.5)
#: Bins either way of the profiles' middle ones.
BINS_M, BINS = 16, 12


def pair_ranges(trials: Trials) -> dict[str, tuple[float, float]]:
    """The farthest displacements from a success to any trial, by axis, the others within the limits.

    Pairs in a profile's middle bin do not count as displaced; beyond its last bin nothing is looked at.
    """
    poses = trials.poses
    ends = {axis: [0.0, 0.0] for axis in ("x", "y", "z", "rx", "ry", "rz")}

    def note(axis: str, amount: float, step: float, most: int) -> None:
        if 1 <= abs(math.floor(amount / step + 0.5)) <= most:
            ends[axis][0], ends[axis][1] = min(ends[axis][0], amount), max(ends[axis][1], amount)

    for a, b in itertools.product(np.flatnonzero(trials.won), range(len(poses))):
        if a == b:
            continue
        own, other = poses.quaternions_xyzw[a], poses.quaternions_xyzw[b]
        shift = poses.positions[b] - poses.positions[a]
        turn = min(se3.angle_between(own, other), se3.angle_between(own, se3.jaw_twin(other)))
        if turn <= OFF:
            at = se3.to_matrix(own).T @ shift
            for i, axis in enumerate("xyz"):
                if np.abs(np.delete(at, i)).max() <= OFF_M + 1e-9:
                    # The jaw's twin sees x and y mirrored.
                    for sign in (1.0,) if axis == "z" else (1.0, -1.0):
                        note(axis, sign * at[i], STEP_M, BINS_M)
        if np.linalg.norm(shift) > OFF_M:
            continue
        for one, end in itertools.product((own, se3.jaw_twin(own)), (other, se3.jaw_twin(other))):
            relative = se3.multiply(se3.conjugate(one), end)
            for i, axis in enumerate(("rx", "ry", "rz")):
                if relative[3] ** 2 + relative[i] ** 2 >= math.cos(0.5 * OFF) ** 2:
                    angle = 2.0 * math.atan2(relative[i], relative[3])
                    note(axis, (angle + math.pi) % (2.0 * math.pi) - math.pi, STEP, BINS)
    return {axis: (low, high) for axis, (low, high) in ends.items()}


def hold_to(found: Anisotropy, ranges: dict[str, tuple[float, float]]) -> None:
    """No half width reaches beyond the pairs, and one is at least so much where it ends with them."""
    for item in found.tolerances:
        low, high = ranges[item.axis]
        assert low - 1e-9 <= item.tried[0] <= 0.0 <= item.tried[1] <= high + 1e-9
        for end, reach in ((item.minus, -item.tried[0]), (item.plus, item.tried[1])):
            assert math.isnan(end) or end <= reach + 1e-9
        if not math.isnan(item.half_width):
            assert item.low <= item.high <= 0.5 * (item.tried[1] - item.tried[0]) + 1e-9
            assert not (item.beyond and item.within)
    for judged in wide_axes(found):
        assert math.isfinite(judged.ratio) or judged.verdict == "undecided"


def measured(trials: Trials) -> Anisotropy | None:
    """By pairs, without a warning; None where they are refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return empirical_anisotropy(trials.poses, trials.won)
        except ValueError:
            return None


@pytest.mark.parametrize("kind", KINDS)
@given(seed=st.integers(0, 10_000))
@settings(max_examples=4, deadline=None)
def test_half_widths_end_where_pairs_of_trials_do(kind: str, seed: int) -> None:
    trials = KINDS[kind](40, np.random.default_rng(seed))
    found = measured(trials)
    if found is None:
        assert kind in ("two trials", "all successes", "all failures", "huge")
        return
    ranges = pair_ranges(trials)
    hold_to(found, ranges)
    for item in found.tolerances:
        assert item.tried == pytest.approx(ranges[item.axis], abs=1e-9), item.axis


@pytest.mark.parametrize("kind", KINDS)
def test_the_smoothed_ones_do_too(kind: str) -> None:
    trials = KINDS[kind](60, np.random.default_rng(1))
    if trials.won.sum() < 20:
        return
    kernel = IsotropicKernel(OFF_M, OFF)
    successes = GraspDensity.build(trials.poses[np.flatnonzero(trials.won)], kernel=kernel)
    attempts = GraspDensity.build(trials.poses, kernel=kernel)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = density_anisotropy(
            successes,
            lambda poses: attempts.size * attempts.density(poses),
            tried=trials.poses,
            max_grasps=60,
        )
    hold_to(found, pair_ranges(trials))
    for item in found.tolerances:
        assert np.all((item.probability >= 0.0) & (item.probability <= 1.0))


def test_where_nobody_tried_the_smoothed_share_is_unknown() -> None:
    """All attempts succeed, along z and nowhere else: no share is below one, and none is told along x."""
    p = np.zeros((41, 3))
    p[:, 2] = np.linspace(0.0, 0.04, 41)
    q = np.tile(se3.IDENTITY, (41, 1))
    density = GraspDensity.build(Poses.of(p, q), kernel=IsotropicKernel(0.005, math.radians(10.0)))
    found = density_anisotropy(density, lambda at: density.size * density.density(at), tried=Poses.of(p, q))
    by = {item.axis: item for item in found.tolerances}
    assert by["z"].tried == pytest.approx((-0.04, 0.04))
    assert np.all(by["z"].probability > 0.9)
    assert by["z"].beyond
    assert by["x"].tried == (0.0, 0.0)
    assert math.isnan(by["x"].half_width)
    # Turned by a quarter about both axes.
    assert all(np.isnan(plane.probability[6, 6]) for plane in found.rotations)


def test_a_lower_bound_is_as_far_as_was_tried() -> None:
    """Successes within 30 mm along z, and failures elsewhere that pair with none of them."""
    p = np.zeros((40, 3))
    p[:30, 2] = np.linspace(0.0, 0.03, 30)
    p[30:, 0] = 1.0
    poses = Poses.of(p, np.tile(se3.IDENTITY, (40, 1)))
    found = empirical_anisotropy(poses, np.arange(40) < 30)
    z = next(item for item in found.tolerances if item.axis == "z")
    assert z.tried == pytest.approx((-0.03, 0.03))
    assert z.beyond
    assert z.half_width == pytest.approx(0.03)
    # A few pairs lie that far apart, of few grasps: the interval knows.
    assert z.low <= z.half_width
    assert {item.verdict for item in wide_axes(found)} == {"undecided"}


def test_a_few_pairs_tell_nothing() -> None:
    pairs = np.array([0, 0, 9, LEAST_PAIRS - 1, 5] * 3)
    value, weight = np.full((15, 3), 0.9), np.ones((15, 3), dtype=np.float32)
    moved = pairs * np.tile(np.arange(-2, 3), 3) * STEP_M
    found = tolerances(("x", "y", "z"), value, weight, pairs, moved, step=STEP_M, level=0.9)
    assert all(math.isnan(item.half_width) and math.isnan(item.minus) for item in found)
    assert all(item.plus == pytest.approx(2 * STEP_M) for item in found)
    assert not any(item.beyond for item in found)


def test_ranges_alone_confirm_nothing() -> None:
    """Where nothing fails along any axis, how far it was tried says nothing of what is forgiven."""
    side = np.arange(-3, 4) * 0.01
    p = np.stack(np.meshgrid(2.0 * side, 0.5 * side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    p = np.concatenate([p, p + np.array([5.0, 0.0, 0.0])])
    poses, won = Poses.of(p, np.tile(se3.IDENTITY, (len(p), 1))), np.arange(len(p)) < len(p) // 2
    axes = se3.to_matrix(se3.from_rotation_vector([0.0, 0.0, 0.5 * math.pi]))
    blurred = empirical_anisotropy(poses, won)
    aligned = empirical_anisotropy(poses, won, alignment="object", frames=axes)
    judged = [*wide_axes(blurred), sharpened(aligned, blurred)]
    assert {item.verdict for item in judged} == {"undecided"}
    assert {item.bound for item in judged if math.isfinite(item.ratio)} == {"both"}


def test_where_the_nearest_trials_fail_the_width_is_less_than_that() -> None:
    """Along y even the nearest trials, 20 mm away, fail; along x 20 mm hold: x forgives at least as much."""
    side = np.arange(-3, 4) * 0.02
    p = np.stack(np.meshgrid(side, side, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    won = np.abs(p[:, 1]) < 0.01
    p, won = np.repeat(p, 3, axis=0), np.repeat(won, 3)
    found = empirical_anisotropy(Poses.of(p, np.tile(se3.IDENTITY, (len(p), 1))), won)
    by = {item.axis: item for item in found.tolerances}
    assert by["y"].within
    assert by["y"].nearest == pytest.approx(0.02)
    assert by["y"].half_width < 0.02
    x_wide = wide_axes(found)[0]
    assert x_wide.bound == "lower"
    assert x_wide.ratio == pytest.approx(by["x"].half_width / 0.02)


def test_the_range_of_pairs_is_the_brute_force_one() -> None:
    rng = np.random.default_rng(3)
    p, q = rng.uniform(-0.02, 0.02, (80, 3)), se3.from_rotation_vector(rng.normal(size=(80, 3)) * 0.4)
    poses = Poses.of(p, q)
    axes: Floats = se3.to_matrix(q)
    found = tried_range(
        poses,
        poses,
        axes,
        off_axis_m=OFF_M,
        off_axis=0.3,
        reach_m=0.03,
        reach=1.0,
        twins=False,
        mirrored=True,
    )
    along, about = np.zeros((3, 2)), np.zeros((3, 2))
    for a, b in itertools.permutations(range(80), 2):
        t = axes[a].T @ (p[b] - p[a])
        r = se3.multiply(se3.conjugate(q[a]), q[b])
        for i in range(3):
            beside = np.abs(np.delete(t, i)).max() <= OFF_M and se3.angle_between(q[a], q[b]) <= 0.3
            if beside and abs(t[i]) <= 0.03:
                along[i] = np.maximum(along[i], [-t[i], t[i]])
            if np.linalg.norm(t) <= OFF_M and r[3] ** 2 + r[i] ** 2 >= math.cos(0.15) ** 2:
                angle = 2.0 * math.atan(r[i] / r[3])
                if abs(angle) <= 1.0:
                    about[i] = np.maximum(about[i], [-angle, angle])
    along[:2] = along[:2].max(axis=1, keepdims=True)
    np.testing.assert_allclose(found.along, along, atol=1e-9)
    np.testing.assert_allclose(found.about, about, atol=1e-9)
