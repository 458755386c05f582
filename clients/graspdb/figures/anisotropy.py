"""The figure of the anisotropy report: shares by displacement, what the paper expects, and relations."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from graspdb.figures.canvas import Axes, Figure, new_figure, place, show_grid
from graspdb.figures.style import BLUE, GREEN, GREY, ORANGE, show_ranges, title
from graspdb.wire.reports import (
    AnisotropyHistogram,
    AnisotropyHypothesis,
    AnisotropyRelation,
    AnisotropyReport,
    AnisotropyTolerance,
    ReportRange,
)

#: Inches: the figure's width, left and right of the panels, a line of the words above them.
#: A displacement with fewer pairs of trials is drawn apart: what they share may be chance.
_FEW_PAIRS = 5
_WIDTH, _LEFT, _RIGHT, _LINE = 10.0, 0.75, 0.25, 0.19
#: A panel of every kind: its height, and what its title and labels take above and below.
_SQUARE, _PROFILE, _ROW = 2.15, 1.45, 0.27
_ABOVE, _BELOW = 0.5, 0.52
_EXPECTED = {
    "x-wide": "x forgives more than y",
    "z-wide": "z forgives more than y",
    "ry-wide": "turns about y forgive more\nthan about x or z",
    "alignment-sharpens": "widest to narrowest differ\nmore than along the gripper",
}
#: Colour, marker, and how it is filled.
_VERDICTS = {
    "confirmed": (BLUE, "o", BLUE),
    "denied": (ORANGE, "X", ORANGE),
    "undecided": (GREY, "D", "white"),
}
_RELATIONS = {
    "surfaces": "opposite surfaces",
    "coplanar-edges": "parallel edges of one face",
    "parallel-edges": "opposite edges",
    "none": "at no pair",
}


def draw_anisotropy(report: AnisotropyReport) -> Figure:
    """Draw it, from above: the words, histograms, profiles by axis, expectations, relations."""
    figure = new_figure()
    frame = "gripper" if report.alignment == "gripper" else f"{report.alignment}'s axes"
    figure.set_size_inches(_WIDTH, 10.0)
    lines = title(figure, report, f"what a success tells about its vicinity ({report.method}, {frame})")
    judged = report.hypotheses if any(item.ratio is not None for item in report.hypotheses) else []
    related = [item for item in report.relations if item.probability is not None]
    flat = _span(len(report.translations))
    heights = [flat, _SQUARE, *(_PROFILE for _ in range(0, len(report.tolerances), 3))]
    heights += [_rows(len(judged) * 1.6)] if judged else []
    heights += [_rows(_lines(related))] if related else []
    total = _LINE * (lines + 1) + sum(heights) + len(heights) * (_ABOVE + _BELOW)
    figure.set_size_inches(_WIDTH, total)
    below = total - _LINE * (lines + 1)

    def placed(left: float, width: float, height: float) -> Axes:
        return place(figure, left, below - height, width, height)

    below -= _ABOVE
    for i, histogram in enumerate(report.translations):
        axes = placed(_LEFT + i * (flat + 0.12), flat, flat)
        _translation(axes, histogram, first=i == 0)
    below -= flat + _BELOW + _ABOVE
    step = (_WIDTH - _LEFT - 0.95) / 3
    for i, histogram in enumerate(report.rotations):
        axes = placed(_LEFT + i * step, _SQUARE, _SQUARE)
        image = _rotation(axes, histogram)
    bar = figure.colorbar(image, cax=placed(_WIDTH - 0.85, 0.14, _SQUARE))
    bar.set_label("share of displaced grasps that\nsucceed (hatched: none tried)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    below -= _SQUARE + _BELOW
    step = (_WIDTH - _LEFT - _RIGHT + 0.25) / 3
    reach = {unit: _reach([t for t in report.tolerances if t.unit == unit]) for unit in ("m", "rad")}
    for i, item in enumerate(report.tolerances):
        if i % 3 == 0:
            below -= _ABOVE if i == 0 else _PROFILE + _BELOW + _ABOVE
        axes = placed(_LEFT + i % 3 * step, step - 0.25, _PROFILE)
        _profile(axes, item, reach[item.unit], report.level, first=i % 3 == 0)
    below -= _PROFILE + _BELOW
    panels: list[tuple[list[Any], float, Callable[[Axes, list[Any], float], None]]] = [
        (judged, len(judged) * 1.6, _forest),
        (related, _lines(related), _shares),
    ]
    for items, rows, show in panels:
        if items:
            below -= _ABOVE
            height = _rows(rows)
            show(placed(_LEFT + 1.45, _WIDTH - _LEFT - 1.45 - 2.6, height), items, report.level)
            below -= height + _BELOW
    return figure


def _lines(related: list[AnisotropyRelation]) -> int:
    """Every relation has a heading."""
    return len(related) + len({item.relation for item in related})


def _span(count: int) -> float:
    """Side of as many squares in a row, inches."""
    return min(_SQUARE, (_WIDTH - _LEFT - _RIGHT + 0.12) / max(count, 1) - 0.12)


def _rows(count: float) -> float:
    return max(0.8, _ROW * count)


def _translation(axes: Axes, histogram: AnisotropyHistogram, *, first: bool) -> None:
    _heat(axes, histogram, 1e3)
    low, high = histogram.slice_m or (0.0, 0.0)
    axes.set_title(f"z {1e3 * low:.0f} to {1e3 * high:.0f} mm\nn = {_total(histogram)}", fontsize=8)
    axes.set_xlabel("x [mm]", fontsize=8)
    if first:
        axes.set_ylabel("y [mm]", fontsize=8)
    else:
        axes.set_yticklabels([])


def _rotation(axes: Axes, histogram: AnisotropyHistogram) -> Any:
    image = _heat(axes, histogram, 180.0 / math.pi)
    first, second = (name[1:] for name in histogram.axes)
    axes.set_title(f"rotation about {first}, then {second}\nn = {_total(histogram)}", fontsize=8)
    axes.set_xlabel(f"about {first} [deg]", fontsize=8)
    axes.set_ylabel(f"about {second} [deg]", fontsize=8, labelpad=1)
    return image


def _total(histogram: AnisotropyHistogram) -> str:
    return f"{sum(map(sum, histogram.count)):,}"


def _heat(axes: Axes, histogram: AnisotropyHistogram, factor: float) -> Any:
    value = np.array(histogram.probability, dtype=np.float64)
    axes.set_facecolor("white")
    x, y = (factor * np.asarray(edge) for edge in histogram.edges)
    axes.fill_between(
        [x[0], x[-1]], y[0], y[-1], facecolor="white", edgecolor="0.8", hatch="////", linewidth=0
    )
    image = axes.pcolormesh(
        x, y, np.ma.masked_invalid(value.T), cmap="viridis", vmin=0.0, vmax=1.0, linewidth=0, rasterized=True
    )
    axes.plot(0.0, 0.0, marker="+", color="white", markersize=7, markeredgewidth=1.6)
    axes.set_aspect("equal")
    # None at the ends, where a neighbour's begin.
    ticks = [-90.0, 0.0, 90.0] if histogram.slice_m is None else [-0.75 * x[-1], 0.0, 0.75 * x[-1]]
    axes.set_xticks(ticks)
    axes.set_yticks(ticks)
    axes.tick_params(labelsize=8)
    return image


def _reach(items: list[AnisotropyTolerance]) -> float:
    """How far the profiles of a unit are shown: as far as was tried, turns a quarter at least."""
    ends = [abs(at) for item in items for at in (*item.displacement, *(item.tried or ()))]
    ends += [0.5 * math.pi for item in items if item.unit == "rad"]
    return max(ends, default=0.0)


def _profile(axes: Axes, item: AnisotropyTolerance, reach: float, level: float, *, first: bool) -> None:
    turn = item.unit == "rad"
    factor, unit = (180.0 / math.pi, "deg") if turn else (1e3, "mm")
    name = f"about {item.axis[1:]}" if turn else f"along {item.axis}"
    at = factor * np.asarray(item.displacement)
    if len(at):
        told, low, high = (
            np.asarray(values, dtype=np.float64)
            for values in (item.probability, item.profile_low, item.profile_high)
        )
        few = np.asarray(item.count) < _FEW_PAIRS
        if not (np.abs(at) < 0.02 * np.abs(at).max()).any():
            # No trial is where the success itself is: a line across would hide it.
            place = int(np.searchsorted(at, 0.0))
            axes.plot([0.0], [1.0], color=BLUE, marker="o", markerfacecolor="white", markersize=4, zorder=3)
            ends = np.insert(at, place, 0.0), np.insert(told, place, 1.0)
            axes.plot(*ends, color=BLUE, linewidth=0.8, linestyle="--")
            at, told, low, high = (np.insert(values, place, np.nan) for values in (at, told, low, high))
            few = np.insert(few, place, False)
        axes.fill_between(at, low, high, color=BLUE, alpha=0.2, linewidth=0, label=f"{level:.0%} interval")
        many = np.where(few, np.nan, told)
        axes.plot(at, many, color=BLUE, marker=".", markersize=4, linewidth=1.2)
        axes.plot(
            at[few], told[few], color=BLUE, marker="o", markersize=3, markerfacecolor="white", linestyle=""
        )
        if item.axis == "x":
            axes.legend(fontsize=7, loc="lower center", framealpha=0.9)
    axes.axhline(0.5, color=GREY, linestyle="--", linewidth=0.8)
    if item.tried is not None:
        _hatch_untried(axes, *(factor * at for at in (*item.tried, max(1.05 * reach, 1e-6))))
    for end, sign in ((item.minus, -1.0), (item.plus, 1.0)):
        if item.half_width is None or end is None:
            continue
        if item.least is None:
            axes.axvline(sign * factor * end, color=ORANGE, linestyle=":", linewidth=1.2)
        else:
            # Where the profile seems to fall is no half width then: at least as far as the title says.
            axes.plot(
                sign * factor * item.least, 0.5, color=ORANGE, marker=">" if sign > 0 else "<", markersize=5
            )
    axes.set_title(f"forgives {name}: {item.in_words()}\nn = {sum(item.count):,}", fontsize=8)
    axes.set_ylim(0.0, 1.02)
    axes.set_xlabel(f"{name} [{unit}]", fontsize=8)
    if turn:
        axes.set_xticks([-90, -45, 0, 45, 90])
    if first:
        axes.set_ylabel("share that succeeds\n(others unchanged)", fontsize=8)
    else:
        axes.set_yticklabels([])
    show_grid(axes)


def _hatch_untried(axes: Axes, low: float, high: float, reach: float) -> None:
    """What lies farther than was tried, to either side."""
    for begin, end in ((-reach, low), (high, reach)):
        axes.fill_between(
            [begin, end], 0.0, 1.02, facecolor="white", edgecolor="0.8", hatch="////", linewidth=0, zorder=0.5
        )
    axes.set_xlim(-reach, reach)


def _forest(axes: Axes, found: list[AnisotropyHypothesis], level: float) -> None:
    """Quotients with their intervals on a scale of ratios; the verdict in words, marker and colour."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    ends: list[float] = [0.5, 2.0]
    for i, item in enumerate(found):
        if item.ratio is None:
            axes.annotate(
                "these trials do not tell:\nundecided", (1.02, i), xycoords=("axes fraction", "data"),
                fontsize=8, va="center", color="0.15",
            )  # fmt: skip
            continue
        ratio = item.ratio
        low, high = item.low or ratio, item.high or ratio
        ends += [0.8 * low, 1.25 * high]
        colour, marker, face = _VERDICTS[item.verdict]
        axes.plot([low, high], [i, i], color=colour, linewidth=2.0, solid_capstyle="butt")
        for end in (low, high):
            axes.plot([end, end], [i - 0.12, i + 0.12], color=colour, linewidth=1.2)
        axes.plot([ratio], [i], color=colour, marker=marker, markerfacecolor=face, markersize=7)
        bound = {"lower": "at least ", "upper": "at most ", "both": "about "}.get(item.bound or "", "")
        if item.bound in ("lower", "upper"):
            axes.annotate(
                "", (high * 1.2 if item.bound == "lower" else low / 1.2, i),
                xytext=(high if item.bound == "lower" else low, i),
                arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1.2},
            )  # fmt: skip
        _beside(axes, f"{bound}{ratio:.2f} ({low:.2f} to {high:.2f}):\n{item.verdict}", (1.02, i))
    axes.axvline(1.0, color="0.15", linewidth=1.0)
    axes.set_xscale("log")
    axes.set_xlim(min(ends), max(ends))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_yticks(range(len(found)), [_EXPECTED.get(item.name, item.name) for item in found], fontsize=8)
    axes.set_ylim(len(found) - 0.4, -0.6)
    axes.set_xlabel(
        f"quotient of half widths, {level:.0%} intervals (right of 1: as the paper expects)", fontsize=8
    )
    axes.set_title(
        "what the paper expects  (\u25cf confirmed, \u2716 denied, \u25c7 undecided)", fontsize=9, loc="left"
    )
    show_grid(axes)


