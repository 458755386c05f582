"""Kernels that predict success: a width an axis, the gripper's or the object's, chosen on all attempts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from graspdb.wire.kernels import KernelComponent, KernelCreate, KernelWidths
from graspdb_density import AnisotropicKernel
from graspdb_density.success.axis_bandwidth import fit_axis_bandwidths
from graspdb_service.problems import invalid, too_few_trials
from graspdb_service.storage.kernels import NewKernel
from graspdb_service.usecases.densities import stored_kernel
from graspdb_service.usecases.densities.estimators import Estimators
from graspdb_service.usecases.kernels import fit
from graspdb_service.usecases.trials import attempts

#: A correlation beyond this is one.
_CORRELATED = 1e-9


def fitted(ctx: Estimators, request: KernelCreate) -> NewKernel:
    """Widths chosen by held-out log loss.

    Attempts that collided are left out where collisions are tested, as they are when success is predicted.
    409 for too few successes or failures, or attempts all in one place.
    """
    assert request.object is not None
    with ctx.compute.within():
        selected = ctx.densities.selections.resolve(request.object, fit.trials_of(request))
        # Said first: without axes no number of trials helps.
        axes = stored_kernel.axes(request.alignment, selected, ctx.scenes.features)
        assert not callable(axes)
        everything = attempts.read(ctx.database, selected)
        tested = ctx.scenes.test(selected) is not None
        kept = ~everything.collided if tested else np.ones(len(everything), dtype=bool)
        try:
            found = ctx.compute.run(
                lambda: fit_axis_bandwidths(
                    everything.poses[kept],
                    everything.success[kept],
                    axes=axes,
                    symmetric=everything.symmetric[kept],
                )
            )
        except ValueError as error:
            raise too_few_trials(str(error)) from None
    component = KernelComponent(covariance=np.diag(np.square(found.kernel.sigmas)).tolist())
    return fit.fitted_on(
        selected,
        request,
        [component.model_dump(mode="json")],
        attempts=found.attempts,
        judged=found.judged,
        log_loss=found.log_loss,
        isotropic_log_loss=found.isotropic_log_loss,
        brier_skill=fit.finite(found.skill),
        isotropic_brier_skill=fit.finite(found.isotropic_skill),
        isotropic_widths=KernelWidths(
            sigma_position_m=found.isotropic.sigma_position_m,
            sigma_rotation_deg=min(40.0, math.degrees(found.isotropic.sigma_rotation)),
        ),
    )


def checked(request: KernelCreate) -> list[dict[str, Any]]:
    """The one component of a kernel that is given; 422 for more, one off the centre, or correlations."""
    assert isinstance(request.components, list)
    if len(request.components) != 1:
        raise invalid("components", "a kernel that predicts success has one component")
    item = request.components[0]
    if item.covariance is None or any(item.mean):
        raise invalid("components.0", "it has a covariance and no mean")
    given = np.array(item.covariance)
    spread = np.sqrt(np.maximum(np.diag(given), 0.0))
    if np.any(np.abs(given - np.diag(np.diag(given))) > _CORRELATED * np.outer(spread, spread)):
        raise invalid("components.0.covariance", "one width an axis: entries off the diagonal are zero")
    try:
        kernel = AnisotropicKernel.gaussian(given)
    except ValueError as error:
        raise invalid("components.0.covariance", str(error)) from None
    component = KernelComponent(covariance=kernel.covariances[0].tolist())
    return [component.model_dump(mode="json")]
