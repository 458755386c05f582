"""Can the numbers be believed? The calibration report."""

from __future__ import annotations

import numpy as np

from graspdb.wire import OUTCOME_CODES
from graspdb.wire.queries import SelectionQuery
from graspdb.wire.reports import (
    CalibrationBin,
    CalibrationReport,
    CheckedGrasps,
    LearnedCalibration,
    ReportRange,
)
from graspdb_density import importance_weights
from graspdb_density.kde.weighted_sums import Progress
from graspdb_density.se3 import Poses
from graspdb_density.success.calibration import (
    Blocks,
    Calibration,
    area_under_curve,
    assign_blocks,
    brier_skill,
    calibrate,
    reliability,
)
from graspdb_density.vicinity.displacement_bins import LEAST_SUCCESSES
from graspdb_service.problems import too_few_trials
from graspdb_service.trial_columns import Floats, Ints
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.evidence.collisions import Contradiction, contradiction
from graspdb_service.usecases.geometry.collision import CollisionTest
from graspdb_service.usecases.reports.common import (
    LEVEL,
    ReportInputs,
    as_model,
    enough,
    finite,
    head,
    interval,
    model_near,
    need_failures,
    share,
)
from graspdb_service.usecases.simulation import verification
from graspdb_service.usecases.trials import attempts
from graspdb_service.usecases.trials.attempts import AllTrials

#: Outcomes judged: of those that collided fewer, for nearly all are right.
_JUDGED_FREE, _JUDGED_COLLIDED = 20_000, 5_000
#: Of those that collided, about so many are read: enough to judge, and to tell where blocks lie.
_KEPT_COLLIDED = 100_000
LEAST_ATTEMPTS, LEAST_FAILURES = 100, 20
_FOLDS = 5
#: How long a report waits for what is being learned.
_LEARNED_WITHIN_S = 300.0
#: Bins of grasps that were simulated again: there are few of them.
_CHECKED_BINS = 5


def calibration_report(
    inputs: ReportInputs, built: Built, options: SelectionQuery, progress: Progress
) -> CalibrationReport:
    test = inputs.scenes.test(built.selected)
    against = None if test is None else contradiction(built, test, inputs.threads)
    test = None if against is not None else test
    # Where geometry tells them apart, those that collided are only judged, and few of them.
    most = None if test is None else _KEPT_COLLIDED
    everything = attempts.read(inputs.database, built.selected, most_collided=most)
    successes = int(everything.success.sum())
    if everything.attempts < LEAST_ATTEMPTS or successes < LEAST_SUCCESSES:
        raise too_few_trials(
            f"Calibration needs at least {LEAST_ATTEMPTS} attempts and {LEAST_SUCCESSES} successes in them,"
            f" of sources that post failures, too; there are {everything.attempts} and {successes}",
        )
    need_failures(everything, "Calibration", LEAST_FAILURES)
    density = built.density
    assert density is not None
    edge = 3.0 * density.kernel.sigma_position_m
    blocks = enough(lambda: assign_blocks(everything.poses.positions, edge_m=edge, folds=_FOLDS))
    judged, weights = _judged(everything)
    predicted, ranked = _predictions(inputs, built, everything, test, blocks, judged, progress)
    won, collided, block = everything.shares[judged], everything.collided[judged], blocks.block[judged]
    whole = calibrate(predicted, won, weights=weights, blocks=block, level=LEVEL)
    apart = None
    free = ~collided
    if test is not None and collided.any() and 0.0 < won[free].mean() < 1.0:
        apart = _skill(
            calibrate(predicted[free], won[free], weights=weights[free], blocks=block[free], level=LEVEL)
        )
    checked = _checked(inputs, built, everything, test)
    learned = _learned(inputs, built, collisions_known=test is not None)
    report = CalibrationReport(
        **head(built),
        kernel=built.kernel,
        attempts=everything.attempts,
        successes=successes,
        judged=len(judged),
        blocks=blocks.count,
        block_edge_m=edge,
        folds=blocks.folds,
        collisions_known=test is not None,
        share=float(np.average(won, weights=weights)),
        brier=whole.brier,
        skill=_skill(whole),
        free_skill=apart,
        ece=finite(whole.ece),
        auc_probability=finite(whole.auc),
        auc_density=finite(area_under_curve(ranked, won, weights=weights)),
        bins=[as_model(CalibrationBin, item) for item in whole.bins],
        checked=checked,
        learned=learned,
        warnings=_warnings(built.object_row.slug, test, against, checked=checked is not None),
    )
    return report.model_copy(update={"text": _calibration_text(report)})


