"""What was promised against what happened: the promises report."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.wire.reports import (
    PromiseBin,
    PromisedPrior,
    PromisePlacement,
    PromiseSelection,
    PromisesOptions,
    PromisesReport,
    ReportRange,
)
from graspdb_density.kde.weighted_sums import Progress
from graspdb_density.se3 import Poses
from graspdb_density.success.promises import Promises, judge_promises
from graspdb_service.problems import too_few_trials
from graspdb_service.storage import answers
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.reports.common import (
    LEVEL,
    ReportInputs,
    finite,
    head,
    interval,
    share,
)
from graspdb_service.usecases.reports.promises.tried import TriedAnswers, angles, tried_answers
from graspdb_service.usecases.trials import attempts

#: Fewer answers than this tell nothing for certain.
LEAST_ANSWERS = 10
_BINS = 5
_UNKNOWN = ReportRange(value=None, low=None, high=None)
#: A probability from fewer effective trials rests on next to nothing.
_WITHIN_REACH = 1.0
#: Attempts that collided, of millions, that are read.
_MOST_COLLIDED = 200_000


def promises_report(
    inputs: ReportInputs, built: Built, options: PromisesOptions, progress: Progress
) -> PromisesReport:
    """Judge what answers promised by the trials that name them; 409 where no trial of the selection does."""
    tried = tried_answers(inputs.database, built.selected)
    slug = built.object_row.slug
    if not len(tried.held):
        raise too_few_trials(
            "No trial of this selection names the answer that it tried: post trials with answer, the id of"
            f" the best grasp that they tried (POST /objects/{slug}/trials)"
        )
    progress(0.3)
    with inputs.database.read() as tx:
        given, named = answers.tally(tx, built.object_row.id, "best-grasp")
    turned = np.degrees(tried.rotation)
    matched = (tried.position_m <= options.match_position_m) & (turned <= options.match_rotation_deg)
    promised, prior = matched & np.isfinite(tried.probability), np.isfinite(tried.prior)
    by_prior = matched & ~promised & prior
    judged = None
    if promised.any():
        judged = judge_promises(
            tried.probability[promised],
            tried.held[promised],
            tried.answer[promised],
            tried.error[promised],
            bins=_BINS,
            level=LEVEL,
        )
    report = PromisesReport(
        **head(built),
        verdict=_verdict(judged),
        answers_given=given,
        answers_never_tried=given - named,
        trials=len(tried.held),
        unmatched=int((~matched).sum()),
        match_position_m=_median(tried.position_m[matched]),
        match_rotation_deg=_median(turned[matched]),
        without_promise=int((matched & ~promised & ~by_prior).sum()),
        prior=PromisedPrior(
            trials=int(by_prior.sum()),
            promised=_mean(tried.prior[by_prior]),
            happened=share(int(tried.held[by_prior].sum()), int(by_prior.sum())),
        ),
        **_judged(judged, tried.probability[promised]),
        selection=_selection(built, tried, judged),
        placement=_placement(inputs, built, tried),
    )
    return report.model_copy(update={"text": _text(report), "warnings": _warnings(report)})


def _verdict(judged: Promises | None) -> Any:
    if judged is None or judged.answers < LEAST_ANSWERS:
        return "undecided"
    if judged.high < judged.promised:
        return "over-promised"
    return "under-promised" if judged.low > judged.promised else "as-promised"


def _judged(judged: Promises | None, probability: Floats) -> dict[str, Any]:
    if judged is None:
        ranges = dict.fromkeys(("promised", "happened", "difference", "skill"), _UNKNOWN)
        return {"answers": 0, "judged": 0, "brier": None, "bins": [], **ranges}
    told = judged.promised
    return {
        "answers": judged.answers,
        "judged": judged.trials,
        "promised": interval(told, float(probability.min()), float(probability.max())),
        "happened": interval(judged.happened, judged.low, judged.high),
        "difference": interval(judged.happened - told, judged.low - told, judged.high - told),
        "brier": judged.brier,
        "skill": interval(judged.skill, judged.skill_low, judged.skill_high),
        "bins": [
            PromiseBin(
                lower=item.lower,
                upper=item.upper,
                answers=item.answers,
                trials=item.trials,
                promised=finite(item.promised),
                happened=interval(item.happened, item.low, item.high),
            )
            for item in judged.bins
        ],
    }


def _selection(built: Built, tried: TriedAnswers, judged: Promises | None) -> PromiseSelection:
    """What choosing the highest estimates may explain, and how promises would have to be shrunk."""
    outcomes = built.selected.outcomes
    others = sum(outcomes.values()) - outcomes.get("simulation_error", 0) - len(tried.held)
    won = built.selected.successes - int(tried.held.sum())
    base = won / others if others > 0 else None
    at_most = 0.0 if judged is None else judged.selection
    more = None
    if judged is not None and judged.answers >= LEAST_ANSWERS:
        more = judged.high < judged.promised - at_most
    came_true = _UNKNOWN
    if judged is not None and base is not None and judged.promised - base > 0.05:
        parts = [(x - base) / (judged.promised - base) for x in (judged.happened, judged.low, judged.high)]
        came_true = interval(*parts)
    return PromiseSelection(share_of_all=base, at_most=at_most, more_than_selection=more, came_true=came_true)


def _placement(inputs: ReportInputs, built: Built, tried: TriedAnswers) -> PromisePlacement:
    """How far the tool was from where it was commanded to, and what that cost by the estimate."""
    placed, columns = tried.placed, tried.columns
    commanded = tried.commanded[placed]
    achieved = Poses(columns.achieved[placed, :3], columns.achieved[placed, 3:])
    held = tried.held[placed]
    metres = np.linalg.norm(achieved.positions - commanded.positions, axis=1)
    twins = built.selected.symmetric(columns.provenance[placed])
    turned = np.array(
        [
            math.degrees(float(angles(a[None], c, twins=bool(twin))[0]))
            for a, c, twin in zip(achieved.quaternions_xyzw, commanded.quaternions_xyzw, twins, strict=True)
        ]
    )
    there, here = _probabilities(inputs, built, commanded, achieved)
    return PromisePlacement(
        trials=len(held),
        position_m=_median(metres),
        position_p90_m=_quantile(metres, 0.9),
        rotation_deg=_median(turned),
        rotation_p90_deg=_quantile(turned, 0.9),
        position_held_m=_median(metres[held]),
        position_failed_m=_median(metres[~held]),
        rotation_held_deg=_median(turned[held]),
        rotation_failed_deg=_median(turned[~held]),
        commanded_probability=there,
        achieved_probability=here,
    )


def _probabilities(
    inputs: ReportInputs, built: Built, commanded: Poses, achieved: Poses
) -> tuple[float | None, float | None]:
    """Mean success probabilities at both poses by the attempts that are none of these; None where unknown."""
    kernel = built.success_kernel or (None if built.density is None else built.density.kernel)
    if not len(achieved) or kernel is None:
        return None, None
    everything = attempts.read(inputs.database, built.selected, most_collided=_MOST_COLLIDED)
    others = ~np.isin(_as_keys(everything.poses), _as_keys(achieved))
    if not others.any():
        return None, None
    model = everything.success_model(kernel, others)
    found = model.evaluate(Poses.concatenate([commanded, achieved]), threads=inputs.threads)
    probability, told = np.split(found.probability, 2), np.split(found.effective_trials, 2)
    known = (told[0] >= _WITHIN_REACH) & (told[1] >= _WITHIN_REACH)
    return _mean(probability[0][known]), _mean(probability[1][known])


def _as_keys(poses: Poses) -> NDArray[np.void]:
    """Positions (n,), each as one value to compare."""
    # Zeros of either sign are alike.
    positions = np.ascontiguousarray(poses.positions + 0.0)
    return positions.view([("x", "f8"), ("y", "f8"), ("z", "f8")]).ravel()


def _mean(values: Floats) -> float | None:
    return float(values.mean()) if len(values) else None


def _median(values: Floats) -> float | None:
    return _quantile(values, 0.5)


def _quantile(values: Floats, share: float) -> float | None:
    return float(np.quantile(values, share)) if len(values) else None


def _text(report: PromisesReport) -> str:
    promised, happened, difference = report.promised, report.happened, report.difference
    if promised.value is None or happened.value is None or difference.value is None:
        return (
            f"Undecided: none of {report.trials} trials that name an answer tried a grasp that promised a"
            " success probability from attempts near it."
        )
    told = (
        f"{report.answers} answers promised {promised.value:.2f} on average ({promised.low:.2f} to"
        f" {promised.high:.2f}) and {happened.value:.2f} held ({happened.low:.2f} to {happened.high:.2f}),"
        f" in {report.judged} trials. "
    )
    if report.verdict == "undecided":
        return f"{told}That is too little to decide anything: it takes {LEAST_ANSWERS} answers."
    if report.verdict == "as-promised":
        return f"{told}Nothing shows that too much or too little was promised, in that range."
    if report.verdict == "under-promised":
        return f"{told}More held than was promised, in that range."
    most = report.selection.at_most
    if report.selection.more_than_selection:
        why = f"More than choosing the highest of many estimates explains, at most {most:.2f}"
    else:
        why = f"Choosing the highest of many estimates, at most {most:.2f}, may be all of it"
    shrink = report.selection.came_true.value
    share = "" if shrink is None else f"; {shrink:.2f} of what was promised above the rest's share came true"
    return f"{told}Too much was promised. {why}{share}."


def _warnings(report: PromisesReport) -> list[str]:
    told = []
    if report.promised.low is not None and report.promised.high is not None:
        told.append(
            f"Only what promised {report.promised.low:.2f} to {report.promised.high:.2f} was tried: nothing"
            " is known of other promises"
        )
    if report.answers_never_tried:
        told.append(
            f"{report.answers_never_tried} of {report.answers_given} best grasps that are kept were never"
            " tried: those that were may be the better or the worse ones"
        )
    if report.unmatched:
        told.append(f"{report.unmatched} trials lie off every grasp of the answer that they name")
    place = report.placement
    if place.commanded_probability is not None and place.achieved_probability is not None:
        lost = place.commanded_probability - place.achieved_probability
        if lost > 0.05:
            told.append(
                f"By the estimate, misplacing the tool ({1e3 * (place.position_m or 0.0):.1f} mm,"
                f" {place.rotation_deg or 0.0:.1f} deg in the middle) cost {lost:.2f} of success probability"
            )
    return told
