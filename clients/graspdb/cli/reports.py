"""``graspdb report`` and ``graspdb kernels``."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from graspdb.cli.common import (
    ERRORS,
    Gripper,
    ObjectId,
    Protocol,
    Source,
    State,
    out,
    selecting,
    show_rows,
    show_table,
    state_of,
)
from graspdb.errors import ChecksNeeded
from graspdb.reports import (
    Bandwidth,
    Calibration,
    Convergence,
    KernelSimilarity,
    Reports,
    Sources,
    Summary,
)
from graspdb.wire import OUTCOMES
from graspdb.wire.kernels import KernelProvenance
from graspdb.wire.reports import REPORTS, ReportRange, ReportRun

kernels = typer.Typer(help="Stored kernels.", no_args_is_help=True)


#: What each report takes, by the names of the SDK.
_SELECTION = ("gripper", "protocol", "source")
_KERNEL = ("kernel", "sigma_position_m", "sigma_rotation_deg")
OPTIONS: dict[str, tuple[str, ...]] = {
    "convergence": ("matching", *_SELECTION, *_KERNEL),
    "anisotropy": ("method", "alignment", *_SELECTION, *_KERNEL),
    "calibration": (*_SELECTION, *_KERNEL),
    "projection": (
        "plane",
        "approach",
        "approach_cone_deg",
        "direction",
        "direction_cone_deg",
        *_SELECTION,
        *_KERNEL,
    ),
    "bandwidth": _SELECTION,
    "kernel-similarity": (
        "window_position_m",
        "window_rotation_deg",
        "component_position_m",
        "component_rotation_deg",
        *_SELECTION,
    ),
    "sources": ("gripper", "protocol", "sigma_position_m", "sigma_rotation_deg"),
    "summary": (),
}


@selecting
def report(
    context: typer.Context,
    id: ObjectId,
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[REPORT]",
            help=f"One of: {', '.join(REPORTS)}. Instead of both, `graspdb report summary`: all objects.",
            show_default=False,
        ),
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Write the figure to this .png or .svg file.", dir_okay=False)
    ] = None,
    matching: Annotated[
        str | None,
        typer.Option(help="convergence: determinants, likelihood or success, beside a stored kernel."),
    ] = None,
    method: Annotated[str | None, typer.Option(help="anisotropy: empirical or density.")] = None,
    alignment: Annotated[
        str | None, typer.Option(help="anisotropy: gripper, object, edge or surface-pair.")
    ] = None,
    plane: Annotated[
        str | None, typer.Option(help="projection: xy, xz, yz or the plane's normal x,y,z.")
    ] = None,
    approach: Annotated[
        str | None, typer.Option(help="projection: only grasps whose tool z points along x,y,z (or -z ...).")
    ] = None,
    approach_cone_deg: Annotated[
        float | None, typer.Option("--approach-cone-deg", help="projection: half angle, 30 by default.")
    ] = None,
    direction: Annotated[
        str | None, typer.Option(help="projection: only grasps whose tool x lies along x,y,z (or z ...).")
    ] = None,
    direction_cone_deg: Annotated[
        float | None, typer.Option("--direction-cone-deg", help="projection: half angle, 30 by default.")
    ] = None,
    window_position_m: Annotated[
        float | None, typer.Option("--window-position-m", help="kernel-similarity: half edge of the window.")
    ] = None,
    window_rotation_deg: Annotated[
        float | None, typer.Option("--window-rotation-deg", help="kernel-similarity: largest turn.")
    ] = None,
    component_position_m: Annotated[
        float | None, typer.Option("--component-position-m", help="kernel-similarity: width of a sample.")
    ] = None,
    component_rotation_deg: Annotated[
        float | None, typer.Option("--component-rotation-deg", help="kernel-similarity: width of a sample.")
    ] = None,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="Have a worker simulate the draws that the report lacks.")
    ] = False,
) -> None:
    """Report on an object's trials: where grasps succeed, tolerances, enough of them, calibration, sources.

    `graspdb report summary` counts the trials of all objects.
    """
    if name is None and id == "summary":
        name = "summary"
    if name is None or (name not in REPORTS and name != "summary"):
        raise typer.BadParameter(
            f"{name or 'nothing'!r} is none of: {', '.join(REPORTS)}", param_hint="REPORT"
        )
    if figure is not None and figure.suffix.lower() not in (".png", ".svg"):
        raise typer.BadParameter("figures are .png or .svg files", param_hint="--figure")
    named = [option for options in OPTIONS.values() for option in options]
    given = {option: value for option in named if (value := context.params.get(option)) is not None}
    for option in given:
        if option not in OPTIONS[name]:
            raise typer.BadParameter(
                f"the {name} report has no such option", param_hint=f"--{option.replace('_', '-')}"
            )
    state = state_of(context)
    found: Any
    if name == "summary":
        with state.client() as db:
            found = db.reports.summary()
    else:
        found = _computed(state, id, name, given, simulate)
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


def _computed(state: State, id: str, name: str, options: dict[str, Any], simulate: bool) -> Any:
    """The report, with a bar while the service computes it, and before that while it is simulated."""
    with state.client() as db:
        reports = db.objects.get(id).reports
        try:
            found = _asked(reports, id, name, options)
            calls = getattr(found.raw, "calls", [])
        except ChecksNeeded as error:
            if not simulate:
                raise
            calls = error.calls
        if not simulate or not calls:
            return found
        for sweep in reports.simulate(calls):
            sweep.wait(progress=not state.json)
        return _asked(reports, id, name, options)


def _asked(reports: Reports, id: str, name: str, options: dict[str, Any]) -> Any:
    with _bar(f"{name} of {id}") as show:
        return getattr(reports, name.replace("-", "_"))(**options, progress=show)


@contextmanager
def _bar(title: str) -> Iterator[Callable[[ReportRun], None]]:
    """How far a run is, for a person to see, once it is told."""
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=ERRORS, transient=True
    )
    with bar:
        task: Any = None

        def show(run: ReportRun) -> None:
            nonlocal task
            task = bar.add_task(title, total=1.0) if task is None else task
            bar.update(task, completed=run.progress)

        yield show


def _show(found: Any) -> None:
    raw = found.raw
    rows: dict[str, Any] = {"": found.text}
    if not isinstance(found, Summary):
        rows = {"object": f"{raw.object}, revision {raw.revision}", **rows}
    if isinstance(found, Calibration):
        rows |= {
            "Brier skill": _range(raw.skill),
            "over attempts that did not collide": _range(raw.free_skill),
            "calibration error above 0.1": _number(raw.ece),
            "AUC of probability and density": f"{_number(raw.auc_probability)}, {_number(raw.auc_density)}",
        }
        if raw.checked is not None:
            rows["simulated again"] = (
                f"{raw.checked.successes:,} of {raw.checked.grasps:,} succeeded: {_range(raw.checked.rate)},"
                f" predicted {_number(raw.checked.predicted)}"
            )
    show_rows(rows)
    for table in _tables(found):
        show_table(table[0], table[1], empty="Nothing.")
    for call in getattr(raw, "calls", []):
        ERRORS.print(
            f"Missing: {call.method} {call.path} {json.dumps(call.body)}", soft_wrap=True, markup=False
        )


Table = tuple[tuple[str, ...], list[tuple[Any, ...]]]


def _tables(found: Any) -> list[Table]:
    """What is shown below the words, by kind of report."""
    raw = found.raw
    if isinstance(found, Convergence):
        return [
            (
                (f"grasps ({curve.label})", "similarity", "deviation", "held-out log density"),
                [
                    (p.grasps, f"{p.similarity:.4f}", f"{p.deviation:.4f}", f"{p.log_likelihood:.3f}")
                    for p in curve.points
                ],
            )
            for curve in raw.curves
        ]
    if isinstance(found, Calibration):
        return [
            (
                ("predicted", "came true", "interval", "attempts"),
                [
                    (
                        _number(b.predicted),
                        _number(b.observed),
                        f"{_number(b.low)} to {_number(b.high)}",
                        b.count,
                    )
                    for b in raw.bins
                    if b.count
                ],
            )
        ]
    if isinstance(found, Bandwidth):
        best = sorted(raw.grid, key=lambda p: -(p.log_likelihood or -1e99))[:8]
        tables: list[Table] = [
            (
                ("position [mm]", "rotation [°]", "held-out log density", "below the best"),
                [
                    (
                        f"{1e3 * p.sigma_position_m:.1f}",
                        f"{p.sigma_rotation_deg:.1f}",
                        _number(p.log_likelihood),
                        f"{_number(p.below_best)} ± {_number(p.below_best_error)}",
                    )
                    for p in best
                ],
            )
        ]
        if raw.draws:
            tables.append(
                (
                    ("draws at", "protocol", "simulated", "succeed", "collide", "succeed of the rest"),
                    [
                        (
                            f"{1e3 * d.kernel.sigma_position_m:.1f} mm, {d.kernel.sigma_rotation_deg:.1f}°",
                            d.protocol,
                            d.draws,
                            _range(d.success),
                            _range(d.collision),
                            _range(d.free_success),
                        )
                        for d in raw.draws
                    ],
                )
            )
        return tables
    if isinstance(found, KernelSimilarity):
        return [
            (
                (what, "similarity", "error"),
                [(p.count, f"{p.similarity:.3f}", f"{p.error:.3f}") for p in points],
            )
            for what, points in (("samples", raw.samples), ("Gaussians", raw.mixtures))
        ]
    if isinstance(found, Sources):
        return [
            (
                (
                    "source",
                    "trials",
                    "succeeded",
                    "predicted",
                    "agreement",
                    "Brier skill",
                    "density similarity",
                ),
                [
                    (
                        item.source,
                        item.trials,
                        _range(item.share),
                        _number(item.predicted),
                        _range(item.agreement),
                        _range(item.skill),
                        "unknown"
                        if item.similarity is None
                        else f"{item.similarity.value:.2f} (chance alone {_range(item.similarity.expected)})",
                    )
                    for item in raw.sources
                ],
            )
        ]
    if isinstance(found, Summary):
        outcomes = [name for name in OUTCOMES if any(name in row.outcomes for row in raw.rows)]
        return [
            (
                ("object", "gripper", "protocol", "source", *outcomes),
                [
                    (
                        row.object,
                        row.gripper,
                        row.protocol,
                        row.source,
                        *(row.outcomes.get(name, 0) for name in outcomes),
                    )
                    for row in raw.rows
                ],
            ),
            (
                ("object", "source", *raw.rules),
                [(row.object, row.source, *(_percent(item.rate) for item in row.rates)) for row in raw.rows],
            ),
        ]
    return []


def _percent(value: ReportRange) -> str:
    if value.value is None or value.low is None or value.high is None:
        return "unknown"
    return f"{100 * value.value:.2f} % ({100 * value.low:.2f} to {100 * value.high:.2f})"


def _range(value: ReportRange | None) -> str:
    if value is None or value.value is None:
        return "unknown"
    return f"{value.value:.2f} ({_number(value.low)} to {_number(value.high)})"


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f}"


def _fitted_on(source: KernelProvenance) -> dict[str, str]:
    """What a kernel was fitted on, and how well it does on what it has not seen."""
    if source.attempts is not None:
        skill, isotropic = _number(source.brier_skill), _number(source.isotropic_brier_skill)
        return {
            "fitted on": f"{source.attempts:,} attempts",
            "Brier skill": f"{skill} (isotropic {isotropic})",
            "log loss": f"{_number(source.log_loss)} (isotropic {_number(source.isotropic_log_loss)})",
        }
    told = {"fitted on": f"{source.successes:,} successes, {source.displacements:,} displacements"}
    if source.log_likelihood is not None:
        told["held-out log density"] = (
            f"{_number(source.log_likelihood)} (isotropic {_number(source.isotropic_log_likelihood)})"
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
    with state.client() as db, _bar(f"kernel of {id}") as show:
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
