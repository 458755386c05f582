"""Kernels fitted on an object's trials: within the request, or as runs where that takes longer."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from graspdb.wire.kernels import (
    MAX_FITTED,
    MAX_SAMPLED,
    SAMPLED,
    KernelCreate,
    KernelProvenance,
    KernelWidths,
    KernelWindow,
    StoredKernel,
)
from graspdb.wire.queries import TrialSelection
from graspdb_density import AnisotropicKernel
from graspdb_density.bandwidth.mixture_fit import (
    LEAST_DISPLACEMENTS,
    displacements,
    fit_kernel,
    sampled_rows,
)
from graspdb_density.kde.bhattacharyya import DisplacementWindow, bhattacharyya
from graspdb_density.kde.weighted_sums import Progress
from graspdb_service.principal import Actor
from graspdb_service.problems import invalid, too_few_trials
from graspdb_service.storage import kernels
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Tx
from graspdb_service.storage.kernels import KernelRow, NewKernel
from graspdb_service.storage.objects import ObjectRow
from graspdb_service.storage.report_runs import RunKey, RunRow
from graspdb_service.usecases.densities import stored_kernel
from graspdb_service.usecases.densities.build import Built, KernelChoice
from graspdb_service.usecases.densities.cache import Densities
from graspdb_service.usecases.geometry.features import Axes, Features
from graspdb_service.usecases.runtime.runs import Result, RunKind
from graspdb_service.usecases.trials.selection import Selected

Fitted = tuple[list[dict[str, Any]], dict[str, Any]]
"""A kernel's components, and what is told of the fit."""
RUN = "kernel"
"""What runs that fit a kernel are named where others have their report's name; the kernel has their id."""

#: Displacements that stand for all of them where a sample is compared with them.
_WHOLE = 20_000


def check(request: KernelCreate) -> None:
    """422 where a request asks for a fit that there is none of."""
    sampled, count = request.kind == "sampled", request.components
    assert not isinstance(count, list)
    if sampled and count == "auto":
        raise invalid(
            "components", f"how many displacements to draw: 1 to {MAX_SAMPLED}, {SAMPLED} by default"
        )
    if not sampled and isinstance(count, int) and count > MAX_FITTED:
        raise invalid(
            "components", f"at most {MAX_FITTED} Gaussians, or auto; kind sampled takes {MAX_SAMPLED}"
        )
    if request.alignment != "gripper" and count not in (None, 1, "auto"):
        raise invalid(
            "components",
            "axes that do not turn with the jaw have no sign: a kernel aligned with them has 1",
        )


def trials_of(request: KernelCreate) -> TrialSelection:
    """Which trials a kernel is fitted on."""
    return TrialSelection(gripper=request.gripper, protocol=request.protocol, source=request.source)


def fitted_on(
    selected: Selected, request: KernelCreate, components: list[dict[str, Any]], **told: Any
) -> NewKernel:
    """A kernel fitted on a selection; what else is ``told`` belongs to its provenance."""
    provenance = KernelProvenance(
        origin="fitted",
        object=selected.row.slug,
        revision=selected.row.revision,
        protocol=selected.protocol,
        source=selected.source,
        **told,
    )
    return new_kernel(request, components, provenance, selected.gripper, selected.row.id)


def new_kernel(
    request: KernelCreate,
    components: list[dict[str, Any]],
    provenance: KernelProvenance,
    gripper: str | None,
    object_id: int | None = None,
) -> NewKernel:
    """A kernel of the kind and alignment that were asked for."""
    return NewKernel(
        kind=request.kind,
        alignment=request.alignment,
        gripper=gripper,
        object_id=object_id,
        components=components,
        provenance=provenance.model_dump(mode="json", exclude_none=True),
    )


def fitted(
    densities: Densities,
    features: Features,
    request: KernelCreate,
    *,
    threads: int,
    computed: Callable[[Callable[[], Fitted]], Fitted],
    progress: Progress,
) -> NewKernel:
    """A kernel learned from an object's successes; ``computed`` is where numbers are. 404 for the object, 409
    where its trials or geometry don't suffice.
    """
    assert request.object is not None
    window, widths = request.window or KernelWindow(), request.component_widths or KernelWidths()
    built = densities.get(densities.selections.resolve(request.object, trials_of(request)), KernelChoice())
    # Said first: without axes no number of trials helps.
    axes = stored_kernel.axes(request.alignment, built.selected, features)
    if built.density is None:
        raise too_few_trials(
            "No trial of this selection succeeded, so there is nothing to fit a kernel on:"
            f" post trials (POST /objects/{request.object}/trials) or sweep a grid first",
        )
    try:
        components, told = computed(
            lambda: (
                _sample(request, built, window, widths, threads)
                if request.kind == "sampled"
                else _fit(request, built, axes, window, widths, threads, progress)
            )
        )
    except ValueError as error:
        raise too_few_trials(f"No kernel can be fitted: {error}") from None
    return fitted_on(built.selected, request, components, window=window, component_widths=widths, **told)


