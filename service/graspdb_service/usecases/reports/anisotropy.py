"""What a success tells about its vicinity: the anisotropy report."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from graspdb.wire.kernels import Alignment
from graspdb.wire.reports import (
    AnisotropyHistogram,
    AnisotropyHypothesis,
    AnisotropyOptions,
    AnisotropyReport,
    AnisotropyTolerance,
    Method,
)
from graspdb_density import IsotropicKernel, importance_weights
from graspdb_density.kde.weighted_sums import Progress
from graspdb_density.se3 import Poses
from graspdb_density.vicinity.anisotropy import empirical_anisotropy
from graspdb_density.vicinity.displacement_bins import Anisotropy, Frames, check_enough
from graspdb_density.vicinity.displacement_density import density_anisotropy
from graspdb_density.vicinity.half_width import LEAST_PAIRS, Tolerance
from graspdb_density.vicinity.hypotheses import Hypothesis, sharpened, wide_axes
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases.densities import stored_kernel
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.reports import surface_pairs
from graspdb_service.usecases.reports.common import (
    LEVEL,
    ReportInputs,
    as_model,
    enough,
    finite,
    head,
    need_failures,
)
from graspdb_service.usecases.trials import attempts
from graspdb_service.usecases.trials.attempts import AllTrials

#: Attempts that stand for all where their density is asked for.
_LOCAL_ATTEMPTS = 200_000
#: What x, y and z are, by alignment.
_AXES = {
    "gripper": "the gripper's axes: x sideways, y the way the fingers close, z the approach",
    "object": "the object's principal axes, the longest first; rotations the gripper's",
    "edge": "x along the nearest edge, y across it, z outwards; rotations the gripper's",
    "surface-pair": (
        "y from one side to the other of the pair of surfaces or edges that the jaw closes on, x and z along"
        " it; rotations the gripper's"
    ),
}
_EXPECTED = {
    "x-wide": "x forgives {} as much as y",
    "z-wide": "z forgives {} as much as y",
    "ry-wide": "turns about y are forgiven {} as much as about x or z",
    "alignment-sharpens": "the widest differs from the narrowest {} as much as along the gripper's axes",
}
_COMPARED = {
    "x-wide": "x against y",
    "z-wide": "z against y",
    "ry-wide": "turns about y against those about x and z",
    "alignment-sharpens": "what alignment changes",
}


def anisotropy_report(
    inputs: ReportInputs, built: Built, options: AnisotropyOptions, progress: Progress
) -> AnisotropyReport:
    method, alignment = options.method, options.alignment
    axes = stored_kernel.axes(alignment, built.selected, inputs.scenes.features)
    frames: Frames | None = (
        (lambda poses: axes(poses.positions, poses.quaternions_xyzw)) if callable(axes) else axes
    )
    enough(lambda: check_enough(built.selected.successes))
    everything = attempts.read(inputs.database, built.selected)
    need_failures(everything, "What a success tells about its vicinity", 1)
    measure = _measure(inputs, built, method, everything)
    # The same grasps along the gripper's axes, for what alignment changes.
    share = 1.0 if alignment == "gripper" else 0.5
    found = enough(lambda: measure(alignment, frames, lambda done: progress(share * done)))
    expected = [] if alignment == "object" else wide_axes(found)
    if alignment != "gripper":
        blurred = enough(lambda: measure("gripper", None, lambda done: progress(share * (1.0 + done))))
        expected.append(sharpened(found, blurred))
    pairs = inputs.scenes.features.known_pairs(built.selected)
    related = [] if pairs is None else surface_pairs.relations(everything, pairs)
    tolerances, warnings = _tolerances(found, built)
    if found.aligned < found.grasps and alignment != "gripper":
        near = alignment == "edge"
        what = "no edge lies within 30 mm of them, or two do" if near else "they are at no pair"
        warnings.append(
            f"{found.grasps - found.aligned:,} of {found.grasps:,} grasps were displaced along the gripper's"
            f" axes: {what}"
        )
    text = _tolerances_text(tolerances, alignment) + _hypotheses_text(expected)
    return as_model(
        AnisotropyReport,
        found,
        **{**head(built), "text": text + surface_pairs.in_words(related)},
        warnings=warnings,
        alignment=alignment,
        attempts=len(everything),
        kernel=None if method == "empirical" else built.kernel,
        tolerances=tolerances,
        translations=[as_model(AnisotropyHistogram, item) for item in found.translations],
        rotations=[as_model(AnisotropyHistogram, item) for item in found.rotations],
        hypotheses=[as_model(AnisotropyHypothesis, item) for item in expected],
        relations=related,
    )


def _measure(
    inputs: ReportInputs, built: Built, method: Method, everything: AllTrials
) -> Callable[[Alignment, Frames | None, Progress], Anisotropy]:
    """The method, ready for any alignment; the same grasps and resamples every time."""
    if method == "density":
        density = built.density
        assert density is not None
        local, tried = _local_attempts(everything, density.kernel)
        return lambda alignment, frames, progress: density_anisotropy(
            density,
            local,
            tried=tried,
            alignment=alignment,
            frames=frames,
            level=LEVEL,
            threads=inputs.threads,
            progress=progress,
        )
    weights = None
    known = everything.proposal[everything.success & np.isfinite(everything.proposal)]
    if known.size and np.ptp(known) > 0.0:
        weights = importance_weights(everything.proposal)
    keys = everything.keys
    symmetric = bool(everything.symmetric.all())
    return lambda alignment, frames, progress: empirical_anisotropy(
        everything.poses,
        everything.success,
        rotation_keys=None if keys is None else keys[0],
        position_keys=None if keys is None else keys[1],
        alignment=alignment,
        frames=frames,
        symmetric=symmetric,
        weights=weights,
        level=LEVEL,
        progress=progress,
    )


def _tolerances(found: Anisotropy, built: Built) -> tuple[list[AnisotropyTolerance], list[str]]:
    """Tolerances, and what to mind of them."""
    tolerances = [_tolerance(item) for item in found.tolerances]
    hidden = [item.axis for item in tolerances if item.within] if found.method == "density" else []
    if hidden:
        # Smoothed shares that start below one half bound nothing.
        tolerances = [
            item.model_copy(update={"half_width": None, "minus": None, "plus": None}) if item.within else item
            for item in tolerances
        ]
    warnings = _untold([item for item in tolerances if item.axis not in hidden])
    if hidden:
        kernel = built.kernel
        warnings.append(
            f"the kernel ({1e3 * kernel.sigma_position_m:.1f} mm, {kernel.sigma_rotation_deg:.1f} deg)"
            f" smooths more than a grasp forgives along or about {', '.join(hidden)}: shares stay below one"
            " half even beside a success; method=empirical or a narrower kernel tells more"
        )
    return tolerances, warnings


def _local_attempts(
    everything: AllTrials, kernel: IsotropicKernel
) -> tuple[Callable[[Poses], Floats], Poses]:
    """Attempts per m^3 rad^3 around poses, from at most so many drawn at random, and those."""
    density = everything.density(kernel, everything.some(_LOCAL_ATTEMPTS))
    return lambda poses: len(everything) * density.density(poses), density.poses


def _untold(tolerances: list[AnisotropyTolerance]) -> list[str]:
    """Along and about which axes, and which way, too little was tried to tell anything."""
    nothing, few = [], []
    for item in tolerances:
        if item.half_width is not None:
            continue
        low, high = item.tried or (0.0, 0.0)
        if not low and not high:
            nothing.append(item.axis)
        elif low and high:
            few.append(item.axis)
        else:
            nothing.append(f"{'-' if high else '+'}{item.axis}")
    more = "a grid's trials, or many more, tell that"
    warnings = []
    if nothing:
        warnings.append(f"nothing was tried displaced along or about {', '.join(nothing)} alone: {more}")
    if few:
        warnings.append(
            f"fewer than {LEAST_PAIRS} pairs of trials differ each way along or about {', '.join(few)}"
            f" alone: {more}"
        )
    return warnings


def _tolerance(item: Tolerance) -> AnisotropyTolerance:
    # Where even the nearest trials mostly fail the crossing lies between them and the grasp itself.
    shown = {"half_width": finite(item.nearest), "low": None, "high": None} if item.within else {}
    unit = "rad" if item.axis.startswith("r") else "m"
    return as_model(AnisotropyTolerance, item, unit=unit, **shown)


def _tolerances_text(tolerances: list[AnisotropyTolerance], alignment: str) -> str:
    parts = []
    for item in tolerances:
        if item.half_width is None:
            continue
        way = f"about {item.axis[1:]}" if item.unit == "rad" else f"along {item.axis}"
        parts.append(f"{item.in_words()} {way}")
    if not parts:
        return f"No tolerance can be told from these trials, the warnings say why ({_AXES[alignment]})."
    return f"A good grasp forgives {', '.join(parts)} ({_AXES[alignment]})."


def _hypotheses_text(found: list[Hypothesis]) -> str:
    judged, untold = [], []
    for item in found:
        if not math.isfinite(item.ratio):
            untold.append(_COMPARED[item.name])
            continue
        bound = {"lower": "at least ", "upper": "at most ", "both": "about "}.get(item.bound or "", "")
        times = f"{bound}{item.ratio:.2g} times ({item.low:.2g} to {item.high:.2g})"
        judged.append(f"{_EXPECTED[item.name].format(times)} ({item.verdict})")
    text = f" What grasps are expected to do: {'; '.join(judged)}." if judged else ""
    return text + (f" Undecided, for these trials do not tell: {'; '.join(untold)}." if untold else "")
