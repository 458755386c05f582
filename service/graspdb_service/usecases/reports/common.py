"""What the reports share: what they are computed from, how numbers go to the wire, and too few trials."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel
from scipy.spatial import cKDTree
from scipy.special import betaincinv

from graspdb.wire.queries import TrialSelection
from graspdb.wire.reports import ReportRange
from graspdb_density import SuccessModel
from graspdb_density.bandwidth.matching import Match
from graspdb_density.kde.weighted_sums import Progress
from graspdb_density.se3 import Poses
from graspdb_density.statistics.incremental_bootstrap import IncrementalCurve
from graspdb_density.success.kernel_regression import SUCCESS_CUTOFF, SuccessKernel
from graspdb_service.problems import conflict, too_few_trials
from graspdb_service.storage.database import Database
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.cache import Densities
from graspdb_service.usecases.densities.success_models import Successes
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.trials.attempts import AllTrials

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)

LEVEL = 0.9
"""Probability that the intervals of reports hold."""
#: What a kept match takes, roughly, and all of them may.
_MATCH_BYTES, _MATCHES_BYTES = 1_024, 2**20


@dataclass(frozen=True)
class ReportInputs:
    """What reports are computed from."""

    database: Database
    densities: Densities
    scenes: Scenes
    threads: int
    curves: KeptCurves
    successes: Successes


class KeptCurves:
    """Convergence curves kept from one report to the next, so that new trials are added to what was summed.

    What a kept curve was made of it tells itself (see `incremental_bootstrap`): after a deletion, other
    weights or another process's commits it is extended or computed anew as its grasps demand, and reports of
    several processes agree. A curve of 20,000 points takes about 10 MB.
    """

    def __init__(self, max_bytes: int) -> None:
        self._curves: SingleFlightCache[
            tuple[tuple[int, TrialSelection, int | None], str | None, float, float], IncrementalCurve
        ]
        self._curves = SingleFlightCache(max_bytes, lambda curve: curve.nbytes)
        self._matches: SingleFlightCache[tuple[bytes, str], Match]
        self._matches = SingleFlightCache(_MATCHES_BYTES, lambda _: _MATCH_BYTES)

    def grown(
        self,
        built: Built,
        matched: Match | None,
        grow: Callable[[IncrementalCurve | None, Progress], IncrementalCurve],
        progress: Progress,
    ) -> IncrementalCurve:
        """The curve of a density, or of the isotropic kernel matched to it, made by ``grow`` of the one kept
        before.
        """
        kernel = built.kernel
        widths = (
            (kernel.sigma_position_m, kernel.sigma_rotation_deg)
            if matched is None
            else (matched.kernel.sigma_position_m, matched.kernel.sigma_rotation)
        )
        key = (built.selected.key, kernel.id, *widths)
        # A curve that nothing is to be added to comes back as it is.
        return self._curves.get(key, lambda _: False, lambda before: grow(before, progress))

    def match(self, curve: IncrementalCurve, rule: str, make: Callable[[], Match]) -> Match:
        """The isotropic kernel matched to a curve's: the same until the curve is computed anew."""
        return self._matches.get((curve.generation, rule), lambda _: True, lambda _: make())


# -- to the wire


def head(built: Built) -> dict[str, Any]:
    """What every report says first; its text follows."""
    selected = built.selected
    return {
        "object": built.object_row.slug,
        "revision": built.revision,
        "gripper": selected.gripper,
        "gripper_versions": list(selected.versions),
        "protocol": selected.protocol,
        "source": selected.source,
        "level": LEVEL,
        "text": "",
    }


def as_model(model: type[M], item: object, **more: Any) -> M:
    """A model of an item's fields of the same names; what is not finite becomes null."""
    names = [name for name in model.model_fields if name not in more and hasattr(item, name)]
    return model.model_validate({**{name: _plain(getattr(item, name)) for name in names}, **more})


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def interval(value: float, low: float, high: float) -> ReportRange:
    return ReportRange(value=finite(value), low=finite(low), high=finite(high))


def share(won: float, tried: float) -> ReportRange:
    """A share of independent trials with Jeffreys' interval, which includes what was seen."""
    if not tried > 0:
        return ReportRange(value=None, low=None, high=None)
    value, tail = won / tried, 0.5 * (1.0 - LEVEL)
    low, high = (float(betaincinv(won + 0.5, tried - won + 0.5, t)) for t in (tail, 1.0 - tail))
    return ReportRange(value=value, low=min(low, value), high=max(high, value))


# -- what there has to be


def enough(call: Callable[[], T]) -> T:
    """What the maths refuses as too few trials, as a problem that says so."""
    try:
        return call()
    except ValueError as error:
        raise too_few_trials(str(error)) from None


def model_near(
    everything: AllTrials, poses: Poses, kernel: SuccessKernel, sigma_m: float, *, collisions_known: bool
) -> SuccessModel | None:
    """What attempts tell of poses, by those within a kernel of ``sigma_m`` of one: of millions few are."""
    tree = cKDTree(poses.positions)
    distance, _ = tree.query(everything.poses.positions, distance_upper_bound=SUCCESS_CUTOFF * sigma_m)
    near = np.isfinite(distance)
    if collisions_known:
        # Those that collided tell nothing of the others.
        near &= ~everything.collided
    return everything.success_model(kernel, near) if near.any() else None


def need_failures(everything: AllTrials, what: str, least: int) -> None:
    failures = int((~everything.success).sum())
    if failures < least:
        there = "only successes are" if not failures else f"only {failures} are"
        raise conflict(
            "failures-needed",
            f"{what} needs failures too, at least {least}; {there} known: post the attempts that failed, or"
            " sweep a grid",
        )
