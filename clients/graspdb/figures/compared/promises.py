"""The figure of the promises report: what happened over what was promised."""

from __future__ import annotations

from graspdb.figures.canvas import Figure, new_figure, show_grid
from graspdb.figures.style import BLUE, GREEN, GREY, ORANGE, show_ranges, title
from graspdb.wire.reports import PromisesReport


def draw_promises(report: PromisesReport) -> Figure:
    """Draw shares that held over promises, of bins and in all; what was not promised is hatched."""
    figure = new_figure(6.6, 6.2)
    title(figure, report, "was kept what was promised?")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color=GREY, linestyle="--", linewidth=1, label="as promised")
    base = report.selection.share_of_all
    if base is not None:
        axes.axhline(base, color=GREEN, linestyle=":", linewidth=1.2, label=f"all other attempts: {base:.2f}")
    promised = report.promised
    if promised.value is not None and promised.low is not None and promised.high is not None:
        for left, right in ((0.0, promised.low), (promised.high, 1.0)):
            axes.axvspan(left, right, facecolor="none", edgecolor="0.85", hatch="//", linewidth=0)
        at_most = report.selection.at_most
        axes.plot(
            [at_most, 1], [0, 1 - at_most], color=ORANGE, linewidth=1, label="choosing the highest, at most"
        )
        known = [item for item in report.bins if item.promised is not None]
        show_ranges(
            axes, [item.promised for item in known], [item.happened for item in known], color=BLUE,
            marker="o", markersize=5, capsize=3,
            label=f"{report.answers:,} answers, {report.level:.0%} intervals",
        )  # fmt: skip
        for item in known:
            axes.annotate(
                f"{item.answers:,}", (item.promised, item.happened.value), xytext=(6, 4), fontsize=8,
                textcoords="offset points",
            )  # fmt: skip
        show_ranges(
            axes, [promised.value], [report.happened], color=ORANGE, marker="D", markersize=7, capsize=5,
            label="all of them",
        )  # fmt: skip
    axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="promised success probability", ylabel="share that held")
    axes.legend(fontsize=8, loc="upper left", framealpha=0.9)
    show_grid(axes)
    return figure
