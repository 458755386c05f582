"""``graspdb kernels``."""

from __future__ import annotations

from typing import Annotated

import typer

from graspdb.cli.common import ObjectId, State, run_bar
from graspdb.cli.options import Commands
from graspdb.figures.style import number
from graspdb.resources.kernels import KernelOptions
from graspdb.wire.kernels import KernelProvenance

kernels = Commands(help="Stored kernels.", no_args_is_help=True)


def _fitted_on(source: KernelProvenance) -> dict[str, str]:
    """What a kernel was fitted on, and how well it does on what it has not seen."""
    if source.attempts is not None:
        skill, isotropic = number(source.brier_skill), number(source.isotropic_brier_skill)
        return {
            "fitted on": f"{source.attempts:,} attempts",
            "Brier skill": f"{skill} (isotropic {isotropic})",
            "log loss": f"{number(source.log_loss)} (isotropic {number(source.isotropic_log_loss)})",
        }
    told = {"fitted on": f"{source.successes:,} successes, {source.displacements:,} displacements"}
    if source.log_likelihood is not None:
        told["held-out log density"] = (
            f"{number(source.log_likelihood)} (isotropic {number(source.isotropic_log_likelihood)})"
        )
    return told


@kernels.command("fit")
def fit_kernel(state: State, id: ObjectId, options: KernelOptions) -> None:
    """Fit a kernel on an object's successes, or widths that predict success on all its attempts."""
    with run_bar(f"kernel of {id}") as show:
        made = state.db.kernels.fit(id, progress=show, **options)
    widths = f"{_widths(made.widths_m, 1e3)} mm; {_widths(made.widths_deg)} °"
    state.show(made, {"id": made.id, "widths": widths, **_fitted_on(made.provenance)})


@kernels.command("list")
def list_kernels(state: State) -> None:
    """List stored kernels."""
    state.show_list(
        list(state.db.kernels),
        {
            "id": lambda k: k.id,
            "object": lambda k: k.provenance.object,
            "gripper": lambda k: k.gripper,
            "alignment": lambda k: k.alignment,
            "widths [mm]": lambda k: _widths(k.widths_m, 1e3),
            "widths [°]": lambda k: _widths(k.widths_deg),
        },
        empty="No kernels: fit one with graspdb kernels fit OBJECT.",
    )


@kernels.command("delete")
def delete_kernel(state: State, kernel: Annotated[str, typer.Argument(help="The kernel's id.")]) -> None:
    """Delete a stored kernel."""
    state.db.kernels.delete(kernel)


def _widths(values: tuple[float, ...], factor: float = 1.0) -> str:
    return ", ".join(f"{factor * value:.1f}" for value in values)
