"""What is known of a density."""

from __future__ import annotations

from functools import partial

from graspdb.wire import DensityInfo, Selection
from graspdb_density.kde.importance_weights import LOW_EFFECTIVE_SHARE
from graspdb_service.storage.trials import findings
from graspdb_service.storage.trials.findings import FindingTotal
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.runtime.asked import or_kept, outage, outage_warnings
from graspdb_service.usecases.trials.findings.words import of_selection
from graspdb_service.usecases.trials.selection import Selected


def density_info(ctx: Estimators, slug: str, request: Selection) -> tuple[DensityInfo, Selected]:
    """What is known of a density, and the selection of trials that it is made of."""
    with ctx.compute.within(request):
        built = ctx.densities.requested(slug, request)
    density, selected = built.density, built.selected
    size = 0 if density is None else density.size
    effective = 0.0 if density is None else density.effective_sample_size
    doubtful: list[FindingTotal] = or_kept(partial(_findings, ctx, built), [])
    warnings = [*outage_warnings(built.revision), *ctx.evidence.warnings(built)]
    if outage() is not None:
        warnings.append("what was doubtful about its trials (findings) can't be read now")
    if size and effective < LOW_EFFECTIVE_SHARE * size:
        warnings.append(
            f"the weights are very uneven: {size} successes count like {effective:.0f};"
            " check the proposal densities of the trials"
        )
    info = DensityInfo(
        object=slug,
        revision=built.revision,
        epoch=built.object_row.epoch,
        gripper=selected.gripper,
        gripper_versions=list(selected.versions),
        protocol=selected.protocol,
        source=selected.source,
        kernel=built.kernel,
        size=size,
        outcomes=dict(selected.outcomes),
        effective_sample_size=effective,
        weights=built.weighing.info,
        selection=built.selection,
        bytes=built.nbytes,
        warnings=warnings,
        findings=of_selection(doubtful),
        estimator=ctx.successes.estimator(built, collisions_known=ctx.evidence.believed(built) is not None),
        stale=outage() is not None,
    )
    return info, selected


def _findings(ctx: Estimators, built: Built) -> list[FindingTotal]:
    with ctx.database.read() as tx:
        return findings.totals(tx, built.object_row.id, list(built.selected.provenances))
