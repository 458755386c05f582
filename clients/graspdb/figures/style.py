"""What the figures of reports look like: colours, titles, ranges, and how numbers are written."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from graspdb.figures.canvas import Axes, Figure
from graspdb.wire import OUTCOMES
from graspdb.wire.reports import ReportRange

#: Okabe and Ito's, which colour-blind readers tell apart.
BLUE, ORANGE, GREEN, YELLOW, GREY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#666666"
_PINK, _SKY = "#CC79A7", "#56B4E9"
COLOURS = (BLUE, ORANGE, GREEN, YELLOW, _PINK, _SKY, GREY)
#: Of outcomes, success the darkest, wherever they are drawn: here and in the viewer.
OUTCOME_COLOURS = dict(
    zip(OUTCOMES, (GREY, BLUE, ORANGE, _SKY, YELLOW, "#F0E442", GREEN, _PINK, "#BBBBBB"), strict=True)
)
SOURCE_COLOURS = {"simulation": BLUE, "robot": ORANGE, "human": GREEN, "import": _PINK}


MARKERS = "osD^v"
#: Of a curve with error bars.
CURVE: dict[str, Any] = {"markersize": 4, "capsize": 3, "linewidth": 1.5}


def title(figure: Figure, report: Any, kind: str) -> int:
    """The object, of which trials the report is, and its answer in words; how many lines that takes."""
    of = ", ".join(x for x in (report.gripper, report.protocol, report.source) if x)
    first = f"{report.object}: {kind}" + (f" ({of})" if of else "") + f", revision {report.revision}"
    return heading(figure, first, report.text)


def heading(figure: Figure, first: str, text: str) -> int:
    """A title line and words below it, wrapped to the figure's width; the number of lines."""
    width = round(11 * figure.get_figwidth())
    words = f"{first}\n{textwrap.fill(text, width, break_long_words=False, break_on_hyphens=False)}"
    figure.suptitle(words, fontsize=10)
    return 1 + words.count("\n")


def number(value: float | None) -> str:
    """Two decimals, or that it is not known."""
    return "unknown" if value is None else f"{value:.2f}"


def widths(kernel: Any) -> str:
    """A kernel's widths in words."""
    return f"{1e3 * kernel.sigma_position_m:.1f} mm, {kernel.sigma_rotation_deg:.1f}°"


def show_ranges(
    axes: Axes, at: Any, ranges: Sequence[ReportRange], *, upright: bool = True, **style: Any
) -> None:
    """Draw values with their intervals as marks at ``at``, upright or lying."""
    values = [item.value or 0.0 for item in ranges]
    low = [value if item.low is None else item.low for item, value in zip(ranges, values, strict=True)]
    high = [value if item.high is None else item.high for item, value in zip(ranges, values, strict=True)]
    ends = np.maximum([np.subtract(values, low), np.subtract(high, values)], 0.0)
    places = {"x": at, "y": values, "yerr": ends} if upright else {"x": values, "y": at, "xerr": ends}
    axes.errorbar(**places, **{"linestyle": "none", **style})
