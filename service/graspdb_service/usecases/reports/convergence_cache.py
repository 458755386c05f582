"""Convergence curves kept from one report to the next, so that new trials are added to what was summed.

What a kept curve was made of it tells itself (see `incremental_bootstrap`): after a deletion, other
weights or another process's commits it is extended or computed anew as its grasps demand, and reports of
several processes agree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from graspdb_density.bandwidth.matching import Match
from graspdb_density.kde.weighted_sums import Progress
from graspdb_density.statistics.incremental_bootstrap import GrowingCurve
from graspdb_service.usecases.densities.cache import Built
from graspdb_service.usecases.runtime.cache import SingleFlightCache
from graspdb_service.usecases.trials.selection import Filters

#: What a kept match takes, roughly, and all of them may.
_MATCH_BYTES, _MATCHES_BYTES = 1_024, 2**20


@dataclass(frozen=True)
class _Key:
    object_id: int
    filters: Filters
    kernel_id: str | None
    sigma_position_m: float
    sigma_rotation_deg: float


class KeptCurves:
    """The curves of one service process.

    Parameters
    ----------
    max_bytes
        What all of them together may take; a curve of 20,000 points takes about 10 MB.
    """

    def __init__(self, max_bytes: int) -> None:
        self._curves: SingleFlightCache[_Key, GrowingCurve] = SingleFlightCache(max_bytes, lambda c: c.nbytes)
        self._matches: SingleFlightCache[tuple[bytes, str], Match] = SingleFlightCache(
            _MATCHES_BYTES, lambda _: _MATCH_BYTES
        )

    def grown(
        self,
        built: Built,
        matched: Match | None,
        grow: Callable[[GrowingCurve | None, Progress], GrowingCurve],
        progress: Progress,
    ) -> GrowingCurve:
        """The curve of a density, or of the isotropic kernel matched to it, made by ``grow`` of the one kept
        before.
        """
        kernel = built.kernel
        key = _Key(
            built.object_row.id,
            built.selected.filters,
            kernel.id,
            kernel.sigma_position_m if matched is None else matched.kernel.sigma_position_m,
            kernel.sigma_rotation_deg if matched is None else matched.kernel.sigma_rotation,
        )
        # A curve that nothing is to be added to comes back as it is.
        return self._curves.get(key, lambda _: False, lambda before: grow(before, progress))

    def match(self, curve: GrowingCurve, rule: str, make: Callable[[], Match]) -> Match:
        """The isotropic kernel matched to a curve's: the same until the curve is computed anew."""
        return self._matches.get((curve.generation, rule), lambda _: True, lambda _: make())

    @property
    def nbytes(self) -> int:
        return self._curves.nbytes
