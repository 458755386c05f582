"""Kernels: fit them on an object's trials or take them as they are given, list and delete them."""

from __future__ import annotations

import math
import uuid
from typing import Any

import numpy as np

from graspdb.wire.kernels import (
    KernelComponent,
    KernelCreate,
    KernelProvenance,
    KernelWidths,
    KernelWindow,
    StoredKernel,
)
from graspdb_density import AnisotropicKernel, IsotropicKernel
from graspdb_density.fitting import fit_kernel
from graspdb_density.similarity import DisplacementWindow
from graspdb_service.problems import conflict, invalid, not_found
from graspdb_service.storage import grippers, kernels
from graspdb_service.storage.database import Tx
from graspdb_service.storage.kernels import KernelRow
from graspdb_service.usecases import shapes
from graspdb_service.usecases.context import Context
from graspdb_service.usecases.densities import KernelChoice, require_object
from graspdb_service.usecases.grippers import unknown
from graspdb_service.usecases.idempotency import Created, replay_or
from graspdb_service.usecases.selection import Filters


def create(ctx: Context, request: KernelCreate, *, key: str | None, body: bytes) -> Created:
    """Store a kernel.

    Raises
    ------
    ProblemError
        404 for the object, 422 for components that make no kernel or an alignment that can't be measured,
        409 where the trials don't suffice to fit one.
    """
    shapes.check_alignment(request.alignment)
    made = _given(ctx, request) if isinstance(request.components, list) else _fitted(ctx, request)

    def make(tx: Tx) -> Created:
        row = kernels.create(tx, str(uuid.uuid4()), **made)
        return Created(info(row).model_dump(mode="json"), location=f"/kernels/{row.id}")

    return replay_or(ctx, scope="POST /kernels", key=key, request=body, create=make)


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
    try:
        kernel = AnisotropicKernel.symmetrised(
            [item.weight for item in request.components],
            [item.mean for item in request.components],
            [item.covariance for item in request.components],
            frame="gripper" if request.alignment == "gripper" else "fixed",
        )
        # What no equivalent width can be told of has none.
        kernel.isotropic  # noqa: B018
    except ValueError as error:
        raise invalid("components", str(error), "These components make no kernel") from None
    return {
        "kind": request.kind,
        "alignment": request.alignment,
        "gripper": request.gripper,
        "object_id": None,
        "components": _components(kernel),
        "provenance": KernelProvenance(origin="given").model_dump(mode="json", exclude_none=True),
    }


def _fitted(ctx: Context, request: KernelCreate) -> dict[str, Any]:
    assert request.object is not None
    count = request.components
    assert not isinstance(count, list)
    if request.alignment == "object" and count not in (1, "auto"):
        raise invalid("components", "the object's axes have no sign: a kernel aligned with them has 1")
    window, widths = request.window or KernelWindow(), request.component_widths or KernelWidths()
    filters = Filters(request.gripper, request.protocol, request.source)
    with ctx.compute.admitted():
        built = ctx.densities.get(request.object, filters, KernelChoice())
        density, selected = built.density, built.selected
        frame = shapes.principal_axes(built.object_row) if request.alignment == "object" else None
        if density is None:
            raise conflict(
                "too-few-trials",
                "No trial of this selection succeeded, so there is nothing to fit a kernel on:"
                f" post trials (POST /objects/{request.object}/trials) or sweep a grid first",
            )
        try:
            fit = ctx.compute.run(
                lambda: fit_kernel(
                    density.positions,
                    density.quaternions_xyzw,
                    window=DisplacementWindow(window.position_m, math.radians(window.rotation_deg)),
                    widths=IsotropicKernel(widths.sigma_position_m, math.radians(widths.sigma_rotation_deg)),
                    compared=density.kernel,
                    components=None if count == "auto" else count,
                    weights=density.weights,
                    symmetric=density.symmetric,
                    frame=frame,
                    threads=ctx.compute.threads,
                )
            )
        except ValueError as error:
            text = str(error)
            raise conflict("too-few-trials", f"No kernel can be fitted: {text}") from None
    provenance = KernelProvenance(
        origin="fitted",
        object=built.object_row.slug,
        revision=built.revision,
        protocol=selected.protocol,
        source=selected.source,
        successes=fit.successes,
        displacements=fit.displacements,
        window=window,
        component_widths=widths,
        scale=fit.scale,
        log_likelihood=_finite(fit.log_likelihood),
        isotropic_log_likelihood=_finite(fit.isotropic_log_likelihood),
        similarity=fit.similarity.value,
        likelihood_by_components={str(k): v for k, v in fit.likelihoods.items()} or None,
    )
    return {
        "kind": request.kind,
        "alignment": request.alignment,
        "gripper": selected.gripper,
        "object_id": built.object_row.id,
        "components": _components(fit.kernel),
        "provenance": provenance.model_dump(mode="json", exclude_none=True),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _components(kernel: AnisotropicKernel) -> list[dict[str, Any]]:
    return [
        {"weight": float(w), "mean": m.tolist(), "covariance": s.tolist()}
        for w, m, s in zip(kernel.weights, kernel.means, kernel.covariances, strict=True)
    ]


def info(row: KernelRow) -> StoredKernel:
    """As the wire has it."""
    kernel = shapes.load(row)
    used = shapes.info_of(row, kernel)
    widths = np.sqrt(np.diag(kernel.overall_covariance))
    return StoredKernel(
        id=row.id,
        kind=row.kind,
        alignment=row.alignment,
        gripper=row.gripper,
        sigma_position_m=used.sigma_position_m,
        sigma_rotation_deg=used.sigma_rotation_deg,
        widths_m=(float(widths[0]), float(widths[1]), float(widths[2])),
        widths_deg=(
            math.degrees(widths[3]),
            math.degrees(widths[4]),
            math.degrees(widths[5]),
        ),
        components=[KernelComponent.model_validate(item) for item in row.components],
        provenance=KernelProvenance.model_validate(row.provenance),
        created_at=row.created_at,
    )
