"""Simulated checks of an object: what became of grasps that no density or probability rests on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from graspdb.wire import OUTCOME_CODES, OUTCOMES, KernelInfo
from graspdb.wire.reports import CheckCall, ReportRange, SimulatedDraws
from graspdb_density import IsotropicKernel
from graspdb_service.storage.database import Database
from graspdb_service.storage.simulation import outcomes, sweeps
from graspdb_service.usecases.densities.cache import Built
from graspdb_service.usecases.reports.common import LEVEL
from graspdb_service.usecases.trials import sweep_plan

Floats = NDArray[np.float64]

#: Draws that a sweep named in a report makes: a share of .3 is then known within .04.
DRAWS = 500
_NO_ATTEMPT = OUTCOME_CODES["simulation_error"]
_SUCCESS, _COLLISION = OUTCOME_CODES["success"], OUTCOME_CODES["collision"]


@dataclass(frozen=True, eq=False)
class Check:
    """One check sweep's finished poses; ``kernel`` is the one that a sample was drawn with, where known."""

    plan: str
    protocol: str
    kernel: KernelInfo | None
    position: Floats
    quaternion: Floats
    codes: NDArray[np.uint8]


def read(database: Database, built: Built) -> list[Check]:
    """The checks of a selection's gripper and protocol; simulation errors are left out."""
    selected = built.selected
    with database.read() as tx:
        found = outcomes.checked(
            tx, built.object_row.id, gripper=selected.gripper, protocol=selected.protocol
        )
        plan = sweeps.find_many(tx, sorted({chunk.sweep_id for chunk in found}))
        poses = [sweep_plan.chunk_poses(tx, plan[chunk.sweep_id], chunk.start, chunk.stop) for chunk in found]
    result = []
    for chunk, given in zip(found, poses, strict=True):
        sweep = plan[chunk.sweep_id]
        at = given or sweep_plan.grid_poses(sweep_plan.grid_of(sweep), chunk.start, chunk.stop)
        codes = np.frombuffer(chunk.outcomes, dtype=np.uint8)
        kept = codes != _NO_ATTEMPT
        kernel = sweep.snapshot.get("drawn_with")
        result.append(
            Check(
                plan=sweep.plan,
                protocol=sweep.protocol,
                kernel=None if kernel is None else KernelInfo.model_validate(kernel),
                position=at.position[kept],
                quaternion=at.quaternion_xyzw[kept],
                codes=codes[kept],
            )
        )
    return result


def draws(found: Sequence[Check]) -> list[SimulatedDraws]:
    """What became of draws, those of one kernel and protocol together, the narrowest first."""
    together: dict[tuple[Any, ...], list[Check]] = {}
    for item in found:
        if item.plan == "sample" and item.kernel is not None and len(item.codes):
            k = item.kernel
            key = (
                k.id or "",
                round(k.sigma_position_m, 9),
                round(k.sigma_rotation_deg, 6),
                item.protocol,
            )
            together.setdefault(key, []).append(item)
    result = []
    for items in together.values():
        codes = np.concatenate([item.codes for item in items])
        won, hit = int((codes == _SUCCESS).sum()), int((codes == _COLLISION).sum())
        kernel = items[-1].kernel
        assert kernel is not None
        result.append(
            SimulatedDraws(
                kernel=kernel,
                protocol=items[0].protocol,
                draws=len(codes),
                outcomes=tally(codes),
                success=share(won, len(codes)),
                collision=share(hit, len(codes)),
                free_success=share(won, len(codes) - hit),
            )
        )
    return sorted(result, key=lambda d: (d.kernel.id or "", d.kernel.sigma_position_m, d.protocol))


def tally(codes: NDArray[np.uint8]) -> dict[str, int]:
    """Counts by outcome, those there are."""
    counts = np.bincount(codes, minlength=len(OUTCOMES))
    return {name: int(counts[code]) for code, name in enumerate(OUTCOMES) if counts[code]}


def share(won: float, tried: float, level: float = LEVEL) -> ReportRange:
    """A share of independent trials with Jeffreys' interval, which includes what was seen."""
    if not tried > 0:
        return ReportRange(value=None, low=None, high=None)
    value, tail = won / tried, 0.5 * (1.0 - level)
    low, high = (float(betaincinv(won + 0.5, tried - won + 0.5, t)) for t in (tail, 1.0 - tail))
    return ReportRange(value=value, low=min(low, value), high=max(high, value))


def calls(built: Built, kernels: Iterable[IsotropicKernel | str], protocol: str | None) -> list[CheckCall]:
    """The sweeps that draw under kernels (widths, or the id of a stored one) and simulate what they drew."""
    selected = built.selected
    made = []
    for kernel in kernels:
        sample: dict[str, Any] = {"count": DRAWS, "seed": 0}
        if isinstance(kernel, str):
            sample["kernel"] = kernel
        else:
            sample["kernel"] = {
                "kind": "isotropic",
                "sigma_position_m": round(kernel.sigma_position_m, 6),
                "sigma_rotation_deg": round(float(np.degrees(kernel.sigma_rotation)), 4),
            }
        if selected.protocol is not None:
            sample["protocol"] = selected.protocol
        body: dict[str, Any] = {"sample": sample, "purpose": "check"}
        if selected.gripper is not None:
            body["gripper"] = selected.gripper
        if protocol is not None:
            body["protocol"] = protocol
        made.append(CheckCall(method="POST", path=f"/objects/{built.object_row.slug}/sweeps", body=body))
    return made
