"""Simulated checks of an object: what became of grasps that no density or probability rests on."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspdb.wire import OUTCOME_CODES, OUTCOMES, KernelInfo
from graspdb.wire.reports import CheckCall
from graspdb.wire.sweeps import is_simulated
from graspdb_density import IsotropicKernel
from graspdb_density.se3 import Poses
from graspdb_service.storage.database import Database
from graspdb_service.storage.simulation import outcomes, sweeps
from graspdb_service.usecases.densities.build import Built
from graspdb_service.usecases.trials import sweep_plan

#: Draws that a sweep named in a report makes: a share of .3 is then known within .04.
DRAWS = 500
_NO_ATTEMPT = OUTCOME_CODES["simulation_error"]


@dataclass(frozen=True, eq=False)
class Check:
    """One check sweep's finished poses; ``kernel`` is the one that a sample was drawn with, where known."""

    plan: str
    protocol: str
    kernel: KernelInfo | None
    poses: Poses
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
        if given is None:
            grid = sweep_plan.grid_of(sweep)
            given = sweep_plan.grid_poses(grid, grid.pose_indices(chunk.start, chunk.stop))
        codes = np.frombuffer(chunk.outcomes, dtype=np.uint8)
        kept = codes != _NO_ATTEMPT
        kernel = sweep.snapshot.get("drawn_with")
        result.append(
            Check(
                plan=sweep.plan,
                protocol=sweep.protocol,
                kernel=None if kernel is None else KernelInfo.model_validate(kernel),
                poses=given.poses[kept],
                codes=codes[kept],
            )
        )
    return result


def tally(codes: NDArray[np.uint8]) -> dict[str, int]:
    """Counts by outcome, those there are."""
    counts = np.bincount(codes, minlength=len(OUTCOMES))
    return {name: int(counts[code]) for code, name in enumerate(OUTCOMES) if counts[code]}


def calls(built: Built, kernels: Iterable[IsotropicKernel | str]) -> list[CheckCall]:
    """The sweeps that draw under kernels (widths, or the id of a stored one) and simulate what they drew, by
    the trials' own protocol where it is one that is simulated.
    """
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
        if is_simulated(selected.protocol):
            body["protocol"] = selected.protocol
        made.append(CheckCall(method="POST", path=f"/objects/{built.object_row.slug}/sweeps", body=body))
    return made
