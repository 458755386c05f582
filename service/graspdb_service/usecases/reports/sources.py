"""Does simulation tell what real trials find? The sources report."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from graspdb.wire.reports import (
    CalibrationBin,
    ReportRange,
    SourceComparison,
    SourceMap,
    SourceSimilarity,
    SourcesOptions,
    SourcesReport,
)
from graspdb_density import GraspDensity, IsotropicKernel, SuccessModel
from graspdb_density.kde.bhattacharyya import bhattacharyya
from graspdb_density.kde.weighted_sums import Progress
from graspdb_density.se3 import Poses
from graspdb_density.success.calibration import calibrate
from graspdb_density.success.source_map import (
    LEAST_BLOCKS,
)
from graspdb_service.problems import too_few_trials
from graspdb_service.trial_columns import Bools, Floats, Ints
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.evidence.calibrations import learned, real_trials
from graspdb_service.usecases.densities.stored_kernel import isotropic_info
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.reports.common import (
    LEVEL,
    ReportInputs,
    as_model,
    finite,
    head,
    interval,
    model_near,
    share,
)
from graspdb_service.usecases.trials import attempts
from graspdb_service.usecases.trials.attempts import AllTrials
from graspdb_service.usecases.trials.selection import Selected

REAL = ("robot", "human", "import")
#: Fewest trials for a calibration and for a density's similarity, and attempts to predict from.
LEAST_TRIALS, LEAST_SUCCESSES, LEAST_SIMULATED = 20, 20, 100
_BINS = 5
#: Predictions from fewer simulated attempts than this, by kernel weights, rest on next to nothing.
_WITHIN_REACH = 1.0
#: Subsets of simulated successes that tell what chance alone would do.
_SUBSETS = 10
_POINTS = 8_000
#: Simulated probabilities at which a correction is shown.
_CURVE = np.linspace(0.02, 0.98, 25)


def sources_report(
    inputs: ReportInputs, built: Built, options: SourcesOptions, progress: Progress
) -> SourcesReport:
    """Compare each source of real trials with simulation, whose trials ``built`` is of."""
    simulated = attempts.read(inputs.database, built.selected)
    real = _real(inputs, built, simulated)
    assert built.density is not None
    test = inputs.scenes.test(built.selected)
    trials_of = {source: _all(inputs, built, selected) for source, selected in real.items()}
    progress(0.3)
    kernel = built.density.kernel
    real_poses = Poses.concatenate([item.poses for item in trials_of.values()])
    sigma_m, known = kernel.sigma_position_m, test is not None
    model = model_near(simulated, real_poses, kernel, sigma_m, collisions_known=known)
    progress(0.5)
    compared = []
    for number, (source, selected) in enumerate(real.items()):
        progress(0.5 + 0.5 * number / len(real))
        everything = trials_of[source]
        predictions = _predictions(everything, model, test, inputs.threads)
        compared.append(_compared(inputs, built, selected, everything, predictions))
    report = SourcesReport(
        **{**head(built), "source": None},
        warnings=_warnings(compared, collisions_known=test is not None),
        kernel=built.kernel,
        attempts=len(simulated),
        successes=int(simulated.success.sum()),
        simulation_outcomes=dict(built.selected.outcomes),
        collisions_known=test is not None,
        sources=compared,
    )
    return report.model_copy(update={"text": _text(report)})


def _real(inputs: ReportInputs, built: Built, simulated: AllTrials) -> dict[str, Selected]:
    """The trials to compare with, by source; 409 says what is needed where these or simulated are too few."""
    slug = built.object_row.slug
    if len(simulated) < LEAST_SIMULATED or built.density is None:
        raise too_few_trials(
            f"A comparison needs at least {LEAST_SIMULATED} simulated attempts and 1 success in them; there"
            f" are {len(simulated)} and {built.selected.successes}: sweep a grid"
            f" (POST /objects/{slug}/sweeps)",
        )
    real = {
        source: found
        for source in REAL
        if (found := real_trials(inputs.database, built.selected, source)) is not None
    }
    if not real:
        raise too_few_trials(
            "There are no trials of a robot, a human or an import to compare simulation with: post at least"
            f" {LEAST_TRIALS} (POST /objects/{slug}/trials with source robot)",
        )
    return real


class _Predictions(NamedTuple):
    """What simulation predicts at trials (n,), whether they are within its reach, and whether they collide by
    geometry.
    """

    probability: Floats
    known: Bools
    collides: Bools


def _predictions(
    everything: AllTrials, model: SuccessModel | None, test: CollisionTest | None, threads: int
) -> _Predictions:
    """What simulation predicts at the poses of trials."""
    predicted = np.zeros(len(everything))
    reached = np.zeros(len(everything), dtype=bool)
    if model is not None:
        answer = model.evaluate(everything.poses, threads=threads)
        predicted = answer.probability.copy()
        reached = answer.effective_trials >= _WITHIN_REACH
    collides = np.zeros(len(everything), dtype=bool)
    if test is not None:
        collides = ~test.free(everything.poses, threads=threads)
        predicted[collides] = 0.0
        # Geometry tells of a collision wherever it is.
        reached |= collides
    return _Predictions(predicted, reached & np.isfinite(predicted), collides)


def _all(inputs: ReportInputs, built: Built, selected: Selected) -> AllTrials:
    """Every trial of a source, of one that posts successes only, too."""
    whole = replace(selected, tried=frozenset(selected.provenances))
    return attempts.read(inputs.database, whole)


def _compared(
    inputs: ReportInputs,
    built: Built,
    selected: Selected,
    everything: AllTrials,
    predictions: _Predictions,
) -> SourceComparison:
    won = everything.success
    count = len(everything)
    successes = int(won.sum())
    predicted, known, collides = predictions
    assert selected.source is not None
    comparison = SourceComparison(
        source=selected.source,
        protocols=[] if selected.protocol is None else selected.protocol.split(", "),
        trials=count,
        successes=successes,
        outcomes=dict(selected.outcomes),
        share=share(successes, count),
        predicted=finite(float(predicted[known].mean())) if known.any() else None,
        predicted_at_successes=float(predicted[known & won].mean()) if (known & won).any() else None,
        within_reach=int(known.sum()),
        similarity=_similarity(inputs, built, everything),
    )
    if selected.tried:
        told = known & ~collides
        kernel_m = built.kernel.sigma_position_m
        correction = _correction(everything.poses.positions[told], predicted[told], won[told], kernel_m)
        comparison = comparison.model_copy(update={"correction": correction})
    if not selected.tried or int(known.sum()) < LEAST_TRIALS:
        return comparison
    p, y = predicted[known], won[known]
    whole = calibrate(p, y, bins=_BINS, level=LEVEL)
    said = p > 0.5
    cells = {
        f"{one}-{other}": int(((said == (one == "success")) & (y == (other == "success"))).sum())
        for one in ("success", "failure")
        for other in ("success", "failure")
    }
    right = cells["success-success"] + cells["failure-failure"]
    return comparison.model_copy(
        update={
            "agreement": share(right, len(y)),
            "confusion": cells,
            "brier": whole.brier,
            "skill": interval(whole.skill, whole.skill_low, whole.skill_high),
            "auc": finite(whole.auc),
            "bins": [as_model(CalibrationBin, item) for item in whole.bins],
        }
    )


def _correction(positions: Floats, predicted: Floats, won: Bools, sigma_m: float) -> SourceMap | None:
    """How predictions at trials (n,) should be corrected for their source; None without any."""
    if not len(won):
        return None
    fitted, judged = learned(positions, predicted, won, sigma_m)
    low, high = fitted.interval(_CURVE, _CURVE, _CURVE, level=LEVEL)
    return SourceMap(
        shift=fitted.shift,
        slope=fitted.slope,
        trials=fitted.trials,
        effective_trials=fitted.effective_trials,
        blocks=judged.blocks,
        judged=judged.verdict,
        brier=finite(judged.brier),
        uncorrected_brier=finite(judged.uncorrected_brier),
        share_brier=finite(judged.share_brier),
        gain=interval(judged.gain, judged.gain_low, judged.gain_high),
        informative=judged.informative,
        predicted=_CURVE.tolist(),
        corrected=fitted.probability(_CURVE).tolist(),
        low=low.tolist(),
        high=high.tolist(),
    )


def _similarity(inputs: ReportInputs, built: Built, everything: AllTrials) -> SourceSimilarity | None:
    """Of the densities of both, under one kernel, and of as many simulated successes drawn at random."""
    density = built.density
    won = np.flatnonzero(everything.success)
    if density is None or len(won) < LEAST_SUCCESSES or density.size < LEAST_SUCCESSES:
        return None
    # A few grasps would be islands under a kernel chosen for many: as wide as is the rule for a few.
    sigma = max(density.kernel.sigma_position_m, 0.015)
    kernel = IsotropicKernel(sigma, max(density.kernel.sigma_rotation, math.radians(15.0)))
    rng = np.random.default_rng(0)

    def under(rows: Ints, weights: Floats | None) -> GraspDensity:
        return GraspDensity.build(
            density.poses[rows], kernel=kernel, weights=weights, symmetric=density.symmetric[rows]
        )

    whole = under(np.arange(density.size), density.weights)
    real = everything.density(kernel, won)
    found = bhattacharyya(real, whole, rng, points=_POINTS, threads=inputs.threads)
    count = min(len(won), density.size)
    alone = []
    for _ in range(_SUBSETS):
        rows = rng.choice(density.size, size=count, replace=True, p=density.weights)
        one = under(rows, None)
        alone.append(bhattacharyya(one, whole, rng, points=_POINTS, threads=inputs.threads).value)
    return SourceSimilarity(
        kernel=isotropic_info(kernel, "that of simulation, at least 15 mm and 15 deg"),
        value=found.value,
        error=found.standard_error,
        expected=ReportRange(value=float(np.mean(alone)), low=min(alone), high=max(alone)),
    )


def _warnings(found: list[SourceComparison], *, collisions_known: bool) -> list[str]:
    warnings = []
    for item in found:
        away = item.trials - item.within_reach
        if away:
            warnings.append(
                f"{item.source}: {away:,} of {item.trials:,} trials lie where nothing was simulated nearby;"
                " they are not judged"
            )
        if item.agreement is None:
            need = max(LEAST_TRIALS - item.within_reach, 0)
            why = (
                f"{need} more trials within reach of simulated ones are needed"
                if need
                else "it posts successes only: post the trials that failed, too"
            )
            warnings.append(f"{item.source}: agreement can't be told: {why}")
        correction = item.correction
        if correction is not None and correction.brier is None:
            warnings.append(
                f"{item.source}: whether the correction helps can't be told from {correction.trials} trials"
                f" in {correction.blocks} blocks of space; {LEAST_TRIALS} in {LEAST_BLOCKS} are needed, for"
                " trials of one spot are not independent"
            )
        if item.similarity is None:
            warnings.append(
                f"{item.source}: the densities' similarity can't be told from {item.successes} successes;"
                f" {LEAST_SUCCESSES} of it and of simulation are needed"
            )
    if not collisions_known:
        warnings.append("mesh or gripper is not known: collisions count as ordinary failures")
    return warnings


def _text(report: SourcesReport) -> str:
    parts = []
    for item in report.sources:
        told = f"{item.trials:,} {item.source} trials succeed {_percent(item.share)}"
        if item.predicted is not None:
            told += f", simulation predicts {100.0 * item.predicted:.0f} % at their poses"
        if item.agreement is not None:
            told += f" and agrees on {_percent(item.agreement)}"
        told += _correction_told(item.correction)
        if item.similarity is not None:
            s, e = item.similarity, item.similarity.expected
            told += f"; densities alike to {s.value:.2f} (by chance alone {e.low:.2f} to {e.high:.2f})"
        parts.append(told)
    return ". ".join(parts) + "."


def _correction_told(correction: SourceMap | None) -> str:
    """Whether simulated probabilities should be corrected, in words."""
    if correction is None or correction.brier is None or correction.uncorrected_brier is None:
        return ""
    errors = f"Brier {correction.brier:.3f} instead of {correction.uncorrected_brier:.3f}"
    verdict = {
        "better": f"; corrected, simulation predicts left-out trials better ({errors})",
        "worse": f"; corrected, simulation predicts left-out trials worse ({errors}): leave it as it is",
        "undecided": f"; whether a correction helps is undecided ({errors} on left-out trials)",
    }
    told = verdict[correction.judged]
    return told if correction.informative else told + "; it predicts no better than their share of successes"


def _percent(value: ReportRange) -> str:
    if value.value is None or value.low is None or value.high is None:
        return "nothing known"
    return f"{100.0 * value.value:.0f} % ({100.0 * value.low:.0f} to {100.0 * value.high:.0f})"
