"""The 90 % interval covers the kernel-smoothed truth wherever attempts are dense or sparse.

The fields here are made for this test and were not looked at while anything was tuned. What the interval
claims to cover is the field smoothed by the kernel over the attempts there are, ``sum k f / sum k``.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from graspdb_density import IsotropicKernel, SuccessModel, se3
from graspdb_density.se3 import Poses
from graspdb_density.success.kernel_regression import SUCCESS_CUTOFF

Field = Callable[[se3.Floats, se3.Floats], se3.Floats]
Pair = tuple[se3.Floats, se3.Floats]

KERNEL = IsotropicKernel(0.015, math.radians(15))
#: Edges of the bins of data density, in effective trials.
BINS = (2.0, 8.0, 30.0, 120.0, math.inf)
LEAST = 400


def ridge(p: se3.Floats, q: se3.Floats) -> se3.Floats:
    """Likely along a curved line, for tools that look down on it."""
    away = p[:, 1] - 0.03 * np.sin(40.0 * p[:, 0])
    look = se3.rotate(q, [0.0, 0.0, 1.0])[:, 2]
    return np.asarray(0.1 + 0.8 * np.exp(-0.5 * (away / 0.025) ** 2) * (0.5 - 0.5 * look))


def steps(p: se3.Floats, q: se3.Floats) -> se3.Floats:
    """Two plateaus with an edge between them, other for either half of the closing directions."""
    across = se3.rotate(q, [0.0, 1.0, 0.0])[:, 0] ** 2 > 0.5
    return np.where(p[:, 0] > 0.0, np.where(across, 0.85, 0.6), np.where(across, 0.35, 0.15))


def waves(p: se3.Floats, q: se3.Floats) -> se3.Floats:
    """Smooth in everything."""
    tilt = se3.rotate(q, [0.0, 0.0, 1.0])
    return np.asarray(0.5 + 0.35 * np.sin(50.0 * p[:, 0] + 2.0 * tilt[:, 0]) * np.cos(45.0 * p[:, 2]))


def attempts(count: int, rng: np.random.Generator) -> Pair:
    """Dense in the middle and thinning out: from hundreds of effective trials to hardly one."""
    spread = np.exp(rng.uniform(math.log(0.008), math.log(0.12), (count, 1)))
    turn = np.exp(rng.uniform(math.log(0.15), math.log(2.0), (count, 1)))
    return rng.normal(size=(count, 3)) * spread, se3.from_rotation_vector(rng.normal(size=(count, 3)) * turn)


def smoothed(field: Field, rows: Pair, poses: Pair) -> se3.Floats:
    """``sum k f / sum k`` over the rows within reach, both twins of each."""
    chance, twins = field(*rows), se3.jaw_twin(rows[1])
    out = np.empty(len(poses[0]))
    for j, (p, q) in enumerate(zip(*poses, strict=True)):
        own = KERNEL.log_kernel(se3.Poses(p, q), se3.Poses(rows[0], rows[1])) - KERNEL.log_peak
        other = KERNEL.log_kernel(se3.Poses(p, q), se3.Poses(rows[0], twins)) - KERNEL.log_peak
        k = (np.exp(own) + np.exp(other)) * (np.maximum(own, other) >= -0.5 * SUCCESS_CUTOFF**2)
        out[j] = k @ chance / k.sum() if k.any() else np.nan
    return out


@pytest.mark.long
@pytest.mark.parametrize("field", [ridge, steps, waves])
def test_every_bin_of_data_density_is_covered(field: Field) -> None:
    rng = np.random.default_rng(sum(map(ord, field.__name__)))
    covered: list[list[bool]] = [[] for _ in BINS]
    for _ in range(40):
        rows = attempts(6_000, rng)
        model = SuccessModel.build(Poses.of(*rows), rng.random(6_000) < field(*rows), kernel=KERNEL)
        poses = attempts(120, rng)
        estimate = model.evaluate(Poses.of(*poses))
        truth = smoothed(field, rows, poses)
        inside = (estimate.low <= truth) & (truth <= estimate.high)
        for i in np.flatnonzero(estimate.effective_trials > 0.0):
            covered[int(np.searchsorted(BINS, estimate.effective_trials[i]))].append(bool(inside[i]))
    shares = {edge: (len(hits), float(np.mean(hits))) for edge, hits in zip(BINS, covered, strict=True)}
    for number, share in shares.values():
        assert number >= LEAST, shares
        assert 0.85 <= share <= 0.97, shares
