"""Conditional success by displacement against brute force and objects whose answer is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import brute_force
from graspdb_density import GraspDensity, IsotropicKernel, se3
from graspdb_density._compiled.pairs import composition_angles
from graspdb_density.se3 import Floats, Poses
from graspdb_density.vicinity import pair_candidates
from graspdb_density.vicinity.anisotropy import empirical_anisotropy
from graspdb_density.vicinity.displacement_bins import PLANES, Alignment, Bins, Frames, Histogram
from graspdb_density.vicinity.displacement_density import density_anisotropy
from graspdb_density.vicinity.half_width import tolerances

AXES = {"rx": np.eye(3)[0], "ry": np.eye(3)[1], "rz": np.eye(3)[2]}
HALF_M = np.array([0.05, 0.03, 0.02])
HALF_TURN = math.radians(40.0)


@dataclass(frozen=True)
class Trials:
    positions: Floats
    quaternions: Floats
    success: np.ndarray
    rotation_keys: np.ndarray
    position_keys: np.ndarray

    def parts(self) -> tuple[Poses, np.ndarray]:
        return Poses.of(self.positions, self.quaternions), self.success


def _about(axis: str, angle: Floats | float) -> Floats:
    return se3.from_rotation_vector(np.multiply.outer(np.asarray(angle), AXES[axis]))


@pytest.fixture(scope="module")
def box() -> Trials:
    """Success inside a box of positions and for turns about the gripper's y of less than 40 degrees.

    With A uniform in an interval of half width h, a displacement by d stays inside with chance 1 - d / 2h:
    one half at d = h.
    """
    side = np.arange(-10, 11) * 0.01
    grid = np.stack(np.meshgrid(side, side[4:-4], side[4:-4], indexing="ij"), axis=-1).reshape(-1, 3)
    turns = np.radians(np.arange(-180, 180, 10))
    base = se3.from_rotation_vector([0.3, -0.2, 0.5])
    rotations = se3.multiply(base, _about("ry", turns))
    position_keys, rotation_keys = (
        k.ravel() for k in np.meshgrid(np.arange(len(grid)), np.arange(len(turns)), indexing="ij")
    )
    p = grid[position_keys]
    inside = np.all(np.abs(p) < HALF_M - 0.001, axis=1) & (np.abs(turns[rotation_keys]) < HALF_TURN + 0.01)
    return Trials(p, rotations[rotation_keys], inside, rotation_keys, position_keys)


def _scattered(count: int, rng: np.random.Generator) -> Trials:
    """Trials in clumps of nearly equal rotations or positions, so that pairs by tolerance exist."""
    group = rng.integers(6, size=count)
    p = rng.uniform(-0.06, 0.06, (count, 3))
    q = se3.random_quaternions(6, rng)[group]
    near = rng.random(count) < 0.5
    q[near] = se3.multiply(
        q[near], se3.from_rotation_vector(rng.standard_normal((int(near.sum()), 3)) * 0.05)
    )
    still = rng.random(count) < 0.4
    p[still] = p[0] + rng.standard_normal((int(still.sum()), 3)) * 0.002
    q[still] = se3.random_quaternions(int(still.sum()), rng)
    success = rng.random(count) < 0.4
    return Trials(p, q, success, group, group)


# -- compositions


@given(
    st.sampled_from([0, 1, 2]),
    st.floats(-math.pi, math.pi),
    st.floats(-math.pi, math.pi),
    st.floats(0.0, 0.3),
    st.integers(0, 1_000),
)
@settings(max_examples=100, deadline=None)
def test_composition_angles_are_the_nearest(
    plane: int, alpha: float, beta: float, off: float, seed: int
) -> None:
    first, second = PLANES[plane]
    exact = se3.multiply(_about(first, alpha), _about(second, beta))
    axis = np.random.default_rng(seed).standard_normal(3)
    q = se3.multiply(exact, se3.from_rotation_vector(off * axis / np.linalg.norm(axis)))
    a, b, sine = composition_angles(q, plane)
    found = se3.multiply(_about(first, a), _about(second, b))
    away = float(se3.angle_between(found, q))
    assert math.sin(away) == pytest.approx(sine, abs=1e-6)
    assert away <= off + 1e-6
    for step in (1e-3, -1e-3):
        for other in (
            se3.multiply(_about(first, a + step), _about(second, b)),
            se3.multiply(_about(first, a), _about(second, b + step)),
        ):
            assert away <= float(se3.angle_between(other, q)) + 1e-9
    if off == 0.0:
        np.testing.assert_allclose(
            np.exp(1j * np.array([a, b])), np.exp(1j * np.array([alpha, beta])), atol=1e-6
        )


def test_the_mirror_is_half_turns_about_x_and_y() -> None:
    a, b, sine = composition_angles(se3.JAW_TURN, 0)
    assert sine < 1e-12
    assert abs(a) == pytest.approx(math.pi)
    assert abs(b) == pytest.approx(math.pi)


# -- brute force


def _brute_translations(
    trials: Trials, frames: Floats, tolerance: float, mirror: bool
) -> tuple[Floats, Floats]:
    """Tried and won (5, 9, 9) by loops over matrices."""
    tried, won = np.zeros((5, 9, 9)), np.zeros((5, 9, 9))
    turns = Rotation.from_quat(trials.quaternions)
    half = Rotation.from_euler("z", 180, degrees=True)
    for i in np.flatnonzero(trials.success):
        relative = turns[int(i)].inv() * turns
        angle = np.minimum(relative.magnitude(), (relative * half).magnitude())
        t = (trials.positions - trials.positions[i]) @ frames[i]
        for j in np.flatnonzero(angle <= tolerance):
            for sign in (1.0, -1.0) if mirror else (1.0,):
                x, y, z = t[j] * [sign, sign, 1.0]
                if j != i and max(abs(x), abs(y), abs(z)) <= 0.04:
                    bin_ = (
                        int((z + 0.04) // 0.016),
                        int((x + 0.04) / 0.08 * 9),
                        int((y + 0.04) / 0.08 * 9),
                    )
                    tried[bin_] += 1
                    won[bin_] += trials.success[j]
    return tried, won


def _brute_rotations(trials: Trials, reach: float, tolerance: float) -> tuple[Floats, Floats]:
    """Tried and won (3, 24, 24): the nearest composition by search over Euler angles in scipy."""
    tried, won = np.zeros((3, 24, 24)), np.zeros((3, 24, 24))
    turns = Rotation.from_quat(trials.quaternions)
    half = Rotation.from_euler("z", 180, degrees=True)
    for i in np.flatnonzero(trials.success):
        near = np.linalg.norm(trials.positions - trials.positions[i], axis=1) <= reach
        for j in np.flatnonzero(near):
            if j == i:
                continue
            relative = turns[int(i)].inv() * turns[int(j)]
            for variant in (relative, relative * half, half * relative, half * relative * half):
                for plane, names in enumerate(PLANES):
                    a, b, _ = composition_angles(se3.canonical(variant.as_quat()), plane)
                    found = Rotation.from_rotvec(a * AXES[names[0]]) * Rotation.from_rotvec(
                        b * AXES[names[1]]
                    )
                    if (found.inv() * variant).magnitude() <= tolerance:
                        x, y = (round((v + math.pi) / math.radians(15.0)) % 24 for v in (a, b))
                        tried[plane, x, y] += 1
                        won[plane, x, y] += trials.success[j]
    return tried, won


def _same(histograms: tuple[Histogram, ...], tried: Floats, won: Floats) -> None:
    for histogram, n, s in zip(histograms, tried, won, strict=True):
        np.testing.assert_array_equal(histogram.count, n)
        known = n > 0
        np.testing.assert_allclose(histogram.probability[known], s[known] / n[known], atol=1e-6)
        assert np.all(np.isnan(histogram.probability[~known]))


@pytest.mark.parametrize("alignment", ["gripper", "object", "edge", "surface-pair"])
def test_pairs_by_tolerance_equal_brute_force(alignment: Alignment) -> None:
    rng = np.random.default_rng(1)
    trials = _scattered(110, rng)
    tolerance = math.radians(7.5)
    frames: Frames | None = None
    aligned = int(trials.success.sum())
    used = se3.to_matrix(trials.quaternions)
    if alignment == "object":
        frames = se3.to_matrix(se3.random_quaternions(1, rng))[0]
        used = np.broadcast_to(frames, (110, 3, 3))
    elif alignment != "gripper":
        own = se3.to_matrix(se3.random_quaternions(110, rng))
        own[::3] = np.nan
        used = np.where(np.isnan(own), used, own)
        aligned = int(np.isfinite(own[trials.success, 0, 0]).sum())
        frames = own
        if alignment == "surface-pair":

            def frames(at: Poses) -> Floats:
                return own[[int(np.flatnonzero((trials.positions == x).all(1))[0]) for x in at.positions]]

            trials = replace(trials, positions=trials.positions + np.arange(110)[:, None] * 1e-9)
    got = empirical_anisotropy(*trials.parts(), alignment=alignment, frames=frames)
    _same(got.translations, *_brute_translations(trials, used, tolerance, alignment != "object"))
    _same(got.rotations, *_brute_rotations(trials, 0.005, tolerance))
    assert got.grasps == trials.success.sum()
    assert got.aligned == aligned


def test_jaws_without_symmetry_have_no_twins() -> None:
    trials = _scattered(120, np.random.default_rng(2))
    one = empirical_anisotropy(*trials.parts(), symmetric=False)
    twin = np.random.default_rng(3).random(120) < 0.5
    q = np.where(twin[:, None], se3.jaw_twin(trials.quaternions), trials.quaternions)
    with_twins = [
        empirical_anisotropy(Poses.of(trials.positions, each), trials.success)
        for each in (trials.quaternions, q)
    ]
    for a, b in zip(with_twins[0].rotations, with_twins[1].rotations, strict=True):
        np.testing.assert_array_equal(a.count, b.count)
        np.testing.assert_allclose(a.probability, b.probability)
    for a, b in zip(with_twins[0].translations, with_twins[1].translations, strict=True):
        np.testing.assert_array_equal(a.count, b.count)
    assert sum(h.count.sum() for h in one.rotations) < sum(h.count.sum() for h in with_twins[0].rotations)


def test_keys_on_a_grid_agree_with_tolerances(box: Trials) -> None:
    keyed = empirical_anisotropy(
        *box.parts(), rotation_keys=box.rotation_keys, position_keys=box.position_keys, max_grasps=40
    )
    # Ten degrees apart, so that 7.5 degrees reach the same rotation only.
    free = empirical_anisotropy(*box.parts(), max_grasps=40, max_candidates=10**9)
    for a, b in zip(keyed.translations + keyed.rotations, free.translations + free.rotations, strict=True):
        np.testing.assert_array_equal(a.count, b.count)
        np.testing.assert_allclose(a.probability, b.probability)


@given(st.integers(0, 500), st.floats(0.02, 0.6))
@settings(max_examples=25, deadline=None)
def test_candidates_miss_nothing(seed: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    p, q = rng.uniform(-0.05, 0.05, (300, 3)), se3.random_quaternions(300, rng)
    grasps = rng.permutation(300)[:20].astype(np.int64)
    reach = angle / 20.0
    turned, moved = (
        pair_candidates.near_rotations(q, grasps, angle),
        pair_candidates.near_positions(p, grasps, reach),
    )
    for a, i in enumerate(grasps):
        away = np.minimum(se3.angle_between(q[i], q), se3.angle_between(q[i], se3.jaw_twin(q)))
        for found, wanted in (
            (turned, np.flatnonzero(away <= angle)),
            (moved, np.flatnonzero(np.linalg.norm(p - p[i], axis=1) <= reach)),
        ):
            runs = found.runs[found.first[a] : found.first[a + 1]]
            rows = np.concatenate([found.order[b:e] for b, e in runs])
            assert len(set(rows)) == len(rows) == found.lengths()[a]
            assert set(wanted) <= set(rows)


# -- what is known


def test_tolerances_of_a_box(box: Trials) -> None:
    got = empirical_anisotropy(
        *box.parts(),
        rotation_keys=box.rotation_keys,
        position_keys=box.position_keys,
        alignment="object",
        frames=np.eye(3),
        max_grasps=1_500,
    )
    by_axis = {t.axis: t for t in got.tolerances}
    # Of 9, 5 and 3 positions in a row, half are left after moving by 4.5, 2.5 and 1.5 steps.
    for axis, expected in (("x", 0.045), ("y", 0.025), ("z", 0.015)):
        t = by_axis[axis]
        assert t.half_width == pytest.approx(expected, abs=0.004)
        assert t.low <= t.half_width <= t.high
        assert t.high - t.low < 0.01
        assert not t.beyond
        assert t.minus == pytest.approx(t.plus, abs=0.008)
    assert by_axis["ry"].half_width == pytest.approx(HALF_TURN + math.radians(5.0), abs=math.radians(5.0))
    # Only turns about y were tried: the others are unknown, not failures.
    for axis in ("rx", "rz"):
        assert math.isnan(by_axis[axis].half_width)
        assert not by_axis[axis].count.any()


def test_the_object_s_frame_sharpens_what_the_gripper_s_blurs(box: Trials) -> None:
    keys = {"rotation_keys": box.rotation_keys, "position_keys": box.position_keys}
    along = empirical_anisotropy(*box.parts(), **keys, alignment="object", frames=np.eye(3))
    blurred = empirical_anisotropy(*box.parts(), **keys)
    longest = [max(t.half_width for t in r.tolerances[:3]) for r in (along, blurred)]
    shortest = [min(t.half_width for t in r.tolerances[:3]) for r in (along, blurred)]
    assert longest[0] > longest[1] + 0.005
    assert longest[0] / shortest[0] > 1.5 * longest[1] / shortest[1]


def test_gripper_histograms_have_the_jaw_s_symmetry(box: Trials) -> None:
    got = empirical_anisotropy(*box.parts(), rotation_keys=box.rotation_keys, position_keys=box.position_keys)
    for histogram in got.translations:
        np.testing.assert_allclose(histogram.probability, histogram.probability[::-1, ::-1], atol=1e-6)
    plane = got.rotations[0]
    centres = 0.5 * (plane.edges[0][1:] + plane.edges[0][:-1])
    zero, turned = int(np.argmin(np.abs(centres))), int(np.argmin(np.abs(centres + math.pi)))
    # Rx(180) Ry(180 + b) is the mirror of Ry(b): what holds about 0 holds there.
    ten = int(np.argmin(np.abs(centres - math.radians(15.0))))
    back = int(np.argmin(np.abs(centres + math.radians(165.0))))
    assert plane.probability[turned, back] == pytest.approx(plane.probability[zero, ten], abs=0.05)
    assert plane.probability[zero, ten] > 0.7


def test_intervals_hold_the_value_and_shrink_with_grasps(box: Trials) -> None:
    keys = {"rotation_keys": box.rotation_keys, "position_keys": box.position_keys}
    few, many = (empirical_anisotropy(*box.parts(), **keys, max_grasps=n) for n in (40, 640))
    width = []
    for report in (few, many):
        middle = report.translations[2]
        known = np.isfinite(middle.probability)
        assert np.all(middle.low[known] <= middle.probability[known])
        assert np.all(middle.probability[known] <= middle.high[known])
        width.append(np.nanmean((middle.high - middle.low)[1:-1, 1:-1]))
    assert width[1] < 0.4 * width[0]


def test_intervals_over_grasps_cover(box: Trials) -> None:
    """Against nearly all successes as A: intervals from samples of 60 cover about as often as they say."""
    keys = {"rotation_keys": box.rotation_keys, "position_keys": box.position_keys}
    every = {"alignment": "object", "frames": np.eye(3)}
    truth = empirical_anisotropy(*box.parts(), **keys, **every, max_grasps=3_000, max_candidates=10**9)
    target = truth.translations[2].probability[6, 4]
    hits = 0
    for seed in range(40):
        found = empirical_anisotropy(*box.parts(), **keys, **every, max_grasps=60, seed=seed).translations[2]
        hits += found.low[6, 4] <= target <= found.high[6, 4]
    assert 30 <= hits <= 40


def test_weights_choose_whose_vicinity_counts(box: Trials) -> None:
    keys = {"rotation_keys": box.rotation_keys, "position_keys": box.position_keys}
    left = box.positions[:, 0] < -0.03
    kept = box.success & left
    got = empirical_anisotropy(
        *box.parts(), **keys, alignment="object", frames=np.eye(3), weights=kept.astype(float)
    )
    x = got.tolerances[0]
    assert x.plus > x.minus + 0.03


@pytest.fixture(scope="module")
def densities(box: Trials) -> tuple[GraspDensity, GraspDensity]:
    p, q, success = box.positions, box.quaternions, box.success
    near = np.max(np.abs(p) - HALF_M, axis=1) < 0.05
    kernel = IsotropicKernel(0.006, math.radians(8.0))
    return (
        GraspDensity.build(Poses.of(p[success], q[success]), kernel=kernel),
        GraspDensity.build(Poses.of(p[near], q[near]), kernel=kernel),
    )


def test_smoothed_ranks_the_axes_of_a_box(densities: tuple[GraspDensity, GraspDensity]) -> None:
    """The kernel's smoothing takes from P near the rim, so widths come out smaller but in order."""
    successes, attempts = densities
    layout = Bins(across=3, slices=1, angles=8, reach_m=0.08, profile_m=0.01)
    got = density_anisotropy(
        successes,
        lambda at: attempts.size * attempts.density(at),
        alignment="object",
        frames=np.eye(3),
        bins=layout,
        max_grasps=60,
    )
    assert got.method == "density"
    x, y, z = (t.half_width for t in got.tolerances[:3])
    assert 0.6 * 0.045 < x < 0.05
    assert 0.5 * 0.025 < y < 0.03
    assert 0.4 * 0.015 < z < 0.02
    assert x > y > z
    assert all(t.low <= t.half_width <= t.high for t in got.tolerances[:3])
    assert all(
        np.all((h.probability >= 0.0) & (h.probability <= 1.0)) for h in got.translations + got.rotations
    )


