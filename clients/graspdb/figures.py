"""Figures of reports: one drawing for the service's PNG and SVG and for ``.plot()`` in a notebook.

Drawn with matplotlib's figure objects and without pyplot, so that a server may draw from its threads. Colours
are Okabe and Ito's, which colour-blind readers tell apart; heat maps are viridis. What has no data is white
and hatched, never a colour.
"""

from __future__ import annotations

import io
import threading
from typing import TYPE_CHECKING, Literal

import numpy as np

from graspdb import figures_anisotropy, figures_projection, figures_sources, figures_widths
from graspdb.figures_style import BLUE, GREEN, GREY, ORANGE, bars, told
from graspdb.figures_style import plain as _plain
from graspdb.figures_style import title as _title
from graspdb.wire.reports import (
    AnisotropyReport,
    AnyReport,
    BandwidthReport,
    CalibrationReport,
    ConvergenceReport,
    KernelSimilarityReport,
    ProjectionReport,
    SourcesReport,
    SummaryReport,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw", "rendered"]

_COLOURS = (BLUE, ORANGE, GREEN)
_DPI = 120
# Matplotlib shares its font cache and text paths between figures.
_LOCK = threading.Lock()


def rendered(report: AnyReport | SummaryReport, format: Literal["png", "svg"]) -> bytes:
    """The figure of a report as a file's bytes."""
    with _LOCK:
        figure = draw(report)
        target = io.BytesIO()
        # No date: the same report gives the same bytes.
        metadata = {"Date": None} if format == "svg" else {"Software": None}
        figure.savefig(target, format=format, dpi=_DPI, metadata=metadata)
        return target.getvalue()


def draw(report: AnyReport | SummaryReport) -> Figure:
    """The figure of a report.

    Raises
    ------
    ImportError
        Without matplotlib; the message says how to install it.
    """
    try:
        from matplotlib.figure import Figure as NewFigure
    except ImportError as error:
        raise ImportError("figures need matplotlib: pip install 'graspdb[plot]'") from error
    if isinstance(report, ConvergenceReport):
        figure = NewFigure(figsize=(8.0, 6.4), layout="constrained")
        _convergence(figure, report)
    elif isinstance(report, AnisotropyReport):
        figure = NewFigure()
        figures_anisotropy.anisotropy(figure, report)
    elif isinstance(report, ProjectionReport):
        figure = NewFigure()
        figures_projection.projection(figure, report)
    elif isinstance(report, BandwidthReport):
        figure = NewFigure(figsize=(11.0, 5.6), layout="constrained")
        figures_widths.bandwidth(figure, report)
    elif isinstance(report, KernelSimilarityReport):
        figure = NewFigure(figsize=(10.0, 5.4), layout="constrained")
        figures_widths.kernel_similarity(figure, report)
    elif isinstance(report, SourcesReport):
        figure = NewFigure(figsize=(12.0, 2.2 + 3.4 * max(len(report.sources), 1)), layout="constrained")
        figures_sources.sources(figure, report)
    elif isinstance(report, SummaryReport):
        figure = NewFigure(figsize=(12.0, 2.8 + 0.62 * max(len(report.rows), 2)), layout="constrained")
        figures_sources.summary(figure, report)
    elif isinstance(report, CalibrationReport):
        figure = NewFigure(figsize=(6.6, 7.2), layout="constrained")
        _calibration(figure, report)
    else:
        raise TypeError(f"there is no figure of {type(report).__name__}")
    return figure


# -- convergence


def _convergence(figure: Figure, report: ConvergenceReport) -> None:
    from matplotlib.ticker import FuncFormatter

    _title(figure, report, "are there enough grasps?")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for curve, colour, marker in zip(report.curves, _COLOURS, "osD", strict=False):
        grasps = [point.grasps for point in curve.points]
        kernel = curve.kernel
        widths = f"{1e3 * kernel.sigma_position_m:.1f} mm, {kernel.sigma_rotation_deg:.1f}°"
        top.errorbar(
            grasps,
            [point.similarity for point in curve.points],
            yerr=[point.deviation for point in curve.points],
            color=colour,
            marker=marker,
            markersize=4,
            capsize=3,
            linewidth=1.5,
            label=f"{curve.label} ({widths})",
        )
        bottom.errorbar(
            grasps,
            [point.log_likelihood for point in curve.points],
            yerr=[point.log_likelihood_error for point in curve.points],
            color=colour,
            marker=marker,
            markersize=4,
            capsize=3,
            linewidth=1.5,
        )
        needed = curve.verdict.needed
        if needed.low is not None and needed.high is not None and needed.high > needed.low:
            top.axvspan(needed.low, needed.high, color=colour, alpha=0.12, linewidth=0)
        if needed.value is not None:
            word = "extrapolated" if curve.verdict.extrapolated else "reached"
            top.axvline(
                needed.value, color=colour, linestyle=":", linewidth=1.2,
                label=f"{curve.verdict.target:g} {word} at {needed.value:,.0f} grasps"
                f" ({_number(needed.low)} to {_number(needed.high)})",
            )  # fmt: skip
    target = report.curves[0].verdict.target
    top.axhline(target, color=GREY, linestyle="--", linewidth=1, label=f"target {target:g}")
    top.set_xscale("log")
    bottom.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    top.set_ylabel(f"similarity s (eq 9)\nbars: deviation of {report.replicates} replicates")
    top.set_ylim(top=1.0)
    top.legend(fontsize=8, loc="lower right", framealpha=0.9)
    bottom.set_ylabel("held-out log density\n[nats of 1/(m³ rad³)]")
    bottom.set_xlabel(
        f"successful grasps (means over {report.subsets} subsets; {report.held_out:,} held out)"
    )
    for axes in (top, bottom):
        _plain(axes)


def _number(value: float | None) -> str:
    return "can't be told" if value is None else f"{value:,.0f}"


# -- calibration


def _calibration(figure: Figure, report: CalibrationReport) -> None:
    _title(figure, report, "can success_probability be believed?")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1.3))
    known = [item for item in report.bins if item.predicted is not None and item.observed is not None]
    predicted = np.array([item.predicted for item in known], dtype=np.float64)
    observed = np.array([item.observed for item in known], dtype=np.float64)
    low = np.array([item.low if item.low is not None else item.observed for item in known], dtype=np.float64)
    high = np.array(
        [item.high if item.high is not None else item.observed for item in known], dtype=np.float64
    )
    top.plot([0, 1], [0, 1], color=GREY, linestyle="--", linewidth=1, label="as predicted")
    top.axhline(
        report.share, color=GREEN, linestyle=":", linewidth=1.2, label=f"all attempts: {report.share:.3f}"
    )
    top.errorbar(
        predicted,
        observed,
        yerr=[np.maximum(observed - low, 0.0), np.maximum(high - observed, 0.0)],
        color=BLUE,
        marker="o",
        markersize=5,
        capsize=3,
        linewidth=1.5,
        label=f"held-out attempts, {report.level:.0%} intervals over {report.blocks} blocks",
    )
    again = report.checked
    if again is not None:
        top.errorbar(
            [again.predicted], [again.rate.value or 0.0], yerr=bars([again.rate]), color=ORANGE, marker="D",
            markersize=6, capsize=4, linestyle="none",
            label=f"{again.grasps:,} given grasps simulated again ({again.successes:,} succeed)",
        )  # fmt: skip
    top.set_ylabel("share that succeeded")
    top.set_xlim(0, 1)
    top.set_ylim(0, 1.02)
    top.legend(fontsize=8, loc="upper left", framealpha=0.9)
    scores = [
        f"Brier skill {told(report.skill.value)} ({told(report.skill.low)} to {told(report.skill.high)})"
    ]
    if report.free_skill is not None:
        scores.append(f"not colliding {told(report.free_skill.value)}")
    scores += [
        f"ECE above 0.1: {told(report.ece)}",
        f"AUC: probability {told(report.auc_probability)}, density {told(report.auc_density)}",
    ]
    top.text(
        0.98, 0.03, "\n".join(scores), transform=top.transAxes, ha="right", va="bottom", fontsize=8,
        bbox={"facecolor": "white", "edgecolor": "0.8", "boxstyle": "round"},
    )  # fmt: skip
    edges = [item.lower for item in report.bins]
    counts = [item.count for item in report.bins]
    bottom.bar(
        edges, counts, width=[item.upper - item.lower for item in report.bins], align="edge", color=BLUE,
        edgecolor="white",
    )  # fmt: skip
    for item in report.bins:
        if item.count:
            bottom.annotate(
                f"{item.count:,}", (0.5 * (item.lower + item.upper), item.count), ha="center", va="bottom",
                fontsize=8,
            )  # fmt: skip
    bottom.set_yscale("log")
    bottom.set_ylim(0.7, 10 * max(counts, default=1))
    bottom.set_ylabel("attempts judged")
    bottom.set_xlabel("predicted success probability")
    for axes in (top, bottom):
        _plain(axes)
