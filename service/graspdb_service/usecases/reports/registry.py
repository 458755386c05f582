"""The reports of one service process: what a request asks for, as a run's key, and how a run computes it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Any

from graspdb.wire import Selection
from graspdb.wire.queries import TrialSelection
from graspdb.wire.reports import REPORTS, Report, ReportOptions
from graspdb_density.kde.weighted_sums import Progress
from graspdb_service import __version__
from graspdb_service.settings import Settings
from graspdb_service.storage import report_runs
from graspdb_service.storage.database import Database
from graspdb_service.storage.report_runs import RunKey, RunRow
from graspdb_service.storage.simulation import outcomes
from graspdb_service.usecases.densities.build import Built, KernelChoice
from graspdb_service.usecases.densities.cache import Densities, kernel_of
from graspdb_service.usecases.densities.success_models import Successes
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.reports.anisotropy import anisotropy_report
from graspdb_service.usecases.reports.bandwidth import bandwidth_report
from graspdb_service.usecases.reports.calibration import calibration_report
from graspdb_service.usecases.reports.common import KeptCurves, ReportInputs
from graspdb_service.usecases.reports.convergence import convergence_report
from graspdb_service.usecases.reports.engines.report import engines_report
from graspdb_service.usecases.reports.kernel_similarity import kernel_similarity_report
from graspdb_service.usecases.reports.projection import projection_report
from graspdb_service.usecases.reports.promises.report import promises_report
from graspdb_service.usecases.reports.sources import sources_report
from graspdb_service.usecases.runtime.runs import Result, RunKind

#: Kept convergence curves may take this part of what densities may.
_CURVES_SHARE = 4
#: Reports that say what became of simulated checks.
_OF_CHECKS = ("bandwidth", "calibration", "engines")
_COMPUTE: Mapping[str, Callable[[ReportInputs, Built, Any, Progress], Report]] = {
    "anisotropy": anisotropy_report,
    "bandwidth": bandwidth_report,
    "calibration": calibration_report,
    "convergence": convergence_report,
    "engines": engines_report,
    "kernel-similarity": kernel_similarity_report,
    "projection": projection_report,
    "promises": promises_report,
    "sources": sources_report,
}


class Reports:
    """What runs of reports are keyed by, and how they are computed."""

    def __init__(
        self,
        settings: Settings,
        database: Database,
        densities: Densities,
        scenes: Scenes,
        successes: Successes,
    ) -> None:
        curves = KeptCurves(settings.max_density_cache_bytes // _CURVES_SHARE)
        self._inputs = ReportInputs(database, densities, scenes, settings.threads, curves, successes)

    def key(self, slug: str, report: str, options: ReportOptions) -> RunKey:
        """The run of a report, all of it resolved: the same parameters give the same report of a revision."""
        selection = Selection(**{name: getattr(options, name, None) for name in Selection.model_fields})
        choice, _ = kernel_of(selection)
        densities = self._inputs.densities
        selected = densities.selections.resolve(slug, selection)
        if choice.stored is not None:
            choice = KernelChoice(stored=densities.stored(selected, choice.stored).id)
        own = options.model_dump(mode="json", exclude=set(Selection.model_fields), exclude_none=True)
        if report in _OF_CHECKS or own.get("matching") == "success":
            # Checks change no revision: what of them there is belongs to the question.
            with self._inputs.database.read() as tx:
                own[report_runs.CHECKS] = outcomes.checks_stamp(tx, selected.row.id)
        parameters = {
            "report": report,
            "filters": selected.filters.model_dump(),
            # Another profile changes no revision.
            "gripper_stamp": selected.stamp,
            "kernel": vars(choice),
            "options": own,
        }
        digest = hashlib.sha256(json.dumps([parameters, __version__], sort_keys=True).encode()).hexdigest()
        return RunKey(selected.row.id, selected.row.revision, report, digest, parameters)

    def compute(self, slug: str, parameters: Mapping[str, Any], progress: Progress) -> Report:
        """The report by the parameters of a run; 409 says what is missing where the trials don't suffice."""
        report = parameters["report"]
        own = {name: value for name, value in parameters["options"].items() if name != report_runs.CHECKS}
        options = REPORTS[report].options.model_validate(own)
        asked, kernel = TrialSelection(**parameters["filters"]), KernelChoice(**parameters["kernel"])
        densities = self._inputs.densities
        built = densities.get(densities.selections.resolve(slug, asked), kernel)
        found = _COMPUTE[report](self._inputs, built, options, progress)
        return found.model_copy(update={"warnings": [*built.selected.warnings, *found.warnings]})

    def run_kinds(self) -> dict[str, RunKind]:
        """Runs that compute reports."""

        def compute(run: RunRow, progress: Progress) -> Result:
            result = self.compute(run.object, run.parameters, progress).model_dump_json()
            return lambda tx: result

        return dict.fromkeys(REPORTS, RunKind("report", compute))
