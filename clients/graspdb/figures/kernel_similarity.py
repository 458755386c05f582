"""The figure of the kernel-similarity report (figure 13)."""

from __future__ import annotations

from graspdb.figures.canvas import Figure, new_figure, show_grid, show_ticks
from graspdb.figures.style import BLUE, CURVE, GREY, ORANGE, title
from graspdb.wire.reports import KernelSimilarityReport


def draw_kernel_similarity(report: KernelSimilarityReport) -> Figure:
    """Draw the similarity to the full statistics by number of samples, and of Gaussians."""
    figure = new_figure(10.0, 5.4)
    title(figure, report, "how many samples does a kernel need?")
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    for axes, points, colour, marker in (
        (left, report.samples, BLUE, "o"),
        (right, report.mixtures, ORANGE, "s"),
    ):
        axes.errorbar(
            [point.count for point in points], [point.similarity for point in points],
            yerr=[1.64 * point.error for point in points], color=colour, marker=marker, **CURVE,
        )  # fmt: skip
        axes.set_ylim(0.0, 1.02)
        show_grid(axes)
    left.set_xscale("log")
    show_ticks(left, [float(point.count) for point in report.samples])
    right.set_xticks([point.count for point in report.mixtures if point.count % 2 == 0 or point.count == 1])
    left.axvline(900, color=GREY, linestyle=":", linewidth=1.2)
    left.annotate("900: the paper", (900, 0.03), xytext=(-3, 0), textcoords="offset points",
                  fontsize=8, color=GREY, ha="right", rotation=90)  # fmt: skip
    left.set_xlabel(f"samples, of {report.reference:,} displacements")
    right.set_xlabel("Gaussians of a mixture")
    right.set_title("mixtures in the place of samples", fontsize=8)
    left.set_ylabel(f"similarity to the full statistics\n(Bhattacharyya; {report.level:.0%} intervals)")
    window = f"{1e3 * report.window_position_m:.0f} mm, {report.window_rotation_deg:.0f}°"
    widths = f"{1e3 * report.component_position_m:.0f} mm, {report.component_rotation_deg:.0f}°"
    left.set_title(f"window {window}; components {widths}", fontsize=8)
    return figure
