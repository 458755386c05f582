"""Convergence curves that grow: the same as those computed at once, whatever came in which order."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from graspdb_density import IsotropicKernel, se3
from graspdb_density.kde.rows import Rows
from graspdb_density.kde.weighted_sums import KernelRows
from graspdb_density.kernels.gaussian_mixture import AnisotropicKernel, Frame, Kernel
from graspdb_density.se3 import Floats, Poses
from graspdb_density.statistics import convergence as cv
from graspdb_density.statistics.counter_rng import CounterRng
from graspdb_density.statistics.incremental_bootstrap import IncrementalCurve, curve_prefix

Pair = tuple[Floats, Floats]
Shell = Callable[[int, np.random.Generator], Pair]
ISOTROPIC = IsotropicKernel(0.02, math.radians(20.0))


WIDTHS = np.array([0.03, 0.01, 0.02, 0.2, 0.5, 0.3])
ANISOTROPIC = AnisotropicKernel.diagonal(WIDTHS)


@dataclass(frozen=True)
class Grasps:
    """Rows in commit order, and what belongs to them."""

    p: Floats
    q: Floats
    weights: Floats | None = None
    symmetric: NDArray[np.bool_] | None = None
    frames: Floats | None = None

    def grown(
        self, count: int, kernel: Kernel, before: IncrementalCurve | None = None, **options: int
    ) -> IncrementalCurve:
        """The curve of the first rows."""
        weights, symmetric, frames = self.weights, self.symmetric, self.frames
        return IncrementalCurve.of(
            Rows.of(
                Poses.of(self.p[:count], self.q[:count]),
                weights=None if weights is None else weights[:count],
                symmetric=True if symmetric is None else symmetric[:count],
            ),
            kernel,
            before=before,
            frames=frames if frames is None or frames.ndim == 2 else frames[:count],
            **{"points": 600, "replicates": 8, **options},
        )


def assert_same(one: IncrementalCurve, other: IncrementalCurve) -> None:
    assert one.curve.held_out == other.curve.held_out
    for a, b in zip(one.curve.points, other.curve.points, strict=True):
        assert a.grasps == b.grasps
        np.testing.assert_allclose(a.replicates, b.replicates, atol=1e-6)
        assert a.similarity == pytest.approx(b.similarity, abs=1e-6)
        # Far from all grasps the log density is as exact as its exponents in single precision.
        assert a.log_likelihood == pytest.approx(b.log_likelihood, rel=1e-6, abs=1e-5)
        assert a.log_likelihood_error == pytest.approx(b.log_likelihood_error, rel=1e-6, abs=1e-5)


@given(
    seed=st.integers(0, 1_000),
    counts=st.lists(st.integers(1, 500), min_size=2, max_size=4),
    weighted=st.booleans(),
    shaped=st.booleans(),
    framed=st.booleans(),
)
@settings(max_examples=12, deadline=None)
def test_a_grown_curve_is_the_one_computed_at_once(
    seed: int, counts: list[int], weighted: bool, shaped: bool, framed: bool
) -> None:
    """However the grasps come: one by one, in bulk, past doublings; some without a twin, some far away."""
    rng = np.random.default_rng(seed)
    total = 200 + sum(counts)
    grasps = Grasps(
        np.where(rng.random((total, 1)) < 0.01, 2.0, 0.04) * rng.standard_normal((total, 3)),
        se3.random_quaternions(total, rng),
        rng.lognormal(0.0, 2.0, total) if weighted else None,
        rng.random(total) < 0.8,
        se3.to_matrix(se3.random_quaternions(total, rng)) if framed and shaped else None,
    )
    frame: Frame = "fixed" if framed else "gripper"
    kernel: Kernel = AnisotropicKernel.diagonal(WIDTHS, frame=frame) if shaped else ISOTROPIC
    curve = grasps.grown(200, kernel)
    for count in 200 + np.cumsum(counts):
        before = curve
        curve = grasps.grown(int(count), kernel, before)
        assert curve.size == count
        if curve_prefix(before.size) != curve_prefix(curve.size):
            assert curve.kept == 0
        elif not weighted:
            assert curve.kept == before.size
        assert_same(curve, grasps.grown(int(count), kernel))


def test_one_by_one_adds_no_more_error_than_at_once(shell: Shell) -> None:
    grasps = Grasps(*shell(400, np.random.default_rng(0)))
    curve = grasps.grown(200, ISOTROPIC, replicates=4, points=100)
    for count in range(201, 400):
        curve = grasps.grown(count, ISOTROPIC, curve, replicates=4, points=100)
        assert curve.kept == count - 1
    assert_same(curve, grasps.grown(399, ISOTROPIC, replicates=4, points=100))


def test_what_does_not_hold_any_more_is_not_kept(shell: Shell) -> None:
    """Changed, missing and reordered grasps, other weights, widths, frames and settings: all at once."""
    rng = np.random.default_rng(1)
    p, q = shell(380, rng)
    frames = se3.to_matrix(se3.random_quaternions(380, rng))
    fixed = AnisotropicKernel.diagonal(WIDTHS, frame="fixed")
    grasps = Grasps(p, q, np.ones(380), np.ones(380, dtype=bool), frames)
    before = grasps.grown(300, fixed)
    assert grasps.grown(350, fixed, before).kept == 300
    assert grasps.grown(300, fixed, before).kept == 300
    # Weights have no unit.
    heavier = Grasps(p, q, np.full(380, 7.0), grasps.symmetric, frames)
    assert heavier.grown(350, fixed, before).kept == 300
    moved = p.copy()
    moved[120, 0] += 1e-9
    without = np.delete(np.arange(380), 120)
    flags = np.ones(380, dtype=bool)
    flags[3] = False
    others = [
        Grasps(moved, q, grasps.weights, grasps.symmetric, frames),
        Grasps(p[without], q[without], np.ones(379), np.ones(379, dtype=bool), frames[without]),
        Grasps(p[::-1], q[::-1], grasps.weights, grasps.symmetric, frames[::-1]),
        Grasps(p, q, np.linspace(1.0, 1.01, 380), grasps.symmetric, frames),
        Grasps(p, q, grasps.weights, flags, frames),
        Grasps(p, q, grasps.weights, grasps.symmetric, frames[0]),
    ]
    for other in others:
        again = other.grown(350, fixed, before)
        assert again.kept == 0
        assert_same(again, other.grown(350, fixed))
    wider = AnisotropicKernel.diagonal(1.05 * WIDTHS, frame="fixed")
    assert grasps.grown(350, wider, before).kept == 0
    assert grasps.grown(350, ISOTROPIC, before).kept == 0
    unframed = Grasps(p, q, grasps.weights, grasps.symmetric)
    assert unframed.grown(350, ANISOTROPIC, before).kept == 0
    assert grasps.grown(350, fixed, before, points=601).kept == 0
    assert grasps.grown(350, fixed, before, seed=1).kept == 0
    # Fewer grasps than before, and twice as many.
    assert grasps.grown(250, fixed, before).kept == 0


def test_late_heavy_grasps_bring_no_flood_of_points(shell: Shell) -> None:
    p, q = shell(320, np.random.default_rng(2))
    grasps = Grasps(p, q, np.where(np.arange(320) < 300, 1.0, 1e6))
    before = grasps.grown(300, ISOTROPIC)
    curve = grasps.grown(320, ISOTROPIC, before)
    assert curve.kept == 0
    assert curve.nbytes < 2 * before.nbytes
    assert_same(curve, grasps.grown(320, ISOTROPIC))


# -- the bootstrap


def test_counts_are_poisson_and_stay() -> None:
    draws = CounterRng(5)
    counts = draws.counts(2, 0, 5_000, 50)
    assert counts.shape == (5_000, 50)
    assert counts.mean() == pytest.approx(1.0, abs=0.01)
    assert counts.var() == pytest.approx(1.0, abs=0.02)
    expected = [math.exp(-1.0) / math.factorial(k) for k in range(5)]
    np.testing.assert_allclose([(counts == k).mean() for k in range(5)], expected, atol=0.005)
    # Rows and replicates are independent of their neighbours.
    centred = counts - 1.0
    assert abs((centred[1:] * centred[:-1]).mean()) < 0.01
    assert abs((centred[:, 1:] * centred[:, :-1]).mean()) < 0.01
    np.testing.assert_array_equal(draws.counts(2, 1_000, 3_100, 50), counts[1_000:3_100])
    np.testing.assert_array_equal(draws.counts(2, 7, 8, 50), counts[7:8])
    assert (draws.counts(1, 0, 5_000, 50) != counts).any()
    assert (CounterRng(6).counts(2, 0, 5_000, 50) != counts).any()


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("count", [200, 399, 1_600])
def test_poisson_counts_and_drawing_with_replacement_agree(shell: Shell, count: int, weighted: bool) -> None:
    """Mean and spread of s over replicates are those of equation 9's bootstrap."""
    rng = np.random.default_rng(count)
    p, q = shell(count, rng)
    weights = rng.lognormal(0.0, 0.7, count) if weighted else None
    curve = IncrementalCurve.of(
        Rows.of(Poses.of(p, q), weights=weights), ISOTROPIC, replicates=200, points=20_000, threads=2
    )
    last = curve.curve.points[-1]
    rows = KernelRows(Rows.of(se3.Poses.of(p, q), weights=weights), ISOTROPIC)
    # As many points as a group has: what they add to the deviation is then alike.
    points = len(curve._groups[0].poses.positions)
    drawn = [cv.bootstrap_similarity(rows, rng, replicates=200, points=points, threads=2) for _ in range(5)]
    value, deviation = np.mean(drawn), math.sqrt(np.mean(np.var(drawn, axis=1, ddof=1)))
    # Monte Carlo of replicates and of the points, and the 1/N of 1 - s by which they may differ.
    error = math.hypot(*[np.std(np.mean(v, axis=1), ddof=1) / 2.2 for v in (drawn, last.replicates)])
    assert last.similarity == pytest.approx(value, abs=4.0 * error + deviation / 8.0 + (1.0 - value) / count)
    # 1,000 replicates tell a deviation within 2.2 %.
    assert last.deviation == pytest.approx(deviation, rel=0.12)


