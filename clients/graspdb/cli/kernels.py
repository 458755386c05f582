"""``graspdb kernels``."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from graspdb.cli.common import (
    Gripper,
    ObjectId,
    Protocol,
    Source,
    number,
    out,
    run_bar,
    show_rows,
    show_table,
    state_of,
)
from graspdb.wire.kernels import KernelProvenance

kernels = typer.Typer(help="Stored kernels.", no_args_is_help=True)


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
def fit_kernel(
    context: typer.Context,
    id: ObjectId,
    alignment: Annotated[
        str, typer.Option(help="gripper; anisotropic: or object, edge, surface-pair; probability: or object.")
    ] = "gripper",
    components: Annotated[
        str | None, typer.Option(help="anisotropic: 1 to 16 Gaussians, or auto; sampled: displacements.")
    ] = None,
    kind: Annotated[str, typer.Option(help="anisotropic, sampled or probability.")] = "anisotropic",
    gripper: Gripper = None,
    protocol: Protocol = None,
    source: Source = None,
) -> None:
    """Fit a kernel on an object's successes, or widths that predict success on all its attempts."""
    state = state_of(context)
    count = int(components) if components is not None and components.isdigit() else components
    given: dict[str, Any] = {
        "gripper": gripper,
        "protocol": protocol,
        "source": source,
        "components": count,
    }
    with state.client() as db, run_bar(f"kernel of {id}") as show:
        made = db.kernels.fit(
            id,
            kind=kind,
            alignment=alignment,
            progress=show,
            **{name: value for name, value in given.items() if value is not None},
        )
    if state.json:
        out(made)
        return
    source_of = made.provenance
    show_rows(
        {
            "id": made.id,
            "widths": _widths(made.widths_m, 1e3, "mm") + "; " + _widths(made.widths_deg, 1.0, "°"),
            **_fitted_on(source_of),
        }
    )


@kernels.command("list")
def list_kernels(context: typer.Context) -> None:
    """List stored kernels."""
    state = state_of(context)
    with state.client() as db:
        found = list(db.kernels)
    if state.json:
        out(found)
        return
    show_table(
        ("id", "object", "gripper", "alignment", "widths [mm]", "widths [°]"),
        [
            (
                k.id,
                k.provenance.object,
                k.gripper,
                k.alignment,
                _widths(k.widths_m, 1e3, ""),
                _widths(k.widths_deg, 1.0, ""),
            )
            for k in found
        ],
        empty="No kernels: fit one with graspdb kernels fit OBJECT.",
    )


@kernels.command("delete")
def delete_kernel(
    context: typer.Context, kernel: Annotated[str, typer.Argument(help="The kernel's id.")]
) -> None:
    """Delete a stored kernel."""
    with state_of(context).client() as db:
        db.kernels.delete(kernel)


def _widths(values: tuple[float, ...], factor: float, unit: str) -> str:
    return ", ".join(f"{factor * value:.1f}" for value in values) + (f" {unit}" if unit else "")
