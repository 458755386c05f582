"""``graspdb report``."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from graspdb import wire
from graspdb.cli.common import ERRORS, ObjectId, State, out, run_bar, show_rows, show_table
from graspdb.errors import ChecksNeeded
from graspdb.figures import FILE_FORMATS
from graspdb.figures.style import number, widths
from graspdb.reports import (
    AnisotropyOptions,
    ConvergenceOptions,
    KernelSimilarityOptions,
    ProjectionOptions,
    Reports,
)
from graspdb.wire.reports import REPORT_NAMES, REPORTS, ReportRange

_NAMES = ", ".join(REPORT_NAMES)
Table = tuple[tuple[str, ...], list[tuple[Any, ...]]]


class Options(ConvergenceOptions, AnisotropyOptions, ProjectionOptions, KernelSimilarityOptions, total=False):
    """Of all reports."""


def report(
    state: State,
    id: ObjectId,
    options: Options,
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[REPORT]",
            help=f"One of: {_NAMES}. Instead of both, `graspdb report summary`: all objects.",
            show_default=False,
        ),
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Write the figure to this .png or .svg file.", dir_okay=False)
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
        raise typer.BadParameter(f"{name or 'nothing'!r} is none of: {_NAMES}", param_hint="REPORT")
    if figure is not None and figure.suffix.lower() not in FILE_FORMATS:
        raise typer.BadParameter("figures are .png or .svg files", param_hint="--figure")
    known = REPORTS[name].options.model_fields if name in REPORTS else ()
    for option in options:
        if option not in known:
            raise typer.BadParameter(
                f"the {name} report has no such option", param_hint=f"--{option.replace('_', '-')}"
            )
    found = _computed(state, id, name, options, simulate)
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


def _computed(state: State, id: str, name: str, options: Options, simulate: bool) -> Any:
    """The report, with a bar while the service computes it, and before that while it is simulated."""
    if name == "summary":
        return state.db.reports.summary()
    reports = state.db.objects.get(id).reports
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


def _asked(reports: Reports, id: str, name: str, options: Options) -> Any:
    with run_bar(f"{name} of {id}") as show:
        return getattr(reports, name.replace("-", "_"))(**options, progress=show)


def _show(found: Any) -> None:
    raw = found.raw
    rows: dict[str, Any] = {"": found.text}
    if not isinstance(raw, wire.reports.SummaryReport):
        rows = {"object": f"{raw.object}, revision {raw.revision}", **rows}
    if isinstance(raw, wire.reports.CalibrationReport):
        rows |= _scores(raw)
    show_rows(rows)
    for columns, cells in _TABLES.get(raw.report, lambda _: [])(raw):
        show_table(columns, cells, empty="Nothing.")
    for call in getattr(raw, "calls", []):
        ERRORS.print(
            f"Missing: {call.method} {call.path} {json.dumps(call.body)}", soft_wrap=True, markup=False
        )


def _scores(raw: wire.reports.CalibrationReport) -> dict[str, str]:
    rows = {
        "Brier skill": _range(raw.skill),
        "over attempts that did not collide": _range(raw.free_skill),
        "calibration error above 0.1": number(raw.ece),
        "AUC of probability and density": f"{number(raw.auc_probability)}, {number(raw.auc_density)}",
    }
    checked = raw.checked
    if checked is not None:
        rows["simulated again"] = (
            f"{checked.successes:,} of {checked.grasps:,} succeeded: {_range(checked.rate)},"
            f" predicted {number(checked.predicted)}"
        )
    return rows


def _convergence(raw: wire.reports.ConvergenceReport) -> list[Table]:
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


def _calibration(raw: wire.reports.CalibrationReport) -> list[Table]:
    bins = [
        (number(b.predicted), number(b.observed), f"{number(b.low)} to {number(b.high)}", b.count)
        for b in raw.bins
        if b.count
    ]
    return [(("predicted", "came true", "interval", "attempts"), bins)]


def _bandwidth(raw: wire.reports.BandwidthReport) -> list[Table]:
    best = [
        (
            f"{1e3 * p.sigma_position_m:.1f}",
            f"{p.sigma_rotation_deg:.1f}",
            number(p.log_likelihood),
            f"{number(p.below_best)} ± {number(p.below_best_error)}",
        )
        for p in sorted(raw.grid, key=lambda p: -(p.log_likelihood or -1e99))[:8]
    ]
    draws = [
        (
            widths(d.kernel),
            d.protocol,
            d.draws,
            *map(_range, (d.success, d.collision, d.free_success)),
        )
        for d in raw.draws
    ]
    columns = ("draws at", "protocol", "simulated", "succeed", "collide", "succeed of the rest")
    return [
        (("position [mm]", "rotation [°]", "held-out log density", "below the best"), best),
        *([(columns, draws)] if draws else []),
    ]


def _kernel_similarity(raw: wire.reports.KernelSimilarityReport) -> list[Table]:
    return [
        ((what, "similarity", "error"), [(p.count, f"{p.similarity:.3f}", f"{p.error:.3f}") for p in points])
        for what, points in (("samples", raw.samples), ("Gaussians", raw.mixtures))
    ]


def _sources(raw: wire.reports.SourcesReport) -> list[Table]:
    columns = ("source", "trials", "succeeded", "predicted", "agreement", "Brier skill", "density similarity")
    return [
        (
            columns,
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


def _summary(raw: wire.reports.SummaryReport) -> list[Table]:
    outcomes = [name for name in wire.OUTCOMES if any(name in row.outcomes for row in raw.rows)]
    counts = [
        (row.object, row.gripper, row.protocol, row.source, *(row.outcomes.get(o, 0) for o in outcomes))
        for row in raw.rows
    ]
    rates = [(row.object, row.source, *(_percent(item.rate) for item in row.rates)) for row in raw.rows]
    return [
        (("object", "gripper", "protocol", "source", *outcomes), counts),
        (("object", "source", *raw.rules), rates),
    ]


_TABLES: dict[str, Callable[[Any], list[Table]]] = {
    "bandwidth": _bandwidth,
    "calibration": _calibration,
    "convergence": _convergence,
    "kernel-similarity": _kernel_similarity,
    "sources": _sources,
    "summary": _summary,
}
"""What is shown below the words."""


def _percent(value: ReportRange) -> str:
    if value.value is None or value.low is None or value.high is None:
        return "unknown"
    return f"{100 * value.value:.2f} % ({100 * value.low:.2f} to {100 * value.high:.2f})"


def _range(value: ReportRange | None) -> str:
    if value is None or value.value is None:
        return "unknown"
    return f"{value.value:.2f} ({number(value.low)} to {number(value.high)})"
