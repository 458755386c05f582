"""The reports, computed: parameters to the documents of :mod:`graspdb.wire.reports`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from graspdb.wire.reports import AnyReport
from graspdb_density.kde.weighted_sums import Progress
from graspdb_service.usecases.densities.cache import Built, KernelChoice
from graspdb_service.usecases.reports.anisotropy import anisotropy_report
from graspdb_service.usecases.reports.bandwidth import bandwidth_report
from graspdb_service.usecases.reports.calibration import calibration_report
from graspdb_service.usecases.reports.common import Sources
from graspdb_service.usecases.reports.convergence import convergence_report
from graspdb_service.usecases.reports.kernel_similarity import kernel_similarity_report
from graspdb_service.usecases.reports.projection import projection_report
from graspdb_service.usecases.reports.sources import sources_report
from graspdb_service.usecases.trials.selection import Filters


@dataclass(frozen=True)
class Asked:
    """Parameters of a report, everything resolved: the same ones give the same report of a revision."""

    report: str
    filters: Filters
    kernel: KernelChoice
    options: dict[str, str]

    def document(self) -> dict[str, Any]:
        """As a run keeps it."""
        return {
            "report": self.report,
            "filters": vars(self.filters),
            "kernel": vars(self.kernel),
            "options": self.options,
        }

    @classmethod
    def of(cls, document: dict[str, Any]) -> Asked:
        return cls(
            document["report"],
            Filters(**document["filters"]),
            KernelChoice(**document["kernel"]),
            document["options"],
        )


def compute(sources: Sources, slug: str, asked: Asked, progress: Progress) -> AnyReport:
    """The report.

    Raises
    ------
    ProblemError
        409 where the trials don't suffice, saying what is missing and how much of it.
    """
    built = sources.densities.get(slug, asked.filters, asked.kernel)
    return _REPORTS[asked.report](sources, built, asked.options, progress)


_REPORTS: dict[str, Callable[[Sources, Built, dict[str, str], Progress], AnyReport]] = {
    "anisotropy": anisotropy_report,
    "bandwidth": bandwidth_report,
    "calibration": calibration_report,
    "convergence": convergence_report,
    "kernel-similarity": kernel_similarity_report,
    "projection": projection_report,
    "sources": sources_report,
}
