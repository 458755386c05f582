"""The figure of the sources report: each source's trials against simulation."""

from __future__ import annotations

from typing import Any

from graspdb.figures.calibration import show_bins
from graspdb.figures.canvas import Axes, Figure, new_figure, show_grid
from graspdb.figures.style import BLUE, GREEN, GREY, ORANGE, number, show_ranges, title, widths
from graspdb.wire.reports import SourceComparison, SourcesReport

_MARK: dict[str, Any] = {"markersize": 6, "capsize": 4}


def draw_sources(report: SourcesReport) -> Figure:
    """Draw for each source: calibration of simulation's predictions, agreement, and density similarity."""
    figure = new_figure(12.0, 2.2 + 3.4 * max(len(report.sources), 1))
    title(figure, report, "does simulation tell what real trials find?")
    table = figure.subplots(len(report.sources), 3, squeeze=False, width_ratios=(3, 2, 2))
    for row, item in zip(table, report.sources, strict=True):
        _calibrated(row[0], item, report.level)
        _shares(row[1], item, report)
        _similar(row[2], item)
        for axes in row:
            show_grid(axes)
    return figure


def _calibrated(axes: Axes, item: SourceComparison, level: float) -> None:
    axes.plot([0, 1], [0, 1], color=GREY, linestyle="--", linewidth=1)
    correction = item.correction
    if correction is not None:
        axes.fill_between(correction.predicted, correction.low, correction.high, color=ORANGE, alpha=0.2)
        axes.plot(
            correction.predicted, correction.corrected, color=ORANGE, linewidth=1.5,
            label=f"correction: {correction.judged} on left-out trials",
        )  # fmt: skip
        axes.legend(fontsize=8, loc="center left", framealpha=0.9)
    known = show_bins(axes, item.bins, linewidth=1.3)
    for b in known:
        axes.annotate(
            f"{b.count:,}", (b.predicted or 0.0, b.observed or 0.0), xytext=(6, 4),
            textcoords="offset points", fontsize=8,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8},
        )  # fmt: skip
    if not known:
        axes.text(0.5, 0.5, "only successes, or too few trials", transform=axes.transAxes, ha="center",
                  va="center", fontsize=8, color=GREY,
                  bbox={"facecolor": "white", "edgecolor": "none"})  # fmt: skip
    axes.set(xlim=(0, 1), ylim=(0, 1.02))
    axes.set_xlabel("predicted from simulation", fontsize=8)
    axes.set_ylabel(f"{item.source}: share that succeeded", fontsize=8)
    axes.set_title(
        f"{item.source}: n = {item.trials:,} trials, {level:.0%} intervals\n"
        f"Brier skill {number(None if item.skill is None else item.skill.value)}, AUC {number(item.auc)}",
        fontsize=8,
    )


def _shares(axes: Axes, item: SourceComparison, report: SourcesReport) -> None:
    names, ranges = [f"{item.source}\nsucceeded"], [item.share]
    if item.agreement is not None:
        names.append("agreement with\nsimulation")
        ranges.append(item.agreement)
    show_ranges(axes, range(len(names)), ranges, color=BLUE, marker="o", **_MARK, label="found")
    if item.predicted is not None:
        axes.plot([0], [item.predicted], color=ORANGE, marker="D", markersize=6, linestyle="none",
                  label="simulation's mean prediction")  # fmt: skip
    axes.set_xticks(range(len(names)), names)
    axes.set(xlim=(-0.6, len(names) - 0.4), ylim=(0.0, 1.02))
    axes.set_ylabel("share of trials", fontsize=8)
    axes.legend(fontsize=8, loc="lower right", framealpha=0.9)
    axes.set_title(f"simulation: {report.successes:,} of {report.attempts:,} succeeded", fontsize=8)


def _similar(axes: Axes, item: SourceComparison) -> None:
    found = item.similarity
    axes.set_ylim(0.0, 1.02)
    axes.set_ylabel("density similarity (Bhattacharyya)", fontsize=8)
    if found is None:
        axes.text(0.5, 0.5, "too few successes", transform=axes.transAxes, ha="center", va="center",
                  fontsize=8, color=GREY)  # fmt: skip
        axes.set_xticks([])
        return
    axes.errorbar(
        [0], [found.value], yerr=[1.64 * found.error], color=BLUE, marker="o", linestyle="none", **_MARK
    )
    show_ranges(axes, [1], [found.expected], color=GREEN, marker="s", **_MARK)
    axes.set_xticks([0, 1], [f"{item.source}\nto simulation", "as many grasps\nof simulation"])
    axes.set_xlim(-0.6, 1.6)
    axes.set_title(f"kernel {widths(found.kernel)};\ngreen: range of 10 draws of simulation", fontsize=8)
