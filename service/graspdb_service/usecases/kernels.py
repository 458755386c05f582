"""Kernels: fit them on an object's trials or take them as they are given, list and delete them."""

from __future__ import annotations

import math
import uuid
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.wire.kernels import (
    MAX_COMPONENTS,
    MAX_FITTED,
    MAX_SAMPLED,
    SAMPLED,
    KernelComponent,
    KernelCreate,
    KernelProvenance,
    KernelWidths,
    KernelWindow,
    StoredKernel,
)
from graspdb_density import AnisotropicKernel, IsotropicKernel, se3
from graspdb_density.fitting import LEAST_DISPLACEMENTS, displacements, fit_kernel
from graspdb_density.similarity import DisplacementWindow, bhattacharyya, sampled_kernel_rows
from graspdb_service.problems import conflict, invalid, not_found
from graspdb_service.storage import grippers, kernels
from graspdb_service.storage.database import Tx
from graspdb_service.storage.kernels import KernelRow
from graspdb_service.usecases import predictors, shapes
from graspdb_service.usecases.context import Context
from graspdb_service.usecases.densities import Built, KernelChoice, require_object
from graspdb_service.usecases.features import Axes
from graspdb_service.usecases.grippers import unknown
from graspdb_service.usecases.idempotency import Created, replay_or, replayed
from graspdb_service.usecases.selection import Filters

Floats = NDArray[np.float64]

#: Farther along an axis no displacement between grasps of one object reaches.
_MOST_SHIFT_M = 1.0
#: Displacements that stand for all of them where a sample is compared with them.
_WHOLE = 20_000
#: Shares of a covariance's scale, and metres, below which an entry is none.
_SAME = 1e-9


def create(ctx: Context, request: KernelCreate, *, key: str | None, body: bytes) -> Created:
    """Store a kernel.

    Raises
    ------
    ProblemError
        404 for the object, 422 for components that make no kernel, 409 where the trials don't suffice to fit
        one or the object's geometry does not have what it is to be aligned with.
    """
    if request.kind != "anisotropic" and request.alignment != "gripper":
        raise invalid(
            "alignment",
            f"a kernel of kind {request.kind} lies along the gripper's axes: use alignment=gripper",
        )
    scope = "POST /kernels"
    # A fit takes a while, and the trials may have gone since.
    earlier = replayed(ctx, scope=scope, key=key, request=body)
    if earlier is not None:
        return earlier
    made = _given(ctx, request) if isinstance(request.components, list) else _fitted(ctx, request)

    def make(tx: Tx) -> Created:
        row = kernels.create(tx, str(uuid.uuid4()), **made)
        return Created(info(row).model_dump(mode="json"), location=f"/kernels/{row.id}")

    return replay_or(ctx, scope=scope, key=key, request=body, create=make)


def get(ctx: Context, id: str) -> StoredKernel:
    """One kernel."""
    with ctx.database.read() as tx:
        row = kernels.find(tx, id)
    if row is None:
        raise not_found("kernel", id[:80], "GET /kernels lists those there are")
    return info(row)


def page(
    ctx: Context, *, after: int, limit: int, object: str | None, gripper: str | None
) -> tuple[list[StoredKernel], int | None]:
    """A page of kernels, oldest first, and where the next one starts."""
    with ctx.database.read() as tx:
        object_id = None if object is None else require_object(tx, object).id
        rows = kernels.page(tx, after=after, limit=limit + 1, object_id=object_id, gripper=gripper)
    items = [info(row) for row in rows[:limit]]
    return items, rows[limit - 1].number if len(rows) > limit else None


def remove(ctx: Context, id: str) -> None:
    """Delete a kernel; densities that were asked with it go on only for answers under way."""
    with ctx.database.write() as tx:
        if not kernels.remove(tx, id):
            raise not_found("kernel", id[:80], "GET /kernels lists those there are")


def _given(ctx: Context, request: KernelCreate) -> dict[str, Any]:
    assert isinstance(request.components, list)
    if request.gripper is not None:
        with ctx.database.read() as tx:
            if grippers.find(tx, request.gripper) is None:
                raise unknown("gripper", [request.gripper])
    sampled = request.kind == "sampled"
    if request.kind == "probability":
        components, widths = predictors.checked(request), None
    else:
        components, widths = _checked_samples(request) if sampled else (_checked_gaussians(request), None)
    provenance = KernelProvenance(origin="given", component_widths=widths)
    return {
        "kind": request.kind,
        "alignment": request.alignment,
        "gripper": request.gripper,
        "object_id": None,
        "components": components,
        "provenance": provenance.model_dump(mode="json", exclude_none=True),
    }