def test_smoothed_is_the_mean_of_the_definition(densities: tuple[GraspDensity, GraspDensity]) -> None:
    """At hardly any displacement, against the float64 reference with A's row removed."""
    successes, attempts = densities
    rho = 3.0 * float(
        np.median(attempts.size * attempts.density(Poses(successes.positions, successes.quaternions_xyzw)))
    )
    layout = Bins(across=1, slices=1, angles=2, reach_m=1e-6, profile_m=1e-6, reach=1e-6, profile=1e-6)
    got = density_anisotropy(successes, rho, bins=layout, max_grasps=successes.size)
    p, q, n = successes.positions, successes.quaternions_xyzw, successes.size
    share = []
    for row in range(0, n, 7):
        rest = np.delete(np.arange(n), row)
        log = brute_force.log_density(
            successes.kernel,
            Poses.of(p[rest], q[rest]),
            Poses.of(p[row : row + 1], q[row : row + 1]),
            weights=np.ones(n - 1),
        )
        share.append(min(1.0, (n - 1) * float(np.exp(log[0])) / rho))
    error = np.std(share) / math.sqrt(len(share))
    for t in got.tolerances:
        np.testing.assert_allclose(t.probability, np.mean(share), atol=3.0 * error)


def test_smoothed_leaves_the_grasp_itself_out() -> None:
    """Successes alone in the world: without its own kernel nothing is left at a grasp."""
    rng = np.random.default_rng(0)
    p = np.arange(30)[:, None] * np.array([1.0, 0.0, 0.0])
    density = GraspDensity.build(
        Poses.of(p, se3.random_quaternions(30, rng)), kernel=IsotropicKernel(0.01, 0.2)
    )
    got = density_anisotropy(density, 1.0, max_grasps=30)
    peak = float(np.exp(density.kernel.log_peak))
    assert peak > 100.0
    assert got.translations[2].probability[4, 4] < 1.0
    assert all(np.nanmax(h.probability) < 1.0 for h in got.translations)
    scaled = density_anisotropy(density, 1e-3 * peak, max_grasps=30)
    assert np.nanmax(scaled.translations[2].probability) < 1e-2


