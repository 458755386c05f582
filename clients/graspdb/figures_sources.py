"""Figures of what was tried: by source against simulation, and of all objects together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from graspdb.figures_style import BLUE, COLOURS, GREEN, GREY, ORANGE, bars, heading, plain, title, told
from graspdb.wire import OUTCOMES
from graspdb.wire.reports import SourceComparison, SourcesReport, SummaryReport, SummaryRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["sources", "summary"]

#: Okabe and Ito's, success the darkest.
_OUTCOME_COLOURS = dict(
    zip(
        OUTCOMES,
        (GREY, BLUE, ORANGE, "#56B4E9", "#E69F00", "#F0E442", GREEN, "#CC79A7", "#BBBBBB"),
        strict=True,
    )
)
_MARKERS = "osD^v"
#: On which white is read best, and the share of trials from which it is written down.
_DARK, _LEAST_TOLD = ("failure", "success", "collision", "dropped"), 0.06


def summary(figure: Figure, report: SummaryReport) -> None:
    """Draw trials by outcome beside the success rates by each way of counting."""
    heading(figure, "what was tried, and what succeeded", report.text)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    rows = report.rows
    at = np.arange(len(rows))[::-1].astype(float)
    start = np.zeros(len(rows))
    for name in OUTCOMES:
        width = np.array([row.outcomes.get(name, 0) for row in rows], dtype=float)
        total = np.array([max(sum(row.outcomes.values()), 1) for row in rows], dtype=float)
        if not width.any():
            continue
        share = width / total
        left.barh(at, share, left=start, color=_OUTCOME_COLOURS[name], edgecolor="white", linewidth=0.5,
                  height=0.7, label=name.replace("_", " "))  # fmt: skip
        for y, part, begin in zip(at, share, start, strict=True):
            if part >= _LEAST_TOLD:
                left.text(begin + 0.5 * part, y, f"{100 * part:.0f} %", fontsize=8, ha="center", va="center",
                          color="white" if name in _DARK else "0.1")  # fmt: skip
        start += share
    left.set_yticks(at)
    left.set_yticklabels([_name(row) for row in rows], fontsize=8)
    left.set_ylim(-0.6, len(rows) - 0.4)
    left.set_xlim(0.0, 1.0)
    left.set_xlabel("share of the trials, by outcome")
    if rows:
        left.legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    for number, (rule, colour, marker) in enumerate(zip(report.rules, COLOURS, _MARKERS, strict=False)):
        rates = [next(item for item in row.rates if item.rule == rule) for row in rows]
        known = [i for i, item in enumerate(rates) if item.rate.value is not None]
        shown = [rates[i].rate for i in known]
        right.errorbar(
            [item.value or 0.0 for item in shown],
            at[known] + 0.2 * (1 - number),
            xerr=bars(shown),
            color=colour,
            marker=marker,
            markersize=5,
            capsize=2,
            linestyle="none",
            label=report.rules[rule],
        )
        for i, item in zip(known, shown, strict=True):
            right.annotate(
                f"{100 * (item.value or 0.0):.2f} %",
                (item.high or 0.0, at[i] + 0.2 * (1 - number)),
                xytext=(6, 0),
                textcoords="offset points",
                fontsize=8,
                va="center",
            )
    # Room for the numbers beside the markers.
    right.set_xlim(0.0, 1.2)
    right.set_xticks(np.linspace(0.0, 1.0, 6))
    right.set_xlabel(f"share that succeeded, {report.level:.0%} intervals")
    if rows:
        right.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    for axes in (left, right):
        plain(axes)


def _name(row: SummaryRow) -> str:
    parts = [part for part in (row.gripper, row.protocol, row.source) if part]
    return f"{row.object}\n{', '.join(parts) or 'no source'}; n = {row.trials:,}"


def sources(figure: Figure, report: SourcesReport) -> None:
    """Draw for each source: calibration of simulation's predictions, agreement, and density similarity."""
    title(figure, report, "does simulation tell what real trials find?")
    table = figure.subplots(len(report.sources), 3, squeeze=False, width_ratios=(3, 2, 2))
    for row, item in zip(table, report.sources, strict=True):
        _calibrated(row[0], item, report.level)
        _shares(row[1], item, report)
        _similar(row[2], item)
        for axes in row:
            plain(axes)


def _calibrated(axes: Axes, item: SourceComparison, level: float) -> None:
    axes.plot([0, 1], [0, 1], color=GREY, linestyle="--", linewidth=1)
    known = [b for b in item.bins if b.predicted is not None and b.observed is not None]
    if known:
        observed = np.array([b.observed for b in known], dtype=float)
        low, high = (
            np.array(
                [getattr(b, end) if getattr(b, end) is not None else b.observed for b in known], dtype=float
            )
            for end in ("low", "high")
        )
        axes.errorbar(
            [b.predicted or 0.0 for b in known],
            observed,
            yerr=[np.maximum(observed - low, 0.0), np.maximum(high - observed, 0.0)],
            color=BLUE,
            marker="o",
            markersize=5,
            capsize=3,
            linewidth=1.3,
        )
        for b, y in zip(known, observed, strict=True):
            axes.annotate(
                f"{b.count:,}",
                (b.predicted or 0.0, y),
                xytext=(6, 4),
                textcoords="offset points",
                fontsize=8,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8},
            )
    else:
        axes.text(0.5, 0.5, "only successes, or too few trials", transform=axes.transAxes, ha="center",
                  va="center", fontsize=8, color=GREY,
                  bbox={"facecolor": "white", "edgecolor": "none"})  # fmt: skip
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("predicted from simulation", fontsize=8)
    axes.set_ylabel(f"{item.source}: share that succeeded", fontsize=8)
    axes.set_title(
        f"{item.source}: n = {item.trials:,} trials, {level:.0%} intervals\n"
        f"Brier skill {told(None if item.skill is None else item.skill.value)}, AUC {told(item.auc)}",
        fontsize=8,
    )


def _shares(axes: Axes, item: SourceComparison, report: SourcesReport) -> None:
    names, ranges = [f"{item.source}\nsucceeded"], [item.share]
    if item.agreement is not None:
        names.append("agreement with\nsimulation")
        ranges.append(item.agreement)
    axes.errorbar(
        range(len(names)), [r.value or 0.0 for r in ranges], yerr=bars(ranges), color=BLUE, marker="o",
        markersize=6, capsize=4, linestyle="none", label="found",
    )  # fmt: skip
    if item.predicted is not None:
        axes.plot([0], [item.predicted], color=ORANGE, marker="D", markersize=6, linestyle="none",
                  label="simulation's mean prediction")  # fmt: skip
    axes.set_xticks(range(len(names)))
    axes.set_xticklabels(names)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.set_ylim(0.0, 1.02)
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
        [0], [found.value], yerr=[1.64 * found.error], color=BLUE, marker="o", markersize=6, capsize=4,
        linestyle="none",
    )  # fmt: skip
    axes.errorbar(
        [1], [found.expected.value or 0.0], yerr=bars([found.expected]), color=GREEN, marker="s",
        markersize=6, capsize=4, linestyle="none",
    )  # fmt: skip
    axes.set_xticks([0, 1])
    axes.set_xticklabels([f"{item.source}\nto simulation", "as many grasps\nof simulation"])
    axes.set_xlim(-0.6, 1.6)
    kernel = found.kernel
    axes.set_title(
        f"kernel {1e3 * kernel.sigma_position_m:.1f} mm, {kernel.sigma_rotation_deg:.1f}°;\n"
        "green: range of 10 draws of simulation",
        fontsize=8,
    )
