"""The figure of the convergence report: similarity and held-out log density by the number of grasps."""

from __future__ import annotations

from graspdb.figures.canvas import Figure, new_figure, show_grid
from graspdb.figures.style import BLUE, CURVE, GREEN, GREY, ORANGE, title, widths
from graspdb.wire.reports import ConvergenceReport

_COLOURS = (BLUE, ORANGE, GREEN)


def draw_convergence(report: ConvergenceReport) -> Figure:
    """Draw a curve a kernel, with the number of grasps that reaches the target."""
    figure = new_figure(8.0, 6.4)
    from matplotlib.ticker import FuncFormatter

    title(figure, report, "are there enough grasps?")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for curve, colour, marker in zip(report.curves, _COLOURS, "osD", strict=False):
        grasps = [point.grasps for point in curve.points]
        top.errorbar(
            grasps, [point.similarity for point in curve.points],
            yerr=[point.deviation for point in curve.points], color=colour, marker=marker, **CURVE,
            label=f"{curve.label} ({widths(curve.kernel)})",
        )  # fmt: skip
        bottom.errorbar(
            grasps, [point.log_likelihood for point in curve.points],
            yerr=[point.log_likelihood_error for point in curve.points], color=colour, marker=marker, **CURVE,
        )  # fmt: skip
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
        show_grid(axes)
    return figure


def _number(value: float | None) -> str:
    return "can't be told" if value is None else f"{value:,.0f}"
