"""``graspdb report`` and ``graspdb kernels``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from graspdb.cli.common import (
    ERRORS,
    Gripper,
    Kernel,
    ObjectId,
    Protocol,
    SigmaPosition,
    SigmaRotation,
    Source,
    out,
    show_rows,
    show_table,
    state_of,
)
from graspdb.reports import Anisotropy, Calibration, Convergence
from graspdb.wire.reports import REPORTS, ReportRange, ReportRun

kernels = typer.Typer(help="Stored kernels.", no_args_is_help=True)


def report(
    context: typer.Context,
    id: ObjectId,
    name: Annotated[str, typer.Argument(metavar="REPORT", help=f"One of: {', '.join(REPORTS)}.")],
    figure: Annotated[
        Path | None, typer.Option(help="Write the figure to this .png or .svg file.", dir_okay=False)
    ] = None,
    kernel: Kernel = None,
    matching: Annotated[
        str | None, typer.Option(help="convergence: determinants or likelihood, beside a stored kernel.")
    ] = None,
    method: Annotated[str | None, typer.Option(help="anisotropy: empirical or density.")] = None,
    alignment: Annotated[str | None, typer.Option(help="anisotropy: gripper or object.")] = None,
    gripper: Gripper = None,
    protocol: Protocol = None,
    source: Source = None,
    sigma_position_m: SigmaPosition = None,
    sigma_rotation_deg: SigmaRotation = None,
) -> None:
    """Report on an object's trials: enough of them, tolerances, calibration."""
    if name not in REPORTS:
        raise typer.BadParameter(f"{name!r} is none of: {', '.join(REPORTS)}", param_hint="REPORT")
    if figure is not None and figure.suffix.lower() not in (".png", ".svg"):
        raise typer.BadParameter("figures are .png or .svg files", param_hint="--figure")
    options = {
        "convergence": {"matching": matching},
        "anisotropy": {"method": method, "alignment": alignment},
        "calibration": {},
    }[name]
    for other, value in {"matching": matching, "method": method, "alignment": alignment}.items():
        if value is not None and other not in options:
            raise typer.BadParameter(f"the {name} report has no such option", param_hint=f"--{other}")
    state = state_of(context)
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=ERRORS, transient=True
    )
    with state.client() as db, bar:
        task: Any = None

        def show(run: ReportRun) -> None:
            nonlocal task
            task = bar.add_task(f"{name} of {id}", total=1.0) if task is None else task
            bar.update(task, completed=run.progress)

        found: Convergence | Anisotropy | Calibration = getattr(db.objects.get(id).reports, name)(
            **options,
            gripper=gripper,
            protocol=protocol,
            source=source,
            kernel=kernel,
            sigma_position_m=sigma_position_m,
            sigma_rotation_deg=sigma_rotation_deg,
            progress=show,
        )
    if figure is not None:
        found.save(figure)
    if state.json:
        out(found.raw)
        return
    _show(found)
    for warning in found.warnings:
        ERRORS.print(f"Mind: {warning}")
    if figure is not None:
        ERRORS.print(f"Figure: {figure}")


def _show(found: Convergence | Anisotropy | Calibration) -> None:
    rows: dict[str, Any] = {"object": f"{found.raw.object}, revision {found.raw.revision}", "": found.text}
    if isinstance(found, Calibration):
        raw = found.raw
        rows |= {
            "Brier skill": _range(raw.skill),
            "over attempts that did not collide": _range(raw.free_skill),
            "calibration error above 0.1": _number(raw.ece),
            "AUC of probability and density": f"{_number(raw.auc_probability)}, {_number(raw.auc_density)}",
        }
    show_rows(rows)
    if isinstance(found, Convergence):
        for curve in found.raw.curves:
            show_table(
                (f"grasps ({curve.label})", "similarity", "deviation", "held-out log density"),
                [
                    (p.grasps, f"{p.similarity:.4f}", f"{p.deviation:.4f}", f"{p.log_likelihood:.3f}")
                    for p in curve.points
                ],
                empty="No points.",
            )
    elif isinstance(found, Calibration):
        show_table(
            ("predicted", "came true", "interval", "attempts"),
            [
                (_number(b.predicted), _number(b.observed), f"{_number(b.low)} to {_number(b.high)}", b.count)
                for b in found.raw.bins
                if b.count
            ],
            empty="No predictions.",
        )


def _range(value: ReportRange | None) -> str:
    if value is None or value.value is None:
        return "unknown"
    return f"{value.value:.2f} ({_number(value.low)} to {_number(value.high)})"


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f}"


@kernels.command("fit")
def fit_kernel(
    context: typer.Context,
    id: ObjectId,
    alignment: Annotated[str, typer.Option(help="gripper or object.")] = "gripper",
    components: Annotated[str, typer.Option(help="1 to 4 Gaussians, or auto.")] = "1",
    gripper: Gripper = None,
    protocol: Protocol = None,
    source: Source = None,
) -> None:
    """Fit an anisotropic kernel on an object's successes."""
    state = state_of(context)
    count: int | str = int(components) if components.isdigit() else components
    given = {"gripper": gripper, "protocol": protocol, "source": source}
    with state.client() as db:
        made = db.kernels.fit(
            id,
            alignment=alignment,
            components=count,
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
            "fitted on": f"{source_of.successes:,} successes, {source_of.displacements:,} displacements",
            "held-out log density": f"{_number(source_of.log_likelihood)}"
            f" (isotropic {_number(source_of.isotropic_log_likelihood)})",
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
