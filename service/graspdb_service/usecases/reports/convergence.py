"""Have we tried enough? The convergence report."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import KernelInfo
from graspdb.wire.reports import ConvergenceCurve as CurveModel
from graspdb.wire.reports import (
    ConvergencePoint,
    ConvergenceReport,
    ReportRange,
    SimulatedDraws,
)
from graspdb.wire.reports import Verdict as VerdictModel
from graspdb_density import GraspDensity, IsotropicKernel
from graspdb_density.bandwidth.matching import (
    Match,
    match_determinants,
    match_likelihood,
    match_success,
    scaled,
    success_ends,
)
from graspdb_density.kde.weighted_sums import Kernel, KernelRows, Progress
from graspdb_density.statistics.convergence import ConvergenceCurve, curve_sizes, needed_ratio, verdict
from graspdb_density.statistics.incremental_bootstrap import GrowingCurve
from graspdb_service.problems import conflict
from graspdb_service.usecases.densities.cache import Built
from graspdb_service.usecases.reports import verification
from graspdb_service.usecases.reports.common import LEVEL, Sources, head, interval, said

Floats = NDArray[np.float64]

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
    sources: Sources, built: Built, options: dict[str, str], progress: Progress
) -> ConvergenceReport:
    density = built.density
    # Said before anything is computed.
    said(lambda: curve_sizes(0 if density is None else density.size))
    assert density is not None
    if built.sampled is not None:
        raise conflict(
            "kernel-sampled",
            "Convergence is measured under isotropic and anisotropic kernels, not under sampled ones",
        )
    matching = options.get("matching") if built.shaped is None else options.get("matching", "determinants")
    if matching is not None and built.shaped is None:
        raise conflict(
            "nothing-to-match", "matching compares an anisotropic kernel with an isotropic one: name kernel="
        )
    # Missing checks are said before anything is computed.
    match: Match | None = None
    ends: tuple[Match, ...] = ()
    if matching == "success" and built.shaped is not None:
        match, ends = _by_success(sources, built)
    share = 1.0 if built.shaped is None else 0.5
    kernel: Kernel = density.kernel if built.shaped is None else built.shaped.kernel
    frames = None
    if built.shaped is not None and built.kernel.alignment not in (None, "gripper"):
        # As the density has them: those of new trials only were looked for.
        frames = built.shaped.frames
    grown = _curve(sources, built, None, kernel, frames, _part_of(progress, 0.0, share))
    curve = grown.curve
    curves = [_curve_model("isotropic" if built.shaped is None else "anisotropic", built.kernel, curve)]
    extra: dict[str, Any] = {}
    if built.shaped is not None:
        match = match or _matched(sources, density, grown, kernel, frames, str(matching))
        others = []
        # The matched kernel, and where its width is known by draws the narrowest and widest that may match.
        for part, other in enumerate((match, *ends)):
            each = 0.5 / (1 + len(ends))
            told = _part_of(progress, 0.5 + each * part, each)
            others.append(_curve(sources, built, other, other.kernel, None, told).curve)
        curves.append(_curve_model("isotropic, matched", _isotropic_info(match), others[0]))
        ratio = needed_ratio(curve, others[0], ends=others[1:], level=LEVEL)
        extra = {"matching": matching, "matched": match.reached, "ratio": interval(*ratio)}
    judged = curves[0].verdict
    warnings = (
        [] if judged.exponent > 0 else ["the curve does not rise: it is noise, or all grasps are alike"]
    )
    if match is not None and not match.reached:
        warnings.append(
            f"no width tried matches by {match.rule}: {match.achieved:.3g} comes nearest to"
            f" {match.target:.3g}"
        )
    return ConvergenceReport(
        **head(built),
        text=_convergence_text(curves[0], extra.get("ratio")),
        level=LEVEL,
        held_out=curve.held_out,
        subsets=SUBSETS,
        replicates=REPLICATES,
        method=_METHOD.format(prefix=grown.prefix),
        curves=curves,
        warnings=warnings,
        **extra,
    )


def _part_of(progress: Progress, begin: float, share: float) -> Progress:
    return lambda done: progress(begin + share * done)


def _curve(
    sources: Sources,
    built: Built,
    matched: Match | None,
    kernel: Kernel,
    frames: Floats | None,
    progress: Progress,
) -> GrowingCurve:
    """The curve under a kernel: what was kept of it, and the trials that came since."""
    density = built.density
    assert density is not None

    def grow(before: GrowingCurve | None, progress: Progress) -> GrowingCurve:
        return GrowingCurve.grown(
            before,
            density.positions,
            density.quaternions_xyzw,
            kernel,
            weights=density.raw_weights,
            symmetric=density.symmetric,
            frames=frames,
            subsets=SUBSETS,
            replicates=REPLICATES,
            points=POINTS,
            threads=sources.threads,
            progress=progress,
        )

    return said(lambda: sources.curves.grown(built, matched, grow, progress))


def _matched(
    sources: Sources,
    density: GraspDensity,
    grown: GrowingCurve,
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
    p, q, w = density.positions, density.quaternions_xyzw, density.weights
    if frames is not None and frames.ndim == 3:
        frames = frames[train]

    def likelihood(used: Kernel) -> float:
        rows = KernelRows(
            p[train], q[train], used, weights=w[train], symmetric=density.symmetric[train],
            frames=None if isinstance(used, IsotropicKernel) else frames,
        )  # fmt: skip
        return float(np.average(rows.log_density(p[held], q[held], threads=sources.threads), weights=w[held]))

    return sources.curves.match(
        grown, rule, lambda: match_likelihood(likelihood(kernel), match.kernel, likelihood)
    )


def _by_success(sources: Sources, built: Built) -> tuple[Match, tuple[Match, ...]]:
    """The isotropic kernel whose simulated draws succeed as often as those of the stored one, and the
    narrowest and widest that may, as the draws are few; none where no width tried succeeds as often.

    Raises
    ------
    ProblemError
        409 ``checks-needed`` while draws of either have not been simulated, with the sweeps that do it.
    """
    assert built.shaped is not None
    base = match_determinants(built.shaped.kernel).kernel
    drawn = verification.draws(verification.read(sources.database, built))
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
        protocol = built.selected.protocol
        calls = verification.calls(built, missing, protocol if protocol in ("wrench", "lift") else None)
        raise conflict(
            "checks-needed",
            "Matching by success compares draws of this kernel and of isotropic ones at several widths, which"
            " have not all been simulated: send each of `calls`"
            f" (POST /objects/{built.object_row.slug}/sweeps), wait for a worker, and ask again; determinants"
            " and likelihood need none",
            calls=[call.model_dump(mode="json") for call in calls],
        )
    factors, aim = sorted(found), target.success.value or 0.0
    rates, counts = (
        [found[f].success.value or 0.0 for f in factors],
        [found[f].draws for f in factors],
    )
    match = match_success(aim, base, rates, factors=factors, draws=counts)
    if not match.reached:
        return match, ()
    kernels = success_ends(
        aim, base, rates, factors=factors, draws=counts, target_draws=target.draws, level=LEVEL
    )
    return match, tuple(replace(match, kernel=kernel) for kernel in kernels)


def _isotropic_info(match: Match) -> KernelInfo:
    return KernelInfo(
        kind="isotropic",
        sigma_position_m=match.kernel.sigma_position_m,
        sigma_rotation_deg=math.degrees(match.kernel.sigma_rotation),
        rule=f"matched by {match.rule}",
    )


def _curve_model(label: str, kernel: KernelInfo, curve: ConvergenceCurve) -> CurveModel:
    judged = verdict(curve, level=LEVEL)
    needed = judged.needed
    least, best, most = judged.more
    return CurveModel(
        label=label,
        kernel=kernel,
        points=[
            ConvergencePoint(
                grasps=point.grasps,
                similarity=point.similarity,
                deviation=point.deviation,
                log_likelihood=point.log_likelihood,
                log_likelihood_error=point.log_likelihood_error,
            )
            for point in curve.points
        ],
        verdict=VerdictModel.model_validate(
            {
                "state": judged.state,
                "grasps": judged.grasps,
                "target": needed.target,
                "similarity": interval(judged.similarity, judged.low, judged.high),
                "needed": interval(needed.grasps, needed.low, needed.high),
                "more": interval(best, least, most),
                "extrapolated": needed.extrapolated,
                "exponent": judged.exponent,
            }
        ),
    )


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
