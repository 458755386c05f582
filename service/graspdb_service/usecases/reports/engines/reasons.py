"""Why a grasp holds in one engine and not in the other, as far as what was measured tells."""

from __future__ import annotations

import math
from dataclasses import dataclass

from graspdb.wire.reports import EngineReasonName

#: A quality this near to the protocol's limit is about as good as one on its other side: qualities are a
#: weight held over the object's, or a displacement over the one allowed, and theory holds within 20 %.
NEAR = 0.2
_LIMITS = {"wrench": 1.0}
#: What an engine calls a grasp that it lost before, or without, its margin being what decided.
_LOST = ("missed", "slipped", "dropped")

WORDS: dict[EngineReasonName, str] = {
    "draws": f"they succeed in about as many draws, within {NEAR:.0%} of them, and half lies between",
    "margin": f"a quality lies within {NEAR:g} of the limit: they hold about as much, the limit between them",
    "edge": "one missed the object or lost it, far from the limit: the contact is thin, near an edge",
    "timeout": "one was still closing or carrying when its time was over",
    "unexplained": "neither is near the limit, and none missed or lost it",
    "broke-off": "one could not simulate it, as where a finger sank in: nothing is compared there",
}
"""What each reason means."""


@dataclass(frozen=True)
class Said:
    """What an engine says of a grasp that it simulated so many times (``draws``); NaN where it measured
    nothing.
    """

    engine: str
    outcome: str
    quality: float
    width_m: float
    successes: int = 0
    draws: int = 1

    @property
    def holds(self) -> bool:
        return self.outcome == "success"

    def margin(self, protocol: str) -> float:
        """How far its quality is from the limit, from 0; infinite where it has none."""
        # Of a jaw that closed on nothing, 0 was measured of nothing: what was carried too far has less.
        empty = self.outcome in ("missed", "slipped") and self.quality == 0.0
        if empty or math.isnan(self.quality):
            return math.inf
        return abs(self.quality - _LIMITS.get(protocol, 0.0))


def reason(protocol: str, one: Said, two: Said) -> EngineReasonName:
    """Why two engines differ on a grasp that holds in one of them."""
    failed = two if one.holds else one
    if one.draws > 1 and abs(one.successes - two.successes) <= max(1.0, NEAR * one.draws):
        return "draws"
    if failed.outcome == "timeout":
        return "timeout"
    if min(one.margin(protocol), two.margin(protocol)) <= NEAR:
        return "margin"
    return "edge" if failed.outcome in _LOST else "unexplained"


def words(protocol: str, one: Said, two: Said) -> str:
    """Both opinions with their numbers."""
    limit = _LIMITS.get(protocol, 0.0)
    return f"{_opinion(one)}, {_opinion(two)}; {protocol} succeeds from {limit:g} on"


def _opinion(said: Said) -> str:
    numbers = [f"{said.successes} of {said.draws}"] if said.draws > 1 else []
    if not math.isnan(said.quality):
        numbers.append(f"quality {said.quality:.2f}")
    if not math.isnan(said.width_m):
        numbers.append(f"{1e3 * said.width_m:.1f} mm between the fingers")
    told = f" ({', '.join(numbers)})" if numbers else ""
    return f"{said.outcome.replace('_', ' ')} in {said.engine}{told}"
