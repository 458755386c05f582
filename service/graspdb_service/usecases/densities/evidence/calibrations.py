"""Success probabilities of simulated trials corrected for a robot's, by the few that it has made."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from graspdb.wire import CalibrationInfo, Selection
from graspdb_density.success.calibration import assign_blocks
from graspdb_density.success.source_map import (
    LEAST_TRIALS,
    Judged,
    MappedModel,
    SourceMap,
    fit_source_map,
    judge_source_map,
)
from graspdb_service.problems import conflict, invalid_fields
from graspdb_service.storage.database import Database
from graspdb_service.storage.trials import provenances
from graspdb_service.trial_columns import Bools, Floats, Provenance, is_gripper
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.densities.learned.learning import Model
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.trials import attempts
from graspdb_service.usecases.trials.selection import Selected, of_provenances, outcome_counts

S = TypeVar("S", bound=Selection)

#: Edge of the blocks of space that trials are left out in, in kernel widths.
_BLOCK_WIDTHS = 3.0


def of_simulation(request: S) -> S:
    """A request that asks for a calibration, about simulated trials; 422 where it asks for others."""
    if getattr(request, "calibrated_for", None) is None:
        return request
    told = "calibrated_for corrects simulated trials: leave this out"
    wrong = [
        name
        for name, odd in (
            ("source", request.source not in (None, "simulation")),
            ("source_weight", request.source_weight is not None),
        )
        if odd
    ]
    if wrong:
        raise invalid_fields([(name, told) for name in wrong], "Only simulated trials are calibrated")
    return request.model_copy(update={"source": "simulation"})


def calibrated(
    ctx: Estimators, built: Built, model: Model, test: CollisionTest | None, source: str
) -> tuple[Model, CalibrationInfo]:
    """A model corrected for a source of real trials, and how; 409 where too few of these tell."""
    slug = built.object_row.slug
    real = real_trials(ctx.database, built.selected, source)
    count, poses, threads = 0, None, ctx.compute.threads
    if real is not None and real.tried:
        found = attempts.read(ctx.database, real)
        poses = found.poses
        p, _, nearest = ctx.compute.run(
            lambda: model.whole.without_interval(found.poses, everywhere=True, threads=threads)
        )
        told = model.reach.covers(nearest)
        if test is not None:
            told &= ctx.compute.run(lambda: test.free(found.poses, threads=threads))
        count = int(told.sum())
    if poses is None or count < LEAST_TRIALS:
        raise conflict(
            "too-few-real-trials",
            f"A calibration for {source} needs at least {LEAST_TRIALS} of its trials, failures included,"
            f" within reach of simulated ones; there are {count}: post more (POST /objects/{slug}/trials with"
            f" source {source}), or leave calibrated_for out",
        )
    fitted, judged = ctx.compute.run(
        lambda: learned(poses.positions[told], p[told], found.success[told], built.kernel.sigma_position_m)
    )
    applied = judged.verdict == "better"
    used = fitted
    if not applied:
        used = SourceMap(0.0, 1.0, fitted.covariance, fitted.trials, fitted.effective_trials)
    whole = MappedModel(model.whole, used)
    quick = whole if model.quick is model.whole else MappedModel(model.quick, used)
    info = CalibrationInfo(
        source=source,
        applied=applied,
        judged=judged.verdict,
        trials=fitted.trials,
        effective_trials=fitted.effective_trials,
        blocks=judged.blocks,
        shift=fitted.shift,
        slope=fitted.slope,
        informative=judged.informative,
        reason=_reason(source, judged),
    )
    return Model(whole, quick, model.reach, model.estimator), info


def doubts(calibration: CalibrationInfo | None) -> list[str]:
    """Warnings of probabilities that are not what was asked for, or that nothing shows to be worth much."""
    if calibration is None or (calibration.applied and calibration.informative):
        return []
    return [f"success probabilities are {calibration.reason}"]


def _reason(source: str, judged: Judged) -> str:
    told = {
        "better": f"corrected: {source} trials in left-out blocks of space are predicted better",
        "worse": f"not corrected: {source} trials in left-out blocks of space would be predicted worse",
        "undecided": f"not corrected: {judged.trials} {source} trials in {judged.blocks} blocks of space do"
        " not tell that a correction predicts better",
    }[judged.verdict]
    return told if judged.informative else told + "; nothing shows that it beats their share of successes"


def learned(positions: Floats, predicted: Floats, won: Bools, sigma_m: float) -> tuple[SourceMap, Judged]:
    """How predictions at real trials (n,) should be corrected, and whether that helps on left-out ones."""
    try:
        blocks = assign_blocks(positions, edge_m=_BLOCK_WIDTHS * sigma_m).block
    except ValueError:
        # All in one place.
        blocks = np.zeros(len(won), dtype=np.int64)
    return fit_source_map(predicted, won, blocks), judge_source_map(predicted, won, blocks)


def real_trials(database: Database, chosen: Selected, source: str) -> Selected | None:
    """A source's trials with the gripper of the simulated ones, of their protocol where it has any, else all;
    None without trials.
    """
    with database.read() as tx:
        known = provenances.of_object(tx, chosen.row.id)
        counts = outcome_counts(tx, chosen.row.id, known)
        own = {
            number: item
            for number, item in known.items()
            if number in counts and item.source == source and _of_the_gripper(item, chosen)
        }
    if any(item.protocol == chosen.protocol for item in own.values()):
        own = {number: item for number, item in own.items() if item.protocol in (None, chosen.protocol)}
    if not own:
        return None
    protocols = sorted({item.protocol for item in own.values() if item.protocol is not None})
    names = {"gripper": chosen.gripper, "protocol": ", ".join(protocols) or None, "source": source}
    return of_provenances(chosen.row, own, counts, profile=chosen.profile, **names)


def _of_the_gripper(item: Provenance, chosen: Selected) -> bool:
    """Whether trials are of the selection's gripper, or may be."""
    if item.gripper is None or chosen.gripper is None:
        return item.gripper is None
    return is_gripper(item.gripper, chosen.gripper)
