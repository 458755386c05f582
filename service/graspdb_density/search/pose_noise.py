"""Scores averaged over noise of the object's pose and of the tool's."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from .. import se3
from ..se3 import Floats, Poses
from .scored_poses import Admissible, Score

__all__ = ["PoseNoise", "expected", "expected_over", "nearly_expected", "normal_displacements"]


@dataclass(frozen=True, slots=True)
class PoseNoise:
    """Gaussian noise of a pose, deviations per axis in metres and radians.

    As noise of the object's pose it acts on the left, about ``pivot`` (object frame, metres): 5 degrees at a
    lever of 100 mm move a grasp by 9 mm. As tool noise it acts on the right and the pivot is the tool's
    origin.
    """

    sigma_position_m: float
    sigma_rotation: float
    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        values = (self.sigma_position_m, self.sigma_rotation, *self.pivot)
        if not all(math.isfinite(v) for v in values) or min(values[:2]) < 0.0:
            raise ValueError("noise must be finite and not negative")


def expected(
    value: Score,
    *,
    object_noise: PoseNoise | None = None,
    tool_noise: PoseNoise | None = None,
    samples: int = 64,
) -> Score:
    """The mean of ``value`` (a density or a probability, not a logarithm) under pose noise, itself a score.

    The noise is a fixed scrambled Sobol set of ``samples`` draws, so that the mean is a smooth function of
    the pose; its error falls nearly as 1 / samples.
    """
    displaced = _displaced(_normal(samples), object_noise, tool_noise)

    def mean(poses: Poses) -> Floats:
        values = value(displaced(poses))
        return np.asarray(values.reshape(samples, len(poses)).mean(axis=0), dtype=np.float64)

    return mean


def nearly_expected(
    value: Score,
    free: Admissible,
    *,
    object_noise: PoseNoise | None = None,
    tool_noise: PoseNoise | None = None,
    tested: int = 64,
    valued: int = 8,
) -> Score:
    """Nearly the mean of what `expected` averages where ``value`` is 0 unless a pose is ``free``: for a value
    that costs more than the test, and changes little within the noise.

    It is the share of the first ``tested`` draws that is free times the value's mean over those of ``valued``
    draws that are: these in pairs either way, so that a value's slope cancels out.
    """
    normal = _normal(max(tested, valued // 2))
    tries = _displaced(normal[:tested], object_noise, tool_noise)
    pairs = _displaced(
        np.concatenate([normal[: valued // 2], -normal[: valued // 2]]), object_noise, tool_noise
    )

    def mean(poses: Poses) -> Floats:
        share = free(tries(poses)).reshape(tested, -1).mean(axis=0)
        out = np.zeros(len(poses))
        some = np.flatnonzero(share > 0.0)
        if not some.size:
            return out
        at = pairs(poses[some])
        open_, values = free(at), np.zeros(len(at))
        if open_.any():
            values[open_] = value(at[np.flatnonzero(open_)])
        counts = open_.reshape(-1, len(some)).sum(axis=0)
        out[some] = share[some] * values.reshape(-1, len(some)).sum(axis=0) / np.maximum(counts, 1)
        return out

    return mean


def _normal(samples: int) -> Floats:
    """Standard normal draws (samples, 12): of the object's pose, then of the tool's."""
    if samples < 1:
        raise ValueError(f"samples must be at least 1, not {samples}")
    from scipy.stats import qmc  # late: 0.5 s, and only means need it

    sobol = qmc.Sobol(12, rng=np.random.default_rng(0))
    return np.asarray(ndtri(sobol.random(2 ** math.ceil(math.log2(samples)))[:samples]))


def _displaced(
    normal: Floats, object_noise: PoseNoise | None, tool_noise: PoseNoise | None
) -> Callable[[Poses], Poses]:
    """What draws (S, 12) make of poses (M): (S M), those of one draw one after the other."""
    left_p, left_q = _draws(object_noise, normal[:, :6])
    right_p, right_q = _draws(tool_noise, normal[:, 6:])
    pivot = np.zeros(3) if object_noise is None else np.array(object_noise.pivot)

    def displaced(poses: Poses) -> Poses:
        p, q = poses
        seen_p = pivot + se3.rotate(left_q[:, None], p[None] - pivot) + left_p[:, None]
        seen_q = se3.multiply(left_q[:, None], q[None])
        at, to = se3.compose(Poses(seen_p, seen_q), Poses(right_p[:, None], right_q[:, None]))
        return Poses(at.reshape(-1, 3), se3.normalise(to.reshape(-1, 4)))

    return displaced


def expected_over(value: Score, displacements: Poses, weights: Floats) -> Score:
    """The mean of ``value`` where the object is displaced, itself a score.

    Parameters
    ----------
    displacements : (K)
        By which a grasp is displaced, seen from where the object is: on the left of a pose.
    weights : (K,)
        How likely each is; they sum up to 1.
    """
    count = len(displacements)
    left_p, left_q = displacements.positions[:, None], displacements.quaternions_xyzw[:, None]

    def mean(poses: Poses) -> Floats:
        p, q = poses
        at, to = se3.rotate(left_q, p[None]) + left_p, se3.multiply(left_q, q[None])
        values = value(Poses(at.reshape(-1, 3), se3.normalise(to.reshape(-1, 4))))
        return np.asarray(weights @ values.reshape(count, len(p)), dtype=np.float64)

    return mean


def normal_displacements(covariance: Floats, samples: int) -> Floats:
    """Draws (samples, 6) of a normal distribution of a covariance (6, 6), the first a power of two of a fixed
    scrambled Sobol set; ValueError where it is none.
    """
    values, axes = np.linalg.eigh(np.asarray(covariance, dtype=np.float64))
    if values.min() < -1e-9 * max(values.max(), 1e-30):
        raise ValueError("a covariance has no negative eigenvalue")
    from scipy.stats import qmc  # late: 0.5 s, and only means need it

    uniform = qmc.Sobol(6, rng=np.random.default_rng(0)).random(2 ** math.ceil(math.log2(samples)))
    return np.asarray(ndtri(uniform[:samples]) @ (axes * np.sqrt(np.maximum(values, 0.0))).T)


def _draws(noise: PoseNoise | None, normal: Floats) -> tuple[Floats, Floats]:
    scale = (0.0, 0.0) if noise is None else (noise.sigma_position_m, noise.sigma_rotation)
    return normal[:, :3] * scale[0], se3.from_rotation_vector(normal[:, 3:] * scale[1])
