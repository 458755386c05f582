"""How wide should the kernel be? The bandwidth report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from graspdb.wire.queries import TrialSelection
from graspdb.wire.reports import BandwidthPoint, BandwidthReport, SimulatedDraws
from graspdb_density import IsotropicKernel
from graspdb_density.bandwidth.selection import MOST_HELD_OUT, MOST_ROWS, WidthScore, score_widths
from graspdb_density.kde.weighted_sums import Progress
from graspdb_service.problems import too_few_trials
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.stored_kernel import isotropic_info
from graspdb_service.usecases.reports.common import ReportInputs, as_model, enough, head, share
from graspdb_service.usecases.simulation import verification

#: Widths whose draws are to be simulated, as factors on the recommended ones; 15, 30 and 45 mm in the paper.
_FACTORS = (0.5, 1.0, 2.0, 3.0)
#: Widths this many standard errors below the best can't be told from it (90 %, one-sided).
_ERRORS = 1.28


def bandwidth_report(
    inputs: ReportInputs, built: Built, options: TrialSelection, progress: Progress
) -> BandwidthReport:
    density = built.density
    if density is None:
        raise too_few_trials(
            "Widths are told apart from 200 successes on; there are 0, so 200 more are needed",
        )
    scores = enough(lambda: score_widths(density.rows, threads=inputs.threads, progress=progress))
    best = max((s for s in scores if math.isfinite(s.log_likelihood)), key=lambda s: s.log_likelihood)
    near = [s.kernel for s in scores if s.below_best <= _ERRORS * s.below_best_error]
    near.append(best.kernel)
    drawn = simulated_draws(verification.read(inputs.database, built))
    turns = [math.degrees(k.sigma_rotation) for k in near]
    report = BandwidthReport(
        **head(built),
        warnings=_warnings(scores, best, drawn),
        kernel=built.kernel,
        rows=min(density.size, MOST_ROWS),
        held_out=min(density.size, MOST_HELD_OUT),
        grid=[_point(item) for item in scores],
        recommended=isotropic_info(best.kernel, "likeliest given other blocks, of all successes"),
        range_m=(min(k.sigma_position_m for k in near), max(k.sigma_position_m for k in near)),
        range_deg=(min(turns), max(turns)),
        draws=drawn,
        calls=verification.calls(built, _missing(best.kernel, drawn)),
    )
    return report.model_copy(update={"text": _text(report)})


def simulated_draws(found: Sequence[verification.Check]) -> list[SimulatedDraws]:
    """What became of draws, those of one kernel and protocol together, the narrowest first."""
    together: dict[tuple[Any, ...], list[verification.Check]] = {}
    for item in found:
        if item.plan == "sample" and item.kernel is not None and len(item.codes):
            k = item.kernel
            widths = round(k.sigma_position_m, 9), round(k.sigma_rotation_deg, 6)
            key = (k.id or "", *widths, item.protocol)
            together.setdefault(key, []).append(item)
    result = []
    for items in together.values():
        codes = np.concatenate([item.codes for item in items])
        outcomes = verification.tally(codes)
        won, hit = outcomes.get("success", 0), outcomes.get("collision", 0)
        kernel = items[-1].kernel
        assert kernel is not None
        result.append(
            SimulatedDraws(
                kernel=kernel,
                protocol=items[0].protocol,
                draws=len(codes),
                outcomes=outcomes,
                success=share(won, len(codes)),
                collision=share(hit, len(codes)),
                free_success=share(won, len(codes) - hit),
            )
        )
    return sorted(result, key=lambda d: (d.kernel.id or "", d.kernel.sigma_position_m, d.protocol))


def _point(item: WidthScore) -> BandwidthPoint:
    return as_model(
        BandwidthPoint,
        item,
        sigma_position_m=item.kernel.sigma_position_m,
        sigma_rotation_deg=math.degrees(item.kernel.sigma_rotation),
    )


def _missing(best: IsotropicKernel, drawn: list[SimulatedDraws]) -> list[IsotropicKernel]:
    """Widths around the best of which no draws were simulated."""
    known = {
        (round(d.kernel.sigma_position_m, 5), round(d.kernel.sigma_rotation_deg, 2))
        for d in drawn
        if d.kernel.id is None
    }
    wanted = []
    for factor in _FACTORS:
        # Turns beyond 45 degrees make another kernel, not a wider one.
        turn = min(factor * best.sigma_rotation, math.radians(45.0))
        kernel = IsotropicKernel(factor * best.sigma_position_m, turn)
        if (round(kernel.sigma_position_m, 5), round(math.degrees(turn), 2)) not in known:
            wanted.append(kernel)
    return wanted


def _warnings(scores: list[WidthScore], best: WidthScore, drawn: list[SimulatedDraws]) -> list[str]:
    warnings = []
    widths = sorted({s.kernel.sigma_position_m for s in scores})
    turns = sorted({s.kernel.sigma_rotation for s in scores})
    at_end = best.kernel.sigma_position_m in (widths[0], widths[-1])
    if at_end or best.kernel.sigma_rotation in (turns[0], turns[-1]):
        warnings.append("the likeliest widths lie at an end of those tried: others beyond may be likelier")
    if not drawn:
        warnings.append(
            "no draws have been simulated: `calls` are the sweeps that simulate some at several widths"
        )
    return warnings


def _text(report: BandwidthReport) -> str:
    best = report.recommended
    text = (
        f"Recommended: {1e3 * best.sigma_position_m:.1f} mm and {best.sigma_rotation_deg:.1f} deg, under"
        " which left-out grasps are likeliest"
    )
    if report.range_m[0] < report.range_m[1] or report.range_deg[0] < report.range_deg[1]:
        text += (
            f" (from {1e3 * report.range_m[0]:.1f} to {1e3 * report.range_m[1]:.1f} mm and"
            f" {report.range_deg[0]:.1f} to {report.range_deg[1]:.1f} deg can't be told from it)"
        )
    text += "."
    used = report.kernel
    same = math.isclose(used.sigma_position_m, best.sigma_position_m, rel_tol=1e-6)
    if not (same and math.isclose(used.sigma_rotation_deg, best.sigma_rotation_deg, rel_tol=1e-6)):
        text += f" In use: {1e3 * used.sigma_position_m:.1f} mm and {used.sigma_rotation_deg:.1f} deg."
    parts = [
        f"{100.0 * d.success.value:.0f} % at {1e3 * d.kernel.sigma_position_m:.0f} mm"
        for d in report.draws
        if d.success.value is not None and d.kernel.id is None
    ]
    if parts:
        text += f" Simulated draws succeed {', '.join(parts)}."
    return text
