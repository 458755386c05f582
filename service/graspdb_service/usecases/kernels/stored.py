"""Kernels: fit them on an object's trials or take them as they are given, list and delete them."""

from __future__ import annotations

import json
import math
import uuid
from dataclasses import replace
from typing import Any

import numpy as np

from graspdb.wire.kernels import (
    MAX_COMPONENTS,
    MAX_SAMPLED,
    KernelCreate,
    KernelProvenance,
    KernelWidths,
    StoredKernel,
)
from graspdb.wire.states import RunState
from graspdb_density import AnisotropicKernel
from graspdb_service import principal
from graspdb_service.problems import found, invalid
from graspdb_service.storage import kernels
from graspdb_service.storage import report_runs as report_run_rows
from graspdb_service.storage.access import audit
from graspdb_service.storage.database import Tx
from graspdb_service.storage.kernels import KernelRow, NewKernel
from graspdb_service.trial_columns import Floats
from graspdb_service.usecases import grippers
from graspdb_service.usecases.densities import stored_kernel
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.kernels import axis_bandwidth_fit, fit
from graspdb_service.usecases.objects import require
from graspdb_service.usecases.runtime.idempotency import Created, Sent, replay_or, replayed
from graspdb_service.usecases.runtime.runs import Runs, model

_SCOPE = "POST /kernels"
_GIVEN = "Kernels given by their components"
#: Axes that kernels of a kind may lie along, where not all.
_ALIGNED = {"sampled": ("gripper",), "probability": ("gripper", "object")}
#: Farther along an axis no displacement between grasps of one object reaches.
_MOST_SHIFT_M = 1.0
#: Shares of a covariance's scale, and metres, below which an entry is none.
_SAME = 1e-9


def create(ctx: Estimators, runs: Runs, request: KernelCreate, sent: Sent) -> Created:
    """Store a kernel, or with ``components=auto`` start the run that fits it (202) unless it is done at once.

    404 for the object, 422 for components that make no kernel, 409 where trials or geometry don't suffice.
    """
    if request.object is None:
        principal.refuse_limited(_GIVEN)
    else:
        principal.refuse_hidden(request.object)
    if request.alignment not in _ALIGNED.get(request.kind, (request.alignment,)):
        ways = " or ".join(f"alignment={name}" for name in _ALIGNED[request.kind])
        raise invalid(
            "alignment", f"a kernel of kind {request.kind} does not lie along those axes: use {ways}"
        )
    # A fit takes a while, and the trials may have gone since.
    earlier = replayed(ctx.database, _SCOPE, sent)
    if earlier is not None and earlier.status == 201:
        return earlier
    if not isinstance(request.components, list) and request.kind != "probability":
        fit.check(request)
        if request.components == "auto":
            return _started(ctx, runs, request, sent)
    made = _given(ctx, request) if isinstance(request.components, list) else _fitted(ctx, request)

    def make(tx: Tx) -> Created:
        if made.gripper is not None:
            grippers.hold(tx, made.gripper)
        row = kernels.create(tx, str(uuid.uuid4()), made)
        audit.record(tx, "kernel.create", object=request.object, subject=row.id)
        return Created(fit.info(row).model_dump(mode="json"), location=f"/kernels/{row.id}")

    return replay_or(ctx.database, _SCOPE, sent, make)


def get(ctx: Estimators, id: str) -> StoredKernel:
    """One kernel."""
    with ctx.database.read() as tx:
        return fit.info(_require(tx, id))


def page(
    ctx: Estimators, *, after: int, limit: int, object: str | None, gripper: str | None
) -> tuple[list[StoredKernel], int | None]:
    """A page of kernels, oldest first, and where the next one starts."""
    with ctx.database.read() as tx:
        object_id = None if object is None else require(tx, object).id
        rows = kernels.page(tx, after=after, limit=limit + 1, object_id=object_id, gripper=gripper)
    # A key that sees some objects only gets short pages.
    items = [fit.info(row) for row in rows[:limit] if principal.sees(stored_kernel.owner(row))]
    return items, rows[limit - 1].number if len(rows) > limit else None


def remove(ctx: Estimators, id: str) -> None:
    """Delete a kernel; densities that were asked with it go on only for answers under way."""
    with ctx.database.write() as tx:
        owner = stored_kernel.owner(_require(tx, id))
        if owner is None:
            principal.refuse_limited(_GIVEN)
        if kernels.remove(tx, id):
            audit.record(tx, "kernel.delete", object=owner, subject=id)
        # The run that fitted it has its id, and answers with it.
        report_run_rows.remove(tx, id)


def _require(tx: Tx, id: str) -> KernelRow:
    """The kernel, or a 404: its id does not tell whose it is."""
    row = kernels.find(tx, id)
    seen = row is not None and principal.sees(stored_kernel.owner(row))
    return found(row if seen else None, "kernel", id, "GET /kernels lists those there are")


def _given(ctx: Estimators, request: KernelCreate) -> NewKernel:
    assert isinstance(request.components, list)
    if request.gripper is not None:
        with ctx.database.read() as tx:
            grippers.named(tx, request.gripper)
    sampled = request.kind == "sampled"
    if request.kind == "probability":
        components, widths = axis_bandwidth_fit.checked(request), None
    else:
        components, widths = _checked_samples(request) if sampled else (_checked_gaussians(request), None)
    provenance = KernelProvenance(origin="given", component_widths=widths)
    return fit.new_kernel(request, components, provenance, request.gripper)


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
    return fit.components_of(kernel)


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


def _fitted(ctx: Estimators, request: KernelCreate) -> NewKernel:
    if request.kind == "probability":
        return axis_bandwidth_fit.fitted(ctx, request)
    with ctx.compute.within():
        return fit.fitted(
            ctx.densities,
            ctx.scenes.features,
            request,
            threads=ctx.compute.threads,
            computed=ctx.compute.run,
            progress=lambda _: None,
        )


def _started(ctx: Estimators, runs: Runs, request: KernelCreate, sent: Sent) -> Created:
    """A fit as a run: the kernel where it is done within the wait, else the run as it is."""
    assert request.object is not None
    row = ctx.densities.selections.resolve(request.object, fit.trials_of(request)).row
    lease = runs.place()
    id = str(uuid.uuid4())
    asked_by = principal.actor()

    def make(tx: Tx) -> Created:
        report_run_rows.ask(tx, fit.run_key(row, id, request, asked_by), id=id, lease_id=lease)
        return Created({"id": id}, location=f"/report-runs/{id}", status=202)

    made = replay_or(ctx.database, _SCOPE, sent, make)
    # The same request may have come before, even while this one did.
    run = runs.follow(made.body["id"], lease if made.body["id"] == id else None)
    if run.state == RunState.RUNNING:
        return replace(made, body=model(run).model_dump(mode="json"))
    assert run.result is not None
    return Created(json.loads(run.result), location=f"/kernels/{run.id}")
