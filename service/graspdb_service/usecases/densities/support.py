"""How far answers are from what was tried, as it is told."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import NearestAttempt, ReachInfo, Support
from graspdb_density import IsotropicKernel
from graspdb_service.usecases.densities.learned.learning import Model
from graspdb_service.usecases.densities.success_models import Estimates

Floats = NDArray[np.float64]


def support_columns(estimates: Estimates) -> dict[str, Any]:
    """Columns of many poses; numbers in float32, whose digits are enough and half as long."""
    nearest = estimates.nearest
    distances = {
        "position_m": nearest.position_m,
        "rotation_deg": np.degrees(nearest.rotation),
        "kernel_widths": nearest.widths,
    }
    return {
        "nearest_attempt": {name: column.astype(np.float32) for name, column in distances.items()},
        "effective_trials": estimates.effective_trials.astype(np.float32),
        "enough": estimates.enough,
    }


def support_of(estimates: Estimates, row: int, reach: ReachInfo | None) -> Support:
    """That of one pose, with the reason where it is not enough."""
    nearest, enough = estimates.nearest, bool(estimates.enough[row])
    at = None
    if math.isfinite(nearest.position_m[row]):
        at = NearestAttempt(
            position_m=float(nearest.position_m[row]),
            rotation_deg=math.degrees(nearest.rotation[row]),
            kernel_widths=float(nearest.widths[row]),
        )
    trials = float(estimates.effective_trials[row])
    reason = None if enough else _reason(at, reach)
    return Support(nearest_attempt=at, effective_trials=trials, enough=enough, reason=reason)


def _reason(nearest: NearestAttempt | None, reach: ReachInfo | None) -> str:
    if nearest is None or reach is None:
        return "no attempt tells how likely a success is: post trials that failed, too"
    return (
        f"the nearest attempt is {1e3 * nearest.position_m:.1f} mm and {nearest.rotation_deg:.0f} degrees"
        f" away; success probabilities are told up to {_limits(reach)}{_by_axis(reach)}"
    )


def _limits(reach: ReachInfo) -> str:
    if reach.position_m is None or reach.rotation_deg is None:
        widths = f"{reach.position_widths:.2g} kernel widths of position and {reach.rotation_widths:.2g}"
        return f"{widths} of rotation"
    return f"{1e3 * reach.position_m:.1f} mm and {reach.rotation_deg:.0f} degrees"


def _by_axis(reach: ReachInfo) -> str:
    """The limits of single axes, where they say more than those of all."""
    told = []
    along, about = reach.along_m, reach.about_deg
    if along is not None and (reach.position_m is None or min(along) < reach.position_m):
        told.append(f"{', '.join(f'{1e3 * limit:.0f}' for limit in along)} mm along x, y, z")
    if about is not None and (reach.rotation_deg is None or min(about) < reach.rotation_deg):
        told.append(f"{', '.join(f'{limit:.0f}' for limit in about)} degrees about x, y, z")
    return f", no more than {' and '.join(told)} of the gripper" if told else ""


def reach_info(model: Model | None) -> ReachInfo | None:
    """How far a model tells, and why no farther; None without one."""
    if model is None:
        return None
    reach, kernel = model.reach, model.whole.kernel
    info = ReachInfo(
        position_widths=reach.position,
        rotation_widths=reach.rotation,
        validated=bool(reach.validated_position or reach.validated_rotation),
        attempts=reach.attempts,
        along_m=list(reach.along[:3]),
        about_deg=np.degrees(reach.along[3:]).tolist(),
        rule="",
    )
    if isinstance(kernel, IsotropicKernel):
        info.position_m = reach.position * kernel.sigma_position_m
        info.rotation_deg = math.degrees(reach.rotation * kernel.sigma_rotation)
    told = []
    for name, limit, validated in (
        ("position", reach.position, reach.validated_position),
        ("rotation", reach.rotation, reach.validated_rotation),
    ):
        if validated is not None and validated >= limit:
            told.append(
                f"{name}: with everything nearer left out, attempts are still predicted better than by the"
                " share of successes"
            )
            continue
        why = "too few attempts tell how far predictions reach"
        if validated is not None:
            why = "left-out attempts are predicted no better than by the share of successes any farther"
        told.append(f"{name}: {why}, so as near as 19 of 20 attempts lie to another one, at most one width")
    by_axis = _by_axis(info)
    if by_axis:
        told.append("along and about single axes: as far as attempts near one another lie apart")
    info.rule = f"up to {_limits(info)} from the nearest attempt{by_axis} ({'; '.join(told)})"
    return info
