"""Constrained maxima against exhaustive search, feasibility, diversity, collisions."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import nnls

from graspdb_density import GraspDensity, IsotropicKernel, ModeSearch, Region, Separation, se3
from graspdb_density.search import start_ranking
from graspdb_density.search.mode_search import MeanShiftSearch
from graspdb_density.search.start_ranking import centre_sums

Poses = tuple[se3.Floats, se3.Floats]
Shell = Callable[[int, np.random.Generator], Poses]

KERNEL = IsotropicKernel(0.015, math.radians(15.0))


def random_region(rng: np.random.Generator) -> Region:
    """A box, plane, ball or nothing, with or without cones."""
    planes = np.empty((0, 4))
    spheres = None
    if rng.random() < 0.7:
        centre = rng.uniform([-0.2, -0.1, -0.1], [0.2, 0.1, 0.1])
        half = rng.uniform(0.01, 0.1, 3)
        planes = Region.box(centre - half, centre + half)
    elif rng.random() < 0.5:
        spheres = np.append(rng.uniform([-0.2, -0.1, -0.1], [0.2, 0.1, 0.1]), rng.uniform(0.01, 0.1))[None]
    if rng.random() < 0.3:
        normal = rng.standard_normal(3)
        planes = np.concatenate([planes, [np.append(normal / np.linalg.norm(normal), -0.05)]])
    approach = closing = None
    if rng.random() < 0.6:
        approach = rng.standard_normal(3), math.radians(rng.uniform(10.0, 60.0))
    if rng.random() < 0.4:
        axis = rng.standard_normal(3)
        if approach is not None:
            axis = np.cross(axis, approach[0])
        closing = axis, math.radians(rng.uniform(10.0, 60.0))
    return Region(
        half_spaces=planes,
        spheres=spheres,
        approach=None if approach is None else approach[0],
        approach_angle=None if approach is None else approach[1],
        closing=None if closing is None else closing[0],
        closing_angle=None if closing is None else closing[1],
    )


def exhaustive(density: GraspDensity, region: Region, rng: np.random.Generator) -> float:
    """Best log density by hill climbing of its own: random feasible steps from every start, not mean shift.

    Starts: every row projected into the region, and the density's own samples so projected.
    """
    p, q = density.positions, density.quaternions_xyzw
    drawn = density.sample(2_000, rng)
    p, q, inside = region.project(
        np.concatenate([p, drawn.positions]), np.concatenate([q, drawn.quaternions_xyzw])
    )
    p, q = p[inside], q[inside]
    if not len(p):
        return -math.inf
    values = density.log_density(se3.Poses.of(p, q), cutoff=5.0)
    best = np.argsort(-values)[:300]
    p, q, values = p[best], q[best], values[best]
    for step in np.repeat([1.0, 0.5, 0.25, 0.12, 0.06, 0.03, 0.015], 25):
        moved = p + rng.standard_normal(p.shape) * step * density.kernel.sigma_position_m
        turns = se3.from_rotation_vector(rng.standard_normal(p.shape) * step * density.kernel.sigma_rotation)
        new_p, new_q, inside = region.project(moved, se3.multiply(q, turns))
        new = np.where(inside, density.log_density(se3.Poses.of(new_p, new_q), cutoff=5.0), -np.inf)
        better = new > values
        p[better], q[better], values[better] = new_p[better], new_q[better], new[better]
    return float(values.max())


@pytest.mark.parametrize("seed", range(10))
def test_against_exhaustive_search(seed: int, shell: Shell) -> None:
    rng = np.random.default_rng(seed)
    density = GraspDensity.build(se3.Poses.of(*shell(1_500, rng)), kernel=KERNEL)
    region = random_region(rng)
    found = ModeSearch(density).maxima(region)
    best = exhaustive(density, region, rng)
    if not found:
        # Nothing within the cut-off: then nothing anyone finds is worth more than a kernel's tail there.
        assert best < KERNEL.log_peak - 8.0
        return
    assert region.contains(found[0].position[None], found[0].quaternion_xyzw[None]).all()
    assert math.exp(found[0].log_density - best) >= 0.999


def test_global_maximum_is_the_highest_point(shell: Shell) -> None:
    rng = np.random.default_rng(20)
    density = GraspDensity.build(se3.Poses.of(*shell(1_500, rng)), kernel=KERNEL)
    search = ModeSearch(density)
    top = search.global_maximum()
    assert top is search.global_maximum()
    assert math.exp(top.log_density - exhaustive(density, Region(), rng)) >= 0.999
    assert (density.log_density(se3.Poses.of(*density.sample(5_000, rng))) <= top.log_density + 1e-3).all()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_never_infeasible_and_always_distinct(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.uniform([-0.2, -0.1, -0.1], [0.2, 0.1, 0.1], (300, 3)), se3.random_quaternions(300, rng)
    symmetric = bool(rng.random() < 0.5)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=KERNEL, symmetric=symmetric)
    region = random_region(rng)
    found = ModeSearch(density).maxima(region, count=4, separation=Separation(0.02, math.radians(30.0)))
    for i, grasp in enumerate(found):
        assert region.contains(grasp.position[None], grasp.quaternion_xyzw[None]).all()
        assert math.isfinite(grasp.log_density)
        for other in found[:i]:
            assert other.log_density >= grasp.log_density
            apart = np.linalg.norm(grasp.position - other.position) > 0.02
            ends = [grasp.quaternion_xyzw]
            if symmetric:
                ends.append(se3.jaw_twin(grasp.quaternion_xyzw))
            turned = min(float(se3.angle_between(q, other.quaternion_xyzw)) for q in ends) > math.radians(
                30.0
            )
            assert apart or turned
    if not found:
        p, q, inside = region.project(*rows)
        reached = inside & (np.linalg.norm(p - rows[0], axis=1) < 3.9 * KERNEL.sigma_position_m)
        reached &= se3.angle_between(q, rows[1]) < 3.9 * KERNEL.sigma_rotation
        assert not reached.any()


def test_a_single_mode_yields_several_distinct_grasps() -> None:
    rng = np.random.default_rng(21)
    rows = rng.normal(size=(500, 3)) * 0.02, np.tile(se3.IDENTITY, (500, 1))
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=KERNEL)
    found = ModeSearch(density).maxima(count=5, separation=Separation(0.01, 0.3))
    assert len(found) == 5


def test_regions_without_a_feasible_row_are_reached_by_projection() -> None:
    p, q = np.zeros((50, 3)), np.tile(se3.IDENTITY, (50, 1))
    density = GraspDensity.build(se3.Poses.of(p, q), kernel=KERNEL)
    region = Region(
        half_spaces=[[1.0, 0.0, 0.0, 0.03]], approach=[1.0, 0.0, 1.0], approach_angle=math.radians(30.0)
    )
    (best,) = ModeSearch(density).maxima(region)
    np.testing.assert_allclose(best.position, [0.03, 0.0, 0.0], atol=1e-6)
    # Turned from z by the 15 degrees that bring it into the cone of 30 about an axis at 45.
    assert float(se3.angle_between(best.quaternion_xyzw, se3.IDENTITY)) == pytest.approx(
        math.radians(15.0), abs=1e-4
    )
    assert set(best.active_constraints) == {"half_spaces[0]", "approach"}


def test_two_cones_meet_at_the_nearest_rotation() -> None:
    """Rotations by rotation vectors in a grid, against the projection onto both cones."""
    rng = np.random.default_rng(22)
    region = Region(
        approach=[0.0, 0.5, 1.0], approach_angle=0.2, closing=[0.5, 1.0, -0.5], closing_angle=0.25
    )
    grid = np.stack(np.meshgrid(*[np.linspace(-1.4, 1.4, 57)] * 3), axis=-1).reshape(-1, 3)
    candidates = se3.from_rotation_vector(grid)
    allowed = candidates[region.contains(np.zeros_like(grid), candidates)]
    assert len(allowed) > 100
    for start in se3.from_rotation_vector(rng.standard_normal((10, 3)) * 0.3):
        _, q, inside = region.project(np.zeros((1, 3)), start[None])
        assert inside.all()
        assert region.contains(np.zeros((1, 3)), q).all()
        moved = float(se3.angle_between(q, start)[0])
        # The grid's own spacing is 0.05 rad.
        assert moved <= float(se3.angle_between(allowed, start).min()) + 1e-3
        assert moved >= float(se3.angle_between(allowed, start).min()) - 0.05 * math.sqrt(3.0)


def test_position_projection_is_the_nearest_point() -> None:
    rng = np.random.default_rng(23)
    region = Region(
        half_spaces=np.concatenate([Region.box([0, 0, 0], [1, 1, 1]), [[1.0, 1.0, 1.0, 1.2]]]),
        spheres=[[0.2, 0.2, 0.2, 0.8]],
    )
    points = rng.uniform(-1.0, 2.0, (40, 3))
    quaternions = np.tile(se3.IDENTITY, (40, 1))
    near, _, inside = region.project(points, quaternions)
    assert inside.all()
    assert region.contains(near, quaternions).all()
    feasible = rng.uniform(0.0, 1.0, (20_000, 3))
    feasible = feasible[region.contains(feasible, np.tile(se3.IDENTITY, (20_000, 1)))]
    # The variational inequality that marks a projection onto a convex set.
    slack = np.einsum("ijk,ik->ij", feasible[None, :, :] - near[:, None, :], points - near)
    assert slack.max() < 1e-6


def test_the_closing_axis_has_no_sign_unless_asked() -> None:
    kernel = KERNEL
    density = GraspDensity.build(
        se3.Poses.of(np.zeros((1, 3)), se3.IDENTITY[None]), kernel=kernel, symmetric=False
    )
    back = {"closing": [0.0, -1.0, 0.0], "closing_angle": 0.1}
    assert ModeSearch(density).maxima(Region(**back))
    assert not ModeSearch(density).maxima(Region(**back, closing_signed=True))
    both = GraspDensity.build(se3.Poses.of(np.zeros((1, 3)), se3.IDENTITY[None]), kernel=kernel)
    (twin,) = ModeSearch(both).maxima(Region(**back, closing_signed=True))
    assert float(se3.angle_between(twin.quaternion_xyzw, se3.JAW_TURN)) < 1e-3


def test_nothing_is_found_out_of_reach(shell: Shell) -> None:
    rng = np.random.default_rng(24)
    density = GraspDensity.build(se3.Poses.of(*shell(500, rng)), kernel=KERNEL)
    region = Region(half_spaces=Region.box([1.0, 1.0, 1.0], [2.0, 2.0, 2.0]))
    assert ModeSearch(density).maxima(region) == []
    assert ModeSearch(density).maxima(admissible=lambda poses: np.zeros(len(poses), dtype=bool)) == []
    empty = Region(half_spaces=[[1.0, 0.0, 0.0, 0.1], [-1.0, 0.0, 0.0, 0.1]])
    assert ModeSearch(density).maxima(empty) == []
    for one, reached in ((empty, False), (region, True)):
        assert one.project(np.zeros((1, 3)), se3.IDENTITY[None])[2].all() == reached


@pytest.mark.parametrize("seed", range(4))
def test_collisions_are_avoided_and_the_edge_of_the_free_space_is_searched(seed: int, shell: Shell) -> None:
    rng = np.random.default_rng(seed)
    density = GraspDensity.build(se3.Poses.of(*shell(1_500, rng)), kernel=KERNEL)
    top = ModeSearch(density).global_maximum()

    def admissible(poses: se3.Poses) -> NDArray[np.bool_]:
        # A forbidden ball about the global maximum and a forbidden half: a curved and a flat edge.
        p = poses.positions
        free = np.linalg.norm(p - top.position, axis=1) > 0.02
        return np.asarray(free & (p[:, 2] > -0.5 * abs(top.position[2])), dtype=bool)

    found = ModeSearch(density).maxima(count=3, admissible=admissible)
    assert found
    for grasp in found:
        assert admissible(se3.Poses.of(grasp.position[None], grasp.quaternion_xyzw[None])).all()
    p, q = density.positions, density.quaternions_xyzw
    free = admissible(se3.Poses(p, q))
    best = density.log_density(se3.Poses.of(p[free], q[free])).max()
    for step in np.repeat([0.5, 0.2, 0.1, 0.05], 25):
        start = np.argsort(-density.log_density(se3.Poses.of(p[free], q[free])))[:200]
        moved = p[free][start] + rng.standard_normal((len(start), 3)) * step * 0.015
        turned = se3.multiply(
            q[free][start], se3.from_rotation_vector(rng.standard_normal((len(start), 3)) * step * 0.26)
        )
        ok = admissible(se3.Poses(moved, turned))
        p, q = np.concatenate([p[free], moved[ok]]), np.concatenate([q[free], turned[ok]])
        free = np.ones(len(p), dtype=bool)
        best = max(best, density.log_density(se3.Poses.of(moved[ok], turned[ok])).max())
    assert math.exp(found[0].log_density - best) > 0.98


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"half_spaces": [[1.0, 0.0, 0.0]]}, "half_spaces have shape"),
        ({"half_spaces": [[0.0, 0.0, 0.0, 1.0]]}, "normal has no length"),
        ({"half_spaces": [[1.0, 0.0, math.nan, 1.0]]}, "finite"),
        ({"spheres": [[0.0, 0.0, 0.0, -1.0]]}, "radius is negative"),
        ({"approach": [0.0, 0.0, 0.0], "approach_angle": 0.1}, "no direction"),
        ({"approach": [0.0, 0.0, 1.0]}, "approach_angle must be"),
        ({"approach_angle": 0.1}, "without approach"),
        ({"closing": [0.0, 1.0, 0.0], "closing_angle": 4.0}, "closing_angle must be"),
        (
            {"approach": [0, 0, 1], "approach_angle": 0.1, "closing": [0, 0, 1], "closing_angle": 0.1},
            "contradict each other",
        ),
    ],
)
def test_bad_regions_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Region(**arguments)  # type: ignore[arg-type]


def test_bad_searches_are_refused() -> None:
    density = GraspDensity.build(se3.Poses.of(np.zeros((1, 3)), se3.IDENTITY[None]), kernel=KERNEL)
    with pytest.raises(ValueError, match="count must be"):
        ModeSearch(density).maxima(count=0)
    with pytest.raises(ValueError, match="negative"):
        ModeSearch(density).maxima(separation=Separation(-1.0, 0.0))
    with pytest.raises(ValueError, match="lower corner"):
        Region.box([1.0, 0.0, 0.0], [0.0, 1.0, 1.0])
    with pytest.raises(ValueError, match="admissible answered shape"):
        ModeSearch(density).maxima(admissible=lambda poses: np.ones(1 + len(poses), dtype=bool))


def climbed_from(density: GraspDensity, region: Region, starts: se3.Poses, steps: int) -> se3.Poses:
    """Ends of climbs from given poses."""
    ranking = ModeSearch(density).ranking(2)
    search = MeanShiftSearch(density, ranking, density.log_density, region, None, 2)
    return search.climb(starts, steps)[1].poses


def small_shell(count: int, shell: Shell, rng: np.random.Generator) -> Poses:
    """The shell at 0.3 of its size: most kernels reach each other."""
    p, q = shell(count, rng)
    return 0.3 * p, q


@pytest.mark.parametrize("seed", range(4))
def test_dense_data_is_ranked_by_a_sample_and_searched_as_well(
    seed: int, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start_ranking, "MOST_PAIRS", 3e7)
    rng = np.random.default_rng(100 + seed)
    rows = small_shell(20_000, shell, rng)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=KERNEL)
    sample = centre_sums(density, None, 1).sample
    assert sample is not None
    assert 3_000 < sample.rows.size < 8_000
    low = np.array([rng.uniform(-0.05, 0.0), -1.0, -1.0])
    approach = rng.standard_normal(3), math.radians(50.0)
    region = Region(
        half_spaces=Region.box(low, [1.0, 1.0, 1.0]), approach=approach[0], approach_angle=approach[1]
    )
    found = ModeSearch(density).maxima(region)
    # The same climb from the 400 truly best rows.
    values = np.where(region.contains(*rows), density.log_density(se3.Poses.of(*rows), threads=2), -np.inf)
    best = np.argsort(-values)[:400]
    ends = climbed_from(density, region, se3.Poses(rows[0][best], rows[1][best]), 200)
    top = density.log_density(se3.Poses.of(ends.positions, ends.quaternions_xyzw)).max()
    assert math.exp(found[0].log_density - top) >= 0.999


def test_sampled_centre_sums_are_unbiased_and_extended_alike(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(7)
    p, q = small_shell(9_000, shell, rng)
    weights, symmetric = rng.uniform(0.2, 3.0, 9_000), rng.random(9_000) < 0.7
    exact = GraspDensity.build(se3.Poses.of(p, q), kernel=KERNEL, weights=weights, symmetric=symmetric)
    every = centre_sums(exact, None, 1)
    truth = every.values
    assert every.sample is None
    monkeypatch.setattr(start_ranking, "MOST_PAIRS", 3e7)
    first = slice(0, 8_500)
    old = GraspDensity.build(
        se3.Poses.of(p[first], q[first]), kernel=KERNEL, weights=weights[first], symmetric=symmetric[first]
    )
    known = centre_sums(old, None, 1)
    grown = old.extend(
        se3.Poses.of(p[8_500:], q[8_500:]), weights=weights[8_500:], symmetric=symmetric[8_500:]
    )
    now = centre_sums(grown, known, 1)
    assert known.sample is not None
    assert now.sample is not None
    assert 0 < now.sample.rows.size - known.sample.rows.size < 450
    unit = grown.weights[0] / grown.raw_weights[0] / (exact.weights[0] / exact.raw_weights[0])
    ratio = now.values * unit / truth
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.01)
    assert np.std(ratio) < 0.3
    top = np.argsort(-truth)[:500]
    assert np.std(ratio[top]) < 0.15
    assert np.mean(ratio[8_500:]) == pytest.approx(1.0, abs=0.05)


def test_rows_of_the_sample_do_not_outrank_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Far from each other, every row is worth its own kernel, in the sample or not."""
    monkeypatch.setattr(start_ranking, "MOST_PAIRS", 0.0)
    grid = np.stack(np.meshgrid(*[np.arange(18.0)] * 3), axis=-1).reshape(-1, 3)
    density = GraspDensity.build(se3.Poses.of(grid, np.tile(se3.IDENTITY, (len(grid), 1))), kernel=KERNEL)
    sums = centre_sums(density, None, 1)
    assert sums.sample is not None
    np.testing.assert_allclose(sums.values, 0.5, rtol=1e-5)


