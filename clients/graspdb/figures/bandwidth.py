"""The figure of the bandwidth report: likelihood by width, and what became of simulated draws."""

from __future__ import annotations

import numpy as np

from graspdb.figures.canvas import Axes, Figure, new_figure, show_grid, show_ticks
from graspdb.figures.style import BLUE, COLOURS, GREEN, GREY, MARKERS, ORANGE, show_ranges, title
from graspdb.wire.reports import BandwidthReport, SimulatedDraws


def draw_bandwidth(report: BandwidthReport) -> Figure:
    """Draw the likelihood of left-out grasps by width, and what became of simulated draws."""
    figure = new_figure(11.0, 5.6)
    title(figure, report, "how wide should the kernel be?")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1) if report.draws else (3, 1))
    turns = sorted({point.sigma_rotation_deg for point in report.grid})
    for turn, colour, marker in zip(turns, COLOURS, MARKERS, strict=False):
        points = [p for p in report.grid if p.sigma_rotation_deg == turn and p.log_likelihood is not None]
        left.errorbar(
            [1e3 * p.sigma_position_m for p in points], [p.log_likelihood or 0.0 for p in points],
            yerr=[p.below_best_error or 0.0 for p in points], color=colour, marker=marker, markersize=4,
            capsize=2, linewidth=1.3, label=f"{turn:.1f}°",
        )  # fmt: skip
    best = report.recommended
    left.axvspan(1e3 * report.range_m[0], 1e3 * report.range_m[1], color=GREY, alpha=0.12, linewidth=0)
    left.axvline(1e3 * best.sigma_position_m, color=GREY, linestyle=":", linewidth=1.2)
    left.set_xscale("log")
    left.set_xlabel(f"position width [mm] ({report.rows:,} grasps, {report.held_out:,} left out)")
    left.set_ylabel("log density of left-out grasps\n[nats of 1/(m³ rad³)]")
    left.set_title("bars: error of the difference to the best;\nband: not told from the best", fontsize=8)
    left.legend(title="rotation width", fontsize=8, title_fontsize=8, loc="lower left", framealpha=0.9)
    show_ticks(left, sorted({1e3 * p.sigma_position_m for p in report.grid if p.log_likelihood is not None}))
    _draws(right, report.draws, report.level)
    for axes in (left, right):
        show_grid(axes)
    return figure


def _draws(axes: Axes, draws: list[SimulatedDraws], level: float) -> None:
    if not draws:
        axes.text(
            0.5, 0.5, "No draws were simulated yet:\nthe report's `calls` are\nthe sweeps that do it",
            transform=axes.transAxes, ha="center", va="center", fontsize=9, color=GREY,
        )  # fmt: skip
        axes.set_axis_off()
        return
    at = np.arange(len(draws))
    for ranges, colour, marker, label, shift in (
        ([d.success for d in draws], BLUE, "o", "succeed", -0.12),
        ([d.free_success for d in draws], GREEN, "s", "succeed, of those free of collision", 0.0),
        ([d.collision for d in draws], ORANGE, "^", "collide", 0.12),
    ):
        known = [i for i, item in enumerate(ranges) if item.value is not None]
        shown = [ranges[i] for i in known]
        show_ranges(axes, at[known] + shift, shown, color=colour, marker=marker, markersize=5, capsize=3,
                    label=label)  # fmt: skip
    axes.set_xticks(
        at,
        [
            f"{1e3 * d.kernel.sigma_position_m:.1f} mm\n{d.kernel.sigma_rotation_deg:.1f}°"
            + ("" if d.kernel.id is None else f"\n{d.kernel.kind}")
            + f"\n{d.protocol}\nn = {d.draws:,}"
            for d in draws
        ],
    )
    axes.set(xlim=(-0.5, len(draws) - 0.5), ylim=(0.0, 1.02), ylabel="share of simulated draws")
    axes.set_title(f"draws simulated as checks, {level:.0%} intervals", fontsize=8)
    axes.legend(fontsize=8, loc="upper right", framealpha=0.9)
