"""Expectations of a grasp's vicinity judged on objects whose answer is known, and shares by relation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from graspdb_density import se3
from graspdb_density.se3 import Floats, Poses
from graspdb_density.success.block_bootstrap import shares
from graspdb_density.vicinity.anisotropy import empirical_anisotropy
from graspdb_density.vicinity.displacement_bins import Anisotropy
from graspdb_density.vicinity.displacement_density import density_anisotropy
from graspdb_density.vicinity.hypotheses import Hypothesis, sharpened, wide_axes

#: Half extents (m) in which grasps of a bar hold, along x, y and z, and half turns (deg) about them.
BAR = ((0.05, 0.015, 0.03), (20.0, 60.0, 20.0))


def bar(
    limits: tuple[tuple[float, ...], tuple[float, ...]] = BAR, turned: float = 0.0
) -> tuple[Floats, Floats, np.ndarray]:
    """A grid about a bar along x: positions at one rotation, and turns about each axis at its middle."""
    # Reaching far enough that what lies beyond is out of reach of every success.
    side = np.arange(-11, 12) * 0.01
    p = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    base = se3.from_rotation_vector([0.0, 0.0, turned])
    within = (np.abs(p) <= np.array(limits[0]) + 1e-6).all(axis=1)
    angle = np.radians(np.arange(-90, 91, 5))
    turns, held = [], []
    for axis in range(3):
        vectors = np.zeros((len(angle), 3))
        vectors[:, axis] = angle
        turns.append(se3.multiply(base, se3.from_rotation_vector(vectors)))
        held.append(np.abs(angle) <= math.radians(limits[1][axis]) + 1e-6)
    q = np.concatenate([np.broadcast_to(base, (len(p), 4)), *turns])
    positions = np.concatenate([p, np.zeros((3 * len(angle), 3))])
    return positions, q, np.concatenate([within, *held])


def by_name(found: list[Hypothesis]) -> dict[str, Hypothesis]:
    return {item.name: item for item in found}


def test_a_bar_held_along_its_edge_confirms_them() -> None:
    found = by_name(wide_axes(empirical_anisotropy(Poses.of(*bar()[:2]), bar()[2])))
    for name in ("x-wide", "z-wide", "ry-wide"):
        item = found[name]
        assert item.verdict == "confirmed", item
        assert 1.0 < item.low <= item.ratio <= item.high
    assert found["x-wide"].ratio > found["z-wide"].ratio


def test_the_other_way_round_denies_them() -> None:
    p, q, won = bar(((0.02, 0.05, 0.02), (60.0, 20.0, 60.0)))
    found = by_name(wide_axes(empirical_anisotropy(Poses.of(p, q), won)))
    assert [found[name].verdict for name in ("x-wide", "z-wide", "ry-wide")] == ["denied"] * 3
    assert found["ry-wide"].high < 1.0


def test_what_is_alike_or_unknown_stays_undecided() -> None:
    p, q, won = bar(((0.03, 0.03, 0.03), (40.0, 40.0, 40.0)))
    assert {item.verdict for item in wide_axes(empirical_anisotropy(Poses.of(p, q), won))} == {"undecided"}
    # Without a trial turned about any axis nothing can be said of those.
    still = (p != 0.0).any(axis=1) | (q == q[0]).all(axis=1)
    turns = by_name(wide_axes(empirical_anisotropy(Poses.of(p[still], q[still]), won[still])))["ry-wide"]
    assert turns.verdict == "undecided"
    assert math.isnan(turns.ratio)


def test_a_bound_decides_only_what_it_can_not_overturn() -> None:
    # Along x nothing fails within reach: x is a lower bound, so x over y is one, too.
    side = np.arange(-20, 21) * 0.005
    p = np.stack(np.meshgrid(side, side, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    won = np.abs(p[:, 1]) < 0.016
    q = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(p), 4))
    wide = by_name(wide_axes(empirical_anisotropy(Poses.of(p, q), won)))["x-wide"]
    assert (wide.verdict, wide.bound) == ("confirmed", "lower")
    across = p[:, [1, 0, 2]]
    narrow = by_name(wide_axes(empirical_anisotropy(Poses.of(across, q), won)))["x-wide"]
    assert (narrow.verdict, narrow.bound) == ("denied", "upper")


def test_alignment_sharpens_where_the_gripper_lies_across() -> None:
    p, q, won = bar(turned=math.radians(45.0))
    axes = np.eye(3)
    blurred = empirical_anisotropy(Poses.of(p, q), won)
    for alignment, frames in (
        ("object", axes),
        ("edge", lambda poses: np.broadcast_to(axes, (len(poses), 3, 3))),
    ):
        found = sharpened(
            empirical_anisotropy(Poses.of(p, q), won, alignment=alignment, frames=frames), blurred
        )
        assert found.verdict == "confirmed", found
    itself = sharpened(blurred, blurred)
    assert (itself.ratio, itself.verdict) == (1.0, "undecided")
    with pytest.raises(ValueError, match="same grasps"):
        sharpened(empirical_anisotropy(Poses.of(p, q), won, max_grasps=30), blurred)


def test_hypotheses_know_the_smoothed_method_too() -> None:
    from graspdb_density import GraspDensity, IsotropicKernel

    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(400, 6)) * [0.03, 0.004, 0.02, 0.05, 0.5, 0.05]
    density = GraspDensity.build(
        Poses.of(vectors[:, :3], se3.from_rotation_vector(vectors[:, 3:])),
        kernel=IsotropicKernel(0.005, math.radians(8.0)),
        symmetric=False,
    )
    peak = (
        float(np.median(density.density(Poses.of(density.positions, density.quaternions_xyzw))))
        * density.size
    )
    found: Anisotropy = density_anisotropy(density, 0.6 * peak)
    assert by_name(wide_axes(found))["x-wide"].ratio > 1.0


# -- shares by relation


def test_shares_are_those_counted_with_intervals_that_hold_them() -> None:
    rng = np.random.default_rng(1)
    p = rng.uniform(-0.1, 0.1, (4_000, 3))
    group = rng.integers(-1, 3, 4_000)
    won = rng.random(4_000) < np.choose(group + 1, [0.9, 0.1, 0.5, 0.8])
    found = shares(won, group, p, groups=4)
    for number in range(3):
        chosen = group == number
        assert (found[number].attempts, found[number].successes) == (chosen.sum(), won[chosen].sum())
        assert found[number].probability == pytest.approx(won[chosen].mean())
        assert found[number].low < (0.1, 0.5, 0.8)[number] < found[number].high
    assert found[3].attempts == 0
    assert math.isnan(found[3].low)


def test_shares_of_attempts_that_fare_alike_are_less_sure() -> None:
    rng = np.random.default_rng(2)
    p = np.repeat(rng.uniform(-0.2, 0.2, (40, 3)), 100, axis=0)
    alike = np.repeat(rng.random(40) < 0.5, 100)
    apart = rng.random(4_000) < alike.mean()
    zero = np.zeros(4_000, dtype=int)
    (one,), (other,) = shares(alike, zero, p, groups=1), shares(apart, zero, p, groups=1)
    assert one.high - one.low > 4 * (other.high - other.low)
    sure = shares(
        np.ones(50, dtype=bool), np.zeros(50, dtype=int), p[:5_000:100][:40].repeat(2, 0)[:50], groups=1
    )
    assert sure[0].low < 1.0 == sure[0].high
    with pytest.raises(ValueError, match="below their count"):
        shares(alike, zero + 1, p, groups=1)
