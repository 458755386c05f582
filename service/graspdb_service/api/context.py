"""The composition of one service process: routes hand use cases what they need of it."""

from __future__ import annotations

from dataclasses import dataclass

from graspdb_service.settings import Settings
from graspdb_service.storage.database import Database
from graspdb_service.usecases.densities.cache import Densities
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.densities.prior import Priors
from graspdb_service.usecases.densities.success_models import Successes
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.geometry.features import Features
from graspdb_service.usecases.reports.runs import ReportRuns
from graspdb_service.usecases.runtime.compute import Compute


@dataclass(kw_only=True)
class Context(Estimators):
    """The parts of one service process."""

    reports: ReportRuns

    @classmethod
    def create(cls, settings: Settings, database: Database) -> Context:
        compute = Compute(settings.threads)
        features = Features(database, compute)
        densities = Densities(database, compute, features, settings.max_density_cache_bytes)
        scenes = Scenes(database, compute, features)
        return cls(
            settings=settings,
            database=database,
            compute=compute,
            densities=densities,
            scenes=scenes,
            priors=Priors(compute, scenes),
            successes=Successes(database, compute, settings.max_density_cache_bytes),
            reports=ReportRuns(settings, database, densities, scenes),
        )

    def close(self) -> None:
        self.reports.close()
        self.compute.close()
        self.database.dispose()