def test_planes_that_nearly_coincide_hold_no_climb_back(shell: Shell) -> None:
    """A box with a slanted face almost along one of its own."""
    density = GraspDensity.build(se3.Poses.of(*shell(3_000, np.random.default_rng(5))), kernel=KERNEL)
    slanted = np.array([-0.03, 0.999, -0.02, -0.05])
    region = Region(half_spaces=np.vstack([Region.box([0.1, -0.1, -0.15], [0.22, -0.03, 0.15]), slanted]))
    best = exhaustive(density, region, np.random.default_rng(6))
    assert math.exp(ModeSearch(density).maxima(region)[0].log_density - best) >= 0.999


def test_runners_up_are_found_however_far_apart_they_must_be() -> None:
    """Hundreds of rows about one place outrank the single rows at four others."""
    rng = np.random.default_rng(8)
    lone = np.array([[0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [-0.3, 0.0, 0.0], [0.0, -0.3, 0.0]])
    p = np.concatenate([0.04 * rng.standard_normal((3_000, 3)), lone])
    q = np.concatenate([se3.random_quaternions(3_000, rng), np.tile(se3.IDENTITY, (4, 1))])
    density = GraspDensity.build(se3.Poses.of(p, q), kernel=KERNEL)
    found = ModeSearch(density).maxima(count=5, separation=Separation(0.25, math.pi))
    assert len(found) == 5
    places = np.array([grasp.position for grasp in found[1:]])
    apart = np.linalg.norm(places[:, None] - lone[None], axis=2)
    assert (apart.min(axis=0) < 0.01).all()


@pytest.mark.parametrize("shift", [0.0, 0.005, 1.0])
def test_nearest_rows_are_those_of_all(shift: float, shell: Shell) -> None:
    """Whether the rows lie in the cells around the pose or far from it; some with a twin, some without."""
    rng = np.random.default_rng(9)
    p, q = shell(2_000, rng)
    symmetric = rng.random(2_000) < 0.5
    density = GraspDensity.build(se3.Poses.of(p, q), kernel=KERNEL, symmetric=symmetric)
    for row in range(0, 2_000, 200):
        at, to = p[row] + shift, se3.normalise(q[row] + 0.05)
        cosine = np.abs(q @ to)
        cosine = np.where(symmetric, np.maximum(cosine, np.abs(q @ se3.jaw_twin(to))), cosine)
        squared = np.sum((p - at) ** 2, axis=1) / KERNEL.sigma_position_m**2
        distance = np.sqrt(squared + 2.0 * KERNEL.kappa * (1.0 - cosine))
        rows = density.nearest_rows(se3.Poses(at, to), 5)
        np.testing.assert_allclose(distance[rows], np.sort(distance)[:5], rtol=1e-3)
        (nearest,), (apart,) = density.nearest_each(se3.Poses(at[None], to[None]), within=2.0)
        if distance.min() < 2.0:
            assert distance[nearest] == pytest.approx(distance.min(), rel=1e-3)
            assert apart == pytest.approx(distance.min(), rel=1e-3, abs=1e-3)
        else:
            assert nearest == -1 or apart > 2.0
    few = GraspDensity.build(se3.Poses.of(p[:3], q[:3]), kernel=KERNEL)
    assert sorted(few.nearest_rows(se3.Poses(p[0], q[0]), 5)) == [0, 1, 2]


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_projection_onto_a_polyhedron_is_exact(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 9))
    normals = rng.standard_normal((count, 3))
    if count > 1 and rng.random() < 0.5:
        normals[-1] = normals[0] + 1e-3 * rng.standard_normal(3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    inner = rng.normal(size=3) * 0.1
    planes = np.hstack([normals, (normals @ inner - rng.uniform(0.0, 0.1, count))[:, None]])
    goal = rng.normal(size=3) * 0.5
    (near,), _, (inside,) = Region(half_spaces=planes).project(goal[None], se3.IDENTITY[None])
    assert inside
    assert (planes[:, :3] @ near >= planes[:, 3] - 1e-8).all()
    # What pulls towards the goal is a sum of normals of the faces touched, none of them pushing.
    touched = planes[planes[:, :3] @ near < planes[:, 3] + 1e-7, :3]
    pull = near - goal
    if np.linalg.norm(pull) < 1e-8:
        return
    _, rest = nnls(touched.T, pull)
    assert rest < 1e-6


@pytest.mark.long
@pytest.mark.parametrize("seed", range(50))
def test_against_mean_shift_from_everywhere(seed: int, shell: Shell) -> None:
    """The exhaustive maximum at 20,000 kernels: from every feasible centre and 100,000 feasible starts."""
    rng = np.random.default_rng(1_000 + seed)
    density = GraspDensity.build(se3.Poses.of(*shell(20_000, np.random.default_rng(0))), kernel=KERNEL)
    region = random_region(rng)
    low, high = density.positions.min(axis=0) - 0.05, density.positions.max(axis=0) + 0.05
    p = np.concatenate([density.positions, rng.uniform(low, high, (100_000, 3))])
    q = np.concatenate([density.quaternions_xyzw, se3.random_quaternions(100_000, rng)])
    p, q, inside = region.project(p, q)
    p, q = p[inside], q[inside]
    # A start a thousandth as good as the best is left out: hours would go into the tails.
    value = density.log_density(se3.Poses.of(p, q), threads=2)
    kept = value > value.max() - math.log(1e3) if len(value) else np.zeros(0, dtype=bool)
    ends = climbed_from(density, region, se3.Poses(p[kept], q[kept]), 60)
    found = ModeSearch(density).maxima(region)
    if not found:
        assert not len(value) or value.max() < KERNEL.log_peak - 8.0
        return
    best = density.log_density(se3.Poses.of(ends.positions, ends.quaternions_xyzw), threads=2).max()
    assert region.contains(found[0].position[None], found[0].quaternion_xyzw[None]).all()
    assert math.exp(found[0].log_density - best) >= 0.999
