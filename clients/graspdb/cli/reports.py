"""``graspdb report``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any

import typer

from graspdb import wire
from graspdb.cli.common import ERRORS, ObjectId, State, numbers, out, run_bar, show_rows, show_table
from graspdb.cli.wording import in_commands
from graspdb.errors import ChecksNeeded, add_note
from graspdb.figures import FILE_FORMATS
from graspdb.figures.style import number, widths
from graspdb.reports import (
    AnisotropyOptions,
    ConvergenceOptions,
    KernelSimilarityOptions,
    ProjectionOptions,
    PromisesOptions,
    Reports,
)
from graspdb.wire.reports import REPORT_NAMES, REPORTS, ReportRange

_NAMES = ", ".join(REPORT_NAMES)
#: Grasps that engines differ on which are shown of each pair of sweeps.
_SHOWN = 20
Columns = dict[str, Callable[[Any], Any]]
Table = tuple[Sequence[Any], Columns]


class Options(
    ConvergenceOptions,
    AnisotropyOptions,
    ProjectionOptions,
    KernelSimilarityOptions,
    PromisesOptions,
    total=False,
):
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
    calls = getattr(found.raw, "calls", [])
    if calls:
        ERRORS.print(_simulation_told(id, name, len(calls)))
    for warning in found.warnings:
        ERRORS.print(f"Mind: {in_commands(warning)}", markup=False)
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
            add_note(error, _simulation_told(id, name, len(error.calls)))
            raise
        calls = error.calls
    if not simulate or not calls:
        return found
    for sweep in reports.simulate(calls):
        sweep.wait(progress=not state.json)
    return _asked(reports, id, name, options)


def _simulation_told(id: str, name: str, sweeps: int) -> str:
    return f"`graspdb report {id} {name} --simulate` makes the {sweeps} sweeps that lack and waits for them."


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
    for items, columns in _TABLES[raw.report](raw) if raw.report in _TABLES else ():
        show_table(items, columns, empty="Nothing.")


def _scores(raw: wire.reports.CalibrationReport) -> dict[str, str]:
    rows = {
        "Brier skill": _range(raw.skill),
        "over attempts that did not collide": _range(raw.free_skill),
        "calibration error above 0.1": number(raw.ece),
        "AUC of probability and density": f"{number(raw.auc_probability)}, {number(raw.auc_density)}",
    }
    learned = raw.learned
    if learned is not None:
        rows[f"learned ({learned.estimator.name}): Brier skill"] = (
            f"{_range(learned.skill)}, the kernel estimate {number(learned.kernel_skill)}"
        )
        rows["learned: told within reach"] = (
            f"{learned.told_share:.0%} of them, Brier skill {number(learned.told_skill)}"
        )
        rows["learned: blocks within their intervals"] = number(learned.coverage)
    checked = raw.checked
    if checked is not None:
        rows["simulated again"] = (
            f"{checked.successes:,} of {checked.grasps:,} succeeded: {_range(checked.rate)},"
            f" predicted {number(checked.predicted)}"
        )
    return rows


def _anisotropy(raw: wire.reports.AnisotropyReport) -> Iterator[Table]:
    columns: Columns = {
        "a good grasp": lambda t: f"about {t.axis[1:]}" if t.unit == "rad" else f"along {t.axis}",
        "forgives": lambda t: t.in_words(),
        "tried": _tried,
        "pairs" if raw.method == "empirical" else "evaluations": lambda t: sum(t.count),
    }
    yield raw.tolerances, columns


def _tried(item: wire.reports.AnisotropyTolerance) -> str:
    factor, unit = (math.degrees(1.0), "°") if item.unit == "rad" else (1e3, " mm")
    low, high = (factor * at for at in item.tried or (0.0, 0.0))
    return f"{low:.0f} to {high:.0f}{unit}"


def _convergence(raw: wire.reports.ConvergenceReport) -> Iterator[Table]:
    for curve in raw.curves:
        columns: Columns = {
            f"grasps ({curve.label})": lambda p: p.grasps,
            "similarity": lambda p: f"{p.similarity:.4f}",
            "deviation": lambda p: f"{p.deviation:.4f}",
            "held-out log density": lambda p: f"{p.log_likelihood:.3f}",
        }
        yield curve.points, columns


def _calibration(raw: wire.reports.CalibrationReport) -> Iterator[Table]:
    columns: Columns = {
        "predicted": lambda b: number(b.predicted),
        "came true": lambda b: number(b.observed),
        "interval": lambda b: f"{number(b.low)} to {number(b.high)}",
        "attempts": lambda b: b.count,
    }
    yield [b for b in raw.bins if b.count], columns


def _bandwidth(raw: wire.reports.BandwidthReport) -> Iterator[Table]:
    pairs: Columns = {
        "position [mm]": lambda p: f"{1e3 * p.sigma_position_m:.1f}",
        "rotation [°]": lambda p: f"{p.sigma_rotation_deg:.1f}",
        "held-out log density": lambda p: number(p.log_likelihood),
        "below the best": lambda p: f"{number(p.below_best)} ± {number(p.below_best_error)}",
    }
    yield sorted(raw.grid, key=lambda p: -(p.log_likelihood or -1e99))[:8], pairs
    draws: Columns = {
        "draws at": lambda d: widths(d.kernel),
        "protocol": lambda d: d.protocol,
        "simulated": lambda d: d.draws,
        "succeed": lambda d: _range(d.success),
        "collide": lambda d: _range(d.collision),
        "succeed of the rest": lambda d: _range(d.free_success),
    }
    if raw.draws:
        yield raw.draws, draws


def _kernel_similarity(raw: wire.reports.KernelSimilarityReport) -> Iterator[Table]:
    for what, points in (("samples", raw.samples), ("Gaussians", raw.mixtures)):
        columns: Columns = {
            what: lambda p: p.count,
            "similarity": lambda p: f"{p.similarity:.3f}",
            "error": lambda p: f"{p.error:.3f}",
        }
        yield points, columns


def _sources(raw: wire.reports.SourcesReport) -> Iterator[Table]:
    columns: Columns = {
        "source": lambda s: s.source,
        "trials": lambda s: s.trials,
        "succeeded": lambda s: _range(s.share),
        "predicted": lambda s: number(s.predicted),
        "agreement": lambda s: _range(s.agreement),
        "Brier skill": lambda s: _range(s.skill),
        "correction": lambda s: None if s.correction is None else _correction(s.correction),
        "density similarity": lambda s: _alike(s.similarity),
    }
    yield raw.sources, columns


def _correction(found: wire.reports.SourceMap) -> str:
    return f"{found.judged}: sigmoid({found.shift:+.2f} {found.slope:+.2f} logit p)"


def _promises(raw: wire.reports.PromisesReport) -> Iterator[Table]:
    promised = raw.promised
    rows = {
        "answers tried": f"{raw.answers:,} of {raw.answers_given:,} best grasps kept; {raw.trials:,} trials",
        "promised": f"{number(promised.value)} on average, {number(promised.low)} to {number(promised.high)}",
        "happened": _range(raw.happened),
        "difference": _range(raw.difference),
        "Brier skill": _range(raw.skill),
        "explained by choosing the highest": f"at most {number(raw.selection.at_most)}",
        "of other grasps": f"{raw.unmatched:,} trials",
        "without a probability": f"{raw.without_promise:,} trials",
        "expected untried": f"{raw.prior.trials:,} trials",
    }
    if raw.placement.trials:
        place = raw.placement
        rows["misplaced"] = (
            f"{1e3 * (place.position_m or 0.0):.1f} mm, {place.rotation_deg or 0.0:.1f}° in the middle of"
            f" {place.trials:,} trials"
        )
    yield list(rows.items()), {"": lambda row: row[0], " ": lambda row: row[1]}
    columns: Columns = {
        "promised": lambda b: f"{b.lower:.1f} to {b.upper:.1f}",
        "answers": lambda b: b.answers,
        "trials": lambda b: b.trials,
        "mean": lambda b: number(b.promised),
        "happened": lambda b: _range(b.happened),
    }
    yield [item for item in raw.bins if item.answers], columns


def _engines(raw: wire.reports.EnginesReport) -> Iterator[Table]:
    columns: Columns = {
        "sweep": lambda p: p.sweep,
        "protocol": lambda p: p.protocol,
        "engines": lambda p: " and ".join([*p.engines, *p.other_engines]),
        "poses": lambda p: f"{p.poses:,}",
        "agree": lambda p: _range(p.agreement),
        "rest on physics": lambda p: f"{p.physics:,}",
        "of these agree": lambda p: _range(p.physics_agreement),
    }
    yield raw.pairs, columns
    why: Columns = {"why": lambda r: r.reason, "poses": lambda r: r.poses, "": lambda r: r.text}
    grasps: Columns = {
        "pose": lambda d: d.pose_index,
        "position [m]": lambda d: numbers(d.position),
        "outcome": lambda d: d.outcome,
        "other": lambda d: d.other_outcome,
        "quality": lambda d: number(d.quality),
        "other's": lambda d: number(d.other_quality),
        "why": lambda d: d.reason,
    }
    for pair in raw.pairs:
        yield pair.reasons, why
        yield pair.first[:_SHOWN], grasps


def _alike(found: wire.reports.SourceSimilarity | None) -> str:
    return "unknown" if found is None else f"{found.value:.2f} (chance alone {_range(found.expected)})"


def _summary(raw: wire.reports.SummaryReport) -> Iterator[Table]:
    outcomes = [name for name in wire.OUTCOMES if any(name in row.outcomes for row in raw.rows)]
    counts: Columns = {name: attrgetter(name) for name in ("object", "gripper", "protocol", "source")}
    counts |= {name: partial(_count, name) for name in outcomes}
    yield raw.rows, counts
    rates: Columns = {name: attrgetter(name) for name in ("object", "source")}
    rates |= {rule: partial(_rate, rule) for rule in raw.rules}
    yield raw.rows, rates


def _count(outcome: str, row: wire.reports.SummaryRow) -> int:
    return row.outcomes.get(outcome, 0)


def _rate(rule: str, row: wire.reports.SummaryRow) -> str:
    return _percent(next(item.rate for item in row.rates if item.rule == rule))


_TABLES: dict[str, Callable[[Any], Iterator[Table]]] = {
    "anisotropy": _anisotropy,
    "bandwidth": _bandwidth,
    "calibration": _calibration,
    "convergence": _convergence,
    "engines": _engines,
    "kernel-similarity": _kernel_similarity,
    "promises": _promises,
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