def _checked_gaussians(request: KernelCreate) -> list[dict[str, Any]]:
    """The components of an anisotropic kernel, invariant under the jaw's turn."""
    assert isinstance(request.components, list)
    if len(request.components) > MAX_COMPONENTS:
        raise invalid(
            "components", f"at most {MAX_COMPONENTS} Gaussians; a kernel of kind sampled takes {MAX_SAMPLED}"
        )
    covariances = []
    for i, item in enumerate(request.components):
        if item.covariance is None:
            raise invalid(f"components.{i}.covariance", "a Gaussian needs its 6x6 covariance")
        covariances.append(item.covariance)
    try:
        kernel = AnisotropicKernel.symmetrised(
            [item.weight for item in request.components],
            [item.mean for item in request.components],
            covariances,
            frame="gripper" if request.alignment == "gripper" else "fixed",
        )
        # What no equivalent width can be told of has none.
        kernel.isotropic  # noqa: B018
        if request.alignment in ("edge", "surface-pair"):
            _check_signs(kernel)
    except ValueError as error:
        raise invalid("components", str(error), "These components make no kernel") from None
    return _components(kernel)


def _check_signs(kernel: AnisotropicKernel) -> None:
    """Refuse what an edge's tangent or a pair's axes, whose signs mean nothing, would make ambiguous."""
    sign = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
    off = kernel.covariances - sign[:, None] * kernel.covariances * sign
    scale = np.sqrt(np.einsum("cii->ci", kernel.covariances))
    turned = np.abs(off) > _SAME * scale[:, :, None] * scale[:, None, :]
    if turned.any() or np.any(np.abs(kernel.means[:, :2]) > _SAME):
        raise ValueError(
            "x and y of an edge or a pair have no sign: no mean along them, no correlation with others"
        )


def _checked_samples(request: KernelCreate) -> tuple[list[dict[str, Any]], KernelWidths]:
    """The displacements of a sampled kernel, and the widths of its components."""
    assert isinstance(request.components, list)
    widths = request.component_widths
    for i, item in enumerate(request.components):
        if max(map(abs, item.mean[:3])) > _MOST_SHIFT_M or np.linalg.norm(item.mean[3:]) > math.pi:
            raise invalid(
                f"components.{i}.mean", f"at most {_MOST_SHIFT_M:g} m along an axis and a turn of at most pi"
            )
        if item.covariance is None:
            continue
        own = _isotropic_widths(np.array(item.covariance))
        if own is None or own != (widths or own):
            raise invalid(
                f"components.{i}.covariance",
                "components of a sampled kernel share one isotropic width: leave covariance out and give"
                " component_widths {sigma_position_m, sigma_rotation_deg}",
            )
        widths = own
    components = [{"weight": item.weight, "mean": item.mean} for item in request.components]
    return components, widths or KernelWidths()


def _isotropic_widths(covariance: Floats) -> KernelWidths | None:
    """The widths of a covariance that has one for all shifts and one for all turns; else None."""
    shift, turn = covariance[0, 0], covariance[3, 3]
    if not np.allclose(covariance, np.diag([shift] * 3 + [turn] * 3), rtol=1e-9, atol=0.0):
        return None
    try:
        return KernelWidths(
            sigma_position_m=round(math.sqrt(shift), 12),
            sigma_rotation_deg=round(math.degrees(math.sqrt(turn)), 12),
        )
    except ValueError:
        return None


def _fitted(ctx: Context, request: KernelCreate) -> dict[str, Any]:
    assert request.object is not None
    if request.kind == "probability":
        return predictors.fitted(ctx, request)
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
    window, widths = request.window or KernelWindow(), request.component_widths or KernelWidths()
    filters = Filters(request.gripper, request.protocol, request.source)
    with ctx.compute.admitted():
        built = ctx.densities.get(request.object, filters, KernelChoice())
        # Said first: without axes no number of trials helps.
        axes = shapes.axes(request.alignment, built.object_row, built.selected, ctx.scenes.features)
        if built.density is None:
            raise conflict(
                "too-few-trials",
                "No trial of this selection succeeded, so there is nothing to fit a kernel on:"
                f" post trials (POST /objects/{request.object}/trials) or sweep a grid first",
            )
        threads = ctx.compute.threads
        try:
            components, told = ctx.compute.run(
                lambda: (
                    _sample(request, built, window, widths, threads)
                    if sampled
                    else _fit(request, built, axes, window, widths, threads)
                )
            )
        except ValueError as error:
            raise conflict("too-few-trials", f"No kernel can be fitted: {error}") from None
    provenance = KernelProvenance(
        origin="fitted",
        object=built.object_row.slug,
        revision=built.revision,
        protocol=built.selected.protocol,
        source=built.selected.source,
        window=window,
        component_widths=widths,
        **told,
    )
    return {
        "kind": request.kind,
        "alignment": request.alignment,
        "gripper": built.selected.gripper,
        "object_id": built.object_row.id,
        "components": components,
        "provenance": provenance.model_dump(mode="json", exclude_none=True),
    }


