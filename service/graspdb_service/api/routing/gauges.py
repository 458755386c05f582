"""What a service process has and holds, read when Prometheus asks; no request waits for the database here."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from graspdb_service.api.context import Context


class Gauges(Collector):
    """Metrics of one application: a few lines each, whatever there is in the database."""

    def __init__(self, ctx: Context) -> None:
        self._ctx = ctx
        self.registry = CollectorRegistry()
        self.registry.register(self)

    def collect(self) -> Iterator[Metric]:
        ctx = self._ctx
        yield _gauge(
            "graspdb_ready", "1 where the last look at the database was well.", ctx.health.trouble is None
        )
        yield _gauge(
            "graspdb_compute_waiting", "Computations that wait for a processor.", ctx.compute.waiting
        )
        yield _gauge("graspdb_compute_busy", "Computations under way.", ctx.compute.busy)
        yield _gauge("graspdb_compute_threads", "Processors to compute on.", ctx.compute.threads)
        yield from self._caches()
        yield from self._database()
        yield from self._stored()

    def describe(self) -> list[Metric]:
        """Nothing: registering must not read the database."""
        return []

    def _caches(self) -> Iterator[Metric]:
        size = GaugeMetricFamily("graspdb_cache_bytes", "Bytes that a cache holds.", labels=["cache"])
        hits = CounterMetricFamily("graspdb_cache_hits", "Answers found in a cache.", labels=["cache"])
        misses = CounterMetricFamily(
            "graspdb_cache_misses", "Answers that a cache had to have made.", labels=["cache"]
        )
        for name, cache in (("densities", self._ctx.densities.kept), ("attempts", self._ctx.successes.kept)):
            size.add_metric([name], cache.nbytes)
            hits.add_metric([name], cache.hits)
            misses.add_metric([name], cache.misses)
        yield from (size, hits, misses)

    def _database(self) -> Iterator[Metric]:
        used, idle = self._ctx.database.connections()
        pool = GaugeMetricFamily(
            "graspdb_database_connections", "Connections to the database.", labels=["state"]
        )
        pool.add_metric(["used"], used)
        pool.add_metric(["idle"], idle)
        yield pool
        if self._ctx.database.path is not None:
            path = Path(self._ctx.database.path).absolute()
            journal = path.with_name(path.name + "-wal")
            yield _gauge(
                "graspdb_disk_free_bytes", "Free under the database.", shutil.disk_usage(path.parent).free
            )
            for name, file in (("graspdb_database_bytes", path), ("graspdb_journal_bytes", journal)):
                yield _gauge(name, f"Size of {file.suffix[1:]}.", file.stat().st_size if file.exists() else 0)

    def _stored(self) -> Iterator[Metric]:
        figures = self._ctx.upkeep.figures
        if figures is None:
            return
        yield _gauge("graspdb_objects", "Objects, counted every 15 s.", figures.objects)
        trials = GaugeMetricFamily("graspdb_trials", "Trials stored, counted every 15 s.", labels=["kind"])
        trials.add_metric(["row"], figures.rows)
        trials.add_metric(["packed"], figures.packed)
        jobs = GaugeMetricFamily(
            "graspdb_jobs", "Jobs not done, counted every 15 s.", labels=["kind", "state"]
        )
        for (kind, state), number in sorted(figures.jobs.items()):
            jobs.add_metric([kind, state], number)
        yield from (trials, jobs)


def _gauge(name: str, what: str, value: float) -> Metric:
    return GaugeMetricFamily(name, what, value=float(value))
