"""``graspdb report``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from graspdb.cli.common import (
    ERRORS,
    ObjectId,
    State,
    number,
    out,
    run_bar,
    show_rows,
    show_table,
    state_of,
)
from graspdb.cli.options import takes_options
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
from graspdb.resources.selection import Selection
from graspdb.wire import OUTCOMES
from graspdb.wire.reports import REPORTS, ReportRange

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


@takes_options
def report(
    context: typer.Context,
    id: ObjectId,
    selection: Selection,
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
    with run_bar(f"{name} of {id}") as show:
        return getattr(reports, name.replace("-", "_"))(**options, progress=show)


def _show(found: Any) -> None:
    raw = found.raw
    rows: dict[str, Any] = {"": found.text}
    if not isinstance(found, Summary):
        rows = {"object": f"{raw.object}, revision {raw.revision}", **rows}
    if isinstance(found, Calibration):
        rows |= {
            "Brier skill": _range(raw.skill),
            "over attempts that did not collide": _range(raw.free_skill),
            "calibration error above 0.1": number(raw.ece),
            "AUC of probability and density": f"{number(raw.auc_probability)}, {number(raw.auc_density)}",
        }
        if raw.checked is not None:
            rows["simulated again"] = (
                f"{raw.checked.successes:,} of {raw.checked.grasps:,} succeeded: {_range(raw.checked.rate)},"
                f" predicted {number(raw.checked.predicted)}"
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
                        number(b.predicted),
                        number(b.observed),
                        f"{number(b.low)} to {number(b.high)}",
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
                        number(p.log_likelihood),
                        f"{number(p.below_best)} ± {number(p.below_best_error)}",
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
                        number(item.predicted),
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
    return f"{value.value:.2f} ({number(value.low)} to {number(value.high)})"