def _fit(
    request: KernelCreate,
    built: Built,
    axes: Axes,
    window: KernelWindow,
    widths: KernelWidths,
    threads: int,
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """A Gaussian, or a mixture of a few: its components and what is told of the fit."""
    density, count = built.density, request.components
    assert density is not None
    assert not isinstance(count, list)
    fit = fit_kernel(
        density.positions,
        density.quaternions_xyzw,
        window=_window(window),
        widths=_isotropic(widths),
        compared=density.kernel,
        components=None if count == "auto" else count or 1,
        weights=density.weights,
        symmetric=density.symmetric,
        frame=shapes.axes_at(axes, density.positions, density.quaternions_xyzw),
        threads=threads,
    )
    return _components(fit.kernel), {
        "successes": fit.successes,
        "displacements": fit.displacements,
        "scale": fit.scale,
        "log_likelihood": _finite(fit.log_likelihood),
        "isotropic_log_likelihood": _finite(fit.isotropic_log_likelihood),
        "similarity": fit.similarity.value,
        "likelihood_by_components": {str(k): v for k, v in fit.likelihoods.items()} or None,
    }


def _sample(
    request: KernelCreate, built: Built, window: KernelWindow, widths: KernelWidths, threads: int
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Displacements drawn from those between successes (eq 5), and their likeness to all of them."""
    density, rng = built.density, np.random.default_rng(0)
    assert density is not None
    count = request.components if isinstance(request.components, int) else SAMPLED
    found = displacements(
        density.positions,
        density.quaternions_xyzw,
        window=_window(window),
        rng=rng,
        weights=density.weights,
        symmetric=density.symmetric,
    )
    if len(found.vectors) < LEAST_DISPLACEMENTS:
        raise ValueError(
            f"the window holds {len(found.vectors)} displacements between successes, and a kernel is sampled"
            f" from at least {LEAST_DISPLACEMENTS}: widen the window or add trials"
        )
    share = found.weights / found.weights.sum()
    chosen = found.vectors[rng.choice(len(share), size=count, p=share)]
    whole = found.vectors[rng.choice(len(share), size=min(_WHOLE, len(share)), p=share)]
    one, every = (
        sampled_kernel_rows(part[:, :3], se3.from_rotation_vector(part[:, 3:]), _isotropic(widths))
        for part in (chosen, whole)
    )
    similarity = bhattacharyya(one, every, rng, points=4_000, window=_window(window), threads=threads)
    return [{"weight": 1.0, "mean": vector.tolist()} for vector in chosen], {
        "successes": density.size,
        "displacements": len(found.vectors),
        "similarity": similarity.value,
    }


def _window(window: KernelWindow) -> DisplacementWindow:
    return DisplacementWindow(window.position_m, math.radians(window.rotation_deg))


def _isotropic(widths: KernelWidths) -> IsotropicKernel:
    return IsotropicKernel(widths.sigma_position_m, math.radians(widths.sigma_rotation_deg))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _components(kernel: AnisotropicKernel) -> list[dict[str, Any]]:
    return [
        {"weight": float(w), "mean": m.tolist(), "covariance": s.tolist()}
        for w, m, s in zip(kernel.weights, kernel.means, kernel.covariances, strict=True)
    ]


def info(row: KernelRow) -> StoredKernel:
    """As the wire has it."""
    used = shapes.info_of(row)
    assert used.widths_m is not None
    assert used.widths_deg is not None
    return StoredKernel(
        id=row.id,
        kind=row.kind,
        alignment=row.alignment,
        gripper=row.gripper,
        sigma_position_m=used.sigma_position_m,
        sigma_rotation_deg=used.sigma_rotation_deg,
        widths_m=used.widths_m,
        widths_deg=used.widths_deg,
        components=[KernelComponent.model_validate(item) for item in row.components],
        provenance=KernelProvenance.model_validate(row.provenance),
        created_at=row.created_at,
    )