def test_a_profile_that_stays_high_is_a_lower_bound() -> None:
    value = np.full((33, 5), 0.9)
    n = np.full(33, 10)
    moved = (np.arange(33) - 16) * 0.005 * n
    probability = np.concatenate([value, value, value])
    found = tolerances(
        ("x", "y", "z"), probability, np.ones_like(probability, dtype=np.float32), np.tile(n, 3),
        np.tile(moved, 3), step=0.005, level=0.9,
    )  # fmt: skip
    # As far as pairs lie, on the mean of the last bin's, and no farther.
    assert all(t.beyond and t.half_width == pytest.approx(0.08) for t in found)


def test_too_little_is_refused_with_what_is_needed(box: Trials) -> None:
    p, q, success = box.positions, box.quaternions, box.success
    few = np.zeros(len(p), dtype=bool)
    few[:7] = True
    with pytest.raises(ValueError, match=r"at least 20 successes; there are 7, so 13 more"):
        empirical_anisotropy(Poses.of(p, q), few)
    with pytest.raises(ValueError, match="needs failures"):
        empirical_anisotropy(Poses.of(p[success], q[success]), success[success])
    with pytest.raises(ValueError, match="needs its frames"):
        empirical_anisotropy(Poses.of(p, q), success, alignment="object")
    with pytest.raises(ValueError, match="takes no frames"):
        empirical_anisotropy(Poses.of(p, q), success, frames=np.eye(3))
    with pytest.raises(ValueError, match="orthonormal"):
        empirical_anisotropy(Poses.of(p, q), success, alignment="object", frames=2.0 * np.eye(3))
    with pytest.raises(ValueError, match="integers"):
        empirical_anisotropy(Poses.of(p, q), success, rotation_keys=np.zeros(len(p)))
    with pytest.raises(ValueError, match="success has shape"):
        empirical_anisotropy(Poses.of(p, q), success[:-1])
    far = np.arange(60)[:, None] * np.array([1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="no trial lies within reach"):
        empirical_anisotropy(
            Poses.of(far, se3.random_quaternions(60, np.random.default_rng(0))), np.arange(60) < 30
        )
    density = GraspDensity.build(Poses.of(p[:30], q[:30]), kernel=IsotropicKernel(0.01, 0.2))
    with pytest.raises(ValueError, match="density of attempts"):
        density_anisotropy(density, 0.0)


def test_progress_rises_and_cancels(box: Trials) -> None:
    keys = {"rotation_keys": box.rotation_keys, "position_keys": box.position_keys}
    seen: list[float] = []
    empirical_anisotropy(*box.parts(), **keys, max_grasps=200, progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0

    def stop(share: float) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        empirical_anisotropy(*box.parts(), **keys, progress=stop)


def test_work_is_limited(box: Trials) -> None:
    keys = {"rotation_keys": box.rotation_keys, "position_keys": box.position_keys}
    limited = empirical_anisotropy(*box.parts(), **keys, max_candidates=200_000)
    assert 20 <= limited.grasps < box.success.sum()
    assert limited.translation_pairs + limited.rotation_pairs <= 200_000
