"""The composition of one service process: routes hand use cases what they need of it."""

from __future__ import annotations

from dataclasses import dataclass

from graspdb_service.settings import Settings
from graspdb_service.storage.database import Database
from graspdb_service.storage.upkeep.probe import Probe
from graspdb_service.usecases.access.key_ring import KeyRing
from graspdb_service.usecases.answers.asking import Asking
from graspdb_service.usecases.answers.keeping import AnswerKeeper
from graspdb_service.usecases.cells.robots import Robots
from graspdb_service.usecases.densities.cache import Densities
from graspdb_service.usecases.densities.evidence.collisions import CollisionEvidence
from graspdb_service.usecases.densities.evidence.symmetries import Symmetries
from graspdb_service.usecases.densities.learned.learning import Learning
from graspdb_service.usecases.densities.prior import Priors
from graspdb_service.usecases.densities.success_models import Successes
from graspdb_service.usecases.geometry.collision import Scenes
from graspdb_service.usecases.geometry.features import Features
from graspdb_service.usecases.geometry.pictures import Pictures
from graspdb_service.usecases.geometry.symmetries import ShapeSymmetries
from graspdb_service.usecases.kernels import fit
from graspdb_service.usecases.reports.registry import Reports
from graspdb_service.usecases.runtime.compute import Compute
from graspdb_service.usecases.runtime.health import Health
from graspdb_service.usecases.runtime.runs import Runs
from graspdb_service.usecases.trials.selection import Selections
from graspdb_service.usecases.upkeep.upkeep import Upkeep


@dataclass(kw_only=True)
class Context(Asking):
    """The parts of one service process."""

    reports: Reports
    runs: Runs
    health: Health
    upkeep: Upkeep
    pictures: Pictures
    keys: KeyRing

    @classmethod
    def create(cls, settings: Settings, database: Database) -> Context:
        probe = Probe(database, min_free_bytes=settings.min_free_disk_bytes)
        health = Health(probe.look, settings.probe_seconds, may_hang=not database.is_sqlite)
        # From here on a file that is gone is no empty database, and what hangs is not waited for.
        database.keep_file()
        database.down = health.down
        compute = Compute(
            settings.threads,
            settings.max_question_seconds,
            long=settings.max_long_questions_at_once,
            waiting_long=settings.max_queries_at_once,
        )
        features = Features(database, compute)
        densities = Densities(
            database, Selections(database), compute, features, settings.max_density_cache_bytes
        )
        scenes = Scenes(database, compute, features)
        pictures = Pictures(database, compute, scenes, densities.selections)
        learning = Learning(database, scenes, enabled=settings.learned_estimates)
        successes = Successes(database, compute, learning, settings.max_density_cache_bytes)
        reports = Reports(settings, database, densities, scenes, successes)
        fits = fit.run_kind(densities, features, settings.threads)
        return cls(
            settings=settings,
            database=database,
            compute=compute,
            densities=densities,
            scenes=scenes,
            robots=Robots(database, compute),
            evidence=CollisionEvidence(scenes, compute),
            symmetries=Symmetries(ShapeSymmetries(database, compute), compute),
            priors=Priors(compute, scenes),
            successes=successes,
            answers=AnswerKeeper(database, most=settings.max_answers),
            pictures=pictures,
            reports=reports,
            keys=KeyRing(database),
            health=health,
            upkeep=Upkeep(settings, database),
            runs=Runs(database, wait_s=settings.report_wait_s, kinds={fit.RUN: fits, **reports.run_kinds()}),
        )

    def close(self) -> None:
        self.answers.close()
        self.densities.widths.close()
        self.successes.learning.close()
        self.health.close()
        self.upkeep.close()
        self.runs.close()
        self.keys.close()
        self.database.dispose()
