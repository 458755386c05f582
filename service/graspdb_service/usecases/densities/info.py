"""What is known of a density."""

from __future__ import annotations

from graspdb.wire import DensityInfo, EstimatorInfo, Selection
from graspdb_density.kde.importance_weights import LOW_EFFECTIVE_SHARE
from graspdb_service.storage.trials import findings
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.trials.findings.words import of_selection
from graspdb_service.usecases.trials.selection import Selected


def density_info(ctx: Estimators, slug: str, request: Selection) -> tuple[DensityInfo, Selected]:
    """What is known of a density, and the selection of trials that it is made of."""
    with ctx.compute.within(request):
        built = ctx.densities.requested(slug, request)
    density, selected = built.density, built.selected
    size = 0 if density is None else density.size
    effective = 0.0 if density is None else density.effective_sample_size
    warnings = ctx.evidence.warnings(built)
    if size and effective < LOW_EFFECTIVE_SHARE * size:
        warnings.append(
            f"the weights are very uneven: {size} successes count like {effective:.0f};"
            " check the proposal densities of the trials"
        )
    with ctx.database.read() as tx:
        doubtful = findings.totals(tx, built.object_row.id, list(selected.provenances))
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
        estimator=EstimatorInfo(),
    )
    return info, selected
