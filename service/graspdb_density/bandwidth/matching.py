"""Isotropic kernels that match another kernel's width: without saying how widths are matched, "converges
faster" says nothing. Three rules: equal determinants of the position and the rotation block, equal likelihood
of held-out grasps, equal success of simulated draws (collisions are failures).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import isotonic_regression

from ..kernels.gaussian_mixture import Kernel
from ..kernels.isotropic import POSITION_LIMITS_M, ROTATION_LIMITS, IsotropicKernel
from ..se3 import Floats

__all__ = [
    "Match",
    "match_determinants",
    "match_likelihood",
    "match_success",
    "scaled",
    "success_ends",
]

#: Factors on both widths of the base kernel that a search tries, before it refines, and how near in nats it
#: has to come.
_FACTORS, _TOLERANCE = tuple(float(f) for f in np.geomspace(0.4, 2.5, 11)), 0.01
_RESAMPLES = 400


@dataclass(frozen=True, slots=True)
class Match:
    """An isotropic kernel matched by a rule.

    ``reached`` is false where no width tried attains the target: the kernel is then the one that comes
    nearest, and ``achieved`` says how near.
    """

    rule: str
    kernel: IsotropicKernel
    target: float
    achieved: float
    reached: bool


def match_determinants(kernel: Kernel) -> Match:
    """The isotropic kernel whose position and rotation blocks have the kernel's determinants.

    ``achieved`` and ``target`` are the log determinant of both blocks together.
    """
    cov = kernel.overall_covariance
    blocks = [float(np.linalg.slogdet(cov[part, part])[1]) for part in (slice(0, 3), slice(3, 6))]
    sigma, turn = (math.exp(value / 6.0) for value in blocks)
    found = _clipped(sigma, turn)
    achieved = 6.0 * (math.log(found.sigma_position_m) + math.log(found.sigma_rotation))
    target = sum(blocks)
    return Match("determinants", found, target, achieved, abs(achieved - target) < 1e-6)


def match_likelihood(
    target: float,
    base: IsotropicKernel,
    likelihood: Callable[[IsotropicKernel], float],
) -> Match:
    """Scale both widths until held-out grasps are as likely as ``target`` nats.

    The likelihood rises and falls with the width, so two widths may match; the wider is taken, which
    converges faster and so favours the isotropic kernel in a comparison.

    Parameters
    ----------
    likelihood : callable
        Mean log density of held-out grasps under a kernel, nats of 1/(m^3 rad^3).
    """
    tried, tolerance = _FACTORS, _TOLERANCE
    values = [likelihood(scaled(base, f)) for f in tried]
    top = int(np.argmax(values))
    if values[top] < target - tolerance:
        return Match("likelihood", scaled(base, tried[top]), target, values[top], False)
    below = [i for i in range(top, len(tried)) if values[i] < target]
    if not below:
        # Even the widest is as likely: nothing tried is wide enough.
        near = abs(values[-1] - target) <= tolerance
        return Match("likelihood", scaled(base, tried[-1]), target, values[-1], near)
    inner, outer = tried[max(below[0] - 1, top)], tried[below[0]]
    if inner == outer:
        return Match("likelihood", scaled(base, inner), target, values[top], True)
    factor, value = inner, values[max(below[0] - 1, top)]
    for _ in range(12):
        if abs(value - target) <= tolerance:
            break
        factor = math.sqrt(inner * outer)
        value = likelihood(scaled(base, factor))
        inner, outer = (factor, outer) if value >= target else (inner, factor)
    return Match("likelihood", scaled(base, factor), target, value, abs(value - target) <= tolerance)


def match_success(
    target: float,
    base: IsotropicKernel,
    success: ArrayLike,
    *,
    factors: ArrayLike,
    draws: ArrayLike,
) -> Match:
    """Scale both widths until draws from the density succeed as often as ``target``.

    Draws succeed less the wider the kernel; measured rates are made monotone first (weighted by ``draws``)
    and interpolated over the log of the factor.

    Parameters
    ----------
    success : (K,)
        Shares of simulated draws that succeed, collisions counted as failures, measured at
        ``scaled(base, factor)`` for each of ``factors``.
    draws : (K,)
        Draws behind each rate.

    Raises
    ------
    ValueError
        For rates outside [0, 1], or arrays that do not match.
    """
    tried, rates, counts = (np.array(column, dtype=np.float64) for column in (factors, success, draws))
    if rates.shape != tried.shape or counts.shape != tried.shape or len(tried) < 2:
        raise ValueError("factors, rates and draws are arrays of one length, at least 2")
    if not (np.all(rates >= 0.0) and np.all(rates <= 1.0) and np.all(counts > 0.0) and np.all(tried > 0.0)):
        raise ValueError("rates lie in [0, 1]; draws and factors are positive")
    order = np.argsort(tried)
    tried = tried[order]
    smooth = isotonic_regression(rates[order], weights=counts[order], increasing=False).x
    if not smooth[-1] <= target <= smooth[0]:
        end = 0 if target > smooth[0] else -1
        return Match("success", scaled(base, float(tried[end])), target, float(smooth[end]), False)
    # np.interp wants rising abscissae; of equal rates the widest kernel is taken, as for the likelihood.
    factor = math.exp(_falling_inverse(np.log(tried), smooth, target))
    achieved = float(np.interp(math.log(factor), np.log(tried), smooth))
    return Match("success", scaled(base, factor), target, achieved, True)


def success_ends(
    target: float,
    base: IsotropicKernel,
    success: ArrayLike,
    *,
    factors: ArrayLike,
    draws: ArrayLike,
    target_draws: int,
    level: float = 0.9,
) -> tuple[IsotropicKernel, IsotropicKernel]:
    """The narrowest and the widest kernel that `match_success` may mean, as draws are few: quantiles over
    draws that succeed anew by chance, those of the target too. Arguments as there.
    """
    rates, counts = np.array(success, dtype=np.float64), np.array(draws, dtype=np.int64)
    rng = np.random.default_rng(0)
    widths = [
        match_success(
            float(rng.binomial(target_draws, target)) / target_draws,
            base,
            rng.binomial(counts, rates) / counts,
            factors=factors,
            draws=counts,
        ).kernel.sigma_position_m
        for _ in range(_RESAMPLES)
    ]
    low, high = np.quantile(widths, [0.5 * (1.0 - level), 0.5 * (1.0 + level)]) / base.sigma_position_m
    return scaled(base, float(low)), scaled(base, float(high))


def _falling_inverse(x: Floats, y: Floats, target: float) -> float:
    """The largest x where the falling polyline y(x) has the target."""
    last = int(np.flatnonzero(y >= target)[-1])
    if last == len(x) - 1 or y[last] == target:
        return float(x[last])
    share = (y[last] - target) / (y[last] - y[last + 1])
    return float(x[last] + share * (x[last + 1] - x[last]))


def scaled(base: IsotropicKernel, factor: float) -> IsotropicKernel:
    """Both widths times a factor, kept within what a kernel may be."""
    return _clipped(base.sigma_position_m * factor, base.sigma_rotation * factor)


def _clipped(sigma: float, turn: float) -> IsotropicKernel:
    return IsotropicKernel(
        min(max(sigma, POSITION_LIMITS_M[0]), POSITION_LIMITS_M[1]),
        min(max(turn, ROTATION_LIMITS[0]), ROTATION_LIMITS[1]),
    )
