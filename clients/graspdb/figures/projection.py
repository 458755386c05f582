"""The figure of the projection report: a density on a plane over the object's silhouette, and on its axes."""

from __future__ import annotations

from typing import Any

import numpy as np

from graspdb.figures.canvas import Axes, Figure, new_figure, place, show_grid
from graspdb.figures.style import BLUE, GREY, title, widths
from graspdb.wire.reports import ProjectionProfile, ProjectionReport

#: Inches: the plane's longer side and its shorter one at least, the profiles, and what is left around them.
_LONGEST, _SHORTEST, _ABOVE, _BESIDE, _GAP = 5.2, 2.4, 1.1, 1.3, 0.15
#: The plane and the profile beside it together at least: the words need room.
_NARROWEST = 5.4
_LEFT, _BELOW, _TITLE = 0.85, 0.6, 0.95


def draw_projection(report: ProjectionReport) -> Figure:
    """Draw it: the plane, and the profiles above and beside it."""
    figure = new_figure()
    from matplotlib.patches import Polygon

    which = "grasps that point one way" if report.approach or report.direction else "all grasps"
    title(figure, report, f"where grasps succeed, {which}")
    across, upward = (1e3 * np.asarray(edges) for edges in (report.across_m, report.upward_m))
    left, right, bottom, top = _reach(report, across, upward)
    wide, high = right - left, top - bottom
    # Placed by hand: the plane keeps its shape, and the profiles stand along its sides.
    scale = _LONGEST / max(wide, high)
    size = max(scale * wide, _SHORTEST), max(scale * high, _SHORTEST)
    beside_inches = max(_BESIDE, _NARROWEST - size[0])
    total = _LEFT + size[0] + _GAP + beside_inches + 1.25, _BELOW + size[1] + _GAP + _ABOVE + _TITLE
    figure.set_size_inches(*total)

    axes = place(figure, _LEFT, _BELOW, *size)
    above = place(figure, _LEFT, _BELOW + size[1] + _GAP, size[0], _ABOVE, sharex=axes)
    beside = place(figure, _LEFT + size[0] + _GAP, _BELOW, beside_inches, size[1], sharey=axes)
    values = np.ma.masked_less(np.asarray(report.values), 1e-3)
    image = axes.pcolormesh(
        across, upward, values.T, cmap="Reds", vmin=0.0, vmax=1.0, linewidth=0, rasterized=True
    )
    for polygon in report.outline:
        corners = 1e3 * np.asarray(polygon)
        axes.add_patch(Polygon(corners, closed=True, fill=False, edgecolor=GREY, linewidth=0.9, zorder=3))
    first, second = report.profiles
    limits = (axes.set_xlim, left, right, size[0]), (axes.set_ylim, bottom, top, size[1])
    for set_limits, low, most, inches in limits:
        middle = 0.5 * (low + most)
        set_limits(middle - 0.5 * inches / scale, middle + 0.5 * inches / scale)
    axes.set_xlabel(f"{first.axis} [mm]")
    axes.set_ylabel(f"{second.axis} [mm]")
    scale_left = _LEFT + size[0] + _GAP + beside_inches + 0.25
    bar = figure.colorbar(image, cax=place(figure, scale_left, _BELOW, 0.16, size[1]))
    bar.set_label(
        f"density on the plane; 1 is {1e-4 * report.peak_per_m2:.3g} % of all grasps per mm\u00b2", fontsize=8
    )
    for each in (axes, bar.ax):
        each.tick_params(labelsize=8)
    _profile(above, first, upright=False)
    _profile(beside, second, upright=True)
    above.tick_params(labelbottom=False)
    beside.tick_params(labelleft=False)
    corner = place(figure, _LEFT + size[0] + _GAP, _BELOW + size[1] + _GAP, beside_inches, _ABOVE)
    corner.axis("off")
    corner.text(0.0, 1.0, _key(report), transform=corner.transAxes, va="top", fontsize=8)
    return figure


def _reach(report: ProjectionReport, across: Any, upward: Any) -> tuple[float, float, float, float]:
    """Left, right, bottom and top in millimetres: all of the density and of the object."""
    x, y = [across[0], across[-1]], [upward[0], upward[-1]]
    for polygon in report.outline:
        x += [1e3 * point[0] for point in polygon]
        y += [1e3 * point[1] for point in polygon]
    return float(min(x)), float(max(x)), float(min(y)), float(max(y))


def _profile(axes: Axes, item: ProjectionProfile, *, upright: bool) -> None:
    from matplotlib.ticker import MaxNLocator

    at = 1e3 * np.asarray(item.at_m)
    value, low, high = (0.1 * np.asarray(x) for x in (item.density_per_m, item.low, item.high))
    fill: Any = axes.fill_betweenx if upright else axes.fill_between
    fill(at, low, high, color=BLUE, alpha=0.25, linewidth=0)
    axes.plot(*((value, at) if upright else (at, value)), color=BLUE, linewidth=1.3)
    (axes.set_xlim if upright else axes.set_ylim)(0.0, None)
    (axes.set_xlabel if upright else axes.set_ylabel)("% of all\ngrasps per mm", fontsize=8)
    (axes.xaxis if upright else axes.yaxis).set_major_locator(MaxNLocator(3, prune="lower"))
    show_grid(axes)


def _key(report: ProjectionReport) -> str:
    lines = [f"n = {report.passing:,} of {report.grasps:,}", "successful grasps"]
    if report.outside:
        lines.append(f"{report.outside:,} far away, not shown")
    for name, vector, cone in (
        ("approach (tool z)", report.approach, report.approach_cone_deg),
        ("direction (tool x)", report.direction, report.direction_cone_deg),
    ):
        if vector is not None:
            lines.append(f"{name} within {cone:g}\u00b0 of\n  ({', '.join(f'{x:.3g}' for x in vector)})")
    lines.append(f"kernel {widths(report.kernel)}")
    lines.append("grey: the object" if report.outline else "no mesh: no silhouette")
    lines.append(f"band: {report.level:.0%} interval, all depths")
    return "\n".join(lines)
