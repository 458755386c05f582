"""How many samples does a kernel need? Figure 13: the report on a kernel's similarity to its statistics."""

from __future__ import annotations

import math

import numpy as np

from graspdb.wire.queries import TrialSelection
from graspdb.wire.reports import KernelSimilarityOptions, KernelSimilarityReport, SimilarityPoint
from graspdb_density import IsotropicKernel, se3
from graspdb_density.bandwidth.component_count import mixture_curve
from graspdb_density.bandwidth.mixture_fit import (
    LEAST_DISPLACEMENTS,
    LEAST_SUCCESSES,
    Displacements,
    displacements,
)
from graspdb_density.kde.bhattacharyya import Coefficient, DisplacementWindow, sampled_kernel_curve
from graspdb_density.kde.weighted_sums import Progress
from graspdb_service.problems import conflict, too_few_trials
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.reports.common import ReportInputs, head

#: Displacements that stand for the full statistics, and what the paper limits a kernel to.
_REFERENCE, _PAPER = 20_000, 900
#: Root mean squares of displacements that are none but for rounding, metres and radians, and the axes' names.
_LEAST_SPREAD = np.repeat([1e-6, 1e-6], 3)
_AXES = ("along x", "along y", "along z", "about x", "about y", "about z")


def kernel_similarity_report(
    inputs: ReportInputs, built: Built, options: KernelSimilarityOptions, progress: Progress
) -> KernelSimilarityReport:
    window = DisplacementWindow(options.window_position_m, math.radians(options.window_rotation_deg))
    widths = IsotropicKernel(options.component_position_m, math.radians(options.component_rotation_deg))
    found = _displacements(built, window)
    progress(0.1)
    try:
        samples, mixtures = _curves(found, window, widths, inputs.threads, progress)
    except ValueError as error:
        raise conflict(
            "window-too-narrow",
            f"Kernels with components this wide can't be compared inside the window ({error}): widen the"
            " window or narrow the components",
        ) from None
    report = KernelSimilarityReport(
        **head(built),
        warnings=_warnings(found),
        **options.model_dump(exclude=set(TrialSelection.model_fields)),
        successes=built.selected.successes,
        displacements=len(found.vectors),
        reference=min(_REFERENCE, len(found.vectors)),
        samples=[_point(*item) for item in samples.items()],
        mixtures=[_point(*item) for item in mixtures.items()],
    )
    return report.model_copy(update={"text": _text(report, window, widths)})


def _curves(
    found: Displacements,
    window: DisplacementWindow,
    widths: IsotropicKernel,
    threads: int,
    progress: Progress,
) -> tuple[dict[int, Coefficient], dict[int, Coefficient]]:
    """Similarity of sampled kernels, and of mixtures, to all displacements.

    Raises
    ------
    ValueError
        Where a kernel has next to nothing inside the window.
    """
    rng = np.random.default_rng(0)
    share = found.weights / found.weights.sum()
    kept = rng.choice(len(share), size=min(2 * _REFERENCE, len(share)), replace=False, p=share)
    samples = sampled_kernel_curve(
        se3.Poses.of(found.vectors[kept, :3], se3.from_rotation_vector(found.vectors[kept, 3:])),
        components=widths,
        window=window,
        rng=rng,
        reference=_REFERENCE,
        threads=threads,
    )
    progress(0.4)
    mixtures = mixture_curve(
        found,
        components=widths,
        window=window,
        rng=rng,
        reference=_REFERENCE,
        threads=threads,
        progress=lambda done: progress(0.4 + 0.6 * done),
    )
    return samples, mixtures


def _displacements(built: Built, window: DisplacementWindow) -> Displacements:
    density = built.density
    count = 0 if density is None else density.size
    if density is None or count < LEAST_SUCCESSES:
        raise too_few_trials(
            f"The similarity of kernels needs at least {LEAST_SUCCESSES} successes; there are {count}, so"
            f" {LEAST_SUCCESSES - count} more are needed",
        )
    found = displacements(density.rows, window=window, rng=np.random.default_rng(0))
    if len(found.vectors) < LEAST_DISPLACEMENTS:
        raise too_few_trials(
            f"The window holds {len(found.vectors)} displacements between successes; at least"
            f" {LEAST_DISPLACEMENTS} are needed: widen window_position_m or"
            " window_rotation_deg, or add trials",
        )
    return found


def _warnings(found: Displacements) -> list[str]:
    """Along and about which of the gripper's axes no success differs from another."""
    spread = np.sqrt(np.average(found.vectors**2, axis=0, weights=found.weights))
    if not (spread >= _LEAST_SPREAD).any():
        return ["all successes inside the window are at one pose: one Gaussian is like any of their kernels"]
    names = [name for name, at, least in zip(_AXES, spread, _LEAST_SPREAD, strict=True) if at < least]
    if not names:
        return []
    return [
        f"no success differs from another {', '.join(names)} of the gripper: nothing is said of how kernels"
        " are like each other there"
    ]


def _point(count: int, found: Coefficient) -> SimilarityPoint:
    return SimilarityPoint(count=count, similarity=found.value, error=found.standard_error)


def _text(report: KernelSimilarityReport, window: DisplacementWindow, widths: IsotropicKernel) -> str:
    told = [
        f"{1e3 * metres:.0f} mm and {math.degrees(turn):.0f} deg"
        for metres, turn in (
            (window.position_m, window.rotation),
            (widths.sigma_position_m, widths.sigma_rotation),
        )
    ]
    parts = []
    nearest = min(report.samples, key=lambda item: abs(item.count - _PAPER))
    parts.append(f"{nearest.count:,} samples have a similarity of {nearest.similarity:.2f}")
    best = max(report.mixtures, key=lambda item: item.similarity)
    first = report.mixtures[0]
    enough = next(item for item in report.mixtures if item.similarity >= best.similarity - 0.01)
    parts.append(f"1 Gaussian {first.similarity:.2f}")
    if enough.count > 1:
        parts.append(f"a mixture of {enough.count} {enough.similarity:.2f}")
    return f"{', '.join(parts)} (window {told[0]}, components {told[1]})."
