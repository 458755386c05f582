"""Kernels learned from grasps whose vicinity is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from degenerate_trials import KINDS
from graspdb_density import IsotropicKernel, se3
from graspdb_density.bandwidth.mixture_fit import displacements, fit_kernel, mixture_parts
from graspdb_density.kde.bhattacharyya import DisplacementWindow
from graspdb_density.kde.rows import Rows
from graspdb_density.se3 import Poses

Floats = NDArray[np.float64]

WINDOW = DisplacementWindow(0.03, math.radians(45.0))
NARROW = IsotropicKernel(0.005, math.radians(5.0))
COMPARED = IsotropicKernel(0.008, math.radians(10.0))
#: Wide along x and about y.
SPREAD = np.array([0.03, 0.004, 0.01, 0.08, 0.5, 0.08])


def _ridges(count: int = 1_200, seed: int = 0) -> tuple[Floats, Floats]:
    """Grasps about ten places, far wider along some axes of the gripper than along others."""
    rng = np.random.default_rng(seed)
    at, to = rng.normal(size=(10, 3)) * 0.08, se3.random_quaternions(10, rng)
    which = rng.integers(10, size=count)
    xi = rng.normal(size=(count, 6)) * SPREAD
    p = at[which] + np.einsum("nij,nj->ni", se3.to_matrix(to[which]), xi[:, :3])
    return p, se3.multiply(to[which], se3.from_rotation_vector(xi[:, 3:]))


def test_displacements_are_those_of_every_pair_in_the_window() -> None:
    p, q = _ridges(60)
    w = np.random.default_rng(1).random(60) + 0.5
    found = displacements(Rows.of(Poses.of(p, q), weights=w), window=WINDOW, rng=np.random.default_rng(2))
    expected = {}
    for a in range(60):
        for b in range(60):
            if a == b:
                continue
            shift = se3.to_matrix(q[a]).T @ (p[b] - p[a])
            for end in (q[b], se3.jaw_twin(q[b])):
                turn = se3.to_rotation_vector(se3.multiply(se3.conjugate(q[a]), end))
                if np.abs(shift).max() <= 0.03 and np.linalg.norm(turn) <= math.radians(45.0):
                    expected[a, b] = np.concatenate([shift, turn]), w[b]
    assert len(found.vectors) == len(expected) > 100
    rows = {a: [v for (start, _), (v, _) in expected.items() if start == a] for a in range(60)}
    for vector, origin in zip(found.vectors, found.origin, strict=True):
        assert min(np.abs(vector - other).max() for other in rows[int(origin)]) < 1e-9
    total = sum(weight for _, weight in expected.values())
    mean = sum(v * weight for v, weight in expected.values()) / total
    np.testing.assert_allclose(found.weights @ found.vectors / found.weights.sum(), mean, atol=1e-9)


def test_a_fitted_kernel_has_the_shape_of_the_vicinity_and_predicts_better() -> None:
    p, q = _ridges()
    fit = fit_kernel(Rows.of(Poses.of(p, q)), window=WINDOW, widths=NARROW, compared=COMPARED, components=1)
    widths = np.sqrt(np.diag(fit.kernel.overall_covariance))
    assert widths[0] > 1.7 * widths[1]
    assert widths[4] > 2.0 * max(widths[3], widths[5])
    assert fit.log_likelihood > fit.isotropic_log_likelihood + 0.5
    assert fit.similarity.value > 0.85
    again = fit_kernel(Rows.of(Poses.of(p, q)), window=WINDOW, widths=NARROW, compared=COMPARED, components=1)
    np.testing.assert_array_equal(again.kernel.covariances, fit.kernel.covariances)


def test_the_number_of_components_is_chosen_by_held_out_displacements() -> None:
    p, q = _ridges()
    fit = fit_kernel(Rows.of(Poses.of(p, q)), window=WINDOW, widths=NARROW, compared=COMPARED)
    assert {1, 2, 3} <= set(fit.likelihoods)
    # As few as come within what a component is worth of those with more.
    best = min(k for k, v in fit.likelihoods.items() if v > max(fit.likelihoods.values()) - 0.04)
    assert best <= len(fit.kernel.weights) <= 2 * max(fit.likelihoods)
    one = fit_kernel(Rows.of(Poses.of(p, q)), window=WINDOW, widths=NARROW, compared=COMPARED, components=1)
    assert fit.similarity.value > one.similarity.value - 0.01


def test_a_kernel_in_the_objects_axes_ignores_their_signs() -> None:
    p, q = _ridges()
    turn = se3.to_matrix(se3.random_quaternions(1, np.random.default_rng(3)))[0]
    fit = fit_kernel(Rows.of(Poses.of(p, q)), window=WINDOW, widths=NARROW, compared=COMPARED, frame=turn)
    flipped = fit_kernel(
        Rows.of(Poses.of(p, q)),
        window=WINDOW,
        widths=NARROW,
        compared=COMPARED,
        frame=turn @ np.diag([-1.0, 1.0, -1.0]),
    )
    assert fit.kernel.frame == "fixed"
    np.testing.assert_allclose(fit.kernel.covariances, flipped.kernel.covariances, atol=1e-12)
    with pytest.raises(ValueError, match="no sign"):
        fit_kernel(
            Rows.of(Poses.of(p, q)), window=WINDOW, widths=NARROW, compared=COMPARED, components=2, frame=turn
        )


def test_a_kernel_along_edges_is_wide_along_them() -> None:
    """Places along three bars of the object, however the gripper is turned to them."""
    rng = np.random.default_rng(5)
    bars = se3.to_matrix(se3.random_quaternions(3, rng))
    which = rng.integers(3, size=900)
    shift = rng.uniform(-1.0, 1.0, (900, 3)) * [0.06, 0.004, 0.004]
    p = rng.normal(size=(3, 3))[which] + np.einsum("nij,nj->ni", bars[which], shift)
    q = se3.multiply(
        se3.random_quaternions(6, rng)[rng.integers(6, size=900)],
        se3.from_rotation_vector(rng.normal(size=(900, 3)) * 0.1),
    )
    frames = bars[which] * rng.choice([-1.0, 1.0], (900, 1, 1))
    frames[:, :, 2] = np.cross(frames[:, :, 0], frames[:, :, 1])
    along, own = (
        fit_kernel(
            Rows.of(Poses.of(p, q)), window=WINDOW, widths=NARROW, compared=COMPARED, components=1, frame=axes
        )
        for axes in (frames, None)
    )
    widths = np.sqrt(np.diag(along.kernel.overall_covariance))
    assert widths[0] > 2.0 * max(widths[1:3])
    assert along.log_likelihood > own.log_likelihood + 0.3
    # Where a grasp is at no edge the gripper's axes take their place.
    frames[::2] = np.nan
    half = fit_kernel(Rows.of(Poses.of(p, q)), window=WINDOW, widths=NARROW, compared=COMPARED, frame=frames)
    assert own.log_likelihood < half.log_likelihood < along.log_likelihood
    with pytest.raises(ValueError, match=r"\(900, 3, 3\)"):
        fit_kernel(Rows.of(Poses.of(p, q)), window=WINDOW, widths=NARROW, compared=COMPARED, frame=frames[:5])


def test_too_little_is_said_with_numbers() -> None:
    p, q = _ridges(40)
    with pytest.raises(ValueError, match="at least 50 successes; there are 40, so 10 more"):
        fit_kernel(Rows.of(Poses.of(p, q)), window=WINDOW, widths=NARROW, compared=COMPARED)
    rng = np.random.default_rng(4)
    far = rng.normal(size=(60, 3)) * 10.0
    with pytest.raises(ValueError, match=r"the window holds 0 displacements.*at least 200"):
        fit_kernel(
            Rows.of(Poses.of(far, se3.random_quaternions(60, rng))),
            window=WINDOW,
            widths=NARROW,
            compared=COMPARED,
        )


@pytest.mark.parametrize("kind", ["planar", "one rotation", "one position", "identical", "two poses", "tiny"])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_what_does_not_spread_has_a_floor(kind: str) -> None:
    """Successes that differ along some axes only: Gaussians as wide as a component along the others."""
    rows = Rows.of(KINDS[kind](60, np.random.default_rng(0)).poses)
    found = displacements(rows, window=WINDOW, rng=np.random.default_rng(1))
    for count in (1, 2, 5):
        _, means, covariances = mixture_parts(found.vectors, count, found.weights)
        assert np.isfinite(means).all()
        assert np.linalg.eigvalsh(covariances).min() > -1e-12
    kernel = fit_kernel(rows, window=WINDOW, widths=NARROW, compared=COMPARED, components=2).kernel
    assert np.isfinite(kernel.log_peaks).all()
    # Scaled by no less than the least factor.
    assert np.sqrt(np.diagonal(kernel.covariances, axis1=1, axis2=2)[:, :3]).min() > 0.001
