"""Best grasps by any score, and expectations under pose noise."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from graspdb_density import (
    GraspDensity,
    IsotropicKernel,
    ModeSearch,
    PoseNoise,
    Region,
    SuccessModel,
    expected,
    se3,
)
from graspdb_density.se3 import Poses

Pair = tuple[se3.Floats, se3.Floats]
Shell = Callable[[int, np.random.Generator], Pair]

KERNEL = IsotropicKernel(0.015, math.radians(15.0))


@pytest.mark.parametrize("seed", range(3))
def test_the_density_itself_as_a_score_gives_its_maximum(seed: int, shell: Shell) -> None:
    rng = np.random.default_rng(seed)
    density = GraspDensity.build(se3.Poses.of(*shell(1_500, rng)), kernel=KERNEL)
    region = Region(
        half_spaces=Region.box([-0.15, -0.1, 0.0], [0.15, 0.1, 0.15]), approach=[0, 0, -1], approach_angle=0.8
    )
    (climbed,) = ModeSearch(density).maxima(region)
    (scored,) = ModeSearch(density).maxima(region, score=density.log_density)
    assert region.contains(scored.position[None], scored.quaternion_xyzw[None]).all()
    assert math.exp(scored.score - climbed.log_density) > 0.99
    assert scored.score == pytest.approx(scored.log_density)


def test_as_many_distinct_grasps_as_there_are(shell: Shell) -> None:
    density = GraspDensity.build(se3.Poses.of(*shell(1_500, np.random.default_rng(0))), kernel=KERNEL)
    found = ModeSearch(density).maxima(score=density.log_density, count=100)
    assert len(found) == 100
    scores = [item.score for item in found]
    assert scores == sorted(scores, reverse=True)
    p = np.array([item.position for item in found])
    q = np.array([item.quaternion_xyzw for item in found])
    apart = np.linalg.norm(p[:, None] - p, axis=-1) > 0.01
    twin = se3.angle_between(q[:, None], se3.jaw_twin(q))
    apart |= np.minimum(se3.angle_between(q[:, None], q), twin) > math.radians(20.0)
    assert (apart | np.eye(100, dtype=bool)).all()


def test_success_probability_is_ranked_by_the_lower_end_of_its_interval() -> None:
    """Many successes on one side, one lucky success on the other."""
    rng = np.random.default_rng(3)
    left = np.array([-0.1, 0.0, 0.0]) + rng.normal(size=(300, 3)) * 0.01
    right = np.array([[0.1, 0.0, 0.0]])
    p = np.concatenate([left, right, rng.uniform(-0.2, 0.2, (300, 3))])
    q = np.tile(se3.IDENTITY, (len(p), 1))
    won = np.arange(len(p)) < 301
    won[:60] = False
    model = SuccessModel.build(Poses.of(p, q), won, kernel=KERNEL)
    density = GraspDensity.build(se3.Poses.of(p[won], q[won]), kernel=KERNEL)
    found = ModeSearch(density).maxima(score=lambda poses: model.evaluate(poses).low, count=2)
    assert found[0].position[0] < -0.05
    assert found[0].score > found[1].score
    estimate = model.evaluate(Poses.of(found[0].position[None], found[0].quaternion_xyzw[None]))
    assert found[0].score == pytest.approx(estimate.low[0])
    every = model.evaluate(Poses.of(p, q), level=0.8)
    np.testing.assert_array_equal(model.lower_end(Poses.of(p, q), level=0.8), every.low)
    np.testing.assert_array_equal(model.probability(Poses.of(p, q)), every.probability)


def test_refused_poses_are_never_returned(shell: Shell) -> None:
    rng = np.random.default_rng(4)
    density = GraspDensity.build(se3.Poses.of(*shell(500, rng)), kernel=KERNEL)

    def admissible(poses: se3.Poses) -> NDArray[np.bool_]:
        return np.asarray(poses.positions[:, 0] > 0.05, dtype=bool)

    found = ModeSearch(density).maxima(score=density.log_density, count=3, admissible=admissible)
    assert found
    assert all(m.position[0] > 0.05 for m in found)


def test_tool_noise_is_a_wider_kernel(shell: Shell) -> None:
    rng = np.random.default_rng(5)
    rows = shell(300, rng)
    density = GraspDensity.build(se3.Poses.of(*rows), kernel=KERNEL)
    wider = GraspDensity.build(se3.Poses.of(*rows), kernel=KERNEL.widened(0.01, math.radians(8.0)))
    poses = se3.Poses.of(rows[0][:40], rows[1][:40])
    mean = expected(density.density, tool_noise=PoseNoise(0.01, math.radians(8.0)), samples=1024)(poses)
    np.testing.assert_allclose(mean, wider.density(poses), rtol=0.08)


def test_object_noise_grows_with_the_lever() -> None:
    near, far = np.array([[0.0, 0.0, 0.02]]), np.array([[0.0, 0.0, 0.3]])
    q = se3.IDENTITY[None]
    noise = PoseNoise(0.0, math.radians(5.0))
    for p, least, most in ((near, 0.9, 1.0), (far, 0.0, 0.6)):
        at = se3.Poses.of(p, q)
        density = GraspDensity.build(at, kernel=IsotropicKernel(0.015, math.radians(60.0)))
        share = expected(density.density, object_noise=noise, samples=256)(at) / density.density(at)
        assert least < share[0] < most
    # About the grasp itself there is no lever.
    at = se3.Poses.of(far, q)
    density = GraspDensity.build(at, kernel=IsotropicKernel(0.015, math.radians(60.0)))
    about = PoseNoise(0.0, math.radians(5.0), (0.0, 0.0, 0.3))
    share = expected(density.density, object_noise=about, samples=256)(at) / density.density(at)
    assert share[0] > 0.97


def test_robust_search_prefers_the_broad_peak() -> None:
    """A sharp cluster with the higher density and a broad one that survives noise."""
    rng = np.random.default_rng(6)
    sharp = np.array([0.1, 0.0, 0.0]) + rng.normal(size=(60, 3)) * 0.001
    broad = np.array([-0.1, 0.0, 0.0]) + rng.normal(size=(140, 3)) * 0.012
    p = np.concatenate([sharp, broad])
    density = GraspDensity.build(
        se3.Poses.of(p, np.tile(se3.IDENTITY, (200, 1))), kernel=IsotropicKernel(0.006, 0.3)
    )
    assert ModeSearch(density).maxima()[0].position[0] > 0.0
    robust = expected(density.density, object_noise=PoseNoise(0.02, 0.0))
    (best,) = ModeSearch(density).maxima(score=robust)
    assert best.position[0] < 0.0


def test_bad_arguments_are_refused() -> None:
    density = GraspDensity.build(se3.Poses.of(np.zeros((1, 3)), se3.IDENTITY[None]), kernel=KERNEL)
    with pytest.raises(ValueError, match="noise must be"):
        PoseNoise(-1.0, 0.0)
    with pytest.raises(ValueError, match="samples"):
        expected(density.density, samples=0)
    with pytest.raises(ValueError, match="the score answered shape"):
        ModeSearch(density).maxima(score=lambda poses: np.zeros(1 + len(poses)))


@pytest.mark.parametrize("noise", [0.0, 1e-8])
def test_of_equal_scores_the_densest_is_best(noise: float) -> None:
    """A score that is flat but for rounding: the density's maximum, told with the score itself."""
    rng = np.random.default_rng(0)
    p = rng.normal(size=(60, 3)) * 0.004 + [0.02, -0.01, 0.05]
    q = se3.from_rotation_vector(rng.normal(size=(60, 3)) * 0.05)
    density = GraspDensity.build(Poses.of(p, q), kernel=KERNEL)
    search = ModeSearch(density)

    def score(poses: Poses) -> se3.Floats:
        # Rounding that has its own favourites.
        return np.asarray(0.75 + noise * np.sin(1e4 * poses.positions.sum(axis=1)))

    (found,) = search.maxima(score=score, resolution=1e-5)
    assert found.log_density == pytest.approx(search.global_maximum().log_density, abs=0.01)
    assert found.score == pytest.approx(0.75, abs=2.0 * noise)
    several = search.maxima(score=score, resolution=1e-5, count=3)
    logs = [item.log_density for item in several]
    assert logs == sorted(logs, reverse=True)
