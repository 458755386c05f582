"""What the reports share: what they are computed from, and how too few trials are said."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from graspdb.wire.reports import (
    ReportRange,
)
from graspdb_service.problems import conflict
from graspdb_service.storage.database import Database
from graspdb_service.usecases.densities.cache import Built, Densities
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.reports.convergence_cache import KeptCurves
from graspdb_service.usecases.trials import attempts
from graspdb_service.usecases.trials.attempts import AllTrials

T = TypeVar("T")

LEVEL = 0.9
"""Probability that the intervals of reports hold."""


@dataclass(frozen=True)
class Sources:
    """What reports are computed from."""

    database: Database
    densities: Densities
    scenes: Scenes
    threads: int
    curves: KeptCurves


def said(call: Callable[[], T]) -> T:
    """What the maths refuses as too few trials, as a problem that says so."""
    try:
        return call()
    except ValueError as error:
        text = str(error)
        raise conflict("too-few-trials", text[:1].upper() + text[1:]) from None


def head(built: Built) -> dict[str, Any]:
    selected = built.selected
    return {
        "object": built.object_row.slug,
        "revision": built.revision,
        "gripper": selected.gripper,
        "protocol": selected.protocol,
        "source": selected.source,
    }


def finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def interval(value: float, low: float, high: float) -> ReportRange:
    return ReportRange(value=finite(value), low=finite(low), high=finite(high))


def attempts_of(sources: Sources, built: Built) -> AllTrials:
    return attempts.read(sources.database, built.object_row, built.selected)


def need_failures(everything: AllTrials, what: str, least: int) -> None:
    failures = int((~everything.success).sum())
    if failures < least:
        there = "only successes are" if not failures else f"only {failures} are"
        raise conflict(
            "failures-needed",
            f"{what} needs failures too, at least {least}; {there} known: post the attempts that failed, or"
            " sweep a grid",
        )
