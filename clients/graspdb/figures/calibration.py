"""The figure of the calibration report: how often came true what was predicted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from graspdb.figures.canvas import Axes, Figure, new_figure, show_grid
from graspdb.figures.style import BLUE, GREEN, GREY, ORANGE, number, show_ranges, title
from graspdb.wire.reports import CalibrationBin, CalibrationReport, ReportRange


def draw_calibration(report: CalibrationReport) -> Figure:
    """Draw predictions against shares that succeeded, above how many attempts were judged."""
    figure = new_figure(6.6, 7.2)
    title(figure, report, "can success_probability be believed?")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1.3))
    top.plot([0, 1], [0, 1], color=GREY, linestyle="--", linewidth=1, label="as predicted")
    top.axhline(
        report.share, color=GREEN, linestyle=":", linewidth=1.2, label=f"all attempts: {report.share:.3f}"
    )
    label = f"held-out attempts, {report.level:.0%} intervals over {report.blocks} blocks"
    show_bins(top, report.bins, linewidth=1.5, label=label)
    learned = report.learned
    if learned is not None:
        what = f"learned ({learned.estimator.name}), {learned.judged:,} that did not collide"
        show_bins(top, learned.bins, linewidth=1.5, label=what, color=GREEN)
    again = report.checked
    if again is not None:
        show_ranges(
            top, [again.predicted], [again.rate], color=ORANGE, marker="D", markersize=6, capsize=4,
            label=f"{again.grasps:,} given grasps simulated again ({again.successes:,} succeed)",
        )  # fmt: skip
    top.set(ylabel="share that succeeded", xlim=(0, 1), ylim=(0, 1.02))
    top.legend(fontsize=8, loc="upper left", framealpha=0.9)
    top.text(
        0.98, 0.03, _scores(report), transform=top.transAxes, ha="right", va="bottom", fontsize=8,
        bbox={"facecolor": "white", "edgecolor": "0.8", "boxstyle": "round"},
    )  # fmt: skip
    _counts(bottom, report.bins)
    for axes in (top, bottom):
        show_grid(axes)
    return figure


def show_bins(axes: Axes, bins: Sequence[CalibrationBin], **style: Any) -> list[CalibrationBin]:
    """Draw what came true over what was predicted with its intervals, and give the bins that have both."""
    known = [item for item in bins if item.predicted is not None and item.observed is not None]
    observed = [ReportRange(value=item.observed, low=item.low, high=item.high) for item in known]
    predicted = [item.predicted for item in known]
    look: dict[str, Any] = {"color": BLUE, "linestyle": "-", "marker": "o", "markersize": 5, "capsize": 3}
    show_ranges(axes, predicted, observed, **{**look, **style})
    return known


def _scores(report: CalibrationReport) -> str:
    skill = report.skill
    lines = [f"Brier skill {number(skill.value)} ({number(skill.low)} to {number(skill.high)})"]
    if report.free_skill is not None:
        lines.append(f"not colliding {number(report.free_skill.value)}")
    if report.learned is not None:
        lines.append(f"learned {number(report.learned.skill.value)}")
    lines.append(f"ECE above 0.1: {number(report.ece)}")
    lines.append(f"AUC: probability {number(report.auc_probability)}, density {number(report.auc_density)}")
    return "\n".join(lines)


def _counts(axes: Axes, bins: Sequence[CalibrationBin]) -> None:
    axes.bar(
        [item.lower for item in bins], [item.count for item in bins],
        width=[item.upper - item.lower for item in bins], align="edge", color=BLUE, edgecolor="white",
    )  # fmt: skip
    for item in bins:
        if item.count:
            middle = (0.5 * (item.lower + item.upper), item.count)
            axes.annotate(f"{item.count:,}", middle, ha="center", va="bottom", fontsize=8)
    most = max((item.count for item in bins), default=1)
    axes.set(yscale="log", ylim=(0.7, 10 * most))
    axes.set(ylabel="attempts judged", xlabel="predicted success probability")
