"""Similarity of mixtures to the statistics they stand for, against the number of Gaussians."""

from __future__ import annotations

import math

import numpy as np
import pytest

from degenerate_trials import KINDS
from graspdb_density import IsotropicKernel, se3
from graspdb_density.bandwidth.component_count import mixture_curve
from graspdb_density.bandwidth.mixture_fit import Displacements, displacements
from graspdb_density.kde.bhattacharyya import DisplacementWindow
from graspdb_density.kde.rows import Rows

COMPONENTS = IsotropicKernel(0.005, math.radians(6.0))
WINDOW = DisplacementWindow(0.06, math.radians(90.0))


def drawn(centres: list[float], count: int, seed: int = 0, axis: int = 2) -> Displacements:
    """Displacements about places along an axis, z unless another is named."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(count, 6)) * [0.006, 0.003, 0.004, 0.1, 0.2, 0.1]
    vectors[:, axis] += rng.choice(centres, size=count)
    return Displacements(vectors, np.ones(count), np.arange(count))


def test_one_gaussian_is_enough_for_one_and_not_for_two() -> None:
    rng = np.random.default_rng(1)
    options = {"components": COMPONENTS, "window": WINDOW, "fitted": 1_000, "reference": 4_000}
    done: list[float] = []
    single = mixture_curve(drawn([0.0], 4_000), rng=rng, counts=(1,), **options)  # type: ignore[arg-type]
    assert single.keys() == {1}
    assert single[1].value > 0.97
    found = mixture_curve(
        drawn([-0.9, 0.9], 4_000, axis=4),
        rng=rng,
        counts=(1, 3),
        progress=done.append,
        **options,  # type: ignore[arg-type]
    )
    one, several = (item.value for item in found.values())
    assert one < 0.95
    assert several > one + 0.04
    assert done == [0.5, 1.0]
    assert all(0.0 < item.standard_error < 0.05 for item in found.values())


def test_turns_wider_than_a_component_may_be_are_narrowed() -> None:
    rng = np.random.default_rng(2)
    turns = se3.to_rotation_vector(se3.canonical(se3.random_quaternions(2_000, rng)))
    vectors = np.concatenate([rng.uniform(-0.04, 0.04, (2_000, 3)), turns], axis=1)
    everywhere = Displacements(vectors, np.ones(2_000), np.arange(2_000))
    wide = DisplacementWindow(0.04, math.pi)
    found = mixture_curve(everywhere, components=COMPONENTS, window=wide, rng=rng, counts=(1, 6), fitted=800)
    assert 0.2 < found[1].value < found[6].value + 0.05 < 1.05


def test_weights_decide_what_counts() -> None:
    near, far = drawn([0.0], 2_000), drawn([0.04], 2_000)
    vectors = np.concatenate([near.vectors, far.vectors])
    weights = np.repeat([2.0 - 1e-6, 1e-6], 2_000)
    both = Displacements(vectors, weights, np.arange(4_000))
    found = mixture_curve(
        both, components=COMPONENTS, window=WINDOW, rng=np.random.default_rng(3), counts=(1,),
        fitted=1_000, reference=1_500,
    )  # fmt: skip
    assert found[1].value == pytest.approx(0.985, abs=0.015)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_displacements_that_fill_no_volume_have_a_curve(kind: str) -> None:
    rows = Rows.of(KINDS[kind](40, np.random.default_rng(0)).poses)
    found = displacements(rows, window=WINDOW, rng=np.random.default_rng(1))
    if len(found.vectors) < 10:
        assert kind in ("two trials", "huge")
        return
    sizes = {"reference": 300, "fitted": 100, "points": 400}
    rng = np.random.default_rng(2)
    curve = mixture_curve(found, components=COMPONENTS, window=WINDOW, rng=rng, counts=(1, 2, 4), **sizes)
    assert all(0.0 <= found.value <= 1.0 and found.standard_error >= 0.0 for found in curve.values())
    if kind in ("identical", "tiny"):
        assert curve[1].value == pytest.approx(1.0, abs=1e-3)
