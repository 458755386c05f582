"""The figure of all objects' trials: outcomes, and success rates by each way of counting."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graspdb.figures.canvas import Axes, Figure, new_figure, show_grid
from graspdb.figures.style import COLOURS, MARKERS, OUTCOME_COLOURS, heading, show_ranges
from graspdb.wire import OUTCOMES
from graspdb.wire.reports import SummaryReport, SummaryRow

#: On which white is read best, and the share of trials from which it is written down.
_DARK, _LEAST_WRITTEN = ("failure", "success", "collision", "dropped"), 0.06


def draw_summary(report: SummaryReport) -> Figure:
    """Draw trials by outcome beside the success rates by each way of counting."""
    figure = new_figure(12.0, 2.8 + 0.62 * max(len(report.rows), 2))
    heading(figure, "what was tried, and what succeeded", report.text)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    at = np.arange(len(report.rows))[::-1].astype(float)
    _outcomes(left, report.rows, at)
    _rates(right, report, at)
    for axes, columns in ((left, 4), (right, 1)):
        if report.rows:
            axes.legend(
                fontsize=8, ncols=columns, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False
            )
        show_grid(axes)
    return figure


def _outcomes(axes: Axes, rows: Sequence[SummaryRow], at: NDArray[np.float64]) -> None:
    start = np.zeros(len(rows))
    total = np.array([max(sum(row.outcomes.values()), 1) for row in rows], dtype=float)
    for name in OUTCOMES:
        share = np.array([row.outcomes.get(name, 0) for row in rows], dtype=float) / total
        if not share.any():
            continue
        axes.barh(at, share, left=start, color=OUTCOME_COLOURS[name], edgecolor="white", linewidth=0.5,
                  height=0.7, label=name.replace("_", " "))  # fmt: skip
        for y, part, begin in zip(at, share, start, strict=True):
            if part >= _LEAST_WRITTEN:
                axes.text(begin + 0.5 * part, y, f"{100 * part:.0f} %", fontsize=8, ha="center", va="center",
                          color="white" if name in _DARK else "0.1")  # fmt: skip
        start += share
    axes.set_yticks(at, [_name(row) for row in rows], fontsize=8)
    axes.set(xlim=(0.0, 1.0), ylim=(-0.6, len(rows) - 0.4), xlabel="share of the trials, by outcome")


def _rates(axes: Axes, report: SummaryReport, at: NDArray[np.float64]) -> None:
    for number, (rule, colour, marker) in enumerate(zip(report.rules, COLOURS, MARKERS, strict=False)):
        rates = [next(item.rate for item in row.rates if item.rule == rule) for row in report.rows]
        known = [i for i, rate in enumerate(rates) if rate.value is not None]
        shown = [rates[i] for i in known]
        height = at[known] + 0.2 * (1 - number)
        style = {"color": colour, "marker": marker, "markersize": 5, "capsize": 2}
        show_ranges(axes, height, shown, upright=False, **style, label=report.rules[rule])
        for y, rate in zip(height, shown, strict=True):
            axes.annotate(f"{100 * (rate.value or 0.0):.2f} %", (rate.high or 0.0, y), xytext=(6, 0),
                          textcoords="offset points", fontsize=8, va="center")  # fmt: skip
    # Room for the numbers beside the markers.
    axes.set(xlim=(0.0, 1.2), xticks=np.linspace(0.0, 1.0, 6))
    axes.set_xlabel(f"share that succeeded, {report.level:.0%} intervals")


def _name(row: SummaryRow) -> str:
    parts = [part for part in (row.gripper, row.protocol, row.source) if part]
    return f"{row.object}\n{', '.join(parts) or 'no source'}; n = {row.trials:,}"