def _predictions(
    inputs: ReportInputs,
    built: Built,
    everything: AllTrials,
    test: CollisionTest | None,
    blocks: Blocks,
    judged: Ints,
    progress: Progress,
) -> tuple[Floats, Floats]:
    """The success probability and the log density of every judged attempt, without the blocks of its fold."""
    assert built.density is not None
    kernel = built.density.kernel
    poses = everything.poses[judged]
    predicted, ranked = np.zeros(len(judged)), np.full(len(judged), -np.inf)
    free = None if test is None else test.free(poses, threads=inputs.threads)
    learned = everything.collided if test is not None else np.zeros(len(everything), dtype=bool)
    proposal_known = not np.isnan(everything.proposal).all()
    for fold in range(blocks.folds):
        train = np.flatnonzero((blocks.fold != fold) & ~learned)
        held = np.flatnonzero(blocks.fold[judged] == fold)
        progress(fold / blocks.folds)
        if not held.size or not train.size:
            continue
        model = everything.success_model(built.success_kernel or kernel, train)
        progress((fold + 0.5) / blocks.folds)
        predicted[held] = model.probability(poses[held], threads=inputs.threads)
        kept = train[everything.success[train]]
        if kept.size:
            weights = importance_weights(everything.proposal[kept]) if proposal_known else None
            own = everything.density(kernel, kept, weights)
            ranked[held] = own.log_density(poses[held], threads=inputs.threads)
    if free is not None:
        predicted[~free] = 0.0
    return predicted, ranked


def _learned(inputs: ReportInputs, built: Built, *, collisions_known: bool) -> LearnedCalibration | None:
    """How well what was learned predicts the blocks that it was judged on, if it is in use."""
    stack, estimator = inputs.successes.learned(
        built, collisions_known=collisions_known, within_s=_LEARNED_WITHIN_S
    )
    if stack is None:
        return None
    held = stack.left_out
    whole = calibrate(held.learned, held.share, weights=held.weight, blocks=held.block, level=LEVEL)
    inside, outside = (
        finite(brier_skill(held.learned[rows], held.share[rows], weights=held.weight[rows]))
        if rows.any()
        else None
        for rows in (held.told, ~held.told)
    )
    return LearnedCalibration(
        estimator=estimator,
        judged=len(held.share),
        blocks=len(np.unique(held.block)),
        skill=_skill(whole),
        kernel_skill=finite(held.skills[1]),
        ece=finite(whole.ece),
        auc=finite(whole.auc),
        coverage=finite(held.coverage),
        told_share=float(np.average(held.told, weights=held.weight)),
        told_skill=inside,
        untold_skill=outside,
        bins=[as_model(CalibrationBin, item) for item in whole.bins],
    )


def _skill(item: Calibration) -> ReportRange:
    return interval(item.skill, item.skill_low, item.skill_high)


def _warnings(
    slug: str, test: CollisionTest | None, against: Contradiction | None, *, checked: bool
) -> list[str]:
    warnings = []
    if against is not None:
        warnings.append(against.warning)
    elif test is None:
        warnings.append(
            "mesh or gripper is not known: collisions count as ordinary failures, which costs much skill"
        )
    if not checked:
        warnings.append(
            "no best grasps have been simulated again: ask for some and simulate them with"
            f' POST /objects/{slug}/best-grasp {{"count": 25}} and POST /objects/{slug}/sweeps'
            ' {"poses": [...], "fidelity": "fine", "purpose": "check"}, as best_grasps(count=25, verify=True)'
            f" and `graspdb best-grasp {slug} --count 25 --verify` do"
        )
    return warnings


