"""Have we tried enough? The convergence report."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from graspdb.wire import KernelInfo
from graspdb.wire.reports import ConvergenceCurve as CurveModel
from graspdb.wire.reports import (
    ConvergenceOptions,
    ConvergencePoint,
    ConvergenceReport,
    ReportRange,
    SimulatedDraws,
)
from graspdb.wire.reports import Verdict as VerdictModel
from graspdb_density import GraspDensity, IsotropicKernel, MixtureDensity
from graspdb_density.bandwidth.matching import (
    Match,
    match_determinants,
    match_likelihood,
    match_success,
    scaled,
    success_ends,
)
from graspdb_density.kde.weighted_sums import KernelRows, Progress
from graspdb_density.kernels.gaussian_mixture import Kernel
from graspdb_density.statistics.convergence import ConvergenceCurve, curve_sizes, needed_ratio, verdict
from graspdb_density.statistics.incremental_bootstrap import IncrementalCurve
from graspdb_service.problems import conflict
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.densities.stored_kernel import isotropic_info
from graspdb_service.usecases.reports.bandwidth import simulated_draws
from graspdb_service.usecases.reports.common import LEVEL, ReportInputs, as_model, enough, head, interval
from graspdb_service.usecases.simulation import verification

_METHOD = (
    "eq 9: mean Bhattacharyya coefficient between the density of all grasps and bootstrap replicates of it,"
    " at poses drawn from the density. All grasps: Poisson bootstrap (a replicate counts a grasp k times, k"
    " of mean 1 and fixed by the grasp's place in commit order, renormalises, and is taken for one of as many"
    " draws as there are grasps), so that new grasps add to what was summed. Fewer grasps: subsets drawn"
    " without replacement from the first {prefix:,} in commit order, resampled with replacement. These"
    " subsets, the held-out grasps and the poses drawn from the first {prefix:,} are chosen anew when the"
    " number of grasps doubles"
)

SUBSETS, REPLICATES, POINTS = 5, 50, 20_000
#: Widths whose draws are compared with a stored kernel's, as factors on those of equal determinants; how many
#: of them it takes, and how nearly widths must be those factors.
_SUCCESS_FACTORS, _LEAST_WIDTHS, _ALIKE = (0.4, 0.6, 0.8, 1.0, 1.25), 3, 0.02


def convergence_report(
    inputs: ReportInputs, built: Built, options: ConvergenceOptions, progress: Progress
) -> ConvergenceReport:
    density, shaped = built.density, built.shaped
    # What is missing is said before anything is computed.
    enough(lambda: curve_sizes(0 if density is None else density.size))
    assert density is not None
    if built.sampled is not None:
        raise conflict(
            "kernel-sampled",
            "Convergence is measured under isotropic and anisotropic kernels, not under sampled ones",
        )
    if shaped is None:
        if options.matching is not None:
            raise conflict(
                "nothing-to-match",
                "matching compares an anisotropic kernel with an isotropic one: name kernel=",
            )
        grown = _curve(inputs, built, None, density.kernel, None, progress)
        return _report(built, grown, [_curve_model("isotropic", built.kernel, grown.curve)])
    rule = options.matching or "determinants"
    match, ends = _by_success(inputs, built, shaped) if rule == "success" else (None, ())
    # As the density has them: those of new trials only were looked for.
    frames = None if built.kernel.alignment in (None, "gripper") else shaped.frames
    grown = _curve(inputs, built, None, shaped.kernel, frames, _part_of(progress, 0.0, 0.5))
    match = match or _matched(inputs, density, grown, shaped.kernel, frames, rule)
    others = []
    # The matched kernel, and where its width is known by draws the narrowest and widest that may match.
    for part, other in enumerate((match, *ends)):
        each = 0.5 / (1 + len(ends))
        told = _part_of(progress, 0.5 + each * part, each)
        others.append(_curve(inputs, built, other, other.kernel, None, told).curve)
    ratio = interval(*needed_ratio(grown.curve, others[0], ends=others[1:], level=LEVEL))
    curves = [
        _curve_model("anisotropic", built.kernel, grown.curve),
        _curve_model(
            "isotropic, matched", isotropic_info(match.kernel, f"matched by {match.rule}"), others[0]
        ),
    ]
    return _report(built, grown, curves, match, matching=rule, matched=match.reached, ratio=ratio)


def _report(
    built: Built,
    grown: IncrementalCurve,
    curves: list[CurveModel],
    match: Match | None = None,
    **matched: Any,
) -> ConvergenceReport:
    warnings = []
    if not curves[0].verdict.exponent > 0:
        warnings.append("the curve does not rise: it is noise, or all grasps are alike")
    if match is not None and not match.reached:
        warnings.append(
            f"no width tried matches by {match.rule}: {match.achieved:.3g} comes nearest to"
            f" {match.target:.3g}"
        )
    return ConvergenceReport(
        **{**head(built), "text": _convergence_text(curves[0], matched.get("ratio"))},
        held_out=grown.curve.held_out,
        subsets=SUBSETS,
        replicates=REPLICATES,
        method=_METHOD.format(prefix=grown.prefix),
        curves=curves,
        warnings=warnings,
        **matched,
    )


def _part_of(progress: Progress, begin: float, share: float) -> Progress:
    return lambda done: progress(begin + share * done)


def _curve(
    inputs: ReportInputs,
    built: Built,
    matched: Match | None,
    kernel: Kernel,
    frames: Floats | None,
    progress: Progress,
) -> IncrementalCurve:
    """The curve under a kernel: what was kept of it, and the trials that came since."""
    density = built.density
    assert density is not None

    def grow(before: IncrementalCurve | None, progress: Progress) -> IncrementalCurve:
        return IncrementalCurve.of(
            density.rows,
            kernel,
            before=before,
            frames=frames,
            subsets=SUBSETS,
            replicates=REPLICATES,
            points=POINTS,
            threads=inputs.threads,
            progress=progress,
        )

    return enough(lambda: inputs.curves.grown(built, matched, grow, progress))


def _matched(
    inputs: ReportInputs,
    density: GraspDensity,
    grown: IncrementalCurve,
    kernel: Kernel,
    frames: Floats | None,
    rule: str,
) -> Match:
    """By equal determinants, or by the likelihood of the first grasps, so that it stays while they do."""
    match = match_determinants(kernel)
    if rule == "determinants":
        return match
    order = np.random.default_rng(0).permutation(grown.prefix)
    held, train = np.split(order, [max(1, min(2_000, grown.prefix // 10))])
    judged, learned = density.rows[held], density.rows[train]
    if frames is not None and frames.ndim == 3:
        frames = frames[train]

    def likelihood(used: Kernel) -> float:
        rows = KernelRows(learned, used, frames=None if isinstance(used, IsotropicKernel) else frames)
        log_density = rows.log_density(judged.poses, threads=inputs.threads)
        return float(np.average(log_density, weights=judged.weights))

    return inputs.curves.match(
        grown, rule, lambda: match_likelihood(likelihood(kernel), match.kernel, likelihood)
    )


def _by_success(
    inputs: ReportInputs, built: Built, shaped: MixtureDensity
) -> tuple[Match, tuple[Match, ...]]:
    """The isotropic kernel whose simulated draws succeed as often as those of the stored one, and the
    narrowest and widest that may, as the draws are few; none where no width tried succeeds as often.

    409 ``checks-needed`` while draws of either have not been simulated, with the sweeps that do it.
    """
    base = match_determinants(shaped.kernel).kernel
    drawn = simulated_draws(verification.read(inputs.database, built))
    target = next((item for item in drawn if item.kernel.id == built.kernel.id), None)
    found: dict[float, SimulatedDraws] = {}
    for item in drawn:
        if item.kernel.id is None and (target is None or item.protocol == target.protocol):
            factor = item.kernel.sigma_position_m / base.sigma_position_m
            turn = math.radians(item.kernel.sigma_rotation_deg) / base.sigma_rotation
            if abs(turn / factor - 1.0) < _ALIKE:
                found[factor] = item
    missing: list[IsotropicKernel | str] = []
    if target is None:
        assert built.kernel.id is not None
        missing.append(built.kernel.id)
    near = {f for f in _SUCCESS_FACTORS if any(abs(g / f - 1.0) < _ALIKE for g in found)}
    missing += [scaled(base, f) for f in _SUCCESS_FACTORS if f not in near]
    if target is None or len(found) < _LEAST_WIDTHS:
        calls = verification.calls(built, missing)
        raise conflict(
            "checks-needed",
            "Matching by success compares draws of this kernel and of isotropic ones at several widths, which"
            " have not all been simulated: send each of `calls`"
            f" (POST /objects/{built.object_row.slug}/sweeps), wait for a worker, and ask again; determinants"
            " and likelihood need none",
            calls=[call.model_dump(mode="json") for call in calls],
        )
    factors, aim = sorted(found), target.success.value or 0.0
    rates = [found[f].success.value or 0.0 for f in factors]
    counts = [found[f].draws for f in factors]
    match = match_success(aim, base, rates, factors=factors, draws=counts)
    if not match.reached:
        return match, ()
    kernels = success_ends(
        aim, base, rates, factors=factors, draws=counts, target_draws=target.draws, level=LEVEL
    )
    return match, tuple(replace(match, kernel=kernel) for kernel in kernels)


def _curve_model(label: str, kernel: KernelInfo, curve: ConvergenceCurve) -> CurveModel:
    judged = verdict(curve, level=LEVEL)
    needed = judged.needed
    least, best, most = judged.more
    told = as_model(
        VerdictModel,
        judged,
        target=needed.target,
        similarity=interval(judged.similarity, judged.low, judged.high),
        needed=interval(needed.grasps, needed.low, needed.high),
        more=interval(best, least, most),
        extrapolated=needed.extrapolated,
    )
    points = [as_model(ConvergencePoint, point) for point in curve.points]
    return CurveModel(label=label, kernel=kernel, points=points, verdict=told)


def _convergence_text(curve: CurveModel, ratio: ReportRange | None) -> str:
    judged = curve.verdict
    s = judged.similarity
    told = f"similarity {s.value:.3f} ({s.low:.3f} to {s.high:.3f})"
    if judged.state == "enough":
        text = f"{judged.grasps:,} successful grasps are enough: {told} reaches {judged.target:g}."
    elif judged.state == "borderline":
        text = f"{judged.grasps:,} successful grasps are borderline: {told} holds {judged.target:g}."
    else:
        text = f"{judged.grasps:,} successful grasps are not enough: {told} is below {judged.target:g}."
    if judged.state != "enough":
        more = judged.more
        if more.value is None:
            text += " How many more it takes can't be told from this curve."
        else:
            least = 0 if more.low is None else more.low
            high = "more than can be told" if more.high is None else f"{_rounded(more.high):,}"
            text += f" About {_rounded(more.value):,} more are needed ({_rounded(least):,} to {high})."
    if ratio is not None and ratio.value is not None:
        between = "" if ratio.low is None or ratio.high is None else f" ({ratio.low:.2f} to {ratio.high:.2f})"
        text += f" It takes {ratio.value:.2f}{between} times the grasps of the matched isotropic kernel."
    return text


def _rounded(value: float) -> int:
    """Two figures: more would be pretence."""
    return int(round(value, 1 - math.floor(math.log10(value)))) if value >= 1.0 else 0