def _fit(
    request: KernelCreate,
    built: Built,
    axes: Axes,
    window: KernelWindow,
    widths: KernelWidths,
    threads: int,
    progress: Progress,
) -> Fitted:
    """A Gaussian, or a mixture of a few: its components and what is told of the fit."""
    density, count = built.density, request.components
    assert density is not None
    assert not isinstance(count, list)
    fit = fit_kernel(
        density.rows,
        window=_window(window),
        widths=stored_kernel.isotropic(widths),
        compared=density.kernel,
        components=None if count == "auto" else count or 1,
        frame=stored_kernel.axes_at(axes, density.poses),
        threads=threads,
        progress=progress,
    )
    return components_of(fit.kernel), {
        "successes": fit.successes,
        "displacements": fit.displacements,
        "scale": fit.scale,
        "log_likelihood": finite(fit.log_likelihood),
        "isotropic_log_likelihood": finite(fit.isotropic_log_likelihood),
        "similarity": fit.similarity.value,
        "likelihood_by_components": {str(k): v for k, v in fit.likelihoods.items()} or None,
    }


def _sample(
    request: KernelCreate, built: Built, window: KernelWindow, widths: KernelWidths, threads: int
) -> Fitted:
    """Displacements drawn from those between successes (eq 5), and their likeness to all of them."""
    density, rng = built.density, np.random.default_rng(0)
    assert density is not None
    count = request.components if isinstance(request.components, int) else SAMPLED
    found = displacements(density.rows, window=_window(window), rng=rng)
    if len(found.vectors) < LEAST_DISPLACEMENTS:
        raise ValueError(
            f"the window holds {len(found.vectors)} displacements between successes, and a kernel is sampled"
            f" from at least {LEAST_DISPLACEMENTS}: widen the window or add trials"
        )
    share = found.weights / found.weights.sum()
    chosen = found.vectors[rng.choice(len(share), size=count, p=share)]
    whole = found.vectors[rng.choice(len(share), size=min(_WHOLE, len(share)), p=share)]
    one, every = (sampled_rows(part, stored_kernel.isotropic(widths)) for part in (chosen, whole))
    similarity = bhattacharyya(one, every, rng, points=4_000, window=_window(window), threads=threads)
    return [{"weight": 1.0, "mean": vector.tolist()} for vector in chosen], {
        "successes": density.size,
        "displacements": len(found.vectors),
        "similarity": similarity.value,
    }


def _window(window: KernelWindow) -> DisplacementWindow:
    return DisplacementWindow(window.position_m, math.radians(window.rotation_deg))


def finite(value: float) -> float | None:
    """Null stands for what no number tells."""
    return value if math.isfinite(value) else None


def components_of(kernel: AnisotropicKernel) -> list[dict[str, Any]]:
    """As a row keeps them."""
    return [
        {"weight": float(w), "mean": m.tolist(), "covariance": s.tolist()}
        for w, m, s in zip(kernel.weights, kernel.means, kernel.covariances, strict=True)
    ]


def info(row: KernelRow) -> StoredKernel:
    """As the wire has it."""
    return StoredKernel.model_validate({**vars(stored_kernel.info_of(row)), **vars(row)})


def run_key(row: ObjectRow, id: str, request: KernelCreate, by: Actor) -> RunKey:
    """Of the run that fits the kernel of this id: every request makes one of its own, nobody else's."""
    asked = request.model_dump(mode="json", exclude_unset=True)
    document = {"report": RUN, "run": id, "request": asked, "by": by._asdict()}
    return RunKey(row.id, row.revision, RUN, hashlib.sha256(id.encode()).hexdigest(), document)


def run_kind(densities: Densities, features: Features, threads: int) -> RunKind:
    """Runs that fit kernels."""

    def compute(run: RunRow, progress: Progress) -> Result:
        kernel = fitted(
            densities,
            features,
            KernelCreate.model_validate(run.parameters["request"]),
            threads=threads,
            computed=lambda work: work(),
            progress=progress,
        )

        def store(tx: Tx) -> str:
            # Whoever computes it, a key asked for it.
            by = Actor(**run.parameters.get("by", {}))
            audit.record(tx, "kernel.create", object=run.object, subject=run.id, by=by)
            return info(kernels.create(tx, run.id, kernel)).model_dump_json()

        return store

    return RunKind("fit", compute)
