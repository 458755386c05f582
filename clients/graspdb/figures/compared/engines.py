"""The figure of the engines report: how far two engines agree, and why they do not."""

from __future__ import annotations

from graspdb.figures.canvas import Figure, new_figure, show_grid
from graspdb.figures.style import BLUE, ORANGE, show_ranges, title
from graspdb.wire.reports import EnginesReport


def draw_engines(report: EnginesReport) -> Figure:
    """Draw the agreement of each pair of sweeps with its interval, and the reasons of what they differ on."""
    figure = new_figure(9.0, 4.2)
    title(figure, report, "do two engines agree?")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    for offset, colour, label, ranges in (
        (-0.1, BLUE, "all poses", [pair.agreement for pair in report.pairs]),
        (0.1, ORANGE, "those that rest on physics", [pair.physics_agreement for pair in report.pairs]),
    ):
        known = [(place + offset, item) for place, item in enumerate(ranges) if item.value is not None]
        show_ranges(
            left, [place for place, _ in known], [item for _, item in known], color=colour, marker="o",
            markersize=5, capsize=3, label=label,
        )  # fmt: skip
    left.set_xticks(range(len(report.pairs)), [f"{p.protocol}\n{p.poses:,} poses" for p in report.pairs])
    left.set(xlim=(-0.5, len(report.pairs) - 0.5), ylim=(0.0, 1.02), ylabel="share that agrees")
    left.legend(fontsize=8, loc="lower left", framealpha=0.9)
    counts: dict[str, int] = {}
    for pair in report.pairs:
        for reason in pair.reasons:
            counts[reason.reason] = counts.get(reason.reason, 0) + reason.poses
    right.barh(list(counts), list(counts.values()), color=BLUE)
    right.set_xlabel("poses that they differ on")
    right.set_title("why", fontsize=8)
    for axes in (left, right):
        show_grid(axes)
    return figure