def _checked(
    inputs: ReportInputs, built: Built, everything: AllTrials, test: CollisionTest | None
) -> CheckedGrasps | None:
    """Grasps given to checks against what is predicted of them: no prediction rests on a check's outcome."""
    read = verification.read(inputs.database, built)
    found = [item for item in read if item.plan == "poses" and len(item.codes)]
    if not found:
        return None
    poses = Poses.concatenate([item.poses for item in found])
    codes = np.concatenate([item.codes for item in found])
    assert built.density is not None
    kernel, diagonal = built.density.kernel, built.success_kernel
    widest = max([kernel.sigma_position_m, *(() if diagonal is None else diagonal.sigmas[:3])])
    known = test is not None
    model = model_near(everything, poses, diagonal or kernel, widest, collisions_known=known)
    predicted = np.zeros(len(poses)) if model is None else model.probability(poses, threads=inputs.threads)
    if test is not None:
        predicted[~test.free(poses, threads=inputs.threads)] = 0.0
    outcomes = verification.tally(codes)
    won = outcomes.get("success", 0)
    success = codes == OUTCOME_CODES["success"]
    return CheckedGrasps(
        grasps=len(codes),
        successes=won,
        rate=share(won, len(codes)),
        predicted=float(predicted.mean()),
        outcomes=outcomes,
        bins=[
            as_model(CalibrationBin, item)
            for item in reliability(predicted, success, bins=_CHECKED_BINS, level=LEVEL)
        ],
    )


def _judged(everything: AllTrials) -> tuple[Ints, Floats]:
    """Rows to judge and what each stands for: drawn at random from those that collided and from the rest."""
    rng = np.random.default_rng(0)
    rows, weights = [], []
    for chosen, most, more in (
        (~everything.collided, _JUDGED_FREE, 0),
        (everything.collided, _JUDGED_COLLIDED, everything.left_out),
    ):
        members = np.flatnonzero(chosen)
        if not members.size:
            continue
        drawn = members if members.size <= most else np.sort(rng.choice(members, size=most, replace=False))
        rows.append(drawn)
        weights.append(np.full(drawn.size, (members.size + more) / drawn.size))
    return np.concatenate(rows), np.concatenate(weights)


def _calibration_text(report: CalibrationReport) -> str:
    skill = report.skill
    if skill.value is None:
        text = "Every judged attempt had the same outcome, so there is nothing to predict."
    else:
        between = "" if skill.low is None or skill.high is None else f" ({skill.low:.2f} to {skill.high:.2f})"
        text = f"Brier skill {skill.value:.2f}{between} on {report.judged:,} attempts it had not seen"
        text += f" ({report.blocks} blocks of {1e3 * report.block_edge_m:.0f} mm)."
    if report.ece is not None:
        text += f" Where it predicts more than 0.1 it is off by {report.ece:.2f} on average."
    if report.auc_probability is not None and report.auc_density is not None:
        text += (
            f" A success ranks above a failure with {report.auc_probability:.2f} by probability, with"
            f" {report.auc_density:.2f} by density."
        )
    learned = report.learned
    if learned is not None and learned.skill.value is not None:
        text += (
            f" What was learned ({learned.estimator.name}) answers in its place: Brier skill"
            f" {learned.skill.value:.2f} on {learned.judged:,} attempts that did not collide"
        )
        text += "." if learned.kernel_skill is None else f", the kernel estimate {learned.kernel_skill:.2f}."
    again = report.checked
    if again is not None and again.rate.low is not None and again.rate.high is not None:
        text += (
            f" Simulated again, {again.successes:,} of {again.grasps:,} given grasps succeed"
            f" ({100.0 * again.rate.low:.0f} to {100.0 * again.rate.high:.0f} %, predicted"
            f" {100.0 * again.predicted:.0f} %)."
        )
    return text
