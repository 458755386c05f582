"""The rule that chooses default widths."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from graspdb_density import DEFAULT_KERNEL, GraspDensity, IsotropicKernel, choose_widths, se3, widths_prefix
from graspdb_density.bandwidth.selection import score_widths
from graspdb_density.kde.rows import Rows
from graspdb_density.se3 import Poses

Pair = tuple[se3.Floats, se3.Floats]
Shell = Callable[[int, np.random.Generator], Pair]


@pytest.mark.parametrize(
    ("count", "prefix"),
    [(0, 0), (199, 0), (200, 200), (399, 200), (400, 400), (6_400, 6_400), (25_600, 20_000), (10**7, 20_000)],
)
def test_prefix_doubles(count: int, prefix: int) -> None:
    assert widths_prefix(count) == prefix


def test_few_rows_keep_the_default(shell: Shell) -> None:
    choice = choose_widths(Rows.of(Poses.of(*shell(199, np.random.default_rng(0)))))
    assert choice.kernel == DEFAULT_KERNEL
    assert (choice.rule, choice.rows) == ("default", 0)


def test_rows_beyond_the_prefix_change_nothing(shell: Shell) -> None:
    rows = shell(799, np.random.default_rng(1))
    all_at_once = choose_widths(Rows.of(Poses.of(*rows)))
    assert all_at_once == choose_widths(Rows.of(Poses.of(rows[0][:400], rows[1][:400])))
    assert (all_at_once.rule, all_at_once.rows) == ("leave-one-block-out", 400)


def test_more_data_of_finer_structure_gives_narrower_widths() -> None:
    rng = np.random.default_rng(2)
    centres = rng.uniform(-0.1, 0.1, (40, 3)), se3.random_quaternions(40, rng)
    made = GraspDensity.build(se3.Poses.of(*centres), kernel=IsotropicKernel(0.02, math.radians(20.0)))
    rows = tuple(made.sample(3_200, rng))
    chosen = choose_widths(Rows.of(Poses.of(*rows))).kernel
    few = choose_widths(Rows.of(Poses.of(rows[0][:200], rows[1][:200]))).kernel
    assert chosen.sigma_position_m <= few.sigma_position_m
    assert chosen.sigma_rotation <= few.sigma_rotation
    assert 0.007 < chosen.sigma_position_m < 0.03
    # The choice generalises: fresh data are likelier under it than under widths far from it.
    fresh = made.sample(500, rng)

    def likelihood(kernel: IsotropicKernel) -> float:
        return float(GraspDensity.build(se3.Poses.of(*rows), kernel=kernel).log_density(fresh).mean())

    best = likelihood(chosen)
    assert best > likelihood(IsotropicKernel(0.004, math.radians(5.0))) + 0.2
    assert best > likelihood(IsotropicKernel(0.06, math.radians(45.0))) + 0.2


def test_grids_and_repetitions_do_not_collapse_the_kernel() -> None:
    rng = np.random.default_rng(3)
    axis = np.arange(-0.05, 0.051, 0.01)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    rows = grid[rng.permutation(len(grid))[:800]], np.tile(se3.IDENTITY, (800, 1))
    for p, q in (rows, (np.repeat(rows[0], 4, axis=0), np.repeat(rows[1], 4, axis=0))):
        assert choose_widths(Rows.of(Poses.of(p, q))).kernel.sigma_position_m > 0.005


def test_weights_count(shell: Shell) -> None:
    """A row of negligible weight might as well not be there."""
    rng = np.random.default_rng(4)
    rows = shell(400, rng)
    noise = rng.uniform(-0.3, 0.3, (400, 3)), se3.random_quaternions(400, rng)
    both = np.concatenate([rows[0], noise[0]]), np.concatenate([rows[1], noise[1]])
    weights = np.repeat([1.0, 1e-9], 400)
    order = rng.permutation(800)
    with_noise = choose_widths(Rows.of(Poses.of(both[0][order], both[1][order]), weights=weights[order]))
    assert with_noise.kernel.sigma_position_m == pytest.approx(
        choose_widths(Rows.of(Poses.of(*rows))).kernel.sigma_position_m, rel=0.5
    )


def test_scores_are_those_the_choice_is_made_by(shell: Shell) -> None:
    rows = shell(800, np.random.default_rng(3))
    weights = np.random.default_rng(4).uniform(0.5, 2.0, 800)
    choice = choose_widths(Rows.of(Poses.of(*rows), weights=weights))
    done: list[float] = []
    scores = score_widths(Rows.of(Poses.of(*rows), weights=weights), progress=done.append)
    best = max(scores, key=lambda item: item.log_likelihood)
    assert best.kernel == choice.kernel
    assert best.log_likelihood == pytest.approx(choice.log_likelihood, abs=1e-9)
    assert (best.below_best, best.below_best_error) == (0.0, 0.0)
    assert len({item.kernel for item in scores}) == len(scores) == len(done) == 35
    for item in scores:
        assert item.below_best == pytest.approx(best.log_likelihood - item.log_likelihood, abs=1e-6)
        assert 0.0 < item.error < 1.0
    # Far from the best, the difference is many times its error.
    far = max(scores, key=lambda item: item.below_best)
    assert far.below_best > 5.0 * far.below_best_error
    with pytest.raises(ValueError, match="there are 199, so 1 more are needed"):
        score_widths(Rows.of(Poses.of(rows[0][:199], rows[1][:199])))


def test_errors_fall_with_the_number_of_grasps(shell: Shell) -> None:
    rows = shell(3_200, np.random.default_rng(5))
    few, many = (
        score_widths(Rows.of(Poses.of(rows[0][:400], rows[1][:400]))),
        score_widths(Rows.of(Poses.of(*rows))),
    )
    assert np.mean([item.error for item in many]) < np.mean([item.error for item in few])


def test_where_no_block_can_be_left_out_the_default_stays() -> None:
    p, q = np.tile([0.0, 0.0, 0.05], (400, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (400, 1))
    choice = choose_widths(Rows.of(Poses.of(p, q)))
    assert (choice.kernel, choice.rule, choice.rows) == (DEFAULT_KERNEL, "default", 400)