def test_the_first_points_of_a_group_follow_the_density(shell: Shell) -> None:
    """Draws that grow along are distributed as the density is: the mean log density is its own."""
    p, q = shell(399, np.random.default_rng(3))
    curve = IncrementalCurve.of(Rows.of(Poses.of(p, q)), ISOTROPIC, points=20_000, replicates=2)
    rows = KernelRows(Rows.of(se3.Poses.of(p, q)), ISOTROPIC)
    expected = rows.log_density(se3.Poses.of(*rows.sample(20_000, np.random.default_rng(0))))
    at = (
        np.concatenate([g.poses.positions for g in curve._groups]),
        np.concatenate([g.poses.quaternions_xyzw for g in curve._groups]),
    )
    assert 10_000 < len(at[0]) <= 20_000
    got = rows.log_density(se3.Poses.of(*at))
    error = math.hypot(got.std() / math.sqrt(len(got)), expected.std() / math.sqrt(len(expected)))
    assert got.mean() == pytest.approx(expected.mean(), abs=5.0 * error)


def test_progress_rises_and_can_cancel(shell: Shell) -> None:
    grasps = Grasps(*shell(700, np.random.default_rng(4)))
    seen: list[float] = []
    before = IncrementalCurve.of(
        Rows.of(Poses.of(grasps.p[:500], grasps.q[:500])), ISOTROPIC, progress=seen.append
    )
    assert seen == sorted(seen)
    assert 0.0 < seen[0] < 0.2
    assert seen[-1] == pytest.approx(1.0)
    seen.clear()
    IncrementalCurve.of(Rows.of(Poses.of(grasps.p, grasps.q)), ISOTROPIC, before=before, progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(1.0)

    class StopError(Exception):
        pass

    def stop(share: float) -> None:
        if share > 0.3:
            raise StopError

    with pytest.raises(StopError):
        IncrementalCurve.of(Rows.of(Poses.of(grasps.p, grasps.q)), ISOTROPIC, before=before, progress=stop)