def _beside(axes: Axes, text: str, at: tuple[float, float]) -> None:
    """Words to the right of a share of the axes' width, in a row."""
    across = ("axes fraction", "data")
    axes.annotate(text, at, xycoords=across, fontsize=8, va="center", color="0.15")


def _shares(axes: Axes, found: list[AnisotropyRelation], level: float) -> None:
    """P(success | relation), all attempts and those that did not collide, with how many there are."""
    row, labels, at, last = 0.0, [], [], None
    series: dict[str, list[tuple[float, ReportRange]]] = {"all": [], "free": []}
    for item in found:
        if item.relation != last:
            row += 0.35 if last is not None else 0.0
            if item.angle_deg is not None:
                heading = _RELATIONS.get(item.relation, item.relation)
                _beside(axes, f"{heading}, the closing axis off theirs by", (0.01, row))
                row += 0.8
            last = item.relation
        labels.append(
            _RELATIONS.get(item.relation, item.relation)
            if item.angle_deg is None
            else f"{item.angle_deg[0]:g} to {item.angle_deg[1]:g}\u00b0"
        )
        at.append(row)
        for name, value, low, high in (
            ("all", item.probability, item.low, item.high),
            ("free", item.free_probability, item.free_low, item.free_high),
        ):
            if value is not None:
                series[name].append((row, ReportRange(value=value, low=low, high=high)))
        free = item.attempts - item.collisions
        axes.annotate(
            f"n = {item.attempts:,}; {free:,} do not collide", (1.02, row),
            xycoords=("axes fraction", "data"), fontsize=7.5, va="center", annotation_clip=False,
        )  # fmt: skip
        row += 1.0
    for name, colour, marker, shift, label in (
        ("all", BLUE, "o", -0.14, "all attempts"),
        ("free", GREEN, "s", 0.14, "attempts that do not collide"),
    ):
        if series[name]:
            rows, ranges = zip(*series[name], strict=True)
            at_row = np.array(rows) + shift
            show_ranges(axes, at_row, ranges, upright=False, color=colour, marker=marker, markersize=5,
                        capsize=2.5, label=label)  # fmt: skip
    axes.set_yticks(at, labels, fontsize=8)
    axes.set(ylim=(row - 0.4, -0.6), xlim=(0.0, 1.0))
    axes.set_xlabel(f"share that succeeded, {level:.0%} intervals", fontsize=8)
    axes.set_title("by what the jaw closes on", fontsize=9, loc="left")
    axes.legend(fontsize=7.5, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
    show_grid(axes)
